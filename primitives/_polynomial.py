"""Polynomials in unit time: products, derivatives, values, real roots in [0, 1], and constant tables of segments.

Coefficients of batched polynomials are the last axis, lowest power first, in NumPy float64. Each polynomial is computed
by itself, so results do not depend on the batch.

A segment of order m (2 acceleration, 3 jerk, 4 snap) is a polynomial of degree 2 m - 1 in unit time
u = (t - t_k) / h. Its data are, in this order,

    s = (x0, V0_1, ..., V0_(m-1), D, V1_1, ..., V1_(m-1)),   V_i = h^i x^(i),   D = x1 - x0,        (1)

with the step D instead of x1, so that a distant origin costs no accuracy. The tables map s to coefficients and costs.
"""

from __future__ import annotations

from functools import cache
from math import comb, factorial, perm
from typing import TypeAlias

import numpy as np

from .array_api import Floats

Table: TypeAlias = list[list[float]]  # Python floats, which every array library multiplies by

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


@cache
def coefficient_table(order: int) -> Floats:
    """Return the matrix that maps s of Eq. 1 to the coefficients of 1, u, ..., u^(2m-1)."""
    data = np.zeros((2 * order, 2 * order))  # from the coefficients to s
    for i in range(order):
        data[i, i] = factorial(i)
        for k in range(i, 2 * order):
            data[order + i, k] = perm(k, i)
    data[order, 0] = 0.0  # D instead of x1: x0 moves the whole segment
    # The entries of the inverse are whole multiples of 1 / (m - 1)!, which takes the rounding away.
    unit = factorial(order - 1)
    table: Floats = np.round(unit * np.linalg.inv(data)) / unit + 0.0
    return table


def _moments(order: int, nu: int) -> Floats:
    """Return the integrals over [0, 1] of the nu-th derivative of u^(nu+j) times P_i(2 u - 1), by rows i.

    The integral of u^j P_i(2 u - 1) is j!^2 / ((j - i)! (j + i + 1)!), and 0 for j < i.
    """
    size = 2 * order - nu
    table: Floats = np.zeros((size, size))
    for i in range(size):
        for j in range(i, size):
            table[i, j] = perm(j + nu, nu) * factorial(j) ** 2 / (factorial(j - i) * factorial(j + i + 1))
    return table


@cache
def mode_table(order: int) -> Table:
    """Return the matrix P that maps s of Eq. 1, without x0, to the Legendre modes of the m-th derivative.

    Columns: D, V0_1, ..., V0_(m-1), V1_1, ..., V1_(m-1). The modes q_i = integral over [0, 1] of x^(m) P_i(2 u - 1)
    are whole multiples of the data, so that modes that vanish do so without rounding.
    """
    columns = [order, *range(1, order), *range(order + 1, 2 * order)]
    modes = _moments(order, order) @ coefficient_table(order)[order:, columns]
    table: Table = (np.round(modes) + 0.0).tolist()
    return table


@cache
def series_table(order: int) -> Table:
    """Return the matrix that maps the modes q to the coefficients of u^m, ..., u^(2m-1).

    It follows from x^(m) = sum_i (2 i + 1) q_i P_i(2 u - 1), P_i(2 u - 1) = sum_k (-1)^(i+k) C(i, k) C(i + k, k) u^k.
    """
    table = np.zeros((order, order))
    for i in range(order):
        for k in range(i + 1):
            legendre = (-1) ** (i + k) * comb(i, k) * comb(i + k, k)
            table[k, i] = (2 * i + 1) * legendre * factorial(k) / factorial(order + k)
    rows: Table = table.tolist()
    return rows


@cache
def stiffness_table(order: int) -> Table:
    """Return the matrix W = P^T diag(2 i + 1) P of the cost 1/2 s^T W s / h^(2m-1) of a segment.

    Its rows and columns are the columns of `mode_table`. For m = 3 the entries are 720, 360, 192, 168, 60, ...
    """
    modes = np.array(mode_table(order))
    weights = np.arange(1, 2 * order, 2)[:, None]
    table: Table = (modes.T @ (weights * modes)).tolist()
    return table


@cache
def energy_table(order: int, nu: int) -> Floats:
    """Return L with |L c|^2 = integral over [0, 1] of the squared nu-th derivative, c the coefficients of u^nu, ...

    Its rows are the components along the orthonormal shifted Legendre polynomials, so that a cost is a sum of
    squares, without cancellation.
    """
    moments = _moments(order, nu)
    table: Floats = np.sqrt(np.arange(1, 2 * len(moments), 2))[:, None] * moments
    return table


@cache
def derivative_factors(order: int, nu: int) -> Floats:
    """Return the column of factors k! / (k - nu)! of the nu-th derivative of u^k, k = nu ... 2m-1."""
    return np.array([[float(perm(k, nu))] for k in range(nu, 2 * order)])
