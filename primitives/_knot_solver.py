"""Least-cost trajectories through given points at given times: normal equations, and weighted least squares.

With the cost 1/2 sum_s s^T W s / h^(2m-1) of the segments (see `_polynomial`), a zero gradient with
respect to the unknown derivatives y at the knots is

    A y = b,                                                                                        (1)

symmetric, positive definite, with a narrow band: block tridiagonal with blocks of size m - 1. The equations
state that snap and jerk (m = 3) are continuous at the knots, as in Flash & Hogan 1985, Appendix C; position,
velocity and acceleration are so by construction.

All operations work element by element, on arrays or on Python floats where all movements share their
durations. So an item of a batch gives the same bits as alone, which LAPACK does not promise.

The normal equations lose the digits of a long segment beside a short one: their error grows like the square of the
ratio of the durations. Where durations differ by many orders, the cost of a segment stays a sum of squares,

    phi = 1/2 sum_i w_i |r_i|^2,   r_i = q_i / h^(m-1),   w_i = (2 i + 1) / h,                      (2)

with the Legendre modes q = P s of `_polynomial`. Unknowns are eliminated from its rows by rotations without
square roots (Gentleman 1973, Least squares computations by Givens transformations without square roots). Two rows
y + x.z and c y + x'.z, of weights w and w', become

    row 2: (x' - c x).z of weight w w' / W,   row 1: y + (x + t (x' - c x)).z of weight W,          (3)
    W = w + w' c^2,   t = w' c / W,

where only positive numbers are added. Read backwards the same rotations lead from the residuals of the eliminated
rows (zero) and of the remaining ones to those of the given rows,

    r_1 - t r_2,   c r_1 + (w / W) r_2,                                                             (4)

so that the modes, and with them the highest derivatives, do not suffer from the cancellation of a computation
from the states.

Waypoints are known up to the rounding of their coordinates. Without a tolerance this rounding would demand any
jerk from points that all but coincide. Therefore a segment may miss its step by e at the cost e^2 / (2 slack).
That lowers the weight of the only mode in which the step occurs to

    w / (1 + w P_D^2 slack / h^(2m-2)),   w = (2 m - 1) / h,                                        (5)

which changes nothing where durations are not extremely short.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, product, repeat
from math import factorial
from typing import Any, TypeAlias

import numpy as np

from ._polynomial import coefficient_table, energy_table, mode_table, series_table, stiffness_table
from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    broadcast_to,
    change_given,
    change_time_unit,
    flat_batch,
    is_given,
    like,
    ordered_sum,
    to_numpy,
    unit_factors,
)

Entry: TypeAlias = Any  # An array or a Python float

Unknown: TypeAlias = tuple[int, int]  # Derivative states[k][i] by (k, i), in the order of the columns

# states[k][i - 1] = i-th time derivative at knot k: an array, None for zero, FREE for unknown
States: TypeAlias = list[list[Any]]

# Power of the machine epsilon that is the least ratio of two durations of a movement for the normal equations. Their
# relative error is about epsilon times the square of the inverse ratio: below 1e-10, in single precision 1e-4.
_DIGITS = 0.15
# Greatest distance by which a movement may miss a waypoint because of rounding, relative to its extent.
_MISS = 1e-9
# Least relative change of the cost for which the tolerance of waypoints counts.
_GAIN = 1e-8
# Durations [s] between which no power of them over- or underflows, even in single precision; others are scaled.
_SHORT, _LONG = 1e-3, 1e3
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


# Elimination step of Eqs. 3 and 4: both rows, c, w / W and t; or a row whose residual is divided by c, and None
Rotation: TypeAlias = tuple[_Row, _Row | None, Entry, Entry, Entry]


def knot_states(order: int, ends: Iterable[Boundary], vias: int = 0) -> States:
    """Return the m - 1 derivatives at every knot: the values of END_NAMES at the ends, FREE at via-points.

    Order 4 (snap) has the jerk zero at both ends.
    """
    values = list(ends)
    states = [[*values[:2], None][: order - 1]]
    for _ in range(vias):
        states.append([FREE] * (order - 1))
    return [*states, [*values[2:], None][: order - 1]]


def _solve_states(order: int, durations: Sequence[Entry], steps: Sequence[Array], states: States) -> States:
    """Return the states with every FREE derivative computed, from durations and steps of the segments."""
    upper, values = _assemble(order, durations, steps, states)
    # Elimination without pivoting is stable, as A is positive definite.
    for p, row in upper.items():
        pivot = row[p]
        for q in [q for q in row if q > p]:
            factor = row[q] / pivot
            values[q] = values[q] - factor * values[p]
            for r in [r for r in row if r >= q]:
                entry = factor * row[r]
                upper[q][r] = upper[q][r] - entry if r in upper[q] else -entry
    solved = list(map(list, states))
    for p in reversed(upper):
        for q, entry in upper[p].items():
            if q > p:
                values[p] = values[p] - entry * values[q]
        values[p] = values[p] / upper[p][p]
        solved[p[0]][p[1]] = values[p]
    return solved


def _assemble(
    order: int, durations: Sequence[Entry], steps: Sequence[Array], states: States
) -> tuple[dict[Unknown, dict[Unknown, Entry]], dict[Unknown, Array]]:
    """Return the upper half of A and the right side b of Eq. 1.

    A segment adds W_ab h^(i + j + 2 - (2m - 1)) to the entry of the unknowns x^(i+1), x^(j+1) at its ends,
    since its data are V_i = h^i x^(i). Its step D and given derivatives go to the right side.
    """
    table = stiffness_table(order)
    upper: dict[Unknown, dict[Unknown, Entry]] = {}
    right: dict[Unknown, Array] = {}
    for s, (duration, step) in enumerate(zip(durations, steps, strict=True)):
        # 1, 1/h, 1/h^2, ...; index = exponent
        powers = [1.0, *accumulate(repeat(1.0 / duration, 2 * order - 2), operator.mul)]
        local = list(product((s, s + 1), range(order - 1)))
        for p, (loads, *weights) in zip(local, table[1:], strict=True):
            if states[p[0]][p[1]] is not FREE:
                continue
            row = upper.setdefault(p, {})
            load = -loads * powers[2 * order - 2 - p[1]] * step
            for q, weight in zip(local, weights, strict=True):
                value = states[q[0]][q[1]]
                if value is FREE and q >= p:
                    entry = weight * powers[2 * order - 3 - p[1] - q[1]]
                    row[q] = row[q] + entry if q in row else entry
                elif is_given(value):
                    load = load - weight * powers[2 * order - 3 - p[1] - q[1]] * value
            right[p] = right[p] + load if p in right else load
    return upper, right


def least_cost_coefficients(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States
) -> Array:
    """Return the coefficients (..., 2m, S, D) of the least-cost trajectory through all waypoints at fixed times.

    The waypoints (..., S + 1, D) have the full batch shape; durations (..., S) may be shared by the batch. They may be
    0 between waypoints that are equal within rounding; the via-points after such segments are dropped.
    """
    segments = durations.shape[-1]
    eps = float(xp.finfo(durations.dtype).eps)
    if not is_extreme(to_numpy(durations), eps).any():
        return _banded_coefficients(xp, order, waypoints, durations, states)
    batch = waypoints.shape[:-2]
    points = flat_batch(xp, waypoints, batch, 2)
    durations = flat_batch(xp, durations, batch, 1)
    states = [change_given(lambda value: flat_batch(xp, value, batch, 1), state) for state in states]
    numbers = to_numpy(durations)
    empty = numbers <= 0
    positive = np.where(empty, numbers.max(axis=-1, keepdims=True), numbers)
    kinds = np.column_stack([empty, is_extreme(positive, eps)])
    result = like(xp, np.zeros((len(points), 2 * order, segments, points.shape[-1])), waypoints)
    result[:, 0] = points[:, :-1]  # an empty segment is a constant
    for kind in np.unique(kinds, axis=0):  # movements with the same empty segments are solved together
        where = np.flatnonzero((kinds == kind).all(axis=1))
        full = np.flatnonzero(~kind[:-1]).tolist()
        if not full:
            continue
        # Keep the start and the end of every full segment; merged knots share one state, the goal's at the end.
        kept = [0, *(s + 1 for s in full[:-1]), segments]
        chosen = [change_given(operator.itemgetter(where), states[k]) for k in kept]
        solve = _weighted_coefficients if kind[-1] else _banded_coefficients
        part = result[where]
        part[:, :, full] = solve(xp, order, points[where][:, kept], durations[where][:, full], chosen)
        result[where] = part
    return xp.reshape(result, (*batch, *result.shape[1:]))


def is_extreme(durations: Any, eps: float) -> Any:
    """Return (...,) True where the normal equations lose digits at durations (..., S), or a segment is empty."""
    return durations.min(axis=-1) <= eps**_DIGITS * durations.max(axis=-1)


def _banded_coefficients(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States
) -> Array:
    """Return the coefficients (..., 2m, S, D) by the normal equations."""
    if 0 not in durations.shape and not (durations.min() >= _SHORT and durations.max() <= _LONG):
        scale = unit_factors(xp, durations)
        durations = durations * scale
        states = [change_time_unit(state, 1.0 / scale) for state in states]  # exact, as powers of two are
    segments = waypoints.shape[-2] - 1
    steps = waypoints[..., 1:, :] - waypoints[..., :-1, :]
    lengths = xp.moveaxis(durations[..., None], -2, 0)
    if xp is np and durations.size == segments and durations.dtype == np.float64:
        lengths = lengths.reshape(-1).tolist()  # Python floats: the same bits, without an array's overhead
    states = _solve_states(order, lengths, xp.moveaxis(steps, -2, 0), states)
    rest = 0.0 * steps[..., 0, :]
    # Rows of s = (x0, V0_1, ..., D, V1_1, ...), see Eq. 1 of _polynomial; V_i = h^i x^(i).
    first, last = [waypoints[..., :-1, :]], [steps]
    power = length = durations[..., None]
    for i in range(order - 1):
        knots = []
        for state in states:
            value = rest if state[i] is None else state[i]
            knots.append(broadcast_to(xp, value, rest.shape))
        derivative = xp.stack(knots, axis=-2)
        first.append(power * derivative[..., :-1, :])
        last.append(power * derivative[..., 1:, :])
        power = power * length
    data = xp.concat(first + last, axis=-2)
    batch = data.shape[:-2]
    data = xp.reshape(data, (*batch, 2 * order, segments * data.shape[-1]))
    coefficients = xp.matmul(like(xp, coefficient_table(order), data), data)
    return xp.reshape(coefficients, (*batch, 2 * order, segments, rest.shape[-1]))


def _weighted_coefficients(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States
) -> Array:
    """Return the coefficients (N, 2m, S, D) by weighted least squares, in double precision."""
    places = xp.astype(waypoints, xp.float64)
    lengths = xp.astype(durations, xp.float64).mT
    rows = [change_given(lambda value: xp.astype(value, xp.float64).mT, state) for state in states]
    total = sum(lengths)  # from first to last, alone as in a batch
    points = to_numpy(places)
    pace = to_numpy(total)
    ends = []
    for state in (states[0], states[-1]):
        ends.append(change_time_unit(change_given(to_numpy, state), pace[:, None]))
    slack = like(xp, rounding_slack(points, ends), lengths)
    for _ in range(2 * order - 1):
        slack = slack * total
    soft = _fitted_coefficients(xp, order, places, lengths, rows, slack)
    exact = _fitted_coefficients(xp, order, places, lengths, rows, 0.0 * slack)
    # The tolerance is for rounding alone: it must lower the cost, and no waypoint may be missed by more.
    table = energy_table(order, order)
    shares = (to_numpy(lengths) / pace).T ** (2 * order - 1)
    costs = []
    for found in (exact, soft):
        modes = np.einsum("ik,nksd->nisd", table, to_numpy(found)[:, order:])
        costs.append(ordered_sum((modes * modes).sum(axis=(1, 3)) / shares, -1))
    steps = to_numpy(soft)[:, 1:].sum(axis=1)
    missed = np.abs(steps - np.diff(points, axis=1)).max(axis=(1, 2))
    far = missed > _MISS * np.abs(points - points[:, :1]).max(axis=(1, 2))
    better = far | (costs[0] <= (1.0 + _GAIN) * costs[1])
    chosen = like(xp, 1.0 * better, slack)[:, None, None, None]
    return xp.astype(xp.where(chosen > 0, exact, soft), waypoints.dtype)


def _fitted_coefficients(
    xp: Namespace, order: int, waypoints: Array, lengths: Array, states: States, slack: Array
) -> Array:
    """Return the coefficients (N, 2m, S, D) from waypoints (N, S + 1, D); for the others see `fit_modes`."""
    steps = xp.permute_dims(waypoints[:, 1:] - waypoints[:, :-1], (1, 2, 0))
    solved, modes = fit_modes(xp, order, lengths, steps, states, slack)
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
    """Return the weights w_0 ... w_(m-1) of Eqs. 2 and 5 of a segment."""
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
    """Compute the FREE derivatives at the knots, and the modes r of each segment (Eq. 2), of N movements.

    Durations are (S, N), steps (S, D, N), derivatives at the knots (D, N), None for zero, or FREE; the slack (N,) is
    that of Eq. 5. Returned are the states with every FREE replaced, and r_0 ... r_(m-1) per segment, (D, N) each.
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
    fastest = _FASTEST * sum(xp.linalg.vector_norm(steps, axis=1)) / sum(lengths)
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
