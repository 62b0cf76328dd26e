"""Speed of the core: ratios of measurements that alternate within one run, and times of single operations on one core.

python benchmarks/speed.py    # prints the numbers, and writes them to docs/speed.csv
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco.batch
import numpy as np
import torch
from stable_baselines3.common.env_util import make_vec_env

import viapoint.envs as envs
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import GeometrySearch, plan_clearances, registered_task
from viapoint.training.vec_env import ViaVecEnv

FILE = Path("docs/speed.csv")
"""File of the numbers."""
IDS = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
"""Environments in the plane and in space."""
REPEATS = 7
CANDIDATES = 256
"""Random movements of a scene that are checked together."""


def main() -> None:
    """Measure, print and write everything; takes about three minutes."""
    torch.set_num_threads(1)
    rows: list[tuple[str, str]] = []

    def show(what: str, value: float) -> None:
        rows.append((what, f"{value:.3g}"))
        print(f"{what:75s} {value:8.3g}", flush=True)

    for env_id, number in zip(IDS, (512, 256), strict=True):
        inside, drawing = step_shares(env_id, number)
        show(f"{env_id}, {number}: share of a step that is MuJoCo's", inside)
        show(f"{env_id}, {number}: share of a step that draws scenes", drawing)
    for env_id in IDS:
        show(f"{env_id}, 64: ViaVecEnv, times as fast as make_vec_env", adapter(env_id))
    for env_id in IDS:
        check, search = planning(env_id)
        show(f"{env_id}: check of a random movement [us]", check * 1e6)
        show(f"{env_id}: search with 512 checks, one scene [ms]", search * 1e3)
    show("check among 100,000 points, relative to ten boxes (Panda)", cloud())
    show("memory of 1,024 Pandas [GB]", memory())
    show("import viapoint.envs, compiled [s]", timed_process("import viapoint.envs"))
    first = (
        "import gymnasium as gym, viapoint.envs; e = gym.make('viapoint/PandaObstacles-v0'); "
        "e.reset(seed=0); e.step(e.action_space.sample())"
    )
    show("make, reset and first step of a Panda, compiled [s]", timed_process(first))
    with tempfile.TemporaryDirectory() as folder:
        fresh = timed_process(first, NUMBA_CACHE_DIR=folder)
        show("the same on a fresh machine, kernels compiled [s]", fresh)
    with FILE.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("measurement", "value"), *rows])


def step_shares(env_id: str, number: int) -> tuple[float, float]:
    """Return the shares of the time of batched steps, with resets, within MuJoCo and within the sampler of scenes."""
    venv: Any = gym.make_vec(env_id, num_envs=number)
    rng = np.random.default_rng(0)
    venv.reset(seed=0)
    spent = {"mujoco": 0.0, "draw": 0.0}
    undo = [
        watch(mujoco.batch.Batch, "rollout", spent, "mujoco"),
        watch(SceneSampler, "__call__", spent, "draw"),
    ]
    venv.step(rng.uniform(-0.3, 0.3, venv.action_space.shape))
    spent.update(mujoco=0.0, draw=0.0)
    begin = time.perf_counter()
    for _ in range(REPEATS):
        venv.step(rng.uniform(-0.3, 0.3, venv.action_space.shape))
    whole = time.perf_counter() - begin
    for restore in undo:
        restore()
    threads = len(venv.unwrapped._episodes)
    venv.close()
    return spent["mujoco"] / threads / whole, spent["draw"] / threads / whole


def watch(kind: Any, name: str, spent: dict[str, float], key: str) -> Callable[[], None]:
    """Add up the time within a method; return a function that ends it."""
    plain = getattr(kind, name)

    def timed(*args: Any, **kwargs: Any) -> Any:
        begin = time.perf_counter()
        try:
            return plain(*args, **kwargs)
        finally:
            spent[key] += time.perf_counter() - begin

    setattr(kind, name, timed)
    return lambda: setattr(kind, name, plain)


def adapter(env_id: str) -> float:
    """Return how many times as fast as Stable-Baselines3's own vector environment ours is, on all cores."""
    ours: Any = ViaVecEnv(env_id, 64, seed=0)
    theirs: Any = make_vec_env(env_id, 64, seed=0)
    rng = np.random.default_rng(0)
    times = {0: 1e9, 1: 1e9}
    for each in (ours, theirs):
        each.reset()
    for _ in range(REPEATS):
        actions = rng.uniform(-0.3, 0.3, (64, *ours.action_space.shape)).astype(np.float32)
        for key, each in enumerate((ours, theirs)):
            times[key] = min(times[key], seconds(lambda: each.step(actions)))  # noqa: B023
    for each in (ours, theirs):
        each.close()
    return times[1] / times[0]


def planning(env_id: str) -> tuple[float, float]:
    """Return the times of a check of a random movement and of a search with 512 checks, [s]."""
    task = registered_task(env_id)
    scenes = task.sampler()([np.random.default_rng(seed) for seed in range(64)])
    problem = Problem.of_scenes(scenes, task)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, CANDIDATES, task.action.size))
    search = GeometrySearch(task, 256, refinements=4, per_round=64)
    single = problem.take([0])
    search.solve(single)
    check = best(lambda: plan_clearances(task, problem, actions, 0.05, 0.0)) / actions[..., 0].size
    each = [seconds(lambda: search.solve(problem.take([row]))) for row in range(64)]  # noqa: B023
    return check, float(np.median(each))


def cloud() -> float:
    """Return the time of a check among 100,000 points relative to that among ten boxes."""
    task = registered_task("viapoint/PandaObstacles-v0")
    rng = np.random.default_rng(0)
    boxes = [envs.Box((0.05, 0.05, 0.05), position=tuple(rng.uniform(0.3, 0.7, 3))) for _ in range(10)]
    faces = rng.integers(0, 3, 100_000)
    points = rng.uniform(-0.05, 0.05, (100_000, 3))
    points[np.arange(len(points)), faces] = np.where(rng.random(len(points)) < 0.5, -0.05, 0.05)
    centres = np.array([box.position for box in boxes])
    points += centres[rng.integers(0, 10, len(points))]
    scenes = task.sampler()([np.random.default_rng(seed) for seed in range(16)])
    actions = rng.uniform(-1.0, 1.0, (16, CANDIDATES, task.action.size))
    times = []
    for some in (boxes, [envs.PointCloud(points, radius=0.002)]):
        problem = Problem.of_scenes(scenes, task)._replace(obstacles=pack([some] * 16))
        times.append(best(lambda: plan_clearances(task, problem, actions, 0.05, 0.0)))  # noqa: B023
    return times[1] / times[0]


def memory() -> float:
    """Return the memory of a process with a batch of 1,024 Pandas after a step, [GB]."""
    code = (
        "import gymnasium as gym, resource, viapoint.envs; v = gym.make_vec('viapoint/PandaObstacles-v0', "
        "num_envs=1024); v.reset(seed=0); v.step(v.action_space.sample()); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(out.stdout) * 1024 / 1e9


def timed_process(code: str, **environment: str) -> float:
    """Return the time of a process that runs some code, the second time, or the only time with another environment."""
    command = [sys.executable, "-c", code]
    run = lambda: subprocess.run(command, check=True, env={**os.environ, **environment})  # noqa: E731
    if not environment:
        run()
    return seconds(run)


def seconds(job: Callable[[], Any]) -> float:
    """Return the time that a job takes, [s]."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def best(job: Callable[[], Any]) -> float:
    """Return the shortest time of a job, [s]; it runs once before."""
    job()
    return min(seconds(job) for _ in range(REPEATS))


if __name__ == "__main__":
    main()
