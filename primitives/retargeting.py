"""Replanning: a movement under way gets another goal, arrival time or via-point."""

from __future__ import annotations

from math import inf
from typing import Any

from .array_api import FREE, Array, Boundary, as_number, broadcast_batch, broadcast_to, require
from .minimum_jerk import END_NAMES, end_shapes, through
from .passage_times import passage_durations
from .trajectory import Trajectory, require_trajectory


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
    if not 0 <= as_number(freeze) < inf:
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
