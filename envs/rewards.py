"""Rewards of all tasks."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from viapoint.envs.common.arrays import Bool, Float
from viapoint.envs.common.validation import number_of_at_least
from viapoint.envs.outcome import Outcome, straight_jerk_cost
from viapoint.envs.plans import SHORTEST_DURATION

CLEARANCE_RANGE = (-0.05, 0.01)  # Range in which clearance changes the reward, [m]
CLEARANCE_UNIT = 0.05  # Unit of the clearance term, [m]
SMALLEST = 1e-6  # Least length of a way to the goal that rewards are relative to, [m] or [rad]


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weights of the terms of the reward, 0 or more; see `reward_terms`.

    Example:
        >>> from viapoint.envs import RewardWeights
        >>> RewardWeights(smoothness=0.0).success
        1.0
    """

    success: float = 1.0
    """Success at the end of the episode."""
    collision: float = 0.5
    """Contact at any physics step, negative."""
    clearance: float = 0.5
    """Clearance of the plan, within bounds."""
    goal_error: float = 0.5
    """Distance from the goal at the end of the episode, negative."""
    smoothness: float = 0.1
    """Logarithm of the jerk cost, negative."""
    duration: float = 0.25
    """Duration, negative."""
    progress: float = 0.0
    """Way towards the goal in each decision."""

    def __post_init__(self) -> None:
        """Check that no weight is negative."""
        for field in dataclasses.fields(self):
            value = number_of_at_least(f"reward weight {field.name}", getattr(self, field.name), 0.0)
            object.__setattr__(self, field.name, value)


# Names of the terms of the reward in infos
TERMS = tuple(f"reward_{field.name}" for field in dataclasses.fields(RewardWeights))


def reward_terms(
    before: Outcome,
    after: Outcome,
    first: Bool,
    ended: Bool,
    length: Float,
    zero_duration: Float,
    goal_unit: float,
    weights: RewardWeights,
) -> dict[str, Float]:
    """Return the weighted terms of one decision of N episodes by their names in infos, shape (N,) each.

    Over an episode the terms add up to

        w_success 1[success] - w_collision 1[contact] + w_clearance clip(c, -5 cm, 1 cm) / 5 cm
        - w_goal min(e / u, 1) - w_smoothness log(1 + J / J_0) - w_duration T / T_0 + w_progress (1 - e / length)

    with the clearance c of all that was commanded, its jerk cost J and duration T until a contact, the distance e from
    the goal at the end, and the jerk cost J_0 and the duration T_0 of the straight movement of the zero action. With
    the default weights a success is worth more than a failure unless its plan is very slow or rough: the term of the
    duration is -1 where T is 4 T_0, that of smoothness where J is 22,000 J_0. The duration T_0 is the best one of a
    straight movement.

    Metrics are those before and after the decision, which is the `first` of an episode or not, and `ended` it or not.
    The length is that from start to goal, [m] or [rad], and u, `goal_unit`, the distance at which the term of the goal
    saturates.
    """
    later = ~first  # before the first decision nothing was commanded
    clearance = _bounded(after.planned_clearance) - later * _bounded(before.planned_clearance)
    # An arm that is at the goal already has no way to go, and needs no time.
    length = np.maximum(length, SMALLEST)
    zero_duration = np.maximum(zero_duration, SHORTEST_DURATION)
    cost = straight_jerk_cost(length, zero_duration)  # J_0
    rough = np.log1p(after.jerk_cost / cost) - np.log1p(before.jerk_cost / cost)
    spent = (after.duration - before.duration) / zero_duration
    far = np.minimum(after.goal_error / goal_unit, 1.0)
    nearer = (before.goal_error - after.goal_error) / length
    return {
        "reward_success": np.where(ended & after.is_success, weights.success, 0.0),
        "reward_collision": np.where(ended & after.collision, -weights.collision, 0.0),
        "reward_clearance": weights.clearance * clearance,
        "reward_goal_error": np.where(ended, -weights.goal_error * far, 0.0),
        "reward_smoothness": -weights.smoothness * rough,
        "reward_duration": -weights.duration * spent,
        "reward_progress": weights.progress * nearer,
    }


def _bounded(clearance: Float) -> Float:
    """Return clearance within the range that changes the reward, in its unit."""
    return np.asarray(np.clip(clearance, *CLEARANCE_RANGE) / CLEARANCE_UNIT)
