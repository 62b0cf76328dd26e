"""Constant tables of the polynomial segment of order m (2 acceleration, 3 jerk, 4 snap), computed exactly.

A segment is a polynomial of degree 2 m - 1 in unit time u = (t - t_k) / h. Its data are, in this order,

    s = (x0, V0_1, ..., V0_(m-1), D, V1_1, ..., V1_(m-1)),   V_i = h^i x^(i),   D = x1 - x0,        (1)

with the step D instead of x1, so that a distant origin costs no accuracy.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from math import comb, factorial, perm, sqrt
from typing import Any, TypeAlias

import numpy as np

from .array_api import Floats

Table: TypeAlias = tuple[tuple[float, ...], ...]

ORDERS = (2, 3, 4)


@cache
def coefficient_table(order: int) -> Floats:
    """Return the matrix that maps s of Eq. 1 to the coefficients of 1, u, ..., u^(2m-1)."""
    return np.asarray(_coefficients(order), dtype=float)


@cache
def mode_table(order: int) -> Table:
    """Return the matrix P that maps s of Eq. 1, without x0, to the Legendre modes of the m-th derivative.

    Columns: D, V0_1, ..., V0_(m-1), V1_1, ..., V1_(m-1). The modes q_i = integral over [0, 1] of x^(m) P_i(2 u - 1)
    are whole multiples of the data, so that modes that vanish do so without rounding.
    """
    return _floats(_modes(order))


@cache
def series_table(order: int) -> Table:
    """Return the matrix that maps the modes q to the coefficients of u^m, ..., u^(2m-1).

    It follows from x^(m) = sum_i (2 i + 1) q_i P_i(2 u - 1), P_i(2 u - 1) = sum_k (-1)^(i+k) C(i, k) C(i + k, k) u^k.
    """
    table = np.full((order, order), Fraction(0))
    for i in range(order):
        for k in range(i + 1):
            legendre = (-1) ** (i + k) * comb(i, k) * comb(i + k, k)
            table[k, i] = Fraction((2 * i + 1) * legendre * factorial(k), factorial(order + k))
    return _floats(table)


@cache
def stiffness_table(order: int) -> Table:
    """Return the matrix W = P^T diag(2 i + 1) P of the cost 1/2 s^T W s / h^(2m-1) of a segment.

    Its rows and columns are the columns of `mode_table`. For m = 3 the entries are 720, 360, 192, 168, 60, ...
    """
    modes = _modes(order)
    weights = np.arange(1, 2 * order, 2)[:, None]
    return _floats(modes.T @ (weights * modes))


@cache
def energy_table(order: int, nu: int) -> Floats:
    """Return L with |L c|^2 = integral over [0, 1] of the squared nu-th derivative, c the coefficients of u^nu, ...

    Its rows are the components along the orthonormal shifted Legendre polynomials, so that a cost is a sum of
    squares, without cancellation.
    """
    table = []
    for i, row in enumerate(_moments(order, nu)):
        norm = sqrt((2 * i + 1) * row[i] ** 2)
        table.append(norm * (row / row[i]).astype(float))
    return np.array(table)


@cache
def derivative_factors(order: int, nu: int) -> Floats:
    """Return the column of factors k! / (k - nu)! of the nu-th derivative of u^k, k = nu ... 2m-1."""
    return np.array([[float(perm(k, nu))] for k in range(nu, 2 * order)])


def _coefficients(order: int) -> Any:
    """Return the coefficients of the two-point Taylor interpolation, exactly.

    With b_i(u) = u^i / i! (1 - u)^m sum_(k < m-i) C(m - 1 + k, k) u^k it is (Davis 1975, Interpolation and
    Approximation)

        x(u) = x0 + sum_(0 < i < m) V0_i b_i(u) + D b_0(1 - u) + sum_(0 < i < m) (-1)^i V1_i b_i(1 - u).   (4)
    """
    m = order
    table = np.full((2 * m, 2 * m), Fraction(0))
    for i in range(m):
        for k in range(m - i):
            weight = Fraction(comb(m - 1 + k, k), factorial(i))
            for n in range(m + 1):
                table[i + k + n, i] += weight * comb(m, n) * (-1) ** n
            for n in range(i + k + 1):
                table[m + n, m + i] += weight * comb(i + k, n) * (-1) ** (n + i)
    table[:, 0] = Fraction(0)  # D instead of x1: x0 moves the whole segment
    table[0, 0] = Fraction(1)
    return table


def _moments(order: int, nu: int) -> Any:
    """Return the integrals over [0, 1] of the nu-th derivative of u^(nu+j) times P_i(2 u - 1), by rows i.

    The integral of u^j P_i(2 u - 1) is j!^2 / ((j - i)! (j + i + 1)!), and 0 for j < i.
    """
    size = 2 * order - nu
    table = np.full((size, size), Fraction(0))
    for i in range(size):
        for j in range(i, size):
            integral = Fraction(factorial(j) ** 2, factorial(j - i) * factorial(j + i + 1))
            table[i, j] = perm(j + nu, nu) * integral
    return table


def _modes(order: int) -> Any:
    """Return the table of `mode_table`, exactly."""
    columns = [order, *range(1, order), *range(order + 1, 2 * order)]
    return _moments(order, order) @ _coefficients(order)[order:, columns]


def _floats(table: Any) -> Table:
    """Return a table of fractions as Python floats."""
    return tuple(map(tuple, table.astype(float).tolist()))
