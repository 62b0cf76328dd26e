"""Measure GeometrySearch: time of a decision and success, by task and number of checks.

    OMP_NUM_THREADS=1 python benchmarks/geometry_search.py --scenes validation --number 200

Columns, times in [ms] and in one thread:

    single     first decision of one scene, all checks in one call
    batch      the same for each scene of a batch of 250
    refined    first decision of one scene by the method of the tables, with half of its checks in refinements
    all        clearance, reach and reward of all candidates of a scene, in the batch
    ratio      `all` relative to its lower bound: one multiplication for each pair of an instant and an obstacle
    solved     success of the method on the scenes, [%]
    jerk       median jerk ratio of its successes
    decisions  mean number in an episode
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.registration import REPLANNING_TASKS, TASKS
from viapoint.training.planning.baselines import factory
from viapoint.training.rollouts.rollout import new_simulation
from viapoint.training.scene_sets.scene_set import load
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.planning.plan_checks import NODES, check_plans

REPEATS = 9
BATCH = 250
LARGEST = 1 << 18
"""Greatest number of candidates in a batch."""


def milliseconds(function: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the median time of a call, [ms]."""
    function()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))


def floor(checks: int, obstacles: int) -> float:
    """Return the time of one multiplication for each pair of an instant and an obstacle, [ms]."""
    numbers = np.ones(checks * NODES * max(obstacles, 1), np.float32)
    return milliseconds(lambda: np.multiply(numbers, numbers, out=numbers))


def times(task: Any, method: Any, observation: dict[str, NDArray[np.float32]]) -> str:
    """Return the columns of times."""
    checks, number = method.total_checks, min(BATCH, LARGEST // method.total_checks)
    search = GeometrySearch(task, checks)
    batch = {name: np.resize(values, (number, values.shape[1])) for name, values in observation.items()}
    alone = {name: values[len(values) // 2][None] for name, values in observation.items()}
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (1, checks, task.action.size)).astype(np.float32)
    every = np.broadcast_to(actions, (number, *actions.shape[1:]))
    columns = (
        milliseconds(functools.partial(search.decide, alone)),
        milliseconds(functools.partial(search.decide, batch), 3) / number,
        milliseconds(functools.partial(method.decide, alone)),
        whole := milliseconds(functools.partial(check_plans, batch, every, task), 3) / number,
        whole / floor(checks, task.scenes.n_obstacles[1]),
    )
    return " ".join(f"{column:8.3f}" for column in columns)


def report(env_id: str, scenes: str, number: int, methods: list[str]) -> None:
    """Print one row for each method in one task."""
    every = load(scenes, env_id).scenes
    some = every.take(np.linspace(0, len(every.start) - 1, min(number, len(every.start))).astype(int))
    simulation = new_simulation(env_id, min(256, len(some.start)), threads=1)
    observation = simulation.observe(some)
    for name in methods:
        method: Any = factory(name, simulation.env_id)(simulation)
        result = simulation.play(method, some, method.decide(observation))
        jerk = np.median(result.info["jerk_ratio"][result.success]) if result.success.any() else np.nan
        decisions = result.info["decisions"].mean() if "decisions" in result.info else 1.0
        print(
            f"{env_id.removeprefix('viapoint/'):25} {name:10} {times(simulation.task, method, observation)} "
            f"{100.0 * result.success.mean():8.1f} {jerk:8.2f} {decisions:9.2f}",
            flush=True,
        )
    simulation.close()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", default="validation")
    parser.add_argument("--number", type=int, default=200, help="greatest number of scenes of each task")
    parser.add_argument("--tasks", nargs="+", default=[*TASKS, *REPLANNING_TASKS])
    parser.add_argument("--methods", nargs="+", default=["search16", "search64", "search512", "search4096"])
    arguments = parser.parse_args()
    heads = ("single", "batch", "refined", "all", "ratio", "solved", "jerk")
    print(f"{'task':25} {'method':10} {' '.join(f'{head:>8}' for head in heads)} {'decisions':>9}")
    for env_id in arguments.tasks:
        report(env_id, arguments.scenes, arguments.number, arguments.methods)


if __name__ == "__main__":
    main()
