"""Pictures in memory, which need no display, and a window on the screen.

OpenGL is loaded with the first picture.
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
from mujoco.rendering.classic import gl_context

from viapoint.envs.common.arrays import Frame

MAX_SIDE = 8192  # Longest side of a supersampled picture, in pixels; OpenGL may not support larger ones
MAX_GEOMS = 2000  # Greatest number of shapes in a scene
INSTALL = "on Debian and Ubuntu: apt-get install libegl1 libgl1"


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

    def __init__(self, model: mujoco.MjModel, width: int, height: int, title: str) -> None:
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
            self._window = glfw.create_window(width, height, title, None, None)
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
    if importlib.util.find_spec("torch") and importlib.util.find_spec("triton"):
        with contextlib.suppress(Exception):  # a broken triton concerns torch only
            importlib.import_module("triton")
