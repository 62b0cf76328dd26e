"""ViaTD3 is used as any algorithm of Stable-Baselines3 is, and says what it cannot do."""

import io

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from viapoint.training.vec_env import ViaVecEnv
from viapoint.training.via_td3 import ViaTD3

ENV, ONLINE = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"
SMALL = {
    "learning_starts": 16,
    "batch_size": 8,
    "gradient_steps": 1,
    "fresh_scenes": 2,
    "policy_kwargs": {"width": 16},
}


@pytest.fixture
def made():
    """Environments that are closed at the end."""
    open_ = []

    def make(env_id=ENV, number=8, **kwargs):
        open_.append(ViaVecEnv(env_id, number, seed=0, threads=1, **kwargs))
        return open_[-1]

    yield make
    for env in open_:
        env.close()


def model_on(env, **kwargs):
    return ViaTD3("ViaPolicy", env, seed=0, **{**SMALL, **kwargs})


def weights(model):
    return torch.cat([part.detach().flatten() for part in model.policy.parameters()])


def test_it_learns_in_pieces_is_saved_and_goes_on(made, tmp_path):
    env = made()
    model = model_on(env).learn(24)
    model.learn(16, reset_num_timesteps=False)
    assert model.num_timesteps == 40
    model.save(tmp_path / "model")
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    observation = env.reset()
    one = {name: part[0] for name, part in observation.items()}
    for again in (ViaTD3.load(tmp_path / "model"), ViaTD3.load(buffer, env=env)):
        decided = again.predict(observation, deterministic=True)[0]
        np.testing.assert_array_equal(decided, model.predict(observation)[0])
        np.testing.assert_allclose(again.predict(one)[0], decided[0], atol=1e-5)
        again.set_env(env)
        assert again.learn(8, reset_num_timesteps=False).num_timesteps == 48


@pytest.mark.parametrize(
    "env",
    [
        ENV,
        lambda: gym.make(ENV, threads=1),
        lambda: make_vec_env(ENV, 2, env_kwargs={"threads": 1}),
        lambda: VecNormalize(make_vec_env(ENV, 2, env_kwargs={"threads": 1}), norm_obs=False),
    ],
)
def test_any_environment_of_sb3_will_do(env):
    model = model_on(env() if callable(env) else env).learn(20)
    assert model._n_updates > 0
    model.get_env().close()


def test_equal_seeds_give_equal_agents(made):
    one, other = (weights(model_on(made()).learn(32)) for _ in range(2))
    assert torch.equal(one, other)


def test_it_goes_on_in_other_scenes_of_its_task_only(made):
    model = model_on(made()).learn(24)
    model.set_env(made(n_obstacles=5))
    model.learn(8, reset_num_timesteps=False)
    assert model.pool._task.scenes.n_obstacles == (5, 5)
    for other, part in (
        ({"env_id": "viapoint/PlanarWholeArm-v0"}, "whole_arm"),
        ({"duration_range": (0.5, 2.0)}, "action"),
        ({"reward_weights": {"success": 2.0}}, "weights"),
    ):
        env = model.get_env()
        with pytest.raises(ValueError, match=f"must have the {part} that the agent was made for"):
            model.set_env(made(**other))
        assert model.get_env() is env
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(made("viapoint/PandaObstacles-v0"))


def test_environments_that_cannot_be_foreseen_are_refused(made):
    for env in (made("viapoint/PlanarObstaclesStep-v0"), "Pendulum-v1"):
        with pytest.raises(ValueError, match="an action is a whole movement, such as viapoint/"):
            model_on(env)
    with pytest.raises(ValueError, match="norm_obs=False"):
        model_on(VecNormalize(made()))
    with pytest.raises(ValueError, match=r"gamma must be more than 0 .+, got 0.0"):
        model_on(made(ONLINE))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("objective", "fame"),
        ("noise", -1.0),
        ("promising", 0),
        ("augment", 3),
        ("policy_kwargs", {"kept": 0}),
    ],
)
def test_settings_that_make_no_sense_are_refused(made, name, value):
    with pytest.raises(ValueError, match=r"hyperparameter .+ of viatd3 must be"):
        model_on(made(), **{name: value})


@pytest.mark.parametrize(
    "settings",
    [
        {"further": 0},
        {"others": np.int64(0)},
        {"promising": 500},
        {"policy_kwargs": {"width": 16, "heads": 1}},
        {"policy_kwargs": {"width": 16, "kept": 1, "rounds": 0, "candidates": 1}},
    ],
)
@pytest.mark.parametrize(("env_id", "gamma"), [(ENV, 0.0), (ONLINE, 0.9)])
def test_the_least_and_the_most_of_each_setting_can_be_learnt_with(made, env_id, gamma, settings):
    model = model_on(made(env_id), gamma=gamma, **settings).learn(32)
    assert model._n_updates > 0
    assert torch.isfinite(weights(model)).all()
