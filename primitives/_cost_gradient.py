"""Closed-form derivatives of the cost of a least-cost trajectory, by the values of its higher derivatives at the knots."""

from __future__ import annotations

from math import factorial
from typing import Any

from ._arrays import Array


def duration_gradient(coefficients: Array, rates: Array) -> Array:
    """dJ/dh of each segment with its end states held, which is minus its Hamiltonian.

    For order m, dJ/dh = -1/2 |x^(m)|^2 - sum_{i=1}^{m-1} (-1)^i x^(m+i) . x^(m-i), the same at every instant of a segment;
    for jerk -|jerk|^2/2 + snap . acceleration - crackle . velocity. With the states at their best it is also the derivative
    of the whole cost (envelope theorem).

    Args:
        coefficients: (..., 2m, S, D) in unit time.
        rates: (..., S) 1 / h.

    Returns:
        (..., S) [cost / s].
    """
    order = coefficients.shape[-3] // 2
    total: Any = 0.0
    for i in range(order):
        weight = (0.5 if i == 0 else (-1.0) ** i) * factorial(order + i) * factorial(order - i)
        total = total + weight * (
            coefficients[..., order + i, :, :] * coefficients[..., order - i, :, :]
        ).sum(-1)
    square = rates * rates
    for _ in range(order - 1):
        square = square * rates * rates
    return -total * square


def point_forces(coefficients: Array, rates: Array) -> list[Array]:
    """(-1)^(m+1) x^(2m-1) of each segment, (..., D) each: for jerk the crackle, which is constant in a segment [m/s^5]."""
    order = coefficients.shape[-3] // 2
    power = rates
    for _ in range(2 * order - 2):
        power = power * rates
    force = (-1.0) ** (order + 1) * factorial(2 * order - 1) * coefficients[..., -1, :, :] * power[..., None]
    return [force[..., s, :] for s in range(force.shape[-2])]
