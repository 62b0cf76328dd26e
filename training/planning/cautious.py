"""Planning with what a sensor sees: beliefs as obstacles, and a penalty for ways through unseen space.

These are the methods without learning that agents with sensors are compared with. The name of a method in tables and on
the command line is BELIEF:PLANNER, such as `points:search512`; without a belief it is `thick`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import Bool, Float, Int, Observation, Single
from viapoint.envs.geometry.clearance import place, place_group
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training.planning.beliefs import Sight, fitted_boxes, thick_points
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.movements import INSTANTS, Setting, joints_at, memory_of, place_hand
from viapoint.training.planning.problem import (
    Moves,
    Numbers,
    Problem,
    movement_of,
    moves_of,
    setting_of,
    worth_of,
)
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    INFEASIBLE,
    plan_clearances,
    refined_actions,
)

OUT_OF_VIEW = -1  # Ray of a place that is outside the field of view
# Number of instants at which the way through unseen space is measured
PENALTY_INSTANTS = {"hand": 32, "joints": 16}
# Depth behind a seen surface that is avoided like the surface, [m]
BEHIND = {"hand": 0.04, "joints": 0.04}
UNSEEN_WEIGHT = 50.0  # Reward that a mean depth of 1 m in unseen space costs, [1/m]
MARGIN = 0.03  # Distance in front of unseen space at which the penalty begins, [m]
DEEPEST = 0.1  # Depth in unseen space at which the penalty of an instant saturates, [m]
# Number of best candidates that are refined around what is seen. The settings were tuned on `validation` scenes.
REFINED = {"hand": 0, "joints": 8}


class Places(NamedTuple):
    """Places of S spheres at T instants of H movements in each of B scenes."""

    # Number of the ray that passes nearest to the centre, or OUT_OF_VIEW, shape (B, H, T, S)
    ray: NDArray[np.int32]
    distance: Single  # Distance of the centre from the sensor, shape (B, H, T, S), [m]
    centre: Single  # Centre in the world, shape (B, H, T, S, 3), [m]
    radius: Single  # Radius of each sphere, shape (S,), [m]
    inside: Bool  # True for movements within reach and joint ranges, shape (B, H)

    def depth(self, sight: Sight) -> Single:
        """Return how far centres lie behind the surface that is seen in their direction, shape (B, H, T, S), [m].

        Where nothing is seen in this direction, or the place is out of view, it is the negative greatest range.
        """
        number = len(self.ray)
        flat = self.ray.reshape(number, -1)
        rays = np.maximum(flat, 0)
        ranges = np.take_along_axis(sight.ranges, rays, axis=1)
        seen = np.take_along_axis(sight.hit, rays, axis=1) & (flat >= 0)
        depth = np.where(seen, self.distance.reshape(number, -1) - ranges, -sight.ranges.max(initial=1.0))
        return depth.reshape(self.ray.shape).astype(np.float32)


def places_of(task: Task, problem: Problem, moves: Moves, sight: Sight, instants: Int) -> Places:
    """Return where the spheres of the arm are at some instants of H movements in each of B problems.

    The obstacles of the problems tell which spheres of an arm in the plane matter.
    """
    setting = setting_of(task, problem.obstacles)
    number, plans = moves.duration.shape
    links = np.repeat(setting.spheres.link, np.diff(setting.spheres.first))
    some = np.flatnonzero(links > 0)
    shape = number, plans, len(instants), len(some)
    centre = np.zeros((*shape, 3), np.float32)
    inside = np.ones((number, plans), np.bool_)
    _centres(setting, moves, instants, some, centre, inside)
    assert task.sensor is not None
    ray, distance = sight.towards(task.sensor, centre.reshape(number, -1, 3))
    radius = setting.spheres.radius[some].astype(np.float32)
    return Places(ray.reshape(shape), distance.reshape(shape), centre, radius, inside)


def instants_of(task: Task, number: int) -> Int:
    """Return instants of a movement at which its places are looked at; in joint space not the first and last ones."""
    ends = 0 if task.space.of_hand else 2
    return np.linspace(ends, INSTANTS - 1 - ends, number).round().astype(np.int64)


@compiled
def _centres(setting: Setting, moves: Moves, instants: Int, some: Int, centre: Single, inside: Bool) -> None:
    """Fill in the centres of some spheres, see :func:`places_of`."""
    number, plans = moves.duration.shape
    spheres = setting.spheres
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    position, joints, placed = memory.position, memory.joints, memory.placed
    for b in range(number):
        for h in range(plans):
            for k in range(len(instants)):
                if not joints_at(setting, movement_of(moves, b, h), instants[k], position, joints):
                    inside[b, h] = False
                    break
                if setting.hand_alone:
                    place_hand(position, placed)
                else:
                    place(setting.chain, setting.spheres, joints, placed)
                for group in range(len(spheres.link)):
                    place_group(spheres, group, placed)
                for i in range(len(some)):
                    for axis in range(3):
                        centre[b, h, k, i, axis] = placed.centre[some[i], axis]


def seen(task: Task, sight: Sight, truth: Obstacles) -> Obstacles:
    """Return those of the true obstacles that at least one ray meets."""
    sensor = _one_look(task, "seen")
    hidden = sensor.hidden(sight.rotation[:, 0], sight.origin[:, 0], truth)
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
        places = places_of(task, problem, moves, sight, instants_of(task, PENALTY_INSTANTS[name]))
        depth = np.clip(places.depth(sight) + MARGIN, 0.0, DEEPEST).max(axis=-1)
        return np.asarray(worth - UNSEEN_WEIGHT * depth.mean(axis=-1))
