"""Closed-form derivatives of the cost, read from the higher derivatives at the knots.

By the envelope theorem they hold for the optimum over everything that was left open: the states at the
via-points, and the passage times if the segment durations came from `passage_durations`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

from .array_api import Array
from .trajectory import Trajectory, require_trajectory


@dataclass(frozen=True)
class CostGradient:
    """Derivatives of Trajectory.cost().

    Attributes:
        waypoints: (..., S + 1, D) with respect to start, via-points and goal. At a via-point it is minus
            Flash & Hogan's multiplier pi. A dropped via-point and its neighbour share the derivative of the
            point they have in common.
        durations: (..., S) with respect to each segment's duration; equal for all segments at free passage
            times, and then also the derivative with respect to the total duration (-5 cost / duration from
            rest to rest, order 3).
        start_velocity, goal_velocity: (..., D) with respect to the boundary velocities; zero where FREE.
        start_acceleration, goal_acceleration: (..., D) likewise (zero for order 2).
    """

    waypoints: Array
    durations: Array
    start_velocity: Array
    goal_velocity: Array
    start_acceleration: Array
    goal_acceleration: Array


def cost_gradient(trajectory: Trajectory) -> CostGradient:
    """Return all derivatives of the least cost.

    For order m, dJ/dx^(i)(T) = (-1)^(m-1-i) x^(2m-1-i)(T) at the goal, the opposite at the start, and at a
    via-point the jump of (-1)^(m-1) x^(2m-1), left minus right.
    """
    require_trajectory(trajectory)
    xp, m = trajectory.namespace, trajectory.order
    sign = (-1.0) ** (m - 1)
    highest = _segment_derivative(trajectory, 2 * m - 1, at_end=False) * sign
    rows = [-highest[..., :1, :], highest[..., :-1, :] - highest[..., 1:, :], highest[..., -1:, :]]
    ends = []
    for i in (1, 2):
        if i >= m:
            ends += [0.0 * highest[..., 0, :]] * 2
            continue
        sign = (-1.0) ** (m - 1 - i)
        ends.append(-sign * _segment_derivative(trajectory, 2 * m - 1 - i, at_end=False)[..., 0, :])
        ends.append(sign * _segment_derivative(trajectory, 2 * m - 1 - i, at_end=True)[..., -1, :])
    durations = duration_gradient(trajectory.coefficients, trajectory.rates)
    return CostGradient(xp.concat(rows, axis=-2), durations, *ends)


def duration_gradient(coefficients: Array, rates: Array) -> Array:
    """Return dJ/dh of each segment, which is minus its Hamiltonian (Flash & Hogan's Eqs. C6, C7).

    For order m, dJ/dh = -1/2 |x^(m)|^2 - sum_{i=1}^{m-1} (-1)^i x^(m+i) . x^(m-i), the same at every instant
    of a segment; for jerk it is -|jerk|^2/2 + snap . acceleration - crackle . velocity.

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
    power = square
    for _ in range(order - 1):
        power = power * square
    return -total * power


def _segment_derivative(trajectory: Trajectory, nu: int, *, at_end: bool) -> Array:
    """Return the nu-th derivative of each segment at its own beginning or end, (..., S, D)."""
    power = trajectory.rates
    for _ in range(nu - 1):
        power = power * trajectory.rates
    total: Any = 0.0
    for k in range(nu, 2 * trajectory.order if at_end else nu + 1):
        total = total + factorial(k) / factorial(k - nu) * trajectory.coefficients[..., k, :, :]
    return total * power[..., None]
