"""Episodes of many steps, which end at different times in one batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.envs.common.types import Float, Observation
from viapoint.envs.single_env import ReachEnv
from viapoint.envs.vector_env import ReachVectorEnv


class ManyStepVectorEnv(ReachVectorEnv):
    """Where an episode ends, the next one begins in the same step; the others go on.

    What a step is, :meth:`execute_actions` says: it sets `terminated` and `truncated`.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.terminated, self.truncated = np.zeros((2, self.num_envs), dtype=bool)
        """Which episodes ended in the last step, shape (num_envs,)."""

    def step(self, actions: Any) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Make one step in each environment; where an episode ended, start the next.

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
            self._start(rows, self._draw(self._generators, rows, {}))
            observation = self._observe_start()
        return observation, reward, terminated.copy(), truncated.copy(), infos


class ManyStepEnv(ReachEnv):
    """A batch of one of a :class:`ManyStepVectorEnv`."""

    batch: ManyStepVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; see :meth:`~viapoint.envs.single_env.ReachVectorEnv.reset`."""
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
