"""Movements to begin with: the straight one and ways round, wide and narrow, early and late."""

from __future__ import annotations

from collections.abc import Container

import numpy as np
from numpy.typing import NDArray

from viapoint.envs._arrays import clamp, last, namespace_of
from viapoint.envs.action import ActionLayout, frame
from viapoint.envs.task import Task
from viapoint.training.features import Look, look_along, look_at
from viapoint.training.movements import Movements, direction, effort_of, on_the_way
from viapoint.training.sight import INSTANTS, Array, Observation

ALONG = {2: (-0.32, -0.16, 0.0, 0.16, 0.32), 3: (-0.25, 0.0, 0.25)}
HEIGHT = {2: (0.12, 0.25, 0.40, 0.55, 0.70, 0.85), 3: (0.20, 0.45, 0.75)}
"""Where anchors' via-points lie from the middle of the straight line, relative to its length, in plane and space."""
DETOURS = (0.2, 0.4, 0.7)
"""How far a detour goes aside, relative to the distance that is left."""
PACES = (0.0, -0.8, 0.8)
"""Durations that are tried without a detour; the first changes nothing."""
NARROW = 0.12
"""Distances are not taken for shorter than this, [m]: obstacles are as wide near the goal as elsewhere."""


class Anchors:
    """Fixed movements, scaled with the distance of start and goal.

    As they scale, their paths are computed once. A policy that sees how each of them would fare needs to improve the
    promising ones only.

    Args:
        task: The environment's.
        count: Only so many of them, evenly spread; 1 is the straight movement.
    """

    def __init__(self, task: Task, count: int | None = None) -> None:
        if not task.action.n_via:
            raise ValueError("a policy of via-points needs an environment with n_via of 1 or more")
        d = task.arm.dimension
        layout = ActionLayout(dimension=d, via_scale=(1.0,) * d)
        vias = _vias(d, count)
        goal = np.eye(d)[0] * np.ones((len(vias), 1))
        plan = layout.decode(np.concatenate((vias, np.zeros((len(vias), 1))), axis=-1), 0.0 * goal, goal)
        trajectory, duration = plan.trajectory(), plan.durations.sum(axis=-1)
        self.task = task
        path = trajectory(duration[:, None] * INSTANTS).astype(np.float32)
        self.paths = np.ascontiguousarray(np.moveaxis(path, -1, 0))
        """In the frame of start and goal, shape (D, A, PHASES), for a distance of 1 m."""
        ratio = trajectory.cost() * duration**5 / 360.0
        self.log_jerk = np.log(np.maximum(ratio, 1.0)).astype(np.float32)
        """Of their jerk cost relative to the straight movement's, shape (A,)."""
        places = np.arange(1, task.action.n_via + 1) / (task.action.n_via + 1)
        on_path = trajectory(duration[:, None] * places) - places[:, None] * goal[:, None]
        if task.action.n_via == 1:
            on_path = vias[:, None]
        scaled = on_path / np.array(task.action.via_scale[:d])
        self.vias = scaled.reshape(len(vias), -1).astype(np.float32)
        """Via components of their actions, shape (A, K D), for a distance of 1 m."""

    def __len__(self) -> int:
        return len(self.vias)

    def look(self, observation: Observation) -> Look:
        """See how they would fare in each of B scenes."""
        start, line = observation["hand"], observation["goal"] - observation["hand"]
        xp = namespace_of(line)
        distance = xp.sqrt(xp.sum(line * line, axis=-1))[:, None, None]
        hand = self._paths(start, xp.stack(frame(line), axis=-2) * distance)
        actions = self.actions(observation)
        log_jerk = xp.zeros_like(actions[..., 0]) + xp.asarray(self.log_jerk)
        duration = xp.full_like(log_jerk, self.task.action.centre_duration)
        moves = Movements(hand, duration, log_jerk, effort_of(log_jerk, duration, self.task))
        return look_along(observation, actions, moves, self.task)

    def _paths(self, start: Array, axes: Array) -> Array:
        """Of the hand, shape (B, A, PHASES, D), each component by itself in memory, as they are dealt with."""
        xp = namespace_of(start)
        paths = xp.asarray(self.paths)
        parts = [
            start[:, i, None, None] + sum(paths[j] * axes[:, j, i, None, None] for j in range(len(paths)))
            for i in range(len(paths))
        ]
        return last(xp.stack(parts))

    def actions(self, observation: Observation) -> Array:
        """In each of B scenes, shape (B, A, m), inside (-1, 1)."""
        line = observation["goal"] - observation["hand"]
        xp = namespace_of(line)
        vias = xp.asarray(self.vias) * xp.sqrt(xp.sum(line * line, axis=-1))[:, None, None]
        rest = xp.zeros((*vias.shape[:2], self.task.action.size - vias.shape[-1]), dtype=vias.dtype)
        return clamp(xp.concat((vias, rest), axis=-1), -0.97, 0.97)


class AnchorsOnTheWay:
    """Changes of a movement that is under way: none, detours to all sides, and other durations.

    Args:
        task: The environment's.
        count: Only so many of them, evenly spread.
    """

    def __init__(self, task: Task, count: int | None = None) -> None:
        self.task, d = task, task.arm.dimension
        along, height, turn = np.meshgrid((-0.2, 0.2), DETOURS, _turns(d), indexing="ij")
        sideways = (np.cos(turn), np.sin(turn))[: d - 1]
        offsets = np.stack([along, *(height * side for side in sideways)], axis=-1).reshape(-1, d)
        slower = np.zeros((len(offsets), 1))
        quiet = np.zeros((len(PACES), d))
        every = np.concatenate(
            (
                np.concatenate((quiet, np.array(PACES)[:, None]), axis=1),
                np.concatenate((offsets, slower), axis=1),
            )
        )
        every = every if count is None else every[np.linspace(0, len(every) - 1, count).round().astype(int)]
        vias = np.tile(every[:, :d] / np.array(task.action.via_scale[:d]), task.action.n_via)
        self.vias = vias.astype(np.float32)
        """Via components of their actions, shape (A, K D), for a distance of 1 m."""
        self.pace = every[:, d:].astype(np.float32)
        """Duration components of their actions, shape (A, 1)."""

    def __len__(self) -> int:
        return len(self.vias)

    def actions(self, observation: Observation) -> Array:
        """In each of B scenes, shape (B, A, m), inside (-1, 1)."""
        line = direction(observation)
        xp = namespace_of(line)
        distance = xp.maximum(xp.sqrt(xp.sum(line * line, axis=-1)), NARROW)[:, None, None]
        vias = xp.asarray(self.vias) * distance
        pace = xp.broadcast_to(xp.asarray(self.pace), (*vias.shape[:2], 1))
        return clamp(xp.concat((vias, pace), axis=-1), -0.97, 0.97)

    def look(self, observation: Observation) -> Look:
        """See how they would fare in each of B scenes."""
        return look_at(observation, self.actions(observation), self.task)


def anchors_of(task: Task, parts: Container[str], count: int | None = None) -> Anchors | AnchorsOnTheWay:
    """The anchors for observations with these parts."""
    return AnchorsOnTheWay(task, count) if on_the_way(parts) else Anchors(task, count)


def _vias(dimension: int, count: int | None) -> NDArray[np.float64]:
    """Via-points for a distance of 1 m, from the middle of the straight line, shape (A, D)."""
    along, height, turn = np.meshgrid(ALONG[dimension], HEIGHT[dimension], _turns(dimension), indexing="ij")
    sideways = (np.cos(turn), np.sin(turn))[: dimension - 1]
    vias = np.stack([along, *(height * side for side in sideways)], axis=-1).reshape(-1, dimension)
    vias = np.concatenate((np.zeros((1, dimension)), vias))
    return vias if count is None else vias[np.linspace(0, len(vias) - 1, count).round().astype(int)]


def _turns(dimension: int) -> NDArray[np.float64]:
    """Directions sideways: left and right in the plane, eight all round in space."""
    return np.linspace(0.0, 2.0 * np.pi, 2 if dimension == 2 else 8, endpoint=False)
