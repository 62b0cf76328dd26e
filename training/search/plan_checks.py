"""Clearance, reach and reward of planned movements, computed without a simulation.

Every movement is sampled at NODES instants. Between instants, clearance is refined where it matters: the squared
distance d^2(t) of an arm body from an obstacle has a local minimum, and it may be below the clearance of interest.

    (1)  clearance(t) = d(t) - r_obstacle - r_body
    (2)  x(t) = sum_i L_i(t) x_i, the Lagrange interpolation of the body through STENCIL instants
    (3)  min f = f_0 - s^2 / (2 c), s = (f_1 - f_-1) / 2, c = f_1 - 2 f_0 + f_-1, the vertex of the parabola through
         three equidistant values, if it lies between them: |s| < c
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.arrays import squared_length
from viapoint.envs.common.types import Index, Numbers, Single
from viapoint.envs.geometry.distance import MAX_CLEARANCE, point_distance_squared, segment_distance_squared
from viapoint.envs.mdp.observation import ObservationLayout, ObstacleRows, is_replanning
from viapoint.envs.mdp.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT, weighted_terms
from viapoint.envs.sim.executor import SETTLING
from viapoint.training.search.planned_movements import (
    Observation,
    PlannedMovements,
    plan_movements,
    take_rows,
)

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

CLEARANCE_MARGIN = 0.001
"""Least planned clearance of a movement that the search prefers, [m]; 1 to 8 mm make no difference."""
REACH_MARGIN = 0.001
"""Least reach margin of a movement that the search prefers, [m]."""
NODES = 16
"""Instants at which every movement is sampled."""
FRACTIONS = np.linspace(0.0, 1.0, NODES)
"""Fractions of the duration at these instants."""
MIN_REFINED = -0.055
"""Clearance below which no instant is refined, [m]: the reward ends at CLEARANCE_RANGE."""
MAX_REFINED = 0.1
"""Clearance above which no instant is refined, [m]."""
SUBSTEPS = 12
"""Refined samples in each interval between two instants."""
STEP_REACH = 0.8
"""Share of a step between instants within which the nearest approach lies; 0.5 on a straight line."""
STENCIL = 4
"""Instants from which positions between them are interpolated."""
INFEASIBLE = -1e6
"""Merit offset of plans outside the margins, below the merit of every plan within them."""
PATH_BLOCK = 1 << 17
"""Hand positions that are computed together before the best plans are checked."""
FIRST_BATCH = 64
"""Plans of each scene that are checked first; every further batch is twice as large."""
CHECK_BLOCK = 1 << 14
"""Hand positions that are checked together, so that temporary arrays stay in the cache."""


class PlanChecks(NamedTuple):
    """Checks of H planned movements in each of B scenes, shape (B, H) each."""

    clearance: Single
    """Least clearance over the movement, [m], at most MAX_CLEARANCE.

    Between MIN_REFINED and MAX_REFINED its error is below half a millimetre, if the movement stays within reach. Beyond
    them it is the least of NODES instants, and slightly too large.
    """
    reach_margin: Single
    """Least distance inside the arm's reach, [m]; negative where the movement leaves it."""
    reward: Single
    """Reward if the physics follows the plan."""


def check_plans(observation: Observation, actions: Numbers, task: Task, until: float = np.inf) -> PlanChecks:
    """Compute clearance, reach margin and reward of the plans of H actions in each of B scenes.

    Obstacles with velocities are extrapolated with them. The reward has the terms of
    :func:`~viapoint.envs.mdp.rewards.weighted_terms`. The goal error of a collision is unknown and counts as zero, and
    movements are not slowed down for the arm's limits. When replanning, the reward is that of the rest of the episode
    if nothing changes: success counts if the remaining time suffices, and the smoothness term weighs
    :attr:`~viapoint.training.search.planned_movements.PlannedMovements.effort`.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
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
    obstacles = _Obstacles.from_observation(observation, task)
    for rows in _blocks(obstacles.number, max(1, CHECK_BLOCK // (actions.shape[1] * NODES))):
        some = take_rows(observation, rows)
        moves = plan_movements(some, actions[rows], task, FRACTIONS)
        clearance = _least_clearance(moves, obstacles.take(rows), task, until, (MIN_REFINED, MAX_REFINED))
        reach = _least_reach_margin(task.arm, moves.path)
        found.clearance[rows], found.reach_margin[rows] = clearance, reach
        found.reward[rows] = _reward(some, moves, clearance, reach, task)
    return found


def best_plan(
    checks: PlanChecks, clearance_margin: float = CLEARANCE_MARGIN, reach_margin: float = REACH_MARGIN
) -> Index:
    """Return the index of the best plan of each scene, shape (B,).

    The best plan has the greatest reward of those whose clearance and reach margin exceed the given margins. Where none
    does, it has the greatest minimum of clearance and reach margin.

    Args:
        checks: Checks of H plans in each of B scenes.
        clearance_margin: Least clearance, [m].
        reach_margin: Least reach margin, [m].
    """
    return np.asarray(merit(checks, clearance_margin, reach_margin).argmax(axis=-1))


def merit(checks: PlanChecks, clearance_margin: float, reach_margin: float) -> NDArray[np.float64]:
    """Return the merit by which :func:`best_plan` orders plans, shape (B, H): the reward of those within the margins.

    Plans outside the margins have a merit near INFEASIBLE; the minimum of clearance and reach margin orders them.
    """
    within = (checks.clearance > clearance_margin) & (checks.reach_margin > reach_margin)
    least = np.minimum(checks.clearance, checks.reach_margin, dtype=np.float64)
    return np.where(within, checks.reward, least + INFEASIBLE)


def pruned_merit(
    observation: Observation,
    actions: Numbers,
    task: Task,
    margins: tuple[float, float],
    until: float = np.inf,
    bonus: float = 0.0,
) -> NDArray[np.float64]:
    """Return :func:`merit` of the best plan of each scene by branch and bound, shape (B, H).

    Jerk, duration and reach bound the reward of a plan. So clearance is checked in the order of this bound, until no
    other plan can be better. Up to FIRST_BATCH plans are all checked.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        margins: Least clearance and least reach margin, [m].
        until: Time after which clearance does not matter, [s].
        bonus: Reward added to the first action.

    Returns:
        Merits, minus infinity for plans that are pruned or outside the margins. Up to FIRST_BATCH plans have the exact
        merit, within the margins or not.
    """
    if actions.shape[1] <= FIRST_BATCH:
        merits = merit(check_plans(observation, actions, task, until), *margins)
        merits[:, 0] += np.where(merits[:, 0] > 0.5 * INFEASIBLE, bonus, 0.0)
        return merits
    merits = np.full(actions.shape[:2], -np.inf)
    obstacles = _Obstacles.from_observation(observation, task)
    for rows in _blocks(obstacles.number, max(1, PATH_BLOCK // (actions.shape[1] * NODES))):
        some = take_rows(observation, rows)
        moves, bound = reward_bounds(some, actions[rows], task, margins[1])
        bound[:, 0] += bonus
        merits[rows] = _branch_and_bound(moves, bound, obstacles.take(rows), task, margins[0], until)
    return merits


def reward_bounds(
    observation: Observation, actions: Numbers, task: Task, reach_margin: float
) -> tuple[PlannedMovements, Numbers]:
    """Return the plans of actions and upper bounds of their rewards, the rewards without obstacles, shape (B, H).

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        reach_margin: Least reach margin, [m]; plans below it have the bound minus infinity.
    """
    moves = plan_movements(observation, actions, task, FRACTIONS)
    reach = _least_reach_margin(task.arm, moves.path)
    bound = _reward(observation, moves, np.full_like(reach, MAX_CLEARANCE), reach, task)
    return moves, np.where(reach > reach_margin, bound, -np.inf)


def _branch_and_bound(
    moves: PlannedMovements, bound: Numbers, obstacles: _Obstacles, task: Task, margin: float, until: float
) -> Numbers:
    """Return the merits of plans, shape (B, H), checked in the order of their upper bounds."""
    merits = np.full(bound.shape, -np.inf)
    order = np.argsort(-bound, axis=-1, kind="stable")
    open_scenes, first, count = np.arange(len(bound)), 0, FIRST_BATCH
    while open_scenes.size and first < bound.shape[1]:
        these = open_scenes[:, None], order[open_scenes, first : first + count]
        some = PlannedMovements(*(field[these] for field in moves))
        exact = margin, CLEARANCE_RANGE[1]  # beyond it the reward does not depend on clearance
        clearance = _least_clearance(some, obstacles.take(open_scenes), task, until, exact)
        lost = np.clip(clearance, *CLEARANCE_RANGE) - CLEARANCE_RANGE[1]
        reward = bound[these] + task.weights.clearance * lost / CLEARANCE_UNIT
        merits[these] = np.where(clearance > margin, reward, -np.inf)
        first, count = first + count, 2 * count
        if first < bound.shape[1]:
            following = bound[open_scenes, order[open_scenes, first]]
            open_scenes = open_scenes[(merits[open_scenes].max(axis=-1) < following) & (following > -np.inf)]
    return merits


class _Obstacles(NamedTuple):
    """Obstacles of B scenes, present ones first."""

    rows: Single
    """Shape (B, n, 2 D + 1), [m]; absent ones have a radius so negative that they are far from everything."""
    number: Index
    """Obstacles of each scene, shape (B,)."""
    velocity: Single | None
    """Shape (B, n, D), [m/s]; None where obstacles stand still."""

    @classmethod
    def from_observation(cls, observation: Observation, task: Task) -> _Obstacles:
        """Return the obstacles of observations."""
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
        """Return the obstacles of some scenes, with no more rows than these need."""
        number = self.number[rows]
        most = int(number.max(initial=0))
        velocity = None if self.velocity is None else self.velocity[rows, :most]
        return _Obstacles(self.rows[rows, :most], number, velocity)


def _blocks(number: Index, size: int) -> Iterator[Any]:
    """Yield the indices of scenes that are checked together; scenes of a block have similar numbers of obstacles."""
    if len(number) <= size:
        yield slice(None)
        return
    order = np.argsort(number, kind="stable")
    yield from (order[first : first + size] for first in range(0, len(order), size))


def _parabola_minimum(before: Numbers, middle: Numbers, after: Numbers, within: float = 1.0) -> Numbers:
    """Return the vertex (3) where it lies within so many steps of the middle value, elsewhere the middle value."""
    slope, curvature = 0.5 * (after - before), after - 2.0 * middle + before
    inside = within * curvature > np.abs(slope)
    drop = 0.5 * slope * slope / np.where(inside, curvature, 1.0)
    return np.where(inside, middle - drop, middle)


def _least_reach_margin(arm: Arm, path: Numbers) -> Numbers:
    """Return the least reach margin over movements, shape (B, H), [m], between instants by parabolas."""
    margin = np.asarray(arm.reach_margin(path))
    inner = _parabola_minimum(margin[..., :-2], margin[..., 1:-1], margin[..., 2:], STEP_REACH).min(axis=-1)
    return np.asarray(np.minimum(inner, np.minimum(margin[..., 0], margin[..., -1])))


class _Body(NamedTuple):
    """One capsule of an arm, or the hand, during B H movements."""

    first: Numbers
    """One end of the axis, shape (B, T, H, D), [m]."""
    second: Numbers | None
    """The other end; None where the body is a sphere."""
    radius: float
    """[m]."""

    def distance_squared(self, rows: Numbers, drift: Numbers | None) -> Numbers:
        """Return the squared distance from obstacles, for ends of shape (B, T H, D)."""
        if self.second is None:
            return np.asarray(point_distance_squared(self.first, rows, drift))
        return np.asarray(segment_distance_squared(self.first, self.second, rows, drift))

    def map(self, function: Any) -> _Body:
        """Return the body with both ends transformed."""
        second = None if self.second is None else function(self.second)
        return self._replace(first=function(self.first), second=second)


def _bodies(hand: Numbers, task: Task) -> list[_Body]:
    """Return the bodies that must clear the obstacles, with the hand at positions of shape (B, T, H, D)."""
    arm, sphere = task.arm, _Body(hand, None, task.arm.hand_radius)
    if not task.whole_arm:
        return [sphere]
    quick = getattr(arm, "links_at", None)
    links = _links(arm, hand) if quick is None else quick(hand)
    bodies = [
        _Body(first, second, radius) for (first, second), radius in zip(links, arm.link_radii, strict=True)
    ]
    # The last link ends at the hand and encloses it, unless the hand is thicker.
    return bodies if arm.hand_radius <= arm.link_radii[-1] else [*bodies, sphere]


def _links(arm: Arm, hand: Numbers) -> list[tuple[Numbers, Numbers]]:
    """Return both ends of each link of an arm in space, shape (B, T, H, 3) each, components contiguous in memory."""
    ends = np.moveaxis(np.asarray(arm.links(arm.inverse_kinematics(hand))), (-3, -2, -1), (0, 1, 2))
    single = np.moveaxis(np.ascontiguousarray(ends, np.float32), 2, -1)
    return [(first, second) for first, second in single]


def _least_clearance(
    moves: PlannedMovements, obstacles: _Obstacles, task: Task, until: float, exact: tuple[float, float]
) -> Single:
    """Return the least clearance of movements, shape (B, H), [m].

    Args:
        moves: H movements in each of B scenes.
        obstacles: Obstacles of the scenes.
        task: Task of the environment.
        until: Time after which clearance does not matter, [s].
        exact: Range of clearance in which the result is refined, [m].
    """
    hand = np.asarray(moves.path, np.float32).swapaxes(1, 2)
    number, instants, plans, _ = hand.shape
    least = np.full((number, plans), MAX_CLEARANCE, np.float32)
    if not obstacles.rows.shape[1]:
        return least
    drift, elapsed = None, moves.duration[:, None].astype(np.float32) * FRACTIONS[:, None].astype(np.float32)
    if obstacles.velocity is not None:
        drift = obstacles.velocity[:, :, None] * elapsed.reshape(number, 1, -1, 1)
    profiles = []
    for body in _bodies(hand, task):
        flat = body.map(lambda ends: ends.reshape(number, instants * plans, -1))
        squared = flat.distance_squared(obstacles.rows, drift).reshape(number, -1, instants, plans)
        if until < np.inf:
            np.copyto(squared, np.float32(np.inf), where=(elapsed > until)[:, None])
        radii = (obstacles.rows[..., -1] + np.float32(body.radius))[..., None]
        profile = _DistanceProfile(body, radii, squared)
        profiles.append(profile)
        np.minimum(least, (np.sqrt(profile.lowest) - profile.radii).min(axis=1), out=least)  # (1)
    limit = np.where(
        least > exact[0], np.minimum(least, np.float32(exact[1])), np.float32(-2.0 * MAX_CLEARANCE)
    )
    for profile in profiles:
        minima = profile.local_minima(limit)
        if len(minima[0]):
            refined = _refined_clearance(profile.body, minima, obstacles, moves.duration)
            np.minimum.at(least, (minima[0], minima[3]), refined)
    return least


class _DistanceProfile:
    """Squared distances of one body from n obstacles at T instants of H movements in each of B scenes."""

    def __init__(self, body: _Body, radii: Numbers, squared: Numbers) -> None:
        self.body = body
        self.radii = radii
        """Sums of the radii of body and obstacles, shape (B, n, 1), [m]."""
        self.squared = squared
        """Squared distances of axes, shape (B, n, T, H), [m^2]."""
        self.lowest = squared.min(axis=2)
        """Least of the instants, shape (B, n, H), [m^2]."""

    def local_minima(self, limit: Numbers) -> tuple[Index, Index, Index, Index]:
        """Return the scenes, obstacles, instants and movements of nearest approaches, shape (M,) each.

        These are local minima in time from which STEP_REACH of a step to the next instant may lead below the limit: on
        a straight path d^2 = d_min^2 + s^2, so they have d^2 <= (limit + radii)^2 + (STEP_REACH step)^2.

        Args:
            limit: Clearance of interest, shape (B, H), [m].
        """
        reach = np.maximum(limit[:, None] + self.radii, 0.0)
        bound, steps = np.where(reach > 0.0, reach * reach, -np.inf), self._steps_squared()
        scene, obstacle, movement = np.nonzero(self.lowest <= bound + steps.max(axis=1)[:, None])
        some = self.squared[scene, obstacle, :, movement]
        minimum = some <= bound[scene, obstacle, movement, None] + steps[scene, :, movement]
        minimum[:, 1:] &= some[:, 1:] <= some[:, :-1]
        minimum[:, :-1] &= some[:, :-1] <= some[:, 1:]
        each, instant = np.nonzero(minimum)
        return scene[each], obstacle[each], instant, movement[each]

    def _steps_squared(self) -> Numbers:
        """Return the square of STEP_REACH of the longer step to a neighbouring instant, shape (B, T, H), [m^2]."""
        ends = [each for each in (self.body.first, self.body.second) if each is not None]
        squares = [squared_length(each[:, 1:] - each[:, :-1]) for each in ends]
        square: Numbers = np.float32(STEP_REACH**2) * functools.reduce(np.maximum, squares)
        longer = np.empty((len(square), square.shape[1] + 1, square.shape[2]), square.dtype)
        longer[:, :-1], longer[:, -1] = square, square[:, -1]
        np.maximum(longer[:, 1:-1], square[:, :-1], out=longer[:, 1:-1])
        return longer


def _refined_clearance(
    body: _Body, minima: tuple[Index, ...], obstacles: _Obstacles, duration: Numbers
) -> Single:
    """Return the least clearance between the instants around local minima, shape (M,), [m].

    Args:
        body: Body of the distance profile.
        minima: Scenes, obstacles, instants and movements, shape (M,) each.
        obstacles: Obstacles of the scenes.
        duration: Durations of the movements, shape (B, H), [s].
    """
    scene, which, instant, movement = minima
    first, weights, times = _interpolation(NODES)
    nodes = first[instant, None] + np.arange(STENCIL)
    ends = body.map(lambda end: weights[instant] @ end[scene[:, None], nodes, movement[:, None]])  # (2)
    row = obstacles.rows[scene, which, None]
    drift = None
    if obstacles.velocity is not None:
        elapsed = duration[scene, movement, None] * times[instant]
        drift = (obstacles.velocity[scene, which, None] * elapsed[..., None].astype(np.float32))[:, None]
    squared = ends.distance_squared(row, drift)[:, 0]
    each = np.arange(len(squared))
    at = squared[:, 1:-1].argmin(axis=-1)
    before, middle, after = (squared[each, at + i] for i in range(3))
    lowest = np.minimum(_parabola_minimum(before, middle, after), np.minimum(before, after))  # (3)
    distance = np.sqrt(np.maximum(lowest, 0.0))
    return np.asarray(distance - (row[:, 0, -1] + np.float32(body.radius)))  # (1)


@functools.cache
def _interpolation(number: int) -> tuple[Index, Single, NDArray[np.float64]]:
    """Return the weights of the interpolation (2) between instants.

        L_i(t) = prod over j != i of (t - t_j) / (t_i - t_j)

    Returns:
        The first of STENCIL instants around each instant, shape (T,); the weights of their positions at the refined
        samples around it, shape (T, L, STENCIL); and the fractions of the duration at these samples, shape (T, L).
    """
    instant = np.arange(number)
    first = np.clip(instant - STENCIL // 2 + 1, 0, number - STENCIL)
    samples = np.arange(-SUBSTEPS, SUBSTEPS + 1) / SUBSTEPS
    times = np.clip(instant[:, None] + samples, 0, number - 1)
    nodes = (first[:, None] + np.arange(STENCIL))[:, None]
    others = np.array([[j for j in range(STENCIL) if j != i] for i in range(STENCIL)])
    apart = nodes[..., None] - nodes[..., others]
    weights = ((times[..., None, None] - nodes[..., others]) / apart).prod(axis=-1)
    return first, weights.astype(np.float32), times / (number - 1)


def _reward(
    observation: Observation, moves: PlannedMovements, clearance: Numbers, reach: Numbers, task: Task
) -> Numbers:
    """Return the reward of movements that go as planned, shape (B, H)."""
    reachable, touches = reach >= 0.0, clearance < 0.0
    success = (reachable & ~touches).astype(np.float32)
    if is_replanning(observation):
        # After its end a movement settles for SETTLING. Success fades in over as much spare time again.
        spare = observation["time_left"] - moves.duration
        success *= np.clip(spare / SETTLING - 1.0, 0.0, 1.0)
    line = observation["goal"] - observation["hand"]
    goal_error = np.where(reachable, 0.0, np.sqrt((line * line).sum(axis=-1, keepdims=True)))
    relative = moves.duration / task.action.centre_duration
    return weighted_terms(
        success, reachable & touches, clearance, goal_error, moves.effort, relative, task.weights
    ).total()
