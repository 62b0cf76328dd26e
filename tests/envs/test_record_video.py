"""Videos of movements."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import AROUND, moved

from viapoint.envs.record_video import RecordMovements

pytest.importorskip("moviepy")
pytestmark = pytest.mark.usefixtures("quick_pictures")


def test_gymnasium_records_two_frames_of_a_movement_and_a_warning_says_so(make, tmp_path):
    env = gym.wrappers.RecordVideo(make(side=64), str(tmp_path / "videos"), episode_trigger=lambda _: True)
    with pytest.warns(UserWarning, match="RecordMovements"):
        moved(env, AROUND)
    env.close()
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == 2


def test_whole_movements_are_recorded(make, tmp_path):
    made = make(mode="rgb_array_list", side=64)
    env = RecordMovements(made, str(tmp_path / "videos"), episode_trigger=lambda _: True)
    moved(env, AROUND)
    expected = 1 + round(env.unwrapped.last_rollout.time[-1] * env.metadata["render_fps"])
    env.close()
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == expected


def test_where_a_movement_is_several_steps_each_frame_of_it_is_recorded_once(make, tmp_path):
    short = (0.4, 0.6)
    made = make("viapoint.envs:viapoint/PlanarTargetJump-v0", "rgb_array_list", side=64, duration_range=short)
    env = RecordMovements(made, str(tmp_path / "videos"), episode_trigger=lambda _: True)
    env.reset(seed=0)
    steps, over = 0, False
    while not over:
        *_, terminated, truncated, _ = env.step(np.full(env.action_space.shape, 0.3, np.float32))
        steps, over = steps + 1, terminated or truncated
    expected = 1 + round(env.unwrapped.last_rollout.time[-1] * env.metadata["render_fps"])
    env.close()
    assert steps > 1
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == pytest.approx(expected, abs=1)


def frames_of(path):
    reader = pytest.importorskip("imageio_ffmpeg").read_frames(str(path))
    next(reader)
    return sum(1 for _ in reader)
