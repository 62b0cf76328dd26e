"""Least clearance of planned movements, computed without a simulation.

Every movement is sampled at NODES instants. Between instants, clearance is refined where it matters: the squared
distance d^2(t) of an arm body from an obstacle has a local minimum, and it may be below the clearance of interest.

    (1)  clearance(t) = d(t) - r_obstacle - r_body
    (2)  x(t) = sum_i L_i(t) x_i, the Lagrange interpolation of the body through STENCIL instants
    (3)  min f = f_0 - s^2 / (2 c), s = (f_1 - f_-1) / 2, c = f_1 - 2 f_0 + f_-1, the vertex of the parabola through
         three equidistant values, if it lies between them: |s| < c
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import in_space, squared_length
from viapoint.envs.common.types import Float, Index, Numbers, Single
from viapoint.envs.geometry.distance import MAX_CLEARANCE, point_distance_squared, segment_distance_squared
from viapoint.envs.geometry.rows import has_shapes, pair_distance

if TYPE_CHECKING:
    from viapoint.envs.arms.base import Arm
    from viapoint.envs.mdp.task import Task
    from viapoint.training.search.planned_movements import Observation, PlannedMovements

NODES = 16
"""Instants at which every movement is sampled."""
FRACTIONS = np.linspace(0.0, 1.0, NODES)
"""Fractions of the duration at these instants."""
SUBSTEPS = 12
"""Refined samples in each interval between two instants."""
STEP_REACH = 0.8
"""Share of a step between instants within which the nearest approach lies; 0.5 on a straight line."""
STENCIL = 4
"""Instants from which positions between them are interpolated."""


class Obstacles(NamedTuple):
    """Obstacles of B scenes, present ones first."""

    rows: Single
    """Shape (B, n, 2 D + 1), [m]; absent ones have a radius so negative that they are far from everything."""
    number: Index
    """Obstacles of each scene, shape (B,)."""
    velocity: Single | None
    """Shape (B, n, D), [m/s]; None where obstacles stand still."""
    shapes: Float | None = None
    """Rows with shapes, whose capsules are bounds, shape (B, n, .), [m]; None if all obstacles are capsules."""

    @classmethod
    def from_observation(cls, observation: Observation, task: Task) -> Obstacles:
        """Return the obstacles of observations."""
        d, number = task.arm.dimension, len(observation["hand"])
        if "obstacles" not in observation:
            return cls(np.zeros((number, 0, 2 * d + 1), np.float32), np.zeros(number, np.intp), None)
        whole: Any = task.observation.scene_rows(observation["obstacles"])
        present = whole[..., -1] > 0.0
        radius = np.where(present, whole[..., -1], -2.0 * MAX_CLEARANCE)[..., None]
        rows = np.concatenate((whole[..., : 2 * d], radius), axis=-1, dtype=np.float32)
        order = np.argsort(~present, axis=-1, kind="stable")[..., None]
        shapes = np.take_along_axis(whole, order, axis=1) if has_shapes(whole) else None
        velocity = None
        if "obstacle_velocities" in observation:
            every = np.asarray(observation["obstacle_velocities"], np.float32).reshape(*present.shape, d)
            velocity = np.take_along_axis(every, order, axis=1) if every.any() else None
        return cls(np.take_along_axis(rows, order, axis=1), present.sum(axis=-1), velocity, shapes)

    def take(self, rows: Any) -> Obstacles:
        """Return the obstacles of some scenes, with no more rows than these need."""
        number = self.number[rows]
        most = int(number.max(initial=0))
        velocity = None if self.velocity is None else self.velocity[rows, :most]
        shapes = None if self.shapes is None else self.shapes[rows, :most]
        return Obstacles(self.rows[rows, :most], number, velocity, shapes)


def parabola_minimum(before: Numbers, middle: Numbers, after: Numbers, within: float = 1.0) -> Numbers:
    """Return the vertex (3) where it lies within so many steps of the middle value, elsewhere the middle value."""
    slope, curvature = 0.5 * (after - before), after - 2.0 * middle + before
    inside = within * curvature > np.abs(slope)
    drop = 0.5 * slope * slope / np.where(inside, curvature, 1.0)
    return np.where(inside, middle - drop, middle)


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


def least_clearance(
    moves: PlannedMovements, obstacles: Obstacles, task: Task, until: float, exact: tuple[float, float]
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
    least: Single = np.full((number, plans), MAX_CLEARANCE, np.float32)
    bodies = _bodies(hand, task)
    if task.collision_model.may_touch_itself:
        parts = [(each.first, each.second) for each in bodies if each.second is not None]
        # Components stay contiguous in memory.
        ends = np.stack([[np.moveaxis(end, -1, 0) for end in part] for part in parts])
        links = np.moveaxis(ends, (0, 1, 2), (-3, -2, -1))
        least = task.collision_model.with_self_clearance(least, links, time_axis=1)
    if not obstacles.rows.shape[1]:
        return least
    drift, elapsed = None, moves.duration[:, None].astype(np.float32) * FRACTIONS[:, None].astype(np.float32)
    if obstacles.velocity is not None:
        drift = obstacles.velocity[:, :, None] * elapsed.reshape(number, 1, -1, 1)
    profiles = []
    flat = [body.map(lambda ends: ends.reshape(number, instants * plans, -1)) for body in bodies]
    every = [each.distance_squared(obstacles.rows, drift) for each in flat]
    if until < np.inf:
        for squared in every:
            late = np.broadcast_to((elapsed > until)[:, None], (number, 1, instants, plans))
            np.copyto(squared.reshape(number, -1, instants, plans), np.float32(np.inf), where=late)
    if obstacles.shapes is not None:
        every = _sharpened(every, flat, obstacles.rows, obstacles.shapes, drift, least, exact)
    for body, squared in zip(bodies, every, strict=True):
        radii = (obstacles.rows[..., -1] + np.float32(body.radius))[..., None]
        squared = squared.reshape(number, -1, instants, plans)
        profile = _DistanceProfile(body, radii, squared, convex=obstacles.shapes is not None)
        profiles.append(profile)
        np.minimum(least, (np.sqrt(profile.lowest) - profile.radii).min(axis=1), out=least)  # (1)
    limit = np.where(
        least > exact[0], np.minimum(least, np.float32(exact[1])), np.float32(-2.0 * MAX_CLEARANCE)
    )
    for profile in profiles:
        minima = profile.local_minima(limit)
        if len(minima[0]):
            refined = _refined_clearance(profile.body, minima, obstacles, moves.duration, limit)
            np.minimum.at(least, (minima[0], minima[3]), refined)
    return least


def _sharpened(
    squared: list[Numbers],
    bodies: list[_Body],
    rows: Numbers,
    shapes: Float,
    drift: Numbers | None,
    least: Single | None = None,
    exact: tuple[float, float] = (-np.inf, np.inf),
) -> list[Numbers]:
    """Return squared distances from the capsules around shapes, or, where they matter, those from the shapes.

    What stands for the distance from a capsule's axis is the signed distance from the shape plus the capsule's radius,
    so that the same clearance follows.

    Args:
        squared: Squared distances of L bodies from the axes of the capsules, shape (B, n, P) each, [m^2].
        bodies: Bodies with ends of shape (B, P, D).
        rows: Capsules, shape (B, n, 2 D + 1), [m].
        shapes: Rows with shapes, shape (B, n, .), [m].
        drift: Displacements of the obstacles, shape (B, n, P, D), [m]; None if they stand still.
        least: Least clearance of H movements so far, shape (B, H), [m], which is lowered; P is a multiple of H. Without
            it, all distances are those from the shapes.
        exact: Range of clearance of interest, [m].
    """
    found = np.stack(squared, axis=1)
    first, second = (
        np.stack([in_space(each) for each in ends], axis=1)
        for ends in (
            [body.first for body in bodies],
            [body.first if body.second is None else body.second for body in bodies],
        )
    )
    radii = np.array([body.radius for body in bodies])

    def clearance(scene: Index, body: Index, obstacle: Index, place: Index) -> Float:
        ends: list[Any] = [end[scene, body, place] for end in (first, second)]
        if drift is not None:
            ends = [end - in_space(drift[scene, obstacle, place]) for end in ends]
        distance = pair_distance(shapes[scene, obstacle], *ends)
        found[scene, body, obstacle, place] = np.square(np.maximum(distance + rows[scene, obstacle, -1], 0.0))
        return np.asarray(distance - radii[body])

    if least is None:
        clearance(*np.nonzero(found >= 0.0))
        return list(np.moveaxis(found, 1, 0))
    plans, instants = least.shape[1], found.shape[3] // least.shape[1]
    bound = np.sqrt(found) - (rows[:, None, :, -1:] + radii.astype(np.float32)[:, None, None])
    each = bound.reshape(len(bound), -1, plans)
    nearest = each.argmin(axis=1)  # the least bound of each movement, whose exact value excludes most others
    scene, plan = np.nonzero(each.min(axis=1) < np.minimum(least, exact[1]))
    body, rest = np.divmod(nearest[scene, plan], instants * rows.shape[1])
    obstacle, instant = np.divmod(rest, instants)
    np.minimum.at(least, (scene, plan), clearance(scene, body, obstacle, instant * plans + plan))
    limit = np.where(least > exact[0], np.minimum(least, np.float32(exact[1])), -np.inf)
    some = bound < np.tile(limit, instants)[:, None, None]
    some[scene, body, obstacle, instant * plans + plan] = False
    scene, body, obstacle, place = np.nonzero(some)
    np.minimum.at(least, (scene, place % plans), clearance(scene, body, obstacle, place))
    return list(np.moveaxis(found, 1, 0))


class _DistanceProfile:
    """Squared distances of one body from n obstacles at T instants of H movements in each of B scenes."""

    def __init__(self, body: _Body, radii: Numbers, squared: Numbers, *, convex: bool) -> None:
        self.body = body
        self.convex = convex
        """False if all obstacles are capsules."""
        self.radii = radii
        """Sums of the radii of body and obstacles, shape (B, n, 1), [m]."""
        self.squared = squared
        """Squared distances of axes, shape (B, n, T, H), [m^2]."""
        self.lowest = squared.min(axis=2)
        """Least of the instants, shape (B, n, H), [m^2]."""

    def local_minima(self, limit: Numbers) -> tuple[Index, Index, Index, Index]:
        """Return the scenes, obstacles, instants and movements of nearest approaches, shape (M,) each.

        These are local minima in time from which STEP_REACH of a step to the next instant may lead below the limit: on
        a straight path d^2 = d_min^2 + s^2, so they have d^2 <= (limit + radii)^2 + (STEP_REACH step)^2. The distance
        from other shapes than capsules changes by at most s: d <= limit + radii + STEP_REACH step.
        """
        reach = np.maximum(limit[:, None] + self.radii, 0.0)
        bound, steps = np.where(reach > 0.0, reach * reach, -np.inf), self._steps_squared()
        scene, obstacle, movement = np.nonzero(self.lowest <= self._within(bound, steps.max(axis=1)[:, None]))
        some = self.squared[scene, obstacle, :, movement]
        minimum = some <= self._within(bound[scene, obstacle, movement, None], steps[scene, :, movement])
        minimum[:, 1:] &= some[:, 1:] <= some[:, :-1]
        minimum[:, :-1] &= some[:, :-1] <= some[:, 1:]
        each, instant = np.nonzero(minimum)
        return scene[each], obstacle[each], instant, movement[each]

    def _within(self, bound: Numbers, steps: Numbers) -> Numbers:
        """Return the greatest squared distance from which a step may lead below a squared bound, [m^2]."""
        across = 2.0 * np.sqrt(np.maximum(bound, 0.0) * steps) if self.convex else np.float32(0.0)
        return np.asarray(bound + steps + across)

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
    body: _Body, minima: tuple[Index, ...], obstacles: Obstacles, duration: Numbers, limit: Numbers
) -> Single:
    """Return the least clearance between the instants around local minima, shape (M,), [m].

    Args:
        body: Body of the distance profile.
        minima: Scenes, obstacles, instants and movements, shape (M,) each.
        obstacles: Obstacles of the scenes.
        duration: Durations of the movements, shape (B, H), [s].
        limit: Clearance of interest, shape (B, H), [m].
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
    squared = ends.distance_squared(row, drift)
    if obstacles.shapes is not None:
        clearance = np.sqrt(squared.min(axis=(1, 2))) - row[:, 0, -1] - np.float32(body.radius)
        near = np.flatnonzero(clearance < limit[scene, movement])
        shapes, some = obstacles.shapes[scene[near], which[near], None], ends.map(lambda end: end[near])
        moved = None if drift is None else drift[near]
        (squared[near],) = _sharpened([squared[near]], [some], row[near], shapes, moved)
    squared = squared[:, 0]
    each = np.arange(len(squared))
    at = squared[:, 1:-1].argmin(axis=-1)
    before, middle, after = (squared[each, at + i] for i in range(3))
    lowest = np.minimum(parabola_minimum(before, middle, after), np.minimum(before, after))  # (3)
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
