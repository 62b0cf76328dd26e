"""Videos of movements."""

import gymnasium as gym
import pytest
from episodes import AROUND, JUMP, OBSTACLES, moved, play

from viapoint.envs.env import RecordMovements

pytest.importorskip("moviepy")
pytestmark = pytest.mark.usefixtures("quick_pictures")


@pytest.mark.parametrize("env_id", [OBSTACLES, JUMP])
def test_each_frame_of_a_movement_of_one_or_several_steps_is_recorded_once(env_id, make, tmp_path):
    made = make(f"viapoint.envs:{env_id}", "rgb_array_list", side=64, duration_range=(0.4, 0.6))
    env = RecordMovements(made, str(tmp_path / "videos"), episode_trigger=lambda _: True)
    env.reset(seed=0)
    steps = len(play(env, 0.3))
    expected = 1 + round(env.unwrapped.last_rollout.time[-1] * env.metadata["render_fps"])
    env.close()
    assert (steps > 1) == (env_id == JUMP)
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == pytest.approx(expected, abs=1)


def frames_of(path):
    reader = pytest.importorskip("imageio_ffmpeg").read_frames(str(path))
    next(reader)
    return sum(1 for _ in reader)


def test_gymnasium_records_two_frames_of_a_movement_and_a_warning_says_so(make, tmp_path):
    env = gym.wrappers.RecordVideo(make(side=64), str(tmp_path / "videos"), episode_trigger=lambda _: True)
    with pytest.warns(UserWarning, match="RecordMovements"):
        moved(env, AROUND)
    env.close()
    assert frames_of(tmp_path / "videos" / "rl-video-episode-0.mp4") == 2
