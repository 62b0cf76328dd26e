"""Observations of all tasks."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from viapoint.envs.common.arrays import Float, Observation
from viapoint.envs.geometry.obstacles import POSE_SIZE, Obstacles, observation_rows
from viapoint.envs.plans import Motion, NominalPlan
from viapoint.envs.scenes.scene import FASTEST
from viapoint.envs.sensors import Looks

if TYPE_CHECKING:
    from viapoint.envs.task import Task

BEYOND_LIMIT = 0.1  # Margin beyond the joint limits at which observed joints are clipped, [rad]


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

    def __init__(self, task: Task) -> None:
        self.task = task
        self.n_rows = task.n_obstacles[1]  # Greatest number of obstacles
        self.row_size = len(task.shapes) + POSE_SIZE  # Number of values of one obstacle

    @functools.cached_property
    def bounds(self) -> dict[str, tuple[Float, Float]]:
        """Lower and upper bounds of the parts."""
        task, sensor = self.task, self.task.sensor
        farthest = task.arm.farthest
        low, high = task.arm.joint_range.T
        joints = low - BEYOND_LIMIT, high + BEYOND_LIMIT  # MuJoCo's joint limits are soft
        found = {"joints": joints, "hand": _box(farthest, 3), "goal": _box(farthest, 3)}
        if task.space_name == "joints":
            found["goal_joints"] = joints
        if sensor is not None:
            seen = sensor.range + farthest + float(np.abs(sensor.position).max())
            number = sensor.looks * sensor.n_rays  # all looks that are remembered
            found["ranges"] = np.zeros(number), np.full(number, sensor.range)
            found["points"] = _box(seen, 3 * number)
            if sensor.looks > 1:
                found["eyes"] = _box(farthest, 3 * sensor.looks)
        elif self.n_rows:
            kinds = np.zeros(len(task.shapes))
            pose = [farthest] * 3 + [1.0] * 6
            sizes = [farthest] * 3
            lowest = np.concatenate((kinds, -np.array(pose), np.zeros(3), [-FASTEST] * 3, [0.0]))
            highest = np.concatenate((kinds + 1.0, pose, sizes, [FASTEST] * 3, [1.0]))
            found["obstacles"] = np.tile(lowest, self.n_rows), np.tile(highest, self.n_rows)
        if not task.whole_movement:
            dimension = task.space.dimension
            place = joints if task.space_name == "joints" else _box(farthest, dimension)
            found["command"] = place
            found["velocity"] = _box(2.0 * max(task.steering.top_speed), dimension)
            found["acceleration"] = _box(task.steering.greatest_acceleration, dimension)
            found["time_left"] = np.zeros(1), np.full(1, task.time_limit)
            if task.replanning:
                found["remaining"] = found["time_left"]
                if task.n_via:
                    found["via"] = np.tile(place[0], task.n_via), np.tile(place[1], task.n_via)
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
        parts: dict[str, Any] = {"joints": joints, "hand": hand, "goal": goal[1], "goal_joints": goal[0]}
        task = self.task
        if task.sensor is not None:
            if looks is None:
                looks = Looks.none(task.sensor, len(joints))
                looks.add(np.arange(len(joints)), task.sensor, task.arm, joints, obstacles)
            for name, part in looks._asdict().items():
                parts[name] = part.reshape(len(joints), -1)
        else:
            parts["obstacles"] = observation_rows(obstacles, task.shapes).reshape(len(joints), -1)
        if command is not None and time is not None:
            parts |= {
                "command": command.position,
                "velocity": command.velocity,
                "acceleration": command.acceleration,
                "time_left": (task.time_limit - time)[:, None],
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
