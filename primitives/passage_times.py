"""Passage times at which the minimum-jerk movement passes its via-points if they are left free."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ._boundary import chosen_items, read_arguments, unit_time_ends, waypoint_shapes
from ._passage.cost import PassageCost
from ._passage.moving_ends import fractions_moving
from ._passage.newton import attach_gradient, fractions_by_newton
from ._passage.rest_to_rest import fractions_at_rest
from .array_api import (
    FREE,
    Array,
    Boundary,
    broadcast_batch,
    broadcast_to,
    follows_gradient,
    is_given,
    like,
    require,
    to_numpy,
)


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

    They satisfy Flash & Hogan's condition pi . v(t_k) = 0 at every via-point (1985, Eq. C16). One via-point,
    rest to rest: the only root of a polynomial, the global minimum. One via-point, moving or free ends: the
    best of all roots. Several via-points: damped Newton steps on the cost; local minima cannot be excluded.

    The computation runs in NumPy and double precision for every input. torch gradients follow from the
    implicit function theorem and are clipped where a via-point meets its neighbour.

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
        ValueError: an argument is not finite or has a wrong shape, or duration <= 0.

    Warns:
        RuntimeWarning: the iteration did not converge for some movements (K >= 2, knots about to merge);
            their durations are the best found.

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
    require(duration > 0, "duration", duration, "must be positive")
    flat_ends = dict(ends)
    for name, value in ends.items():
        if is_given(value):
            flat_ends[name] = _flat(value, batch, 1)
    unit_ends = unit_time_ends(flat_ends, _flat(duration, batch, 0))
    numbers = _fractions(_flat(waypoints, batch, 2), unit_ends)
    fractions = like(xp, numbers.reshape(*batch, waypoints.shape[-2] - 1), waypoints)
    if xp is not np and follows_gradient(waypoints, duration, *ends.values()):
        waypoints = broadcast_to(xp, waypoints, (*batch, *waypoints.shape[-2:]))
        fractions = attach_gradient(fractions, waypoints, unit_time_ends(ends, duration), xp)
    return fractions * duration[..., None]


def _flat(array: Array, batch: tuple[int, ...], own: int) -> Any:
    """Return NumPy float64 with the full batch in one axis; the last `own` axes stay."""
    array = array if isinstance(array, np.ndarray) else to_numpy(array)
    numbers = array.astype(np.float64, copy=False)
    shape = numbers.shape[numbers.ndim - own :] if own else ()
    return np.broadcast_to(numbers, (*batch, *shape)).reshape(-1, *shape)


def _fractions(points: Any, ends: list[Any]) -> Any:
    """Return fractions of the duration (N, S).

    Movements with the same distinct waypoints, and with or without motion at the ends, are solved together.
    """
    count, knots, _ = points.shape
    if knots == 2 or not count:
        return np.ones((count, knots - 1))
    distinct = (points[:, 1:] != points[:, :-1]).any(axis=-1)
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
        chosen = [chosen_items(value, where) for value in ends]
        result[np.ix_(where, full)] = _solve(kept, chosen, bool(kind[-1]))
    return result


def _scaled(points: Any, ends: list[Any]) -> tuple[Any, list[Any]]:
    """Scale each movement to a size of about 1 by a power of two: exact, and no square under- or overflows."""
    size = np.abs(points - points[:, :1]).max(axis=(1, 2))
    for value in ends:
        if isinstance(value, np.ndarray):
            size = np.maximum(size, np.abs(value).max(axis=1))
    exponent = -np.frexp(size)[1]
    scaled = [np.ldexp(v, exponent[:, None]) if isinstance(v, np.ndarray) else v for v in ends]
    return np.ldexp(points, exponent[:, None, None]), scaled


def _solve(points: Any, ends: list[Any], moving: bool) -> Any:
    """Return fractions (N, S) where neighbouring waypoints differ."""
    if points.shape[1] == 2:
        return np.ones((len(points), 1))
    points, ends = _scaled(points, ends)
    if points.shape[1] == 3:
        return fractions_moving(points, ends) if moving else fractions_at_rest(points)
    cost = PassageCost.from_points(points, ends if moving else [None] * 4)
    fractions, converged = fractions_by_newton(cost, several=moving)
    if not converged.all():
        lost = np.flatnonzero(~converged)
        warnings.warn(
            f"passage times of {lost.size} of {len(points)} movements did not converge (first: waypoints "
            f"{points[lost[0]].tolist()}); the best found are returned",
            RuntimeWarning,
            stacklevel=4,
        )
    return fractions
