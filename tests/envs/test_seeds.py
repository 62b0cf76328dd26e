"""The seed that Gymnasium tells is that of the running episode, and `np_random` is what it is drawn from."""

import gymnasium as gym
import numpy as np
import pytest

import viapoint.envs

assert viapoint.envs, "importing it registers the environments"

IDS = ("viapoint/PlanarObstacles-v0", "viapoint/PlanarObstaclesStep-v0", "viapoint/PlanarMovingObstacles-v0")
"""One of each kind."""


@pytest.fixture(params=IDS)
def env_id(request):
    return request.param


def same(one, other):
    return all(np.array_equal(one[name], other[name]) for name in one)


def test_an_episode_without_a_seed_can_be_had_again(env_id):
    for looked in (False, True):
        env = gym.make(env_id).unwrapped
        known = env.np_random_seed if looked else None  # asking for it draws one
        seen, _ = env.reset()
        seed = env.np_random_seed
        assert seed is not None
        assert known in (None, seed)
        assert env.np_random is env.batch.np_random
        assert same(gym.make(env_id).reset(seed=seed)[0], seen)
    batch = gym.make_vec(env_id, num_envs=2, threads=1).unwrapped
    seen, _ = batch.reset()
    again, _ = gym.make_vec(env_id, num_envs=2, threads=1).reset(seed=[batch.np_random_seed, None])
    assert same(
        {name: part[0] for name, part in seen.items()}, {name: part[0] for name, part in again.items()}
    )


def test_a_generator_that_is_set_is_used(env_id):
    wanted, _ = gym.make(env_id).reset(seed=7)
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1).unwrapped):
        for begun in (False, True):
            if begun:
                env.reset(seed=1)
            env.np_random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(7)))
            assert env.np_random_seed == -1
            seen, _ = env.reset()
            if hasattr(env, "num_envs"):
                seen = {name: part[0] for name, part in seen.items()}
            assert same(wanted, seen)


def test_the_seed_told_is_of_an_environment_that_was_reset(env_id):
    env = gym.make_vec(env_id, num_envs=3, threads=1).unwrapped
    env.reset(seed=5)
    assert env.np_random_seed == 5
    second, first = np.array([False, True, False]), np.array([True, False, False])
    env.reset(seed=[11, 12, 13], options={"reset_mask": second})
    assert env.np_random_seed == 5
    env.reset(seed=[None, 12, 13])
    assert env.np_random_seed == 5  # the same generator goes on
    env.reset(seed=[11, 12, 13], options={"reset_mask": first})
    assert env.np_random_seed == 11
    with pytest.raises(ValueError):
        env.reset(seed=21, options={"start": (5.0, 5.0)})
    assert env.np_random_seed == 11


@pytest.mark.parametrize("kind", [np.int64, np.array, lambda seed: [seed], lambda seed: np.array([seed])])
def test_a_seed_is_any_whole_number(env_id, kind):
    env = gym.make(env_id).unwrapped
    wanted, _ = env.reset(seed=7)
    assert same(wanted, env.reset(seed=kind(7))[0])
