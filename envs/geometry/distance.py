"""Exact distances between the arm and the obstacles.

All bodies are capsules: an obstacle is a row (centre D, half-axis vector D, radius 1) in [m], a link a segment with a
radius, and the hand a point with one. The clearance of two capsules is the distance of their axes less both radii. The
functions are batched over leading dimensions and accept NumPy arrays and torch tensors. They share these arguments:

    obstacles   rows of n obstacles, shape (..., n, 2 D + 1), [m]
    present     True for rows that are obstacles, shape (..., n)
    drift       displacement of each obstacle at each time, shape (..., n, T, D), [m]; None if obstacles stand still
    radius(es)  of the hand, or of the L links, [m]

Clearance is negative for penetration and at most MAX_CLEARANCE.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

from viapoint.envs.common.arrays import clamp, dot
from viapoint.primitives.array_api import Array, Namespace, namespace_of

MAX_CLEARANCE = 1.0
"""Greatest clearance that is reported, also without obstacles, [m]."""
TINY = 1e-12
"""Least squared length of an axis, [m^2], and least squared sine between axes that are not parallel."""


def hand_clearance(points: Array, radius: float, obstacles: Array, present: Array) -> Array:
    """Return the least clearance of the hand over a movement from each obstacle, shape (..., n), [m].

    Args:
        points: Hand positions, shape (..., T, D), [m].
        radius: Radius of the hand, [m].
        obstacles: See the module.
        present: See the module.
    """
    xp = namespace_of(points)
    nearest = xp.min(point_distance_squared(points, obstacles), axis=-1)
    return _clearance(xp, nearest, obstacles[..., -1] + radius, present)


def arm_clearance(links: Array, radii: tuple[float, ...], obstacles: Array, present: Array) -> Array:
    """Return the least clearance of all links over a movement from each obstacle, shape (..., n), [m].

    Args:
        links: Both ends of the links' axes, shape (..., T, L, 2, D), [m].
        radii: Radii of the links, [m].
        obstacles: See the module.
        present: See the module.
    """
    xp, each = namespace_of(links), []
    for i, radius in enumerate(radii):
        # Only the least squared distance needs its root: 6 to 10 % faster than all clearances first.
        squared = segment_distance_squared(links[..., i, 0, :], links[..., i, 1, :], obstacles)
        each.append(_clearance(xp, xp.min(squared, axis=-1), obstacles[..., -1] + radius, present))
    return functools.reduce(xp.minimum, each)


def point_distance_squared(points: Array, obstacles: Array, drift: Array = None) -> Array:
    """Return the squared distance of points from the obstacles' axes, shape (..., n, T), [m^2].

    Args:
        points: Positions, shape (..., T, D), [m].
        obstacles: See the module.
        drift: See the module.
    """
    dimension = points.shape[-1]
    offset = [points[..., None, :, i] - obstacles[..., :, None, i] for i in range(dimension)]
    offset = offset if drift is None else [o - drift[..., i] for i, o in enumerate(offset)]
    return point_axis_squared(offset, [obstacles[..., :, None, dimension + i] for i in range(dimension)])


def segment_distance_squared(first: Array, second: Array, obstacles: Array, drift: Array = None) -> Array:
    """Return the squared distance of segments from the axes of obstacles, shape (..., n, T), [m^2].

    Args:
        first: One end of each segment, shape (..., T, D), [m].
        second: Other end of each segment, shape (..., T, D), [m].
        obstacles: See the module.
        drift: See the module.
    """
    dimension = first.shape[-1]
    link = [second[..., None, :, i] - first[..., None, :, i] for i in range(dimension)]
    axis = [2.0 * obstacles[..., :, None, dimension + i] for i in range(dimension)]
    gap = [
        first[..., None, :, i] - (obstacles[..., :, None, i] - obstacles[..., :, None, dimension + i])
        for i in range(dimension)
    ]
    gap = gap if drift is None else [g - drift[..., i] for i, g in enumerate(gap)]
    return segment_axis_squared(gap, link, axis)


def point_axis_squared(offset: Sequence[Array], axis: Sequence[Array]) -> Array:
    """Return the squared distance of points p from segments c + t a, -1 <= t <= 1, [m^2].

    The nearest point of the segment is at t = (p - c) . a / |a|^2, clamped.

    Args:
        offset: Components of p - c, [m].
        axis: Components of a, [m].
    """
    square = dot(axis, axis)
    along = (dot(offset, axis) / (square + (square <= TINY))).clip(-1.0, 1.0)
    rest = [o - along * a for o, a in zip(offset, axis, strict=True)]
    return dot(rest, rest)


def segment_axis_squared(gap: Sequence[Array], link: Sequence[Array], axis: Sequence[Array]) -> Array:
    """Return the squared distance of segments p + s u from segments q + t v, 0 <= s, t <= 1, [m^2].

    The nearest points of two segments by clamping one parameter after the other (C. Ericson, Real-Time Collision
    Detection, 2005, section 5.1.9, in its notation): the point of the link nearest to the obstacle's line, the point of
    the obstacle's axis nearest to that, and the point of the link nearest to that.

    Args:
        gap: Components of p - q, [m].
        link: Components of u, [m].
        axis: Components of v, [m].
    """
    on_link, on_axis = nearest_on_segments(gap, link, axis)
    rest = [g + on_link * u - on_axis * v for g, u, v in zip(gap, link, axis, strict=True)]
    return dot(rest, rest)


def nearest_on_segments(
    gap: Sequence[Array], link: Sequence[Array], axis: Sequence[Array]
) -> tuple[Array, Array]:
    """Return s and t of the nearest points of two segments; see :func:`segment_axis_squared`."""
    xp = namespace_of(gap[0])
    a, e, b = dot(link, link), dot(axis, axis), dot(link, axis)
    c, f = dot(link, gap), dot(axis, gap)
    a, e = xp.maximum(a, TINY), xp.maximum(e, TINY)
    determinant = a * e - b * b
    crosses = determinant > TINY * a * e  # else parallel: any point of the link will do to begin with
    crossing = (b * f - c * e) / xp.where(crosses, determinant, 1.0)
    on_link = clamp(xp.where(crosses, crossing, 0.0), 0.0, 1.0)
    on_axis = clamp((b * on_link + f) / e, 0.0, 1.0)
    return clamp((b * on_axis - c) / a, 0.0, 1.0), on_axis


def _clearance(xp: Namespace, squared: Array, radii: Array, present: Array) -> Array:
    """Return clearance from squared distances of axes; the small summand keeps gradients at distance 0 finite."""
    distance = xp.sqrt(squared + 1e-24) - radii
    return xp.where(present, xp.minimum(distance, MAX_CLEARANCE), xp.full_like(distance, MAX_CLEARANCE))
