"""Minimum-jerk trajectories between two states and through via-points at given times, and checks of their arguments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    as_floats,
    broadcast_batch,
    broadcast_to,
    change_time_unit,
    is_given,
    leading_shape,
    require,
    to_numpy,
)
from .trajectory import Trajectory, connect

Ends = dict[str, Boundary]  # The four boundary values by name, in the order of END_NAMES

ORDERS = (2, 3, 4)

# Distance of waypoints that count as equal, in units of the rounding of their greatest coordinate.
_EQUAL = 64.0

END_NAMES = ("start_velocity", "start_acceleration", "goal_velocity", "goal_acceleration")


def point_to_point(
    start: Array,
    goal: Array,
    duration: Array,
    *,
    start_velocity: Array | None = None,
    start_acceleration: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
    order: int = 3,
) -> Trajectory:
    """Return the movement from start to goal with the least integral of |x^(order)|^2.

    At rest on both ends and with order 3 it is Eq. 2 of Flash & Hogan 1985,
    x(t) = x0 + (xf - x0)(10 tau^3 - 15 tau^4 + 6 tau^5), tau = t / duration.

    Args:
        start: (..., D) [m].
        goal: (..., D) [m].
        duration: (...,) [s].
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = the value of least cost (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.
        order: 2, 3 or 4: least acceleration, jerk or snap. Order 2 leaves accelerations open; with order 4
            the jerk is zero at both ends.

    Raises:
        ValueError: an argument is not finite, has a wrong shape, or duration <= 0 (0 is allowed for a movement
            from rest to rest that stays where it is).

    Example:
        >>> from viapoint.primitives import point_to_point
        >>> reach = point_to_point([0.0, 0.0], [0.3, 0.0], 0.8)
        >>> reach([0.0, 0.4, 0.8]).round(3).tolist()
        [[0.0, 0.0], [0.15, 0.0], [0.3, 0.0]]
    """
    check_order(order, start_acceleration, goal_acceleration)
    xp, (start, goal, duration), ends = read_arguments(
        (start_velocity, start_acceleration, goal_velocity, goal_acceleration),
        start=start,
        goal=goal,
        duration=duration,
    )
    shapes = {"start": leading_shape("start", start, None), "duration": tuple(duration.shape)}
    dimension = start.shape[-1]
    goal_shape = leading_shape("goal", goal, dimension)
    shape = (*broadcast_batch(**shapes, goal=goal_shape, **end_shapes(ends, dimension)), dimension)
    waypoints = xp.stack([broadcast_to(xp, start, shape), broadcast_to(xp, goal, shape)], axis=-2)
    check_durations("duration", duration[..., None], waypoints, ends)
    return connect(xp, order, waypoints, duration[..., None], knot_states(order, ends.values()))


def through(
    waypoints: Array,
    durations: Array,
    *,
    start_velocity: Array | None = None,
    start_acceleration: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
    via_velocities: Array | None = None,
    order: int = 3,
) -> Trajectory:
    """Return the movement through all waypoints with the least integral of |x^(order)|^2.

    Velocity and acceleration at the K via-points are those of least cost. The result is continuous up to
    x^(2 order - 2) (Flash & Hogan 1985, Appendix C).

    Args:
        waypoints: (..., K + 2, D) start, via-points, goal [m].
        durations: (..., K + 1) [s]. 0 is allowed between waypoints that are equal up to rounding and drops the
            via-point. Durations (K + 1,) for a batch of waypoints are shared, which is faster.
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = the value of least cost (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.
        via_velocities: (..., K, D) prescribed velocities at the via-points [m/s]; None = those of least cost.
        order: 2, 3 or 4: least acceleration, jerk or snap.

    Raises:
        ValueError: an argument is not finite or has a wrong shape; a duration is negative, or 0 between
            different waypoints, or all are 0 while an end moves.

    Example:
        >>> from viapoint.primitives import through
        >>> movement = through([[0.0, 0.0], [0.2, 0.1], [0.4, 0.0]], [0.5, 0.5])
        >>> movement(0.5).round(3).tolist()
        [0.2, 0.1]
    """
    check_order(order, start_acceleration, goal_acceleration)
    xp, (waypoints, durations, via_velocities), ends = read_arguments(
        (start_velocity, start_acceleration, goal_velocity, goal_acceleration),
        {"via_velocities": via_velocities},
        waypoints=waypoints,
        durations=durations,
    )
    shapes = waypoint_shapes(waypoints, ends)
    knots, dimension = waypoints.shape[-2:]
    shapes["durations"] = leading_shape("durations", durations, knots - 1)
    if via_velocities is not None:
        shapes["via_velocities"] = leading_shape("via_velocities", via_velocities, knots - 2, dimension)
    batch = broadcast_batch(**shapes)
    waypoints = broadcast_to(xp, waypoints, (*batch, knots, dimension))
    check_durations("durations", durations, waypoints, ends)
    states = knot_states(order, ends.values(), knots - 2)
    if via_velocities is not None:
        for k in range(knots - 2):
            states[k + 1][0] = via_velocities[..., k, :]
    return connect(xp, order, waypoints, durations, states)


def minimum_jerk_coefficients(
    x0: Array, dx0: Array, ddx0: Array, xT: Array, dxT: Array, ddxT: Array, T: Array
) -> Array:
    """Return a_0 ... a_5 of the minimum-jerk polynomial x(t) = sum_k a_k t^k between two states.

    With V = T dx, A = T^2 ddx and D = xT - x0 the solution of the boundary conditions is, for any T > 0,

        a_3 T^3 =  10 D - 6 V0 - 4 VT - 3/2 A0 + 1/2 AT
        a_4 T^4 = -15 D + 8 V0 + 7 VT + 3/2 A0 -     AT
        a_5 T^5 =   6 D - 3 V0 - 3 VT - 1/2 A0 + 1/2 AT

    Position [m], velocity [m/s] and acceleration [m/s^2] at start and goal and the duration T [s] have the shape
    (...,), the coefficients (..., 6), a_k in m/s^k.

    Raises:
        ValueError: an argument is not finite, does not broadcast, or T <= 0.

    Example:
        >>> from viapoint.primitives import minimum_jerk_coefficients
        >>> minimum_jerk_coefficients(0, 0, 0, 1, 0, 0, 1).tolist()
        [0.0, 0.0, 0.0, 10.0, -15.0, 6.0]
    """
    given = {"x0": x0, "dx0": dx0, "ddx0": ddx0, "xT": xT, "dxT": dxT, "ddxT": ddxT, "T": T}
    xp, arrays = as_floats(**given)
    require(arrays[-1] > 0, "T", arrays[-1], "must be positive")
    shape = broadcast_batch(**{name: tuple(a.shape) for name, a in zip(given, arrays, strict=True)})
    x0, dx0, ddx0, xT, dxT, ddxT, T = (broadcast_to(xp, a, shape)[..., None] for a in arrays)
    movement = connect(xp, 3, xp.stack([x0, xT], axis=-2), T, [[dx0, ddx0], [dxT, ddxT]])
    unit = movement.coefficients[..., 0, :]
    rate = 1.0 / T
    upper = [unit[..., k, :] * math.prod([rate] * k) for k in range(3, 6)]
    # a_1 and a_2 are given: conversion to unit time and back would round them.
    return xp.concat([unit[..., 0, :], dx0, ddx0 / 2, *upper], axis=-1)


def read_arguments(
    ends: tuple[Boundary, Boundary, Boundary, Boundary],
    optional: Mapping[str, Any] | None = None,
    /,
    **required: Any,
) -> tuple[Namespace, list[Any], Ends]:
    """Convert the arguments of a movement to one library and dtype, see `as_floats`.

    `ends` are the values of END_NAMES. They are returned by name, after the namespace and the other arrays.
    """
    named = dict(zip(END_NAMES, ends, strict=True))
    xp, arrays = as_floats({**(optional or {}), **named}, **required)
    return xp, arrays[:-4], dict(zip(END_NAMES, arrays[-4:], strict=True))


def check_order(order: int, start_acceleration: Boundary, goal_acceleration: Boundary) -> None:
    """Raise ValueError for an unknown order, or for order 2 with boundary accelerations."""
    if not isinstance(order, int | np.integer) or order not in ORDERS:
        raise ValueError(f"order must be 2 (acceleration), 3 (jerk) or 4 (snap), got {order!r}")
    if order == 2 and (is_given(start_acceleration) or is_given(goal_acceleration)):
        raise ValueError("no acceleration can be given for order 2: least acceleration leaves it open")


def end_shapes(ends: Mapping[str, Boundary], dimension: int) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of the given boundary values; raise ValueError if a last axis is not D."""
    shapes = {}
    for name, value in ends.items():
        if is_given(value):
            shapes[name] = leading_shape(name, value, dimension)
    return shapes


def waypoint_shapes(waypoints: Array, ends: Ends) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of waypoints and of boundary values, or raise ValueError."""
    shape = leading_shape("waypoints", waypoints, None, None)
    if waypoints.shape[-2] < 2:
        raise ValueError("waypoints must hold start and goal, got one point")
    return {"waypoints": shape, **end_shapes(ends, waypoints.shape[-1])}


def check_durations(name: str, durations: Array, waypoints: Array, ends: Ends) -> None:
    """Raise ValueError for durations (..., S) below 0, and for 0 between waypoints (..., S + 1, D) that differ.

    All durations of a movement may be 0 only if its ends are at rest.
    """
    if (durations > 0).all():
        return
    require(durations >= 0, name, durations, "must not be negative")
    points, numbers = to_numpy(waypoints), to_numpy(durations)
    positive = np.broadcast_to(numbers > 0, (*points.shape[:-2], numbers.shape[-1]))
    rounding = _EQUAL * np.finfo(points.dtype).eps * np.abs(points).max(axis=(-2, -1), initial=0.0)
    equal = np.abs(np.diff(points, axis=-2)).max(axis=-1) <= rounding[..., None]
    require(positive | equal, name, 1.0 * positive, "may be 0 only between equal waypoints")
    moves = np.zeros(positive.shape[:-1], dtype=bool)
    for value in ends.values():
        if is_given(value):
            moves = moves | (to_numpy(value) != 0).any(axis=-1)
    require(positive.any(axis=-1) | ~moves, name, 1.0 * moves, "must not be 0 for a movement whose ends move")


def knot_states(order: int, ends: Iterable[Boundary], vias: int = 0) -> list[list[Any]]:
    """Return the m - 1 derivatives at every knot: the values of END_NAMES at the ends, FREE at via-points.

    Order 4 (snap) has the jerk zero at both ends.
    """
    values = list(ends)
    states = [[*values[:2], None][: order - 1]]
    for _ in range(vias):
        states.append([FREE] * (order - 1))
    return [*states, [*values[2:], None][: order - 1]]


def unit_time_ends(ends: Sequence[Boundary], duration: Array) -> list[Any]:
    """Return the values of END_NAMES in unit time, V = v T and A = a T^2; None and FREE stay."""
    time = duration[..., None]
    return change_time_unit(ends[:2], time) + change_time_unit(ends[2:], time)
