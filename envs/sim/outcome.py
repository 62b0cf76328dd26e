"""What came of a movement."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Bool, Float

GOAL_TOLERANCE = 0.01
"""Greatest distance from the goal that counts as success, [m]."""
REST_SPEED = 0.02
"""Greatest hand speed at the end that counts as rest, [m/s]."""
LIMIT_TOLERANCE = 1e-3
"""How far MuJoCo's soft limits may give way, [rad]."""


class Outcome(NamedTuple):
    """What came of N movements, shape (N,) each."""

    is_success: Bool
    """No contact, joint limits kept, at rest within 1 cm of the goal after the settling time."""
    collision: Bool
    """Contact at any physics step."""
    first_contact_time: Float
    """[s]; -1 without contact."""
    min_clearance: Float
    """[m], exact, over all physics steps; at most 1."""
    planned_clearance: Float
    """[m], of the plan: how deep it would cut into an obstacle that gave way; at most 1."""
    goal_error: Float
    """[m], after the settling time."""
    duration: Float
    """[s], planned, and stretched where the arm's limits ask for it."""
    path_length: Float
    """[m], of the hand."""
    jerk_cost: Float
    """Half the integral of the planned squared jerk, [m^2/s^5]."""
    jerk_ratio: Float
    """Jerk cost relative to the straight movement's of the same duration."""
    peak_speed: Float
    """[m/s], of the hand."""
    tracking_error: Float
    """[m], root mean square of hand minus plan."""
    reachable: Bool
    """Whether the whole plan is within the arm's reach; if not, the arm does not start."""
    unstable: Bool
    """Whether the physics broke down."""
    stretch: Float
    """By which factor the movement was slowed down for the arm's limits; 1 where it was not."""


def straight_jerk_cost(length: Float, duration: Float) -> Float:
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
