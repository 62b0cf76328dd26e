"""What a movement is worth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.outcome import Outcome

Float = NDArray[np.float64]

CLEARANCE_RANGE = (-0.05, 0.01)
"""Clearance beyond which nothing more is lost or won, [m]."""
CLEARANCE_UNIT = 0.05
"""[m]."""
GOAL_ERROR_UNIT = 0.1
"""Goal error at which all is lost, [m]."""


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """How much each term counts, 0 or more."""

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
        """Refuse a weight that turns its term round."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 <= float(value) < np.inf:
                raise ValueError(
                    f"reward weight {field.name} must be a finite number, 0 or more, got {value!r}"
                )

    @classmethod
    def of(cls, weights: RewardWeights | Mapping[str, float] | None) -> RewardWeights:
        """Weights from a record, from a mapping of some of them, or the defaults.

        Raises:
            ValueError: It is something else, or has terms that there are not.
        """
        if weights is not None and not isinstance(weights, RewardWeights | Mapping):
            raise ValueError(f"reward_weights must be a mapping of names to numbers, got {weights!r}")
        given = dict(vars(weights) if isinstance(weights, RewardWeights) else weights or {})
        known = [field.name for field in dataclasses.fields(cls)]
        unknown = sorted(repr(name) for name in given if name not in known)
        if unknown:
            raise ValueError(f"reward_weights knows {', '.join(known)}, not {', '.join(unknown)}")
        return weights if isinstance(weights, RewardWeights) else cls(**given)


class RewardTerms(NamedTuple):
    """The weighted terms, shape (N,) each; the reward is their sum."""

    success: Float
    collision: Float
    clearance: Float
    goal_error: Float
    smoothness: Float
    duration: Float

    def total(self) -> Float:
        """The reward, shape (N,): the terms added in order."""
        return np.asarray(sum(self))

    def as_info(self) -> dict[str, Any]:
        """The terms as `reward_*`."""
        return {f"reward_{name}": term for name, term in self._asdict().items()}


def reward_terms(outcome: Outcome, centre_duration: float, weights: RewardWeights) -> RewardTerms:
    """The weighted terms of movements.

    Every term is bounded, so that no movement outweighs all others. With the default weights any success is worth
    more than any failure; and among movements of one shape the one of the centre duration is best: there a longer
    one costs as much time as it saves jerk.

    Args:
        outcome: Of N movements.
        centre_duration: Duration of the zero action, [s].
        weights: Of the terms.
    """
    relative: Any = outcome.duration / centre_duration
    log_jerk = np.log(outcome.jerk_ratio) - 5.0 * np.log(relative)  # jerk cost scales with duration^-5
    return RewardTerms(
        success=np.multiply(weights.success, outcome.is_success, dtype=np.float64),
        collision=np.multiply(-weights.collision, outcome.collision, dtype=np.float64),
        clearance=weights.clearance * np.clip(outcome.planned_clearance, *CLEARANCE_RANGE) / CLEARANCE_UNIT,
        goal_error=-weights.goal_error * np.minimum(outcome.goal_error / GOAL_ERROR_UNIT, 1.0),
        smoothness=-weights.smoothness * log_jerk,
        duration=-weights.duration * (relative - 1.0),
    )
