"""What the agent sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.scenes import LARGEST_HALF_AXIS, LARGEST_RADIUS, Scenes

Array = Any

FARTHEST = 1.0
"""Bound of every coordinate, [m]."""
BEYOND_LIMIT = 0.1
"""How far a joint may be pushed past its limit before the observation clips it, [rad]."""


class ObstacleRows(NamedTuple):
    """The obstacles of an observation by name, shape (..., n, .) each, [m]; absent rows are zero."""

    centre: Array
    half_axis: Array
    radius: Array
    present: Array


@dataclass(frozen=True, kw_only=True)
class ObservationLayout:
    """Names, sizes, bounds and units of the observation's parts.

    `hand` and `goal` [m], `joints` [rad] and, where there may be obstacles, `obstacles`: n rows of centre (D),
    half-axis vector (D) and radius [m] and a 1 for present, flattened. The rows are in random order.
    """

    dimension: int
    joint_range: tuple[tuple[float, float], ...]
    n_rows: int

    @classmethod
    def of(cls, arm: Arm, n_rows: int) -> ObservationLayout:
        """The layout for an arm and at most `n_rows` obstacles."""
        return cls(dimension=arm.dimension, joint_range=arm.joint_range, n_rows=n_rows)

    @property
    def row_size(self) -> int:
        """Numbers of one obstacle."""
        return 2 * self.dimension + 2

    def space(self) -> spaces.Dict:
        """The observation space of one environment."""
        point = np.full(self.dimension, FARTHEST)
        low, high = (np.array(side) for side in zip(*self.joint_range, strict=True))
        bounds = {
            "hand": (-point, point),
            "goal": (-point, point),
            "joints": (low - BEYOND_LIMIT, high + BEYOND_LIMIT),
        }
        if self.n_rows:
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
        """Observations of N environments, shape (N, .) each, in fresh arrays."""
        low, high = (np.array(side) for side in zip(*self.joint_range, strict=True))
        parts: dict[str, Any] = {
            "hand": np.clip(hand, -FARTHEST, FARTHEST),
            "goal": scenes.goal,
            "joints": np.clip(joints, low - BEYOND_LIMIT, high + BEYOND_LIMIT),
        }
        if self.n_rows:
            rows = np.concatenate((scenes.obstacles, scenes.present[..., None]), axis=-1)
            parts["obstacles"] = rows.reshape(len(rows), -1)
        return {name: part.astype(np.float32) for name, part in parts.items()}

    def obstacles(self, flat: Array) -> ObstacleRows:
        """The `obstacles` part, shape (..., n (2 D + 2)), by name; a view, of NumPy arrays and torch tensors."""
        rows = flat.reshape((*flat.shape[:-1], self.n_rows, self.row_size))
        d = self.dimension
        return ObstacleRows(rows[..., :d], rows[..., d : 2 * d], rows[..., 2 * d], rows[..., 2 * d + 1])
