"""What a robot knows while its plan is under way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from viapoint.envs.courses import FASTEST, ChangingScenes
from viapoint.envs.observation import FARTHEST, ObservationLayout
from viapoint.envs.revision import Default

Float = NDArray[np.float64]
Observation = dict[str, NDArray[np.float32]]

GREATEST_SPEED = 5.0
"""Bound of the commanded velocity along any axis, [m/s]."""
GREATEST_ACCELERATION = 100.0
"""Bound of the commanded acceleration along any axis, [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class OnlineObservationLayout(ObservationLayout):
    """The parts of a whole movement's observation, and what changes on the way; what lies in the future is hidden.

    `hand` [m], `velocity` [m/s] and `acceleration` [m/s^2] are what is commanded, `goal` and `obstacles` the present
    ones, `obstacle_velocities` n rows of D [m/s], flattened, `time_left` [s]; `via`, K rows of D [m], flattened, and
    `remaining` [s] are the plan that a zero action leads to. What exceeds its bounds is clipped.
    """

    n_via: int
    time_limit: float

    def space(self) -> spaces.Dict:
        """The observation space of one environment."""
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

    def online(self, joints: Float, scenes: ChangingScenes, default: Default, time: Float) -> Observation:
        """Observations of N environments, shape (N, .) each, in fresh arrays.

        Args:
            joints: Shape (N, J), [rad].
            scenes: N of them.
            default: What N hands do on a zero action.
            time: Since the start, shape (N,), [s].
        """
        now = scenes.at(time)
        d, number = self.dimension, len(time)
        now.obstacles[..., :d] = np.clip(now.obstacles[..., :d], -FARTHEST, FARTHEST)
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
