"""Scenes that the buttons of the live page draw: random ones, and the next ones of shipped sets and of a benchmark."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.envs.arms import PANDA, Arm
from viapoint.envs.common.arrays import norm
from viapoint.envs.geometry.rows import obstacle_rows
from viapoint.envs.scenes.scene import rows_of_lights
from viapoint.training.live.scene_file import SCENE_SHAPES, LiveScene
from viapoint.training.scene_sets.scene_set import frozen_fit, load

Drawn = tuple[LiveScene, str]
"""Scene, and a sentence on where it comes from, which may be empty."""
Draw = Callable[[], Drawn]
"""Function that returns the next scene of a kind."""

PROBLEMS = Path(__file__).with_name("motion_bench_maker.json")
"""Problems of MotionBenchMaker, written by `benchmarks/motion_bench_maker.py`."""


def scene_kinds(
    env_id: str, env_kwargs: Mapping[str, Any], task: Any, seed: int | None = None
) -> dict[str, Draw]:
    """Return functions that draw scenes of an environment, by the names of their buttons; random ones have a seed."""
    endless: dict[str, Iterator[Drawn]] = {}
    for label, name in (("Test", "test"), ("Hard", "hard")):
        if frozen_fit(name, env_id, env_kwargs):
            endless[label] = _scenes_of(name, env_id)
    if not (task.spatial or task.whole_arm or task.replanning) and task.observation.n_rows:
        endless["Lights 1985"] = _lights()
    if task.arm == PANDA:
        endless["Benchmark"] = _benchmark(task.arm)
    each = {label: functools.partial(next, scenes) for label, scenes in endless.items()}
    return {"Random": _random(env_id, env_kwargs, seed), **each}


def _random(env_id: str, env_kwargs: Mapping[str, Any], seed: int | None) -> Draw:
    env: Any = gym.make_vec(env_id, num_envs=1, threads=1, **env_kwargs)
    seeds = [seed]

    def draw() -> Drawn:
        env.reset(seed=seeds.pop() if seeds else None)
        return LiveScene.of(env.unwrapped.scenes), ""

    return draw


def _scenes_of(name: str, env_id: str) -> Iterator[Drawn]:
    """Yield the scenes of a shipped set, again and again."""
    scenes = load(name, env_id).scenes
    for row in itertools.cycle(range(len(scenes.start))):
        yield LiveScene.of(scenes, row), f"Scene {row} of the set {name}."


def _lights() -> Iterator[Drawn]:
    """Yield the obstacle paradigm of Flash & Hogan 1985, pair by pair, again and again."""
    pairs, scenes = rows_of_lights()
    for row, (first, last) in itertools.cycle(enumerate(pairs)):
        yield LiveScene.of(scenes, row), f"From {first} to {last} past a row of lights, Flash & Hogan 1985."


def _benchmark(arm: Arm) -> Iterator[Drawn]:
    """Yield the problems of MotionBenchMaker, again and again."""
    for problem in itertools.cycle(benchmark_problems()):
        ends = np.array([problem["start"], problem["goal"]])
        joints = np.array([problem["start_joints"], problem["goal_joints"]])
        first, last = 100.0 * norm(np.asarray(arm.hand_position(joints)) - ends)
        rows = obstacle_rows(problem["obstacles"], arm.dimension, SCENE_SHAPES)
        yield (
            LiveScene(ends[0], ends[1], rows, np.zeros((len(rows), 7)), np.zeros((0, 4))),
            (
                f"{problem['set']} {problem['number']} of MotionBenchMaker: its obstacles. Here the hand always points "
                f"down, so postures differ, and start and goal lie {first:.0f} and {last:.0f} cm from the benchmark's."
            ),
        )


def benchmark_problems() -> list[dict[str, Any]]:
    """Return the problems of MotionBenchMaker that the page shows.

    Each has the joint angles of its start and goal in the benchmark, [rad], positions of the hand near those, [m], and
    its obstacles.
    """
    problems: list[dict[str, Any]] = json.loads(PROBLEMS.read_text(encoding="utf-8"))["problems"]
    return problems
