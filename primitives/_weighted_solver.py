"""Least-cost knot states where durations differ by many orders: weighted least squares by Givens rotations.

The normal equations of `_knot_solver` lose the digits of a long segment beside a short one: their error grows like
the square of the ratio of the durations. Here the cost of a segment stays a sum of squares,

    phi = 1/2 sum_i w_i |r_i|^2,   r_i = q_i / h^(m-1),   w_i = (2 i + 1) / h,                      (1)

with the Legendre modes q = P s of `_polynomial`. Unknowns are eliminated from its rows by rotations without
square roots (Gentleman 1973, Least squares computations by Givens transformations without square roots). Two rows
y + x.z and c y + x'.z, of weights w and w', become

    row 2: (x' - c x).z of weight w w' / W,   row 1: y + (x + t (x' - c x)).z of weight W,          (2)
    W = w + w' c^2,   t = w' c / W,

where only positive numbers are added. Read backwards the same rotations lead from the residuals of the eliminated
rows (zero) and of the remaining ones to those of the given rows,

    r_1 - t r_2,   c r_1 + (w / W) r_2,                                                             (3)

so that the modes, and with them the highest derivatives, do not suffer from the cancellation of a computation
from the states.

Waypoints are known up to the rounding of their coordinates. Without a tolerance this rounding would demand any
jerk from points that all but coincide. Therefore a segment may miss its step by e at the cost e^2 / (2 slack).
That lowers the weight of the only mode in which the step occurs to

    w / (1 + w P_D^2 slack / h^(2m-2)),   w = (2 m - 1) / h,                                        (4)

which changes nothing where durations are not extremely short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any, TypeAlias

import numpy as np

from ._polynomial import mode_table, series_table
from .array_api import FREE, Array, Namespace, change_given

Entry: TypeAlias = Any  # An array or a Python float

Unknown: TypeAlias = tuple[
    int, int
]  # Derivative states[k][i] by (k, i), ordered like the columns of a system

# Tolerance of waypoints, relative to their greatest coordinate.
_ROUNDING = 64.0 * 2.0**-52
# Distances that cost about as much as a velocity, an acceleration and a jerk of 1 at an end, in unit time.
_REACHES = (0.5, 0.1, 0.02)
# Mean velocity of a segment, relative to the speed on the whole path, above which it tells nothing.
_FASTEST = 100.0
# Bound on the tolerance relative to the extent of the movement, for points far from the origin.
_LARGEST_SLACK = 1e-6


@dataclass(eq=False)
class _Row:
    """Weighted residual r = sum_j entries_j y_j + rest."""

    weight: Entry
    entries: dict[Unknown, Entry]
    rest: Array
    residual: Array = None


# Elimination step of Eqs. 2 and 3: both rows, c, w / W and t; or a row whose residual is divided by c, and None
Rotation: TypeAlias = tuple[_Row, _Row | None, Entry, Entry, Entry]


def rounding_slack(points: Any, ends: Sequence[Sequence[Any]]) -> Any:
    """Return the slack (N,) of waypoints (N, S + 1, D) with the derivatives (N, D) at both ends, in unit time."""
    size = np.abs(points - points[:, :1]).max(axis=(1, 2))
    for end in ends:
        for value, reach in zip(end, _REACHES, strict=False):
            if isinstance(value, np.ndarray):
                size = np.maximum(size, reach * np.abs(value).max(axis=1))
    tolerance = _ROUNDING * np.abs(points).max(axis=(1, 2))
    return np.minimum(tolerance / np.where(size > 0, size, np.inf), _LARGEST_SLACK) ** 2


def mode_weights(order: int, length: Entry, slack: Entry) -> list[Entry]:
    """Return the weights w_0 ... w_(m-1) of Eqs. 1 and 4 of a segment."""
    rate = 1.0 / length
    weights = [(2.0 * i + 1.0) * rate for i in range(order)]
    softness = weights[-1] * mode_table(order)[-1][0] ** 2 * slack
    for _ in range(2 * order - 2):
        softness = softness * rate
    weights[-1] = weights[-1] / (1.0 + softness)
    return weights


def fit_modes(
    xp: Namespace, order: int, lengths: Array, steps: Array, states: Any, slack: Array
) -> tuple[Any, list[list[Array]]]:
    """Compute the FREE derivatives at the knots, and the modes r of each segment (Eq. 1), of N movements.

    Durations are (S, N), steps (S, D, N), derivatives at the knots (D, N), None for zero, or FREE; the slack (N,) is
    that of Eq. 4. Returned are the states with every FREE replaced, and r_0 ... r_(m-1) per segment, (D, N) each.
    """
    origins = _origins(xp, lengths, steps, states)
    unknown: list[list[Unknown]] = []
    for k, state in enumerate(states):
        unknown.append([(k, i) for i, value in enumerate(state) if value is FREE])
    rows: list[list[_Row]] = []
    pivots: dict[Unknown, _Row] = {}  # In the order of elimination
    remaining: list[_Row] = []
    rotations: list[Rotation] = []
    for s in range(len(steps)):
        rows.append(_segment_rows(order, s, lengths[s], steps[s], states, origins, slack))
        active = list(rows[-1])
        for column in reversed(unknown[s] if s else []):  # what the segments before say of this knot
            row = pivots.pop(column)
            row.entries[column] = 1.0
            active.insert(0, row)
        for column in unknown[s] + unknown[s + 1]:
            pivots[column] = _eliminate(active, column, rotations)
            active.remove(pivots[column])
        remaining += active
    solved = [list(state) for state in states]
    values: dict[Unknown, Array] = {}
    for column, row in reversed(pivots.items()):
        value = -row.rest
        for other, entry in row.entries.items():
            value = value - entry * values[other]
        values[column] = value
        solved[column[0]][column[1]] = value + origins.get(column, 0.0)
        row.residual = 0.0 * row.rest
    for row in remaining:
        row.residual = row.rest
    for upper, lower, c, share, t in reversed(rotations):
        first = upper.residual
        if lower is None:
            upper.residual = c * first
        else:
            upper.residual = first - t * lower.residual
            lower.residual = c * first + share * lower.residual
    return solved, [[row.residual for row in segment] for segment in rows]


def _origins(xp: Namespace, lengths: Array, steps: Array, states: Any) -> dict[Unknown, Array]:
    """Return the values from which unknown velocities are measured: the mean velocity of the shorter neighbour.

    The velocities at both ends of a short segment are large compared with their difference. A mean that is far
    greater than the speed on the whole path only shows that the segment misses its step.
    """
    means = steps / lengths[:, None]
    speeds = xp.linalg.vector_norm(means, axis=1)
    fastest = _FASTEST * xp.linalg.vector_norm(steps, axis=1).sum(0) / lengths.sum(0)
    means = means * xp.where(speeds > fastest, fastest / xp.where(speeds > 0, speeds, 1.0), 1.0)[:, None]
    origins = {}
    for k, state in enumerate(states):
        if state[0] is FREE:
            left = max(k - 1, 0)
            right = min(k, len(steps) - 1)
            origins[k, 0] = xp.where(lengths[left] < lengths[right], means[left], means[right])
    return origins


def _segment_rows(
    order: int, s: int, length: Array, step: Array, states: Any, origins: dict[Unknown, Array], slack: Array
) -> list[_Row]:
    """Return the rows of the modes r of segment s."""
    rate = 1.0 / length
    powers = [1.0, rate]
    while len(powers) < order:
        powers.append(powers[-1] * rate)
    rows = []
    columns = [(k, i) for k in (s, s + 1) for i in range(order - 1)]
    mean = step / length
    for table, weight in zip(mode_table(order), mode_weights(order, length, slack), strict=True):
        # The step and the velocities are added first: they cancel exactly where all of them are equal.
        row = _Row(weight, {}, table[0] * mean)
        for derivative in range(order - 1):
            for column, factor in zip(columns, table[1:], strict=True):
                value = states[column[0]][column[1]]
                if column[1] != derivative or not factor:
                    continue
                if value is FREE:
                    row.entries[column] = factor * powers[order - 2 - derivative]
                    value = origins.get(column)
                if value is not None:
                    row.rest = row.rest + factor * value
            if derivative < order - 2:
                row.rest = row.rest * rate
        rows.append(row)
    return rows


def _eliminate(rows: list[_Row], column: Unknown, rotations: list[Rotation]) -> _Row:
    """Rotate the rows so that only one of them has an entry in the column, and return it, with 1 there (implied)."""
    pivot, *others = [row for row in rows if column in row.entries]
    own = pivot.entries.pop(column)
    pivot.weight = pivot.weight * own * own
    pivot.entries = {key: entry / own for key, entry in pivot.entries.items()}
    pivot.rest = pivot.rest / own
    rotations.append((pivot, None, own, 1.0, 0.0))
    for other in others:
        c = other.entries.pop(column)
        product = other.weight * c
        weight = pivot.weight + product * c
        share, t = pivot.weight / weight, product / weight
        for key in pivot.entries.keys() | other.entries.keys():
            before = pivot.entries.get(key, 0.0)
            entry = other.entries.get(key, 0.0)
            other.entries[key] = entry - c * before
            pivot.entries[key] = share * before + t * entry
        rest = other.rest
        other.rest = rest - c * pivot.rest
        pivot.rest = share * pivot.rest + t * rest
        other.weight, pivot.weight = other.weight * share, weight
        rotations.append((pivot, other, c, share, t))
    return pivot


def weighted_coefficients(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: Any, slack: Array
) -> Array:
    """Return the coefficients (N, 2m, S, D) of the least-cost trajectories through waypoints (N, S + 1, D).

    The durations are (N, S), the derivatives at the knots (N, D), the slack is (N,).
    """
    lengths = durations.mT
    steps = xp.permute_dims(waypoints[:, 1:] - waypoints[:, :-1], (1, 2, 0))
    turned = [change_given(lambda value: value.mT, state) for state in states]
    solved, modes = fit_modes(xp, order, lengths, steps, turned, slack)
    columns = []
    for s, length in enumerate(lengths):
        # A step that is missed takes its part of the residual: the mode is the rest.
        weight = mode_weights(order, length, slack)[-1]
        modes[s][-1] = modes[s][-1] * (weight * length / (2.0 * order - 1.0))
        power, column = 1.0, [waypoints[:, s].mT]
        for i in range(order - 1):
            power = power * length
            value = 0.0 * steps[s] if solved[s][i] is None else solved[s][i]
            column.append(power / factorial(i + 1) * value)
        for table in series_table(order):
            terms = [factor * mode for factor, mode in zip(table, modes[s], strict=True) if factor]
            column.append(power * sum(terms[1:], start=terms[0]))
        columns.append(xp.stack([value + 0.0 * steps[s] for value in column], axis=0))
    return xp.permute_dims(xp.stack(columns, axis=1), (3, 0, 1, 2))
