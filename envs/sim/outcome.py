"""Executed movements and their metrics; :class:`~viapoint.envs.sim.episode_state.EpisodeState` computes them.

Clearances come from :class:`~viapoint.envs.arms.base.CollisionModel`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from viapoint.envs.common.types import Bool, Float

if TYPE_CHECKING:
    from viapoint.envs.arms.base import Arm

GOAL_TOLERANCE = 0.01
"""Greatest distance from the goal that counts as success, [m]."""
REST_SPEED = 0.02
"""Greatest hand speed at the end that counts as rest, [m/s]."""
SETTLING = 0.1
"""Time after the movement in which the hand must come to rest, [s]."""
LIMIT_TOLERANCE = 1e-3
"""Tolerance of MuJoCo's soft joint limits, [rad]."""


class Rollout(NamedTuple):
    """One movement at its T physics steps."""

    time: Float
    """Shape (T,), [s]."""
    planned: Float
    """Planned hand positions, shape (T, D), [m]."""
    joints: Float
    """Joint angles, shape (T, J), [rad]."""
    hand: Float
    """Executed hand positions, shape (T, D), [m]."""
    contact: Bool
    """True where the arm touched an obstacle at the state before the step, shape (T,)."""
    clearance: Float
    """Clearance from the nearest obstacle, shape (T,), [m]."""


class Outcome(NamedTuple):
    """Metrics of N executed movements, shape (N,) each."""

    is_success: Bool
    """True for no contact, joint limits kept, and rest within 1 cm of the goal after the settling time."""
    collision: Bool
    """True for contact at any physics step."""
    first_contact_time: Float
    """Time of the first contact, [s]; -1 without contact."""
    min_clearance: Float
    """Least clearance over all physics steps, [m], exact; at most 1."""
    planned_clearance: Float
    """Least clearance of the plan, [m]; negative for the depth inside an obstacle; at most 1."""
    goal_error: Float
    """Distance from the goal after the settling time, [m]."""
    duration: Float
    """Planned duration after time scaling, [s]."""
    path_length: Float
    """Length of the hand's path, [m]."""
    jerk_cost: Float
    """Jerk cost of the plan: half the integral of its squared jerk, [m^2/s^5]."""
    jerk_ratio: Float
    """Jerk cost relative to the straight movement's of the same duration."""
    peak_speed: Float
    """Greatest speed of the hand, [m/s]."""
    tracking_error: Float
    """Root mean square distance of hand and plan, [m]."""
    reachable: Bool
    """True if the whole plan is within the arm's reach; otherwise the arm does not start."""
    unstable: Bool
    """True if the physics broke down."""
    stretch: Float
    """Factor by which the movement was slowed down for the arm's limits, 1 or more."""


def straight_jerk_cost(length: Float, duration: Float | float) -> Float:
    """Return the jerk cost of straight minimum-jerk movements from rest to rest, [m^2/s^5].

    Half the integral of the squared jerk is 360 A^2 / T^5 for length A and duration T.
    """
    return 360.0 * length**2 / duration**5


def within_joint_range(joints: Float, arm: Arm) -> Bool:
    """Return True for each joint angle, shape (..., J), within its limits and MuJoCo's tolerance."""
    low, high = np.array(arm.joint_range).T
    return np.asarray((joints >= low - LIMIT_TOLERANCE) & (joints <= high + LIMIT_TOLERANCE))


def sum_in_order(values: Float) -> Float:
    """Return the sum along the last axis, added one after the other.

    NumPy's pairwise summation depends on the length; here, zeros at the end change no bit.
    """
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])
