"""Environment, agent and comparison that all tabs of the live page share."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from viapoint.training.algorithms.agent import Agent
from viapoint.training.live.comparison import Comparison
from viapoint.training.live.decisions import DecisionMaker
from viapoint.training.live.drawing import ArmDrawing
from viapoint.training.live.movements import DECISION_INTERVAL
from viapoint.training.live.obstacle_editing import obstacle_kinds
from viapoint.training.live.panels import Facts
from viapoint.training.live.scene_draws import Draw, scene_kinds
from viapoint.training.rollouts.step_rollout import is_step_wise, whole_task

MOST_VIAS = 4
"""Greatest number of via-points of the slider."""


class Shared:
    """Task, agent, and everything that is expensive to make, for all tabs of a page.

    Args:
        env_id: Id of a registered environment.
        agent: Agent of that environment; None for the geometry search.
        model_file: MJCF file that the arm was loaded from, whose meshes are drawn.
        seed: Seed of the random scenes.
        env_kwargs: Arguments of the environment.
    """

    def __init__(
        self,
        env_id: str,
        agent: Agent | None,
        *,
        model_file: str | Path | None,
        seed: int | None,
        env_kwargs: Mapping[str, Any],
    ) -> None:
        self.env_id, self.agent, self.env_kwargs = env_id, agent, dict(env_kwargs)
        self._whole_id, self._whole_kwargs = whole_task(env_id, self.env_kwargs)
        self._model_file, self._seed = model_file, seed
        env = self.make_env()
        self.task = env.task
        self.drawing(env.model)
        env.close()
        self._steps = agent is not None and is_step_wise(env_id)
        self.decisions = DecisionMaker(self.task, None if self._steps else agent)
        self.comparison = Comparison(self._whole_id, agent, **self._whole_kwargs)
        self.comparing = threading.Lock()
        """Lock of the comparison, whose environments all tabs share."""

    def make_env(self) -> Any:
        """Return a vector environment of one environment, whose actions are whole movements or revisions of them."""
        kwargs = dict(self._whole_kwargs)
        env: Any = gym.make_vec(self._whole_id, num_envs=1, threads=1, **kwargs)
        if env.unwrapped.task.replanning and "horizon" not in kwargs:
            env.close()
            env = gym.make_vec(self._whole_id, num_envs=1, threads=1, **kwargs, horizon=DECISION_INTERVAL)
        return env.unwrapped

    def make_step_env(self) -> Any:
        """Return an environment for an agent that acts in every control step; None for other agents."""
        if not self._steps:
            return None
        env: Any = gym.make_vec(self.env_id, num_envs=1, threads=1, **self.env_kwargs)
        return env.unwrapped

    def drawing(self, model: Any) -> ArmDrawing:
        """Return the parts of the arm."""
        return ArmDrawing(self.task.arm, model, self._model_file)

    def scene_kinds(self) -> dict[str, Draw]:
        """Return functions that draw scenes, by the names of their buttons."""
        return scene_kinds(self._whole_id, self._whole_kwargs, self.task, self._seed)

    def facts(self, kinds: Sequence[str]) -> Facts:
        """Return what the panels show of the page."""
        own = self.task.action.n_via
        who = "no agent: the geometry search decides"
        if self.agent is not None:
            who = f"agent: {type(self.agent).__name__}"
        return Facts(
            title=self.env_id.removeprefix("viapoint/"), subtitle=who, scene_kinds=kinds,
            shapes=obstacle_kinds(self.task.scenes.shapes), n_via=own,
            most_vias=own if self.task.replanning else max(MOST_VIAS, own),
            duration_range=self.task.action.duration_range, ranks=self.decisions.ranks, spatial=self.task.spatial,
        )  # fmt: skip
