"""Exact distances between the arm and the obstacles.

Everything is a capsule: an obstacle is a row (centre D, half-axis vector D, radius 1) in [m], a link a segment with a
radius, the hand a point with one. So clearance is the distance of two segments less two radii. The functions are
batched over leading dimensions and accept NumPy arrays and torch tensors.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

from viapoint.envs.common.arrays import clamp
from viapoint.primitives.array_api import Array, namespace_of

MAX_CLEARANCE = 1.0
"""Clearance is reported up to this distance, [m]: also where there is no obstacle."""
_TINY = 1e-12


def hand_clearance(points: Array, radius: float, obstacles: Array, present: Array) -> Array:
    """Least clearance of the hand over a movement, for each obstacle.

    Args:
        points: Positions of the hand, shape (..., T, D), [m].
        radius: Of the hand, [m].
        obstacles: Shape (..., n, 2 D + 1), [m].
        present: Whether a row is an obstacle, shape (..., n), bool.

    Returns:
        Shape (..., n), [m]; negative is penetration, at most MAX_CLEARANCE.
    """
    xp = namespace_of(points)
    nearest = xp.min(point_distance_squared(points, obstacles), axis=-1)
    return _clearance(nearest, obstacles[..., -1] + radius, present)


def arm_clearance(links: Array, radii: tuple[float, ...], obstacles: Array, present: Array) -> Array:
    """Least clearance of the links over a movement, for each obstacle.

    Args:
        links: End points of the links' axes, shape (..., T, L, 2, D), [m].
        radii: Of the L links, [m].
        obstacles: Shape (..., n, 2 D + 1), [m].
        present: Whether a row is an obstacle, shape (..., n), bool.

    Returns:
        Shape (..., n), [m]; negative is penetration, at most MAX_CLEARANCE.
    """
    xp = namespace_of(links)
    each = []
    for i, radius in enumerate(radii):
        squared = segment_distance_squared(links[..., i, 0, :], links[..., i, 1, :], obstacles)
        each.append(_clearance(xp.min(squared, axis=-1), obstacles[..., -1] + radius, present))
    return xp.min(xp.stack(each, axis=-1), axis=-1)


def clearance_profile(
    hand: Array,
    hand_radius: float,
    obstacles: Array,
    present: Array,
    links: Array = None,
    link_radii: tuple[float, ...] = (),
    drift: Array = None,
) -> Array:
    """Clearance of the hand and, where given, the links from each obstacle at each time.

    Args:
        hand: Positions, shape (..., T, D), [m].
        hand_radius: [m].
        obstacles: Shape (..., n, 2 D + 1), [m].
        present: Whether a row is an obstacle, shape (..., n), bool.
        links: End points of the links' axes, shape (..., T, L, 2, D), [m].
        link_radii: Of the L links, [m].
        drift: How far each obstacle has moved at each time, shape (..., n, T, D), [m]; None where they stand.

    Returns:
        Shape (..., n, T), [m].
    """
    radii, shown = obstacles[..., :, None, -1], present[..., :, None]
    least = _clearance(point_distance_squared(hand, obstacles, drift), radii + hand_radius, shown)
    if links is None:
        return least
    pairs = [(links[..., i, 0, :], links[..., i, 1, :]) for i in range(len(link_radii))]
    return namespace_of(hand).minimum(least, links_profile(pairs, link_radii, obstacles, present, drift))


def links_profile(
    links: Sequence[tuple[Array, Array]],
    radii: tuple[float, ...],
    obstacles: Array,
    present: Array,
    drift: Array = None,
) -> Array:
    """Clearance of the links alone, as :func:`clearance_profile` has it.

    Args:
        links: Both ends of the L links' axes, shape (..., T, D) each, [m].
        radii: Of the links, [m].
        obstacles: Shape (..., n, 2 D + 1), [m].
        present: Whether a row is an obstacle, shape (..., n), bool.
        drift: How far each obstacle has moved at each time, shape (..., n, T, D), [m]; None where they stand.

    Returns:
        Shape (..., n, T), [m].
    """
    each = (
        _clearance(
            segment_distance_squared(first, second, obstacles, drift),
            obstacles[..., :, None, -1] + radius,
            present[..., :, None],
        )
        for (first, second), radius in zip(links, radii, strict=True)
    )
    return functools.reduce(namespace_of(obstacles).minimum, each)


def point_distance_squared(points: Array, obstacles: Array, drift: Array = None) -> Array:
    """Squared distance of points from the obstacles' axes.

    Args:
        points: Shape (..., T, D), [m].
        obstacles: Shape (..., n, 2 D + 1), [m].
        drift: How far each obstacle has moved at each time, shape (..., n, T, D), [m]; None where they stand.

    Returns:
        Shape (..., n, T), [m^2].
    """
    xp = namespace_of(points)
    dimension = points.shape[-1]
    offset = [points[..., None, :, i] - obstacles[..., :, None, i] for i in range(dimension)]
    offset = offset if drift is None else [o - drift[..., i] for i, o in enumerate(offset)]
    axis = [obstacles[..., :, None, dimension + i] for i in range(dimension)]
    square = sum(a * a for a in axis)
    along = sum(o * a for o, a in zip(offset, axis, strict=True)) / xp.where(square > _TINY, square, 1.0)
    along = clamp(along, -1.0, 1.0)
    rest = [o - along * a for o, a in zip(offset, axis, strict=True)]
    return sum(r * r for r in rest)


def segment_distance_squared(first: Array, second: Array, obstacles: Array, drift: Array = None) -> Array:
    """Squared distance of segments from the obstacles' axes, which are segments too.

    The nearest points of two segments by clamping one parameter after the other (C. Ericson, Real-Time Collision
    Detection, 2005, section 5.1.9).

    Args:
        first: One end of each segment, shape (..., T, D), [m].
        second: The other end, likewise; the segment has a length.
        obstacles: Shape (..., n, 2 D + 1), [m].
        drift: How far each obstacle has moved at each time, shape (..., n, T, D), [m]; None where they stand.

    Returns:
        Shape (..., n, T), [m^2].
    """
    xp = namespace_of(first)
    dimension = first.shape[-1]
    link = [second[..., None, :, i] - first[..., None, :, i] for i in range(dimension)]
    axis = [2.0 * obstacles[..., :, None, dimension + i] for i in range(dimension)]
    gap = [
        first[..., None, :, i] - (obstacles[..., :, None, i] - obstacles[..., :, None, dimension + i])
        for i in range(dimension)
    ]
    gap = gap if drift is None else [g - drift[..., i] for i, g in enumerate(gap)]
    a, e, b = _dot(link, link), _dot(axis, axis), _dot(link, axis)
    c, f = _dot(link, gap), _dot(axis, gap)
    e = xp.maximum(e, _TINY)
    determinant = a * e - b * b
    crosses = determinant > _TINY * a * e
    crossing = (b * f - c * e) / xp.where(crosses, determinant, 1.0)
    on_link = clamp(xp.where(crosses, crossing, 0.0), 0.0, 1.0)
    on_axis = clamp((b * on_link + f) / e, 0.0, 1.0)
    on_link = clamp((b * on_axis - c) / a, 0.0, 1.0)
    rest = [g + on_link * u - on_axis * v for g, u, v in zip(gap, link, axis, strict=True)]
    return _dot(rest, rest)


def _dot(first: list[Array], second: list[Array]) -> Array:
    total = first[0] * second[0]
    for u, v in zip(first[1:], second[1:], strict=True):
        total = total + u * v
    return total


def _clearance(squared: Array, radii: Array, present: Array) -> Array:
    xp = namespace_of(squared)
    distance = xp.sqrt(squared + 1e-24) - radii
    return xp.where(present, xp.minimum(distance, MAX_CLEARANCE), xp.full_like(distance, MAX_CLEARANCE))
