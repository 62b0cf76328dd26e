"""Planning problems: start, goal and obstacles of B scenes, and the plans that actions stand for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.chain import Spheres
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.obstacles import Obstacles, bounding_boxes, no_obstacles, obstacles_from_rows
from viapoint.envs.outcome import SETTLING, straight_jerk_cost
from viapoint.envs.plans import SHORTEST_DURATION
from viapoint.envs.replanning import NEARBY, revised_waypoints
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.planning.movements import (
    FINE_INSTANTS,
    INSTANTS,
    MovementTable,
    Setting,
    movement_table,
    shortest_durations,
    table_costs,
    table_with,
)

Numbers = NDArray[np.floating[Any]]

NEAR = 0.05
"""Vertical distance from obstacles beyond which spheres of an arm in the plane never matter, [m]."""

ELBOW_ROOM = 0.04
"""Angle that a straight elbow turns when the hand is 0.3 mm from its place, the usual error of tracking, [rad]."""
PROLONGED = 1.5
"""Greatest factor by which a plan in motion is prolonged to keep the velocity limits of the joints."""


class Problem(NamedTuple):
    """B planning problems in coordinates of the task's space."""

    start: Float
    """Present reference, shape (B, D)."""
    velocity: Float
    """Its velocity, shape (B, D)."""
    acceleration: Float
    """Its acceleration, shape (B, D)."""
    goal: Float
    """Goal, shape (B, D)."""
    obstacles: Obstacles
    """Obstacles now, with their velocities."""
    vias: Float | None = None
    """Via-points of the plan of a zero action, shape (B, K, D); None where no plan is under way."""
    remaining: Float | None = None
    """Remaining time of this plan, shape (B,), [s]."""
    time_left: Float | None = None
    """Time until the end of the episode, shape (B,), [s]."""

    @classmethod
    def of_observation(cls, observation: Mapping[str, Any], task: Task) -> Problem:
        """Return the problems of B observations, parts of shape (B, .) each."""
        parts = {name: np.asarray(part, dtype=np.float64) for name, part in observation.items()}
        number = len(parts["joints"])
        in_joints = task.space_name == "joints"
        goal = parts["goal_joints"] if in_joints else parts["goal"][:, :2]
        if "obstacles" in parts:
            rows = task.observation.rows(parts["obstacles"])
            obstacles = obstacles_from_rows(rows, task.shapes)
        else:
            obstacles = no_obstacles(number)
        if not task.replanning:
            start = parts["joints"] if in_joints else parts["hand"][:, :2]
            rest = np.zeros_like(start)
            return cls(start, rest, rest, goal, obstacles)
        return cls(
            start=parts["command"],
            velocity=parts["velocity"],
            acceleration=parts["acceleration"],
            goal=goal,
            obstacles=obstacles,
            vias=parts.get("via", np.zeros((number, 0))).reshape(number, task.n_via, task.space.dimension),
            remaining=parts["remaining"][:, 0],
            time_left=parts["time_left"][:, 0],
        )

    @classmethod
    def of_scenes(cls, scenes: Scenes, task: Task) -> Problem:
        """Return the problems of scenes at their beginning."""
        start, goal = task.space.coordinates(scenes.start), task.space.coordinates(scenes.goal)
        rest = np.zeros_like(start)
        return cls(start, rest, rest, goal, scenes.obstacles)

    def take(self, rows: Any) -> Problem:
        """Return some of the problems, by indices, mask or slice."""
        parts: list[Any] = [None if part is None else _some(part, rows) for part in self]
        return Problem(*parts)


class Moves(NamedTuple):
    """Plans of H actions in each of B problems, as products of a table."""

    table: MovementTable
    """Table of movements."""
    offsets: Float
    """Offsets from the start, see :mod:`viapoint.training.planning.movements`, shape (B, H, K + 3, D)."""
    times: Int
    """Indices of the passage times, shape (B, H)."""
    duration: Float
    """Durations, shape (B, H), [s]."""
    rough: Float
    """Logarithm of 1 + jerk cost relative to that of the zero action, shape (B, H)."""
    relative: Float
    """Durations relative to that of the zero action, shape (B, H)."""
    fast: Bool
    """True for plans beyond the velocity limits of the joints, shape (B, H); the environment would prolong them."""


def moves_of(task: Task, problem: Problem, actions: Numbers, *, exact: bool = False) -> Moves:
    """Return the plans of actions of shape (B, H, m).

    Their passage times are the best of a table. With `exact`, plans from rest have those of the environment, and more
    instants.
    """
    layout, table = task.action, movement_table(task.n_via)
    vectors = np.asarray(actions, dtype=np.float64)
    start, goal = problem.start[:, None], problem.goal[:, None]
    batch = vectors.shape[:2]
    columns, dimension = task.n_via + 3, layout.dimension
    offsets = np.zeros((*batch, columns, dimension))
    if problem.remaining is None or problem.vias is None:
        waypoints = layout.waypoints(vectors, np.broadcast_to(start, (*batch, dimension)), goal)
        duration = layout.centre * np.exp(vectors[..., task.n_via * dimension] * layout.log_half_range)
    else:
        waypoints, duration = revised_waypoints(
            layout,
            _line(problem)[:, None],
            np.broadcast_to(start, (*batch, dimension)),
            problem.vias[:, None],
            np.broadcast_to(goal, (*batch, dimension)),
            problem.remaining[:, None],
            vectors,
        )
        _set_motion(problem, duration, offsets)
    offsets[..., : task.n_via + 1, :] = waypoints[..., 1:, :] - waypoints[..., :1, :]
    flat = offsets.reshape(-1, columns, dimension)
    if (exact or layout.timing == "learned") and problem.remaining is None:
        shares = layout.shares(waypoints, vectors).reshape(-1, task.n_via + 1)
        table = table_with(shares, FINE_INSTANTS if exact else INSTANTS)  # each plan has times of its own
        times = np.arange(len(flat))
        cost = np.einsum("hij,hid,hjd->h", table.cost, flat, flat)
    else:
        times, cost = table_costs(table, flat)
    fast = np.zeros(batch, bool)
    if layout.space == "joints":
        limits = np.array(layout.rate_limit)
        shortest = shortest_durations(table, times, flat, limits).reshape(batch)
        if problem.remaining is None:
            duration = duration * shortest
        else:
            # A first plan is relative to the shortest; the environment prolongs later ones beyond the limits.
            factor = np.exp(vectors[..., task.n_via * dimension] * layout.log_half_range)
            resting = ~np.asarray((problem.velocity != 0.0) | (problem.acceleration != 0.0)).any(axis=-1)
            longer = np.clip(shortest / duration, 1.0, PROLONGED) * duration
            duration = np.where(np.asarray(resting)[:, None], layout.centre * factor * shortest, longer)
            _set_motion(problem, duration, offsets)
            times, cost = table_costs(table, flat)
            fast = shortest_durations(table, times, flat, limits).reshape(batch) > 1.02 * duration
    length, whole = _straight_movement(task, problem)
    straight = straight_jerk_cost(length, whole)[:, None]
    rough = np.log1p(cost.reshape(batch) / duration**5 / straight)
    return Moves(table, offsets, times.reshape(batch), duration, rough, duration / whole[:, None], fast)


def _straight_movement(task: Task, problem: Problem) -> tuple[Float, Float]:
    """Return length and duration of the straight movement that rewards are relative to, shape (B,) each.

    In a joint movement under way both are estimates from the total time of the present plan, as an observation has only
    what is left of the way.
    """
    layout = task.action
    length = np.maximum(norm(problem.goal - problem.start), NEARBY[layout.space])
    whole = np.maximum(layout.zero_duration(problem.start, problem.goal), SHORTEST_DURATION)
    if layout.space == "joints" and problem.remaining is not None and problem.time_left is not None:
        whole = np.maximum(whole, task.time_limit - problem.time_left + problem.remaining)
        length = np.maximum(length, whole * min(layout.rate_limit) / (1.875 * layout.centre))
    return length, whole


def _set_motion(problem: Problem, duration: Float, offsets: Float) -> None:
    """Fill in the columns of offsets for the present motion, of plans of some durations, shape (B, H)."""
    offsets[..., -2, :] = problem.velocity[:, None] * duration[..., None]
    offsets[..., -1, :] = problem.acceleration[:, None] * duration[..., None] ** 2


def worth_of(task: Task, problem: Problem, moves: Moves) -> Float:
    """Return the reward of plans that succeed, without the term for clearance, shape (B, H)."""
    weights = task.weights
    worth = weights.success - weights.smoothness * moves.rough - weights.duration * moves.relative
    worth = worth - np.where(moves.fast, weights.success, 0.0)
    if problem.time_left is not None:
        late = moves.duration + SETTLING > problem.time_left[:, None]
        worth = worth - np.where(late, weights.success + weights.goal_error, 0.0)
    return np.asarray(worth)


def setting_of(task: Task, obstacles: Obstacles, *, exact: bool = False) -> Setting:
    """Return arm and space for compiled functions; without spheres that no obstacle can come near.

    With `exact`, movements of the hand keep ELBOW_ROOM from the joint ranges, which the executed movement needs.
    """
    arm = task.arm
    ranges = arm.joint_range
    if exact and task.space.of_hand:
        ranges = ranges + ELBOW_ROOM * np.array([1.0, -1.0])
    spheres, alone = arm.spheres, False
    if task.space.of_hand:
        spheres = _within_height(spheres, arm.chain.origin[:, 2], obstacles)
        alone = len(spheres.radius) == 1 and bool(np.allclose(spheres.centre[0], arm.chain.tool_origin))
    return Setting(arm.chain, spheres, ranges, task.space.of_hand, arm.reach, alone)


def _within_height(spheres: Spheres, heights: Float, obstacles: Obstacles) -> Spheres:
    """Return the groups of spheres of an arm in the plane that are near the heights of some obstacle."""
    centre, half = bounding_boxes(obstacles)
    tall = (np.abs(obstacles.rotation[..., 2, :]) * half).sum(axis=-1)
    present = obstacles.present
    low = float((centre[..., 2] - tall)[present].min(initial=1e9)) - NEAR
    high = float((centre[..., 2] + tall)[present].max(initial=-1e9)) + NEAR
    level = np.concatenate(([0.0], np.cumsum(heights)))
    kept = []
    for group, link in enumerate(spheres.link):
        some = slice(spheres.first[group], spheres.first[group + 1])
        place = level[link] + spheres.centre[some, 2]
        if ((place + spheres.radius[some] > low) & (place - spheres.radius[some] < high)).any():
            kept.append(group)
    if not kept:  # one group at least, so that no table is empty
        kept = [len(spheres.link) - 1]
    rows = np.concatenate([np.arange(spheres.first[group], spheres.first[group + 1]) for group in kept])
    counts = [spheres.first[group + 1] - spheres.first[group] for group in kept]
    return Spheres(
        centre=spheres.centre[rows],
        radius=spheres.radius[rows],
        first=np.concatenate(([0], np.cumsum(counts))),
        link=spheres.link[kept],
        ball_centre=spheres.ball_centre[kept],
        ball_radius=spheres.ball_radius[kept],
        pairs=np.zeros((0, 2), np.int64),
    )


def _line(problem: Problem) -> Float:
    """Return the line of the offsets' frame, shape (B, D)."""
    line = problem.goal - problem.start
    return np.where((norm(line) < NEARBY["hand"])[:, None], np.eye(1, line.shape[-1]), line)


def _some(part: Any, rows: Any) -> Any:
    """Return some rows of an array or of obstacles."""
    return part.take(rows) if isinstance(part, Obstacles) else part[rows]
