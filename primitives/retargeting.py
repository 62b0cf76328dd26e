"""The online version: a movement under way gets another target, time of arrival or via-point."""

from __future__ import annotations

from math import inf
from typing import Any

from ._boundary import check_boundary_shapes
from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    as_number,
    broadcast_batch,
    broadcast_to,
    refuse_free,
    require,
    require_vectors,
)
from .minimum_jerk import through
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
    """Continue a movement towards another goal, as often as wanted (the primer's Eqs. 25 to 27).

    The new movement takes over position, velocity and acceleration at `time`, so it is as smooth as the old
    one, and is the one of least jerk from there. With the goal and arrival unchanged it is the rest of the
    old one.

    Near arrival: an error of the state is amplified into jerk as 60 dx / R^3 + 36 dv / R^2 + 9 da / R, where
        R is the
    remaining time. Here the state is the trajectory's own, so only rounding is amplified. Whoever plans from
    a measured state instead (`point_to_point` with start values) must stop replanning while R is long enough;
    `freeze` is that rule.

    Args:
        trajectory: the movement under way, of order 3.
        time: (...,) the present, on the trajectory's clock [s].
        goal: (..., D) the new goal [m].
        arrival: (...,) when to be there, on the trajectory's clock [s].
        via: (..., D) a point to pass on the way, at its free passage time [m].
        goal_velocity: (..., D) [m/s]; None = zero, FREE = as the least cost decides.
        goal_acceleration: (..., D) [m/s^2]; likewise.
        freeze: [s] where less time than this remains to the old arrival, the old goal, arrival and final
            state are kept, whatever the arguments say (a given via-point is dropped).

    Returns:
        The movement from `time` on; its own clock starts at 0.

    Raises:
        ValueError: time lies before the start or not before the old or the new arrival; freeze is negative
            or not finite; other bad arguments.
    """
    require_trajectory(trajectory)
    named = {"goal_velocity": goal_velocity, "goal_acceleration": goal_acceleration}
    if trajectory.order != 3:
        raise ValueError(f"trajectory must have order 3 to be continued, got order {trajectory.order}")
    refuse_free(via=via)
    if not 0 <= as_number(freeze) < inf:
        raise ValueError(f"freeze must be a finite number of at least 0, got {freeze!r}")
    arrays = trajectory.floats({"via": via, **named}, time=time, goal=goal, arrival=arrival)
    xp, (time, goal, arrival, via, *ends) = trajectory.namespace, arrays
    targets = {"goal": goal, **dict(zip(named, ends, strict=True))}
    batch = _common_batch(trajectory, time, arrival, targets, via)
    time, arrival = broadcast_to(xp, time, batch), broadcast_to(xp, arrival, batch)
    end = broadcast_to(xp, trajectory.duration, batch)
    require(xp, time >= 0, "time", time, "must not be negative")
    require(xp, time < end, "time", time, "must lie before the end of the movement")
    if freeze > 0:
        frozen = end - time < freeze
        arrival = xp.where(frozen, end, arrival)
        targets, via = _keep_old_target(trajectory, frozen, targets, via, xp)
    require(xp, arrival > time, "arrival", arrival, "must lie after time")
    return _plan(trajectory, time, arrival - time, targets, via, batch, xp)


def _common_batch(
    trajectory: Trajectory, time: Array, arrival: Array, targets: dict[str, Any], via: Array | None
) -> tuple[int, ...]:
    """Return the common leading shape, or raise ValueError naming what is wrong."""
    require_vectors("goal", targets["goal"], trajectory.dimension)
    shapes = {
        "trajectory": trajectory.batch_shape,
        "time": tuple(time.shape),
        "arrival": tuple(arrival.shape),
    }
    if via is not None:
        require_vectors("via", via, trajectory.dimension)
        shapes["via"] = tuple(via.shape[:-1])
    return broadcast_batch(**shapes, **check_boundary_shapes(targets, trajectory.dimension))


def _plan(
    trajectory: Trajectory,
    time: Array,
    remaining: Array,
    targets: dict[str, Any],
    via: Array | None,
    batch: tuple[int, ...],
    xp: Namespace,
) -> Trajectory:
    """Return the movement of least jerk from the state at `time`."""
    position, velocity, acceleration = (v[..., 0, :] for v in trajectory.sample(time[..., None], (0, 1, 2)))
    shape = (*batch, trajectory.dimension)
    points = [position, targets["goal"]] if via is None else [position, via, targets["goal"]]
    waypoints = xp.stack([broadcast_to(xp, point, shape) for point in points], axis=-2)
    ends = {
        "start_velocity": velocity,
        "start_acceleration": acceleration,
        "goal_velocity": targets["goal_velocity"],
        "goal_acceleration": targets["goal_acceleration"],
    }
    durations = remaining[..., None] if via is None else passage_durations(waypoints, remaining, **ends)
    return through(waypoints, durations, **ends)


def _keep_old_target(
    trajectory: Trajectory, frozen: Array, targets: dict[str, Any], via: Array | None, xp: Namespace
) -> tuple[dict[str, Any], Array | None]:
    """Return the targets, those of frozen movements replaced by the old end, and the via-point."""
    shape = (*frozen.shape, trajectory.dimension)
    old = trajectory.sample(trajectory.duration[..., None], (0, 1, 2))
    mixed: dict[str, Any] = {}
    for (name, value), end in zip(targets.items(), old, strict=True):
        if value is FREE:
            raise ValueError(f"{name} cannot be FREE together with freeze, which fixes the final state")
        end = broadcast_to(xp, end[..., 0, :], shape)
        value = xp.zeros_like(end) if value is None else broadcast_to(xp, value, shape)
        mixed[name] = xp.where(frozen[..., None], end, value)
    if via is not None:
        via = xp.where(frozen[..., None], mixed["goal"], broadcast_to(xp, via, shape))
    return mixed, via
