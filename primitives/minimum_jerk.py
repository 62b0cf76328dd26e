"""Minimum-jerk movements between two states, through via-points at given times, and on from another movement."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ._knot_solver import knot_states
from .array_api import (
    END_NAMES,
    FREE,
    Array,
    Boundary,
    as_floats,
    as_number,
    broadcast_batch,
    broadcast_to,
    check_durations,
    end_shapes,
    is_given,
    leading_shape,
    read_arguments,
    require,
    waypoint_shapes,
)
from .passage_times import passage_durations
from .trajectory import Trajectory, connect, require_trajectory

ORDERS = (2, 3, 4)


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


def check_order(order: int, start_acceleration: Boundary, goal_acceleration: Boundary) -> None:
    """Raise ValueError for an unknown order, or for order 2 with boundary accelerations."""
    if not isinstance(order, int | np.integer) or order not in ORDERS:
        raise ValueError(f"order must be 2 (acceleration), 3 (jerk) or 4 (snap), got {order!r}")
    if order == 2 and (is_given(start_acceleration) or is_given(goal_acceleration)):
        raise ValueError("no acceleration can be given for order 2: least acceleration leaves it open")


def retarget(
    trajectory: Trajectory,
    time: Array,
    goal: Array,
    arrival: Array,
    *,
    via: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
    freeze: float = 0.0,
) -> Trajectory:
    """Return a movement that continues another one from `time` on, towards a new goal.

    It has the least jerk from the position, velocity and acceleration of the old movement at `time` (Eqs. 25
    to 27 of the minimum-jerk primer). It may be retargeted again.

    It is the rest of the old movement if no via-point is left to pass and goal, arrival, goal velocity and goal
    acceleration are the old ones. A via-point of the old movement that still lies ahead is dropped unless it is
    given again as `via`. A single one whose passage time was free is then passed as before.

    Args:
        trajectory: the movement under way, of order 3.
        time: (...,) present time on the trajectory's clock [s].
        goal: (..., D) new goal [m].
        arrival: (...,) new time of arrival on the trajectory's clock [s].
        via: (..., D) the one via-point of the new movement, passed at its free passage time [m]; (K, D) makes a batch
            of K movements.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = the value of least cost.
        goal_acceleration: (..., D) [m/s^2]; likewise.
        freeze: remaining time to the old arrival [s] below which the old goal, arrival and final state are
            kept, whatever the arguments say, and all via-points are dropped. Near arrival an error of the state
            becomes a jerk of 60 dx / R^3 + 36 dv / R^2 + 9 da / R, where R is the remaining time.

    Returns:
        The movement from `time` on; its own clock starts at 0.

    Raises:
        ValueError: time lies before the start or not before the old or the new arrival; freeze is negative
            or not finite; an argument is not finite or has a wrong shape.

    Example:
        >>> from viapoint.primitives import point_to_point, retarget
        >>> reach = point_to_point([0.0, 0.0], [0.3, 0.0], 0.8)
        >>> turned = retarget(reach, 0.3, [0.2, 0.2], 1.0)
        >>> float(turned.duration), bool((abs(turned(0.0, 1) - reach(0.3, 1)) < 1e-12).all())
        (0.7, True)
    """
    require_trajectory(trajectory)
    named = {"goal_velocity": goal_velocity, "goal_acceleration": goal_acceleration}
    if trajectory.order != 3:
        raise ValueError(f"trajectory must have order 3 to be continued, got order {trajectory.order}")
    if not 0 <= as_number(freeze) < math.inf:
        raise ValueError(f"freeze must be a finite number of at least 0, got {freeze!r}")
    arrays = trajectory.floats({"via": via, **named}, widest=True, time=time, goal=goal, arrival=arrival)
    xp, (time, goal, arrival, via, *ends) = trajectory.namespace, arrays
    targets = {"goal": goal, **dict(zip(named, ends, strict=True))}
    points = targets if via is None else {**targets, "via": via}
    batch = broadcast_batch(
        trajectory=trajectory.batch_shape,
        time=tuple(time.shape),
        arrival=tuple(arrival.shape),
        **end_shapes(points, trajectory.dimension),
    )
    time = broadcast_to(xp, time, batch)
    arrival = broadcast_to(xp, arrival, batch)
    end = broadcast_to(xp, trajectory.duration, batch)
    require(time >= 0, "time", time, "must not be negative")
    under_way = (time < end) | ((time <= 0) & (end <= 0))
    require(under_way, "time", time, "must lie before the end of the movement")
    if freeze > 0:
        frozen = end - time < freeze
        arrival = xp.where(frozen, end, arrival)
        targets, via = _keep_old_target(trajectory, frozen, targets, via)
    require(arrival > time, "arrival", arrival, "must lie after time")
    position, *motion = (value[..., 0, :] for value in trajectory.sample(time[..., None], (0, 1, 2)))
    goal, *final = targets.values()
    states: dict[str, Any] = dict(zip(END_NAMES, (*motion, *final), strict=True))
    passed = [position, goal] if via is None else [position, via, goal]
    shape = (*batch, trajectory.dimension)
    waypoints = xp.stack([broadcast_to(xp, point, shape) for point in passed], axis=-2)
    remaining = arrival - time
    durations = remaining[..., None] if via is None else passage_durations(waypoints, remaining, **states)
    return through(waypoints, durations, **states)


def _keep_old_target(
    trajectory: Trajectory, frozen: Array, targets: dict[str, Any], via: Array | None
) -> tuple[dict[str, Any], Array | None]:
    """Return targets and via-point, with the old final state as the target of frozen movements."""
    xp, shape = trajectory.namespace, (*frozen.shape, trajectory.dimension)
    old = trajectory.sample(trajectory.duration[..., None], (0, 1, 2))
    mixed: dict[str, Any] = {}
    for (name, value), end in zip(targets.items(), old, strict=True):
        if value is FREE:
            raise ValueError(f"{name} cannot be FREE together with freeze, which fixes the final state")
        end = broadcast_to(xp, end[..., 0, :], shape)
        value = xp.zeros_like(end) if value is None else broadcast_to(xp, value, shape)
        mixed[name] = xp.where(frozen[..., None], end, value)
    if via is not None:
        # A via-point that equals the goal gets the duration 0 and is dropped.
        via = xp.where(frozen[..., None], mixed["goal"], broadcast_to(xp, via, shape))
    return mixed, via
