"""Renderers of movements and of episodes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.replanning import MovingPlan
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float, Frame
from viapoint.envs.rendering.gl import Canvas, GLUnavailableError, Window
from viapoint.envs.rendering.overlay import Movement
from viapoint.envs.rendering.scene_view import SPACING, Stage
from viapoint.envs.rendering.shapes import Pencil, in_space, resampled
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import Rollout
from viapoint.envs.sim.simulator import Simulator

__all__ = ["GLUnavailableError", "MovementRenderer", "check_render_mode", "frame_steps"]


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
        stage.set(scene, self._simulator.arm.inverse_kinematics(scene.start)[0])
        return self._shown(stage)

    def movement(self, sim: int, scene: Scenes, plan: Plan, rollout: Rollout) -> Any:
        """The movement."""
        stage = self._ready()
        movement = Movement.of(self._simulator.collision_model, scene, plan, rollout)
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


History = list[tuple[float, MovingPlan]]

FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]
"""Of a plan that was given up."""
GIVEN_UP = 0.0045
"""Radius of its path, [m]."""
POINTS = 60
"""Along a planned path."""


class ChangingStage(Stage):
    """Shows everything where it was at the time of a frame."""

    changing: ChangingScenes | None = None
    """One scene and what became of it."""
    history: History
    """Its plans and when they began, [s]."""

    def set(self, scene: Scenes, joints: Float, movement: Movement | None = None, step: int = 0) -> Any:
        """See :meth:`Stage.set`; of a movement, scene and plan are those of the time of the step."""
        if movement is None or self.changing is None:
            return super().set(scene, joints, movement, step)
        time = step * float(self.model.opt.timestep)
        begun = [plan for began, plan in self.history if began <= time + 1e-9] or [self.history[0][1]]
        current = begun[-1]
        movement = movement._replace(planned=_path(current), vias=current.waypoints[0, 1:-1])
        super().set(self.changing.at(np.array([time])), joints, movement, step)
        pencil = Pencil(self.scene)
        for plan in begun[:-1]:
            pencil.line(in_space(resampled(_path(plan), SPACING), self._floor + 0.001), GIVEN_UP, FADED)
        return self.scene


class EpisodeRenderer(MovementRenderer):
    """Draws what happened in one simulation in the course of its decisions."""

    stage_kind = ChangingStage

    def episode(self, sim: int, changing: ChangingScenes, history: History, rollout: Rollout) -> Any:
        """The episode so far."""
        stage = self._ready()
        assert isinstance(stage, ChangingStage)
        stage.changing, stage.history = changing, history
        touched = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
        scene = changing.at(np.array([touched * float(stage.model.opt.timestep)]))
        return self.movement(sim, scene, history[-1][1].plan, rollout)


def _path(plan: MovingPlan) -> Float:
    """Of one plan, shape (POINTS, D), [m]."""
    return np.asarray(plan.trajectory().sample(POINTS, 0)[0][0])
