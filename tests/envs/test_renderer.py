"""Pictures and films of movements."""

import gc
import os
import subprocess
import sys
import threading
import weakref
from types import SimpleNamespace

import gymnasium as gym
import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from helpers import JUMPS, PANDA, PLANE, SENSED, WHOLE, play, post

from viapoint.envs import Box, HalfSpace, RecordMovements, Sphere, arm_of, renderer
from viapoint.envs.renderer import GLUnavailableError

DRAWN = {
    "start": [-0.1, 0.25],
    "goal": [-0.1, 0.55],
    "obstacles": [post(-0.4, 0.6), Box((0.05, 0.01, 0.04), position=(-0.16, 0.4, 0.0))],
}
STRAIGHT, AROUND = np.zeros(3, np.float32), np.array([0.0, -0.5, 0.5], np.float32)


@pytest.fixture(autouse=True)
def quick_pictures(monkeypatch):
    """Pictures without supersampling: what is tested here does not need to look good."""
    monkeypatch.setattr(renderer, "STILL_SUPERSAMPLING", 1)


@pytest.fixture(scope="module")
def opengl():
    env = gym.make(PLANE, render_mode="rgb_array", width=16, height=16)
    env.reset(seed=0)
    try:
        env.render()
    except GLUnavailableError as error:
        pytest.skip(f"no picture can be rendered here: {error}")
    finally:
        env.close()


@pytest.fixture
def make(opengl):
    """Function that makes environments with small pictures, which are closed after the test."""
    opened = []

    def made(name=PLANE, mode="rgb_array", *, side=96, **kwargs):
        opened.append(gym.make(name, render_mode=mode, **{"width": side, "height": side, **kwargs}))
        return opened[-1]

    yield made
    for env in opened:
        env.close()


def moved(env, action):
    env.reset(options=DRAWN)
    return env.step(action)[-1]


def assert_alike(frame, other):
    """Drivers of OpenGL may give a few pixels on edges other values in a new context."""
    assert frame.shape == other.shape
    assert (frame != other).mean() < 0.01


def red(frame):
    r, g, b = (frame[..., i].astype(int) for i in range(3))
    return int(((r > 130) & (g < 60) & (b < 70)).sum())


@pytest.mark.parametrize(("width", "height"), [(80, 120), (1, 1), (1400, 64)])
@pytest.mark.parametrize("name", [PLANE, PANDA])
def test_a_picture_has_the_size_asked_for(make, name, width, height):
    env = make(name, width=width, height=height)
    env.reset(seed=1)
    still = env.render()
    env.step(np.zeros(env.action_space.shape, np.float32))
    for frame in (still, env.render()):
        assert frame.shape == (height, width, 3)
        assert frame.dtype == np.uint8
        assert (width, height) == (1, 1) or frame.std() > 5.0


def test_a_film_lasts_as_long_as_the_movement(make):
    env = make(mode="rgb_array_list", side=48, duration_range=(0.4, 0.41))
    env.reset(seed=0)
    assert len(env.render()) == 1
    moved(env, AROUND)
    frames, rollout = env.render(), env.unwrapped.last_rollout
    assert isinstance(frames, list)
    assert len(frames) == round(rollout.time[-1] * env.metadata["render_fps"]) + 1
    assert all(frame.shape == (48, 48, 3) and frame.dtype == np.uint8 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


@pytest.mark.parametrize("name", [PLANE, WHOLE])
def test_contact_is_red_and_nothing_else_is(make, name):
    env = make(name, side=240)
    env.reset(options=DRAWN)
    assert red(env.render()) == 0
    assert moved(env, STRAIGHT)["collision"]
    assert red(env.render()) > 60
    assert not moved(env, AROUND)["collision"]
    assert red(env.render()) == 0


def test_a_half_space_below_the_table_is_hidden_by_it(make):
    # MuJoCo would draw a plane that the compiled model did not have as something else.
    env = make(PANDA, side=120)
    ball, home = Sphere(0.05, position=(0.5, 0.4, 0.6)), arm_of("panda").home
    frames = []
    for obstacles in ([ball], [ball, HalfSpace(position=(0.0, 0.0, -0.01))]):
        env.reset(options={"start": home, "goal": home + 0.2, "obstacles": obstacles})
        frames.append(env.render().astype(int))
    assert (np.abs(frames[0] - frames[1]).max(axis=-1) > 20).mean() < 0.15


def test_a_surface_does_not_speckle_itself_with_its_shadow(make):
    env, home = make(PANDA, side=240), arm_of("panda").home
    board = Box((0.056, 0.12, 0.19), position=(-0.45, 0.0, 0.8), quaternion=(0.94, 0.0, 0.0, -0.34))
    env.reset(options={"start": home, "goal": home + 0.2, "obstacles": [board]})
    frame = env.render().astype(int)
    orange = frame[..., 0] - frame[..., 2] > 60
    row, column = np.argwhere(orange).mean(axis=0).astype(int)
    face = frame[row - 10 : row + 10, column - 8 : column + 8]
    assert np.ptp(face, axis=(0, 1)).max() < 8


def test_points_that_a_sensor_sees_are_drawn(make):
    yellow = []
    for name in (PLANE, SENSED):
        env = make(name, side=240)
        env.reset(options=DRAWN)
        r, g, b = (env.render()[..., i].astype(int) for i in range(3))
        yellow.append(int(((r > 200) & (g > 150) & (b < 90)).sum()))
    assert yellow[0] == 0
    assert yellow[1] > 10


def test_pictures_leave_no_trace_in_the_simulation(make):
    plain, drawn = gym.make(PLANE), make(side=16)
    for env in (plain, drawn):
        env.reset(seed=3)
    for _ in range(3):
        drawn.render()
        infos = [env.step(AROUND)[-1] for env in (plain, drawn)]
        drawn.render()
        assert infos[0] == infos[1]
        for env in (plain, drawn):
            env.reset()


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_pictures_of_a_batch_are_those_of_its_environments(mode, make):
    """Also of an episode that is over, where the next one has begun."""
    sizes = {"width": 48, "height": 32}
    batch = gym.make_vec(PLANE, num_envs=3, autoreset_mode=mode, render_mode="rgb_array", **sizes)
    singles = [make(**sizes) for _ in range(3)]
    batch.reset(seed=0)
    for seed, single in enumerate(singles):
        single.reset(seed=seed)
    for moved_already in (False, True):
        if moved_already:
            batch.step(np.tile(STRAIGHT, (3, 1)))
            for single in singles:
                single.step(STRAIGHT)
        for frame, single in zip(batch.render(), singles, strict=True):
            assert frame.shape == (32, 48, 3)
            assert_alike(frame, single.render())
    batch.close()


def test_a_window_plays_in_real_time_and_stops_when_closed(monkeypatch):
    shown = []

    class Window:
        def __init__(self, model, width, height):
            self.scene = mujoco.MjvScene(model, renderer.MAX_GEOMS)

        def draw(self):
            shown.append(self.scene.ngeom)
            return len(shown) < 5

        def close(self):
            shown.append("closed")

    monkeypatch.setattr(renderer, "Window", Window)
    env = gym.make(PLANE, render_mode="human")
    env.reset(seed=0)
    assert len(shown) == 1
    env.step(AROUND)
    assert len(shown) == 5
    env.close()
    assert shown[-1] == "closed"


def frames_of(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    next(reader)
    return sum(1 for _ in reader)


@pytest.mark.parametrize("env_id", [PLANE, JUMPS])
def test_each_frame_of_a_movement_of_one_or_several_steps_is_recorded_once(env_id, make, tmp_path):
    pytest.importorskip("moviepy")
    made = make(env_id, "rgb_array_list", side=64, duration_range=(0.4, 0.6))
    env = RecordMovements(made, str(tmp_path / "videos"), episode_trigger=lambda _: True)
    env.reset(seed=0)
    steps = len(play(env, 0.3))
    expected = 1 + round(env.unwrapped.last_rollout.time[-1] * env.metadata["render_fps"])
    env.close()
    assert (steps > 1) == (env_id == JUMPS)
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == pytest.approx(expected, abs=1)


def test_gymnasium_records_two_frames_of_a_movement_and_a_warning_says_so(make, tmp_path):
    pytest.importorskip("moviepy")
    env = gym.wrappers.RecordVideo(make(side=64), str(tmp_path / "videos"), episode_trigger=lambda _: True)
    with pytest.warns(UserWarning, match="RecordMovements"):
        moved(env, AROUND)
    env.close()
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == 2


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
    assert_alike(in_a_thread(env.render), before)
    assert_alike(env.render(), before)
    in_a_thread(env.unwrapped.batch._renderers[0].close)
    assert_alike(env.render(), before)  # by a new context


NO_WINDOW = SimpleNamespace(_context=None)
"""What GLFW makes without a display."""


@pytest.mark.parametrize("made", [AttributeError("no library"), mujoco.FatalError("no library"), NO_WINDOW])
def test_without_opengl_the_error_says_what_to_install(monkeypatch, made):
    def context(*sizes):
        if isinstance(made, Exception):
            raise made
        return made

    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(renderer.gl_context, "GLContext", context)
    env = gym.make(PLANE, render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(GLUnavailableError, match=r"apt-get install libegl1 libgl1.*MUJOCO_GL"):
        env.render()


def test_a_picture_too_large_for_opengl_is_refused_with_its_size(make):
    env = make(side=40000)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="40000 x 40000"):
        env.render()


FIRST_PICTURE = """
import os, sys
before = dict(os.environ)
import gymnasium as gym, viapoint.envs
env = gym.make("viapoint/PlanarObstacles-v0", render_mode="rgb_array", width=16, height=16)
env.reset(seed=0)
env.step(env.action_space.sample())
assert not {"OpenGL", "OpenGL.GL", "OpenGL.EGL", "mujoco.egl"} & set(sys.modules)
assert dict(os.environ) == before
env.render()
env.close()
"""


@pytest.mark.usefixtures("opengl")
def test_opengl_is_loaded_with_the_first_picture_and_after_triton(tmp_path):
    """Where torch could use Triton; in a process of its own."""
    for name in ("torch", "triton"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(
            f"import sys; assert 'mujoco.egl' not in sys.modules; print('{name}')"
        )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    environment["PYTHONPATH"] = os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))
    command = [sys.executable, "-c", FIRST_PICTURE]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout.split()) == (0, ["triton"]), done.stderr
