"""Scenes that the buttons of the live page draw: random ones, and the next ones of shipped sets and of a benchmark."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping
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

Draw = Callable[[], tuple[LiveScene, str]]
"""Function that returns the next scene of a kind, and a sentence on where it comes from, which may be empty."""

PROBLEMS = Path(__file__).with_name("motion_bench_maker.json")
"""Problems of MotionBenchMaker, written by `benchmarks/motion_bench_maker.py`."""


def scene_kinds(
    env_id: str, env_kwargs: Mapping[str, Any], task: Any, seed: int | None = None
) -> dict[str, Draw]:
    """Return functions that draw scenes, by the names of their buttons.

    Args:
        env_id: Environment whose actions are whole movements or revisions of them.
        env_kwargs: Arguments of the environment.
        task: Its task.
        seed: Seed of the random scenes.
    """
    kinds: dict[str, Draw] = {"Random": _random(env_id, env_kwargs, seed)}
    for label, name in (("Test", "test"), ("Hard", "hard")):
        if frozen_fit(name, env_id, env_kwargs):
            kinds[label] = _next_of(name, env_id)
    if not (task.spatial or task.whole_arm or task.replanning) and task.observation.n_rows:
        kinds["Lights 1985"] = _lights()
    if task.arm == PANDA:
        kinds["Benchmark"] = _benchmark(task.arm)
    return kinds


def _random(env_id: str, env_kwargs: Mapping[str, Any], seed: int | None) -> Draw:
    env: Any = gym.make_vec(env_id, num_envs=1, threads=1, **env_kwargs)
    seeds = [seed]

    def draw() -> tuple[LiveScene, str]:
        env.reset(seed=seeds.pop() if seeds else None)
        return LiveScene.of(env.unwrapped.scenes), ""

    return draw


def _next_of(name: str, env_id: str) -> Draw:
    """Return a function that draws the scenes of a shipped set one after the other."""
    state: dict[str, Any] = {"next": 0}

    def draw() -> tuple[LiveScene, str]:
        if "scenes" not in state:
            state["scenes"] = load(name, env_id).scenes
        scenes = state["scenes"]
        row = state["next"] % len(scenes.start)
        state["next"] = row + 1
        return LiveScene.of(scenes, row), f"Scene {row} of the set {name}."

    return draw


def _lights() -> Draw:
    """Return a function that draws the obstacle paradigm of Flash & Hogan 1985, pair by pair."""
    state = {"next": 0}

    def draw() -> tuple[LiveScene, str]:
        pairs, scenes = rows_of_lights()
        row = state["next"] % len(pairs)
        state["next"] = row + 1
        first, last = pairs[row]
        return LiveScene.of(scenes, row), f"From {first} to {last} past a row of lights, Flash & Hogan 1985."

    return draw


def _benchmark(arm: Arm) -> Draw:
    """Return a function that draws problems of MotionBenchMaker, one after the other."""
    problems = itertools.cycle(benchmark_problems())

    def draw() -> tuple[LiveScene, str]:
        problem = next(problems)
        ends = np.array([problem["start"], problem["goal"]])
        joints = np.array([problem["start_joints"], problem["goal_joints"]])
        first, last = 100.0 * norm(np.asarray(arm.hand_position(joints)) - ends)
        rows = obstacle_rows(problem["obstacles"], arm.dimension, SCENE_SHAPES)
        return LiveScene(ends[0], ends[1], rows, np.zeros((len(rows), 7)), np.zeros((0, 4))), (
            f"{problem['set']} {problem['number']} of MotionBenchMaker: its obstacles. Here the hand always points "
            f"down, so postures differ, and start and goal lie {first:.0f} and {last:.0f} cm from the benchmark's."
        )

    return draw


def benchmark_problems() -> list[dict[str, Any]]:
    """Return the problems of MotionBenchMaker that the page shows.

    Each has the joint angles of its start and goal in the benchmark, [rad], positions of the hand near those, [m], and
    its obstacles.
    """
    problems: list[dict[str, Any]] = json.loads(PROBLEMS.read_text(encoding="utf-8"))["problems"]
    return problems
