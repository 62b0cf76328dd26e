"""OpenGL contexts: pictures in memory, which need no display, and a window on the screen.

OpenGL is loaded with the first picture. The environment variables are never changed.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import sys
import warnings
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from viapoint.envs.common.types import Frame

OFF = ("disable", "disabled", "off", "false", "0")
"""Values of MUJOCO_GL that disable rendering."""
MAX_SIDE = 8192
"""Longest side of a supersampled picture, in pixels; OpenGL may not support larger ones."""
INSTALL = "on Debian and Ubuntu: apt-get install libegl1 libgl1"


class GLUnavailableError(gym.error.DependencyNotInstalled):
    """No picture can be rendered on this machine; the message says what to install."""


class Canvas:
    """Offscreen buffer that scenes are rendered to.

    `mujoco.Renderer` is not used because it takes the OpenGL platform of MUJOCO_GL at the import of MuJoCo, by default
    GLFW, which needs a display, and leaves its context current in the thread that rendered.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, supersampling: int = 1) -> None:
        """Open a context for pictures of a size in pixels, independent of the model's own offscreen size.

        Pictures are rendered larger in both directions by the factor `supersampling`, and then averaged. The samples
        per pixel, `vis.quality.offsamples` of the model, smooth the edges of bodies, but not those of shadows.

        Raises:
            GLUnavailableError: No OpenGL library can be used.
        """
        self._context: Any = None
        self._factor = supersampling if supersampling * max(width, height) <= MAX_SIDE else 1
        self._rectangle = mujoco.MjrRect(0, 0, self._factor * width, self._factor * height)
        size = model.vis.global_
        size.offwidth, size.offheight = self._rectangle.width, self._rectangle.height
        self._context, self._mjr = _open(model)

    def draw(self, scene: mujoco.MjvScene) -> Frame:
        """Render a scene to a picture, shape (height, width, 3)."""
        rows, columns, factor = self._rectangle.height, self._rectangle.width, self._factor
        pixels = np.empty((rows, columns, 3), dtype=np.uint8)
        with self._context.as_current():
            mujoco.mjr_render(self._rectangle, scene, self._mjr)
            mujoco.mjr_readPixels(pixels, None, self._rectangle, self._mjr)
        upright = pixels[::-1].reshape(rows // factor, factor, columns // factor, factor, 3)
        total = upright.sum(axis=(1, 3), dtype=np.uint16)
        return np.asarray(total // factor**2, dtype=np.uint8)

    def close(self) -> None:
        """Free the context; a second call changes nothing."""
        context, self._context = self._context, None
        if context is not None:
            with context.as_current():
                self._mjr.free()
            context.free()

    def __del__(self) -> None:
        self.close()


class Window:
    """Window on the screen."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, title: str) -> None:
        """Open the window.

        Raises:
            GLUnavailableError: There is no display, or no OpenGL on it.
        """
        self._window: Any = None
        if not _has_display():
            raise GLUnavailableError(
                "render_mode='human' opens a window, and there is no display (neither DISPLAY nor "
                "WAYLAND_DISPLAY is set): use render_mode='rgb_array' or 'rgb_array_list', or run under a "
                "virtual display, e.g. xvfb-run -a python ..."
            )
        _import_triton()
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
        """Show a scene; return False after the window has been closed."""
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
    """Return an offscreen context on the platform of MUJOCO_GL, or else on the first that works."""
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wish in OFF:
        raise GLUnavailableError(f"rendering is disabled by MUJOCO_GL={wish}: unset it, or set it to egl")
    _import_triton()
    reasons = []
    for platform in _platforms(wish):
        try:
            return _open_on(platform, model)
        except AttributeError:  # raised by PyOpenGL if it finds no library
            reasons.append(f"{platform}: library not found")
        except Exception as error:  # platforms raise errors of many kinds, including MuJoCo's FatalError
            reasons.append(f"{platform}: {error}")
    raise GLUnavailableError(
        f"no OpenGL library could be used to render ({'; '.join(reasons)}). Install one ({INSTALL}), "
        "or choose another by setting MUJOCO_GL to egl, osmesa or glfw"
    )


def _open_on(platform: str, model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW warns before the exception with the same message
        size = model.vis.global_.offwidth, model.vis.global_.offheight
        context = importlib.import_module(f"mujoco.{platform}").GLContext(*size)
        with context.as_current():
            if platform == "glfw" and not importlib.import_module("glfw").get_current_context():
                raise OSError("no window could be opened")  # MuJoCo would end the process
            mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, mjr)
    return context, mjr


def _import_triton() -> None:
    """Import triton before OpenGL is loaded, if torch can use it.

    Mesa's software renderer and triton each bring their LLVM. If Mesa's is loaded first, the later import of triton,
    with torch's first optimizer, ends the process; in the other order both work.
    """
    if importlib.util.find_spec("torch") and importlib.util.find_spec("triton"):
        with contextlib.suppress(Exception):  # a broken triton concerns torch only
            importlib.import_module("triton")


def _platforms(wish: str) -> tuple[str, ...]:
    """Return MuJoCo's OpenGL platforms in the order in which to try them."""
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
