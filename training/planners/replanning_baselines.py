"""What an agent that revises its plans is measured against."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Observation
from viapoint.training.rollouts.rollout import OnlineTrial, Trials
from viapoint.training.search.candidates import sobol_actions
from viapoint.training.search.planned_movements import plan_movements

ENOUGH = 0.004
"""Clearance from which on more of it is worth nothing to the planner, [m]."""
FIRST, LATER, ROUNDS = 128, 24, 4
"""Actions that the planner tries first, actions that it tries around the best so far, and how often it does so."""
SPREAD = 0.4
"""Of the first of those rounds."""
GROUP = 25
"""Scenes that it looks at together."""
INSTANTS = np.arange(1, 49, dtype=np.float32) / 48
"""Shares of a plan's duration at which its clearance is computed."""


class OpenLoopBaseline:
    """The first decision of a method, never revised, whatever happens.

    Args:
        method: Whose.
        trial: Of the environment.
    """

    def __init__(self, method: Any, trial: OnlineTrial) -> None:
        self.name, self._method = f"{method.name}, no revision", method
        self._trial = OnlineTrial(trial.env_id, 250, **{**trial.kwargs, "decide_at": ()})

    def decide(self, observation: Observation, scenes: Any) -> Float:
        """See :class:`viapoint.training.planners.baselines.Method`."""
        decided: Float = self._method.decide(observation, scenes)
        return decided

    def execute(self, scenes: Any, decided: Float) -> Trials:
        """One movement; where the target is another one by then, it has failed."""
        return self._trial.first(scenes, decided)


class OnlinePlanner:
    """Searches at every decision for the smoothest clear plan, and knows what will become of the obstacles.

    The search is among the same actions; what they would lead to is computed, not simulated.

    Args:
        trial: Of the environment.
        seed: Of the search.
    """

    name = "planner, knows all courses"

    def __init__(self, trial: OnlineTrial, seed: int = 0) -> None:
        self._task, self._limit = trial.task, trial.time_limit
        self._generator = np.random.default_rng(seed)

    def decide(self, observation: Observation, scenes: Any) -> Float:
        """See :class:`viapoint.training.planners.baselines.Method`."""
        number = len(scenes.start)
        rows = [slice(first, first + GROUP) for first in range(0, number, GROUP)]
        return np.concatenate(
            [self._search({k: v[some] for k, v in observation.items()}, scenes.take(some)) for some in rows]
        )

    def _search(self, observation: Observation, scenes: Any) -> Float:
        number, size = len(scenes.start), self._task.action.size
        actions = np.broadcast_to(sobol_actions(FIRST, size), (number, FIRST, size))
        merit = self._merit(observation, actions, scenes)
        best, rows = merit.argmax(axis=1), np.arange(number)
        chosen, worth = actions[rows, best], merit[rows, best]
        for each in range(ROUNDS):
            steps = self._generator.normal(size=(number, LATER, size)) * SPREAD * 0.5**each
            near = np.clip(chosen[:, None] + steps, -1.0, 1.0).astype(np.float32)
            merit = self._merit(observation, near, scenes)
            best = merit.argmax(axis=1)
            better = merit[rows, best] > worth
            chosen = np.where(better[:, None], near[rows, best], chosen)
            worth = np.where(better, merit[rows, best], worth)
        return np.asarray(chosen, dtype=np.float64)

    def _merit(self, observation: Observation, actions: NDArray[np.float32], scenes: Any) -> Float:
        """Clearance as far as it is wanting, then effort and time, shape (N, H)."""
        task, moves = self._task, plan_movements(observation, actions, self._task, INSTANTS)
        number, tried = actions.shape[:2]
        reach = np.asarray(task.arm.reach_margin(moves.path)).min(axis=-1)
        effort = task.weights.smoothness * moves.effort
        time = task.weights.duration * moves.duration / task.action.centre_duration
        merit = -effort - time + 100.0 * np.minimum(reach, 0.0)
        if not scenes.present.shape[1]:
            return np.asarray(merit)
        many = scenes.take(np.repeat(np.arange(number), tried))
        now = np.repeat(self._limit - observation["time_left"][:, 0], tried)
        times = now[:, None] + moves.duration.reshape(-1, 1) * INSTANTS
        path = moves.path.reshape(number * tried, *moves.path.shape[2:])
        clearance = task.collision_model.clearance_profile(path, many.places(times), many.present)
        least = clearance.min(axis=(1, 2)).reshape(number, tried)
        return np.asarray(merit + 200.0 * np.minimum(least - ENOUGH, 0.0))
