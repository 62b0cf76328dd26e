"""Pictures and films of movements."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from drawn import AROUND, OBSTACLES, SCENE, STRAIGHT, moved

from viapoint.envs.rendering import gl, renderer
from viapoint.envs.rendering.overlay import Movement, first_contact
from viapoint.envs.rendering.renderer import frame_steps

WHOLE_ARM = "viapoint.envs:viapoint/PlanarWholeArm-v0"

pytestmark = pytest.mark.usefixtures("quick_pictures")


def red(frame):
    r, g, b = (frame[..., i].astype(int) for i in range(3))
    return int(((r > 130) & (g < 60) & (b < 70)).sum())


@pytest.mark.parametrize(("duration", "fps"), [(0.7, 50), (1.3, 25), (0.702, 30), (0.1, 60)])
def test_the_frames_of_a_film_are_evenly_spaced_from_start_to_end(duration, fps):
    time = 0.002 * np.arange(1, round(duration / 0.002) + 1)
    steps = frame_steps(time, fps)
    assert (steps[0], steps[-1]) == (0, len(time))
    assert len(steps) == round(duration * fps) + 1
    assert np.ptp(np.diff(steps)) <= 1


@pytest.mark.parametrize(("width", "height"), [(120, 80), (80, 120), (1, 1), (1400, 64)])
@pytest.mark.parametrize("name", [OBSTACLES, WHOLE_ARM, "viapoint.envs:viapoint/PlanarReach-v0"])
def test_a_picture_has_the_size_asked_for(make, name, width, height):
    env = make(name, width=width, height=height)
    env.reset(seed=1)
    still = env.render()
    env.step(STRAIGHT)
    for frame in (still, env.render()):
        assert frame.shape == (height, width, 3)
        assert frame.dtype == np.uint8
        assert (width, height) == (1, 1) or frame.std() > 5.0


def test_equal_movements_give_equal_pictures(make):
    pictures = []
    for _ in range(2):
        env = make()
        moved(env, AROUND)
        pictures += [env.render(), env.render()]
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])


def test_a_film_lasts_as_long_as_the_movement(make):
    env = make(mode="rgb_array_list", side=48)
    env.reset(seed=0)
    assert len(env.render()) == 1
    moved(env, AROUND)
    frames, rollout = env.render(), env.unwrapped.last_rollout
    assert isinstance(frames, list)
    assert len(frames) == round(rollout.time[-1] * env.metadata["render_fps"]) + 1
    assert all(frame.shape == (48, 48, 3) and frame.dtype == np.uint8 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


@pytest.mark.parametrize("name", [OBSTACLES, WHOLE_ARM])
def test_contact_is_red_and_nothing_else_is(make, name):
    env = make(name, side=240)
    env.reset(options={key: np.array(value) for key, value in SCENE.items()})
    assert red(env.render()) == 0
    assert moved(env, STRAIGHT)["collision"]
    assert red(env.render()) > 60
    assert not moved(env, AROUND)["collision"]
    assert red(env.render()) == 0


def test_a_film_turns_red_at_contact(make):
    env = make(mode="rgb_array_list", side=240)
    info = moved(env, STRAIGHT)
    reds = np.array([red(frame) for frame in env.render()]) > 20
    first = info["first_contact_time"] * env.metadata["render_fps"]
    assert reds.argmax() == pytest.approx(first, abs=1.5)
    assert reds[reds.argmax() :].all()


@pytest.mark.parametrize("name", [OBSTACLES, WHOLE_ARM])
def test_the_obstacle_that_was_touched_is_named(name):
    env = gym.make(name)
    moved(env, STRAIGHT)
    inner = env.unwrapped
    scene, plan = inner.batch._last[:2]
    movement = Movement.of(inner.task.collision_model, scene, plan, inner.last_rollout)
    assert movement.contact.obstacle == 1
    assert movement.contact.step == inner.last_rollout.contact.argmax()
    tip = np.array([-0.11, 0.4])
    assert np.linalg.norm(movement.contact.position - tip) < 0.01 + max(inner.task.arm.link_radii)


def test_pictures_leave_no_trace_in_the_simulation(make):
    plain, drawn = gym.make(OBSTACLES), make(side=16)
    for env in (plain, drawn):
        env.reset(seed=3)
    for _ in range(3):
        drawn.render()
        infos = [env.step(AROUND)[-1] for env in (plain, drawn)]
        drawn.render()
        assert infos[0] == infos[1]
        for env in (plain, drawn):
            env.reset()


@pytest.mark.usefixtures("opengl")
def test_a_vector_environment_gives_a_picture_of_each():
    env = gym.make_vec(OBSTACLES, num_envs=2, render_mode="rgb_array", width=32, height=24)
    env.reset(seed=0)
    frames = env.render()
    assert [frame.shape for frame in frames] == [(24, 32, 3)] * 2
    env.step(np.zeros((2, 3), dtype=np.float32))
    assert len(env.render()) == 2
    env.close()


def test_a_window_plays_in_real_time_and_stops_when_closed(monkeypatch):
    shown = []

    class Window:
        def __init__(self, model, width, height, title):
            self.scene = mujoco.MjvScene(model, gl.MAX_GEOMS)

        def draw(self):
            shown.append(self.scene.ngeom)
            return len(shown) < 5

        def close(self):
            shown.append("closed")

    monkeypatch.setattr(renderer, "Window", Window)
    env = gym.make(OBSTACLES, render_mode="human")
    env.reset(seed=0)
    assert len(shown) == 1
    env.step(AROUND)
    assert len(shown) == 5
    env.close()
    assert shown[-1] == "closed"


def test_a_full_scene_is_drawn_in_part_and_not_refused(make, monkeypatch):
    monkeypatch.setattr(gl, "MAX_GEOMS", 12)
    env = make(side=16)
    moved(env, AROUND)
    assert env.render().shape == (16, 16, 3)


PANDA_SCENE = {
    "start": [0.45, -0.2, 0.2],
    "goal": [0.45, 0.2, 0.2],
    "obstacles": [[0.45, 0.0, 0.21, 0.0, 0.0, 0.0, 0.05], [0.7, 0.3, 0.1, 0.0, 0.0, 0.05, 0.02]],
}


@pytest.mark.parametrize("around", [False, True])
def test_in_space_spheres_are_seen_and_turn_red_with_the_link_that_touches_them(make, around):
    env = make("viapoint.envs:viapoint/PandaObstacles-v0", side=160)
    env.reset(options={name: np.array(value) for name, value in PANDA_SCENE.items()})
    before = env.render().astype(int)
    sphere = (before[..., 0] - before[..., 2] > 40).sum()
    *_, info = env.step(np.array([0.0, 0.0, 0.9 if around else 0.0, 0.0], np.float32))
    assert info["collision"] == (not around)
    assert sphere > 150
    assert (red(env.render()) > 150) == (not around)


def test_a_contact_that_is_with_no_obstacle_is_drawn_as_such():
    env = gym.make("viapoint.envs:viapoint/PandaReach-v0").unwrapped
    env.reset(seed=0)
    scene = env.batch.scenes
    joints = np.repeat(env.task.arm.inverse_kinematics(scene.start), 3, axis=0)
    contact = first_contact(env.task.collision_model, scene, joints, np.array([False, True, True]))
    assert (contact.step, contact.obstacle, contact.link) == (1, -1, None)
