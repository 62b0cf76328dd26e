"""Scenes that the buttons of the live page draw: random ones, and the next ones of shipped sets and of a benchmark."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from viapoint.envs.arms import PANDA, PANDA_FINE
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.geometry.rows import obstacle_rows
from viapoint.envs.scenes.scene import Scenes, rest_clearance, rows_of_lights
from viapoint.training.live.scene_file import SCENE_SHAPES, LiveScene
from viapoint.training.scene_sets.scene_set import frozen_fit, load

if TYPE_CHECKING:
    from viapoint.envs.arms.base import CollisionModel

Draw = Callable[[], tuple[LiveScene, str]]
"""Function that returns the next scene of a kind, and a sentence on where it comes from, which may be empty."""

PROBLEMS = Path(__file__).with_name("motion_bench_maker.json")
"""Problems of MotionBenchMaker, written by `benchmarks/motion_bench_maker.py`."""
GRID = 0.02
"""Distance of the hand positions among which the nearest possible one is looked for, [m]."""
END_CLEARANCE = 0.01
"""Least clearance of the arm at a start or goal that was moved, [m]."""
BLOCK = 256
"""Hand positions whose clearance is computed together."""


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
    if task.arm in (PANDA, PANDA_FINE):
        kinds["Benchmark"] = _benchmark(task.collision_model)
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


def _benchmark(collision_model: CollisionModel) -> Draw:
    """Return a function that draws problems of MotionBenchMaker, one after the other."""
    state = {"next": 0}

    def draw() -> tuple[LiveScene, str]:
        record = problems_of_benchmark()[state["next"] % len(problems_of_benchmark())]
        state["next"] += 1
        scene, moved = benchmark_scene(record, collision_model)
        first, last = (f"{100 * each:.0f} cm" for each in moved.values())
        return scene, (
            f"{record['set']} {record['number']} of MotionBenchMaker: its obstacles. Here the hand always points down, "
            f"so postures differ, and start and goal lie {first} and {last} from the hand's in the benchmark."
        )

    return draw


@functools.cache
def problems_of_benchmark() -> list[dict[str, Any]]:
    """Return the problems of MotionBenchMaker that the page shows."""
    problems: list[dict[str, Any]] = json.loads(PROBLEMS.read_text(encoding="utf-8"))["problems"]
    return problems


def benchmark_scene(
    record: Mapping[str, Any], collision_model: CollisionModel
) -> tuple[LiveScene, dict[str, float]]:
    """Return a problem of the benchmark as a scene of the Panda, and how far start and goal were moved, [m].

    The benchmark gives start and goal as joint configurations. The hand's positions in them are computed, and moved to
    the nearest ones that this arm reaches, whose hand always points down, and where it touches no obstacle.

    Args:
        record: Problem with `obstacles`, and joint angles as `start` and `goal`, shape (7,), [rad].
        collision_model: Panda, and the bodies that count.

    Raises:
        ValueError: There is no such position.
    """
    rows = obstacle_rows(record["obstacles"], 3, SCENE_SHAPES)
    hands = np.asarray(collision_model.arm.hand_position(np.array([record["start"], record["goal"]])))
    start = nearest_free(hands[0], rows, collision_model)
    goal = nearest_free(hands[1], rows, collision_model, away_from=start)
    none = np.zeros((len(rows), 7)), np.zeros((0, 4))
    moved = {"start": float(norm(start - hands[0])), "goal": float(norm(goal - hands[1]))}
    return LiveScene(start, goal, rows, *none), moved


def nearest_free(
    point: Float, rows: Float, collision_model: CollisionModel, away_from: Float | None = None
) -> Float:
    """Return the nearest position to a point at which the arm rests clear of obstacles, shape (3,), [m].

    Args:
        point: Position of the hand, shape (3,), [m].
        rows: Rows of obstacles, shape (n, .), [m].
        collision_model: Arm, and the bodies that count.
        away_from: Position from which a movement to the result must be long enough, shape (3,), [m].

    Raises:
        ValueError: There is none on a grid within the arm's reach.
    """
    arm: Any = collision_model.arm
    candidates = np.concatenate((point[None], _grid(arm)))
    if away_from is not None:
        candidates = candidates[norm(candidates - away_from) > MIN_GOAL_DISTANCE]
    candidates = candidates[np.argsort(norm(candidates - point), kind="stable")]
    candidates = candidates[np.asarray(arm.reach_margin(candidates)) > 0.0]
    for first in range(0, len(candidates), BLOCK):
        some = candidates[first : first + BLOCK]
        scenes = Scenes(some, some, np.broadcast_to(rows, (len(some), *rows.shape)))
        clear = rest_clearance(scenes, some, collision_model).min(axis=-1) > END_CLEARANCE
        if clear.any():
            return np.asarray(some[clear.argmax()])
    raise ValueError("the arm can rest nowhere among these obstacles")


@functools.cache
def _grid(arm: Any) -> Float:
    """Return hand positions within reach, shape (N, 3), [m]."""
    level, up = np.arange(-1.0, 1.0, GRID), np.arange(0.0, 1.2, GRID)
    points = np.stack(np.meshgrid(level, level, up, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(points[np.asarray(arm.reach_margin(points)) > 0.0])
