"""Search among obstacles that move, with a prediction of their courses.

A prediction is a list of places at intervals of CHORD, between which obstacles move straight. The rest is the search
with computed geometry, which by itself takes the present velocities for constant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import Float, Observation, norm
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.scenes.motions import REACH_LENGTH, REACH_TIME
from viapoint.envs.scenes.scene import CHORD, Scenes, reach_rate, reached
from viapoint.training.planning.problem import Problem
from viapoint.training.rollout import Outcomes, SceneSimulation

HORIZON = 40  # Number of intervals of a prediction; obstacles keep the last velocity
MOVING = 1e-3  # Speed above which an obstacle moves, [m/s]
# Hypotheses on a reach: durations, and the shares of them that have passed
DURATIONS = np.linspace(*REACH_TIME, 7)
PASSED = np.linspace(0.01, 0.99, 50)
# Standard deviations of what was seen from a hypothesis, [m] and [m/s], and of lengths beyond the usual ones, [m]
PLACE_ERROR, RATE_ERROR, LENGTH_ERROR = 0.002, 0.02, 0.03


def _at_rest(time: Float, centre: Float, velocity: Float, scene: Scenes) -> Float:
    """Return obstacles that stay where they are, shape (HORIZON + 1, n, 3), [m]."""
    return np.repeat(centre[-1:], HORIZON + 1, axis=0)


def known_courses(time: Float, centre: Float, velocity: Float, scene: Scenes) -> Float:
    """Return the true courses, which no method can know."""
    times = time[-1] + CHORD * np.arange(HORIZON + 1)
    return scene.take(np.zeros(len(times), np.int64)).obstacles_at(times).centre


def fitted_reaches(time: Float, centre: Float, velocity: Float, scene: Scenes) -> Float:
    """Return minimum-jerk reaches that fit what was seen; an obstacle that rests stays where it is.

    Each hypothesis on duration and begin of the reach has a way, by least squares, and a probability, by what was seen
    and by the length of usual reaches. The prediction is the mean of all hypotheses.
    """
    places = _at_rest(time, centre, velocity, scene)
    ahead = np.linspace(0.0, CHORD * HORIZON, HORIZON + 1)
    for row in np.flatnonzero(norm(velocity[-1]) > MOVING):
        made, weight, way = _hypotheses(time, centre[:, row], velocity[:, row], ahead)
        places[:, row] += np.einsum("h,ht,hd->td", weight, made, way)
    return places


def _hypotheses(time: Float, centre: Float, velocity: Float, ahead: Float) -> tuple[Float, Float, Float]:
    """Return the H hypotheses on a reach that was seen M times.

    Returns:
        Shares of the way that will be made at times from now, shape (H, T); probabilities, shape (H,); ways, shape
        (H, 3), [m].
    """
    duration, passed = (part.ravel() for part in np.meshgrid(DURATIONS, PASSED, indexing="ij"))
    begin = time[-1] - passed * duration
    number = len(time)
    share, rate = _shares(begin, duration, np.concatenate((time, time[-1] + ahead)))
    now = share[:, number - 1, None]
    # Places and velocities in units of their errors, as products of a coefficient and the way
    seen = (share[:, :number] - now) / PLACE_ERROR, rate[:, :number] / RATE_ERROR
    coefficient = np.concatenate(seen, axis=1)
    value = np.concatenate(((centre - centre[-1]) / PLACE_ERROR, velocity / RATE_ERROR))
    square = np.maximum((coefficient**2).sum(axis=1), 1e-12)
    way = coefficient @ value / square[:, None]
    misfit = (value**2).sum() - square * (way**2).sum(axis=1)
    length = norm(way)
    beyond = np.maximum(REACH_LENGTH[0] - length, 0.0) + np.maximum(length - REACH_LENGTH[1], 0.0)
    misfit = misfit + (beyond / LENGTH_ERROR) ** 2
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    return share[:, number:] - now, weight / weight.sum(), way


@compiled
def _shares(begin: Float, duration: Float, time: Float) -> tuple[Float, Float]:
    """Return the shares of their ways that H reaches have made at T times, and their rates, shape (H, T)."""
    share, rate = np.empty((2, len(begin), len(time)))
    for h in range(len(begin)):
        for k in range(len(time)):
            share[h, k] = reached(begin[h], duration[h], time[k])
            rate[h, k] = reach_rate(begin[h], duration[h], time[k])
    return share, rate


# Predictions of the places of obstacles by name: from the times of the M decisions of an episode so far, shape (M,),
# [s], and places and velocities of its obstacles as seen then, shape (M, n, 3), [m] and [m/s]
PREDICTIONS: dict[str, Callable[[Float, Float, Float, Scenes], Float]] = {
    "rest": _at_rest,
    "reach": fitted_reaches,
    "known": known_courses,
}
Memory = dict[bytes, list[Float]]  # Times, places and velocities that were seen in each episode


class PredictedSearch:
    """Search that revises its plans among obstacles whose courses it predicts, by one of PREDICTIONS.

    The search is a :class:`~viapoint.training.planning.search.GeometrySearch`.
    """

    def __init__(self, simulation: SceneSimulation, prediction: str, search: Any) -> None:
        self.name = f"{prediction}:{search.name}"
        self._simulation, self._predict, self._search = simulation, PREDICTIONS[prediction], search

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return first decisions, see :class:`~viapoint.training.planning.baselines.Method`."""
        return self._decide(observation, scenes, {})

    def execute(self, scenes: Scenes, decisions: Float) -> Outcomes:
        """Play every episode to its end, beginning with the given decisions, and remember what is seen."""
        memory: Memory = {}
        self._look(self._problem(self._simulation.observe(scenes)), scenes, memory)
        return self._simulation(scenes, decisions, lambda seen, some: self._decide(seen, some, memory))

    def _problem(self, observation: Observation) -> Problem:
        return Problem.of_observation(observation, self._search.task)

    def _decide(self, observation: Observation, scenes: Scenes, memory: Memory) -> Float:
        problem = self._problem(observation)
        places = []
        for i, (time, centre, velocity) in enumerate(self._look(problem, scenes, memory)):
            places.append(self._predict(time, centre, velocity, scenes.take([i])))
        obstacles = _in_pieces(problem.obstacles, np.array(places))
        return np.asarray(self._search.solve(problem._replace(obstacles=obstacles), n_pieces=HORIZON))

    def _look(self, problem: Problem, scenes: Scenes, memory: Memory) -> list[list[Float]]:
        """Add what is seen to the memory of the episodes, which the scenes tell apart, and return that."""
        assert problem.time_left is not None
        time = self._search.task.time_limit - problem.time_left
        found = []
        for i in range(len(time)):
            parts = scenes.start[i], scenes.goal[i], scenes.obstacles.centre[i], scenes.reach[i]
            key = b"".join(part.tobytes() for part in parts)
            seen = time[[i]], problem.obstacles.centre[[i]], problem.obstacles.velocity[[i]]
            before = memory.get(key, [part[:0] for part in seen])
            memory[key] = [np.concatenate(both) for both in zip(before, seen, strict=True)]
            found.append(memory[key])
        return found


def _in_pieces(obstacles: Obstacles, places: Float) -> Obstacles:
    """Return obstacles of B problems in pieces of CHORD, B T scenes, for places of shape (B, T + 1, n, 3), [m].

    The centre of each piece is where the obstacle would be at time 0 with the velocity of the piece.
    """
    number, pieces = len(places), places.shape[1] - 1
    velocity = np.diff(places, axis=1) / CHORD
    begin = CHORD * np.arange(pieces)[:, None, None]
    centre = places[:, :-1] - begin * velocity
    many = obstacles.take(np.repeat(np.arange(number), pieces))
    shape = many.centre.shape
    return many._replace(centre=centre.reshape(shape), velocity=velocity.reshape(shape))
