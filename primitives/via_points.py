"""Through via-points: the smoothest movement that passes given points at given times."""

from __future__ import annotations

from ._arrays import (
    FREE,
    Array,
    Boundary,
    Namespace,
    as_floats,
    broadcast_batch,
    broadcast_to,
    refuse_free,
    require,
)
from ._banded import States
from ._connecting import boundary_values, check_boundary_shapes, check_order, connect, end_states
from .trajectory import Trajectory


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
