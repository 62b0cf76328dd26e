"""Passage times at which the minimum-jerk movement passes its via-points if they are left free."""

from __future__ import annotations

import warnings
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from ._passage_newton import PassageCost, attach_gradient, fractions_by_newton
from ._passage_one_via import fractions_at_rest, fractions_moving
from ._polynomial import differentiate, evaluate
from ._weighted_solver import rounding_slack
from .array_api import (
    FREE,
    Array,
    Boundary,
    broadcast_batch,
    broadcast_to,
    change_given,
    flat_batch,
    like,
    ordered_sum,
    to_numpy,
)
from .minimum_jerk import check_durations, read_arguments, unit_time_ends, waypoint_shapes
from .trajectory import connect

# Fraction of the duration below which a segment is dropped in lower than double precision, which it would overflow.
_LEAST_FRACTION = 1e-7
# Distance of a via-point from the one before, relative to the longest, below which it is left out at first.
_NEAR = 1e-2
_LEVEL_STEPS = 5
# Entries of the Hessians of the movements that are solved at a time.
_ENTRIES = 50_000


def passage_durations(
    waypoints: Array,
    duration: Array,
    *,
    start_velocity: Array | None = None,
    start_acceleration: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
) -> Array:
    """Return the segment durations with the least jerk cost, for a given total duration.

    They satisfy Flash & Hogan's condition pi . v(t_k) = 0 at every via-point (1985, Eq. C16). With one via-point they
    are the global minimum; with several, local minima cannot be excluded. The computation runs in NumPy and double
    precision for every input. torch gradients follow from the implicit function theorem and are clipped where a
    via-point meets its neighbour.

    Args:
        waypoints: (..., K + 2, D) start, via-points, goal [m].
        duration: (...,) total [s].
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = the value of least cost (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.

    Returns:
        (..., K + 1) [s], adding up to `duration`. A via-point that equals its neighbour gets duration 0;
        `through` then drops it.

    Raises:
        ValueError: an argument is not finite or has a wrong shape, or duration <= 0 (0 is allowed for a movement
            from rest to rest through equal waypoints).

    Warns:
        RuntimeWarning: the iteration did not converge for some movements; their durations are the best found.

    Example:
        >>> from viapoint.primitives import passage_durations
        >>> passage_durations([[0.0, 0.0], [0.35, 0.30], [1.0, 0.0]], 1.0).round(3).tolist()
        [0.448, 0.552]
    """
    xp, (waypoints, duration), ends = read_arguments(
        (start_velocity, start_acceleration, goal_velocity, goal_acceleration),
        waypoints=waypoints,
        duration=duration,
    )
    batch = broadcast_batch(**waypoint_shapes(waypoints, ends), duration=tuple(duration.shape))
    waypoints = broadcast_to(xp, waypoints, (*batch, *waypoints.shape[-2:]))
    check_durations("duration", duration[..., None], waypoints, ends)
    flat_ends = change_given(lambda value: _flat(value, batch, 1), ends.values())
    unit_ends = unit_time_ends(flat_ends, _flat(duration, batch, 0))
    points, dtype = _flat(waypoints, batch, 2), waypoints.dtype
    eps = float(xp.finfo(dtype).eps)
    numbers = _fractions(points, unit_ends, eps)
    if eps > _LEAST_FRACTION:
        numbers[numbers < _LEAST_FRACTION] = 0.0
    numbers = numbers.reshape(*batch, waypoints.shape[-2] - 1)
    recorded = any(getattr(value, "requires_grad", False) for value in (waypoints, duration, *ends.values()))
    if not recorded:
        return like(xp, numbers, waypoints) * duration[..., None]
    cost = PassageCost.from_points(points, unit_ends, rounding_slack(points, (unit_ends[:2], unit_ends[2:])))
    given = change_given(lambda value: xp.astype(value, xp.float64), ends.values())
    waypoints = xp.astype(waypoints, xp.float64)
    time = xp.astype(duration, xp.float64)
    moving = unit_time_ends(given, time)
    fractions = attach_gradient(like(xp, numbers, waypoints), waypoints, moving, cost, xp)
    return xp.astype(fractions * time[..., None], dtype)


def _flat(array: Array, batch: tuple[int, ...], own: int) -> Any:
    """Return NumPy float64 with the full batch in one axis; the last `own` axes stay."""
    return flat_batch(np, to_numpy(array).astype(np.float64, copy=False), batch, own)


def _fractions(points: Any, ends: list[Any], eps: float) -> Any:
    """Return fractions of the duration (N, S).

    Movements with the same distinct waypoints, and with or without motion at the ends, are solved together.
    """
    count, knots, _ = points.shape
    if knots == 2 or not count:
        return np.ones((count, knots - 1))
    gaps = np.abs(np.diff(points, axis=1)).max(axis=-1)
    # The closed forms for one via-point hold at any distance.
    rounding = eps * np.abs(points).max(axis=(1, 2)) if knots > 3 else np.zeros(count)
    distinct = gaps > rounding[:, None]
    moving = np.zeros(count, dtype=bool)
    for value in ends:
        if value is not None:
            moving = moving | (True if value is FREE else (value != 0).any(axis=-1))
    if not moving.any() and distinct.all():
        return _solve(points, ends, False)
    kinds = np.concatenate([distinct, moving[:, None]], axis=1)
    result = np.zeros((count, knots - 1))
    for kind in np.unique(kinds, axis=0):
        where = np.flatnonzero((kinds == kind).all(axis=1))
        full = np.flatnonzero(kind[:-1])
        if not full.size:
            result[where, -1] = 1.0  # all waypoints are equal
            continue
        kept = points[where][:, [*full, knots - 1]]
        chosen = change_given(itemgetter(where), ends)
        result[np.ix_(where, full)] = _solve(kept, chosen, bool(kind[-1]))
    return result


def _solve(points: Any, ends: list[Any], moving: bool) -> Any:
    """Return fractions (N, S) where neighbouring waypoints differ."""
    count, knots, _ = points.shape
    if knots == 2:
        return np.ones((count, 1))
    # A size of about 1, by a power of two, is exact, and no square under- or overflows.
    size = np.abs(points - points[:, :1]).max(axis=(1, 2))
    for value in ends:
        if isinstance(value, np.ndarray):
            size = np.maximum(size, np.abs(value).max(axis=1))
    exponent = -np.frexp(size)[1]
    points = np.ldexp(points, exponent[:, None, None])
    ends = change_given(lambda value: np.ldexp(value, exponent[:, None]), ends)
    slack = rounding_slack(points, (ends[:2], ends[2:]))
    if knots == 3:
        return fractions_moving(points, ends, slack) if moving else fractions_at_rest(points)
    ends = ends if moving else [None] * 4
    cost = PassageCost.from_points(points, ends, slack)
    guess, bound = _from_fewer_points(points, ends, moving)
    fractions = np.empty((count, knots - 1))
    converged = np.empty(count, dtype=bool)
    size = max(1, _ENTRIES // knots**2)
    for first in range(0, count, size):
        rows = slice(first, first + size)
        found = fractions_by_newton(cost.chosen(rows), guess[rows].T, bound[rows], several=moving)
        fractions[rows], converged[rows] = found
    if not converged.all():
        warnings.warn(
            f"the passage times of {np.sum(~converged)} of {count} movements did not converge; the best found are "
            "returned",
            RuntimeWarning,
            stacklevel=4,
        )
    return fractions


def _from_fewer_points(points: Any, ends: list[Any], moving: bool) -> tuple[Any, Any]:
    """Return fractions (N, S) of the best movement without via-points very close to the one before, and its cost (N,).

    The via-points left out get the time when the movement comes level with them. No movement through all points
    costs less, and this one is the best of all if it passes them anyway. Both are NaN where there is none.
    """
    count, knots, _ = points.shape
    chord = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    left_out = np.zeros((count, knots), dtype=bool)
    left_out[:, 1:-1] = chord[:, :-1] < _NEAR * chord.max(axis=1, keepdims=True)
    if not moving:
        left_out[:, 1] = False  # where a movement from rest begins, it is not level with anything
    result = np.full((count, knots - 1), np.nan)
    cost = np.full(count, np.nan)
    for pattern in np.unique(left_out[left_out.any(axis=1)], axis=0):
        where = np.flatnonzero((left_out == pattern).all(axis=1))
        kept = np.flatnonzero(~pattern)
        chosen = change_given(itemgetter(where), ends)
        fewer = points[where][:, kept]
        fractions = _solve(fewer, chosen, moving)
        states: list[list[Any]] = [chosen[:2], *([FREE, FREE] for _ in kept[1:-1]), chosen[2:]]
        movement = connect(np, 3, fewer, fractions, states)
        coefficients, cost[where] = movement.coefficients, movement.cost()
        for i, (first, last) in enumerate(pairwise(kept)):
            times = [np.zeros(len(where))]
            for k in range(first + 1, last):
                step = points[where, k] - points[where, first]
                times.append(_level_time(coefficients[:, :, i], step) * fractions[:, i])
            durations = np.diff([*times, fractions[:, i]], axis=0).T
            result[where, first:last] = durations
    result[~(result > 0).all(axis=1)] = np.nan
    return result, cost


def _level_time(coefficients: Any, step: Any) -> Any:
    """Return the unit time u (N,) at which (x(u) - x(0)) . d = d . d, for segments (N, 6, D) and steps d (N, D)."""
    along = ordered_sum(coefficients * step[:, None], -1)
    along[:, 0] = -ordered_sum(step * step, -1)
    with np.errstate(all="ignore"):
        target = -along[:, 0]
        slope = along[:, 1]
        curve = along[:, 2]
        u = 2.0 * target / (slope + np.sqrt(slope * slope + 4.0 * curve * target))
        for _ in range(_LEVEL_STEPS):
            u = u - evaluate(along, u) / evaluate(differentiate(along), u)
    return u
