"""Baselines for replanning tasks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Observation
from viapoint.training.rollouts.rollout import EpisodeSimulation, SimulationResults
from viapoint.training.planning.candidates import sobol_actions
from viapoint.training.planning.planned_movements import plan_movements

SUFFICIENT_CLEARANCE = 0.004
"""Clearance beyond which more of it has no merit, [m]."""
FIRST, LATER, ROUNDS = 128, 24, 4
"""Number of first actions, of actions in each round around the best one, and of rounds."""
SPREAD = 0.4
"""Standard deviation of the steps in the first round; each further round halves it."""
GROUP = 25
"""Scenes that are searched together."""
INSTANTS = np.arange(1, 49, dtype=np.float32) / 48
"""Fractions of a plan's duration at which its clearance is computed."""


class OpenLoopBaseline:
    """First decision of a method, which is never revised."""

    def __init__(self, method: Any, simulation: EpisodeSimulation) -> None:
        self.name, self._method = f"{method.name}, no revision", method
        self._simulation = EpisodeSimulation(simulation.env_id, 250, **{**simulation.kwargs, "decide_at": ()})

    def decide(self, observation: Observation, scenes: Any) -> Float:
        """Return the decision of the method, see :class:`viapoint.training.planning.baselines.Method`."""
        decisions: Float = self._method.decide(observation, scenes)
        return decisions

    def execute(self, scenes: Any, decisions: Float) -> SimulationResults:
        """Simulate one movement in each scene; it fails where the target has changed by its end."""
        return self._simulation.first(scenes, decisions)


class ReplanningPlanner:
    """Planner that searches the smoothest clear plan in every decision, with the future motion of the obstacles known.

    The search is among the same actions; plans are computed, not simulated.
    """

    name = "planner, knows all courses"

    def __init__(self, simulation: EpisodeSimulation) -> None:
        self._task, self._limit = simulation.task, simulation.time_limit
        self._generator = np.random.default_rng(0)

    def decide(self, observation: Observation, scenes: Any) -> Float:
        """Return the best actions, see :class:`viapoint.training.planning.baselines.Method`."""
        number = len(scenes.start)
        rows = [slice(first, first + GROUP) for first in range(0, number, GROUP)]
        return np.concatenate(
            [self._search({k: v[some] for k, v in observation.items()}, scenes.take(some)) for some in rows]
        )

    def _search(self, observation: Observation, scenes: Any) -> Float:
        """Return the best action of each scene, shape (N, m): Sobol points first, then rounds around the best one."""
        number, size = len(scenes.start), self._task.action.size
        actions = np.broadcast_to(sobol_actions(FIRST, size), (number, FIRST, size))
        merit = self._merit(observation, actions, scenes)
        best, rows = merit.argmax(axis=1), np.arange(number)
        chosen, highest = actions[rows, best], merit[rows, best]
        for each in range(ROUNDS):
            steps = self._generator.normal(size=(number, LATER, size)) * SPREAD * 0.5**each
            near = np.clip(chosen[:, None] + steps, -1.0, 1.0).astype(np.float32)
            merit = self._merit(observation, near, scenes)
            best = merit.argmax(axis=1)
            better = merit[rows, best] > highest
            chosen = np.where(better[:, None], near[rows, best], chosen)
            highest = np.where(better, merit[rows, best], highest)
        return np.asarray(chosen, dtype=np.float64)

    def _merit(self, observation: Observation, actions: NDArray[np.float32], scenes: Any) -> Float:
        """Return the merit of plans, shape (N, H): penalties for missing clearance and reach, then effort and time."""
        task, moves = self._task, plan_movements(observation, actions, self._task, INSTANTS)
        number, plans = actions.shape[:2]
        reach = np.asarray(task.arm.reach_margin(moves.path)).min(axis=-1)
        effort = task.weights.smoothness * moves.effort
        time = task.weights.duration * moves.duration / task.action.centre_duration
        merit = -effort - time + 100.0 * np.minimum(reach, 0.0)
        if not scenes.present.shape[1]:
            return np.asarray(merit)
        many = scenes.take(np.repeat(np.arange(number), plans))
        now = np.repeat(self._limit - observation["time_left"][:, 0], plans)
        times = now[:, None] + moves.duration.reshape(-1, 1) * INSTANTS
        path = moves.path.reshape(number * plans, *moves.path.shape[2:])
        clearance = task.collision_model.clearance_profile(path, many.places(times), many.present)
        least = clearance.min(axis=(1, 2)).reshape(number, plans)
        return np.asarray(merit + 200.0 * np.minimum(least - SUFFICIENT_CLEARANCE, 0.0))
