"""Exact extrema of piecewise polynomials: stationary points from polynomial roots, and segment ends.

The times are computed in NumPy, outside of any gradient. The values are then evaluated in the caller's array
library. Their gradients are right: the slope vanishes at an extremum (envelope theorem), or the time is a knot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ._polynomial import differentiate, evaluate, multiply, root_candidates, unit_size
from .array_api import Array, Floats, largest_exponent, like, ordered_sum, to_numpy

Trajectory: TypeAlias = Any
"""A `Trajectory`, whose module imports this one."""


@dataclass(frozen=True)
class Extrema:
    """Least and greatest value along each axis, with the first time of each.

    Attributes:
        minimum: (..., D) [m/s^nu].
        minimum_time: (..., D) [s].
        maximum: (..., D) [m/s^nu].
        maximum_time: (..., D) [s].

    Example:
        >>> from viapoint.primitives import point_to_point
        >>> extrema = point_to_point([0.0], [1.0], 2.0).extrema(1)  # of the velocity
        >>> extrema.maximum.round(9).tolist(), extrema.maximum_time.round(9).tolist()
        ([0.9375], [1.0])
    """

    minimum: Array
    minimum_time: Array
    maximum: Array
    maximum_time: Array


def axis_extrema(trajectory: Trajectory, coefficients: Array) -> Extrema:
    """Return the extrema of every component of a derivative with the coefficients (..., n, S, D)."""
    polynomials, _ = _polynomials(coefficients)
    u = _with_ends(root_candidates(differentiate(polynomials)))
    values = evaluate(polynomials[..., None, :], u)
    low, high = (_read(trajectory, coefficients, _best(trajectory, u, score)) for score in (-values, values))
    return Extrema(*low, *high)


def largest_norm(trajectory: Trajectory, coefficients: Array) -> Array:
    """Return (...,) the largest Euclidean norm of a derivative, from the roots of x . dx/du."""
    xp = trajectory.namespace
    polynomials, exponent = _polynomials(coefficients)
    square = ordered_sum(multiply(polynomials, polynomials), -2)
    change = ordered_sum(multiply(polynomials, differentiate(polynomials)), -2)
    u = _with_ends(root_candidates(change))
    score = evaluate(square[..., None, :], u)
    values, _ = _read(trajectory, coefficients, _best(trajectory, u[..., None, :], score[..., None, :]))
    limit = largest_exponent(xp, values.dtype)
    exponent = np.clip(exponent, -limit, limit)
    down, up = (like(xp, np.ldexp(1.0, sign * exponent), values) for sign in (-1, 1))
    return xp.linalg.vector_norm(values * down, axis=-1) * up[..., 0]


def _polynomials(coefficients: Array) -> tuple[Floats, Any]:
    """Return the coefficients as (..., S, D, n) NumPy float64, of unit size, and the exponent (..., 1)."""
    numbers, exponent = unit_size(to_numpy(coefficients).astype(np.float64), (-3, -2, -1))
    return np.ascontiguousarray(np.moveaxis(numbers, -3, -1)), exponent[..., 0, 0]


def _with_ends(u: Floats) -> Floats:
    """Return the points with 0 before and 1 after them."""
    edge = np.zeros((*u.shape[:-1], 1))
    return np.concatenate([edge, u, edge + 1.0], axis=-1)


def _best(trajectory: Trajectory, u: Floats, score: Floats) -> tuple[Any, Floats]:
    """Return segment and unit time, (..., D) each, of the best of candidates (..., S, D, P): the earliest of equals."""
    empty = to_numpy(trajectory.rates) <= 0
    score = np.where(empty[..., None, None], -np.inf, score)
    u, score = np.swapaxes(u, -3, -2), np.swapaxes(score, -3, -2)  # (..., D, S, P)
    count = u.shape[-1]
    u, score = (np.reshape(a, (*a.shape[:-2], a.shape[-2] * count)) for a in (u, score))
    chosen = np.argmax(score, axis=-1)
    return chosen // count, np.take_along_axis(u, chosen[..., None], axis=-1)[..., 0]


def _read(trajectory: Trajectory, coefficients: Array, place: tuple[Any, Floats]) -> tuple[Array, Array]:
    """Return the value (..., D) of axis d at place d (or of all axes at the one place), and the time."""
    segment, u = place
    xp, (powers, segments, _) = trajectory.namespace, coefficients.shape[-3:]
    chosen = segment[..., None, None, :] == np.arange(segments)[:, None]  # (..., 1, S, D or 1)
    basis = chosen * u[..., None, None, :] ** np.arange(powers)[:, None, None]
    values = xp.sum(xp.sum(like(xp, basis, coefficients) * coefficients, axis=-2), axis=-2)
    starts = to_numpy(trajectory.starts)
    rates = to_numpy(trajectory.rates)
    spans = np.where(rates > 0, 1.0 / np.where(rates > 0, rates, 1.0), 0.0)
    shape = (*segment.shape[:-1], segments)
    start = np.take_along_axis(np.broadcast_to(starts, shape), segment, axis=-1)
    span = np.take_along_axis(np.broadcast_to(spans, shape), segment, axis=-1)
    time = np.minimum(start + u * span, to_numpy(trajectory.end))  # no rounding past the end
    return values, like(xp, time, coefficients)
