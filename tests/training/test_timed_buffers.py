"""Decisions of different length: what comes after one counts gamma to the power of its time."""

import copy
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

from viapoint.envs.reach_step import StepReachVectorEnv
from viapoint.training.config import TrainConfig
from viapoint.training.discount import TimeDiscount
from viapoint.training.files import BadFileError, read_arrays, read_json
from viapoint.training.model_files import load_model
from viapoint.training.runs import Run
from viapoint.training.timed_buffers import (
    TellElapsed,
    TimedDictReplayBuffer,
    TimedReplayBuffer,
    TimedRolloutBuffer,
    timed,
    unit_of,
)
from viapoint.training.train import train
from viapoint.training.vec_env import ViaVecEnv

GAMMA, UNIT = 0.7, 0.2
SECONDS = np.array([0.1, 0.6, 0.25, 0.4])
"""Of the decisions of the chain."""
PAID = np.array([0.5, 0.0, -0.2, 1.0])
BOX = spaces.Box(-1.0, 1.0, (3,), np.float32)
ACTION = spaces.Box(-1.0, 1.0, (1,), np.float32)


class Chain(gym.Env):
    """Four decisions, of different length whatever is decided; observes which is next."""

    observation_space = spaces.Box(0.0, 1.0, (len(PAID),), np.float32)
    action_space = ACTION

    def __init__(self, key="elapsed", cut=None):
        self.key, self.cut = key, cut

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self._observed(), {}

    def step(self, action):
        here, self.place = self.place, self.place + 1
        info = {self.key: SECONDS[here]} if self.key else {}
        return self._observed(), PAID[here], self.place == len(PAID), self.place == self.cut, info

    def _observed(self):
        return np.eye(len(PAID), dtype=np.float32)[min(self.place, len(PAID) - 1)]


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
    by_time = timed(kind, env.observation_space, gamma=GAMMA, unit=UNIT, key=key or "elapsed")
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
    found = learned(PPO, 1024, callback=TellElapsed(), vf_coef=1.0, max_grad_norm=10.0, **ON)
    np.testing.assert_allclose(found, worth(), atol=0.05)


@pytest.mark.parametrize("gamma", [GAMMA, 1.0])
def test_what_an_episode_is_cut_off_from_is_discounted_by_time(gamma):
    """The value after the cut is a constant of the critic: what SB3 adds with gamma counts by time."""
    env = DummyVecEnv([lambda: Chain(cut=3)])
    model = PPO("MlpPolicy", env, gamma=gamma, gae_lambda=1.0, n_steps=3, batch_size=3, n_epochs=1,
                learning_rate=1e-12, **timed(PPO, env.observation_space, gamma=gamma, unit=UNIT))  # fmt: skip
    model.learn(3, callback=TellElapsed())
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
    with pytest.raises(ValueError, match="TellElapsed"):
        learned(PPO, 64, **ON)


@pytest.mark.parametrize("kind", [SAC, PPO])
def test_an_environment_that_does_not_tell_is_refused(kind):
    with pytest.raises(ValueError, match="environment 0 has"):
        learned(kind, 64, key=None, callback=TellElapsed(), **(ON if kind is PPO else OFF))


class Uneven(StepReachVectorEnv):
    """Steps that are said to have taken as long as the hand has moved."""

    def decide(self, actions):
        decision = super().decide(actions)
        return decision._replace(info={**decision.info, "elapsed": 0.04 + decision.info["path_length"]})


STEP = "viapoint/PlanarObstaclesStep-v0"


@pytest.fixture
def uneven(monkeypatch):
    """The step-wise environment by its id, telling the time of each step."""
    monkeypatch.setattr(gym.spec(STEP), "vector_entry_point", Uneven)


def config(folder, algo, **changes):
    hyperparameters = {
        "sac": {"learning_starts": 32, "gradient_steps": 1, "batch_size": 16, "buffer_size": 96},
        "ppo": {"n_steps": 2, "batch_size": 16, "n_epochs": 2},
    }
    values = {
        "out": folder, "env": STEP, "algo": algo, "n_timesteps": 160, "n_envs": 16, "eval_every": 0,
        "checkpoint_every": 64, "env_kwargs": {"threads": 1, "n_obstacles": 1},
        "hyperparameters": hyperparameters[algo], "discount_unit": 0.1, "progress": False,
    }  # fmt: skip
    return TrainConfig(**{**values, **changes})


def test_every_info_of_the_vector_environment_tells_the_time(uneven):
    env = ViaVecEnv(STEP, 6, seed=0, threads=1)
    env.reset()
    ended = 0
    for _ in range(40):
        *_, done, infos = env.step(np.full((6, 2), 0.9, np.float32))
        assert all(info["elapsed"] >= 0.04 for info in infos)
        assert all(("episode" in info) == over for info, over in zip(infos, done, strict=True))
        ended += done.sum()
    assert ended
    env.close()


class Midway(Chain):
    """Begins anywhere but at the end, so that copies end at different times."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(3))
        return self._observed(), {}


def test_single_environments_tell_the_time_of_their_last_step_too():
    gym.register("test/Midway-v0", entry_point=Midway)
    env = ViaVecEnv("test/Midway-v0", 5, seed=0)
    observed = env.reset()
    mixed = 0
    for _ in range(20):
        expected = SECONDS[observed.argmax(axis=-1)]
        observed, _, done, infos = env.step(np.zeros((5, 1)))
        assert [info["elapsed"] for info in infos] == expected.tolist()
        mixed += 0 < done.sum() < 5
    assert mixed
    env.close()
    del gym.registry["test/Midway-v0"]


@pytest.mark.parametrize("algo", ["sac", "ppo"])
def test_a_run_that_discounts_by_time_resumes_bit_for_bit(algo, uneven, tmp_path, monkeypatch):
    whole = train(config(tmp_path / "whole", algo))
    other = train(config(tmp_path / "other", algo, discount_unit=0.3))
    with monkeypatch.context() as patch:
        step, left = ViaVecEnv.step_wait, iter(range(7))

        def mortal(self):
            if next(left, None) is None:
                raise SystemError("killed")
            return step(self)

        patch.setattr(ViaVecEnv, "step_wait", mortal)
        with pytest.raises(SystemError, match="killed"):
            train(config(tmp_path / "killed", algo))
    resumed = train(TrainConfig(out=tmp_path / "killed", resume=True, progress=False))
    tensors = [read_arrays(run.checkpoints()[-1] / "tensors.safetensors") for run in (whole, resumed, other)]
    assert set(tensors[0]) == set(tensors[1])
    for name, tensor in tensors[0].items():
        np.testing.assert_array_equal(tensor, tensors[1][name], err_msg=name)
    if algo == "sac":
        discounts = tensors[0]["buffer/arrays/discounts"]
        assert len(np.unique(discounts)) > 10
    weights = [read_arrays(run.folder / "final" / "weights.safetensors") for run in (whole, other)]
    assert any((weights[0][name] != weights[1][name]).any() for name in weights[0])


def test_models_and_checkpoints_know_their_unit(uneven, tmp_path):
    run = train(config(tmp_path / "run", "sac"))
    assert Run(run.folder).config.discount_unit == 0.1
    assert read_json(run.folder / "final" / "model.json")["discount_unit"] == 0.1
    assert unit_of(load_model(run.folder / "final")) == 0.1
    path = run.folder / "config.json"
    path.write_text(path.read_text().replace('"discount_unit": 0.1', '"discount_unit": 0.2'))
    with pytest.raises(BadFileError, match=r"discount_unit was 0\.1, is 0\.2"):
        train(TrainConfig(out=run.folder, resume=True, n_timesteps=320, progress=False))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"discount_unit": 0.0}, "discount_unit must be a positive number of seconds, got 0.0"),
        ({"env": "viapoint/PlanarObstacles-v0", "algo": "viatd3"}, "must be None for viatd3"),
    ],
)
def test_the_configuration_refuses_what_cannot_be_meant(changes, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        TrainConfig(**{"env": STEP, "algo": "sac", "discount_unit": 0.1, **changes})


def test_n_steps_and_time_are_refused_together(uneven, tmp_path):
    with pytest.raises(ValueError, match="n_steps must be 1"):
        train(config(tmp_path, "sac", hyperparameters={"n_steps": 3}))


def test_the_example_of_the_page_runs():
    page = (Path(__file__).parents[2] / "docs" / "discount.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(example, names)
    assert issubclass(names["by_time"]["rollout_buffer_class"], TimedRolloutBuffer)
