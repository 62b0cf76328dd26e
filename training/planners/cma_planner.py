"""The planner: search over the same actions in the same simulation. It is the ceiling of every table.

Random actions first, so that every way round is tried, then the covariance matrix adaptation evolution strategy
(Hansen 2016, arXiv 1604.00772; the library `cmaes`) from the best of them, for all scenes at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from cmaes import CMA
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.planners.difficulty import screen
from viapoint.training.rollouts.rollout import Trial

HOPELESS = -3.0
"""Reward put down for an action that fails for certain and is not simulated: by default weights, less than any."""


@dataclass(frozen=True, kw_only=True)
class PlannerBudget:
    """How long the planner searches in each scene."""

    first: int = 64
    """Random actions."""
    more: int = 4096
    """Random actions at most, drawn where none has succeeded yet."""
    generations: int = 12
    """Of the refinement."""
    population: int = 8
    """Actions in each generation."""


class Planned(NamedTuple):
    """What the planner found in N scenes."""

    action: Float
    """Shape (N, m)."""
    reward: Float
    """Shape (N,)."""
    success: NDArray[np.bool_]
    """Shape (N,)."""
    tried: NDArray[np.int64]
    """Actions looked at, shape (N,)."""


class Planner:
    """Searches for the action of the highest reward."""

    def __init__(self, trial: Trial, *, seed: int = 0, budget: PlannerBudget | None = None) -> None:
        self._trial, self._budget, self._seed = trial, budget or PlannerBudget(), seed
        self._size = trial.task.action.size

    def __call__(self, scenes: Scenes) -> Planned:
        """The best action found in each of N scenes; a scene's result depends on the scene and the seed alone."""
        number = len(scenes.start)
        found = Planned(
            np.zeros((number, self._size)),
            np.full(number, -np.inf),
            np.zeros(number, dtype=bool),
            np.zeros(number, dtype=np.int64),
        )
        generator = np.random.default_rng(self._seed)
        self._try(scenes, np.arange(number), np.zeros((number, 1, self._size)), found)
        count = self._budget.first
        while True:
            rows = np.flatnonzero(~found.success) if found.tried.max() > 1 else np.arange(number)
            if not len(rows) or found.tried[rows].max() + count > self._budget.more + 1 + self._budget.first:
                break
            actions = generator.uniform(-1.0, 1.0, (count, self._size))
            self._try(scenes, rows, np.broadcast_to(actions, (len(rows), count, self._size)), found)
            count *= 2
        self._refine(scenes, found)
        return found

    def _try(self, scenes: Scenes, rows: NDArray[np.int64], actions: Float, found: Planned) -> Float:
        """Simulate a few actions in each of some scenes and keep what is better than what was found."""
        count = actions.shape[1]
        every, flat = scenes.take(np.repeat(rows, count)), actions.reshape(-1, self._size)
        screened = screen(self._trial.task, every, flat)
        rewards, success = HOPELESS + screened.merit, np.zeros(len(flat), dtype=bool)
        if not screened.fails.all():
            trials = self._trial(every.take(~screened.fails), flat[~screened.fails])
            rewards[~screened.fails], success[~screened.fails] = trials.reward, trials.success
        rewards = rewards.reshape(-1, count)
        best = rewards.argmax(axis=-1)
        each = np.arange(len(rows))
        better = rewards[each, best] > found.reward[rows]
        found.action[rows[better]] = actions[each, best][better]
        found.reward[rows[better]] = rewards[each, best][better]
        found.success[rows[better]] = success.reshape(-1, count)[each, best][better]
        found.tried[rows] += count
        return rewards

    def _refine(self, scenes: Scenes, found: Planned) -> None:
        bounds = np.tile([-1.0, 1.0], (self._size, 1))
        population = self._budget.population
        rows = np.arange(len(found.action))
        searches = [
            CMA(mean=action, sigma=0.2, bounds=bounds, population_size=population, seed=self._seed)
            for action in found.action
        ]
        for _ in range(self._budget.generations):
            actions = np.array([[search.ask() for _ in range(population)] for search in searches])
            rewards = self._try(scenes, rows, actions, found)
            for search, asked, told in zip(searches, actions, rewards, strict=True):
                search.tell([(action, -float(reward)) for action, reward in zip(asked, told, strict=True)])
