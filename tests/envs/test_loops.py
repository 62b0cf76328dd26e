"""The batch in loops that people have: Gymnasium's autoreset modes and wrappers."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import JUMP, MOVING, OBSTACLES, STEP, same
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

MODES = ("SameStep", "NextStep", "Disabled")


def zeros(env):
    return np.zeros(env.action_space.shape, np.float32)


def native(env_id=OBSTACLES, mode="NextStep", number=3, **kwargs):
    env = gym.make_vec(env_id, num_envs=number, autoreset_mode=mode, **kwargs)
    assert env.metadata["autoreset_mode"] is AutoresetMode(mode)
    return env


@pytest.mark.parametrize("env_id", [OBSTACLES, STEP, MOVING])
@pytest.mark.parametrize("mode", MODES)
def test_the_native_batch_is_gymnasiums_in_each_mode(env_id, mode):
    """Observations, rewards, ends and infos are those of Gymnasium's own vector environment, step by step."""
    mine = native(env_id, mode)
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


@pytest.mark.parametrize("env_id", [OBSTACLES, JUMP])
def test_without_autoreset_an_episode_that_is_over_needs_a_reset(env_id):
    env = native(env_id, "Disabled")
    env.reset(seed=0)
    over = np.zeros(3, bool)
    while not over.any():
        _, _, terminated, truncated, _ = env.step(zeros(env))
        over = terminated | truncated
    with pytest.raises(gym.error.ResetNeeded):
        env.step(zeros(env))
    env.reset(options={"reset_mask": over})
    env.step(zeros(env))


@pytest.mark.parametrize("mode", MODES)
def test_wrappers_take_the_native_batch_and_returns_are_sums_of_rewards(mode):
    """Gymnasium defines those of observations for two of the modes."""
    env = wrappers.RecordEpisodeStatistics(native(JUMP, mode))
    if mode != "SameStep":
        env = wrappers.FlattenObservation(env)
    if mode == "NextStep":
        env = wrappers.NormalizeObservation(env)
    env.reset(seed=0)
    total, over = np.zeros(3), np.zeros(3, bool)
    while not over.any():
        seen, reward, terminated, truncated, info = env.step(zeros(env))
        assert mode == "SameStep" or np.isfinite(seen).all()
        total += reward
        over = terminated | truncated
    found = info["episode"]["r"] if "episode" in info else info["final_info"]["episode"]["r"]
    np.testing.assert_allclose(found[over], total[over])
