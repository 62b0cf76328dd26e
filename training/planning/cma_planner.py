"""Planner that searches the same actions in the same simulation; the upper reference of every table.

The search begins with random actions, so that every side of the obstacles is tried. The covariance matrix adaptation
evolution strategy (Hansen 2016, arXiv 1604.00772; library `cmaes`) then starts from the best of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from cmaes import CMA
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Observation
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.planning.plan_checks import check_plans

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

FAILURE_REWARD = -3.0
"""Reward of an action that certainly fails and is not simulated; with default weights less than any other."""


CERTAIN_FAILURE = 0.002
"""Depth in an obstacle, or beyond the reach, at which a plan certainly fails, [m].

With the default durations plans are tracked within a fifth of a millimetre; much shorter ones are not. The error of
computed clearance is half a millimetre.
"""
CERTAIN_SUCCESS = 0.01
"""Least clearance and reach margin at which a plan in space certainly succeeds, [m].

There movements are slowed down to the arm's limits, so that plans are tracked within a millimetre, whatever their
duration: of 1,017 random plans with a margin over 2 mm none failed.
"""


class Screening(NamedTuple):
    """Outcomes that the plans of N actions determine without simulation, shape (N,) each."""

    fails: NDArray[np.bool_]
    """True where the movement certainly fails."""
    succeeds: NDArray[np.bool_]
    """True where the movement certainly succeeds; never in the plane, where it may be too fast to be tracked."""
    margin: Float
    """Minimum of clearance and reach margin of the plan, [m]."""


def screen(task: Task, scenes: Scenes, actions: Float) -> Screening:
    """Screen one action in each of N scenes by its plan."""
    joints = np.asarray(task.arm.inverse_kinematics(scenes.start))
    observation = task.observation.observe(joints, scenes.start, scenes)
    checks = check_plans(observation, actions[:, None], task)
    margin = np.minimum(checks.clearance, checks.reach_margin)[:, 0].astype(np.float64)
    in_space = task.whole_arm and task.arm.dimension == 3
    return Screening(margin < -CERTAIN_FAILURE, margin > (CERTAIN_SUCCESS if in_space else np.inf), margin)


@dataclass(frozen=True, kw_only=True)
class PlannerBudget:
    """Budget of the planner in each scene."""

    first: int = 64
    """Number of random actions."""
    more: int = 4096
    """Greatest number of random actions, drawn where none has succeeded yet."""
    generations: int = 12
    """Generations of the evolution strategy."""
    population: int = 8
    """Actions in each generation."""


class PlannedActions(NamedTuple):
    """Best actions that the planner found in N scenes."""

    action: Float
    """Shape (N, m)."""
    reward: Float
    """Shape (N,)."""
    success: NDArray[np.bool_]
    """Shape (N,)."""
    n_tried: NDArray[np.int64]
    """Number of actions tried, shape (N,)."""


class Planner:
    """Search for the action of the highest simulated reward."""

    name = "planner"

    def __init__(self, simulation: SceneSimulation, *, budget: PlannerBudget | None = None) -> None:
        self._simulation, self._budget = simulation, budget or PlannerBudget()
        self._size = simulation.task.action.size

    def __call__(self, scenes: Scenes) -> PlannedActions:
        """Return the best action found in each of N scenes; each depends on its scene alone."""
        number = len(scenes.start)
        nothing = np.zeros(number, dtype=bool), np.zeros(number, dtype=np.int64)
        found = PlannedActions(np.zeros((number, self._size)), np.full(number, -np.inf), *nothing)
        generator = np.random.default_rng(0)
        self._try(scenes, np.arange(number), np.zeros((number, 1, self._size)), found)
        count = self._budget.first
        while True:
            rows = np.flatnonzero(~found.success) if found.n_tried.max() > 1 else np.arange(number)
            most = self._budget.more + 1 + self._budget.first
            if not len(rows) or found.n_tried[rows].max() + count > most:
                break
            actions = generator.uniform(-1.0, 1.0, (count, self._size))
            self._try(scenes, rows, np.broadcast_to(actions, (len(rows), count, self._size)), found)
            count *= 2
        self._refine(scenes, found)
        return found

    def _try(self, scenes: Scenes, rows: NDArray[np.int64], actions: Float, found: PlannedActions) -> Float:
        """Simulate actions, shape (n, count, m), in some scenes, keep improvements, and return their rewards."""
        count = actions.shape[1]
        every, flat = scenes.take(np.repeat(rows, count)), actions.reshape(-1, self._size)
        screening = screen(self._simulation.task, every, flat)
        rewards, success = FAILURE_REWARD + screening.margin, np.zeros(len(flat), dtype=bool)
        if not screening.fails.all():
            results = self._simulation(every.take(~screening.fails), flat[~screening.fails])
            rewards[~screening.fails], success[~screening.fails] = results.reward, results.success
        rewards = rewards.reshape(-1, count)
        best = rewards.argmax(axis=-1)
        each = np.arange(len(rows))
        better = rewards[each, best] > found.reward[rows]
        found.action[rows[better]] = actions[each, best][better]
        found.reward[rows[better]] = rewards[each, best][better]
        found.success[rows[better]] = success.reshape(-1, count)[each, best][better]
        found.n_tried[rows] += count
        return rewards

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return the best actions, see :class:`~viapoint.training.planning.baselines.Method`."""
        return self(scenes).action

    def _refine(self, scenes: Scenes, found: PlannedActions) -> None:
        """Improve the found actions by one evolution strategy for each scene."""
        bounds = np.tile([-1.0, 1.0], (self._size, 1))
        population = self._budget.population
        rows = np.arange(len(found.action))
        searches = [
            CMA(mean=action, sigma=0.2, bounds=bounds, population_size=population, seed=0)
            for action in found.action
        ]
        for _ in range(self._budget.generations):
            actions = np.array([[search.ask() for _ in range(population)] for search in searches])
            rewards = self._try(scenes, rows, actions, found)
            for search, candidates, values in zip(searches, actions, rewards, strict=True):
                search.tell(list(zip(candidates, (-values).tolist(), strict=True)))
