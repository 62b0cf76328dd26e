"""Contexts of OpenGL: when they are opened and freed, in any thread, and what is said where there is no OpenGL."""

import gc
import os
import subprocess
import sys
import threading
import weakref

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from helpers import PLANE

from viapoint.envs.rendering import gl
from viapoint.envs.rendering.gl import GLUnavailableError

pytestmark = pytest.mark.usefixtures("quick_pictures")


def in_a_thread(function):
    results = []
    thread = threading.Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join()
    return results[0]


@pytest.mark.usefixtures("opengl")
def test_a_renderer_is_opened_with_the_first_picture_and_freed_with_its_environment(monkeypatch):
    opened = []

    class Renderer(mujoco.Renderer):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            opened.append(weakref.ref(self))

    monkeypatch.setattr(mujoco, "Renderer", Renderer)
    for number in range(1, 5):
        env = gym.make(PLANE, render_mode="rgb_array", width=16, height=16)
        env.reset(seed=0)
        assert len(opened) == number - 1
        env.render()
        env.render()
        assert len(opened) == number
        if number % 2:
            env.close()
            env.close()
        else:
            del env
            gc.collect()
        assert opened[-1]() is None


def test_any_thread_may_render_and_close(make):
    env = make()
    env.reset(seed=0)
    before = env.render()
    np.testing.assert_array_equal(in_a_thread(env.render), before)
    np.testing.assert_array_equal(env.render(), before)
    in_a_thread(env.unwrapped.batch._renderers[0].close)
    np.testing.assert_array_equal(env.render(), before)  # by a new context


@pytest.mark.parametrize(("reason", "mode"), [(AttributeError, "egl"), (mujoco.FatalError, "")])
def test_without_opengl_the_error_says_what_to_install(monkeypatch, reason, mode):
    def missing(*arguments):
        raise reason("no library")

    monkeypatch.setenv("MUJOCO_GL", mode)
    monkeypatch.setattr(gl, "_gl_context", missing)
    env = gym.make(PLANE, render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(GLUnavailableError, match=r"apt-get install libegl1 libgl1.*MUJOCO_GL"):
        env.render()


@pytest.mark.usefixtures("opengl")
def test_a_picture_too_large_for_opengl_is_refused_with_its_size():
    env = gym.make(PLANE, render_mode="rgb_array", width=40000, height=40000)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="40000 x 40000"):
        env.render()


def run(code, **environment):
    """Run a script in a process of its own."""
    inherited = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env={**inherited, **environment})


def test_nothing_of_opengl_is_loaded_before_the_first_picture():
    code = (
        "import os, sys; before = dict(os.environ)\n"
        "import gymnasium as gym, viapoint.envs\n"
        "env = gym.make('viapoint/PlanarObstacles-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        "assert not {'OpenGL', 'OpenGL.GL', 'OpenGL.EGL', 'mujoco.egl'} & set(sys.modules)\n"
        "assert dict(os.environ) == before\n"
    )
    done = run(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("opengl")
def test_triton_is_loaded_before_opengl_where_torch_could_use_it(tmp_path):
    for name in ("torch", "triton"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(
            f"import sys; assert 'mujoco.egl' not in sys.modules; print('{name}')"
        )
    code = (
        "import sys\n"
        "import gymnasium as gym, viapoint.envs\n"
        "env = gym.make('viapoint/PlanarObstacles-v0', render_mode='rgb_array', width=16, height=16)\n"
        "env.reset(seed=0); env.render(); env.close()\n"
    )
    done = run(code, PYTHONPATH=os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", ""))))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["triton"]
