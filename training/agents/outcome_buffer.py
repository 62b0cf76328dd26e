"""Replay buffer that stores the terms of the reward in addition to their sum."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer

from viapoint.envs.common.types import Single
from viapoint.primitives.array_api import Array
from viapoint.training.rollouts.vec_env import ELAPSED, TERMS

LOWER = 1e-6  # Smallest decrease of the clearance term that counts as a decrease
# Largest difference between the reward and the sum of its terms that counts as rounding
REWARD_TOLERANCE = 1e-4


class Outcomes(NamedTuple):
    """Outcomes of N decisions, shape (N,) each; NaN if the environment reports only the sum of the terms."""

    success: Array  # 1 for success, otherwise 0
    contact: Array  # 1 if the arm touched an obstacle, otherwise 0
    clearance: Array  # Clearance term of the reward, summed over the episode so far
    lower: Array  # 1 if this decision lowered that sum, so that no earlier decision accounts for it
    goal_error: Array  # Goal-error term of the reward
    effort_terms: Array  # Sum of the terms for smoothness and duration


class OutcomeSamples(NamedTuple):
    """Sampled decisions: B observations by name, actions of shape (B, m), all other fields of shape (B,)."""

    observations: dict[str, Single]
    actions: Single
    next_observations: dict[str, Single]
    ended: Single
    reward: Single
    # Duration of the executed part of the plan, [s]; infinite if the plan was executed to its end
    elapsed: Single
    outcomes: Outcomes


class OutcomeReplayBuffer(DictReplayBuffer):
    """Replay buffer for dictionary observations that stores the outcome of each decision from `info`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False: the buffer stores the terms of the reward")
        self._begins = False
        self.elapsed = np.full((self.buffer_size, self.n_envs), np.inf, dtype=np.float32)
        self.outcomes = np.full(
            (self.buffer_size, self.n_envs, len(Outcomes._fields)), np.nan, dtype=np.float32
        )

    def add(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]
    ) -> None:
        """Add one transition of each environment."""
        before = self._clearance_before()
        for i, info in enumerate(infos):
            self.elapsed[self.pos, i] = info.get(ELAPSED, np.inf)
            self.outcomes[self.pos, i] = outcome_of(info, float(reward[i]), before[i])
        super().add(obs, next_obs, action, reward, done, infos)

    def begin(self) -> None:
        """Mark the beginning of new episodes in all environments, after a reset."""
        self._begins = True

    def _clearance_before(self) -> Single:
        """Return the clearance terms summed over each running episode, shape (N,); NaN at its first decision."""
        begins, self._begins = self._begins, False
        if begins or (not self.pos and not self.full):
            return np.full(self.n_envs, np.nan, dtype=np.float32)
        last = self.pos - 1
        over = self.dones[last] > 0.5
        return np.where(over, np.nan, self.outcomes[last, :, Outcomes._fields.index("clearance")])

    def sample_outcomes(self, batch_size: int) -> OutcomeSamples:
        """Return `batch_size` decisions, sampled with replacement."""
        rows = np.random.randint(0, self.size(), size=batch_size)  # noqa: NPY002 - as SB3
        at = rows, np.random.randint(0, self.n_envs, size=batch_size)  # noqa: NPY002
        return OutcomeSamples(
            {name: part[at] for name, part in self.observations.items()},
            self.actions[at],
            {name: part[at] for name, part in self.next_observations.items()},
            np.asarray(self.dones[at] * (1.0 - self.timeouts[at]), dtype=np.float32),
            self.rewards[at],
            self.elapsed[at],
            Outcomes(*self.outcomes[at].T),
        )


def outcome_of(info: Mapping[str, Any], reward: float, before: float = np.nan) -> tuple[float, ...]:
    """Return the outcome that `info` reports, or NaN if its terms do not sum to the reward.

    The clearance terms of earlier decisions in the episode sum up to `before`; NaN for the first decision.
    """
    unknown = (np.nan,) * len(Outcomes._fields)
    if not all(name in info for name in TERMS):
        return unknown
    terms = [float(info[name]) for name in TERMS]
    if abs(sum(terms) - reward) > REWARD_TOLERANCE:
        return unknown
    success, collision, clearance, goal_error, smoothness, duration, _ = terms
    succeeded = bool(info.get("is_success", success > 0.0))
    contact = bool(info.get("collision", collision < 0.0))
    first = bool(np.isnan(before))
    lower = first or clearance < -LOWER
    so_far = clearance if first else before + clearance
    return float(succeeded), float(contact), so_far, float(lower), goal_error, smoothness + duration
