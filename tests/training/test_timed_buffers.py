"""Decisions of different length: what comes after one counts gamma to the power of its time."""

import copy
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from decision_chain import ACTION, BOX, PAID, SECONDS, Chain
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

from viapoint.training.algorithms.smdp_buffers import (
    ElapsedTimeCallback,
    TimedDictReplayBuffer,
    TimedReplayBuffer,
    TimedRolloutBuffer,
    time_discount,
)
from viapoint.training.config.discount import TimeDiscount

GAMMA, UNIT = 0.7, 0.2


def worth(paid=PAID, seconds=SECONDS, after=0.0):
    """Value before each decision, in closed form."""
    time = np.concatenate(([0.0], np.cumsum(seconds)))
    return np.array(
        [
            sum(r * GAMMA ** ((time[j] - time[k]) / UNIT) for j, r in enumerate(paid) if j >= k)
            + after * GAMMA ** ((time[-1] - time[k]) / UNIT)
            for k in range(len(paid))
        ]
    )


def filled(kind, space=BOX, number=40, n_envs=3, seed=0, elapsed=None, **kwargs):
    """A replay buffer, the times of its decisions and its rewards; these are all different."""
    generator = np.random.default_rng(seed)
    buffer = kind(number * n_envs, space, ACTION, n_envs=n_envs, **kwargs)
    if elapsed is None:
        elapsed = generator.uniform(0.0, 1.0, (number, n_envs))
    reward = generator.permutation(number * n_envs).reshape(number, n_envs).astype(np.float32)
    for times, pay in zip(elapsed, reward, strict=True):
        observations = [
            {name: generator.uniform(-1, 1, (n_envs, 3)) for name in space.spaces}
            if isinstance(space, spaces.Dict)
            else generator.uniform(-1, 1, (n_envs, 3))
            for _ in range(2)
        ]
        done = generator.random(n_envs) < 0.2
        infos = [
            {"elapsed": each, "TimeLimit.truncated": bool(i % 2 and over)}
            for i, (each, over) in enumerate(zip(times, done, strict=True))
        ]
        buffer.add(*observations, generator.uniform(-1, 1, (n_envs, 1)), pay, done, infos)
    return buffer, elapsed, reward


@pytest.mark.parametrize(
    ("kind", "space"),
    [(TimedReplayBuffer, BOX), (TimedDictReplayBuffer, spaces.Dict({"hand": BOX, "goal": BOX}))],
)
def test_each_sample_has_the_discount_of_its_own_time(kind, space):
    buffer, elapsed, reward = filled(kind, space, gamma=GAMMA, unit=UNIT)
    sample = buffer.sample(500)
    time = dict(zip(reward.ravel().tolist(), elapsed.ravel().tolist(), strict=True))
    expected = [GAMMA ** (time[each] / UNIT) for each in sample.rewards[:, 0].tolist()]
    np.testing.assert_allclose(sample.discounts[:, 0], expected, rtol=1e-6)
    assert len(set(expected)) > 90


def test_a_decision_of_one_unit_is_discounted_as_ever():
    one = np.full((40, 3), UNIT)
    mine, _, _ = filled(TimedReplayBuffer, elapsed=one, gamma=GAMMA, unit=UNIT)
    plain, _, _ = filled(ReplayBuffer, elapsed=one)
    samples = []
    for buffer in (mine, plain):
        np.random.seed(1)  # noqa: NPY002
        samples.append(buffer.sample(64))
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert torch.equal(getattr(samples[0], name), getattr(samples[1], name)), name
    assert torch.equal(samples[0].discounts, torch.full((64, 1), GAMMA))


def rollout(buffer, elapsed, reward, starts, value):
    for k in range(len(reward)):
        if isinstance(buffer, TimedRolloutBuffer):
            buffer.tell([{"elapsed": each} for each in elapsed[k]], reward[k])
        n_envs = reward.shape[1]
        buffer.add(
            np.zeros((n_envs, 3)),
            np.zeros((n_envs, 1)),
            reward[k].copy(),
            starts[k],
            value[k],
            torch.zeros(n_envs),
        )


def drawn(seed, steps=7, n_envs=5):
    generator = np.random.default_rng(seed)
    elapsed = generator.uniform(0.02, 0.9, (steps, n_envs))
    reward, value = generator.normal(size=(2, steps, n_envs)).astype(np.float32)
    starts = (generator.random((steps + 1, n_envs)) < 0.3).astype(np.float32)
    return elapsed, reward, starts, torch.from_numpy(value), generator.normal(size=n_envs).astype(np.float32)


@pytest.mark.parametrize("seed", range(5))
def test_the_returns_of_whole_episodes_are_the_closed_form(seed):
    elapsed, reward, starts, value, last = drawn(seed)
    buffer = TimedRolloutBuffer(7, BOX, ACTION, gae_lambda=1.0, gamma=GAMMA, n_envs=5, unit=UNIT)
    rollout(buffer, elapsed, reward, starts, value)
    buffer.compute_returns_and_advantage(torch.from_numpy(last), starts[-1].astype(bool))
    for env in range(5):
        ends = [*(np.flatnonzero(starts[1:, env]) + 1), 7]
        begin = 0
        for end in ends:
            after = last[env] if end == 7 and not starts[7, env] else 0.0
            expected = worth(reward[begin:end, env], elapsed[begin:end, env], after)
            np.testing.assert_allclose(buffer.returns[begin:end, env], expected, atol=2e-5)
            begin = end
    np.testing.assert_allclose(buffer.advantages, buffer.returns - value.numpy(), atol=1e-6)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.6, 0.95])
def test_advantages_of_unit_decisions_are_those_of_the_plain_buffer(gae_lambda):
    elapsed, reward, starts, value, last = drawn(9)
    settings = {"gae_lambda": gae_lambda, "gamma": GAMMA, "n_envs": 5}
    mine = TimedRolloutBuffer(7, BOX, ACTION, unit=UNIT, **settings)
    plain = RolloutBuffer(7, BOX, ACTION, **settings)
    for buffer in (mine, plain):
        rollout(buffer, np.full_like(elapsed, UNIT), reward, starts, value)
        buffer.compute_returns_and_advantage(torch.from_numpy(last), starts[-1].astype(bool))
    np.testing.assert_allclose(mine.advantages, plain.advantages, atol=1e-5)


def test_a_wait_is_worth_the_same_however_finely_it_is_cut():
    values = []
    for cuts in (1, 2, 7):
        seconds = np.concatenate((np.full(cuts, 0.84 / cuts), [0.3]))[:, None]
        reward = np.zeros((cuts + 1, 1), np.float32)
        reward[-1] = 1.0
        buffer = TimedRolloutBuffer(cuts + 1, BOX, ACTION, gae_lambda=1.0, gamma=GAMMA, unit=UNIT)
        rollout(buffer, seconds, reward, np.zeros((cuts + 1, 1), np.float32), torch.zeros(cuts + 1, 1))
        buffer.compute_returns_and_advantage(torch.zeros(1), np.array([True]))
        values.append(buffer.returns[0, 0])
    np.testing.assert_allclose(values, GAMMA ** (0.84 / UNIT), rtol=1e-6)


def test_infos_that_do_not_tell_are_refused_by_name():
    discount = TimeDiscount(gamma=GAMMA, unit=UNIT)
    with pytest.raises(ValueError, match="'elapsed'; that of environment 1 has time"):
        discount.of([{"elapsed": 1.0}, {"time": 1.0}])
    for bad in (-0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match="finite and not negative"):
            discount.of([{"elapsed": bad}])
    for gamma in (0.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="gamma"):
            TimeDiscount(gamma=gamma, unit=UNIT)
    for unit in (0.0, -1.0, np.nan, np.inf, True, "1"):
        with pytest.raises(ValueError, match="unit"):
            TimeDiscount(gamma=GAMMA, unit=unit)
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        TimedReplayBuffer(9, BOX, ACTION, gamma=GAMMA, unit=UNIT, optimize_memory_usage=True,
                          handle_timeout_termination=False)  # fmt: skip


def learned(kind, steps, *, key="elapsed", cut=None, callback=None, **settings):
    """Values of the chain's four places after training, and the model."""
    env = DummyVecEnv([lambda: Chain(key, cut)] * 2)
    by_time = time_discount(kind, env.observation_space, gamma=GAMMA, unit=UNIT, key=key or "elapsed")
    model = kind("MlpPolicy", env, gamma=GAMMA, seed=0, device="cpu", **by_time, **copy.deepcopy(settings))
    model.learn(steps, callback=callback)
    places = torch.eye(len(PAID))
    with torch.no_grad():
        if kind is PPO:
            return model.policy.predict_values(places)[:, 0].numpy()
        values = model.critic(places, model.actor(places))
        return (values.mean(dim=(1, 2)) if kind is TQC else values[0][:, 0]).numpy()


NETWORK = {"net_arch": [32]}
OFF = {
    "learning_starts": 40, "learning_rate": 1e-2, "batch_size": 64, "tau": 0.5, "gradient_steps": 2, "buffer_size": 400,
    "policy_kwargs": NETWORK,
}  # fmt: skip
ON = {"n_steps": 32, "batch_size": 32, "n_epochs": 10, "learning_rate": 1e-2, "policy_kwargs": NETWORK}


@pytest.mark.parametrize("kind", [SAC, TD3, TQC])
def test_critics_converge_to_the_values_of_the_chain(kind):
    """A fixed key of one's own serves as well; without the discount by time values would be others."""
    settings = OFF if kind is TD3 else {**OFF, "ent_coef": 0.0}
    if kind is TQC:
        settings = {**settings, "top_quantiles_to_drop_per_net": 0}
        settings["policy_kwargs"] = {**NETWORK, "n_quantiles": 5, "n_critics": 1}
    found = learned(kind, 500, key="took", **settings)
    np.testing.assert_allclose(found, worth(), atol=0.05)
    by_decision = worth(seconds=np.full(4, UNIT))
    assert abs(worth() - by_decision).max() > 0.15


def test_ppo_converges_to_the_values_of_the_chain():
    found = learned(PPO, 1024, callback=ElapsedTimeCallback(), vf_coef=1.0, max_grad_norm=10.0, **ON)
    np.testing.assert_allclose(found, worth(), atol=0.05)


@pytest.mark.parametrize("gamma", [GAMMA, 1.0])
def test_what_an_episode_is_cut_off_from_is_discounted_by_time(gamma):
    """The value after the cut is a constant of the critic: what SB3 adds with gamma counts by time."""
    env = DummyVecEnv([lambda: Chain(cut=3)])
    model = PPO("MlpPolicy", env, gamma=gamma, gae_lambda=1.0, n_steps=3, batch_size=3, n_epochs=1,
                learning_rate=1e-12, **time_discount(PPO, env.observation_space, gamma=gamma, unit=UNIT))  # fmt: skip
    model.learn(3, callback=ElapsedTimeCallback())
    with torch.no_grad():
        after = float(model.policy.predict_values(torch.eye(4)[3:4]))
    time = np.concatenate(([0.0], np.cumsum(SECONDS[:3])))
    expected = [
        sum(PAID[j] * gamma ** ((time[j] - time[k]) / UNIT) for j in range(k, 3))
        + after * gamma ** ((time[3] - time[k]) / UNIT)
        for k in range(3)
    ]
    np.testing.assert_allclose(model.rollout_buffer.returns.ravel(), expected, atol=1e-5)


def test_ppo_without_the_callback_is_told_so():
    with pytest.raises(ValueError, match="ElapsedTimeCallback"):
        learned(PPO, 64, **ON)


@pytest.mark.parametrize("kind", [SAC, PPO])
def test_an_environment_that_does_not_tell_is_refused(kind):
    with pytest.raises(ValueError, match="environment 0 has"):
        learned(kind, 64, key=None, callback=ElapsedTimeCallback(), **(ON if kind is PPO else OFF))


def test_the_example_of_the_page_runs():
    page = (Path(__file__).parents[2] / "docs" / "discount.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(example, names)
    assert issubclass(names["by_time"]["rollout_buffer_class"], TimedRolloutBuffer)
