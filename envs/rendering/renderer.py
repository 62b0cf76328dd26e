"""Renderer of the running episode of one environment."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from viapoint.envs.common.types import Float, Int
from viapoint.envs.common.validation import whole_number
from viapoint.envs.episodes import Episodes, Recorded
from viapoint.envs.rendering.gl import Canvas, GLUnavailableError, Window
from viapoint.envs.rendering.scene_view import Picture, SceneView
from viapoint.envs.task import Task

__all__ = ["RENDER_MODES", "EpisodeRenderer", "GLUnavailableError", "frame_steps", "picture_of"]

RENDER_MODES = ["human", "rgb_array", "rgb_array_list"]  # Values of `render_mode` besides None
STILL_SUPERSAMPLING = 2  # Supersampling of single pictures; frames of films have none, because it takes time
POINTS = 60  # Points along a planned path


def frame_steps(times: Float, fps: int) -> Int:
    """Return the states of a movement that the frames of its film show, evenly in time from start to end.

    For the times of T physics steps, [s], these are round(times[-1] fps) + 1 indices in [0, T], where 0 is the start.
    """
    count = round(float(times[-1]) * fps)
    return np.round(np.linspace(0, len(times), count + 1)).astype(np.int64)


class EpisodeRenderer:
    """Renderer of the running episode of one environment.

    The OpenGL context is opened with the first picture. `rgb_array` returns one picture, shape (height, width, 3): the
    end of the movement or, after a collision, the moment of first contact. `rgb_array_list` returns a film of the
    episode as a list of such pictures, and `human` plays it in a window. Before the movement there is one picture.
    """

    def __init__(
        self, episodes: Episodes, row: int, mode: str | None, width: int, height: int, fps: int
    ) -> None:
        if mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {mode!r}")
        self._episodes, self._row, self._mode, self._fps = episodes, row, mode, fps
        self._size = whole_number("width", width, 1), whole_number("height", height, 1)
        self._view: SceneView | None = None
        self._screen: Canvas | Window | None = None

    def render(self) -> Any:
        """Render the running episode so far."""
        recorded = self._episodes.recorded(self._row)
        rollout = recorded.rollout
        if len(rollout.time) == 1:
            picture = self._draw(recorded, 0)
            return {"human": None, "rgb_array_list": [picture]}.get(str(self._mode), picture)
        if self._mode == "rgb_array":
            touched = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
            return self._draw(recorded, touched)
        steps = frame_steps(rollout.time, self._fps)
        if self._mode == "human":
            return self._play(recorded, steps)
        return [self._draw(recorded, int(step)) for step in steps]

    def close(self) -> None:
        """Close window and OpenGL context; the next picture opens them again."""
        if self._screen is not None:
            self._screen.close()
        self._view = self._screen = None

    def _draw(self, recorded: Recorded, step: int) -> Any:
        """Return the picture of a step, or show it and return False after the window has been closed.

        The first picture opens the canvas or window.
        """
        if self._view is None or self._screen is None:
            view = SceneView(self._episodes.simulator.single(), *self._size)
            if self._mode == "human":
                self._screen = Window(view.model, *self._size, title="Viapoint")
            else:
                factor = STILL_SUPERSAMPLING if self._mode == "rgb_array" else 1
                self._screen = Canvas(view.model, *self._size, supersampling=factor)
            view.scene = self._screen.scene
            self._view = view
        self._view.write(picture_of(self._episodes.task, recorded, step))
        return self._screen.draw()

    def _play(self, recorded: Recorded, steps: Int) -> None:
        """Play the film in the window in real time; late frames are left out."""
        begin = time.monotonic()
        for number, step in enumerate(steps):
            late = time.monotonic() - begin - number / self._fps
            if late > 1.0 / self._fps and step != steps[-1]:
                continue
            if late < 0.0:
                time.sleep(-late)
            if not self._draw(recorded, int(step)):
                return


def picture_of(task: Task, recorded: Recorded, step: int) -> Picture:
    """Return what a picture of a physics step of an episode shows; step 0 is the start."""
    scene, history, rollout = recorded
    arm, space = task.arm, task.space
    now = np.array([step * arm.timestep])
    joints = np.concatenate((scene.start, rollout.joints))
    done = np.concatenate((arm.hand(scene.start), rollout.hand))[: step + 1]
    plans = [plan for began, plan in history if began <= now[0] + 1e-9]
    paths = []
    for plan in plans:
        position = plan.trajectory().sample(POINTS, 0)[0][0]
        paths.append(arm.hand(space.joints(np.asarray(position))))
    vias = arm.hand(space.joints(np.asarray(plans[-1].waypoints)[0, 1:-1])) if plans else np.zeros((0, 3))
    # The contact of a step is that of the state before it.
    contact = rollout.contact[: step + 1]
    return Picture(
        joints=joints[step],
        obstacles=scene.obstacles_at(now),
        ends=(arm.hand(scene.start)[0], arm.hand(scene.goals(now))[0]),
        planned=paths[-1] if paths else np.zeros((0, 3)),
        vias=vias,
        done=done,
        touched=int(contact.argmax()) if contact.any() else len(done),
        replaced=paths[:-1],
        seen=_seen(task, recorded, joints, now[0]),
    )


def _seen(task: Task, recorded: Recorded, joints: Float, now: float) -> Float:
    """Return the points that the sensor of a task has met in its last looks until a time, shape (M, 3)."""
    sensor = task.sensor
    if sensor is None:
        return np.zeros((0, 3))
    # Each plan began with a look.
    times = [0.0, *(began for began, _ in recorded.history if 0.0 < began <= now + 1e-9)]
    looks = np.array(times[-sensor.looks :])
    steps = np.minimum(np.round(looks / task.arm.timestep).astype(np.int64), len(joints) - 1)
    scenes = recorded.scene.take(np.zeros(len(looks), np.int64))
    readings = sensor.read(task.arm, joints[steps], scenes.obstacles_at(looks))
    return readings.points[readings.seen >= 0]
