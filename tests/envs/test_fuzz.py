"""Whatever is asked, an environment does it or says why not; and broken physics ends an episode and no more."""

import gymnasium as gym
import numpy as np
import pytest
import reliability_fuzz as fuzz


@pytest.fixture(params=fuzz.IDS)
def env_id(request):
    return request.param


@pytest.mark.parametrize(
    "kind", [fuzz.fuzz_actions, fuzz.fuzz_scenes, fuzz.fuzz_calls], ids=lambda kind: kind.__name__
)
def test_nothing_but_documented_errors_and_finite_numbers(env_id, kind):
    number = {"fuzz_actions": 120, "fuzz_scenes": 24, "fuzz_calls": 40}[kind.__name__]
    found = kind(env_id, number, seed=3, **({"num_envs": 60} if kind is fuzz.fuzz_actions else {}))
    assert sum(found.values()) >= number
    assert "refused without a reason" not in found
    if kind is fuzz.fuzz_scenes:
        assert min(found["played"], found["refused"]) > 2  # both sides of the border are tried


@pytest.mark.parametrize("broken", [1e9, np.nan])
def test_broken_physics_ends_its_episode_alone(env_id, broken, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it stands
    env = gym.make_vec(env_id, num_envs=3, threads=1)
    actions = np.zeros(env.action_space.shape)
    results = []
    for spoilt in (False, True):
        env.reset(seed=4)
        if spoilt:
            env.unwrapped._simulator.batch.bind("qvel")[1] = broken
        results.append(env.step(actions))
        fuzz.check(env, results[-1][0], results[-1][1], results[-1][4])
    (_, whole, *_, before), (_, reward, terminated, _, info) = results
    assert list(info["unstable"]) == [False, True, False]
    assert not before["unstable"].any()
    assert terminated[1]
    assert not info["is_success"][1]
    np.testing.assert_array_equal(reward[[0, 2]], whole[[0, 2]])
    _, _, _, _, after = env.step(actions)
    assert not after["unstable"].any()  # the next episode is sound
