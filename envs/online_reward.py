"""What a decision of several is worth: terms whose sums over an episode mean something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.courses import ChangingScenes
from viapoint.envs.outcome import Outcome, norm
from viapoint.envs.reward import CLEARANCE_RANGE, CLEARANCE_UNIT, GOAL_ERROR_UNIT, RewardTerms, RewardWeights

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class OnlineRewardWeights(RewardWeights):
    """How much each term counts, 0 or more."""

    smoothness: float = 0.05
    """- log(1 + jerk cost so far / jerk cost of the straight movement), less what was given before."""
    duration: float = 0.2
    """- time that the decision took / duration of the zero action."""


def online_rewards(
    before: Outcome,
    after: Outcome,
    elapsed: Float,
    ended: Bool,
    begun: Bool,
    scenes: ChangingScenes,
    centre_duration: float,
    weights: RewardWeights,
) -> RewardTerms:
    """The weighted terms of one decision of N episodes.

    Over an episode clearance and smoothness sum to what they are of all that was commanded, the duration to its time.

    Args:
        before: The decision.
        after: It.
        elapsed: Time that it took, shape (N,), [s].
        ended: Whether the episode ended in it, shape (N,).
        begun: Whether it is the episode's first.
        scenes: N of them.
        centre_duration: Duration of the zero action, [s].
        weights: Of the terms.
    """
    low, high = CLEARANCE_RANGE
    kept, lost = (np.clip(each.planned_clearance, low, high) / CLEARANCE_UNIT for each in (after, before))
    straight = 360.0 * norm(scenes.goal - scenes.start) ** 2 / centre_duration**5  # half of 720 A^2/T^5
    rough = np.log1p(after.jerk_cost / straight) - np.log1p(before.jerk_cost / straight)
    far = np.minimum(after.goal_error / GOAL_ERROR_UNIT, 1.0)
    return RewardTerms(
        success=np.where(after.is_success, weights.success, 0.0),
        collision=np.where(after.collision, -weights.collision, 0.0),
        clearance=weights.clearance * (kept - np.where(begun, 0.0, lost)),
        goal_error=np.where(ended, -weights.goal_error * far, 0.0),
        smoothness=-weights.smoothness * rough,
        duration=-weights.duration * elapsed / centre_duration,
    )
