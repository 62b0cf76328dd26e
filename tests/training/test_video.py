import logging

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
import rendered
from matplotlib.figure import Figure
from PIL import Image

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.rendering import gl
from viapoint.envs.rendering.renderer import GLUnavailableError
from viapoint.training.plotting.gallery import gallery, play
from viapoint.training.plotting.top_view import capsule, draw_movement
from viapoint.training.plotting.video import describe_outcome, record_video

OBSTACLES = "viapoint.envs:viapoint/PlanarObstacles-v0"


@pytest.fixture
def env():
    env = gym.make(OBSTACLES, render_mode="rgb_array_list", width=96, height=96)
    yield env
    env.close()


@pytest.fixture
def _no_opengl(monkeypatch):
    def missing(*arguments):
        raise OSError("no such library")

    monkeypatch.setattr(gl.mujoco, "Renderer", missing)


def scenes_of(env, number, seed=0):
    return env.unwrapped.task.sampler()([np.random.default_rng(seed + i) for i in range(number)])


def straight(observation, scene):
    assert observation["hand"].shape == (1, 2)
    assert scene.start.shape == (1, 2)
    return np.zeros((1, 3))


def entries_of(env, number):
    titles = [f"scene {seed}" for seed in range(number)]
    return play(OBSTACLES, scenes_of(env, number), titles, lambda *_: np.zeros(3, dtype=np.float32))


def read(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def check_film(path, count, env, number):
    meta, frames = read(path)
    assert len(frames) == count
    assert meta["fps"] == pytest.approx(env.metadata["render_fps"] / 2.0)
    duration = env.unwrapped.last_rollout.time[-1]
    assert count >= number * round(duration / 2.0 * meta["fps"])
    assert all(frame[:-48].std() > 5.0 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_a_film_shows_every_movement(env, tmp_path):
    count = record_video(tmp_path / "film.mp4", env, scenes_of(env, 2), straight)
    check_film(tmp_path / "film.mp4", count, env, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.usefixtures("_no_opengl")
def test_without_opengl_a_film_is_drawn_and_one_line_names_the_package(env, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        count = record_video(tmp_path / "film.mp4", env, scenes_of(env, 2), straight)
    check_film(tmp_path / "film.mp4", count, env, 2)
    assert len(caplog.records) == 1
    assert "the video shows a drawn view from above" in caplog.text
    assert "apt-get install libegl1 libgl1" in caplog.text


def test_a_film_needs_lists_of_frames_and_a_scene(env, tmp_path):
    for name in ("film.gif", "film.foo", "film"):
        with pytest.raises(ValueError, match=rf"must end in \.mp4, got .*{name}"):
            record_video(tmp_path / name, env, scenes_of(env, 1), straight)
    with pytest.raises(ValueError, match="rgb_array_list"):
        record_video(tmp_path / "film.mp4", gym.make(OBSTACLES), scenes_of(env, 1), straight)
    with pytest.raises(ValueError, match="at least one scene"):
        record_video(tmp_path / "film.mp4", env, scenes_of(env, 1).take(slice(0, 0)), straight)


def test_a_film_that_fails_half_way_leaves_nothing(env, tmp_path):
    def broken(observation, scene):
        if broken.calls:
            raise KeyError("policy")
        broken.calls = 1
        return np.zeros((1, 3))

    broken.calls = 0
    with pytest.raises(KeyError):
        record_video(tmp_path / "film.mp4", env, scenes_of(env, 2), broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "said", "colour"),
    [
        ({"is_success": True}, "success   clearance 12 mm", PALETTE.goal),
        ({"collision": True}, "collision at 0.31 s", PALETTE.contact),
        ({"reachable": False}, "out of reach", PALETTE.contact),
        ({}, "missed by 40 mm", PALETTE.contact),
    ],
)
def test_the_verdict_says_what_came_of_a_movement(changes, said, colour):
    info = {
        "is_success": False,
        "collision": False,
        "reachable": True,
        "first_contact_time": 0.31,
        "min_clearance": 0.012,
        "goal_error": 0.04,
    }
    assert describe_outcome({**info, **changes}) == (said, colour)


def test_a_gallery_is_a_page_of_movements(env, tmp_path):
    entries = entries_of(env, 5)
    path = gallery(tmp_path / "gallery.png", entries, heading="test scenes")
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
        assert image.width > 700
    assert pixels.std() > 5.0
    assert {entry.outcome for entry in entries} <= {"collision", "missed", "success"}


def test_a_gallery_of_one(env, tmp_path):
    assert gallery(tmp_path / "one.png", entries_of(env, 1)).stat().st_size > 2000


def test_an_empty_gallery_is_refused(env, tmp_path):
    with pytest.raises(ValueError, match="at least one movement"):
        gallery(tmp_path / "gallery.png", [])


def test_the_drawn_footprint_is_the_capsule():
    first, second = np.array([0.1, 0.2]), np.array([-0.2, 0.5])
    outline = capsule(first, second, 0.03)
    along = np.clip((outline - first) @ (second - first) / ((second - first) ** 2).sum(), 0.0, 1.0)
    distance = np.linalg.norm(outline - first - along[:, None] * (second - first), axis=-1)
    np.testing.assert_allclose(distance, 0.03, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(capsule(first, first, 0.03) - first, axis=-1), 0.03, rtol=1e-9)


def test_a_scene_is_drawn_without_plan_and_movement(env):
    axes = Figure().add_subplot()
    draw_movement(axes, env.unwrapped.task.arm, scenes_of(env, 1))
    scene_alone = len(axes.patches)
    entry = entries_of(env, 1)[0]
    draw_movement(axes, entry.arm, entry.scene, entry.plan)
    assert len(axes.patches) > scene_alone
    assert len(axes.lines) > 0


def test_the_pictures_of_the_documentation(tmp_path, monkeypatch):
    monkeypatch.setattr(rendered, "ATTEMPTS", 80)
    try:
        rendered.picture("PlanarReach", tmp_path / "reach.png")
        rendered.flow(tmp_path / "flow.png")
    except GLUnavailableError as error:
        pytest.skip(f"no picture can be rendered here: {error}")
    with Image.open(tmp_path / "reach.png") as image:
        assert image.size == (480, 480)
    with Image.open(tmp_path / "flow.png") as image:
        assert image.width > 1200


@pytest.mark.parametrize("env_id", rendered.PASSAGES)
def test_the_pictures_of_an_agent_show_that_it_passes_and_the_straight_movement_does_not(env_id):
    env = gym.make(env_id, render_mode="rgb_array_list", width=32, height=32)
    try:
        row = rendered.PASSAGES[env_id][0]
        passed, hit = (rendered.passage(env, env_id, row, straight=straight) for straight in (False, True))
    except GLUnavailableError as error:
        pytest.skip(str(error))
    finally:
        env.close()
    assert passed[0].shape == hit[0].shape == (32, 32, 3)
    assert len(hit) < len(passed)
