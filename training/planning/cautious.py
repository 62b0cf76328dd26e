"""Planning with what a sensor sees: beliefs as obstacles, and a penalty for ways through unseen space.

These are the methods without learning that agents with sensors are compared with. The name of a method in tables and on
the command line is BELIEF:PLANNER, such as `points:search512`; without a belief it is `thick`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training.planning.beliefs import Sight, fitted_boxes, thick_points
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.places import instants_of, places_of
from viapoint.training.planning.problem import Numbers, Problem, moves_of, worth_of
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    INFEASIBLE,
    plan_clearances,
    refined_actions,
)

# Number of instants at which the way through unseen space is measured
INSTANTS = {"hand": 32, "joints": 16}
# Depth behind a seen surface that is avoided like the surface, [m]
BEHIND = {"hand": 0.04, "joints": 0.04}
UNSEEN_WEIGHT = 50.0  # Reward that a mean depth of 1 m in unseen space costs, [1/m]
MARGIN = 0.03  # Distance in front of unseen space at which the penalty begins, [m]
DEEPEST = 0.1  # Depth in unseen space at which the penalty of an instant saturates, [m]
# Number of best candidates that are refined around what is seen. The settings were tuned on `validation` scenes.
REFINED = {"hand": 0, "joints": 8}


def seen(task: Task, sight: Sight, truth: Obstacles) -> Obstacles:
    """Return those of the true obstacles that at least one ray meets."""
    sensor = _one_look(task, "seen")
    hidden = sensor.hidden(sight.rotation, sight.origin, truth)
    return truth._replace(kind=np.where(hidden, ABSENT, truth.kind))


def _one_look(task: Task, name: str) -> Sensor:
    """Return the sensor of a task for a method that needs its present look alone.

    Raises:
        ValueError: Other looks are remembered.
    """
    sensor = task.sensor
    assert sensor is not None
    if sensor.looks > 1:
        raise ValueError(f"{name} needs a sensor with looks=1, got {sensor.looks}")
    return sensor


# Obstacles that are believed to be there, by name; PRIVILEGED ones need the truth
BELIEFS: dict[str, Callable[[Task, Sight, Obstacles], Obstacles]] = {
    "known": lambda task, sight, truth: truth,
    "seen": seen,
    "fitted": lambda task, sight, truth: fitted_boxes(task, sight),
    "points": lambda task, sight, truth: thick_points(task, sight, 0.0),
    "thick": lambda task, sight, truth: thick_points(task, sight),
}
PRIVILEGED = ("known", "seen")
DEFAULT_BELIEF = "thick"  # Belief of planners and agents where none is named


class BeliefMethod:
    """Search or planner that plans as if a belief, one of BELIEFS, were the truth."""

    def __init__(self, task: Task, belief: str, method: Any) -> None:
        self.name = f"{belief}:{method.name}"
        self._task, self._belief, self._method = task, BELIEFS[belief], method
        if hasattr(method, "execute"):
            self.execute = method.execute

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return decisions of the method, see :class:`~viapoint.training.planning.baselines.Method`."""
        sight = Sight.of(observation, self._task)
        obstacles = self._belief(self._task, sight, scenes.obstacles)
        if hasattr(self._method, "solve"):
            problem = Problem.of_observation(observation, self._task)._replace(obstacles=obstacles)
            return np.asarray(self._method.solve(problem))
        return np.asarray(self._method.decide(observation, scenes._replace(obstacles=obstacles)))


class CautiousSearch:
    """Search that avoids what is seen and some space behind it, and prefers ways through space that is seen to be free.

    In joint space the best candidates are refined by the gradient of clearance, and compared with the others.
    """

    def __init__(self, task: Task, n_checks: int) -> None:
        _one_look(task, f"cautious{n_checks}")
        self.task, self.n_checks = task, n_checks
        self.name = f"cautious{n_checks}"

    def decide(self, observation: Mapping[str, Any], scenes: Any = None) -> Float:
        """Return the best action of each of B observations, shape (B, m)."""
        sight, name = Sight.of(observation, self.task), self.task.space_name
        obstacles = thick_points(self.task, sight, BEHIND[name])
        problem = Problem.of_observation(observation, self.task)._replace(obstacles=obstacles)
        every = candidate_actions(self.task, self.n_checks, replanning=False)
        actions: Numbers = np.broadcast_to(every, (len(problem.start), *every.shape))
        value = self.values(problem, sight, actions)
        if self.task.n_via and REFINED[name]:
            top = np.argsort(-value, axis=1, kind="stable")[:, : REFINED[name]]
            refined = refined_actions(self.task, problem, np.take_along_axis(actions, top[..., None], axis=1))
            value = np.concatenate((value, self.values(problem, sight, refined)), axis=1)
            actions = np.concatenate((actions, refined), axis=1)
        return np.asarray(actions[np.arange(len(actions)), value.argmax(axis=1)], np.float64)

    def values(self, problem: Problem, sight: Sight, actions: Numbers) -> Float:
        """Return the values of actions of shape (B, H, m), shape (B, H): rewards less the penalty for unseen space."""
        task, name = self.task, self.task.space_name
        moves = moves_of(task, problem, actions)
        high = CLEARANCE_RANGE[1]
        clearance = plan_clearances(task, problem, actions, high, -high)
        worth = worth_of(task, problem, moves) + task.weights.clearance / CLEARANCE_UNIT * clearance
        worth = np.where(clearance >= CLEARANCE_MARGIN, worth, INFEASIBLE + clearance)
        places = places_of(task, problem, moves, sight, instants_of(task, INSTANTS[name]))
        depth = np.clip(places.depth(sight) + MARGIN, 0.0, DEEPEST).max(axis=-1)
        return np.asarray(worth - UNSEEN_WEIGHT * depth.mean(axis=-1))
