"""Nearest points of points, segments and the axes of capsules, and least values along a segment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import TINY, dot
from viapoint.envs.common.types import Array, Float


def point_axis_squared(offset: Sequence[Array], axis: Sequence[Array]) -> Any:
    """Return the squared distance of points p from segments c + t a, -1 <= t <= 1, [m^2], from p - c and a.

    The nearest point of the segment is at t = (p - c) . a / |a|^2, clamped.
    """
    square = dot(axis, axis)
    along = (dot(offset, axis) / (square + (square <= TINY))).clip(-1.0, 1.0)
    rest = []  # a comprehension is a call in Python 3.11, and this runs several times in each step
    for o, a in zip(offset, axis, strict=True):
        rest.append(o - along * a)
    return dot(rest, rest)


def segment_axis_squared(gap: Sequence[Array], link: Sequence[Array], axis: Sequence[Array]) -> Any:
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
    a, e, b = dot(link, link), dot(axis, axis), dot(link, axis)
    c, f = dot(link, gap), dot(axis, gap)
    a, e = np.maximum(a, TINY), np.maximum(e, TINY)
    determinant = a * e - b * b
    crosses = determinant > TINY * a * e  # else parallel: any point of the link will do to begin with
    crossing = (b * f - c * e) / np.where(crosses, determinant, 1.0)
    on_link = np.where(crosses, crossing, 0.0).clip(0.0, 1.0)
    on_axis = ((b * on_link + f) / e).clip(0.0, 1.0)
    return ((b * on_axis - c) / a).clip(0.0, 1.0), on_axis


def lowest_of_lines(slopes: Float, offsets: Float) -> Float:
    """Return t in [0, 1] where the greatest of K affine functions a_k t + b_k, shape (K, M), is least, shape (M,).

    The minimum of max_k (a_k t + b_k) lies where a falling and a rising function cross. Each step replaces one of the
    two by the greatest function at their crossing, so it ends after at most K steps, usually after three.
    """
    each = np.arange(slopes.shape[1])
    rounding = 8.0 * np.finfo(np.float64).eps

    def highest(t: Float) -> tuple[Float, Float, Float]:
        values = slopes * t + offsets
        line = np.argmax(values, axis=0)
        return slopes[line, each], offsets[line, each], values[line, each]

    falling, rising = highest(np.zeros_like(slopes[0])), highest(np.ones_like(slopes[0]))
    inside = (falling[0] < 0.0) & (rising[0] > 0.0)
    t = np.where(falling[0] >= 0.0, 0.0, 1.0)
    for _ in range(len(slopes)):
        steeper = np.where(inside, rising[0] - falling[0], 1.0)
        t = np.where(inside, (falling[1] - rising[1]) / steeper, t)
        slope, offset, value = highest(t)
        crossing = falling[0] * t + falling[1]
        if not (inside & (value > crossing + rounding * (1.0 + np.abs(crossing)))).any():
            break
        down = slope < 0.0
        falling = np.where(down, slope, falling[0]), np.where(down, offset, falling[1]), value
        rising = np.where(down, rising[0], slope), np.where(down, rising[1], offset), value
    return np.clip(t, 0.0, 1.0)


def nearest_to_origin(start: Sequence[Float], along: Sequence[Float]) -> Float:
    """Return t in [0, 1] for which start + t * along is nearest to the origin."""
    square = np.maximum(dot(along, along), TINY)
    return np.asarray((-dot(start, along) / square).clip(0.0, 1.0))
