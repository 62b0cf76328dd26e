"""Reduced jerk cost of movements through given points, as a function of the segment durations h alone.

phi_s is the cost of segment s with the data s = (D, V0, A0, V1, A1) in unit time. The jerk has three Legendre
modes q = P s, so

    phi_s = 1/2 h^-5 sum_i w_i |q_i|^2,   w = (1, 3, 5).                                            (1)

With the states y at the via-points eliminated, J(h) = min_y sum_s phi_s(y, h_s) has the derivatives

    dJ/dh = phi_h                            (envelope theorem),                                    (2)
    d2J/dh2 = phi_hh - phi_hy phi_yy^-1 phi_yh   (Schur complement),                                (3)

where phi_yy is the banded matrix A of `_knot_solver`. Since V = v h and A = a h^2, h d/dh acts on s as the
diagonal matrix E of the degrees (0, 1, 2, 1, 2): h dq/dh = P E s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._knot_solver import Nodes, States, solve_states
from ..array_api import FREE, Array, Floats, ordered_sum

_MODES: tuple[dict[int, float], ...] = (
    {2: -1.0, 4: 1.0},
    {1: 2.0, 2: 1.0, 3: -2.0, 4: 1.0},
    {0: 12.0, 1: -6.0, 2: -1.0, 3: -6.0, 4: 1.0},
)
"""P, by rows of the nonzero entries: Legendre modes of the jerk in unit time."""

_WEIGHTS = (1.0, 3.0, 5.0)
"""w of Eq. 1. P has whole numbers as entries, so that modes that vanish do so without rounding."""

_DEGREES = (0, 1, 2, 1, 2)
"""E: the power of h in each entry of s."""


@dataclass(frozen=True)
class PassageCost:
    """Cost of N movements whose passage times are sought, in unit total time; movements are the last axis.

    Attributes:
        steps: (S, D, N) differences of the waypoints.
        start, goal: velocity and acceleration in unit time: (D, N), None for zero, FREE (goal only).
    """

    steps: Floats
    start: list[Any]
    goal: list[Any]

    @classmethod
    def from_points(cls, points: Floats, ends: Sequence[Any]) -> PassageCost:
        """Return the cost of movements through points (N, S + 1, D) with four boundary values (N, D)."""
        rows = [np.ascontiguousarray(v.T) if isinstance(v, np.ndarray) else v for v in ends]
        steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
        return cls(steps, rows[:2], rows[2:])

    def chosen(self, items: Any, dtype: Any = None) -> PassageCost:
        """Return the movements `items`, in that order, optionally in another precision."""

        def pick(value: Any) -> Any:
            if not isinstance(value, np.ndarray):
                return value
            return value[..., items].astype(dtype or value.dtype, copy=False)

        return PassageCost(pick(self.steps), *([pick(v) for v in end] for end in (self.start, self.goal)))

    def reference(self) -> Floats:
        """Return (N,) a cost far below that of any real movement of this size, to keep logarithms finite."""
        total = ordered_sum(ordered_sum(self.steps * self.steps, -2))
        for value in (*self.start, *self.goal):
            if isinstance(value, np.ndarray):
                total = total + ordered_sum(value * value)
        return 1e-3 * np.where(total > 0, total, 1.0)

    def derivatives(self, h: Floats) -> tuple[Floats, Floats, Floats]:
        """Return J (N,), dJ/dh (S, N) and d2J/dh2 (S, S, N) at durations h (S, N)."""
        segments = len(h)
        states: States = [self.start, *([FREE, FREE] for _ in range(segments - 1)), self.goal]
        states, nodes, factor = solve_states(3, list(h), list(self.steps), states)
        modes = [_modes(self._data(h, states), degree) for degree in range(3)]
        j, first, second = _segment_derivatives(h, *modes)
        hessian = np.zeros((segments, *h.shape), dtype=h.dtype)
        if nodes:
            rows = _mixed_derivatives(h, modes[0], modes[1])
            for node, column in zip(nodes, factor.solve(self._mixed_columns(rows, nodes)), strict=True):
                for s, place in _neighbours(node, segments):
                    hessian[s] -= ordered_sum(rows[place][s] * column, -2)  # Eq. 3
        for s in range(segments):
            hessian[s, s] += second[s]
        return j, first, hessian

    def _data(self, h: Floats, states: States) -> list[Floats]:
        """Return s = (D, V0, A0, V1, A1), each (S, D, N)."""
        zero = np.zeros(self.steps.shape[1:], dtype=h.dtype)
        velocity, acceleration = (
            np.stack([zero if state[i] is None else state[i] for state in states]) for i in range(2)
        )
        h = h[:, None]
        square = h * h
        ends = [
            v * f
            for k in (slice(-1), slice(1, None))
            for v, f in ((velocity[k], h), (acceleration[k], square))
        ]
        return [self.steps, *ends]

    def _mixed_columns(self, rows: dict[int, Floats], nodes: Nodes) -> list[Floats]:
        """Return phi_yh, (S, D, N) for every unknown: nonzero for the two segments at its knot."""
        columns = []
        for node in nodes:
            column = np.zeros_like(self.steps)
            for s, place in _neighbours(node, len(column)):
                column[s] = rows[place][s]
            columns.append(column)
        return columns


def _neighbours(node: tuple[int, int], segments: int) -> list[tuple[int, int]]:
    """Return the segments at knot k and the place of derivative i in their data s, for node (k, i)."""
    k, i = node
    return [(s, place) for s, place in ((k - 1, 3 + i), (k, 1 + i)) if 0 <= s < segments]


def _modes(data: list[Floats], degree: int) -> list[Floats]:
    """Return P E^degree s, the modes after `degree` applications of h d/dh."""
    modes = []
    for row in _MODES:
        terms = [(w * _DEGREES[n] ** degree) * data[n] for n, w in row.items() if _DEGREES[n] or not degree]
        modes.append(ordered_sum(terms))
    return modes


def _segment_derivatives(
    h: Floats, q0: list[Floats], q1: list[Floats], q2: list[Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return J (N,) and the first two derivatives (S, N) of phi_s with respect to h_s at fixed states.

    From Eq. 1 with q1 = h dq/dh and q2 = (h d/dh)^2 q,

        h phi_h = h^-5 (q.q1 - 5/2 q.q),   h^2 phi_hh = h^-5 (q1.q1 + q.q2 - 11 q.q1 + 15 q.q).
    """
    zero, one = _product(q0, q0), _product(q0, q1)
    curve = _product(q1, q1) + _product(q0, q2)
    inverse = 1.0 / h
    fifth = math.prod([inverse] * 4, start=inverse)
    phi = 0.5 * fifth * zero
    first = fifth * inverse * (one - 2.5 * zero)
    second = fifth * inverse * inverse * (curve - 11.0 * one + 15.0 * zero)
    return ordered_sum(phi), first, second


def _mixed_derivatives(h: Floats, q0: list[Floats], q1: list[Floats]) -> dict[int, Floats]:
    """Return d2 phi_s / dh dy (S, D, N) for the places 1 to 4 of s.

    For an entry of degree e, dq/dy = h^e P column, so it is h^(e - 6) sum_i w_i P_i (q1_i + (e - 5) q_i).
    """
    inverse = (1.0 / h)[:, None]
    fourth = math.prod([inverse] * 3, start=inverse)
    rows: dict[int, Floats] = {}
    for place in (1, 2, 3, 4):
        degree = _DEGREES[place]
        terms = [
            (weight * row[place]) * (one + (degree - 5.0) * zero)
            for weight, row, zero, one in zip(_WEIGHTS, _MODES, q0, q1, strict=True)
            if place in row
        ]
        rows[place] = (fourth * inverse if degree == 1 else fourth) * ordered_sum(terms)
    return rows


def _product(p: list[Floats], q: list[Floats]) -> Floats:
    """Return the weighted scalar product sum_i w_i p_i . q_i over modes and dimensions, (S, N)."""
    terms = [w * ordered_sum(x * y, -2) for w, x, y in zip(_WEIGHTS, p, q, strict=True)]
    total: Floats = ordered_sum(terms)
    return total


def duration_gradient(coefficients: Array, rates: Array) -> Array:
    """Return dJ/dh of each segment, which is minus its Hamiltonian (Flash & Hogan 1985, Eqs. C6, C7).

    For order m, dJ/dh = -1/2 |x^(m)|^2 - sum_{i=1}^{m-1} (-1)^i x^(m+i) . x^(m-i), constant along a segment;
    for jerk it is -|jerk|^2/2 + snap . acceleration - crackle . velocity.

    Args:
        coefficients: (..., 2m, S, D) in unit time.
        rates: (..., S) 1 / h.

    Returns:
        (..., S) [cost / s].
    """
    order = coefficients.shape[-3] // 2
    total: Any = 0.0
    for i in range(order):  # at the beginning of the segment, where x^(k) = k! c_k / h^k
        weight = (0.5 if i == 0 else (-1.0) ** i) * math.factorial(order + i) * math.factorial(order - i)
        product = coefficients[..., order + i, :, :] * coefficients[..., order - i, :, :]
        total = total + weight * product.sum(-1)
    return -total * math.prod([rates * rates] * order)
