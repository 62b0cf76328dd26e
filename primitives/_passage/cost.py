"""The jerk cost of the best movement through given points, as a function of the segment durations alone.

With the states y at the via-points eliminated, J(h) = min_y sum_s phi_s(y, h_s). Its gradient is that of phi
at fixed states (envelope theorem), its Hessian the Schur complement phi_hh - phi_hy phi_yy^-1 phi_yh, where
phi_yy is the banded matrix of the linear problem. phi_s = 1/2 h^-5 sum_i w_i |q_i|^2 with the three Legendre
modes of the jerk q = P s of the segment's data s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from .._knot_solver import States, assemble, factorise
from ..array_api import FREE

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

_MODES: tuple[dict[int, float], ...] = (
    {2: -1.0, 4: 1.0},
    {1: 2.0, 2: 1.0, 3: -2.0, 4: 1.0},
    {0: 12.0, 1: -6.0, 2: -1.0, 3: -6.0, 4: 1.0},
)
"""P: the Legendre modes of the jerk in unit time, of the data s = (D, V0, A0, V1, A1)."""

_WEIGHTS = (1.0, 3.0, 5.0)
"""Integral of squared jerk = sum of weight * mode^2; whole numbers, so that modes cancel as they should."""

_DEGREES = (0, 1, 2, 1, 2)
"""The power of h by which each entry of s is scaled."""


@dataclass(frozen=True)
class PassageCost:
    """Movements whose passage times are sought, in unit total time; the movements are the last axis.

    Attributes:
        steps: (S, D, N) differences of the waypoints.
        start, goal: velocity and acceleration in unit time: (D, N), None for zero, FREE (goal only).
    """

    steps: Floats
    start: list[Any]
    goal: list[Any]

    def chosen(self, items: Any) -> PassageCost:
        """Return the movements `items`, in that order."""
        ends = [
            [v[:, items] if isinstance(v, np.ndarray) else v for v in end] for end in (self.start, self.goal)
        ]
        return PassageCost(self.steps[:, :, items], *ends)

    def refined(self, items: Any) -> PassageCost:
        """Return the movements `items` in extended precision, where the machine has one."""
        part = self.chosen(items)
        ends = [
            [v.astype(np.longdouble) if isinstance(v, np.ndarray) else v for v in end]
            for end in (part.start, part.goal)
        ]
        return PassageCost(part.steps.astype(np.longdouble), *ends)

    def scale(self) -> Floats:
        """Return (N,) the squared extent of each movement, 1 where it is zero."""
        total = _total(self.steps * self.steps)
        for value in (*self.start, *self.goal):
            if isinstance(value, np.ndarray):
                total = total + _total((value * value)[None])
        return np.where(total > 0, total, 1.0)

    def derivatives(self, h: Floats) -> tuple[Floats, Floats, Floats]:
        """J (N,), dJ/dh (S, N), d2J/dh2 (S, S, N) at durations h (S, N)."""
        segments = len(h)
        states: States = [self.start, *([FREE, FREE] for _ in range(segments - 1)), self.goal]
        nodes: dict[tuple[int, int], int] = {}
        for k, state in enumerate(states):
            for i, value in enumerate(state):
                if value is FREE:
                    nodes[k, i] = len(nodes)
        factor = None
        if nodes:
            upper, right = assemble(3, list(h), list(self.steps), states, nodes)
            factor = factorise(upper)
            for (k, i), value in zip(nodes, factor.solve(right), strict=True):
                states[k] = [value, states[k][1]] if i == 0 else [states[k][0], value]
        modes = [_apply(self._data(h, states), power) for power in range(3)]
        j, first, second = _segment_derivatives(h, *modes)
        hessian = np.zeros((segments, *h.shape), dtype=h.dtype)
        if factor is not None:
            rows = _mixed_rows(h, modes[0], modes[1])
            right = [self._mixed_column(rows, k, i) for k, i in nodes]
            solved = factor.solve(right)
            for (k, i), column in zip(nodes, solved, strict=True):
                for s, place in ((k - 1, 3 + i), (k, 1 + i)):
                    if 0 <= s < segments:
                        hessian[s] -= _sum_dimensions(rows[place][s] * column)
        for s in range(segments):
            hessian[s, s] += second[s]
        return j, first, hessian

    def _data(self, h: Floats, states: States) -> list[Floats]:
        """S = (D, V0, A0, V1, A1), each (S, D, N)."""
        nothing = np.zeros(self.steps.shape[1:], dtype=h.dtype)
        velocity, acceleration = (
            np.stack([nothing if state[i] is None else state[i] for state in states]) for i in range(2)
        )
        h = h[:, None]
        square = h * h
        return [
            self.steps,
            velocity[:-1] * h,
            acceleration[:-1] * square,
            velocity[1:] * h,
            acceleration[1:] * square,
        ]

    def _mixed_column(self, rows: dict[int, Floats], k: int, i: int) -> Floats:
        """d2 phi / dy dh_s for all s, (S, D, N): only the two segments at the knot count."""
        column = np.zeros_like(self.steps)
        if k > 0:
            column[k - 1] = rows[3 + i][k - 1]
        if k < len(column):
            column[k] = rows[1 + i][k]
        return column


def _apply(data: list[Floats], power: int) -> list[Floats]:
    """P E^power s, with E the degrees: what the modes become when h d/dh acts on s."""
    modes = []
    for row in _MODES:
        total: Any = None
        for place, weight in row.items():
            if power and not _DEGREES[place]:
                continue
            term = (weight * _DEGREES[place] ** power) * data[place]
            total = term if total is None else total + term
        modes.append(total)
    return modes


def _segment_derivatives(
    h: Floats, q0: list[Floats], q1: list[Floats], q2: list[Floats]
) -> tuple[Floats, Floats, Floats]:
    """J (N,) and the first two derivatives (S, N) of phi_s with respect to h_s at fixed states."""
    zero, one = _product(q0, q0), _product(q0, q1)
    curve = _product(q1, q1) + _product(q0, q2)
    inverse = 1.0 / h
    fifth = inverse * inverse * inverse * inverse * inverse
    phi = 0.5 * fifth * zero
    first = fifth * inverse * (one - 2.5 * zero)
    second = fifth * inverse * inverse * (curve - 11.0 * one + 15.0 * zero)
    total = phi[0]
    for row in phi[1:]:
        total = total + row
    return total, first, second


def _mixed_rows(h: Floats, q0: list[Floats], q1: list[Floats]) -> dict[int, Floats]:
    """Return J (N,) and the first two derivatives (S, N) of phi_s by h_s at fixed states."""
    inverse = (1.0 / h)[:, None]
    fourth = inverse * inverse * inverse * inverse
    rows: dict[int, Floats] = {}
    for place in (1, 2, 3, 4):
        degree = _DEGREES[place]
        total: Any = None
        for weight, row, zero, one in zip(_WEIGHTS, _MODES, q0, q1, strict=True):
            if place in row:
                term = (weight * row[place]) * (one + (degree - 5.0) * zero)
                total = term if total is None else total + term
        rows[place] = (fourth * inverse if degree == 1 else fourth) * total
    return rows


def _product(p: list[Floats], q: list[Floats]) -> Floats:
    """Sum over modes and dimensions, (S, N)."""
    total = _sum_dimensions(p[0] * q[0])
    for weight, x, y in zip(_WEIGHTS[1:], p[1:], q[1:], strict=True):
        total = total + weight * _sum_dimensions(x * y)
    return total


def _sum_dimensions(array: Floats) -> Floats:
    """Sum over the axis before the last, in its order."""
    total: Floats = array[..., 0, :]
    for d in range(1, array.shape[-2]):
        total = total + array[..., d, :]
    return total


def _total(array: Floats) -> Floats:
    """Sum over everything but the last axis, in its order."""
    rows = _sum_dimensions(array)
    total: Floats = rows[0]
    for row in rows[1:]:
        total = total + row
    return total
