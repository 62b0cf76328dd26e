r"""Replay and rollout buffers that discount by elapsed time (semi-Markov decision processes).

The value after a decision that took tau seconds is discounted by gamma^(tau / unit), so the value of a plan does not
depend on the number of decisions that execute it (Bradtke & Duff 1995, *Reinforcement learning methods for
continuous-time Markov decision problems*; Sutton, Precup & Singh 1999, *Between MDPs and semi-MDPs*). The reward of a
decision is not discounted, as if it were paid when the decision begins:

    V(s_k) = E[r_k + gamma^(tau_k / unit) V(s_k+1)]

The algorithms of Stable-Baselines3 accept these buffers unchanged. SAC, TD3 and TQC read the discount of each sample
from the buffer. PPO and A2C pass no infos to their buffer, so `learn` needs :class:`ElapsedTimeCallback`:

    SAC("MlpPolicy", env, gamma=0.98, **time_discount(SAC, env.observation_space, gamma=0.98, unit=0.1)).learn(10_000)
    PPO("MlpPolicy", env, gamma=0.98, **time_discount(PPO, env.observation_space, gamma=0.98, unit=0.1)).learn(
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
from stable_baselines3.common.buffers import DictReplayBuffer, DictRolloutBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples

from viapoint.training.config.discount import ELAPSED, TimeDiscount


class TimedReplayBuffer(ReplayBuffer):
    """Replay buffer whose samples contain the discount of the time that each decision took.

    Args:
        *args: Arguments of :class:`stable_baselines3.common.buffers.ReplayBuffer`.
        gamma: Discount of one unit of time; the `gamma` of the algorithm.
        unit: Length of the unit of time, [s].
        key: Key of `info` that holds the elapsed time, [s].
        **kwargs: Keyword arguments of the same class; `optimize_memory_usage` is not supported.

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
        """Add one transition of each environment; see :meth:`TimeDiscount.of` for errors."""
        self.discounts[self.pos] = self.time_discount.of(infos)
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: NDArray[Any], env: Any = None) -> Any:
        """Return samples with discounts, drawn with the same random numbers as in SB3."""
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
        """Return observations, or each part of a dictionary of them, as tensors."""
        several = isinstance(stored, dict)
        chosen: Any = {name: part[at] for name, part in stored.items()} if several else stored[at]
        chosen = self._normalize_obs(chosen, env)
        return (
            {name: self.to_torch(part) for name, part in chosen.items()} if several else self.to_torch(chosen)
        )


class TimedDictReplayBuffer(TimedReplayBuffer, DictReplayBuffer):
    """Replay buffer that discounts by elapsed time, for observations that are dictionaries."""


class TimedRolloutBuffer(RolloutBuffer):
    """Rollout buffer whose returns and advantages discount by elapsed time; needs :class:`ElapsedTimeCallback`.

    With d_k = gamma^(tau_k / unit),

        A_k = r_k + d_k V(s_k+1) - V(s_k) + lambda d_k A_k+1

    Lambda counts decisions, not seconds. It weighs the critic against sampled rewards, whose variance grows with the
    number of decisions. With 1 only the value after the last decision comes from the critic; with 0 the advantage is
    the one-decision temporal difference.

    Args:
        *args: Arguments of :class:`stable_baselines3.common.buffers.RolloutBuffer`.
        unit: Length of the unit of time that `gamma` discounts, [s].
        key: Key of `info` that holds the elapsed time, [s].
        **kwargs: Keyword arguments of the same class.

    Raises:
        ValueError: See :class:`TimeDiscount`.
    """

    def __init__(self, *args: Any, unit: float, key: str = ELAPSED, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.time_discount = TimeDiscount(gamma=self.gamma, unit=unit, key=key)

    def reset(self) -> None:
        """Clear the buffer for the next rollout."""
        super().reset()
        self.discounts = np.ones((self.buffer_size, self.n_envs), dtype=np.float32)
        self._told: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    def tell(self, infos: Sequence[Mapping[str, Any]], rewards: NDArray[np.float32]) -> None:
        """Store infos and rewards (N,) that the next call of :meth:`add` needs and does not receive."""
        self._told = self.time_discount.of(infos), rewards.copy()

    def add(self, obs: Any, action: Any, reward: Any, *args: Any, **kwargs: Any) -> None:
        """Add one transition of each environment.

        SB3 adds gamma times the value of the final observation to the reward of a truncated episode; this method
        replaces gamma by the discount of the elapsed time.

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
        """Compute returns and advantages of a complete rollout."""
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
    """Rollout buffer that discounts by elapsed time, for observations that are dictionaries."""


class ElapsedTimeCallback(BaseCallback):
    """Callback that passes the infos of each step to a :class:`TimedRolloutBuffer`; it ignores other buffers.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import PPO
        >>> from viapoint.training import ElapsedTimeCallback, time_discount
        >>> env = gym.make("viapoint.envs:viapoint/PlanarTargetJump-v0")
        >>> arguments = time_discount(PPO, env.observation_space, gamma=0.98, unit=0.1)
        >>> agent = PPO("MultiInputPolicy", env, gamma=0.98, n_steps=8, batch_size=8, **arguments)
        >>> agent = agent.learn(8, callback=ElapsedTimeCallback())
    """

    def _on_step(self) -> bool:
        buffer = self.locals.get("rollout_buffer")
        if isinstance(buffer, TimedRolloutBuffer):
            buffer.tell(self.locals["infos"], self.locals["rewards"])
        return True


def time_discount(
    algorithm: type[BaseAlgorithm],
    observation_space: spaces.Space[Any],
    *,
    gamma: float,
    unit: float,
    key: str = ELAPSED,
) -> dict[str, Any]:
    """Return the arguments that make an algorithm of Stable-Baselines3 discount by elapsed time.

    Args:
        algorithm: Class of the algorithm.
        observation_space: Observation space of the environment.
        gamma: Discount of one unit of time; the `gamma` of the algorithm.
        unit: Length of the unit of time, [s].
        key: Key of `info` that holds the elapsed time, [s].

    Raises:
        ValueError: See :class:`TimeDiscount`.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import SAC
        >>> from viapoint.training import time_discount
        >>> env = gym.make("viapoint.envs:viapoint/PlanarTargetJump-v0")
        >>> arguments = time_discount(SAC, env.observation_space, gamma=0.98, unit=0.1)
        >>> agent = SAC("MultiInputPolicy", env, gamma=0.98, learning_starts=8, buffer_size=100, **arguments).learn(12)
    """
    TimeDiscount(gamma=gamma, unit=unit, key=key)
    several = isinstance(observation_space, spaces.Dict)
    if issubclass(algorithm, OnPolicyAlgorithm):
        kind = TimedDictRolloutBuffer if several else TimedRolloutBuffer
        return {"rollout_buffer_class": kind, "rollout_buffer_kwargs": {"unit": unit, "key": key}}
    replay = TimedDictReplayBuffer if several else TimedReplayBuffer
    return {"replay_buffer_class": replay, "replay_buffer_kwargs": {"gamma": gamma, "unit": unit, "key": key}}


def unit_of(model: BaseAlgorithm) -> float | None:
    """Return the unit of time by which a model discounts, [s]; None if it discounts by decisions."""
    buffer = getattr(model, "replay_buffer", None) or getattr(model, "rollout_buffer", None)
    discount = getattr(buffer, "time_discount", None)
    return None if discount is None else float(discount.unit)
