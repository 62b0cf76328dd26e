"""Pictures of the running episode of one environment: arm and obstacles as MuJoCo draws them, and paths over them.

Pictures are rendered in memory, which needs no display, or in a window on the screen. OpenGL is loaded with the first
picture.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import itertools
import os
import sys
import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from viapoint.envs.common.arrays import Float, Frame, Int, norm
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.validation import whole_number
from viapoint.envs.episodes import Episodes, Recorded
from viapoint.envs.geometry.obstacles import Obstacles, bounding_boxes
from viapoint.envs.simulator import Simulator
from viapoint.envs.task import Task

MAX_SIDE = 8192  # Longest side of a supersampled picture, in pixels; OpenGL may not support larger ones
MAX_GEOMS = 2000  # Greatest number of shapes in a scene
INSTALL = "on Debian and Ubuntu: apt-get install libegl1 libgl1"
RENDER_MODES = ["human", "rgb_array", "rgb_array_list"]  # Values of `render_mode` besides None
STILL_SUPERSAMPLING = 2  # Supersampling of single pictures; frames of films have none, because it takes time
POINTS = 60  # Points along a planned path
Geom = mujoco.mjtGeom
MATT, GLOWING = 0.0, 1.0  # Emission relative to the colour: lines glow, bodies are lit
CAMERA = "view"
# Types of geoms that have a smaller copy inside
SOLID = (Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE, Geom.mjGEOM_CYLINDER, Geom.mjGEOM_BOX)
# Radii of the planned, the executed and a replaced path, [m]; the planned one shows as a rim of the executed
PLAN, DONE, REPLACED = 0.0065, 0.0030, 0.0045
SPACING = 0.02  # Distance of the points of a drawn path, [m]
# Radius of the points that a sensor has met, twice as much in space, [m], and how many of them are drawn at most
SEEN, MOST_SEEN = 0.004, 600
RAY = 0.0008  # Radius of the rays that end there, [m]
MOST_RAYS = 96  # How many of them are drawn at most
RAY_OPACITY = 0.35
# Half lengths of the board that stands for a half-space, [m], and its opacity
HALF_SPACE_BOARD, GLASSY = (1.0, 1.0, 0.002), 0.4
BELOW_SURFACE = 0.008  # Depth of this board, [m]: a floor at the height of the table is hidden by it
# Depth below its surface from which a body casts its shadow, [m]. The map of shadows has pixels of 1.2 mm; a surface
# that cast the shadow itself would be speckled.
SHADOW_DEPTH = 0.004
ABOVE_TABLE = 0.001  # Height of paths of the plane above the table, [m]
# Colour of a replaced plan
FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]


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
        if mode is not None and not (isinstance(mode, str) and mode in RENDER_MODES):
            raise ValueError(f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {mode!r}")
        self._episodes, self._row, self._mode, self._fps = episodes, row, mode, fps
        self._size = whole_number("width", width, 1), whole_number("height", height, 1)
        self._view: SceneView | None = None
        self._screen: Canvas | Window | None = None

    def render(self) -> Any:
        """Render the running episode so far."""
        recorded = self._episodes.recorded(self._row)
        rollout = recorded.rollout
        still = len(rollout.time) == 1
        if self._mode == "rgb_array":
            last = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
            return self._draw(recorded, 0 if still else last)
        steps = np.zeros(1, np.int64) if still else frame_steps(rollout.time, self._fps)
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
                self._screen = Window(view.model, *self._size)
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
    """Return the rays of a sensor that met something in its last looks until a time, shape (M, 2, 3)."""
    sensor = task.sensor
    if sensor is None:
        return np.zeros((0, 2, 3))
    # Each plan began with a look.
    times = [0.0, *(began for began, _ in recorded.history if 0.0 < began <= now + 1e-9)]
    looks = np.array(times[-sensor.looks :])
    steps = np.minimum(np.round(looks / task.arm.timestep).astype(np.int64), len(joints) - 1)
    scenes = recorded.scene.take(np.zeros(len(looks), np.int64))
    readings = sensor.read(task.arm, joints[steps], scenes.obstacles_at(looks))
    eyes = np.broadcast_to(readings.eye[:, None], readings.points.shape)
    return np.stack((eyes, readings.points), axis=2)[readings.seen >= 0]


class Picture(NamedTuple):
    """Arm, obstacles and paths of one picture."""

    joints: Float  # Joint positions, shape (J,), [rad]
    obstacles: Obstacles  # Obstacles at their present places, of one scene
    ends: tuple[Float, Float]  # Hand positions at start and goal, shape (3,) each, [m]
    planned: Float  # Planned path of the hand, shape (n, 3), [m]; empty for none
    vias: Float  # Via-points of the hand, shape (K, 3), [m]
    done: Float  # Executed path of the hand so far, shape (T, 3), [m]
    touched: int  # Index into the executed path of the first contact; its length without contact
    replaced: Sequence[Float]  # Paths of plans that were replaced, shape (n, 3) each, [m]
    seen: Float  # Rays of a sensor from its eye to what they met, shape (M, 2, 3), [m]


def _some(rays: Float, most: int) -> Float:
    """Return up to so many of the rays, evenly spread."""
    return rays[:: -(-len(rays) // most) or 1]


class SceneView:
    """Writer of MuJoCo scenes with the arm, its surroundings and a movement, for pictures of a size in pixels.

    It uses a simulator of one simulation alone.
    """

    scene: mujoco.MjvScene  # Scene to write, which belongs to the screen that shows it

    def __init__(self, simulator: Simulator, width: int, height: int) -> None:
        self._simulator = simulator
        self.model = simulator.model
        self._data = mujoco.MjData(self.model)
        self._option = mujoco.MjvOption()
        self._flat = simulator.arm.space == "hand"
        self._floor = float(self.model.geom("table").pos[2])
        self._hand = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, "hand")  # -1 without one
        camera = self.model.camera(CAMERA).id
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        if width < height:  # a wider field of view keeps the whole workspace in upright pictures
            field = self.model.cam_fovy[camera]  # an angle, or a length without perspective
            if self.model.cam_projection[camera] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
                self.model.cam_fovy[camera] = field * height / width
            else:
                half = np.tan(np.radians(field) / 2.0)
                self.model.cam_fovy[camera] = 2.0 * np.degrees(np.arctan(half * height / width))

    def write(self, picture: Picture) -> None:
        """Set up one picture."""
        self._pose(picture)
        self._draw_ends(picture)
        for path in picture.replaced:
            self._add_line(self._lowered(path), REPLACED, FADED)
        if len(picture.planned):
            self._add_line(self._lowered(picture.planned), PLAN, PALETTE.plan)
        for via in self._lowered(picture.vias):
            self._add_ball(via, 0.011, PALETTE.via)
        rays = picture.seen.copy()
        if self._flat and len(rays):  # on top of the obstacles, whose sides the camera hardly sees
            centre, half = bounding_boxes(picture.obstacles)
            rays[..., 2] = (centre + half)[0, picture.obstacles.present[0], 2].max()
        for _, point in _some(rays, MOST_SEEN):
            self._add_ball(point, SEEN if self._flat else 2.0 * SEEN, PALETTE.seen)
        for eye, point in _some(rays, MOST_RAYS):
            self._add_tube(eye, point, RAY, PALETTE.seen, RAY_OPACITY)
        free = picture.touched
        done = self._lowered(picture.done)
        for part, colour in ((done[: free + 1], PALETTE.executed), (done[free:], PALETTE.contact)):
            if len(part) > 1:
                self._add_line(part + np.array([0.0, 0.0, PLAN]), DONE, colour)

    def _pose(self, picture: Picture) -> None:
        """Start the scene with the arm in a configuration among the obstacles; geoms in contact are red."""
        model, data = self.model, self._data
        self._simulator.place(np.zeros(1, np.int64), picture.joints[None], picture.obstacles)
        self._simulator.copy_obstacles(0, model, data, picture.obstacles.centre[0])
        data.qpos[: len(picture.joints)] = picture.joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self.scene)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True  # the floor in space fades away
        table = model.geom("table").id
        for geom in self._shown({table}):
            geom.castshadow = False  # there is nothing below it, and its own surface would be speckled
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.type == Geom.mjGEOM_PLANE and geom.objid != table:
                # MuJoCo draws the planes that the model was compiled with, and others as something else.
                geom.type, geom.dataid, geom.size = Geom.mjGEOM_BOX, -1, HALF_SPACE_BOARD
                geom.pos = geom.pos - BELOW_SURFACE * geom.mat[:, 2]
                geom.rgba[3], geom.transparent = GLASSY, True
                geom.castshadow = False
        if not self._flat:  # from above nothing is speckled
            for geom in self._shown({self._hand}):
                geom.size = 1.1 * geom.size  # its surface and that of the finger would be in one place
            self._add_shadows()
        if picture.touched < len(picture.done):
            mujoco.mj_collision(model, data)
            pairs = data.contact.geom[: data.ncon].ravel()
            for geom in self._shown({int(each) for each in pairs}):
                geom.rgba = np.array((*PALETTE.contact, 1.0), dtype=np.float32)

    def _add_shadows(self) -> None:
        """Add smaller bodies, inside those that are shown, which cast the shadows in their place."""
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.castshadow and geom.type in SOLID:
                inner = self._add(geom.type, (1.0,) * 3, geom.pos, PALETTE.joint, MATT)
                inner.mat = geom.mat
                inner.size = np.maximum(geom.size - SHADOW_DEPTH, 0.2 * geom.size)
                geom.castshadow = False

    def _shown(self, numbers: set[int]) -> list[Any]:
        """Return the scene's geoms that show some geoms of the model."""
        geoms = self.scene.geoms[: self.scene.ngeom]
        return [g for g in geoms if g.objtype == mujoco.mjtObj.mjOBJ_GEOM and g.objid in numbers]

    def _lowered(self, points: Float) -> Float:
        """Return points on the table for arms in the plane, where obstacles would hide them, else as they are."""
        if not self._flat:
            return points
        flat = points.copy()
        flat[..., 2] = self._floor + ABOVE_TABLE
        return flat

    def _draw_ends(self, picture: Picture) -> None:
        """Draw start and goal."""
        start, goal = (self._lowered(end) for end in picture.ends)
        if not self._flat:
            self._add_ball(goal, 0.018, PALETTE.goal)
            self._add_ball(start, 0.010, PALETTE.start)
            return
        rings = (start, 0.021, 0.017, PALETTE.start), (goal, 0.031, 0.026, PALETTE.goal)
        for centre, radius, inner, colour in rings:  # two discs are far cheaper than a tube
            self._add_disc(centre, radius, 0.001, colour, GLOWING)
            self._add_disc(centre, inner, 0.002, PALETTE.table)
        self._add_disc(goal, 0.018, 0.003, PALETTE.goal, GLOWING)

    def _add_ball(self, centre: Float, radius: float, colour: Colour) -> None:
        """Add a sphere at `centre`, shape (3,), [m], without a shadow."""
        self._add(Geom.mjGEOM_SPHERE, (radius,) * 3, centre, colour, GLOWING).castshadow = False

    def _add_disc(
        self, centre: Float, radius: float, height: float, colour: Colour, glow: float = MATT
    ) -> None:
        """Add a flat cylinder that stands on `centre`, shape (3,), [m]."""
        middle = centre + np.array([0.0, 0.0, height / 2.0])
        self._add(Geom.mjGEOM_CYLINDER, (radius, height / 2.0, 0.0), middle, colour, glow)

    def _add_line(self, points: Float, radius: float, colour: Colour) -> None:
        """Add a tube along a polyline, shape (n, 3), [m], without a shadow."""
        length = np.concatenate(([0.0], np.cumsum(norm(np.diff(points, axis=0)))))
        count = max(int(np.ceil(length[-1] / SPACING)), 1) + 1
        places = np.linspace(0.0, length[-1], count)
        even = np.stack([np.interp(places, length, column) for column in points.T], axis=-1)
        for first, second in itertools.pairwise(even):
            self._add_tube(first, second, radius, colour)

    def _add_tube(
        self, first: Float, second: Float, radius: float, colour: Colour, opacity: float = 1.0
    ) -> None:
        """Add a tube from one point to another, shape (3,), [m], without a shadow."""
        geom = self._add(Geom.mjGEOM_CAPSULE, (radius,) * 3, first, colour, GLOWING)
        mujoco.mjv_connector(geom, Geom.mjGEOM_CAPSULE, radius, first, second)
        geom.rgba[3], geom.transparent = opacity, opacity < 1.0
        geom.castshadow = False

    def _add(self, kind: int, size: Any, centre: Float, colour: Colour, glow: float) -> Any:
        """Add a MuJoCo geom of a size, [m], and return it; where the scene is full, one that is not shown."""
        scene = self.scene
        geom = scene.geoms[scene.ngeom] if scene.ngeom < scene.maxgeom else mujoco.MjvGeom()
        lit = np.array((*(c / (1.0 + glow) for c in colour), 1.0), dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size), centre, np.eye(3).flatten(), lit)
        geom.emission, geom.specular, geom.shininess = glow, 0.15, 0.3
        scene.ngeom = min(scene.ngeom + 1, scene.maxgeom)
        return geom


class GLUnavailableError(gym.error.DependencyNotInstalled):
    """No picture can be rendered on this machine; the message says what to install."""


class Canvas:
    """Offscreen renderer of pictures of one size."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, supersampling: int = 1) -> None:
        """Open a renderer for pictures of a size in pixels, independent of the model's own offscreen size.

        Pictures are rendered larger by the factor `supersampling`, and then averaged: the samples per pixel of the
        model smooth the edges of bodies, but not those of shadows.

        Raises:
            GLUnavailableError: No OpenGL library can be used.
            ValueError: The picture is too large for OpenGL.
        """
        self._factor = supersampling if supersampling * max(width, height) <= MAX_SIDE else 1
        columns, rows = self._factor * width, self._factor * height
        model.vis.global_.offwidth, model.vis.global_.offheight = columns, rows
        _import_triton()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW warns before the exception with the same message
                self._context = _gl_context()
        except Exception as error:  # platforms raise errors of many kinds, among them MuJoCo's FatalError
            platform = os.environ.get("MUJOCO_GL", "not set")
            raise GLUnavailableError(
                f"no picture can be rendered ({error}). Install OpenGL ({INSTALL}), or choose a library that is there "
                f"by starting Python with MUJOCO_GL=egl, osmesa or glfw; MUJOCO_GL is {platform}"
            ) from error
        try:
            with self._context.as_current():
                self._renderer = mujoco.Renderer(model, rows, columns, MAX_GEOMS)
        except Exception as error:
            self._context.free()
            raise ValueError(
                f"a picture of {width} x {height} pixels cannot be rendered here ({error}); take a smaller one"
            ) from error

    @property
    def scene(self) -> mujoco.MjvScene:
        """Scene that is rendered."""
        return self._renderer.scene

    def draw(self) -> Frame:
        """Render the scene to a picture, shape (height, width, 3)."""
        # MuJoCo's renderer leaves its context current, and then no other thread could render or close. Here, what was
        # current before becomes current again.
        with self._context.as_current():
            pixels: Frame = self._renderer.render()
        rows, columns = pixels.shape[:2]
        factor = self._factor
        parts = pixels.reshape(rows // factor, factor, columns // factor, factor, 3)
        total = parts.sum(axis=(1, 3), dtype=np.uint16)
        return np.asarray(total // factor**2, dtype=np.uint8)

    def close(self) -> None:
        """Free the renderer and its contexts; a second call changes nothing."""
        self._renderer.close()
        self._context.free()


class Window:
    """Window on the screen."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open the window.

        Raises:
            GLUnavailableError: There is no display, or no OpenGL on it.
        """
        self._window: Any = None
        always = sys.platform in ("darwin", "win32")
        if not (always or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise GLUnavailableError(
                "render_mode='human' opens a window, and there is no display (neither DISPLAY nor "
                "WAYLAND_DISPLAY is set): use render_mode='rgb_array' or 'rgb_array_list', or run under a "
                "virtual display, e.g. xvfb-run -a python ..."
            )
        _import_triton()
        import glfw

        self._glfw: Any = glfw
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if not glfw.init():
                raise GLUnavailableError("render_mode='human' opens no window: the display does not answer")
            glfw.window_hint(glfw.VISIBLE, 1)
            glfw.window_hint(glfw.SAMPLES, 4)
            self._window = glfw.create_window(width, height, "Viapoint", None, None)
        if not self._window:
            raise GLUnavailableError(f"render_mode='human' cannot open a window: no OpenGL there; {INSTALL}")
        self._glfw.make_context_current(self._window)
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        # A thread may have the context of one platform alone, GLFW or EGL.
        self._glfw.make_context_current(None)
        self.scene = mujoco.MjvScene(model, MAX_GEOMS)  # Scene that is shown

    def draw(self) -> bool:
        """Show the scene; return False after the window has been closed."""
        if self._window is None or self._glfw.window_should_close(self._window):
            self.close()
            return False
        self._glfw.make_context_current(self._window)
        width, height = self._glfw.get_framebuffer_size(self._window)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, width, height), self.scene, self._mjr)
        self._glfw.swap_buffers(self._window)
        self._glfw.make_context_current(None)
        self._glfw.poll_events()
        return True

    def close(self) -> None:
        """Close the window; a second call changes nothing."""
        window, self._window = self._window, None
        if window is not None:
            self._glfw.make_context_current(window)
            self._mjr.free()
            self._glfw.destroy_window(window)

    def __del__(self) -> None:
        self.close()


def _gl_context() -> Any:
    """Return a new OpenGL context of the kind that MuJoCo's renderer opens."""
    if sys.platform == "linux" and os.environ.get("MUJOCO_GL", "").lower() in ("", "egl"):
        # MuJoCo takes GLFW by default, which needs a display. It reads MUJOCO_GL when it is imported, and then cannot
        # be imported without the library of that name; so the variable is not set, and EGL is used where it is found.
        with contextlib.suppress(ImportError, AttributeError):  # PyOpenGL raises both if it finds no library
            gl_context.GLContext = importlib.import_module("mujoco.egl").GLContext
    context = gl_context.GLContext(1, 1)
    # GLFW without a display warns, and makes a context of no window.
    if not getattr(context, "_context", True):
        raise RuntimeError("GLFW needs a display")
    return context


def _import_triton() -> None:
    """Import triton before OpenGL is loaded, if torch can use it.

    Mesa's software renderer and triton each bring their LLVM. If Mesa's is loaded first, the later import of triton,
    with torch's first optimizer, ends the process; in the other order both work.
    """
    with contextlib.suppress(Exception):  # a broken triton concerns torch only, and a finder may raise
        if importlib.util.find_spec("torch") and importlib.util.find_spec("triton"):
            importlib.import_module("triton")
