"""Base classes of environments whose episodes are several steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.envs.common.types import Bool, Float, Observation
from viapoint.envs.sim.episode_state import Episodes
from viapoint.envs.sim.executor import Rollout
from viapoint.envs.single_env import ReachEnv
from viapoint.envs.vector_env import ReachVectorEnv


class MultiStepVectorEnv(ReachVectorEnv):
    """Environments whose episodes end at different times; where one ends, the next begins in the same step.

    A subclass defines one step in `execute_actions`, which sets `terminated` and `truncated`.
    """

    terminated: Bool
    """True where the last step terminated the episode, shape (num_envs,)."""
    truncated: Bool
    """True where the last step truncated the episode, shape (num_envs,)."""
    _episodes: Episodes

    def __init__(self, num_envs: int = 1, **kwargs: Any) -> None:
        super().__init__(num_envs, **kwargs)
        self.terminated, self.truncated = np.zeros((2, self.num_envs), dtype=bool)

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """Running episodes so far at every physics step; empty before the first reset."""
        return () if self.scenes is None else tuple(self._rollout(row) for row in range(self.num_envs))

    def step(self, actions: Any) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Make one step in each environment; where an episode ends, start the next.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        observation, reward, info = self.execute_actions(actions)
        terminated, truncated = self.terminated, self.truncated
        ended = terminated | truncated
        everyone = np.ones(self.num_envs, dtype=bool)
        infos = {**info, **{f"_{name}": everyone.copy() for name in info}}
        rows = np.flatnonzero(ended)
        if rows.size:
            final = np.full(self.num_envs, None, dtype=object)
            for i in rows:
                final[i] = {name: part[i].copy() for name, part in observation.items()}
            kept = {name: np.where(ended, value, np.zeros_like(value)) for name, value in info.items()}
            masks = {f"_{name}": ended.copy() for name in info}
            infos |= {"final_obs": final, "_final_obs": ended.copy()}
            infos |= {"final_info": {**kept, **masks}, "_final_info": ended.copy()}
            self._start(rows, self._draw(self.generators, rows, {}))
            observation = self._observe_start()
        return observation, reward, terminated.copy(), truncated.copy(), infos

    def episodes_state(self) -> dict[str, Any]:
        """Return the state of the running episodes, without their scenes, as arrays for :meth:`restore_episodes`."""
        return {**self._episodes.state(), "physics": self._simulator.batch.state.copy()}

    def restore_episodes(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`episodes_state` returned, after a reset to the same scenes."""
        self._episodes.restore(state)
        self._simulator.batch.state[:] = state["physics"]

    def _rollout(self, row: int) -> Rollout:
        """Return the running episode of one environment so far."""
        assert self.scenes is not None
        scene = self.scenes.take([row])
        return self._episodes.rollout(row, lambda *movement: self._clearance(scene, *movement))

    @abstractmethod
    def _clearance(self, scene: Any, hand: Float, joints: Float, time: Float) -> Float:
        """Return the clearance in one scene at each time, shape (T,), [m]."""


class MultiStepEnv(ReachEnv):
    """One environment of a :class:`MultiStepVectorEnv`."""

    batch: MultiStepVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; see :meth:`~viapoint.envs.vector_env.ReachVectorEnv.reset`."""
        result = super().reset(seed=seed, options=options)
        self._over = False
        return result

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one step.

        Args:
            action: Shape (m,), in [-1, 1]; components beyond are clipped.
        """
        if self._over:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        observation, reward, _, _, info = super().step(action)
        terminated, truncated = bool(self.batch.terminated[0]), bool(self.batch.truncated[0])
        self._over = terminated or truncated
        return observation, reward, terminated, truncated, info
