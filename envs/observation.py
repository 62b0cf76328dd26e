"""Observations of all tasks."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from viapoint.envs.arms.arm import Arm
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.obstacles import POSE_SIZE, Obstacles, observation_rows
from viapoint.envs.plans import Motion
from viapoint.envs.replanning import NominalPlan
from viapoint.envs.scenes.scene import FARTHEST, FASTEST
from viapoint.envs.sensors import Looks, Sensor

BEYOND_LIMIT = 0.1
"""Margin beyond the joint limits at which observed joints are clipped, [rad]."""


@dataclass(frozen=True, kw_only=True)
class ObservationLayout:
    """Names, sizes, bounds and units of the observation's parts.

    `joints` [rad], `hand` and `goal` [m]; in joint space `goal_joints` [rad]; where obstacles may be, `obstacles`:
    n rows (kind one-hot, centre [m], first two axes of the frame, half lengths of the bounding box [m], velocity [m/s],
    present), flattened. With a sensor, `ranges` and `points` of its rays [m], flattened, in place of `obstacles`, for
    all looks that are remembered; where there are several, also `eyes`, the places of these looks [m]. While
    a movement is under way also the reference that the arm follows, `command`, `velocity` and `acceleration`, and
    `time_left` [s]; in tasks with replanning `via` and `remaining` [s], the plan of a zero action. What exceeds its
    bounds is clipped.
    """

    arm: Arm
    kinds: tuple[str, ...]
    """Kinds that obstacles may have."""
    n_rows: int
    """Greatest number of obstacles."""
    dimension: int
    """Dimension D of the space of the movements."""
    in_joints: bool
    """True if movements are planned in joint space."""
    n_via: int | None = None
    """Number of via-points that are observed; None where plans are not revised."""
    speed: float = 0.0
    """Bound of the command's velocity; 0 where it is not observed."""
    acceleration: float = 0.0
    """Bound of the command's acceleration."""
    time_limit: float = 0.0
    """Time limit of an episode, [s]."""
    sensor: Sensor | None = None
    """Sensor whose readings are observed in place of the obstacles."""

    @property
    def row_size(self) -> int:
        """Number of values of one obstacle."""
        return len(self.kinds) + POSE_SIZE

    @functools.cached_property
    def bounds(self) -> dict[str, tuple[Float, Float]]:
        """Lower and upper bounds of the parts."""
        low, high = self.arm.joint_range.T
        joints = low - BEYOND_LIMIT, high + BEYOND_LIMIT  # MuJoCo's joint limits are soft
        found = {"joints": joints, "hand": _box(FARTHEST, 3), "goal": _box(FARTHEST, 3)}
        if self.in_joints:
            found["goal_joints"] = joints
        if self.sensor is not None:
            farthest = self.sensor.range + FARTHEST + float(np.abs(self.sensor.position).max())
            number = self.sensor.looks * self.sensor.n_rays  # all looks that are remembered
            found["ranges"] = np.zeros(number), np.full(number, self.sensor.range)
            found["points"] = _box(farthest, 3 * number)
            if self.sensor.looks > 1:
                found["eyes"] = _box(FARTHEST, 3 * self.sensor.looks)
        elif self.n_rows:
            kinds, pose = np.zeros(len(self.kinds)), [FARTHEST] * 3 + [1.0] * 6
            sizes = [FARTHEST] * 3
            lowest = np.concatenate((kinds, -np.array(pose), np.zeros(3), [-FASTEST] * 3, [0.0]))
            highest = np.concatenate((kinds + 1.0, pose, sizes, [FASTEST] * 3, [1.0]))
            found["obstacles"] = np.tile(lowest, self.n_rows), np.tile(highest, self.n_rows)
        if self.speed:
            place = joints if self.in_joints else _box(FARTHEST, self.dimension)
            found["command"] = place
            found["velocity"] = _box(self.speed, self.dimension)
            found["acceleration"] = _box(self.acceleration, self.dimension)
            found["time_left"] = _span(self.time_limit)
            if self.n_via is not None:
                found["remaining"] = _span(self.time_limit)
                if self.n_via:
                    found["via"] = np.tile(place[0], self.n_via), np.tile(place[1], self.n_via)
        return found

    def space(self) -> spaces.Dict:
        """Return the observation space of one environment."""
        return spaces.Dict(
            {
                name: spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
                for name, (low, high) in self.bounds.items()
            }
        )

    def observe(
        self,
        joints: Float,
        hand: Float,
        goal: tuple[Float, Float],
        obstacles: Obstacles,
        command: Motion | None = None,
        time: Float | None = None,
        nominal: NominalPlan | None = None,
        looks: Looks | None = None,
    ) -> Observation:
        """Return observations of N environments in fresh arrays.

        Goals are joint positions, (N, J), [rad], and hand positions, (N, 3), [m]. References that the arms follow and
        times since the starts of the episodes, (N,), [s], are needed where decisions are made during a movement, and
        plans of a zero action in tasks with replanning. Without the looks of a sensor so far, a first look is made.
        """
        parts: dict[str, Any] = {
            "joints": joints,
            "hand": hand,
            "goal": goal[1],
            "goal_joints": goal[0],
        }
        if self.sensor is not None:
            if looks is None:
                looks = Looks.none(self.sensor, len(joints))
                looks.add(np.arange(len(joints)), self.sensor, self.arm, joints, obstacles)
            for name, part in looks._asdict().items():
                parts[name] = part.reshape(len(joints), -1)
        else:
            parts["obstacles"] = observation_rows(obstacles, self.kinds).reshape(len(joints), -1)
        if command is not None and time is not None:
            parts |= {
                "command": command.position,
                "velocity": command.velocity,
                "acceleration": command.acceleration,
                "time_left": (self.time_limit - time)[:, None],
            }
        if nominal is not None:
            parts["via"] = nominal.vias.reshape(len(joints), -1)
            parts["remaining"] = nominal.remaining[:, None]
        observation = {}
        for name, (low, high) in self.bounds.items():
            observation[name] = np.clip(parts[name], low, high).astype(np.float32)  # as the space promises
        return observation

    def rows(self, part: Any) -> Any:
        """Return the `obstacles` part as rows, shape (..., n, row_size), in NumPy or torch."""
        return part.reshape((*part.shape[:-1], self.n_rows, self.row_size))


def _box(bound: float, size: int) -> tuple[Float, Float]:
    """Return symmetric bounds."""
    return np.full(size, -bound), np.full(size, bound)


def _span(most: float) -> tuple[Float, Float]:
    """Return the bounds of a time, [s]."""
    return np.zeros(1), np.full(1, most)
