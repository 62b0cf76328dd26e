"""Clearance, reach and reward of planned movements, computed without a simulation."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.arrays import squared_length
from viapoint.envs.common.types import Index, Numbers, Single
from viapoint.envs.geometry.distance import MAX_CLEARANCE, point_distance_squared, segment_distance_squared
from viapoint.envs.mdp.observation import ObservationLayout, ObstacleRows
from viapoint.envs.mdp.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT, GOAL_ERROR_UNIT
from viapoint.envs.mdp.task import Task
from viapoint.envs.sim.executor import SETTLING
from viapoint.training.search.planned_movements import (
    Observation,
    PlannedMovements,
    is_replanning,
    part,
    planned,
)

CLEARANCE_MARGIN = 0.001
"""Least planned clearance of a movement that the search prefers, [m]; 1 to 8 mm make no difference."""
REACH_MARGIN = 0.001
"""Least reach margin of a movement that the search prefers, [m]."""
NODES = 16
"""Instants at which every movement is looked at."""
SHARES = np.linspace(0.0, 1.0, NODES)
"""Shares of the duration at these instants."""
DEEP = -0.055
"""Clearance below which no instant is looked at closely, [m]: the reward ends at CLEARANCE_RANGE."""
CLOSE = 0.1
"""Clearance above which no instant is looked at closely, [m]."""
FINER = 12
"""Close looks in each interval between two instants."""
REACHED = 0.8
"""Share of a step between instants within which the nearest approach lies; half of it on a straight line."""
STENCIL = 4
"""Instants from which places between them are interpolated."""
OUTSIDE = -1e6
"""Merit below that of every plan within the margins."""
PLANNED = 1 << 17
"""Places of the hand that are computed together before some of them are looked at."""
FIRST = 64
"""Plans of each scene that are looked at first; then twice as many, and so on."""
BLOCK = 1 << 14
"""Places of the hand that are looked at together, so that temporary arrays stay in the cache."""


class PlanChecks(NamedTuple):
    """Checks of H planned movements in each of B scenes, shape (B, H) each."""

    clearance: Single
    """Least clearance over the movement, [m], at most MAX_CLEARANCE.

    Between DEEP and CLOSE it is right to half a millimetre, if the movement stays within reach. Beyond them it is the
    least of NODES instants, and a little too large.
    """
    reach_margin: Single
    """Least distance inside the arm's reach, [m]; negative where the movement leaves it."""
    reward: Single
    """Reward if the physics follows the plan."""


def check_plans(observation: Observation, actions: Numbers, task: Task, until: float = np.inf) -> PlanChecks:
    """Compute clearance, reach margin and reward of the plans of H actions in each of B scenes.

    Obstacles with velocities go on as they move now. The reward has all terms of
    :func:`~viapoint.envs.mdp.rewards.reward_terms`. A collision's goal error is not known and counts as none, and
    movements are not slowed down for the arm's limits. Where an episode is several decisions, the reward is that of
    the rest of it if nothing changes: success counts if the time that is left suffices, and smoothness is that of
    :attr:`~viapoint.training.search.planned_movements.PlannedMovements.effort`.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
        until: Time after which clearance does not matter, [s].

    Example:
        >>> import gymnasium, numpy, viapoint.envs
        >>> env = gymnasium.make_vec("viapoint/PlanarReach-v0", num_envs=2).unwrapped
        >>> observation, _ = env.reset(seed=0)
        >>> checks = check_plans(observation, numpy.zeros((2, 1, 3)), env.task)
        >>> checks.clearance.tolist(), checks.reward.astype(float).round(3).tolist()
        ([[1.0], [1.0]], [[1.1], [1.1]])
    """
    found = PlanChecks(*(np.empty(actions.shape[:2], np.float32) for _ in PlanChecks._fields))
    obstacles = _Obstacles.seen(observation, task)
    for rows in _blocks(obstacles.number, max(1, BLOCK // (actions.shape[1] * NODES))):
        some = part(observation, rows)
        moves = planned(some, actions[rows], task, SHARES)
        clearance = _least_clearance(moves, obstacles.take(rows), task, until, (DEEP, CLOSE))
        reach = _least_reach(task.arm, moves.path)
        for mine, theirs in zip(
            found, (clearance, reach, _reward(some, moves, clearance, reach, task)), strict=True
        ):
            mine[rows] = theirs
    return found


def best_plan(
    checks: PlanChecks, clearance_margin: float = CLEARANCE_MARGIN, reach_margin: float = REACH_MARGIN
) -> Index:
    """Return the index of the best plan of each scene, shape (B,).

    It has the greatest reward of those whose clearance and reach exceed the margins; where none does, the greatest
    smaller one of clearance and reach margin.

    Args:
        checks: Of H plans in each of B scenes.
        clearance_margin: [m].
        reach_margin: [m].
    """
    return np.asarray(merit(checks, clearance_margin, reach_margin).argmax(axis=-1))


def merit(checks: PlanChecks, clearance_margin: float, reach_margin: float) -> NDArray[np.float64]:
    """Return the number by which :func:`best_plan` orders plans, shape (B, H): the reward of those within the margins.

    That of all others is far below; the smaller one of clearance and reach margin orders them.
    """
    within = (checks.clearance > clearance_margin) & (checks.reach_margin > reach_margin)
    least = np.minimum(checks.clearance, checks.reach_margin, dtype=np.float64)
    return np.where(within, checks.reward, least + OUTSIDE)


def worth_of_best(
    observation: Observation,
    actions: Numbers,
    task: Task,
    margins: tuple[float, float],
    until: float = np.inf,
    bonus: float = 0.0,
) -> NDArray[np.float64]:
    """Return what :func:`merit` of :func:`check_plans` returns for the best plan of each scene, faster.

    Jerk, duration and reach bound the reward of a plan. So clearance is looked at in the order of this bound, until no
    other plan can be better (branch and bound). A few plans are all looked at.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
        margins: Of clearance and reach, [m].
        until: Time after which clearance does not matter, [s].
        bonus: Reward that the first action gets besides.

    Returns:
        Shape (B, H). Where another plan is no worse it may be minus infinity; for all plans of a scene it is only so
        where none is within the margins.
    """
    if actions.shape[1] <= FIRST:
        few = merit(check_plans(observation, actions, task, until), *margins)
        few[:, 0] += np.where(few[:, 0] > 0.5 * OUTSIDE, bonus, 0.0)
        return few
    worth = np.full(actions.shape[:2], -np.inf)
    obstacles = _Obstacles.seen(observation, task)
    for rows in _blocks(obstacles.number, max(1, PLANNED // (actions.shape[1] * NODES))):
        some = part(observation, rows)
        moves = planned(some, actions[rows], task, SHARES)
        reach = _least_reach(task.arm, moves.path)
        bound = _reward(some, moves, np.full_like(reach, MAX_CLEARANCE), reach, task)
        bound = np.where(reach > margins[1], bound, -np.inf)
        bound[:, 0] += bonus
        worth[rows] = _branch_and_bound(moves, bound, obstacles.take(rows), task, margins[0], until)
    return worth


def _branch_and_bound(
    moves: PlannedMovements, bound: Numbers, obstacles: _Obstacles, task: Task, margin: float, until: float
) -> Numbers:
    worth = np.full(bound.shape, -np.inf)
    order = np.argsort(-bound, axis=-1, kind="stable")
    open_scenes, first, count = np.arange(len(bound)), 0, FIRST
    while open_scenes.size and first < bound.shape[1]:
        these = open_scenes[:, None], order[open_scenes, first : first + count]
        some = PlannedMovements(*(field[these] for field in moves))
        clearance = _least_clearance(
            some, obstacles.take(open_scenes), task, until, (margin, CLEARANCE_RANGE[1])
        )
        lost = np.clip(clearance, *CLEARANCE_RANGE) - CLEARANCE_RANGE[1]
        reward = bound[these] + task.weights.clearance * lost / CLEARANCE_UNIT
        worth[these] = np.where(clearance > margin, reward, -np.inf)
        first, count = first + count, 2 * count
        if first < bound.shape[1]:
            following = bound[open_scenes, order[open_scenes, first]]
            open_scenes = open_scenes[(worth[open_scenes].max(axis=-1) < following) & (following > -np.inf)]
    return worth


class _Obstacles(NamedTuple):
    """Obstacles of B scenes, those that are present first."""

    rows: Single
    """Shape (B, n, 2 D + 1), [m]; absent ones have a radius so negative that they are far from everything."""
    number: Index
    """Obstacles of each scene, shape (B,)."""
    velocity: Single | None
    """Shape (B, n, D), [m/s]; None where obstacles stand still."""

    @classmethod
    def seen(cls, observation: Observation, task: Task) -> _Obstacles:
        """Return the obstacles that observations tell."""
        d, number = task.arm.dimension, len(observation["hand"])
        if "obstacles" not in observation:
            return cls(np.zeros((number, 0, 2 * d + 1), np.float32), np.zeros(number, np.intp), None)
        flat, row_size = observation["obstacles"], 2 * d + 2
        seen: ObstacleRows = ObservationLayout.of(task.arm, flat.shape[-1] // row_size).obstacles(flat)
        present = seen.present > 0.5
        radius = np.where(present, seen.radius, -2.0 * MAX_CLEARANCE)[..., None]
        rows = np.concatenate((seen.centre, seen.half_axis, radius), axis=-1, dtype=np.float32)
        order = np.argsort(~present, axis=-1, kind="stable")[..., None]
        velocity = None
        if "obstacle_velocities" in observation:
            every = np.asarray(observation["obstacle_velocities"], np.float32).reshape(*present.shape, d)
            velocity = np.take_along_axis(every, order, axis=1) if every.any() else None
        return cls(np.take_along_axis(rows, order, axis=1), present.sum(axis=-1), velocity)

    def take(self, rows: Any) -> _Obstacles:
        """Return those of some scenes, with no more rows than these need."""
        number = self.number[rows]
        most = int(number.max(initial=0))
        velocity = None if self.velocity is None else self.velocity[rows, :most]
        return _Obstacles(self.rows[rows, :most], number, velocity)


def _blocks(number: Index, size: int) -> Iterator[Any]:
    """Yield the indices of scenes that are looked at together; they have about equally many obstacles."""
    if len(number) <= size:
        yield slice(None)
        return
    order = np.argsort(number, kind="stable")
    yield from (order[first : first + size] for first in range(0, len(order), size))


def _least_reach(arm: Arm, path: Numbers) -> Numbers:
    """Return the least reach margin over movements, shape (B, H), [m], between instants by parabolas."""
    margin = np.asarray(arm.reach_margin(path))
    before, middle, after = margin[..., :-2], margin[..., 1:-1], margin[..., 2:]
    slope, curvature = 0.5 * (after - before), before + after - 2.0 * middle
    between = REACHED * curvature > np.abs(slope)
    drop = 0.5 * slope * slope / np.where(between, curvature, 1.0)
    lowest = np.where(between, middle - drop, middle).min(axis=-1)
    return np.asarray(np.minimum(lowest, np.minimum(margin[..., 0], margin[..., -1])))


class _Bodies(NamedTuple):
    """One capsule of an arm, or the hand, during B H movements."""

    first: Numbers
    """One end of the axis, shape (B, T, H, D), [m]."""
    second: Numbers | None
    """The other end; None where the body is a sphere."""
    radius: float
    """[m]."""

    def distance_squared(self, rows: Numbers, drift: Numbers | None) -> Numbers:
        """Return the squared distance from obstacles, for axes whose instants are all in one axis."""
        if self.second is None:
            return np.asarray(point_distance_squared(self.first, rows, drift))
        return np.asarray(segment_distance_squared(self.first, self.second, rows, drift))

    def map(self, function: Any) -> _Bodies:
        """Return the body with both ends transformed."""
        return self._replace(
            first=function(self.first), second=None if self.second is None else function(self.second)
        )


def _bodies(places: Numbers, task: Task) -> list[_Bodies]:
    """Return what must clear the obstacles, with the hand at places of shape (B, T, H, D)."""
    arm, hand = task.arm, _Bodies(places, None, task.arm.hand_radius)
    if not task.whole_arm:
        return [hand]
    quick = getattr(arm, "links_at", None)
    links = _links(arm, places) if quick is None else quick(places)
    bodies = [
        _Bodies(first, second, radius) for (first, second), radius in zip(links, arm.link_radii, strict=True)
    ]
    # The last link ends in the hand, which is inside it unless it is thicker.
    return bodies if arm.hand_radius <= arm.link_radii[-1] else [*bodies, hand]


def _links(arm: Arm, places: Numbers) -> list[tuple[Numbers, Numbers]]:
    """Return both ends of each link of an arm in space, shape (B, T, H, 3) each, their components apart in memory."""
    ends = np.moveaxis(np.asarray(arm.links(arm.inverse_kinematics(places))), (-3, -2, -1), (0, 1, 2))
    single = np.moveaxis(np.ascontiguousarray(ends, np.float32), 2, -1)
    return [(first, second) for first, second in single]


def _least_clearance(
    moves: PlannedMovements, obstacles: _Obstacles, task: Task, until: float, exact: tuple[float, float]
) -> Single:
    """Return the least clearance of movements, shape (B, H), [m].

    Args:
        moves: H in each of B scenes.
        obstacles: Of the scenes.
        task: The environment's.
        until: Time after which clearance does not matter, [s].
        exact: Clearance between which the result is looked at closely, [m].
    """
    places = np.asarray(moves.path, np.float32).swapaxes(1, 2)
    number, times, tried, _ = places.shape
    least = np.full((number, tried), MAX_CLEARANCE, np.float32)
    if not obstacles.rows.shape[1]:
        return least
    drift, elapsed = None, moves.duration[:, None].astype(np.float32) * SHARES[:, None].astype(np.float32)
    if obstacles.velocity is not None:
        drift = obstacles.velocity[:, :, None] * elapsed.reshape(number, 1, -1, 1)
    profiles = []
    for body in _bodies(places, task):
        flat = body.map(lambda ends: ends.reshape(number, times * tried, -1))
        squared = flat.distance_squared(obstacles.rows, drift).reshape(number, -1, times, tried)
        if until < np.inf:
            np.copyto(squared, np.float32(np.inf), where=(elapsed > until)[:, None])
        profile = _Profile(body, (obstacles.rows[..., -1] + np.float32(body.radius))[..., None], squared)
        profiles.append(profile)
        np.minimum(least, (np.sqrt(profile.lowest) - profile.radii).min(axis=1), out=least)
    limit = np.where(
        least > exact[0], np.minimum(least, np.float32(exact[1])), np.float32(-2.0 * MAX_CLEARANCE)
    )
    for profile in profiles:
        near = profile.near(limit)
        if len(near[0]):
            closely = _close_look(profile.body, near, obstacles, moves.duration)
            np.minimum.at(least, (near[0], near[3]), closely)
    return least


class _Profile:
    """Squared distances of one body from n obstacles at T instants of H movements in each of B scenes."""

    def __init__(self, body: _Bodies, radii: Numbers, squared: Numbers) -> None:
        self.body = body
        self.radii = radii
        """Sums of the radii of body and obstacles, shape (B, n, 1), [m]."""
        self.squared = squared
        """Distances of axes, shape (B, n, T, H), [m^2]."""
        self.lowest = squared.min(axis=2)
        """Least of the instants, shape (B, n, H), [m^2]."""

    def near(self, limit: Numbers) -> tuple[Index, Index, Index, Index]:
        """Return the scenes, obstacles, instants and movements of nearest approaches, shape (M,) each.

        These are local minima in time, from which a movement of REACHED of a step to the next instant may lead below
        the limit.

        Args:
            limit: Clearance of interest, shape (B, H), [m].
        """
        reach = np.maximum(limit[:, None] + self.radii, 0.0)
        bound, steps = np.where(reach > 0.0, reach * reach, -np.inf), self._steps_squared()
        scene, obstacle, movement = np.nonzero(self.lowest <= bound + steps.max(axis=1)[:, None])
        some = self.squared[scene, obstacle, :, movement]
        near = some <= bound[scene, obstacle, movement, None] + steps[scene, :, movement]
        near[:, 1:] &= some[:, 1:] <= some[:, :-1]
        near[:, :-1] &= some[:, :-1] <= some[:, 1:]
        each, instant = np.nonzero(near)
        return scene[each], obstacle[each], instant, movement[each]

    def _steps_squared(self) -> Numbers:
        """Return the square of REACHED of the longer step to a neighbouring instant, shape (B, T, H), [m^2]."""
        ends = [each for each in (self.body.first, self.body.second) if each is not None]
        squares = [squared_length(each[:, 1:] - each[:, :-1]) for each in ends]
        square: Numbers = np.float32(REACHED**2) * functools.reduce(np.maximum, squares)
        longer = np.empty((len(square), square.shape[1] + 1, square.shape[2]), square.dtype)
        longer[:, :-1], longer[:, -1] = square, square[:, -1]
        np.maximum(longer[:, 1:-1], square[:, :-1], out=longer[:, 1:-1])
        return longer


def _close_look(
    body: _Bodies,
    near: tuple[Index, ...],
    obstacles: _Obstacles,
    duration: Numbers,
) -> Single:
    """Return the least clearance between the instants around some, shape (M,), [m].

    Args:
        body: That is near.
        near: Scenes, obstacles, instants and movements, shape (M,) each.
        obstacles: Of the scenes.
        duration: Of the movements, shape (B, H), [s].
    """
    scene, which, instant, movement = near
    first, weights, times = _interpolation(NODES)
    nodes = first[instant, None] + np.arange(STENCIL)
    ends = body.map(lambda part: weights[instant] @ part[scene[:, None], nodes, movement[:, None]])
    row = obstacles.rows[scene, which, None]
    drift = None
    if obstacles.velocity is not None:
        elapsed = duration[scene, movement, None] * times[instant]
        drift = (obstacles.velocity[scene, which, None] * elapsed[..., None].astype(np.float32))[:, None]
    lowest = _lowest(ends.distance_squared(row, drift)[:, 0])
    return np.asarray(np.sqrt(lowest) - (row[:, 0, -1] + np.float32(body.radius)))


def _lowest(values: Numbers) -> Numbers:
    """Return the least value of each row, or of the parabola through the three values around it, shape (M,)."""
    each = np.arange(len(values))
    at = values[:, 1:-1].argmin(axis=-1)
    before, middle, after = (values[each, at + i] for i in range(3))
    slope, curvature = 0.5 * (after - before), after - 2.0 * middle + before
    between = curvature > np.abs(slope)
    drop = 0.5 * slope * slope / np.where(between, curvature, 1.0)
    lowest: Numbers = np.where(between, middle - drop, np.minimum(np.minimum(before, after), middle))
    return np.maximum(lowest, 0.0)


@functools.cache
def _interpolation(number: int) -> tuple[Index, Single, NDArray[np.float64]]:
    """Return how places between instants are interpolated, by Lagrange's formula.

    Returns:
        The first of STENCIL instants around each, shape (T,), the weights of their places at the close looks around it,
        shape (T, L, STENCIL), and the shares of the duration at these looks, shape (T, L).
    """
    instant = np.arange(number)
    first = np.clip(instant - STENCIL // 2 + 1, 0, number - STENCIL)
    looks = np.arange(-FINER, FINER + 1) / FINER
    places = np.clip(instant[:, None] + looks, 0, number - 1)
    nodes = (first[:, None] + np.arange(STENCIL))[:, None]
    others = np.array([[j for j in range(STENCIL) if j != i] for i in range(STENCIL)])
    apart = nodes[..., None] - nodes[..., others]
    weights = ((places[..., None, None] - nodes[..., others]) / apart).prod(axis=-1)
    return first, weights.astype(np.float32), places / (number - 1)


def _reward(
    observation: Observation, moves: PlannedMovements, clearance: Numbers, reach: Numbers, task: Task
) -> Numbers:
    """Return the reward of movements that go as planned, shape (B, H)."""
    weights, relative = task.weights, moves.duration / task.action.centre_duration
    reachable, touches = reach >= 0.0, clearance < 0.0
    succeeds = (reachable & ~touches).astype(np.float32)
    if is_replanning(observation):
        spare = observation["time_left"] - moves.duration
        succeeds *= np.clip(spare / SETTLING - 1.0, 0.0, 1.0)
    line = observation["goal"] - observation["hand"]
    away = np.minimum(np.sqrt((line * line).sum(axis=-1, keepdims=True)) / GOAL_ERROR_UNIT, 1.0)
    return np.asarray(
        weights.success * succeeds
        - weights.collision * (reachable & touches)
        + weights.clearance * np.clip(clearance, *CLEARANCE_RANGE) / CLEARANCE_UNIT
        - weights.goal_error * np.where(reachable, 0.0, away)
        - weights.smoothness * moves.effort
        - weights.duration * (relative - 1.0)
    )
