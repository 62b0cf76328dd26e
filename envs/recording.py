"""Recording videos of whole movements with Gymnasium."""

from __future__ import annotations

from typing import Any

from gymnasium.wrappers import RecordVideo


class RecordMovements(RecordVideo[Any, Any]):
    """Gymnasium's `RecordVideo` with every frame of a movement.

    `RecordVideo` takes one picture of each step, so with `render_mode="rgb_array_list"` it keeps only the
    last frame of the list, unless `render()` is called after `step()`. Here one step is a whole movement, and
    all frames of it are kept. The arguments are those of `RecordVideo`; moviepy must be installed.

    >>> import gymnasium as gym
    >>> env = gym.make("viapoint.envs:viapoint/PlanarReach-v0", render_mode="rgb_array_list")
    >>> env = RecordMovements(env, "videos")  # doctest: +SKIP
    """

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        if not isinstance(frames, list):
            frames = [frames]
        self.recorded_frames.extend(frames)
