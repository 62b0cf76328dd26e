"""How much slower a movement is made for the limits of the arm's joints, and whether it stays within their reach."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Bool, Float

LOOK_EVERY = 0.008
"""Clearance and reach of the plan are looked at that often, which is every few millimetres, [s]."""
LOOKS, LEAST = 32, 12
"""At how many times a movement is looked at for the arm's limits, and each of its segments at least."""
CLOSER = np.linspace(-1.0, 1.0, 10)[1:-1]
"""Where it is looked at again: around the look with the greatest demand of each segment, up to those beside it."""
NEARLY = 1.1
"""A movement that would be at a limit if it were so much faster is looked at again."""
TOGETHER = 256
"""Movements that are looked at together: as many steps of the inverse dynamics for many as for one."""


class TimeScale(NamedTuple):
    """What the arm's limits ask of N movements."""

    stretch: Float
    """By which factor each must be slowed down, shape (N,); 1 where it need not, or leaves the reach."""
    within: Bool
    """Whether it stays within the reach where it was looked at, shape (N,)."""


def required_time_scale(arm: Arm, plan: Any) -> TimeScale:
    """What limits ask of plans: of an arm that has none, only how short ones keep within its reach.

    Args:
        arm: That would move.
        plan: N movements, with `durations` of their segments [s], `trajectory()` and `take(rows)`.
    """
    number, segments = plan.durations.shape
    stretch, within = np.ones(number), np.ones(number, dtype=bool)
    # Others are looked at no less often where their clearance is computed.
    short = (plan.durations < LOOK_EVERY * looks_of(segments)).any(axis=-1)
    rows = np.arange(number) if arm.velocity_limit else np.flatnonzero(short)
    for first in range(0, len(rows), TOGETHER):
        some = rows[first : first + TOGETHER]
        stretch[some], within[some] = _looked_at(arm, plan.take(some))
    return TimeScale(stretch, within)


def looks_of(segments: int) -> int:
    """At how many times each of so many segments is looked at."""
    return max(-(-LOOKS // segments), LEAST)


def _looked_at(arm: Arm, plan: Any) -> TimeScale:
    """The same of some of them, with all of their segments."""
    durations = plan.durations
    number, segments = durations.shape
    each = looks_of(segments)
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
    near = np.flatnonzero(within & (stretch > 1.0 / NEARLY))
    if len(near):
        about = np.take_along_axis(times[near], demand[near].argmax(axis=-1)[..., None], axis=-1)
        again = np.clip(about + apart[near, :, None] * CLOSER, 0.0, ends[near, -1, None, None])
        closer = _demand(arm, *plan.take(near).trajectory().sample(again.reshape(len(near), -1)))
        stretch[near] = np.maximum(stretch[near], closer.max(axis=-1))
    return TimeScale(np.where(within, np.maximum(stretch, 1.0), 1.0), within)


def _demand(arm: Arm, position: Float, velocity: Float, acceleration: Float) -> Float:
    """By which factor movements must be slowed down for each of their times, shape (N, T); no less than 1 / NEARLY."""
    faster = NEARLY * velocity[:, :, None], NEARLY**2 * acceleration[:, :, None]
    return np.asarray(arm.required_time_scale(position[:, :, None], *faster)) / NEARLY
