"""Recording videos of whole movements with Gymnasium."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

from viapoint.envs.multi_step import ManyStepEnv

EVERY_FRAME = "rgb_array_list"
"""The render mode with all frames of a movement."""


class RecordMovements(RecordVideo[Any, Any]):
    """Gymnasium's `RecordVideo` with every frame of a movement.

    `RecordVideo` takes one picture of each step, so with `render_mode="rgb_array_list"` it keeps only the
    last frame of the list, unless `render()` is called after `step()`. Here all frames of the movement are kept,
    whether it is one step or several. The arguments are those of `RecordVideo`; moviepy must be installed.

    Raises:
        ValueError: The environment's `render_mode` is another than `rgb_array_list`.

    >>> import gymnasium as gym
    >>> env = gym.make("viapoint.envs:viapoint/PlanarReach-v0", render_mode="rgb_array_list")
    >>> env = RecordMovements(env, "videos")  # doctest: +SKIP
    """

    recorded_frames: list[Any] = []  # noqa: RUF012 - Gymnasium asks for it when one that was refused is deleted

    def __init__(self, env: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> None:
        if env.render_mode != EVERY_FRAME:
            raise ValueError(
                f"RecordMovements films every frame of a movement and needs render_mode={EVERY_FRAME!r}, "
                f"got {env.render_mode!r}; RecordVideo of Gymnasium keeps one frame of each step"
            )
        super().__init__(env, *args, **kwargs)
        self._shown = 0
        """How many frames of the episode are in the video."""

    def reset(self, **kwargs: Any) -> Any:
        """Reset the environment and, where an episode is recorded, begin a video."""
        self._shown = 0
        return super().reset(**kwargs)

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        self.recorded_frames.extend(frames[self._shown :])
        if isinstance(
            self.env.unwrapped, ManyStepEnv
        ):  # there every step shows the episode from its beginning
            self._shown = len(frames)
