"""Renderer of movements and of episodes of several plans."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from viapoint.envs.actions.replanning import MovingPlan
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.types import Float, Int
from viapoint.envs.common.validation import whole_number
from viapoint.envs.rendering.gl import Canvas, GLUnavailableError, Window
from viapoint.envs.rendering.overlay import FirstContact, Movement
from viapoint.envs.rendering.scene_view import SceneView
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.sim.simulator import Simulator

__all__ = ["GLUnavailableError", "MovementRenderer", "frame_steps"]

RENDER_MODES = ["human", "rgb_array", "rgb_array_list"]
"""Values of `render_mode` besides None."""
STILL_SUPERSAMPLING = 2
"""Supersampling of single pictures; frames of films have none, because it takes time."""


def frame_steps(time: Float, fps: int) -> Int:
    """Return the states of a movement that the frames of its film show, evenly in time from start to end.

    For the times of T physics steps, [s], these are round(time[-1] fps) + 1 indices in [0, T], where 0 is the start.
    """
    count = round(float(time[-1]) * fps)
    return np.round(np.linspace(0, len(time), count + 1)).astype(np.int64)


History = list[tuple[float, MovingPlan]]
"""Plans of an episode and the times at which they began, [s]."""
POINTS = 60
"""Points along a planned path of an episode."""
Moment = tuple[Scenes, Movement, Sequence[Float]]
"""Scene, movement, and paths of replaced plans at one time of a movement."""


class MovementRenderer:
    """Renderer of the movement of one simulation.

    The OpenGL context is opened with the first picture. `rgb_array` returns one picture, shape (height, width, 3): the
    end of the movement or, after a collision, the moment of first contact. `rgb_array_list` returns a film of the
    movement as a list of such pictures, and `human` plays it in a window.
    """

    def __init__(self, simulator: Simulator, mode: str | None, width: int, height: int, fps: int) -> None:
        if mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {mode!r}")
        self._simulator = simulator
        self.mode = mode
        self._size = whole_number("width", width, 1), whole_number("height", height, 1)
        self._fps = fps
        self._view: SceneView | None = None
        self._screen: Canvas | Window | None = None

    def still(self, scene: Scenes) -> Any:
        """Render the scene before the movement."""
        picture = self._draw(scene, None, (), 0)
        return {"human": None, "rgb_array_list": [picture]}.get(str(self.mode), picture)

    def movement(self, scene: Scenes, plan: Plan, rollout: Rollout) -> Any:
        """Render a movement."""
        movement = Movement.of(self._simulator.collision_model, scene, plan, rollout)
        return self._film(movement.contact, lambda step: (scene, movement, ()), rollout.time)

    def episode(self, changing: ChangingScenes, history: History, rollout: Rollout) -> Any:
        """Render an episode so far, with the obstacles and plans of the time of each frame."""
        timestep = self._simulator.timestep
        touched = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
        scene, plan = changing.at(np.array([touched * timestep])), history[-1][1].plan
        movement = Movement.of(self._simulator.collision_model, scene, plan, rollout)

        def at(step: int) -> Moment:
            begun = [plan for began, plan in history if began <= step * timestep + 1e-9] or [history[0][1]]
            *replaced, path = (np.asarray(plan.trajectory().sample(POINTS, 0)[0][0]) for plan in begun)
            shown = movement._replace(planned=path, vias=begun[-1].waypoints[0, 1:-1])
            return changing.at(np.array([step * timestep])), shown, replaced

        return self._film(movement.contact, at, rollout.time)

    def _film(self, contact: FirstContact | None, at: Callable[[int], Moment], times: Float) -> Any:
        """Render the moments of a movement that the render mode shows."""
        if self.mode == "rgb_array":
            step = len(times) if contact is None else contact.step
            return self._draw(*at(step), step)
        steps = frame_steps(times, self._fps)
        if self.mode == "human":
            return self._play(at, steps)
        return [self._draw(*at(step), step) for step in steps]

    def close(self) -> None:
        """Close window and OpenGL context; the next picture opens them again."""
        if self._screen is not None:
            self._screen.close()
        self._view = self._screen = None

    def _open(self) -> tuple[SceneView, Canvas | Window]:
        """Return the scene view, and the canvas or window for it, which the first picture opens."""
        if self._view is None or self._screen is None:
            view = SceneView(self._simulator, *self._size)
            if self.mode == "human":
                self._screen = Window(view.model, *self._size, title="Viapoint")
            else:
                factor = STILL_SUPERSAMPLING if self.mode == "rgb_array" else 1
                self._screen = Canvas(view.model, *self._size, supersampling=factor)
            view.scene = self._screen.scene
            self._view = view
        return self._view, self._screen

    def _draw(self, scene: Scenes, movement: Movement | None, replaced: Sequence[Float], step: int) -> Any:
        """Return a picture, or show it in the window and return False after the window has been closed."""
        view, screen = self._open()
        still = self._simulator.arm.inverse_kinematics(scene.start) if movement is None else movement.joints
        view.set(scene, still[step], movement, step, replaced)
        return screen.draw()

    def _play(self, at: Callable[[int], Moment], steps: Int) -> None:
        """Play the film in the window in real time; late frames are left out."""
        begin = time.monotonic()
        for number, step in enumerate(steps):
            late = time.monotonic() - begin - number / self._fps
            if late > 1.0 / self._fps and step != steps[-1]:
                continue
            if late < 0.0:
                time.sleep(-late)
            if not self._draw(*at(step), step):
                return
