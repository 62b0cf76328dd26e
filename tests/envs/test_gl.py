"""OpenGL contexts and windows."""

import gc
import importlib
import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from drawn import OBSTACLES, STRAIGHT

from viapoint.envs.rendering import gl
from viapoint.envs.rendering.renderer import GLUnavailableError

pytestmark = pytest.mark.usefixtures("quick_pictures")


@pytest.mark.usefixtures("opengl")
def test_a_context_is_opened_with_the_first_picture_and_given_back(monkeypatch):
    opened, freed = [], []
    real = gl._open

    class Context:
        def __init__(self, context):
            self.context, self.as_current = context, context.as_current

        def free(self):
            freed.append(self)
            self.context.free()

    def counting(model):
        context, mjr = real(model)
        opened.append(context)
        return Context(context), mjr

    monkeypatch.setattr(gl, "_open", counting)
    for number in range(1, 7):
        env = gym.make(OBSTACLES, render_mode="rgb_array", width=16, height=16)
        env.reset(seed=0)
        env.step(STRAIGHT)
        assert len(opened) == number - 1
        env.render()
        env.render()
        assert len(opened) == number
        if number % 2:
            env.close()
            env.close()
        del env
        gc.collect()
        assert len(freed) == number


def test_after_close_a_picture_opens_a_context_again(make):
    env = make()
    env.reset(seed=0)
    before = env.render()
    env.unwrapped.batch._renderer.close()
    np.testing.assert_array_equal(env.render(), before)


def failing(*names):
    real = importlib.import_module

    def fail(name, *rest):
        if name in names:
            raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")
        return real(name, *rest)

    return fail


def test_a_missing_library_is_named_with_the_package_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl.importlib, "import_module", failing("mujoco.egl", "mujoco.glfw", "mujoco.cgl"))
    env = gym.make(OBSTACLES, render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(GLUnavailableError, match=r"library not found.*apt-get install libegl1 libgl1"):
        env.render()
    env.close()


def test_rendering_can_be_forbidden(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    env = gym.make(OBSTACLES, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(STRAIGHT)
    with pytest.raises(GLUnavailableError, match="MUJOCO_GL=off"):
        env.render()


@pytest.mark.skipif(sys.platform != "linux", reason="macOS and Windows always have a display")
def test_a_window_without_a_display_names_the_other_modes(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = gym.make(OBSTACLES, render_mode="human")
    with pytest.raises(GLUnavailableError, match=r"no display.*rgb_array.*xvfb-run"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("wish", "display", "platforms"),
    [
        ("egl", True, ("egl",)),
        ("osmesa", False, ("osmesa",)),
        ("", False, ("egl",)),
        ("", True, ("glfw", "egl")),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa can be chosen on Linux only")
def test_egl_is_chosen_without_a_display_and_a_wish_is_respected(monkeypatch, wish, display, platforms):
    monkeypatch.setattr(gl, "_has_display", lambda: display)
    assert gl._platforms(wish) == platforms


def test_nothing_of_opengl_is_loaded_before_the_first_picture():
    code = (
        "import os, sys; before = dict(os.environ)\n"
        "import gymnasium as gym, viapoint.envs\n"
        "env = gym.make('viapoint/PlanarObstacles-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        "assert not {'OpenGL', 'OpenGL.GL', 'OpenGL.EGL', 'mujoco.egl'} & set(sys.modules)\n"
        "assert dict(os.environ) == before\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("names", [("torch", "triton"), ("triton",)])
def test_triton_is_loaded_before_opengl_where_torch_could_use_it(tmp_path, names):
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(
            f"import sys; assert 'mujoco.egl' not in sys.modules; print('{name}')"
        )
    code = (
        "import sys\n"
        "if 'torch' not in NAMES: sys.modules['torch'] = None\n"
        "import gymnasium as gym, viapoint.envs\n"
        "env = gym.make('viapoint/PlanarObstacles-v0', render_mode='rgb_array', width=16, height=16)\n"
        "env.reset(seed=0); env.render()\n"
        "env.close()\n"
    ).replace("NAMES", repr(names))
    path = os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    environment["PYTHONPATH"] = path
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert told.returncode == 0, told.stderr
    assert told.stdout.split() == (["triton"] if "torch" in names else [])
