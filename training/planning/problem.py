"""Planning problems: start, goal and obstacles of B scenes, and the plans that actions stand for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import Bool, Float, Int, norm
from viapoint.envs.geometry.compiled import compiled, inlined, inner
from viapoint.envs.geometry.obstacles import Obstacles, no_obstacles, obstacles_from_rows
from viapoint.envs.outcome import SETTLING, straight_jerk_cost
from viapoint.envs.plans import NEARBY, SHORTEST_DURATION, least_remaining, turned
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.planning.beliefs import Sight, thick_points
from viapoint.training.planning.movements import (
    ELBOW_ROOM,
    FINE_INSTANTS,
    INSTANTS,
    NEAR,
    Movement,
    MovementTable,
    Setting,
    arm_setting,
    best_times,
    jerk_cost,
    movement_table,
    products,
    shortest_duration,
    table_with,
)

Numbers = NDArray[np.floating[Any]]

# Greatest factor by which a plan in motion is prolonged to keep the velocity limits of the joints
PROLONGED = 1.5


class Problem(NamedTuple):
    """B planning problems in coordinates of the task's space."""

    start: Float  # Present reference, shape (B, D)
    velocity: Float  # Its velocity, shape (B, D)
    acceleration: Float  # Its acceleration, shape (B, D)
    goal: Float  # Goal, shape (B, D)
    obstacles: Obstacles  # Obstacles now, with their velocities
    # Via-points of the plan of a zero action, shape (B, K, D); None where no plan is under way
    vias: Float | None = None
    remaining: Float | None = None  # Remaining time of this plan, shape (B,), [s]
    time_left: Float | None = None  # Time until the end of the episode, shape (B,), [s]

    @classmethod
    def of_observation(cls, observation: Mapping[str, Any], task: Task) -> Problem:
        """Return the problems of B observations, parts of shape (B, .) each.

        With a sensor, the obstacles are what is believed: the points that are seen, and some space behind them.
        """
        parts = {name: np.asarray(part, dtype=np.float64) for name, part in observation.items()}
        number = len(parts["joints"])
        in_joints = task.space_name == "joints"
        goal = parts["goal_joints"] if in_joints else parts["goal"][:, :2]
        if "obstacles" in parts:
            rows = task.observation.rows(parts["obstacles"])
            obstacles = obstacles_from_rows(rows, task.shapes)
        elif task.sensor is not None:
            obstacles = thick_points(task, Sight.of(observation, task))
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
        start = task.space.coordinates(scenes.start)
        goal = task.space.coordinates(scenes.goal)
        rest = np.zeros_like(start)
        return cls(start, rest, rest, goal, scenes.obstacles)

    def take(self, rows: Any) -> Problem:
        """Return some of the problems, by indices, mask or slice."""
        given = {name: part for name, part in self._asdict().items() if part is not None}
        obstacles = given.pop("obstacles").take(rows)
        return self._replace(obstacles=obstacles, **{name: part[rows] for name, part in given.items()})


class Moves(NamedTuple):
    """Plans of H actions in each of B problems, as products of a table."""

    table: MovementTable
    start: Float  # Present references, shape (B, D)
    offsets: Float  # Offsets of via-points, goal and present motion, shape (B, H, K + 3, D)
    times: Int  # Indices of the passage times, shape (B, H)
    duration: Float  # Durations, shape (B, H), [s]
    rough: Float  # Logarithm of 1 + jerk cost relative to that of the zero action, shape (B, H)
    relative: Float  # Durations relative to that of the zero action, shape (B, H)
    # True for plans beyond the velocity limits of the joints, shape (B, H); the environment would prolong them
    fast: Bool


@inlined
def movement_of(moves: Moves, b: int, h: int) -> Movement:
    """Return one of the plans; for kernels, as elsewhere Numba counts references to each array."""
    return Movement(moves.table, moves.times[b, h], moves.start[b], moves.offsets[b, h], moves.duration[b, h])


def moves_of(task: Task, problem: Problem, actions: Numbers, *, exact: bool = False) -> Moves:
    """Return the plans of actions of shape (B, H, m), as :func:`~viapoint.envs.plans.revise` has them.

    Their passage times are the best of a table. With `exact`, plans from rest have those of the environment, and more
    instants.
    """
    layout, table, start = task.action, movement_table(task.n_via), problem.start
    vectors = np.ascontiguousarray(actions, dtype=np.float64)
    number, plans, _ = vectors.shape
    own_times = (exact or layout.timing == "learned") and problem.remaining is None
    if own_times:  # each plan has passage times of its own
        starts = np.broadcast_to(start[:, None], (number, plans, layout.dimension))
        shares = layout.shares(layout.waypoints(vectors, starts, problem.goal[:, None]), vectors)
        table = table_with(shares.reshape(-1, task.n_via + 1), FINE_INSTANTS if exact else INSTANTS)
    size = task.n_via * layout.dimension
    way = line = problem.goal - start
    if task.space.of_hand and problem.remaining is not None:
        line = np.where((norm(line) < NEARBY["hand"])[:, None], np.eye(1, line.shape[-1]), line)
    steps = vectors[..., :size].reshape(number, plans, task.n_via, layout.dimension)
    steps = steps * layout.via_scale
    if task.space.of_hand:
        steps = turned(steps, line[:, None, None])
    if problem.vias is None:
        vias = way[:, None] * (np.arange(1, task.n_via + 1)[:, None] / (task.n_via + 1))
    else:
        vias = problem.vias - start[:, None]
    offsets = np.empty((number, plans, task.n_via + 3, layout.dimension))
    offsets[:, :, :-3] = vias[:, None] + steps
    offsets[:, :, -3] = way[:, None]
    least = least_remaining(layout)
    left = np.full(number, layout.centre) if problem.remaining is None else problem.remaining
    moving = (problem.velocity != 0.0).any(axis=-1) | (problem.acceleration != 0.0).any(axis=-1)
    if not task.space.of_hand:  # from rest, durations are relative to the shortest one
        left = np.where(moving, left, layout.centre)
    left = np.maximum(left, least)[:, None]
    duration = np.maximum(left * np.exp(layout.log_half_range * vectors[..., size]), least)
    if task.space.of_hand:
        duration = np.minimum(duration, np.maximum(left, layout.duration_range[1]))
    motion = np.ascontiguousarray(problem.velocity), np.ascontiguousarray(problem.acceleration)
    rate_limit = np.zeros(0) if task.space.of_hand else layout.rate_limit
    times, cost, fast = _expand(table, offsets, *motion, moving, duration, rate_limit, own_times)
    length, whole = _straight_movement(task, problem)
    rough = np.log1p(cost / duration**5 / straight_jerk_cost(length, whole)[:, None])
    relative = duration / whole[:, None]
    return Moves(table, np.ascontiguousarray(start), offsets, times, duration, rough, relative, fast)


@compiled
def _expand(
    table: MovementTable,
    every: Float,
    velocity: Float,
    acceleration: Float,
    moving: Bool,
    duration: Float,
    rate_limit: Float,
    own_times: bool,
) -> tuple[Int, Float, Bool]:
    """Fill in present motions and durations of plans; return passage times, jerk costs in unit time, and `fast`.

    Durations of joint movements from rest are given relative to the shortest one. Movements without velocity limits,
    shape (D,), are those of the hand. With `own_times`, each plan has a row of the table as passage times.
    """
    number, plans, columns, _ = every.shape
    times = np.empty((number, plans), np.int64)
    costs = np.empty((number, plans))
    fast = np.zeros((number, plans), np.bool_)
    gram = np.empty((columns, columns))
    for b in range(number):
        for h in range(plans):
            offsets, time = every[b, h], duration[b, h]
            row = b * plans + h if own_times else -1
            chosen, cost = _timed(table, offsets, velocity[b], acceleration[b], row, time, gram)
            if len(rate_limit):
                shortest = shortest_duration(table, chosen, offsets, rate_limit)
                if moving[b]:
                    # The environment prolongs plans in motion beyond the limits.
                    time *= min(max(shortest / time, 1.0), PROLONGED)
                    chosen, cost = _timed(table, offsets, velocity[b], acceleration[b], row, time, gram)
                    shortest = shortest_duration(table, chosen, offsets, rate_limit)
                    fast[b, h] = shortest > 1.02 * time
                else:
                    time *= shortest
            times[b, h], costs[b, h], duration[b, h] = chosen, cost, time
    return times, costs, fast


@inner
def _timed(
    table: MovementTable,
    offsets: Float,
    velocity: Float,
    acceleration: Float,
    row: int,
    duration: float,
    gram: Float,
) -> tuple[int, float]:
    """Fill in the present motion of a plan of some duration; return its passage times and jerk cost in unit time.

    The passage times are a row of the table, the best one if it is negative.
    """
    last = len(offsets)
    for d in range(offsets.shape[1]):
        offsets[last - 2, d] = velocity[d] * duration
        offsets[last - 1, d] = acceleration[d] * duration * duration
    if row >= 0:
        products(offsets, gram)
        return row, jerk_cost(table, row, gram)
    return best_times(table, offsets, gram)


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
    of_hand = task.space.of_hand
    room = ELBOW_ROOM if exact and of_hand else 0.0
    return arm_setting(task.arm, of_hand, obstacles, room=room, near=NEAR)
