"""Batched polynomials in unit time: products, derivatives, values, all real roots in [0, 1], and extrema.

Coefficients are the last axis, lowest power first, in NumPy float64. Each polynomial is computed by itself,
so results do not depend on the batch. Extrema of trajectories are at roots of a derivative and at ends of segments.
Their values are evaluated in the caller's array library, with gradients that are right: the slope vanishes at an
extremum (envelope theorem), or the time is a knot.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import comb
from typing import Any, TypeAlias

import numpy as np

from .array_api import Array, Floats, largest_exponent, like, ordered_sum, to_numpy

Trajectory: TypeAlias = Any
"""A `Trajectory`, whose module imports this one."""

# s of w = 1 / (u + s), irrational so that -s is no root of a polynomial with simple coefficients.
_SHIFT = 0.6180339887498949
_POLISHING_STEPS = 3


def evaluate(coefficients: Floats, u: Floats) -> Floats:
    """Evaluate polynomials (..., n + 1) at points (...) of the same leading shape, by Horner's rule."""
    value = np.zeros_like(u) + coefficients[..., -1]
    for k in reversed(range(coefficients.shape[-1] - 1)):
        value = value * u + coefficients[..., k]
    return value


def differentiate(coefficients: Floats) -> Floats:
    """Return the coefficients (..., n) of the derivative, at least one."""
    if coefficients.shape[-1] == 1:
        return np.zeros_like(coefficients)
    return coefficients[..., 1:] * np.arange(1.0, coefficients.shape[-1])


def multiply(p: Floats, q: Floats) -> Floats:
    """Return the coefficients of the product."""
    batch = np.broadcast_shapes(p.shape[:-1], q.shape[:-1])
    product: Floats = np.zeros((*batch, p.shape[-1] + q.shape[-1] - 1))
    for k in range(p.shape[-1]):
        product[..., k : k + q.shape[-1]] += p[..., k : k + 1] * q
    return product


def unit_size(array: Any, axis: tuple[int, ...]) -> tuple[Any, Any]:
    """Return an array times 2^-n, of a size of about 1 along the axes, so that no square over- or underflows, and n."""
    exponent = np.frexp(np.abs(array).max(axis=axis, keepdims=True))[1]
    return np.ldexp(array, -exponent), exponent


def root_candidates(coefficients: Floats) -> Floats:
    """Return points of [0, 1], (..., n) ascending, that include all real roots there.

    The other points are real parts of complex roots, or the nearest end of the interval. They do no harm to a
    caller that compares a function at all points.

    The roots are eigenvalues of a companion matrix (Edelman & Murakami 1995) in w = 1 / (u + s). Where the
    leading coefficients vanish, the roots at infinity become w = 0 instead of infinite matrix entries.
    """
    degree = coefficients.shape[-1] - 1
    if degree < 1:
        return np.zeros((*coefficients.shape[:-1], 0))
    size = np.abs(coefficients).max(axis=-1, keepdims=True)
    scaled = coefficients / np.where(size > 0, size, 1.0)
    # p(v - s) = sum_j shifted_j v^j; with v = 1/w the leading coefficient in w is shifted_0 = p(-s).
    shifted = np.matmul(scaled[..., None, :], _shift_matrix(degree))[..., 0, :]
    leading = shifted[..., :1]
    leading = np.where(np.abs(leading) < 1e-15, 1e-15, leading)
    companion = np.zeros((*shifted.shape[:-1], degree, degree))
    companion[..., np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[..., 0, :] = -shifted[..., 1:] / leading
    w = np.linalg.eigvals(companion)
    square = w.real * w.real + w.imag * w.imag
    u = w.real / np.where(square > 0, square, 1.0) - _SHIFT  # Re(1/w) - s
    u = np.clip(u, 0.0, 1.0)
    # Newton steps within [0, 1]; long steps belong to points that are no roots.
    polynomial = scaled[..., None, :]
    slope = differentiate(polynomial)
    for _ in range(_POLISHING_STEPS):
        rate = evaluate(slope, u)
        step = evaluate(polynomial, u) / np.where(rate == 0, 1.0, rate)
        u = np.where(np.abs(step) < 1e-2, np.clip(u - step, 0.0, 1.0), u)
    return np.sort(u, axis=-1)


@cache
def _shift_matrix(degree: int) -> Floats:
    """Return the matrix that maps coefficients in u = v - s to those in v, by the binomial theorem."""
    table = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for j in range(k + 1):
            table[k, j] = comb(k, j) * (-_SHIFT) ** (k - j)
    return table


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
