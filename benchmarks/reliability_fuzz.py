"""Fuzz the environments with adversarial actions, scenes and sequences of calls.

    python benchmarks/reliability_fuzz.py [--ids ID ...] [--actions N] [--scenes N] [--calls N] [--json FILE]

For every environment: 100,000 actions at and beyond the bounds of their space; 10,000 scenes with obstacles that touch,
contain and repeat each other, of extreme sizes; and 5,000 calls of reset, partial reset, step and close in random
order, with valid and invalid arguments. A call succeeds or raises `ValueError` or `gymnasium.error.ResetNeeded`; its
results are finite and within their spaces; memory does not grow.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import ctypes
import json
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import viapoint.envs
from viapoint.envs.registration import REPLANNING_TASKS, STEP_TASKS, TASKS

IDS = sorted({*TASKS, *STEP_TASKS, *REPLANNING_TASKS})
DOCUMENTED = (ValueError, gym.error.ResetNeeded)
"""Exceptions that a call may raise."""
PARTS = 10
"""Number of parts of each run; memory is measured after each."""
MEGABYTE = 1 << 20
ALLOWED = 8.0
"""Allowed growth of memory, [MB]."""
TINY = float(np.finfo(np.float32).smallest_subnormal)
EDGES = np.array(
    [-1.0, 1.0, 0.0, -0.0, TINY, -TINY, 1e-300, np.nextafter(1.0, 0.0), np.nextafter(1.0, 2.0), 3e38, -1e300]
)

assert viapoint.envs, "importing it registers the environments"


def adversarial_actions(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Return finite adversarial actions, shape (N, m)."""
    uniform = generator.uniform(-1.0, 1.0, shape)
    kinds = (
        uniform,
        np.sign(uniform),
        generator.choice(EDGES, shape),
        np.where(np.arange(shape[1]) % 2 == 0, 1.0, -1.0) * np.sign(uniform[:, :1]),
        np.where(generator.random(shape) < 0.3, generator.choice(EDGES, shape), uniform),
        uniform * 10.0 ** generator.uniform(-40, 30, shape),
    )
    rows = generator.integers(len(kinds), size=shape[0])
    return np.stack(kinds)[rows, np.arange(shape[0])]


def check(env: Any, observation: Any, reward: Any, info: dict[str, Any]) -> None:
    """Check that the results of a step are finite and within their spaces."""
    assert env.observation_space.contains(observation), "an observation is out of its space"
    assert np.isfinite(reward).all(), "a reward is not finite"
    for name, value in {**info, **info.get("final_info", {})}.items():
        if isinstance(value, np.ndarray) and value.dtype != object:
            assert np.isfinite(value).all(), f"{name} is not finite"
    for last in info.get("final_obs", ()):
        assert last is None or env.single_observation_space.contains(last), (
            "a last observation is out of its space"
        )


def fuzz_actions(env_id: str, number: int, seed: int = 0, num_envs: int = 250) -> Counter[str]:
    """Run steps with adversarial actions; invalid ones in between must be rejected without side effects."""
    generator, found = np.random.default_rng(seed), Counter[str]()
    env = gym.make_vec(env_id, num_envs=num_envs, threads=1)
    env.reset(seed=seed)
    shape = env.action_space.shape
    while found["actions"] < number:
        actions = adversarial_actions(generator, shape)
        if generator.random() < 0.2:
            bad = actions.copy()
            bad[tuple(generator.integers(shape))] = generator.choice([np.nan, np.inf, -np.inf])
            try:
                env.step(bad)
            except ValueError:
                found["refused"] += 1
            else:
                raise AssertionError("an action that is not finite was taken")
        observation, reward, _, _, info = env.step(actions)
        check(env, observation, reward, info)
        found["actions"] += num_envs
        found["unstable"] += int(info["unstable"].sum())
        found["successes"] += int(info["is_success"].sum())
    env.close()
    return found


def adversarial_scene(generator: np.random.Generator, env: Any) -> dict[str, np.ndarray]:
    """Return options for `reset` with an adversarial scene."""
    task = env.unwrapped.task
    d, rows = task.arm.dimension, env.unwrapped.observation_layout.n_rows
    start, goal = generator.uniform(-0.6, 0.6, (2, d))
    if generator.random() < 0.8:
        scene = env.unwrapped.batch.scenes
        start, goal = scene.start[0], scene.goal[0]  # of the episode that runs: within reach
    size = 10.0 ** generator.uniform(-12, 0.5)
    goal = start + (goal - start) * (1.0 if generator.random() < 0.7 else size)
    count = int(generator.integers(0, rows + 1))
    places = np.stack((start, goal, (start + goal) / 2.0, generator.uniform(-1.0, 1.0, d)))
    centre = places[generator.integers(4, size=count)]
    kind = generator.integers(6)
    radius = generator.choice([1e-320, 1e-12, 1e-4, 0.02, 0.1, 0.1 + 1e-9, 5.0, 0.0, -0.01], count)
    axis = generator.normal(size=(count, d)) * generator.choice(
        [0.0, 1e-310, 1e-9, 0.05, 0.17, 3.0], (count, 1)
    )
    if kind == 0:  # touching the hand, or nearly so
        offset = generator.normal(size=(count, d))
        radius, axis = np.full(count, 0.03), axis * 0.0
        gap = task.arm.hand_radius + radius + generator.choice([-1e-9, 0.0, 1e-12, 1e-6, 1e-3], count)
        centre = centre + offset / np.linalg.norm(offset, axis=-1, keepdims=True) * gap[:, None]
    elif kind == 1:  # nested
        centre, axis = np.repeat(places[3:], count, axis=0), axis * 0.0
    elif kind == 2 and count:  # coincident
        centre, axis, radius = (np.repeat(part[:1], count, axis=0) for part in (centre, axis, radius))
    elif kind >= 4:  # somewhere, of sizes that are allowed
        centre = generator.uniform(-0.7, 0.7, (count, d))
        radius = generator.choice([1e-320, 1e-9, 1e-3, 0.03, 0.1], count)
        axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-300)
        axis = axis * generator.choice([0.0, 1e-12, 1e-3, 0.3 - 1e-9], (count, 1))
    return {"start": start, "goal": goal, "obstacles": np.column_stack((centre, axis, radius))}


def fuzz_scenes(env_id: str, number: int, seed: int = 0) -> Counter[str]:
    """Run adversarial scenes; each is rejected with a reason, or an episode runs in it."""
    generator, found = np.random.default_rng(seed), Counter[str]()
    env = gym.make(env_id, disable_env_checker=True)
    for count in range(number):
        env.reset(seed=seed + count)
        try:
            observation, _ = env.reset(options=adversarial_scene(generator, env))
        except ValueError as error:
            found["refused" if str(error) else "refused without a reason"] += 1
        else:
            found["played"] += 1
            assert env.observation_space.contains(observation)
        observation, reward, _, _, info = env.step(
            adversarial_actions(generator, (1, *env.action_space.shape))[0]
        )
        assert env.observation_space.contains(observation), "an observation is out of its space"
        assert np.isfinite([reward, *info.values()]).all(), "a reward or info is not finite"
        found["unstable"] += bool(info["unstable"])
    env.close()
    return found


def _calls(generator: np.random.Generator, env: Any) -> dict[str, Callable[[], Any]]:
    """Return valid and invalid calls of a vector environment."""
    n, shape = env.num_envs, env.action_space.shape
    mask = generator.random(n) < 0.5
    bad_mask = (np.ones(n + 1, dtype=bool), np.zeros(n, dtype=bool), np.ones(n), "all")[generator.integers(4)]
    bad_seed = (-1, 1.5, "one", [0])[generator.integers(4)]
    return {
        "reset": lambda: env.reset(),
        "reset with a seed": lambda: env.reset(seed=int(generator.integers(1000))),
        "reset with seeds": lambda: env.reset(seed=[None, *map(int, generator.integers(9, size=n - 1))]),
        "reset with a bad seed": lambda: env.reset(seed=bad_seed),
        "reset some": lambda: env.reset(options={"reset_mask": mask}),
        "reset some badly": lambda: env.reset(options={"reset_mask": bad_mask}),
        "reset to a bad scene": lambda: env.reset(options={"start": np.full(shape[1], np.nan)}),
        "reset by an unknown name": lambda: env.reset(options={"speed": 3}),
        "step": lambda: env.step(adversarial_actions(generator, shape)),
        "step at rest": lambda: env.step(np.zeros(shape)),
        "step badly": lambda: env.step(np.full(shape, np.nan)),
        "step in a wrong shape": lambda: env.step(np.zeros((n, shape[1] + 1))),
        "step by words": lambda: env.step([["left"] * shape[1]] * n),
        "close": env.unwrapped.close_extras,
    }


def fuzz_calls(env_id: str, number: int, seed: int = 0) -> Counter[str]:
    """Run calls in random order, with a new environment after every 500."""
    generator, found, env = np.random.default_rng(seed), Counter[str](), None
    for count in range(number):
        if env is None or count % 500 == 0:
            if env is not None:
                env.close()
            env = gym.make_vec(
                env_id, num_envs=int(generator.integers(2, 6)), threads=int(generator.integers(1, 3))
            )
        calls = _calls(generator, env)
        name = str(generator.choice([*calls, "step", "step", "step"]))
        try:
            result = calls[name]()
        except DOCUMENTED as error:
            found["refused" if str(error) else "refused without a reason"] += 1
            continue
        found["done"] += 1
        if name.startswith("step"):
            observation, reward, _, _, info = result
            check(env, observation, reward, info)
        elif name.startswith("reset"):
            assert env.observation_space.contains(result[0])
    env.close()
    return found


def memory() -> float:
    """Return the resident memory of this process without free blocks of its allocator, [MB]."""
    getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MEGABYTE


def run_in_parts(fuzz: Callable[..., Counter[str]], env_id: str, number: int) -> dict[str, Any]:
    """Return the counts of a run and the growth of memory from its first half to its second.

    Each half counts with its minimum, which distinguishes a leak from blocks that the allocator keeps for a while.
    """
    found, samples, began = Counter[str](), [], time.process_time()
    for part in range(PARTS):
        found.update(fuzz(env_id, max(1, number // PARTS), seed=part * 10**6))
        samples.append(memory())
    growth = min(samples[PARTS // 2 :]) - min(samples[: PARTS // 2])
    return {**found, "memory_growth": round(growth, 2), "seconds": round(time.process_time() - began, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--ids", nargs="+", default=IDS, choices=IDS)
    parser.add_argument("--actions", type=int, default=100_000)
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--calls", type=int, default=5_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results: dict[str, dict[str, Any]] = {}
    for env_id in arguments.ids:
        for fuzz in (fuzz_actions, fuzz_scenes, fuzz_calls):
            kind = fuzz.__name__.removeprefix("fuzz_")
            result = run_in_parts(fuzz, env_id, getattr(arguments, kind))
            results.setdefault(env_id, {})[kind] = result
            print(env_id, kind, json.dumps(result), flush=True)
            if arguments.json is not None:
                arguments.json.write_text(json.dumps(results, indent=1))
    every = [each for kinds in results.values() for each in kinds.values()]
    dumb = any("refused without a reason" in each for each in every)
    raise SystemExit(dumb or max(each["memory_growth"] for each in every) > ALLOWED)


if __name__ == "__main__":
    main()
