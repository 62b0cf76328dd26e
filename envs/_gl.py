"""Where pictures come from: an OpenGL context that needs no display, and a window that does.

Nothing here touches OpenGL or the environment variables before the first picture.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]

OFF = ("disable", "disabled", "off", "false", "0")
"""What MUJOCO_GL says to forbid rendering."""
INSTALL = "on Debian and Ubuntu: apt-get install libegl1 libgl1"


class GLUnavailableError(gym.error.DependencyNotInstalled):
    """No picture can be rendered on this machine; the message says what to install."""


class Canvas:
    """A picture in memory that a scene is rendered to.

    Smooth edges and soft shadows come from the mean of several passes, each with the picture moved by
    a fraction of a pixel and the lamps by a fraction of their size.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open a context for pictures of this size, whatever the model's own offscreen size is.

        Raises:
            GLUnavailableError: There is no OpenGL library, or it refuses.
        """
        self.width, self.height = width, height
        self._context: Any = None
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._context, self._mjr = _open(model)

    def draw(self, scene: mujoco.MjvScene, passes: int = 1, lamp_radius: float = 0.0) -> Frame:
        """The scene as a picture, shape (height, width, 3).

        Args:
            scene: What is to be seen.
            passes: How many pictures to take the mean of.
            lamp_radius: Size of the lamps, [m]; the larger, the softer the shadows.
        """
        rectangle = mujoco.MjrRect(0, 0, self.width, self.height)
        pixels = np.empty((self.height, self.width, 3), dtype=np.uint8)
        total = np.zeros(pixels.shape, dtype=np.uint16)
        with self._context.as_current():
            for shift in _spread(passes):
                with _moved(scene, shift, self.height, lamp_radius):
                    mujoco.mjr_render(rectangle, scene, self._mjr)
                    mujoco.mjr_readPixels(pixels, None, rectangle, self._mjr)
                total += pixels
        return np.ascontiguousarray((total // passes).astype(np.uint8)[::-1])

    def close(self) -> None:
        """Give the context back; a second call changes nothing."""
        context, self._context = self._context, None
        if context is not None:
            with context.as_current():
                self._mjr.free()
            context.free()

    def __del__(self) -> None:
        self.close()


class Window:
    """A window on the screen."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, title: str) -> None:
        """Open the window.

        Raises:
            GLUnavailableError: There is no screen, or no OpenGL on it.
        """
        self._window: Any = None
        if not _has_display():
            raise GLUnavailableError(
                "render_mode='human' opens a window, and there is no display (neither DISPLAY nor "
                "WAYLAND_DISPLAY is set): use render_mode='rgb_array' or 'rgb_array_list', or run under a "
                "virtual display, e.g. xvfb-run -a python ..."
            )
        import glfw

        self._glfw = glfw
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if not glfw.init():
                raise GLUnavailableError(
                    "render_mode='human' cannot open a window: the display does not answer"
                )
            glfw.window_hint(glfw.VISIBLE, 1)
            glfw.window_hint(glfw.SAMPLES, 4)
            self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            raise GLUnavailableError(f"render_mode='human' cannot open a window: no OpenGL there; {INSTALL}")
        glfw.make_context_current(self._window)
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)

    def show(self, scene: mujoco.MjvScene) -> bool:
        """Show the scene; False once the person has closed the window."""
        if self._window is None or self._glfw.window_should_close(self._window):
            self.close()
            return False
        self._glfw.make_context_current(self._window)
        width, height = self._glfw.get_framebuffer_size(self._window)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, width, height), scene, self._mjr)
        self._glfw.swap_buffers(self._window)
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


def _open(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """A context for pictures in memory: what MUJOCO_GL says, else the first that this machine has."""
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wish in OFF:
        raise GLUnavailableError(f"rendering is switched off by MUJOCO_GL={wish}: unset it, or set it to egl")
    reasons = []
    for platform in _platforms(wish):
        try:
            return _open_on(platform, model)
        except AttributeError:  # PyOpenGL's way to say that it found no library
            reasons.append(f"{platform}: library not found")
        except Exception as error:  # every platform has failures of its own, down to MuJoCo's FatalError
            reasons.append(f"{platform}: {error}")
    raise GLUnavailableError(
        f"no OpenGL library could be used to render ({'; '.join(reasons)}). Install one ({INSTALL}), "
        "or choose another by setting MUJOCO_GL to egl, osmesa or glfw"
    )


def _open_on(platform: str, model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW warns where the exception that follows says the same
        size = model.vis.global_.offwidth, model.vis.global_.offheight
        context = importlib.import_module(f"mujoco.{platform}").GLContext(*size)
        with context.as_current():
            if platform == "glfw" and not importlib.import_module("glfw").get_current_context():
                raise OSError("no window could be opened")  # going on would end the process
            mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, mjr)
    return context, mjr


def _platforms(wish: str) -> tuple[str, ...]:
    """MuJoCo's OpenGL platforms in the order to try."""
    if wish in ("egl", "osmesa", "glfw", "cgl"):
        return (wish,)
    if sys.platform == "darwin":
        return ("cgl", "glfw")
    if sys.platform == "win32":
        return ("glfw",)
    return ("glfw", "egl") if _has_display() else ("egl",)


def _has_display() -> bool:
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _spread(passes: int) -> NDArray[np.float64]:
    """Points spread over the square [-1/2, 1/2]^2, shape (passes, 2): M. Roberts' R2 sequence (2018)."""
    if passes == 1:
        return np.zeros((1, 2))
    steps = np.arange(passes)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    return np.asarray((steps + 0.5) % 1.0 - 0.5)


@contextlib.contextmanager
def _moved(
    scene: mujoco.MjvScene, shift: NDArray[np.float64], height: int, lamp_radius: float
) -> Iterator[None]:
    """For a while, the scene with its picture moved by `shift` pixels and its lamps by `shift` diameters."""
    pixel = (scene.camera[0].frustum_top - scene.camera[0].frustum_bottom) / height
    step = pixel * shift[1]
    lamp_step = 2.0 * lamp_radius * np.array([*shift, 0.0])
    eyes = [(eye, eye.frustum_center, eye.frustum_bottom, eye.frustum_top) for eye in scene.camera]
    lamps = [(lamp, lamp.pos.copy()) for lamp in scene.lights[: scene.nlight] if lamp.castshadow]
    for eye, centre, bottom, top in eyes:
        _set_frustum(eye, centre + pixel * shift[0], bottom + step, top + step)
    for lamp, place in lamps:
        lamp.pos = place + lamp_step
    try:
        yield
    finally:
        for eye, *frustum in eyes:
            _set_frustum(eye, *frustum)
        for lamp, place in lamps:
            lamp.pos = place


def _set_frustum(eye: Any, centre: float, bottom: float, top: float) -> None:
    eye.frustum_center, eye.frustum_bottom, eye.frustum_top = centre, bottom, top
