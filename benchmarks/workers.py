"""Speed of environments on threads, in worker processes and in Ray actors, in one alternating run.

    python benchmarks/workers.py --json docs/vectorized.json

takes about two minutes on two idle cores. Parts of a step are processor times, which other load hardly changes.
The predictions for more cores are those of the model on docs/vectorized.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.training import RayVecEnv, ViaVecEnv

ENVS = ("viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0")
CORES = (1, 2, 4, 8, 16)
WARM_UP = 8
"""Steps before those that are timed: scenes are then as many ahead as later."""
SPIN = """
import time
end, count = time.perf_counter() + 0.2, 0
while time.perf_counter() < end:
    count += 1
print(count)
"""
"""Script that counts for 0.2 s."""


def measured(env_id: str, num_envs: int, repeats: int) -> dict[str, Any]:
    """Return decisions per second of each way, and the parts of a step in processor time, [s]."""
    envs = {
        **{f"threads={k}": gym.make_vec(env_id, num_envs=num_envs, threads=k) for k in (1, 2)},
        **{f"workers={w}": gym.make_vec(env_id, num_envs=num_envs, workers=w, threads=1) for w in (1, 2)},
        "ViaVecEnv, workers=2": ViaVecEnv(env_id, num_envs, seed=0, workers=2, threads=1),
        "RayVecEnv, workers=2": RayVecEnv(env_id, num_envs, seed=0, workers=2),
    }
    generator = np.random.default_rng(0)
    shape = num_envs, *envs["threads=1"].single_action_space.shape
    actions = generator.uniform(-0.3, 0.3, (WARM_UP + repeats, *shape)).astype(np.float32)
    for env in envs.values():
        env.reset() if isinstance(env, ViaVecEnv) else env.reset(seed=0)
        for action in actions[:WARM_UP]:
            env.step(action)
    physics = timed(envs["threads=1"].unwrapped._simulator, "rollout")
    times: dict[str, list[float]] = {name: [] for name in envs}
    busy: dict[str, list[float]] = {name: [] for name in envs}
    free = []
    for action in actions[WARM_UP:]:  # equal seeds: all ways have the same scenes
        free.append(free_cores())
        for name, env in envs.items():
            began, worked = time.perf_counter(), time.thread_time()
            env.step(action)
            busy[name].append(time.thread_time() - worked)
            times[name].append(time.perf_counter() - began)
    # Means, because only some steps sample scenes.
    step = {name: float(np.mean(each)) for name, each in times.items()}
    engine = float(np.mean(physics.of_each(repeats)))
    parts = {
        "engine": engine,
        "python": float(np.mean(busy["threads=1"])) - engine,
        "serial": float(np.mean(busy["workers=2"])),
        "message": message_time(envs["workers=2"]),
        "infos of SB3": infos_time(envs["ViaVecEnv, workers=2"], actions[0]),
    }
    for env in envs.values():
        env.close()
    return {
        "num_envs": num_envs,
        "repeats": repeats,
        "free_cores": float(np.median(free)),
        "decisions_per_second": {name: num_envs / each for name, each in step.items()},
        "parts_s": parts,
        "ray_efficiency": step["ViaVecEnv, workers=2"] / step["RayVecEnv, workers=2"],
        "predicted": predicted(parts, num_envs),
    }


def free_cores() -> float:
    """Return how much two busy processes get done at once, relative to one: 2 if two cores are free."""
    command = [sys.executable, "-S", "-c", SPIN]
    done = []
    for number in (1, 2):
        running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(number)]
        done.append(sum(int(each.communicate()[0]) for each in running))
    return done[1] / done[0]


class Stopwatch:
    """Processor times of the calls of a function, [s]."""

    def __init__(self) -> None:
        self.spans: list[float] = []

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with a clock."""

        def clocked(*args: Any, **kwargs: Any) -> Any:
            began = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.spans.append(time.thread_time() - began)

        return clocked

    def of_each(self, steps: int) -> list[float]:
        """Return the sums in each of the last steps, which have equally many calls."""
        return np.array(self.spans).reshape(steps, -1).sum(axis=1).tolist()


def timed(owner: Any, name: str) -> Stopwatch:
    """Clock a method of an object."""
    watch = Stopwatch()
    setattr(owner, name, watch.wrap(getattr(owner, name)))
    return watch


def message_time(env: Any) -> float:
    """Return the time of a question to one worker and its answer, [s]."""
    times = []
    for _ in range(200):
        began = time.perf_counter()
        env.unwrapped.get_attr("num_envs")
        times.append(time.perf_counter() - began)
    return float(np.min(times)) / env.unwrapped.n_workers


def infos_time(env: ViaVecEnv, actions: Any) -> float:
    """Return the time in which a step becomes one of Stable-Baselines3, [s]."""
    inner, times = env.venv, []
    step = inner.step(actions)
    env.venv = type("Replay", (), {"step": staticmethod(lambda _: step)})()
    for _ in range(20):
        began = time.thread_time()
        env.step(actions)
        times.append(time.thread_time() - began)
    env.venv = inner
    return float(np.median(times))


def predicted(parts: dict[str, float], num_envs: int) -> dict[str, dict[str, float]]:
    """Return predicted decisions per second on each number of cores."""
    engine, python = parts["engine"], parts["python"]
    result: dict[str, dict[str, float]] = {}
    for cores in CORES:
        shared = (engine + python) / cores + parts["serial"] + parts["message"] * cores
        times = {
            "threads": python + engine / cores,
            "threads, overlapped": max(python, engine / cores),
            "workers": shared,
            "ViaVecEnv, workers": shared + parts["infos of SB3"],
        }
        result[str(cores)] = {name: num_envs / each for name, each in times.items()}
    return result


def main() -> None:
    """Measure, print, and write a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results = {env_id: measured(env_id, options.num_envs, options.repeats) for env_id in ENVS}
    text = json.dumps({"cores": os.cpu_count(), "environments": results}, indent=1) + "\n"
    print(text)
    if options.json:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
