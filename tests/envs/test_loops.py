"""Loops of others: Gymnasium's autoreset modes, and processes that are forked."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from episodes import MOVING, OBSTACLES, STEP, same
from gymnasium.vector import AutoresetMode


@pytest.mark.parametrize("env_id", [OBSTACLES, STEP, MOVING])
@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_the_native_batch_is_gymnasiums_in_each_mode(env_id, mode):
    """Observations, rewards, ends and infos are those of Gymnasium's own vector environment, step by step."""
    mine = gym.make_vec(env_id, num_envs=3, autoreset_mode=mode)
    assert mine.metadata["autoreset_mode"] is AutoresetMode(mode)
    theirs = gym.vector.SyncVectorEnv([lambda: gym.make(env_id)] * 3, autoreset_mode=AutoresetMode(mode))
    first, second = mine.reset(seed=1)[0], theirs.reset(seed=1)[0]
    same(first, second)
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(8 if env_id != STEP else 50):
        actions = rng.uniform(-1.0, 1.0, mine.action_space.shape).astype(np.float32)
        one, other = mine.step(actions), theirs.step(actions)
        same(one[0], other[0])
        for k in (1, 2, 3):
            np.testing.assert_array_equal(one[k], other[k])
        over = one[2] | one[3]
        ends += over.sum()
        same_infos(one[4], other[4])
        if mode == "Disabled" and over.any():
            with pytest.raises(gym.error.ResetNeeded):
                mine.step(actions)
            options = {"reset_mask": over}
            same(mine.reset(options=dict(options))[0], theirs.reset(options=dict(options))[0])
    assert ends >= 2


def same_infos(mine, theirs):
    """Check that the infos of two batches are equal where Gymnasium says that they hold something."""
    for name, mask in theirs.items():
        if not name.startswith("_"):
            continue
        # With same-step autoreset, the metrics of an episode that ended are at the top level, too.
        assert mine.get(name, np.zeros_like(mask))[mask].all(), name
        one, other = mine[name[1:]], theirs[name[1:]]
        if isinstance(other, dict):
            same_infos(one, other)
        elif other.dtype == object:
            for a, b in zip(one[mask], other[mask], strict=True):
                same(a, b)
        else:
            np.testing.assert_array_equal(one[mask], other[mask], err_msg=name)


FORKED = """
import os, signal
import gymnasium as gym
envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=16, threads=2)
envs.reset(seed=0)
envs.step(envs.action_space.sample())
child = os.fork()
if not child:
    signal.alarm(60)  # ends the child where it waits for threads that it does not have
    envs.step(envs.action_space.sample())
    os._exit(0)
raise SystemExit(os.waitpid(child, 0)[1])
"""


def test_a_forked_process_goes_on_with_the_environments_of_its_parent():
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], check=True)
