"""Free passage times: when the smoothest movement passes its via-points."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ._boundary import boundary_values
from ._passage.cost import PassageCost
from ._passage.gradient import attach
from ._passage.moving_ends import fractions_moving
from ._passage.newton import fractions_by_newton
from ._passage.rest_to_rest import fractions_at_rest
from .array_api import (
    FREE,
    Array,
    Boundary,
    as_floats,
    broadcast_to,
    follows_gradient,
    like,
    require,
    to_numpy,
)
from .minimum_jerk import check_waypoints


def passage_durations(
    waypoints: Array,
    duration: Array,
    *,
    start_velocity: Array | None = None,
    start_acceleration: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
) -> Array:
    """Segment durations with the least jerk: Flash & Hogan's free passage times, pi . v(t_k) = 0 (Eq. C16).

    One via-point, rest to rest: the only root of a polynomial (see _passage_rest). Several: damped Newton on
    the jerk cost. The numbers are found in NumPy and double precision whatever the input; torch gradients
    follow from the implicit function theorem and are clipped where a via-point meets its neighbour.

    Args:
        waypoints: (..., K + 2, D) start, via-points, goal [m].
        duration: (...,) total [s].
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = as the least cost decides (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.

    Returns:
        (..., K + 1) [s], adding up to `duration`. A via-point that equals its neighbour gets duration 0;
        `through` then drops it.

    Raises:
        ValueError: an argument is not finite or has a wrong shape, or duration <= 0.

    Warns:
        RuntimeWarning: the iteration did not converge for some movements (K >= 2, knots about to merge);
            their durations are the best found.
    """
    named = boundary_values(start_velocity, start_acceleration, goal_velocity, goal_acceleration)
    xp, arrays = as_floats(named, waypoints=waypoints, duration=duration)
    waypoints, duration = arrays[:2]
    boundary = dict(zip(named, arrays[2:], strict=True))
    batch = check_waypoints(waypoints, boundary, duration=duration)
    require(xp, duration > 0, "duration", duration, "must be positive")
    points = _flat(waypoints, batch, 2)
    ends = _unit_time_ends(boundary, duration, batch)
    fractions = like(xp, _fractions(points, ends).reshape(*batch, waypoints.shape[-2] - 1), waypoints)
    if xp is not np and follows_gradient(waypoints, duration, *boundary.values()):
        waypoints = broadcast_to(xp, waypoints, (*batch, *waypoints.shape[-2:]))
        fractions = attach(fractions, waypoints, duration, boundary, xp)
    return fractions * duration[..., None]


def _flat(array: Array, batch: tuple[int, ...], own: int) -> Any:
    """(N, ...) NumPy float64 with the full batch in one axis."""
    numbers = to_numpy(array).astype(np.float64, copy=False)
    shape = numbers.shape[numbers.ndim - own :] if own else ()
    return np.broadcast_to(numbers, (*batch, *shape)).reshape(-1, *shape)


def _unit_time_ends(boundary: dict[str, Boundary], duration: Array, batch: tuple[int, ...]) -> list[Any]:
    """Return the four boundary values in unit time (V = v T, A = a T^2): (N, D), None or FREE."""
    if all(value is None for value in boundary.values()):
        return [None] * 4
    time = _flat(duration, batch, 0)[:, None]
    ends = []
    for name, value in boundary.items():
        if value is None or value is FREE:
            ends.append(value)
        else:
            ends.append(_flat(value, batch, 1) * (time if "velocity" in name else time * time))
    return ends


def _fractions(points: Any, ends: list[Any]) -> Any:
    """(N, S) fractions of the duration; movements with the same kind of problem are solved together."""
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
            result[where, -1] = 1.0  # nowhere to go: stay
            continue
        kept = points[where][:, [*full, knots - 1]]
        chosen = [value[where] if isinstance(value, np.ndarray) else value for value in ends]
        result[np.ix_(where, full)] = _solve(kept, chosen, bool(kind[-1]))
    return result


def _scaled(points: Any, ends: list[Any]) -> tuple[Any, list[Any]]:
    """Bring each movement to a size of about 1, by a power of two: exact, and no square under- or overflows."""
    size = np.abs(points - points[:, :1]).max(axis=(1, 2))
    for value in ends:
        if isinstance(value, np.ndarray):
            size = np.maximum(size, np.abs(value).max(axis=1))
    exponent = -np.frexp(size)[1]
    scaled = [np.ldexp(v, exponent[:, None]) if isinstance(v, np.ndarray) else v for v in ends]
    return np.ldexp(points, exponent[:, None, None]), scaled


def _solve(points: Any, ends: list[Any], moving: bool) -> Any:
    """(N, S) fractions where neighbouring waypoints differ."""
    if points.shape[1] == 2:
        return np.ones((len(points), 1))
    points, ends = _scaled(points, ends)
    if points.shape[1] == 3:
        return fractions_moving(points, ends) if moving else fractions_at_rest(points)
    rows = [
        np.ascontiguousarray(v.T) if isinstance(v, np.ndarray) else v
        for v in (ends if moving else [None] * 4)
    ]
    steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
    fractions, converged = fractions_by_newton(PassageCost(steps, rows[:2], rows[2:]), several=moving)
    if not converged.all():
        lost = np.flatnonzero(~converged)
        warnings.warn(
            f"passage times of {lost.size} of {len(points)} movements did not converge (first: waypoints "
            f"{points[lost[0]].tolist()}); the best found are returned",
            RuntimeWarning,
            stacklevel=4,
        )
    return fractions
