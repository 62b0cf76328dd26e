"""Nearest points of points, segments and the axes of capsules, and least values along a segment."""

from __future__ import annotations

from collections.abc import Sequence

from viapoint.envs.common.arrays import TINY, clamp, dot
from viapoint.primitives.array_api import Array, namespace_of


def point_axis_squared(offset: Sequence[Array], axis: Sequence[Array]) -> Array:
    """Return the squared distance of points p from segments c + t a, -1 <= t <= 1, [m^2], from p - c and a.

    The nearest point of the segment is at t = (p - c) . a / |a|^2, clamped.
    """
    square = dot(axis, axis)
    along = (dot(offset, axis) / (square + (square <= TINY))).clip(-1.0, 1.0)
    rest = []  # a comprehension is a call in Python 3.11, and this runs several times in each step
    for o, a in zip(offset, axis, strict=True):
        rest.append(o - along * a)
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


def lowest_of_lines(slopes: Array, offsets: Array) -> Array:
    """Return t in [0, 1] where the greatest of K affine functions a_k t + b_k, shape (K, M), is least, shape (M,).

    The minimum of max_k (a_k t + b_k) lies where a falling and a rising function cross. Each step replaces one of the
    two by the greatest function at their crossing, so it ends after at most K steps, usually after three.
    """
    xp = namespace_of(slopes)
    each = xp.arange(slopes.shape[1])
    rounding = 8.0 * float(xp.finfo(slopes.dtype).eps)

    def highest(t: Array) -> tuple[Array, Array, Array]:
        values = slopes * t + offsets
        line = xp.argmax(values, axis=0)
        return slopes[line, each], offsets[line, each], values[line, each]

    falling, rising = highest(xp.zeros_like(slopes[0])), highest(xp.ones_like(slopes[0]))
    inside = (falling[0] < 0.0) & (rising[0] > 0.0)
    t = xp.where(falling[0] >= 0.0, xp.zeros_like(slopes[0]), xp.ones_like(slopes[0]))
    for _ in range(len(slopes)):
        steeper = xp.where(inside, rising[0] - falling[0], xp.ones_like(t))
        t = xp.where(inside, (falling[1] - rising[1]) / steeper, t)
        slope, offset, value = highest(t)
        crossing = falling[0] * t + falling[1]
        if not (inside & (value > crossing + rounding * (1.0 + xp.abs(crossing)))).any():
            break
        down = slope < 0.0
        falling = xp.where(down, slope, falling[0]), xp.where(down, offset, falling[1]), value
        rising = xp.where(down, rising[0], slope), xp.where(down, rising[1], offset), value
    return xp.clip(t, 0.0, 1.0)


def nearest_to_origin(start: Sequence[Array], along: Sequence[Array]) -> Array:
    """Return t in [0, 1] for which start + t * along is nearest to the origin."""
    square = namespace_of(along[0]).maximum(dot(along, along), TINY)
    return clamp(-dot(start, along) / square, 0.0, 1.0)
