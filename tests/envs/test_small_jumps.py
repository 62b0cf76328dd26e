"""A target that moves a little changes the default plan a little."""

import gymnasium as gym
import numpy as np
import pytest

import viapoint.envs  # noqa: F401


def outcome(when, shift):
    env = gym.make("viapoint/PlanarTargetJump-v0")
    env.reset(
        seed=0, options={"start": (-0.2, 0.35), "goal": (0.1, 0.4), "jumps": [(when, 0.1 + shift, 0.4)]}
    )
    done = False
    while not done:
        *_, done, _, info = env.step(np.zeros(3, np.float32))
    return info


@pytest.mark.parametrize("when", [0.2, 0.4, 0.7])
def test_a_small_jump_neither_restarts_nor_spoils_the_movement(when):
    same = outcome(when, 0.0)
    last = same["time"]
    for shift in (1e-9, 1e-6, 1e-4, 5e-3, 0.019, 0.021):
        info = outcome(when, shift)
        assert info["is_success"]
        assert info["time"] >= last - 0.01
        last = info["time"]
        if shift <= 1e-4:
            assert info["time"] < 1.05 * same["time"]
            assert info["jerk_ratio"] < 1.5 * same["jerk_ratio"]
