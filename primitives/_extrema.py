"""Exact extremes of piecewise polynomials: stationary points from roots, and the ends of the pieces.

The places are found in NumPy, outside of any gradient. The values are then read there in the caller's own
array library; since the slope vanishes at an extremum, or the place is an end, their gradients are right as
well.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from math import frexp
from typing import Any

import numpy as np

from ._evaluate import derivative_coefficients
from ._polynomial import Floats, differentiate, evaluate, multiply, root_candidates, unit_size
from .array_api import Array, Namespace, like, to_numpy


@dataclass(frozen=True)
class Extrema:
    """Least and greatest value along each axis, and when they are reached first.

    Attributes:
        minimum: (..., D) [m/s^nu].
        minimum_time: (..., D) [s].
        maximum: (..., D) [m/s^nu].
        maximum_time: (..., D) [s].
    """

    minimum: Array
    minimum_time: Array
    maximum: Array
    maximum_time: Array


@dataclass(frozen=True)
class Pieces:
    """One derivative: (..., n, S, D) coefficients, (..., S) starts and rates, (..., 1) end."""

    coefficients: Array
    starts: Array
    rates: Array
    end: Array
    namespace: Namespace

    def polynomials(self) -> tuple[Floats, Any]:
        """Return the coefficients as (..., S, D, n) NumPy float64, of unit size, and the exponent (..., 1)."""
        numbers, exponent = unit_size(to_numpy(self.coefficients).astype(np.float64), (-3, -2, -1))
        return np.ascontiguousarray(np.moveaxis(numbers, -3, -1)), exponent[..., 0, 0]


def pieces_of(coefficients: Array, starts: Array, rates: Array, end: Array, nu: int, xp: Namespace) -> Pieces:
    """Return the nu-th derivative; beyond the degree it is the constant zero."""
    if nu >= coefficients.shape[-3]:
        return Pieces(0.0 * coefficients[..., :1, :, :], starts, rates, end, xp)
    return Pieces(derivative_coefficients(coefficients, rates, nu), starts, rates, end, xp)


def axis_extrema(pieces: Pieces) -> Extrema:
    """Return the extremes of every component."""
    polynomials, _ = pieces.polynomials()
    u = _with_ends(root_candidates(differentiate(polynomials)))
    values = evaluate(polynomials[..., None, :], u)
    low = _read(pieces, _best(pieces, u, -values, per_axis=True))
    high = _read(pieces, _best(pieces, u, values, per_axis=True))
    return Extrema(*low, *high)


def largest_norm(pieces: Pieces) -> Array:
    """Return (...,) the largest Euclidean norm."""
    xp = pieces.namespace
    polynomials, exponent = pieces.polynomials()
    square = _over_axes(multiply(polynomials, polynomials))
    change = _over_axes(multiply(polynomials, differentiate(polynomials)))
    u = _with_ends(root_candidates(change))
    place = _best(pieces, u, evaluate(square[..., None, :], u), per_axis=False)
    values, _ = _read(pieces, place)
    largest = min(float(xp.finfo(values.dtype).max), sys.float_info.max)
    limit = frexp(largest)[1] - 2  # powers of two up to this one, and their inverses, are of full precision
    exponent = np.clip(exponent, -limit, limit)
    down, up = (like(xp, np.ldexp(1.0, sign * exponent), values) for sign in (-1, 1))
    return xp.linalg.vector_norm(values * down, axis=-1) * up[..., 0]


def _over_axes(polynomials: Floats) -> Floats:
    """Sum over the axes of space, (..., S, D, n) -> (..., S, n), in their order."""
    total: Floats = polynomials[..., 0, :]
    for d in range(1, polynomials.shape[-2]):
        total = total + polynomials[..., d, :]
    return total


def _with_ends(u: Floats) -> Floats:
    edge = np.zeros((*u.shape[:-1], 1))
    return np.concatenate([edge, u, edge + 1.0], axis=-1)


def _best(pieces: Pieces, u: Floats, score: Floats, *, per_axis: bool) -> tuple[Any, Floats]:
    """Segment and unit time of the best candidate, each (..., D) or (..., 1); the earliest if several."""
    empty = to_numpy(pieces.rates) <= 0
    score = np.where(empty[..., None, None] if per_axis else empty[..., None], -np.inf, score)
    if per_axis:  # (..., S, D, P) -> (..., D, S, P)
        u, score = np.swapaxes(u, -3, -2), np.swapaxes(score, -3, -2)
    else:
        u, score = u[..., None, :, :], score[..., None, :, :]
    count = u.shape[-1]
    u, score = (np.reshape(a, (*a.shape[:-2], a.shape[-2] * count)) for a in (u, score))
    chosen = np.argmax(score, axis=-1)
    return chosen // count, np.take_along_axis(u, chosen[..., None], axis=-1)[..., 0]


def _read(pieces: Pieces, place: tuple[Any, Floats]) -> tuple[Array, Array]:
    """Value (..., D) of axis d at place d (or of all axes at the one place), and the time."""
    segment, u = place
    powers, segments, _ = pieces.coefficients.shape[-3:]
    chosen = (segment[..., None, None, :] == np.arange(segments)[:, None]).astype(
        np.float64
    )  # (..., 1, S, D or 1)
    basis = chosen * u[..., None, None, :] ** np.arange(powers)[:, None, None]
    xp, coefficients = pieces.namespace, pieces.coefficients
    values = xp.sum(xp.sum(like(xp, basis, coefficients) * coefficients, axis=-2), axis=-2)
    starts, rates = to_numpy(pieces.starts), to_numpy(pieces.rates)
    spans = np.where(rates > 0, 1.0 / np.where(rates > 0, rates, 1.0), 0.0)
    shape = (*segment.shape[:-1], segments)
    start = np.take_along_axis(np.broadcast_to(starts, shape), segment, axis=-1)
    span = np.take_along_axis(np.broadcast_to(spans, shape), segment, axis=-1)
    time = np.minimum(start + u * span, to_numpy(pieces.end))  # rounding must not lead past the end
    return values, like(xp, time, coefficients)
