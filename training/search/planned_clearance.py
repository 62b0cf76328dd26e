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


class _Bodies(NamedTuple):
    """L capsules of an arm, or its hand, during B H movements, as if they were P = L H bodies with a movement each."""

    first: Numbers
    """One end of the axis, shape (B, T, P, D), [m]."""
    second: Numbers | None
    """The other end; None where the bodies are spheres."""
    radius: Single
    """Shape (P,), [m]."""

    def distance_squared(self, rows: Numbers, drift: Numbers | None) -> Numbers:
        """Return the squared distance from obstacles, for ends of shape (B, T P, D)."""
        if self.second is None:
            return np.asarray(point_distance_squared(self.first, rows, drift))
        return np.asarray(segment_distance_squared(self.first, self.second, rows, drift))

    def map(self, function: Any) -> _Bodies:
        """Return the bodies with both ends transformed."""
        second = None if self.second is None else function(self.second)
        return self._replace(first=function(self.first), second=second)


def _bodies(hand: Numbers, task: Task) -> _Bodies:
    """Return the bodies that must clear the obstacles, with the hand at positions of shape (B, T, H, D)."""
    arm, plans = task.arm, hand.shape[2]
    if not task.whole_arm:
        return _Bodies(hand, None, np.full(plans, arm.hand_radius, np.float32))
    quick, radii = getattr(arm, "links_at", None), arm.link_radii
    if quick is None:
        links = np.asarray(arm.links(arm.inverse_kinematics(hand))).transpose(4, 5, 0, 1, 3, 2)
    else:
        links = np.array(quick(hand)).transpose(1, 5, 2, 3, 0, 4)
    # The last link ends at the hand and encloses it, unless the hand is thicker.
    if arm.hand_radius > radii[-1]:
        sphere = np.moveaxis(hand, -1, 0)[None, :, :, :, None]
        links = np.concatenate((links, np.repeat(sphere, 2, axis=0)), axis=4)
        radii = (*radii, arm.hand_radius)
    single = np.ascontiguousarray(links, np.float32)  # (2, D, B, T, L, H): components are apart in memory
    first, second = np.moveaxis(single.reshape(*single.shape[:4], -1), 1, -1)
    return _Bodies(first, second, np.repeat(np.array(radii, np.float32), plans))


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
    count = len(bodies.radius) // plans
    if not obstacles.rows.shape[1]:
        return least
    drift, elapsed = None, moves.duration[:, None].astype(np.float32) * FRACTIONS[:, None].astype(np.float32)
    if obstacles.velocity is not None:
        drift = obstacles.velocity[:, :, None] * np.tile(elapsed, count).reshape(number, 1, -1, 1)
    flat = bodies.map(lambda ends: ends.reshape(number, instants * count * plans, -1))
    squared = flat.distance_squared(obstacles.rows, drift)
    if until < np.inf:
        late = np.broadcast_to((elapsed > until)[:, None, :, None], (number, 1, instants, count, plans))
        np.copyto(squared.reshape(number, -1, instants, count, plans), np.float32(np.inf), where=late)
    if obstacles.shapes is not None:
        _sharpen(squared, flat, obstacles, drift, least, exact)
    radii = obstacles.rows[..., -1:] + bodies.radius
    squared = squared.reshape(number, -1, instants, count * plans)
    profile = _DistanceProfile(bodies, radii, squared, convex=obstacles.shapes is not None)
    nearest = (np.sqrt(profile.lowest) - radii).min(axis=1)  # (1)
    np.minimum(least, nearest.reshape(number, count, plans).min(axis=1), out=least)
    limit = np.where(
        least > exact[0], np.minimum(least, np.float32(exact[1])), np.float32(-2.0 * MAX_CLEARANCE)
    )
    minima = profile.local_minima(np.tile(limit, count))
    if len(minima[0]):
        refined = _refined_clearance(bodies, minima, obstacles, moves.duration, limit)
        np.minimum.at(least, (minima[0], minima[3] % plans), refined)
    return least


def _sharpen(
    squared: Numbers,
    bodies: _Bodies,
    obstacles: Obstacles,
    drift: Numbers | None,
    least: Single,
    exact: tuple[float, float],
) -> None:
    """Replace squared distances from the capsules around shapes, where they matter, by those from the shapes.

    What stands for the distance from a capsule's axis is the signed distance from the shape plus the capsule's radius,
    so that the same clearance follows.

    Args:
        squared: Squared distances from the axes of the capsules, shape (B, n, T P), [m^2].
        bodies: Bodies with ends of shape (B, T P, D).
        obstacles: Obstacles with shapes.
        drift: Displacements of the obstacles, shape (B, n, T P, D), [m]; None if they stand still.
        least: Least clearance of H movements so far, shape (B, H), [m], which is lowered; P is a multiple of H.
        exact: Range of clearance of interest, [m].
    """
    assert obstacles.shapes is not None
    shapes, (number, _, places), plans = obstacles.shapes, squared.shape, least.shape[1]
    radii = np.tile(bodies.radius, places // len(bodies.radius))

    def clearance(scene: Index, obstacle: Index, place: Index) -> Float:
        ends: list[Any] = [end[scene, place] for end in (bodies.first, bodies.second) if end is not None]
        if drift is not None:
            ends = [end - drift[scene, obstacle, place] for end in ends]
        distance = pair_distance(shapes[scene, obstacle], *map(in_space, ends))
        from_axis = distance + obstacles.rows[scene, obstacle, -1]
        squared[scene, obstacle, place] = np.square(np.maximum(from_axis, 0.0))
        return np.asarray(distance - radii[place])

    bound = np.sqrt(squared) - (obstacles.rows[..., -1:] + radii)
    each = bound.reshape(number, -1, plans)
    nearest = each.argmin(axis=1)  # the least bound of each movement, whose exact value excludes most others
    scene, plan = np.nonzero(each.min(axis=1) < np.minimum(least, exact[1]))
    obstacle, rest = np.divmod(nearest[scene, plan], places // plans)
    place = rest * plans + plan
    np.minimum.at(least, (scene, plan), clearance(scene, obstacle, place))
    limit = np.where(least > exact[0], np.minimum(least, np.float32(exact[1])), -np.inf)
    some = bound < np.tile(limit, places // plans)[:, None]
    some[scene, obstacle, place] = False
    scene, obstacle, place = np.nonzero(some)
    np.minimum.at(least, (scene, place % plans), clearance(scene, obstacle, place))


class _DistanceProfile:
    """Squared distances of bodies from n obstacles at T instants of P movements in each of B scenes."""

    def __init__(self, bodies: _Bodies, radii: Numbers, squared: Numbers, *, convex: bool) -> None:
        self.bodies = bodies
        self.convex = convex
        """False if all obstacles are capsules."""
        self.radii = radii
        """Sums of the radii of bodies and obstacles, shape (B, n, P), [m]."""
        self.squared = squared
        """Squared distances of axes, shape (B, n, T, P), [m^2]."""
        self.lowest = squared.min(axis=2)
        """Least of the instants, shape (B, n, P), [m^2]."""

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
        """Return the square of STEP_REACH of the longer step to a neighbouring instant, shape (B, T, P), [m^2]."""
        ends = [each for each in (self.bodies.first, self.bodies.second) if each is not None]
        squares = [squared_length(each[:, 1:] - each[:, :-1]) for each in ends]
        square: Numbers = np.float32(STEP_REACH**2) * functools.reduce(np.maximum, squares)
        longer = np.empty((len(square), square.shape[1] + 1, square.shape[2]), square.dtype)
        longer[:, :-1], longer[:, -1] = square, square[:, -1]
        np.maximum(longer[:, 1:-1], square[:, :-1], out=longer[:, 1:-1])
        return longer


def _refined_clearance(
    bodies: _Bodies, minima: tuple[Index, ...], obstacles: Obstacles, duration: Numbers, limit: Numbers
) -> Single:
    """Return the least clearance between the instants around local minima, shape (M,), [m].

    Args:
        bodies: Bodies of the distance profile.
        minima: Scenes, obstacles, instants and movements, shape (M,) each.
        obstacles: Obstacles of the scenes.
        duration: Durations of the movements, shape (B, H), [s].
        limit: Clearance of interest, shape (B, H), [m].
    """
    scene, which, instant, movement = minima
    first, weights, times = _interpolation(NODES)
    nodes, plan = first[instant, None] + np.arange(STENCIL), movement % duration.shape[1]
    ends = bodies.map(lambda end: weights[instant] @ end[scene[:, None], nodes, movement[:, None]])  # (2)
    row, radius = obstacles.rows[scene, which, None], bodies.radius[movement]
    drift = None
    if obstacles.velocity is not None:
        elapsed = duration[scene, plan, None] * times[instant]
        drift = (obstacles.velocity[scene, which, None] * elapsed[..., None].astype(np.float32))[:, None]
    squared = ends.distance_squared(row, drift)[:, 0]
    if obstacles.shapes is not None:
        clearance = np.sqrt(squared.min(axis=1)) - row[:, 0, -1] - radius
        near = np.flatnonzero(clearance < limit[scene, plan])
        shapes = np.repeat(obstacles.shapes[scene[near], which[near]], squared.shape[1], axis=0)
        moved = 0.0 if drift is None else drift[near, 0]
        points = [end[near] - moved for end in (ends.first, ends.second) if end is not None]
        distance = pair_distance(shapes, *(in_space(each.reshape(-1, each.shape[-1])) for each in points))
        from_axis = distance.reshape(len(near), squared.shape[1]) + row[near, 0, -1:]
        squared[near] = np.square(np.maximum(from_axis, 0.0))
    each = np.arange(len(squared))
    at = squared[:, 1:-1].argmin(axis=-1)
    before, middle, after = (squared[each, at + i] for i in range(3))
    lowest = np.minimum(parabola_minimum(before, middle, after), np.minimum(before, after))  # (3)
    distance = np.sqrt(np.maximum(lowest, 0.0))
    return np.asarray(distance - (row[:, 0, -1] + radius))  # (1)


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
