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

Table: TypeAlias = tuple[tuple[float, ...], ...]
Exact: TypeAlias = list[list[Fraction]]

ORDERS = (2, 3, 4)


@cache
def coefficient_table(order: int) -> Table:
    """Return the matrix that maps s of Eq. 1 to the coefficients of 1, u, ..., u^(2m-1)."""
    return _floats(_coefficients(order))


@cache
def stiffness_table(order: int) -> Table:
    """Return the matrix W of the cost 1/2 s^T W s / h^(2m-1) of a segment, without row and column of x0.

    Rows and columns: D, V0_1, ..., V0_(m-1), V1_1, ..., V1_(m-1). For m = 3 the entries are 720, 360, 192, 168,
    60, ... W = U^T G U, with the upper half U of the coefficients and the Gram matrix G of Eq. 2 for nu = m.
    """
    m = order
    columns = [m, *range(1, m), *range(m + 1, 2 * m)]
    upper = np.array(_coefficients(m)[m:])[:, columns]
    size = range(m, 2 * m)
    gram = np.array([[Fraction(perm(k, m) * perm(j, m), k + j - 2 * m + 1) for j in size] for k in size])
    return _floats(upper.T @ gram @ upper)


@cache
def energy_table(order: int, nu: int) -> Table:
    """Return L with |L c|^2 = integral over [0, 1] of the squared nu-th derivative.

    L is the transposed Cholesky factor of the Gram matrix of the derivatives of u^nu, ..., u^(2m-1),

        G_kj = k! / (k - nu)!  j! / (j - nu)! / (k + j - 2 nu + 1).                                 (2)

    Its rows are expansions in orthonormal shifted Legendre polynomials P_i,

        u^j = sum_i (2 i + 1) j!^2 / ((j - i)! (j + i + 1)!) P_i(2 u - 1),                          (3)

    so that a cost is a sum of squares, without cancellation.
    """
    size = range(2 * order - nu)
    # Eq. 3 divided by 2 i + 1: P_i has the squared norm 1 / (2 i + 1).
    modes = [
        [
            perm(j + nu, nu) * Fraction(factorial(j) ** 2, factorial(j - i) * factorial(j + i + 1))
            if j >= i
            else 0
            for j in size
        ]
        for i in size
    ]
    norms = [sqrt((2 * i + 1) * modes[i][i] ** 2) for i in size]
    return tuple(tuple(norms[i] * float(modes[i][j] / modes[i][i]) for j in size) for i in size)


@cache
def derivative_factors(order: int, nu: int) -> Table:
    """Return the column of factors k! / (k - nu)! of the nu-th derivative of u^k, k = nu ... 2m-1."""
    return tuple((float(perm(k, nu)),) for k in range(nu, 2 * order))


def _coefficients(order: int) -> Exact:
    """Return the coefficients of the two-point Taylor interpolation, exactly.

    With b_i(u) = u^i / i! (1 - u)^m sum_(k < m-i) C(m - 1 + k, k) u^k it is (Davis 1975, Interpolation and
    Approximation)

        x(u) = x0 + sum_(0 < i < m) V0_i b_i(u) + D b_0(1 - u) + sum_(0 < i < m) (-1)^i V1_i b_i(1 - u).   (4)
    """
    m = order
    table = [[Fraction(0)] * (2 * m) for _ in range(2 * m)]
    for i in range(m):
        for k in range(m - i):
            weight = Fraction(comb(m - 1 + k, k), factorial(i))
            for n in range(m + 1):
                table[i + k + n][i] += weight * comb(m, n) * (-1) ** n
            for n in range(i + k + 1):
                table[m + n][m + i] += weight * comb(i + k, n) * (-1) ** (n + i)
    for row in table:  # D instead of x1: x0 moves the whole segment
        row[0] = Fraction(0)
    table[0][0] = Fraction(1)
    return table


def _floats(table: Any) -> Table:
    """Return a table of fractions, a list of rows or a NumPy array of objects, as floats."""
    return tuple(tuple(float(value) for value in row) for row in table)
