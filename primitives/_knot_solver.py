"""Least-cost trajectories through given points at given times: a banded linear system for the knot states.

With the cost 1/2 sum_s s^T W s / h^(2m-1) of the segments (see `_polynomial`), a zero gradient with
respect to the unknown derivatives y at the knots is

    A y = b,                                                                                        (1)

symmetric, positive definite, with a narrow band: block tridiagonal with blocks of size m - 1. The equations
state that snap and jerk (m = 3) are continuous at the knots, as in Flash & Hogan 1985, Appendix C; position,
velocity and acceleration are so by construction.

All operations work element by element, on arrays or on Python floats where all movements share their
durations. So an item of a batch gives the same bits as alone, which LAPACK does not promise.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from itertools import accumulate, product, repeat
from typing import Any, TypeAlias

import numpy as np

from ._polynomial import coefficient_table, energy_table, stiffness_table
from ._weighted_solver import Entry, Unknown, rounding_slack, weighted_coefficients
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
    to_numpy,
    unit_factors,
)

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
    if not _is_extreme(to_numpy(durations), eps).any():
        return _banded_coefficients(xp, order, waypoints, durations, states)
    batch = waypoints.shape[:-2]
    points = flat_batch(xp, waypoints, batch, 2)
    durations = flat_batch(xp, durations, batch, 1)
    states = [change_given(lambda value: flat_batch(xp, value, batch, 1), state) for state in states]
    numbers = to_numpy(durations)
    empty = numbers <= 0
    positive = np.where(empty, numbers.max(axis=-1, keepdims=True), numbers)
    kinds = np.column_stack([empty, _is_extreme(positive, eps)])
    result = like(xp, np.zeros((len(points), 2 * order, segments, points.shape[-1])), waypoints)
    for kind in np.unique(kinds, axis=0):  # movements with the same empty segments are solved together
        where = np.flatnonzero((kinds == kind).all(axis=1))
        chosen = [change_given(operator.itemgetter(where), state) for state in states]
        extreme = bool(kind[-1])
        result[where] = _connect_kind(xp, order, points[where], durations[where], chosen, kind[:-1], extreme)
    return xp.reshape(result, (*batch, *result.shape[1:]))


def _is_extreme(durations: Any, eps: float) -> Any:
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
    dtype = waypoints.dtype
    waypoints = xp.astype(waypoints, xp.float64)
    durations = xp.astype(durations, xp.float64)
    states = [change_given(lambda value: xp.astype(value, xp.float64), state) for state in states]
    total = xp.sum(durations, axis=-1)
    points = to_numpy(waypoints)
    pace = to_numpy(total)[:, None]
    ends = []
    for state in (states[0], states[-1]):
        ends.append(change_time_unit(change_given(to_numpy, state), pace))
    slack = like(xp, rounding_slack(points, ends), durations)
    for _ in range(2 * order - 1):
        slack = slack * total
    soft = weighted_coefficients(xp, order, waypoints, durations, states, slack)
    exact = weighted_coefficients(xp, order, waypoints, durations, states, 0.0 * slack)
    # The tolerance is for rounding alone: it must lower the cost, and no waypoint may be missed by more.
    table = energy_table(order, order)
    lengths = to_numpy(durations / total[:, None]) ** (2 * order - 1)
    costs = []
    for found in (exact, soft):
        modes = np.einsum("ik,nksd->nisd", table, to_numpy(found)[:, order:])
        costs.append(((modes * modes).sum(axis=(1, 3)) / lengths).sum(axis=-1))
    steps = to_numpy(soft)[:, 1:].sum(axis=1)
    missed = np.abs(steps - np.diff(points, axis=1)).max(axis=(1, 2))
    far = missed > _MISS * np.abs(points - points[:, :1]).max(axis=(1, 2))
    better = far | (costs[0] <= (1.0 + _GAIN) * costs[1])
    chosen = like(xp, 1.0 * better, slack)[:, None, None, None]
    return xp.astype(xp.where(chosen > 0, exact, soft), dtype)


def _connect_kind(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States, empty: Any, extreme: bool
) -> Array:
    """Return the coefficients where every item has the same empty segments; an empty one is a constant."""
    full = np.flatnonzero(~empty).tolist()
    points = waypoints[:, None, :-1]
    result = xp.concat([points, *[0.0 * points] * (2 * order - 1)], axis=1)
    if not full:
        return result
    # Keep the start and the end of every full segment; merged knots share one state, the goal's at the end.
    kept = [0, *(s + 1 for s in full[:-1]), len(empty)]
    chosen = [states[k] for k in kept]
    solve = _weighted_coefficients if extreme else _banded_coefficients
    result[:, :, full] = solve(xp, order, waypoints[:, kept], durations[:, full], chosen)
    return result
