"""Metrics of executed movements."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.common.arrays import Bool, Float, Int

SETTLING = 0.1  # Time after the movement in which the arm must come to rest, [s]
LIMIT_TOLERANCE = 1e-3  # Tolerance of MuJoCo's soft joint limits, [rad]


class Tolerance(NamedTuple):
    """Bounds of success at the end of a movement."""

    goal: float  # Greatest distance from the goal, [m] of the hand, or [rad] of the farthest joint
    speed: float  # Greatest speed that counts as rest, [m/s] or [rad/s]
    unit: float  # Distance from the goal at which the reward's goal error saturates, [m] or [rad]


TOLERANCES = {"hand": Tolerance(0.01, 0.02, 0.1), "joints": Tolerance(0.02, 0.05, 0.2)}
"""Bounds of success by the space of the movement."""


class Rollout(NamedTuple):
    """One movement at its T physics steps."""

    time: Float  # Shape (T,), [s]
    planned: Float  # Planned positions in the space of the movement, shape (T, D), [m] or [rad]
    joints: Float  # Joint positions, shape (T, J), [rad]
    hand: Float  # Executed hand positions, shape (T, 3), [m]
    contact: Bool  # True where the arm was in contact at the state before the step, shape (T,)
    clearance: Float  # Clearance from the nearest obstacle, shape (T,), [m]


class Outcome(NamedTuple):
    """Metrics of N executed movements, shape (N,) each."""

    is_success: Bool
    """True for no contact, joint limits kept, a plan within reach, stable physics, and rest at the goal in the end."""
    collision: Bool  # True for contact with an obstacle or of the arm with itself
    first_contact_time: Float  # Time of the first contact, [s]; -1 without contact
    min_clearance: Float  # Least clearance from obstacles over all physics steps, [m]; at most 1
    self_clearance: Float  # Least clearance of the arm from itself over all physics steps, [m]; at most 1
    planned_clearance: Float
    """Least clearance of the plan from obstacles and of the arm from itself, [m]; negative for a depth; at most 1."""
    goal_error: Float
    """Distance from the goal after the settling time: of the hand [m], in joint space the greatest of a joint [rad]."""
    duration: Float  # Duration of the plan, until a contact, [s]
    path_length: Float  # Length of the hand's path, [m]
    jerk_cost: Float
    """Jerk cost of the plan until a contact: half the integral of its squared jerk, [m^2/s^5] or [rad^2/s^5]."""
    jerk_ratio: Float  # Jerk cost relative to the straight movement's of the same duration
    peak_speed: Float  # Greatest speed of the hand, [m/s]
    tracking_error: Float  # Root mean square distance from the plan, [m], in joint space [rad]
    reachable: Bool
    """True if the whole plan is within the arm's reach and joint limits; otherwise the arm does not start."""
    unstable: Bool  # True if the physics broke down
    stretch: Float  # Factor by which the movement was slowed down for the arm's limits, 1 or more


class EpisodeState(NamedTuple):
    """Metrics of N running episodes so far, shape (N, ...) each; compiled functions change it in place."""

    joints: Float  # Present joint positions, shape (N, J), [rad]
    hand: Float  # Present hand positions, shape (N, 3), [m]
    steps: Int  # Physics steps so far
    first_contact: Int  # Physics step of the first contact, -1 without contact
    min_clearance: Float  # Least clearance from obstacles, [m]
    self_clearance: Float  # Least clearance from itself, [m]
    planned_clearance: Float  # Least clearance of the commanded path, [m]
    path_length: Float  # Length of the hand's path, [m]
    peak_speed: Float  # Greatest hand speed, [m/s]
    last_speed: Float  # Speed in the last physics step, [m/s] of the hand or [rad/s] of the fastest joint
    rest: Int  # Last physics steps in which the arm was at rest at the goal
    deviation: Float  # Sum of the squared distances between arm and command, [m^2] or [rad^2]
    jerk_cost: Float  # Jerk cost of the commanded path, [m^2/s^5] or [rad^2/s^5]
    stretch: Float  # Greatest factor by which a plan was slowed down
    within: Bool  # True while the joints have kept their limits
    reachable: Bool  # True while the command has stayed within the arm's reach
    unstable: Bool  # True if the physics broke down

    @classmethod
    def at_rest(cls, joints: Float, hand: Float, clearance: Float, self_clearance: Float) -> EpisodeState:
        """Return the state of episodes that begin, for joint and hand positions, (N, J) and (N, 3), and clearances."""
        number = len(joints)
        return cls(
            joints=joints.copy(),
            hand=hand.copy(),
            steps=np.zeros(number, np.int64),
            first_contact=np.full(number, -1),
            min_clearance=clearance.copy(),
            self_clearance=self_clearance.copy(),
            planned_clearance=np.minimum(clearance, self_clearance),  # the start is commanded, too
            path_length=np.zeros(number),
            peak_speed=np.zeros(number),
            last_speed=np.zeros(number),
            rest=np.zeros(number, np.int64),
            deviation=np.zeros(number),
            jerk_cost=np.zeros(number),
            stretch=np.ones(number),
            within=np.ones(number, bool),
            reachable=np.ones(number, bool),
            unstable=np.zeros(number, bool),
        )


def straight_jerk_cost(length: Float | float, duration: Float | float) -> Float:
    """Return the jerk cost of straight minimum-jerk movements from rest to rest, [m^2/s^5] or [rad^2/s^5].

    Half the integral of the squared jerk is 360 A^2 / T^5 for length A and duration T.
    """
    return np.asarray(360.0 * length**2 / duration**5)


def relative_jerk(cost: Float | float, straight: Float | float) -> Float:
    """Return jerk costs relative to those of straight movements, at least 1, and 1 where there is no movement at all.

    Where the straight movement is none, but the other one moves, it is NaN.
    """
    cost, straight = np.broadcast_arrays(cost, straight)
    none = np.where(cost == 0.0, 1.0, np.nan)
    return np.maximum(np.divide(cost, straight, where=straight > 0.0, out=none), 1.0)
