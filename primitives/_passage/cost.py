"""Reduced jerk cost of movements through given points, as a function of the segment durations h alone.

With the states at the via-points eliminated, J(h) is the least sum of the segments' costs phi (Eq. 1 of
`_weighted_solver`). By the envelope theorem dJ/dh is the derivative of phi at fixed states: with r = q / h^2,

    h phi_h = sum_i w_i (r_i . p_i + 1/2 e_i |r_i|^2),   p = h dr/dh,   e = h w'(h) / w.             (1)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._hermite_tables import mode_table
from .._weighted_solver import fit_modes, mode_weights
from ..array_api import FREE, Array, Floats, ordered_sum


@dataclass(frozen=True)
class PassageCost:
    """Cost of N movements whose passage times are sought, in unit total time; movements are the last axis.

    Attributes:
        steps: (S, D, N) differences of the waypoints.
        start, goal: velocity and acceleration in unit time: (D, N), None for zero, FREE (goal only).
        slack: (N,) tolerance of the waypoints, see `_weighted_solver`.
    """

    steps: Floats
    start: list[Any]
    goal: list[Any]
    slack: Floats

    @classmethod
    def from_points(cls, points: Floats, ends: Sequence[Any], slack: Floats) -> PassageCost:
        """Return the cost of movements through points (N, S + 1, D) with four boundary values (N, D)."""
        rows = [np.ascontiguousarray(v.T) if isinstance(v, np.ndarray) else v for v in ends]
        steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
        return cls(steps, rows[:2], rows[2:], slack)

    def chosen(self, items: Any) -> PassageCost:
        """Return the movements `items`, in that order."""
        start, goal = (
            [value[:, items] if isinstance(value, np.ndarray) else value for value in end]
            for end in (self.start, self.goal)
        )
        return PassageCost(self.steps[..., items], start, goal, self.slack[items])

    def reference(self) -> Floats:
        """Return (N,) a cost far below that of any real movement of this size, to keep logarithms finite."""
        total = ordered_sum(ordered_sum(self.steps * self.steps, -2))
        for value in (*self.start, *self.goal):
            if isinstance(value, np.ndarray):
                total = total + ordered_sum(value * value)
        return 1e-3 * np.where(total > 0, total, 1.0)

    def derivatives(self, h: Floats) -> tuple[Floats, Floats]:
        """Return J (N,) and h dJ/dh (S, N) at durations h (S, N)."""
        states = [self.start, *([FREE, FREE] for _ in range(len(h) - 1)), self.goal]
        solved, fitted = fit_modes(np, 3, h, self.steps, states, self.slack)
        weights = mode_weights(3, h, self.slack)
        # The weights are inverse durations, but that of the step, which the slack bounds.
        rates = [-1.0, -1.0, 4.0 - weights[2] * h]
        mean = self.steps / h[:, None]
        velocity = np.stack([0.0 * mean[0] if state[0] is None else state[0] for state in solved])
        total, slope = np.zeros_like(h), np.zeros_like(h)
        for i, (row, weight, rate) in enumerate(zip(mode_table(3), weights, rates, strict=True)):
            mode = np.stack([modes[i] for modes in fitted])
            square = ordered_sum(mode * mode, 1)
            # p of Eq. 1: r depends on h by its step and its velocities.
            change = -(2.0 * row[0] * mean + row[1] * velocity[:-1] + row[3] * velocity[1:]) / h[:, None]
            slope += weight * (ordered_sum(mode * change, 1) + 0.5 * rate * square)
            total += 0.5 * weight * square
        return ordered_sum(total), slope


def duration_gradient(coefficients: Array, rates: Array) -> Array:
    """Return dJ/dh of each segment, (..., S), minus its Hamiltonian (Flash & Hogan 1985, Eqs. C6, C7).

    For order m, dJ/dh = -1/2 |x^(m)|^2 - sum_{i=1}^{m-1} (-1)^i x^(m+i) . x^(m-i), constant along a segment; for jerk
    it is -|jerk|^2/2 + snap . acceleration - crackle . velocity. Coefficients are (..., 2m, S, D) in unit time.
    """
    order = coefficients.shape[-3] // 2
    total: Any = 0.0
    for i in range(order):  # at the beginning of the segment, where x^(k) = k! c_k / h^k
        weight = (0.5 if i == 0 else (-1.0) ** i) * math.factorial(order + i) * math.factorial(order - i)
        product = coefficients[..., order + i, :, :] * coefficients[..., order - i, :, :]
        total = total + weight * product.sum(-1)
    return -total * math.prod([rates * rates] * order)
