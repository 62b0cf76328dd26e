"""Observations of all tasks."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Container
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Numbers, Observation
from viapoint.envs.geometry.rows import CAPSULES, POSE_SIZE, observed_rows, rows_of_observed
from viapoint.envs.scenes.scene import (
    FARTHEST_SHAPE,
    FASTEST,
    LARGEST_HALF_AXIS,
    LARGEST_HALF_LENGTH,
    LARGEST_RADIUS,
    Scenes,
)
from viapoint.primitives.array_api import Array

if TYPE_CHECKING:
    from viapoint.envs.actions.replanning import NominalPlan
    from viapoint.envs.arms.base import Arm
    from viapoint.envs.scenes.dynamic_scene import ChangingScenes

FARTHEST = 1.0
"""Bound of every coordinate, [m]."""
BEYOND_LIMIT = 0.1
"""Margin beyond the joint limits at which observed angles are clipped, [rad]."""


class ObstacleRows(NamedTuple):
    """Capsules of an observation by name, shape (..., n, .) each, [m]; absent rows are zero."""

    centre: Array
    half_axis: Array
    radius: Array
    present: Array


class ShapeRows(NamedTuple):
    """Obstacles of any shape of an observation by name, shape (..., n, .) each; absent rows are zero."""

    shape: Array
    """One-hot vectors of the shapes of the environment."""
    centre: Array
    """[m]"""
    rotation: Array
    """First two axes of the obstacles' frames."""
    half_lengths: Array
    """Half lengths of the bounding boxes along the axes of the frames, [m]."""
    present: Array
    """1 for obstacles, shape (..., n)."""


@dataclass(frozen=True, kw_only=True)
class ObservationLayout:
    """Names, sizes, bounds and units of the observation's parts.

    `hand` and `goal` [m], `joints` [rad] and, where there may be obstacles, `obstacles`: n rows of centre (D),
    half-axis vector (D) and radius [m] and a 1 for present, flattened. Where obstacles may have other shapes than
    capsules, `obstacles` are n rows (shape one-hot, centre 3 [m], rotation 6, half lengths 3 [m], present), not
    flattened, see :func:`~viapoint.envs.geometry.rows.observation_rows`. The rows are in random order.
    """

    dimension: int
    joint_range: tuple[tuple[float, float], ...]
    n_rows: int
    shapes: tuple[str, ...] = CAPSULES
    """Names of the shapes that obstacles may have."""

    @classmethod
    def of(cls, arm: Arm, n_rows: int, shapes: tuple[str, ...] = CAPSULES, **further: Any) -> Self:
        """Return the layout for an arm and at most `n_rows` obstacles of some shapes."""
        return cls(
            dimension=arm.dimension, joint_range=arm.joint_range, n_rows=n_rows, shapes=shapes, **further
        )

    @functools.cached_property
    def _joint_bounds(self) -> tuple[Float, Float]:
        """Lowest and highest observed joint angles, shape (J,) each, [rad]."""
        low, high = np.array(self.joint_range).T
        return low - BEYOND_LIMIT, high + BEYOND_LIMIT

    @property
    def row_size(self) -> int:
        """Number of values of one obstacle."""
        return 2 * self.dimension + 2 if self.shapes == CAPSULES else len(self.shapes) + POSE_SIZE

    def space(self) -> spaces.Dict:
        """Return the observation space of one environment."""
        point = np.full(self.dimension, FARTHEST)
        low, high = self._joint_bounds
        bounds = {"hand": (-point, point), "goal": (-point, point), "joints": (low, high)}
        if self.n_rows and self.shapes != CAPSULES:
            kinds = np.ones(len(self.shapes))
            row = np.concatenate((kinds, 3 * [FARTHEST_SHAPE], np.ones(6), 3 * [LARGEST_HALF_LENGTH], [1.0]))
            lowest = np.concatenate((0.0 * kinds, 3 * [-FARTHEST_SHAPE], -np.ones(6), np.zeros(4)))
            bounds["obstacles"] = np.tile(lowest, (self.n_rows, 1)), np.tile(row, (self.n_rows, 1))
        elif self.n_rows:
            half = np.full(self.dimension, LARGEST_HALF_AXIS)
            row = np.concatenate((point, half, [LARGEST_RADIUS, 1.0]))
            lowest = np.concatenate((-point, -half, [0.0, 0.0]))
            bounds["obstacles"] = (np.tile(lowest, self.n_rows), np.tile(row, self.n_rows))
        return spaces.Dict(
            {
                name: spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
                for name, (low, high) in bounds.items()
            }
        )

    def observe(
        self, joints: NDArray[np.float64], hand: NDArray[np.float64], scenes: Scenes
    ) -> dict[str, NDArray[np.float32]]:
        """Return observations of N environments, shape (N, .) each, in fresh arrays."""
        low, high = self._joint_bounds
        parts: dict[str, Any] = {
            "hand": np.clip(hand, -FARTHEST, FARTHEST),
            "goal": scenes.goal,
            "joints": np.clip(joints, low, high),
        }
        if self.n_rows:
            parts["obstacles"] = self.observed_obstacles(scenes)
        return {name: part.astype(np.float32) for name, part in parts.items()}

    def observed_obstacles(self, scenes: Scenes) -> Float:
        """Return the `obstacles` part of N scenes in double precision, shape (N, .) or (N, n, .)."""
        if self.shapes != CAPSULES:
            return observed_rows(scenes.obstacles, self.shapes)
        rows = np.concatenate((scenes.obstacles, scenes.present[..., None]), axis=-1)
        return np.asarray(rows.reshape(len(rows), -1))

    def obstacles(self, part: Array) -> ObstacleRows | ShapeRows:
        """Return views of the `obstacles` part by name, in NumPy or torch.

        Args:
            part: Shape (..., n (2 D + 2)), or (..., n, .) where obstacles may have other shapes than capsules.
        """
        if self.shapes == CAPSULES:
            return self.capsules(part)
        ends = np.cumsum((len(self.shapes), 3, 6, 3))
        shape, centre, rotation, half = (part[..., a:b] for a, b in itertools.pairwise((0, *ends)))
        return ShapeRows(shape, centre, rotation, half, part[..., -1])

    def capsules(self, flat: Array) -> ObstacleRows:
        """Return views of the `obstacles` part of an environment with capsules alone, shape (..., n (2 D + 2))."""
        rows = flat.reshape((*flat.shape[:-1], flat.shape[-1] // self.row_size, self.row_size))
        d = self.dimension
        return ObstacleRows(rows[..., :d], rows[..., d : 2 * d], rows[..., 2 * d], rows[..., 2 * d + 1])

    def scene_rows(self, part: Numbers) -> Numbers:
        """Return the `obstacles` part as rows of scenes, shape (..., n, .), see :mod:`viapoint.envs.geometry.rows`."""
        if self.shapes != CAPSULES:
            return rows_of_observed(part, self.shapes, self.dimension)
        seen = self.capsules(part)
        radius = np.where(seen.present > 0.5, seen.radius, 0.0)[..., None]
        return np.concatenate((seen.centre, seen.half_axis, radius), axis=-1)


GREATEST_SPEED = 5.0
"""Bound of the commanded velocity along any axis, [m/s]."""
GREATEST_ACCELERATION = 100.0
"""Bound of the commanded acceleration along any axis, [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class ReplanningObservationLayout(ObservationLayout):
    """Layout of replanning observations; future changes of the scene are hidden.

    `hand` [m], `velocity` [m/s] and `acceleration` [m/s^2] are the present command, `goal` and `obstacles` the present
    ones, `obstacle_velocities` n rows of D [m/s], flattened, `time_left` [s]; `via`, K rows of D [m], flattened, and
    `remaining` [s] are the plan that a zero action leads to. What exceeds its bounds is clipped.
    """

    n_via: int
    time_limit: float

    def space(self) -> spaces.Dict:
        """Return the observation space of one environment."""
        d = self.dimension
        sides = {
            "velocity": (-GREATEST_SPEED, GREATEST_SPEED, d),
            "acceleration": (-GREATEST_ACCELERATION, GREATEST_ACCELERATION, d),
            "obstacle_velocities": (-FASTEST, FASTEST, self.n_rows * d),
            "time_left": (0.0, self.time_limit, 1),
            "via": (-FARTHEST, FARTHEST, self.n_via * d),
            "remaining": (0.0, self.time_limit, 1),
        }
        boxes = {name: spaces.Box(low, high, (n,), np.float32) for name, (low, high, n) in sides.items() if n}
        return spaces.Dict({**super().space().spaces, **boxes})

    def observe_replanning(
        self, joints: Float, scenes: ChangingScenes, default: NominalPlan, time: Float
    ) -> Observation:
        """Return observations at times since the start, shape (N,), [s], in fresh arrays of shape (N, .) each."""
        now = scenes.at(time)
        d, number = self.dimension, len(time)
        farthest = FARTHEST if self.shapes == CAPSULES else FARTHEST_SHAPE
        now.obstacles[..., :d] = np.clip(now.obstacles[..., :d], -farthest, farthest)
        seen = self.observe(joints, default.state.position, now)
        parts = {
            "velocity": np.clip(default.state.velocity, -GREATEST_SPEED, GREATEST_SPEED),
            "acceleration": np.clip(
                default.state.acceleration, -GREATEST_ACCELERATION, GREATEST_ACCELERATION
            ),
            "obstacle_velocities": scenes.velocities(time).reshape(number, -1),
            "time_left": np.clip(self.time_limit - time, 0.0, self.time_limit)[:, None],
            "via": np.clip(default.vias, -FARTHEST, FARTHEST).reshape(number, -1),
            "remaining": np.clip(default.remaining, 0.0, self.time_limit)[:, None],
        }
        return {**seen, **{name: part.astype(np.float32) for name, part in parts.items() if part.shape[1]}}


def is_replanning(parts: Container[str]) -> bool:
    """Return whether decisions on observations with these parts revise a movement that may be under way."""
    return "remaining" in parts
