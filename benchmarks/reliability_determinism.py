"""Check that equal seeds give bit-equal episodes in every mode of execution, and compare their stored hashes.

    python benchmarks/reliability_determinism.py            # run every mode and compare with the file
    python benchmarks/reliability_determinism.py --write    # write the file after a change of the environments
    python benchmarks/reliability_determinism.py --write --ids viapoint/PlanarWholeArm-v0

Episode i of an environment begins with `reset(seed=i)` and has actions that depend on i alone. Its hash is that of the
first and last observation, all rewards and all of `info`. The hashes are in tests/envs/episode_hashes.json, with the
versions that their last bits depend on: MuJoCo, NumPy, the C library and the processor's vector instructions.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import hashlib
import json
import multiprocessing
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import viapoint.envs
from viapoint.envs.registration import REPLANNING_TASKS, STEP_TASKS, TASKS

FILE = Path(__file__).parents[1] / "tests" / "envs" / "episode_hashes.json"
IDS = sorted({*TASKS, *STEP_TASKS, *REPLANNING_TASKS})
EPISODES = 1_000
EVERY = 100
"""Interval of stored hashes: of the first 100 episodes, of the first 200 and so on."""
STEPS = 400
"""Upper bound of the steps of an episode."""

assert viapoint.envs, "importing it registers the environments"


def fingerprint() -> dict[str, str]:
    """Return the versions that the last bits of a result depend on."""
    from numpy._core._multiarray_umath import __cpu_features__

    present = "+".join(sorted(name for name, there in __cpu_features__.items() if there))
    return {
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
        "processor": hashlib.sha256(present.encode()).hexdigest()[:16],
        "arithmetic": arithmetic(),
    }


def arithmetic() -> str:
    """Return a hash of results whose last bits differ between processors with the same instructions.

    Linear algebra is computed by kernels that are chosen by the processor's model.
    """
    numbers = np.random.default_rng(0).uniform(-1.0, 1.0, (24, 24))
    results = [
        numbers @ numbers,
        numbers.astype(np.float32) @ numbers.astype(np.float32),
        np.linalg.eigvals(numbers),
        np.linalg.solve(numbers, numbers[0]),
        np.sin(numbers),
        np.tan(numbers),
        np.exp(numbers),
        np.arctan2(numbers, 0.5),
    ]
    # Polynomials of degree 10, as in the passage times of movements that begin in motion.
    companion = np.zeros((24, 10, 10))
    companion[:, 0], companion[:, np.arange(1, 10), np.arange(9)] = numbers[:, :10], 1.0
    results.append(np.linalg.eigvals(companion))
    return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in results)).hexdigest()[:16]


def actions(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the actions of an episode, shape (STEPS, *shape)."""
    return np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, (STEPS, *shape)).astype(np.float32)


class Digest:
    """Hash of one episode, updated step by step."""

    def __init__(self, observation: dict[str, np.ndarray]) -> None:
        self.sum = hashlib.sha256()
        self.add(observation)

    def add(self, values: dict[str, Any]) -> None:
        for name in sorted(values):
            self.sum.update(name.encode() + np.ascontiguousarray(values[name]).tobytes())

    def step(self, reward: float) -> None:
        self.sum.update(np.float64(reward).tobytes())

    def end(self, observation: dict[str, np.ndarray], info: dict[str, Any]) -> bytes:
        self.add(observation)
        self.add({name: np.float64(value) for name, value in info.items()})
        return self.sum.digest()


def single(env_id: str, seeds: Sequence[int], **kwargs: Any) -> list[bytes]:
    """Return the hashes of episodes in a single environment."""
    env, result = gym.make(env_id, disable_env_checker=True, **kwargs), []
    for seed in seeds:
        observation, _ = env.reset(seed=int(seed))
        digest, planned, over = Digest(observation), actions(seed, env.action_space.shape), False
        for action in planned:
            observation, reward, terminated, truncated, info = env.step(action)
            digest.step(reward)
            if over := terminated or truncated:
                break
        assert over, "an episode does not end"
        result.append(digest.end(observation, info))
    env.close()
    return result


def together(env: gym.vector.VectorEnv, seeds: Sequence[int]) -> list[bytes]:
    """Return the hashes of episodes in a vector environment, `num_envs` at a time."""
    result: list[bytes] = []
    shape = env.single_action_space.shape
    for first in range(0, len(seeds), env.num_envs):
        chunk = [int(seed) for seed in seeds[first : first + env.num_envs]]
        chunk += range(10**6, 10**6 + env.num_envs - len(chunk))
        result += _chunk(env, chunk, np.stack([actions(seed, shape) for seed in chunk], axis=1))
    env.close()
    return result[: len(seeds)]


def _chunk(env: gym.vector.VectorEnv, seeds: list[int], planned: np.ndarray) -> list[bytes]:
    observation, _ = env.reset(seed=seeds)
    digests = [Digest({name: part[i] for name, part in observation.items()}) for i in range(len(seeds))]
    ends: list[bytes | None] = [None] * len(seeds)
    for action in planned:
        _, reward, terminated, truncated, info = env.step(action)
        for i in np.flatnonzero([end is None for end in ends]):
            digests[i].step(reward[i])
            if terminated[i] or truncated[i]:
                final = info["final_info"]
                values = {name: final[name][i] for name in final if not name.startswith("_")}
                ends[i] = digests[i].end(info["final_obs"][i], values)
        if None not in ends:
            return ends
    raise AssertionError("an episode does not end")


def native(env_id: str, seeds: Sequence[int], num_envs: int, threads: int = 1) -> list[bytes]:
    """Return the hashes of episodes in the native vector environment."""
    return together(gym.make_vec(env_id, num_envs=num_envs, threads=threads), seeds)


def synchronous(env_id: str, seeds: Sequence[int], num_envs: int) -> list[bytes]:
    """Return the hashes of episodes in Gymnasium's vector of single environments."""
    makers = [lambda: gym.make(env_id, disable_env_checker=True)] * num_envs
    return together(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP), seeds)


def elsewhere(env_id: str, seeds: Sequence[int], processes: int) -> list[bytes]:
    """Return the hashes of episodes in new processes, which share the seeds."""
    shares = [list(seeds[i::processes]) for i in range(processes)]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        parts = pool.starmap(single, [(env_id, share) for share in shares])
    return [parts[i % processes][i // processes] for i in range(len(seeds))]


WAYS: dict[str, Callable[[str, Sequence[int]], list[bytes]]] = {
    "one at a time": single,
    "two at a time": lambda env_id, seeds: native(env_id, seeds, 2),
    "65 at a time, two threads": lambda env_id, seeds: native(env_id, seeds, 65, 2),
    "500 at a time, three threads": lambda env_id, seeds: native(env_id, seeds, 500, 3),
    "seven single ones in SyncVectorEnv": lambda env_id, seeds: synchronous(env_id, seeds, 7),
    "two other processes": lambda env_id, seeds: elsewhere(env_id, seeds, 2),
}
"""Modes of execution that are compared with 100 episodes at a time on one thread."""


def reference(env_id: str, episodes: int) -> list[bytes]:
    """Return the hashes of the first episodes, 100 at a time on one thread."""
    return native(env_id, range(episodes), 100)


def hashes(digests: Sequence[bytes]) -> list[str]:
    """Return a hash of the first EVERY episodes, of the first two times EVERY and so on."""
    ends = range(EVERY, len(digests) + 1, EVERY)
    return [hashlib.sha256(b"".join(digests[:end])).hexdigest()[:16] for end in ends]


def write(ids: Sequence[str]) -> None:
    """Write the file, or its entries of some environments if the versions are unchanged."""
    made = fingerprint()
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    known = kept["hashes"] if kept.get("made_with") == made else {}
    known = {env_id: known[env_id] for env_id in IDS if env_id in known}
    for env_id in ids if known else IDS:
        known[env_id] = hashes(reference(env_id, EPISODES))
        print(f"{env_id}: {known[env_id][-1]}", flush=True)
    content = {"made_with": made, "every": EVERY, "hashes": {name: known[name] for name in sorted(known)}}
    FILE.write_text(json.dumps(content, indent=1) + "\n")


def check(ids: Sequence[str], episodes: int, file: Path | None = None) -> bool:
    """Run every mode and return whether all hashes are equal; `file` gets the number of those that differ as JSON."""
    stored, good = json.loads(FILE.read_text()), True
    found: dict[str, dict[str, Any]] = {}
    comparable = stored["made_with"] == fingerprint()
    for env_id in ids:
        digests = reference(env_id, episodes)
        if comparable:
            same = hashes(digests) == stored["hashes"][env_id][: episodes // EVERY]
            print(
                f"{env_id}: {episodes} episodes {'have' if same else 'DO NOT HAVE'} the stored hashes",
                flush=True,
            )
            good &= same
        found[env_id] = {"episodes": episodes, "differ": {}}
        for name, way in WAYS.items():
            other = way(env_id, range(episodes))
            wrong = sum(a != b for a, b in zip(digests, other, strict=True))
            found[env_id]["differ"][name] = wrong
            print(f"{env_id}: {name}: {wrong} of {episodes} episodes differ", flush=True)
            good &= wrong == 0
        if file is not None:
            file.write_text(json.dumps(found, indent=1) + "\n")
    if not comparable:
        print(f"stored hashes were made with {stored['made_with']}, this is {fingerprint()}: not compared")
    return good


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--ids", nargs="+", default=IDS, choices=IDS)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--json", type=Path, help="file for the numbers of episodes that differ")
    arguments = parser.parse_args()
    if arguments.write:
        write(arguments.ids)
        return
    raise SystemExit(not check(arguments.ids, arguments.episodes, arguments.json))


if __name__ == "__main__":
    main()
