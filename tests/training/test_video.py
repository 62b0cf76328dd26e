from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from viapoint.training import GeometrySearch
from viapoint.training.video import gallery, record_video

TASKS = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"


@pytest.fixture(params=TASKS)
def env(request):
    env = gym.make(request.param, render_mode="rgb_array_list", width=96, height=96)
    yield env
    env.close()


def scenes_of(env, number, seed=0):
    return env.unwrapped.task.sampler()([np.random.default_rng(seed + i) for i in range(number)])


def search(env):
    return GeometrySearch(env.unwrapped.task, 8).decide


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
    assert count > number * meta["fps"] * 0.4 + duration * env.metadata["render_fps"]
    assert all(frame[:-48].std() > 5.0 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_a_film_shows_every_movement(env, tmp_path):
    number = 2 if env.spec.id == TASKS[0] else 1
    count = record_video(tmp_path / "film.mp4", env, scenes_of(env, number), search(env))
    check_film(tmp_path / "film.mp4", count, env, number)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("env", TASKS[:1], indirect=True)
def test_a_film_that_fails_half_way_leaves_nothing(env, tmp_path):
    calls = []

    def broken(observation, scenes):
        calls.append(scenes)
        if len(calls) == 2:
            raise KeyError("policy")
        return np.zeros((1, 3))

    with pytest.raises(KeyError):
        record_video(tmp_path / "film.mp4", env, scenes_of(env, 2), broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("env", TASKS[:1], indirect=True)
def test_a_film_that_the_encoder_could_not_finish_is_refused(env, tmp_path, monkeypatch):
    def on_a_full_disk(path, *_, **__):
        Path(path).write_bytes(b"half a film")
        while True:
            yield

    monkeypatch.setattr(imageio_ffmpeg, "write_frames", on_a_full_disk)
    with pytest.raises(OSError):
        record_video(tmp_path / "film.mp4", env, scenes_of(env, 1), search(env))
    assert not list(tmp_path.iterdir())


def test_a_gallery_is_a_page_of_movements(tmp_path):
    env = gym.make(TASKS[0], render_mode="rgb_array", width=96, height=96)
    titles = [f"scene {seed}" for seed in range(5)]
    path = tmp_path / "gallery.png"
    gallery(path, env, scenes_of(env, 5), search(env), titles, heading="test scenes")
    assert np.asarray(Image.open(path).convert("RGB")).std() > 5.0
