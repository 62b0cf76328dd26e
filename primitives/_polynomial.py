"""Batched polynomials in unit time: products, derivatives, values, and all real roots in [0, 1].

Coefficients are the last axis, lowest power first, in NumPy float64. Each polynomial is computed by itself,
so results do not depend on the batch.
"""

from __future__ import annotations

from functools import cache
from math import comb
from typing import Any

import numpy as np

from .array_api import Floats

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
