"""Methods that a study measures: decision modes of agents, and baselines."""

from __future__ import annotations

from typing import Any

import numpy as np

from viapoint.envs.common.types import Float, Observation
from viapoint.training.algorithms.model_io import untrained
from viapoint.training.planners.baselines import (
    Method,
    StoredSolutions,
    agent_method,
    make_method,
    refined_search,
)
from viapoint.training.planners.replanning_baselines import OpenLoopBaseline
from viapoint.training.rollouts.rollout import EpisodeSimulation, new_simulation
from viapoint.training.scene_sets.scene_set import FrozenScenes
from viapoint.training.search.candidates import candidate_actions
from viapoint.training.search.geometry_search import GeometrySearch, registered_task, score_plans
from viapoint.training.search.plan_checks import CLEARANCE_MARGIN, REACH_MARGIN
from viapoint.training.study.config import Baseline, Environment, Mode


class RandomOrder:
    """Best of some plans that are drawn at random for each scene and checked with computed geometry."""

    def __init__(self, env_id: str, checks: int, **kwargs: Any) -> None:
        self.name, self._checks = f"random order, {checks} checks", checks
        self._task = registered_task(env_id, **kwargs)
        self._generator = np.random.default_rng(0)

    def decide(self, observation: Observation, scenes: Any) -> Float:
        """Return the best of random plans that have the duration of the greatest reward."""
        layout = candidate_actions(self._task, 2, replanning=False)[1]
        number, size = len(observation["hand"]), self._task.action.size
        duration = self._task.action.n_via * self._task.action.dimension
        actions = self._generator.uniform(-1.0, 1.0, (number, self._checks, size)).astype(np.float32)
        actions[..., duration] = layout[duration]
        worth = score_plans(observation, actions, self._task, (CLEARANCE_MARGIN, REACH_MARGIN))
        return np.asarray(actions[np.arange(number), worth.argmax(axis=1)], dtype=np.float64)


def method_of_mode(mode: Mode, model: Any, env: Environment, kwargs: Any, seed: int = 0) -> Method:
    """Return an agent that decides in a mode; the network before training has the weights of the seed."""
    chosen = untrained(model, seed) if mode.untrained else model
    method = agent_method(mode.name, chosen, mode.checks)
    if mode.unrevised:
        return OpenLoopBaseline(method, EpisodeSimulation(env.id, **kwargs))
    return method


def method_of(baseline: Baseline, env: Environment, frozen: FrozenScenes, **more: Any) -> Method:
    """Return a baseline in an environment."""
    kwargs = {**env.env_kwargs, **baseline.env_kwargs, **more}
    if baseline.method == "stored":
        return StoredSolutions(frozen)
    if baseline.checks is None:
        return make_method(baseline.method, env.id, **kwargs)
    if baseline.method == "search":
        return refined_search(baseline.checks)(new_simulation(env.id, 2, **kwargs))
    if baseline.method == "sobol":
        return GeometrySearch(env.id, baseline.checks, **kwargs)
    return RandomOrder(env.id, baseline.checks, **kwargs)
