"""Minimum-jerk trajectories between two states and through via-points at given times."""

from __future__ import annotations

from ._boundary import boundary_values, check_boundary_shapes, check_order, connect, end_states
from ._knot_solver import States
from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    as_floats,
    broadcast_batch,
    broadcast_to,
    refuse_free,
    require,
    require_vectors,
)
from .trajectory import Trajectory


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

    At rest on both ends and with order 3 it is Flash & Hogan's Eq. 2,
    x(t) = x0 + (xf - x0)(10 tau^3 - 15 tau^4 + 6 tau^5), tau = t / duration.

    Args:
        start: (..., D) [m].
        goal: (..., D) [m].
        duration: (...,) [s].
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = as the least cost decides (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.
        order: 2, 3 or 4: least acceleration, jerk or snap. Order 2 leaves accelerations open; with order 4
            the jerk is zero at both ends.

    Returns:
        A trajectory of one segment with the broadcast leading shape.

    Raises:
        ValueError: an argument is not finite, has a wrong shape, or duration <= 0.
    """
    check_order(order, start_acceleration, goal_acceleration)
    named = boundary_values(start_velocity, start_acceleration, goal_velocity, goal_acceleration)
    xp, arrays = as_floats(named, start=start, goal=goal, duration=duration)
    start, goal, duration = arrays[:3]
    boundary = dict(zip(named, arrays[3:], strict=True))
    require_vectors("start", start)
    require_vectors("goal", goal, start.shape[-1])
    require(xp, duration > 0, "duration", duration, "must be positive")
    shapes = {
        "start": tuple(start.shape[:-1]),
        "goal": tuple(goal.shape[:-1]),
        "duration": tuple(duration.shape),
    }
    batch = broadcast_batch(**shapes, **check_boundary_shapes(boundary, start.shape[-1]))
    shape = (*batch, start.shape[-1])
    waypoints = xp.stack([broadcast_to(xp, start, shape), broadcast_to(xp, goal, shape)], axis=-2)
    states = [
        end_states(order, boundary["start_velocity"], boundary["start_acceleration"]),
        end_states(order, boundary["goal_velocity"], boundary["goal_acceleration"]),
    ]
    return connect(xp, order, waypoints, duration[..., None], states)


def minimum_jerk_coefficients(
    x0: Array, dx0: Array, ddx0: Array, xT: Array, dxT: Array, ddxT: Array, T: Array
) -> Array:
    """Return the primer's a_0 ... a_5 of x(t) = sum_k a_k t^k, without its pseudo-inverse.

    With V = T dx, A = T^2 ddx and D = xT - x0 the solution is, exactly and for any T > 0,

        a_3 T^3 =  10 D - 6 V0 - 4 VT - 3/2 A0 + 1/2 AT
        a_4 T^4 = -15 D + 8 V0 + 7 VT + 3/2 A0 -     AT
        a_5 T^5 =   6 D - 3 V0 - 3 VT - 1/2 A0 + 1/2 AT

    Args:
        x0: (...,) location at the start [m].
        dx0: (...,) velocity at the start [m/s].
        ddx0: (...,) acceleration at the start [m/s^2].
        xT: (...,) location at the target [m].
        dxT: (...,) velocity at the target [m/s].
        ddxT: (...,) acceleration at the target [m/s^2].
        T: (...,) time from start to target [s].

    Returns:
        (..., 6) coefficients, a_k in m/s^k.

    Raises:
        ValueError: an argument is not finite, does not broadcast, or T <= 0.
    """
    names = ("x0", "dx0", "ddx0", "xT", "dxT", "ddxT", "T")
    xp, arrays = as_floats(**dict(zip(names, (x0, dx0, ddx0, xT, dxT, ddxT, T), strict=True)))
    require(xp, arrays[-1] > 0, "T", arrays[-1], "must be positive")
    shape = broadcast_batch(**{name: tuple(a.shape) for name, a in zip(names, arrays, strict=True)})
    x0, dx0, ddx0, xT, dxT, ddxT, T = (broadcast_to(xp, a, shape)[..., None] for a in arrays)
    movement = point_to_point(
        x0,
        xT,
        T[..., 0],
        start_velocity=dx0,
        start_acceleration=ddx0,
        goal_velocity=dxT,
        goal_acceleration=ddxT,
    )
    scaled = [
        movement.coefficients[..., 0, 0, :],
        dx0,
        ddx0 / 2,
    ]  # a_1, a_2 as given, not by way of unit time
    rate = 1.0 / T
    power = rate * rate
    for k in range(3, 6):
        power = power * rate
        scaled.append(movement.coefficients[..., k, 0, :] * power)
    return xp.concat(scaled, axis=-1)


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

    Velocity and acceleration at the via-points are those of least cost: a symmetric block tridiagonal system,
    solved in a time proportional to their number K. The result is continuous up to x^(2 order - 2) (Flash &
    Hogan, Appendix C).

    Args:
        waypoints: (..., K + 2, D) start, via-points, goal [m].
        durations: (..., K + 1) [s]; 0 is allowed between equal waypoints, the via-point is then dropped.
            Durations (K + 1,) for a batch of waypoints are shared, which is faster.
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = as the least cost decides (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.
        via_velocities: (..., K, D) velocities to have at the via-points [m/s]; None = those of least cost.
        order: 2, 3 or 4: least acceleration, jerk or snap.

    Returns:
        A trajectory of K + 1 segments with the broadcast leading shape.

    Raises:
        ValueError: an argument is not finite or has a wrong shape; a duration is negative, or 0 between
            different waypoints, or they are all 0.
    """
    check_order(order, start_acceleration, goal_acceleration)
    named = boundary_values(start_velocity, start_acceleration, goal_velocity, goal_acceleration)
    if via_velocities is not None:
        refuse_free(via_velocities=via_velocities)
    optional = {"via_velocities": via_velocities, **named}
    xp, arrays = as_floats(optional, waypoints=waypoints, durations=durations)
    waypoints, durations, via_velocities = arrays[:3]
    boundary = dict(zip(named, arrays[3:], strict=True))
    batch = check_waypoints(waypoints, boundary, durations=durations)
    batch = _check_via_velocities(batch, waypoints, via_velocities)
    waypoints = broadcast_to(xp, waypoints, (*batch, *waypoints.shape[-2:]))
    _check_durations(xp, waypoints, durations)
    states: States = [[FREE] * (order - 1) for _ in range(waypoints.shape[-2])]
    states[0] = end_states(order, boundary["start_velocity"], boundary["start_acceleration"])
    states[-1] = end_states(order, boundary["goal_velocity"], boundary["goal_acceleration"])
    if via_velocities is not None:
        for k in range(via_velocities.shape[-2]):
            states[k + 1][0] = via_velocities[..., k, :]
    return connect(xp, order, waypoints, durations, states)


def check_waypoints(
    waypoints: Array,
    boundary: dict[str, Boundary],
    *,
    durations: Array | None = None,
    duration: Array | None = None,
) -> tuple[int, ...]:
    """Return the common leading shape, or raise ValueError naming what is wrong."""
    if waypoints.ndim < 2 or waypoints.shape[-2] < 2 or waypoints.shape[-1] < 1:
        raise ValueError(
            f"waypoints must have shape (..., K + 2, D), K >= 0, got shape {tuple(waypoints.shape)}"
        )
    segments, dimension = waypoints.shape[-2] - 1, waypoints.shape[-1]
    shapes = {"waypoints": tuple(waypoints.shape[:-2])}
    if durations is not None:
        if durations.ndim < 1 or durations.shape[-1] != segments:
            raise ValueError(
                f"durations must have shape (..., {segments}), one for each segment of waypoints "
                f"{tuple(waypoints.shape)}, got shape {tuple(durations.shape)}"
            )
        shapes["durations"] = tuple(durations.shape[:-1])
    if duration is not None:
        shapes["duration"] = tuple(duration.shape)
    return broadcast_batch(**shapes, **check_boundary_shapes(boundary, dimension))


def _check_via_velocities(
    batch: tuple[int, ...], waypoints: Array, velocities: Array | None
) -> tuple[int, ...]:
    if velocities is None:
        return batch
    expected = (waypoints.shape[-2] - 2, waypoints.shape[-1])
    if velocities.ndim < 2 or tuple(velocities.shape[-2:]) != expected:
        wanted = f"(..., {expected[0]}, {expected[1]})"
        raise ValueError(f"via_velocities must have shape {wanted}, got shape {tuple(velocities.shape)}")
    return broadcast_batch(waypoints=batch, via_velocities=tuple(velocities.shape[:-2]))


def _check_durations(xp: Namespace, waypoints: Array, durations: Array) -> None:
    positive = durations > 0
    if positive.all():
        return
    require(xp, durations >= 0, "durations", durations, "must not be negative")
    require(
        xp, xp.any(positive, axis=-1), "durations", xp.sum(durations, axis=-1), "must not all be 0; their sum"
    )
    still = (waypoints[..., 1:, :] == waypoints[..., :-1, :]).all(axis=-1)
    full = broadcast_to(xp, durations, tuple(still.shape))
    require(xp, (full > 0) | still, "durations", full, "may be 0 only between equal waypoints")
