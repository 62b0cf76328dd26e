"""Drawing movements."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from viapoint.envs._gl import Canvas, GLUnavailableError, Window
from viapoint.envs._movement import Movement
from viapoint.envs._stage import Stage
from viapoint.envs.action import Plan
from viapoint.envs.execution import Rollout
from viapoint.envs.scenes import Scenes
from viapoint.envs.simulator import Simulator

__all__ = ["GLUnavailableError", "MovementRenderer", "check_render_mode", "frame_steps"]

Frame = NDArray[np.uint8]

STILL_SUPERSAMPLING = 2
"""How many times larger a single picture is rendered than it is shown; the frames of a film are not."""


def check_render_mode(mode: str | None, known: Sequence[str]) -> str | None:
    """A render mode that there is."""
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode must be None or one of {', '.join(known)}, got {mode!r}")
    return mode


def frame_steps(time: NDArray[np.float64], fps: int) -> NDArray[np.int64]:
    """Which states of a movement the frames of its film show: from the start to the end, evenly in time.

    Args:
        time: Of the physics steps, shape (T,), [s], evenly spaced, the first one step after the start.
        fps: Frames per second.

    Returns:
        Shape (F,): F = round(time[-1] fps) + 1 indices in [0, T], where 0 is the start.
    """
    count = round(float(time[-1]) * fps)
    return np.round(np.linspace(0, len(time), count + 1)).astype(np.int64)


class MovementRenderer:
    """Draws what happened in one simulation.

    Nothing is opened before the first picture. `rgb_array` gives one picture of shape (height, width, 3): the
    end of a movement or, where the arm hit something, the moment of first contact, which tells more. From
    `rgb_array_list` comes the film of the movement as a list of such pictures, `human` plays it in a window.
    """

    stage_kind: ClassVar[type[Stage]] = Stage

    def __init__(self, simulator: Simulator, mode: str | None, width: int, height: int, fps: int) -> None:
        for name, size in (("width", width), ("height", height)):
            if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
                raise ValueError(f"{name} must be a whole number of pixels, 1 or more, got {size!r}")
        self._simulator = simulator
        self.mode = mode
        self._size = int(width), int(height)
        self._fps = fps
        self._stage: Stage | None = None
        self._canvas: Canvas | None = None
        self._window: Window | None = None

    def still(self, sim: int, scene: Scenes) -> Any:
        """The scene before the movement."""
        stage = self._ready()
        stage.set(scene, self._simulator.arm.posture(scene.start)[0])
        return self._shown(stage)

    def movement(self, sim: int, scene: Scenes, plan: Plan, rollout: Rollout) -> Any:
        """The movement."""
        stage = self._ready()
        movement = Movement.of(stage.arm, scene, plan, rollout, whole_arm=stage.whole_arm)
        steps = frame_steps(rollout.time, self._fps)
        if self.mode == "human":
            return self._play(stage, scene, movement, steps)
        if self.mode == "rgb_array":
            step = len(rollout.time) if movement.touch is None else movement.touch.step
            stage.set(scene, movement.joints[step], movement, step)
            return self._shown(stage)
        return [self._frame(stage, scene, movement, step) for step in steps]

    def close(self) -> None:
        """Let windows and contexts go; the next picture opens them again."""
        for screen in (self._canvas, self._window):
            if screen is not None:
                screen.close()
        self._stage = self._canvas = self._window = None

    def _ready(self) -> Stage:
        """The stage, with a canvas or a window to show it on."""
        if self._stage is None:
            stage = self.stage_kind(self._simulator, *self._size)
            if self.mode == "human":
                self._window = Window(stage.model, *self._size, title="Viapoint")
            else:
                factor = STILL_SUPERSAMPLING if self.mode == "rgb_array" else 1
                self._canvas = Canvas(stage.model, *self._size, supersampling=factor)
            self._stage = stage
        return self._stage

    def _shown(self, stage: Stage) -> Any:
        """What is on the stage, as the mode says."""
        if self._window is not None:
            self._window.show(stage.scene)
            return None
        assert self._canvas is not None
        frame = self._canvas.draw(stage.scene)
        return [frame] if self.mode == "rgb_array_list" else frame

    def _frame(self, stage: Stage, scene: Scenes, movement: Movement, step: int) -> Frame:
        assert self._canvas is not None
        stage.set(scene, movement.joints[step], movement, step)
        return self._canvas.draw(stage.scene)

    def _play(self, stage: Stage, scene: Scenes, movement: Movement, steps: NDArray[np.int64]) -> None:
        """Play the film in the window in real time; frames that come too late are left out."""
        assert self._window is not None
        begin = time.monotonic()
        for number, step in enumerate(steps):
            late = time.monotonic() - begin - number / self._fps
            if late > 1.0 / self._fps and step != steps[-1]:
                continue
            if late < 0.0:
                time.sleep(-late)
            stage.set(scene, movement.joints[step], movement, step)
            if not self._window.show(stage.scene):
                return
