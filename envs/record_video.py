"""Recording of videos with all frames of each movement."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

EVERY_FRAME = "rgb_array_list"
"""Render mode that returns all frames of a movement."""


class RecordMovements(RecordVideo[Any, Any]):
    """Version of Gymnasium's `RecordVideo` that keeps every frame of a movement.

    `RecordVideo` takes one frame per step, so with `render_mode="rgb_array_list"` it keeps only the last frame of the
    list. This wrapper keeps all frames, whether a movement is one step or several. The arguments are those of
    `RecordVideo`; moviepy must be installed.

    Raises:
        ValueError: The environment's `render_mode` is not `rgb_array_list`.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarReach-v0", render_mode="rgb_array_list")
        >>> env = RecordMovements(env, "videos")  # doctest: +SKIP
    """

    recorded_frames: list[Any] = []  # noqa: RUF012 - Gymnasium reads it in `__del__`, also after an error in `__init__`

    def __init__(self, env: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> None:
        if env.render_mode != EVERY_FRAME:
            raise ValueError(
                f"RecordMovements records every frame of a movement and needs render_mode={EVERY_FRAME!r}, "
                f"got {env.render_mode!r}; Gymnasium's RecordVideo records one frame per step"
            )
        super().__init__(env, *args, **kwargs)
        self._shown = 0
        """Number of frames of the episode that are in the video."""

    def reset(self, **kwargs: Any) -> Any:
        """Reset the environment, and start a video if the episode is to be recorded."""
        self._shown = 0
        return super().reset(**kwargs)

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        self.recorded_frames.extend(frames[self._shown :])
        # Each step returns the frames from the beginning of the episode.
        self._shown = len(frames)
