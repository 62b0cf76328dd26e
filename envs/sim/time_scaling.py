"""Time scaling of movements for the limits of the arm's joints."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.arrays import take
from viapoint.envs.common.types import Bool, Float

CHECK_INTERVAL = 0.008
"""Time between checks of a plan's clearance and reach, every few millimetres, [s]."""
CHECKS_PER_MOVEMENT, MIN_CHECKS_PER_SEGMENT = 32, 12
"""Times at which the arm's limits are checked, per movement and per segment at least."""
SECOND_CHECKS = np.linspace(-1.0, 1.0, 10)[1:-1]
"""Relative places of the second checks between the neighbours of the most demanding time of each segment."""
FIRST_CHECK_MARGIN = 1.1
"""Margin of the first check: a movement that would reach a limit if it were this much faster is checked again."""
BLOCK_SIZE = 256
"""Movements checked in one call; a larger batch leaves the cache."""


class TimeScale(NamedTuple):
    """Time scaling that the arm's limits require of N movements."""

    stretch: Float
    """Factor by which each must be slowed down, shape (N,); 1 if that is not needed or out of reach."""
    within: Bool
    """True if the movement stays within reach at the checked times, shape (N,)."""


def required_time_scale(arm: Arm, plan: Any) -> TimeScale:
    """Return the time scaling that joint limits require; for an arm without limits, check the reach of short plans.

    The plan is a record of N movements with `durations` of their segments [s] and `trajectory()`.
    """
    number, segments = plan.durations.shape
    stretch, within = np.ones(number), np.ones(number, dtype=bool)
    # The reach of longer segments is checked as densely where their clearance is computed.
    short = (plan.durations < CHECK_INTERVAL * checks_per_segment(segments)).any(axis=-1)
    rows = np.arange(number) if arm.velocity_limit else np.flatnonzero(short)
    for first in range(0, len(rows), BLOCK_SIZE):
        some = rows[first : first + BLOCK_SIZE]
        stretch[some], within[some] = _check_block(arm, take(plan, some))
    return TimeScale(stretch, within)


def checks_per_segment(segments: int) -> int:
    """Return the number of checks of each segment."""
    return max(-(-CHECKS_PER_MOVEMENT // segments), MIN_CHECKS_PER_SEGMENT)


def _check_block(arm: Arm, plan: Any) -> TimeScale:
    """Check one block of movements."""
    durations = plan.durations
    number, segments = durations.shape
    each = checks_per_segment(segments)
    ends = np.cumsum(durations, axis=-1)
    apart = durations / each
    times = (ends - durations)[..., None] + apart[..., None] * np.arange(each + 1)
    trajectory = plan.trajectory()
    position, velocity, acceleration = trajectory.sample(times.reshape(number, -1))
    within = np.all(np.asarray(arm.reach_margin(position)) >= 0.0, axis=-1)
    if not arm.velocity_limit:
        return TimeScale(np.ones(number), within)
    demand = _demand(arm, position, velocity, acceleration).reshape(times.shape)
    stretch = demand.max(axis=(1, 2))
    near = np.flatnonzero(within & (stretch > 1.0 / FIRST_CHECK_MARGIN))
    if len(near):
        about = np.take_along_axis(times[near], demand[near].argmax(axis=-1)[..., None], axis=-1)
        again = np.clip(about + apart[near, :, None] * SECOND_CHECKS, 0.0, ends[near, -1, None, None])
        closer = _demand(arm, *take(plan, near).trajectory().sample(again.reshape(len(near), -1)))
        stretch[near] = np.maximum(stretch[near], closer.max(axis=-1))
    return TimeScale(np.where(within, np.maximum(stretch, 1.0), 1.0), within)


def _demand(arm: Arm, position: Float, velocity: Float, acceleration: Float) -> Float:
    """Return the factor that the state at each time requires, shape (N, T), at least 1 / FIRST_CHECK_MARGIN."""
    faster = FIRST_CHECK_MARGIN * velocity[:, :, None], FIRST_CHECK_MARGIN**2 * acceleration[:, :, None]
    return np.asarray(arm.required_time_scale(position[:, :, None], *faster)) / FIRST_CHECK_MARGIN
