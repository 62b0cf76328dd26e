"""Constant tables of the polynomial segment of order m (2 acceleration, 3 jerk, 4 snap), computed exactly.

A segment is a polynomial of degree 2 m - 1 in unit time u = (t - t_k) / h. Its data are, in this order,

    s = (x0, V0_1, ..., V0_(m-1), D, V1_1, ..., V1_(m-1)),   V_i = h^i x^(i),   D = x1 - x0,

with the step D instead of x1, so that a far origin costs no accuracy.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from math import factorial, perm, sqrt
from typing import TypeAlias

Table: TypeAlias = tuple[tuple[float, ...], ...]
Exact: TypeAlias = list[list[Fraction]]

ORDERS = (2, 3, 4)


@cache
def coefficient_table(order: int) -> Table:
    """Return the matrix that maps s to the coefficients of 1, u, ..., u^(2m-1)."""
    return _floats(_coefficients(order))


@cache
def stiffness_table(order: int) -> Table:
    """Return the matrix W of the cost 1/2 s^T W s / h^(2m-1) of a segment, without row and column of x0.

    Rows and columns: D, V0_1, ..., V0_(m-1), V1_1, ..., V1_(m-1). For m = 3 it holds 720, 360, 192, 168, 60,
        ...
    """
    places = [order, *range(1, order), *range(order + 1, 2 * order)]
    upper = [[row[place] for place in places] for row in _coefficients(order)[order:]]
    gram = _gram(order, order)
    size = 2 * order - 1
    return _floats(
        [
            [
                sum(
                    (upper[k][i] * gram[k][j] * upper[j][n] for k in range(order) for j in range(order)),
                    Fraction(),
                )
                for n in range(size)
            ]
            for i in range(size)
        ]
    )


@cache
def energy_table(order: int, nu: int) -> Table:
    """Return L with |L c|^2 = integral over [0, 1] of the squared nu-th derivative.

    It is the transposed Cholesky factor of the Gram matrix (scaled shifted Legendre polynomials), so a cost
    is a sum of squares and loses nothing by cancellation.
    """
    gram = _gram(order, nu)
    size = len(gram)
    lower = [[Fraction()] * size for _ in range(size)]
    pivots: list[Fraction] = []
    for j in range(size):
        pivots.append(gram[j][j] - sum((lower[j][k] ** 2 * pivots[k] for k in range(j)), Fraction()))
        for i in range(j, size):
            rest = sum((lower[i][k] * lower[j][k] * pivots[k] for k in range(j)), Fraction())
            lower[i][j] = (gram[i][j] - rest) / pivots[j]
    return tuple(tuple(sqrt(pivots[j]) * float(lower[i][j]) for i in range(size)) for j in range(size))


@cache
def derivative_factors(order: int, nu: int) -> Table:
    """Return the column of factors k! / (k - nu)! that the nu-th derivative puts on u^k, k = nu ... 2m-1."""
    return tuple((float(perm(k, nu)),) for k in range(nu, 2 * order))


def _gram(order: int, nu: int) -> Exact:
    powers = range(nu, 2 * order)
    return [[Fraction(perm(k, nu) * perm(j, nu), k + j - 2 * nu + 1) for j in powers] for k in powers]


def _coefficients(order: int) -> Exact:
    size = 2 * order
    rows = [[Fraction(int(k == j), factorial(k)) for j in range(size)] for k in range(order)]
    # The upper coefficients c_k solve sum_k c_k k!/(k-i)! = V1_i - (what the lower ones give), i = 0 ... m-1.
    right = []
    for i in range(order):
        target = [Fraction(int(j == order + i)) for j in range(size)]
        for k in range(max(i, 1), order):  # x0 itself drops out, since D = x1 - x0
            target[k] -= Fraction(perm(k, i), factorial(k))
        right.append(target)
    left = [[Fraction(perm(k, i)) for k in range(order, size)] for i in range(order)]
    return rows + _solve(left, right)


def _solve(left: Exact, right: Exact) -> Exact:
    size = len(left)
    work = [a + b for a, b in zip(left, right, strict=True)]
    for j in range(size):
        pivot = next(i for i in range(j, size) if work[i][j])
        work[j], work[pivot] = work[pivot], work[j]
        work[j] = [value / work[j][j] for value in work[j]]
        for i in range(size):
            if i != j:
                work[i] = [a - work[i][j] * b for a, b in zip(work[i], work[j], strict=True)]
    return [row[size:] for row in work]


def _floats(table: Exact) -> Table:
    return tuple(tuple(float(value) for value in row) for row in table)
