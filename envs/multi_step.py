"""Base class of environments whose episodes are several steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from viapoint.envs.common.types import Bool, Float
from viapoint.envs.sim.episode_state import Episodes
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.vector_env import ReachVectorEnv, Transition


class MultiStepVectorEnv(ReachVectorEnv):
    """Environments whose episodes end at different times; where one ends, the next begins in the same step.

    A subclass defines one step in `execute_actions`, which sets `terminated` and `truncated`.
    """

    _episodes: Episodes

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """Running episodes so far at every physics step; empty before the first reset."""
        return () if self.scenes is None else tuple(map(self._rollout, range(self.num_envs)))

    def transition(self, actions: Any) -> Transition:
        """Execute one action in each environment, as :meth:`step`, and return the arrays of its result."""
        observation, reward, info = self.execute_actions(actions)
        last, rows = None, np.flatnonzero(self.terminated | self.truncated)
        if rows.size:
            self._start(rows, self._draw_next(rows))
            last, observation = observation, self.observe()
        return Transition(observation, reward, self.terminated.copy(), self.truncated.copy(), info, last)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same kind and number."""
        super().restore(state)
        if state.get("episodes"):
            self.restore_episodes(state["episodes"])

    def episodes_state(self) -> dict[str, Any]:
        """Return the state of the running episodes, without their scenes, as arrays for :meth:`restore_episodes`."""
        return {**self._episodes.state(), "physics": self._simulator.batch.state.copy()}

    def restore_episodes(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`episodes_state` returned, after a reset to the same scenes."""
        self._episodes.restore(state)
        self._simulator.batch.state[:] = state["physics"]

    @staticmethod
    def take_episodes(state: Mapping[str, Any], rows: slice) -> dict[str, Any]:
        """Return the part of :meth:`episodes_state` that belongs to some environments."""
        return {name: np.asarray(part)[rows] for name, part in state.items()}

    def _recorded(self, sim: int) -> tuple[Any, Float, Float, Bool]:
        assert self.scenes is not None
        return self.scenes.take([sim]), *self._episodes.recorded(sim)

    def _render_one(self, sim: int) -> Any:
        if self.render_mode is None or self.scenes is None or not self._episodes.now.steps[sim]:
            return super()._render_one(sim)
        return self._film(sim, self.scenes.take([sim]))

    @abstractmethod
    def _film(self, sim: int, scene: Any) -> Any:
        """Render the running episode of one environment."""
