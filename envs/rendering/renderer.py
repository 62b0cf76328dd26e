"""Renderers of movements and of episodes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from viapoint.envs.actions.replanning import MovingPlan
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import in_space
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float, Int
from viapoint.envs.common.validation import whole_number
from viapoint.envs.rendering.gl import Canvas, GLUnavailableError, Window
from viapoint.envs.rendering.overlay import Movement
from viapoint.envs.rendering.scene_view import SPACING, SceneView
from viapoint.envs.rendering.shapes import ShapeWriter, resampled
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.sim.simulator import Simulator

__all__ = ["GLUnavailableError", "MovementRenderer", "check_render_mode", "frame_steps"]


STILL_SUPERSAMPLING = 2
"""Supersampling of single pictures; frames of films have none, because it takes time."""


def check_render_mode(mode: str | None, known: Sequence[str]) -> str | None:
    """Return a render mode after checking that it is None or known."""
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode must be None or one of {', '.join(known)}, got {mode!r}")
    return mode


def frame_steps(time: Float, fps: int) -> Int:
    """Return the states of a movement that the frames of its film show, evenly in time from start to end.

    Args:
        time: Times of the physics steps, shape (T,), [s], evenly spaced, the first one step after the start.
        fps: Frames per second.

    Returns:
        Indices in [0, T], where 0 is the start, shape (F,), F = round(time[-1] fps) + 1.
    """
    count = round(float(time[-1]) * fps)
    return np.round(np.linspace(0, len(time), count + 1)).astype(np.int64)


class MovementRenderer:
    """Renderer of the movement of one simulation.

    The OpenGL context is opened with the first picture. `rgb_array` returns one picture, shape (height, width, 3): the
    end of the movement or, after a collision, the moment of first contact. `rgb_array_list` returns a film of the
    movement as a list of such pictures, and `human` plays it in a window.
    """

    view_class: ClassVar[type[SceneView]] = SceneView

    def __init__(self, simulator: Simulator, mode: str | None, width: int, height: int, fps: int) -> None:
        self._simulator = simulator
        self.mode = mode
        self._size = whole_number("width", width, 1), whole_number("height", height, 1)
        self._fps = fps
        self._view: SceneView | None = None
        self._canvas: Canvas | None = None
        self._window: Window | None = None

    def still(self, scene: Scenes) -> Any:
        """Render the scene before the movement."""
        picture = self._draw(scene, self._simulator.arm.inverse_kinematics(scene.start)[0])
        return {"human": None, "rgb_array_list": [picture]}.get(str(self.mode), picture)

    def movement(self, scene: Scenes, plan: Plan, rollout: Rollout) -> Any:
        """Render a movement."""
        movement = Movement.of(self._simulator.collision_model, scene, plan, rollout)
        if self.mode == "rgb_array":
            step = len(rollout.time) if movement.contact is None else movement.contact.step
            return self._draw(scene, movement.joints[step], movement, step)
        steps = frame_steps(rollout.time, self._fps)
        if self.mode == "human":
            return self._play(scene, movement, steps)
        return [self._draw(scene, movement.joints[step], movement, step) for step in steps]

    def close(self) -> None:
        """Close window and OpenGL context; the next picture opens them again."""
        for screen in (self._canvas, self._window):
            if screen is not None:
                screen.close()
        self._view = self._canvas = self._window = None

    def _ready(self) -> SceneView:
        """Return the scene view, after opening a canvas or a window for it."""
        if self._view is None:
            view = self.view_class(self._simulator, *self._size)
            if self.mode == "human":
                self._window = Window(view.model, *self._size, title="Viapoint")
            else:
                factor = STILL_SUPERSAMPLING if self.mode == "rgb_array" else 1
                self._canvas = Canvas(view.model, *self._size, supersampling=factor)
            self._view = view
        return self._view

    def _draw(self, scene: Scenes, joints: Float, movement: Movement | None = None, step: int = 0) -> Any:
        """Return a picture, or show it in the window and return False after the window has been closed."""
        view = self._ready()
        view.set(scene, joints, movement, step)
        screen = self._window or self._canvas
        assert screen is not None
        return screen.show(view.scene) if isinstance(screen, Window) else screen.draw(view.scene)

    def _play(self, scene: Scenes, movement: Movement, steps: Int) -> None:
        """Play the film in the window in real time; late frames are left out."""
        begin = time.monotonic()
        for number, step in enumerate(steps):
            late = time.monotonic() - begin - number / self._fps
            if late > 1.0 / self._fps and step != steps[-1]:
                continue
            if late < 0.0:
                time.sleep(-late)
            if not self._draw(scene, movement.joints[step], movement, step):
                return


History = list[tuple[float, MovingPlan]]
"""Plans of an episode and the times at which they began, [s]."""

FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]
"""Colour of a replaced plan."""
FADED_RADIUS = 0.0045
"""Radius of the path of a replaced plan, [m]."""
POINTS = 60
"""Points along a planned path."""


class ReplanningSceneView(SceneView):
    """Scene view that shows moving obstacles and replaced plans at the time of a frame."""

    changing: ChangingScenes | None = None
    """Scene with its changes over time."""
    history: History
    """Plans and the times at which they began, [s]."""

    def set(self, scene: Scenes, joints: Float, movement: Movement | None = None, step: int = 0) -> Any:
        """Set up the scene as :meth:`SceneView.set` does, with obstacles and plans of the step's time."""
        if movement is None or self.changing is None:
            return super().set(scene, joints, movement, step)
        time = step * float(self.model.opt.timestep)
        begun = [plan for began, plan in self.history if began <= time + 1e-9] or [self.history[0][1]]
        current = begun[-1]
        movement = movement._replace(planned=_path(current), vias=current.waypoints[0, 1:-1])
        super().set(self.changing.at(np.array([time])), joints, movement, step)
        shapes = ShapeWriter(self.scene)
        for plan in begun[:-1]:
            shapes.line(in_space(resampled(_path(plan), SPACING), self._floor + 0.001), FADED_RADIUS, FADED)
        return self.scene


class EpisodeRenderer(MovementRenderer):
    """Renderer of an episode of several decisions."""

    view_class = ReplanningSceneView

    def episode(self, changing: ChangingScenes, history: History, rollout: Rollout) -> Any:
        """Render the episode so far."""
        view = self._ready()
        assert isinstance(view, ReplanningSceneView)
        view.changing, view.history = changing, history
        touched = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
        scene = changing.at(np.array([touched * float(view.model.opt.timestep)]))
        return self.movement(scene, history[-1][1].plan, rollout)


def _path(plan: MovingPlan) -> Float:
    """Return the path of a plan, shape (POINTS, D), [m]."""
    return np.asarray(plan.trajectory().sample(POINTS, 0)[0][0])
