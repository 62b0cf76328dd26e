import logging

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from viapoint.envs.rendering.renderer import GLUnavailableError
from viapoint.training.plotting.gallery import gallery, play
from viapoint.training.plotting.top_view import capsule
from viapoint.training.plotting.video import record_video

OBSTACLES = "viapoint.envs:viapoint/PlanarObstacles-v0"


@pytest.fixture
def env():
    env = gym.make(OBSTACLES, render_mode="rgb_array_list", width=96, height=96)
    yield env
    env.close()


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


def test_without_opengl_a_film_is_drawn_and_one_line_names_the_reason(env, tmp_path, caplog, monkeypatch):
    def missing(self):
        raise GLUnavailableError("install libegl1")

    monkeypatch.setattr(type(env), "render", missing)
    with caplog.at_level(logging.WARNING):
        count = record_video(tmp_path / "film.mp4", env, scenes_of(env, 2), straight)
    check_film(tmp_path / "film.mp4", count, env, 2)
    (record,) = caplog.records
    assert "libegl1" in record.getMessage()


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


def test_a_gallery_is_a_page_of_movements(env, tmp_path):
    entries = entries_of(env, 5)
    path = gallery(tmp_path / "gallery.png", entries, heading="test scenes")
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
        assert image.width > 700
    assert pixels.std() > 5.0
    assert {entry.outcome for entry in entries} <= {"collision", "missed", "success"}


def test_the_drawn_footprint_is_the_capsule():
    first, second = np.array([0.1, 0.2]), np.array([-0.2, 0.5])
    outline = capsule(first, second, 0.03)
    along = np.clip((outline - first) @ (second - first) / ((second - first) ** 2).sum(), 0.0, 1.0)
    distance = np.linalg.norm(outline - first - along[:, None] * (second - first), axis=-1)
    np.testing.assert_allclose(distance, 0.03, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(capsule(first, first, 0.03) - first, axis=-1), 0.03, rtol=1e-9)
