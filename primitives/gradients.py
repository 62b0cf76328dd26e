"""Closed-form derivatives of the least cost, from the higher derivatives at the knots."""

from __future__ import annotations

from dataclasses import dataclass

from ._passage_newton import duration_gradient
from .array_api import Array
from .trajectory import Trajectory, derivative_coefficients, require_trajectory


@dataclass(frozen=True)
class CostGradient:
    """Derivatives of Trajectory.cost() with respect to waypoints, durations and boundary values.

    Attributes:
        waypoints: (..., S + 1, D) with respect to start, via-points and goal. At a via-point it is minus
            Flash & Hogan's multiplier pi. A dropped via-point and its neighbour share the derivative of the
            point they have in common.
        durations: (..., S) with respect to each segment's duration; equal for all segments at free passage
            times, and then also the derivative with respect to the total duration (-5 cost / duration from
            rest to rest, order 3).
        start_velocity, goal_velocity: (..., D) with respect to the boundary velocities; zero where FREE.
        start_acceleration, goal_acceleration: (..., D) likewise (zero for order 2).

    Example:
        >>> from viapoint.primitives import cost_gradient, point_to_point
        >>> gradient = cost_gradient(point_to_point([0.0], [1.0], 1.0))
        >>> gradient.waypoints.tolist(), gradient.durations.tolist()  # the cost is 360 A^2 / T^5
        ([[-720.0], [720.0]], [-1800.0])
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
    via-point the jump of (-1)^(m-1) x^(2m-1), left minus right. By the envelope theorem they hold for the
    optimum over everything that was left open: the states at the via-points, and the passage times if the
    segment durations came from `passage_durations`.

    Raises:
        ValueError: the argument is not a Trajectory.

    Example:
        >>> from viapoint.primitives import cost_gradient, through
        >>> movement = through([[0.0, 0.0], [0.5, 0.2], [1.0, 0.0]], [0.5, 0.5])
        >>> cost_gradient(movement).waypoints[1].round(6).tolist()  # -pi: only across the line
        [0.0, 4096.0]
    """
    require_trajectory(trajectory)
    xp, m = trajectory.namespace, trajectory.order
    coefficients, rates = trajectory.coefficients, trajectory.rates
    highest = derivative_coefficients(xp, coefficients, rates, 2 * m - 1)[..., 0, :, :] * (-1.0) ** (m - 1)
    rows = [-highest[..., :1, :], highest[..., :-1, :] - highest[..., 1:, :], highest[..., -1:, :]]
    ends = []
    for i in (1, 2):
        if i >= m:
            ends += [0.0 * highest[..., 0, :]] * 2
            continue
        sign = (-1.0) ** (m - 1 - i)
        derivative = derivative_coefficients(xp, coefficients, rates, 2 * m - 1 - i)
        ends.append(-sign * derivative[..., 0, 0, :])  # at the beginning of the first segment, u = 0
        ends.append(sign * derivative[..., -1, :].sum(-2))  # at the end of the last one, u = 1
    return CostGradient(xp.concat(rows, axis=-2), duration_gradient(coefficients, rates), *ends)
