r"""Discounting by time, for decisions of different length.

What follows a decision that took tau seconds counts gamma^(tau / unit), so that a plan is worth the same however finely
it is cut into decisions (semi-Markov decision processes: Bradtke & Duff 1995, *Reinforcement learning methods for
continuous-time Markov decision problems*; Sutton, Precup & Singh 1999, *Between MDPs and semi-MDPs*). The reward of a
decision counts fully, as if it were paid where the decision begins:

    V(s_k) = E[r_k + gamma^(tau_k / unit) V(s_k+1)]

The algorithms of Stable-Baselines3 take these buffers as they are. SAC, TD3 and TQC find the discount of each sample in
it. PPO and A2C hand no infos to their buffer, so :class:`ElapsedTimeCallback` must be among the callbacks of `learn`:

    SAC("MlpPolicy", env, gamma=0.98, **timed(SAC, env.observation_space, gamma=0.98, unit=0.1)).learn(10_000)
    PPO("MlpPolicy", env, gamma=0.98, **timed(PPO, env.observation_space, gamma=0.98, unit=0.1)).learn(
        10_000, callback=ElapsedTimeCallback()
    )
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import (
    DictReplayBuffer,
    DictRolloutBuffer,
    ReplayBuffer,
    RolloutBuffer,
)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples

from viapoint.training.config.discount import ELAPSED, TimeDiscount


class TimedReplayBuffer(ReplayBuffer):
    """A replay buffer whose samples carry the discount of the time that their decision took.

    Args:
        *args: Of :class:`stable_baselines3.common.buffers.ReplayBuffer`.
        gamma: The algorithm's, the discount of one unit of time.
        unit: [s].
        key: Of the infos, where they tell the elapsed time [s].
        **kwargs: As `args`; `optimize_memory_usage` is not supported.

    Raises:
        ValueError: See :class:`TimeDiscount`.
    """

    def __init__(self, *args: Any, gamma: float, unit: float, key: str = ELAPSED, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False where discounts follow time")
        self.time_discount = TimeDiscount(gamma=gamma, unit=unit, key=key)
        self.discounts = np.ones((self.buffer_size, self.n_envs), dtype=np.float32)

    def add(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]
    ) -> None:
        """Keep a transition of every environment; see :meth:`TimeDiscount.of` for errors."""
        self.discounts[self.pos] = self.time_discount.of(infos)
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: NDArray[Any], env: Any = None) -> Any:
        """As SB3's, with the same draws, and with discounts."""
        at = batch_inds, np.random.randint(0, high=self.n_envs, size=len(batch_inds))  # noqa: NPY002 - as SB3
        ended = self.dones[at] * (1.0 - self.timeouts[at])
        columns = {"dones": ended, "rewards": self._normalize_reward(self.rewards[at], env)}
        columns["discounts"] = self.discounts[at]
        several = isinstance(self.observations, dict)
        kind: Any = DictReplayBufferSamples if several else ReplayBufferSamples
        return kind(
            observations=self._tensors(self.observations, at, env),
            actions=self.to_torch(self.actions[at]),
            next_observations=self._tensors(self.next_observations, at, env),
            **{name: self.to_torch(column.reshape(-1, 1)) for name, column in columns.items()},
        )

    def _tensors(self, stored: Any, at: Any, env: Any) -> Any:
        """Observations, or each part of them."""
        several = isinstance(stored, dict)
        chosen: Any = {name: part[at] for name, part in stored.items()} if several else stored[at]
        chosen = self._normalize_obs(chosen, env)
        return (
            {name: self.to_torch(part) for name, part in chosen.items()} if several else self.to_torch(chosen)
        )


class TimedDictReplayBuffer(TimedReplayBuffer, DictReplayBuffer):
    """The same for observations that are dictionaries."""


class TimedRolloutBuffer(RolloutBuffer):
    """A rollout buffer whose returns and advantages discount by time; needs :class:`ElapsedTimeCallback`.

    With d_k = gamma^(tau_k / unit),

        A_k = r_k + d_k V(s_k+1) - V(s_k) + lambda d_k A_k+1

    Lambda counts decisions, not seconds: it says how much to trust the critic over sampled rewards, whose noise grows
    with the number of decisions drawn. With 1 nothing of the critic but the last value remains, with 0 its judgement
    after one decision, however long that took.

    Args:
        *args: Of :class:`stable_baselines3.common.buffers.RolloutBuffer`.
        unit: [s]; gamma, which the algorithm hands over, is the discount of one.
        key: Of the infos, where they tell the elapsed time [s].
        **kwargs: As `args`.

    Raises:
        ValueError: See :class:`TimeDiscount`.
    """

    def __init__(self, *args: Any, unit: float, key: str = ELAPSED, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.time_discount = TimeDiscount(gamma=self.gamma, unit=unit, key=key)

    def reset(self) -> None:
        """Forget the last rollout."""
        super().reset()
        self.discounts = np.ones((self.buffer_size, self.n_envs), dtype=np.float32)
        self._told: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    def tell(self, infos: Sequence[Mapping[str, Any]], rewards: NDArray[np.float32]) -> None:
        """Note what the next :meth:`add` is not told.

        Args:
            infos: Of N environments.
            rewards: As the environments paid them, shape (N,).
        """
        self._told = self.time_discount.of(infos), rewards.copy()

    def add(self, obs: Any, action: Any, reward: Any, *args: Any, **kwargs: Any) -> None:
        """Keep a transition of every environment.

        Where an episode was cut off, SB3 has added gamma times the value of what was left; that is discounted anew.

        Raises:
            ValueError: :meth:`tell` was not called before.
        """
        if self._told is None:
            raise ValueError(
                "a rollout buffer that discounts by time needs ElapsedTimeCallback() among the callbacks of learn"
            )
        (discounts, paid), self._told = self._told, None
        self.discounts[self.pos] = discounts
        super().add(obs, action, paid + (reward - paid) * (discounts / self.gamma), *args, **kwargs)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: NDArray[np.bool_]) -> None:
        """Fill in returns and advantages once the rollout is complete.

        Args:
            last_values: Of the observations after it, N of them.
            dones: Whether its last decision ended an episode, shape (N,).
        """
        last = last_values.detach().cpu().numpy().reshape(1, -1)
        following = np.concatenate((self.values[1:], last))
        begins = np.concatenate((self.episode_starts[1:], dones[None].astype(np.float32)))
        discounts = self.discounts * (1.0 - begins)
        surprise = self.rewards + discounts * following - self.values
        advantage = np.zeros(self.n_envs, dtype=np.float32)
        for step in reversed(range(self.buffer_size)):
            advantage = surprise[step] + self.gae_lambda * discounts[step] * advantage
            self.advantages[step] = advantage
        self.returns = self.advantages + self.values


class TimedDictRolloutBuffer(TimedRolloutBuffer, DictRolloutBuffer):
    """The same for observations that are dictionaries."""


class ElapsedTimeCallback(BaseCallback):
    """Hands the infos of each step on to a :class:`TimedRolloutBuffer`; does nothing with other buffers."""

    def _on_step(self) -> bool:
        buffer = self.locals.get("rollout_buffer")
        if isinstance(buffer, TimedRolloutBuffer):
            buffer.tell(self.locals["infos"], self.locals["rewards"])
        return True


def timed(
    algorithm: type[BaseAlgorithm],
    observation_space: spaces.Space[Any],
    *,
    gamma: float,
    unit: float,
    key: str = ELAPSED,
) -> dict[str, Any]:
    """Arguments that make an algorithm of Stable-Baselines3 discount by time.

    Args:
        algorithm: Its class.
        observation_space: Of the environment.
        gamma: The algorithm's, the discount of one unit of time.
        unit: [s].
        key: Of the infos, where they tell the elapsed time [s].

    Raises:
        ValueError: See :class:`TimeDiscount`.
    """
    TimeDiscount(gamma=gamma, unit=unit, key=key)
    several = isinstance(observation_space, spaces.Dict)
    if issubclass(algorithm, OnPolicyAlgorithm):
        kind = TimedDictRolloutBuffer if several else TimedRolloutBuffer
        return {"rollout_buffer_class": kind, "rollout_buffer_kwargs": {"unit": unit, "key": key}}
    replay = TimedDictReplayBuffer if several else TimedReplayBuffer
    return {"replay_buffer_class": replay, "replay_buffer_kwargs": {"gamma": gamma, "unit": unit, "key": key}}


def unit_of(model: BaseAlgorithm) -> float | None:
    """The unit [s] by which a model discounts; None where it discounts by decisions."""
    buffer = getattr(model, "replay_buffer", None) or getattr(model, "rollout_buffer", None)
    discount = getattr(buffer, "time_discount", None)
    return None if discount is None else float(discount.unit)
