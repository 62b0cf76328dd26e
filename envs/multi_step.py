"""Base class of environments whose episodes are several steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from viapoint.envs.common.types import Bool, Float, Observation
from viapoint.envs.sim.episode_state import Episodes
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.vector_env import ReachVectorEnv


class MultiStepVectorEnv(ReachVectorEnv):
    """Environments whose episodes end at different times; where one ends, the next begins in the same step.

    A subclass defines one step in `execute_actions`, which sets `terminated` and `truncated`.
    """

    _episodes: Episodes

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """Running episodes so far at every physics step; empty before the first reset."""
        return () if self.scenes is None else tuple(map(self._rollout, range(self.num_envs)))

    def step(self, actions: Any) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Execute one action in each environment; see :meth:`ReachVectorEnv.step`."""
        decision = self.execute_actions(actions)
        rows = np.flatnonzero(self.terminated | self.truncated)
        if rows.size:
            self._start(rows, self._draw(self.generators, rows, {}))
        return self._as_step(decision)

    def state(self) -> dict[str, Any]:
        """Return the state of the environments; see :meth:`ReachVectorEnv.state`."""
        episodes = {**self._episodes.state(), "physics": self._simulator.batch.state.copy()}
        return {**super().state(), "episodes": episodes}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same kind and number."""
        super().restore(state)
        self._episodes.restore(state["episodes"])
        self._simulator.batch.state[:] = state["episodes"]["physics"]

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
