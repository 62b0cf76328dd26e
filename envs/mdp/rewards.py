"""Rewards of all tasks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.common.validation import number_of_at_least
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Outcome, straight_jerk_cost

CLEARANCE_RANGE = (-0.05, 0.01)
"""Range in which clearance changes the reward, [m]."""
CLEARANCE_UNIT = 0.05
"""Unit of the clearance term, [m]."""
GOAL_ERROR_UNIT = 0.1
"""Unit of the goal error term, and the goal error at which it saturates, [m]."""


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weights of the terms of the reward, 0 or more."""

    success: float = 1.0
    """+ 1[success]."""
    collision: float = 0.5
    """- 1[contact at any physics step]."""
    clearance: float = 0.5
    """+ clip(planned_clearance, -0.05 m, 0.01 m) / 0.05 m; the plan's, as a crash ends at the surface."""
    goal_error: float = 0.5
    """- min(goal_error / 0.1 m, 1)."""
    smoothness: float = 0.1
    """- log(jerk cost / jerk cost of the zero action), never less than 0 for the same duration."""
    duration: float = 0.5
    """- (duration / duration of the zero action - 1)."""

    def __post_init__(self) -> None:
        """Check that no weight is negative."""
        for field in dataclasses.fields(self):
            number_of_at_least(f"reward weight {field.name}", getattr(self, field.name), 0.0)

    @classmethod
    def of(cls, weights: RewardWeights | Mapping[str, float] | None) -> RewardWeights:
        """Return weights from a record, from a mapping of some of them, or the defaults.

        Raises:
            ValueError: The argument is something else, or names an unknown term.
        """
        if weights is None:
            return cls()
        known = {field.name for field in dataclasses.fields(cls)}
        if isinstance(weights, Mapping) and known >= set(weights):
            return cls(**weights)
        if isinstance(weights, RewardWeights) and known == set(vars(weights)):
            return weights
        raise ValueError(
            f"reward_weights must be {cls.__name__} or a mapping with some of {', '.join(sorted(known))}, "
            f"got {weights!r}"
        )


class RewardTerms(NamedTuple):
    """Weighted terms of N rewards, shape (N,) each; the reward is their sum."""

    success: Float
    collision: Float
    clearance: Float
    goal_error: Float
    smoothness: Float
    duration: Float

    def total(self) -> Float:
        """Return the reward, shape (N,): the terms added in order."""
        return np.asarray(sum(self))

    def as_info(self) -> dict[str, Any]:
        """Return the terms as `reward_*`."""
        return {f"reward_{name}": term for name, term in self._asdict().items()}


def reward_terms(outcome: Outcome, centre_duration: float, weights: RewardWeights) -> RewardTerms:
    """Return the weighted terms of movements.

    Every term is bounded, so that no movement outweighs all others. With the default weights any success is worth
    more than any failure; and among movements of one shape the one of the centre duration is best: there a longer
    one costs as much time as it saves jerk.
    """
    relative: Any = outcome.duration / centre_duration
    log_jerk = np.log(outcome.jerk_ratio) - 5.0 * np.log(relative)  # jerk cost scales with duration^-5
    success, collision, clearance = outcome.is_success, outcome.collision, outcome.planned_clearance
    return weighted_terms(success, collision, clearance, outcome.goal_error, log_jerk, relative, weights)


def weighted_terms(
    success: NDArray[Any],
    collision: NDArray[np.bool_],
    clearance: NDArray[Any],
    goal_error: NDArray[Any],
    log_jerk: NDArray[Any],
    relative_duration: NDArray[Any],
    weights: RewardWeights,
) -> RewardTerms:
    """Return the weighted terms from arrays of one shape; shared by environments and planners.

        r = w_success s - w_collision 1[collision] + w_clearance clip(c, -0.05 m, 0.01 m) / 0.05 m
            - w_goal min(e / 0.1 m, 1) - w_smoothness log_jerk - w_duration (T / T_0 - 1)

    Args:
        success: Success s, or its probability in [0, 1].
        collision: Contact at any time.
        clearance: Planned clearance c, [m].
        goal_error: Distance e from the goal at the end, [m].
        log_jerk: Log of the jerk cost relative to the zero action.
        relative_duration: Duration T relative to the duration T_0 of the zero action.
        weights: Weights of the terms.
    """
    return RewardTerms(
        success=float(weights.success) * success,
        collision=np.multiply(-float(weights.collision), collision, dtype=np.float64),
        clearance=weights.clearance * np.clip(clearance, *CLEARANCE_RANGE) / CLEARANCE_UNIT,
        goal_error=-weights.goal_error * np.minimum(goal_error / GOAL_ERROR_UNIT, 1.0),
        smoothness=-weights.smoothness * log_jerk,
        duration=-weights.duration * (relative_duration - 1.0),
    )


@dataclass(frozen=True, kw_only=True)
class ReplanningRewardWeights(RewardWeights):
    """Weights of the terms of the reward, 0 or more."""

    smoothness: float = 0.05
    """- log(1 + jerk cost so far / jerk cost of the straight movement), less what was given before."""
    duration: float = 0.2
    """- time that the decision took / duration of the zero action."""


def replanning_rewards(
    before: Outcome,
    after: Outcome,
    elapsed: Float,
    ended: Bool,
    begun: Bool,
    scenes: ChangingScenes,
    centre_duration: float,
    weights: RewardWeights,
) -> RewardTerms:
    """Return the weighted terms of one decision of N episodes.

    Over an episode clearance and smoothness sum to what they are of all that was commanded, the duration to its time.

    Args:
        before: Metrics before the decision.
        after: Metrics after the decision.
        elapsed: Time of the decision, shape (N,), [s].
        ended: True if the episode ended, shape (N,).
        begun: True for the first decision of an episode, shape (N,).
        scenes: Scenes of the N episodes.
        centre_duration: Duration of the zero action, [s].
        weights: Weights of the terms.
    """
    low, high = CLEARANCE_RANGE
    kept, lost = (np.clip(each.planned_clearance, low, high) / CLEARANCE_UNIT for each in (after, before))
    straight = straight_jerk_cost(norm(scenes.goal - scenes.start), centre_duration)
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


@dataclass(frozen=True, kw_only=True)
class StepRewardWeights(RewardWeights):
    """Weights of the terms of a control step's reward, 0 or more."""

    progress: float = 1.0
    """+ how much nearer the goal, as a share of the distance at the start."""


def step_rewards(
    before: Outcome,
    after: Outcome,
    ended: NDArray[np.bool_],
    begun: NDArray[np.bool_],
    scenes: Scenes,
    centre_duration: float,
    weights: StepRewardWeights,
) -> tuple[RewardTerms, Float]:
    """Return the weighted terms of one control step of N episodes, and the progress term.

    Over an episode the terms of a success sum to those of a whole movement with the same outcome, and the progress to
    its weight. Clearance and goal error are given when they change, the others at the end; smoothness and duration
    count where the hand arrived only, as a movement that ends early would seem the smoothest and quickest. The
    arguments are those of :func:`replanning_rewards`, with a control step for a decision.
    """
    whole = reward_terms(after, centre_duration, weights)
    low, high = CLEARANCE_RANGE
    lost = weights.clearance * np.clip(before.planned_clearance, low, high) / CLEARANCE_UNIT
    far = -weights.goal_error * np.minimum(before.goal_error / GOAL_ERROR_UNIT, 1.0)
    arrived = after.is_success
    terms = RewardTerms(
        success=np.where(ended, whole.success, 0.0),
        collision=np.where(ended, whole.collision, 0.0),
        clearance=whole.clearance - np.where(begun, 0.0, lost),
        goal_error=whole.goal_error - np.where(begun, 0.0, far),
        smoothness=np.where(ended & arrived, whole.smoothness, 0.0),
        duration=np.where(ended & arrived, whole.duration, 0.0),
    )
    distance = norm(scenes.goal - scenes.start)
    return terms, np.asarray(weights.progress * (before.goal_error - after.goal_error) / distance)
