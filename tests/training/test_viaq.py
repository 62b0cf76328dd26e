"""ViaQ works as any algorithm of Stable-Baselines3: environments, seeds, saving, and training that goes on."""

import copy
import io

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from tasks import MOVING, PANDA, PLANE, REACH

from viapoint.training import ViaQ, ViaVecEnv
from viapoint.training.agents.outcome_buffer import Outcomes, outcome_of
from viapoint.training.agents.viaq_policy import ViaQPolicy
from viapoint.training.planning.baselines import agent_method
from viapoint.training.rollouts.vec_env import TERMS

FEW = {"width": 8, "instants": 8, "candidates": 32, "refinements": 1, "per_refinement": 16}
SMALL = {
    "learning_starts": 16,
    "batch_size": 8,
    "gradient_steps": 1,
    "explore_candidates": 16,
    "policy_kwargs": FEW,
}


def model_on(env, **kwargs):
    return ViaQ("ViaQPolicy", env, seed=0, **{**SMALL, **kwargs})


def weights(model):
    return torch.cat([part.detach().flatten() for part in model.policy.parameters()])


@pytest.mark.parametrize(
    "env",
    [
        PLANE,
        lambda: gym.make(PLANE),
        lambda: VecNormalize(make_vec_env(PLANE, 2), norm_obs=False),
    ],
)
def test_any_environment_of_sb3_will_do(env):
    model = model_on(env() if callable(env) else env).learn(20)
    assert model._n_updates > 0
    assert torch.isfinite(weights(model)).all()
    model.get_env().close()


def test_it_goes_on_in_other_scenes_of_its_task_only(made):
    model = model_on(made()).learn(24)
    model.set_env(made(n_obstacles=5))
    model.learn(8, reset_num_timesteps=False)
    env = model.get_env()
    others = ({"env_id": PANDA}, {"duration_range": (0.5, 2.0)}, {"timing": "learned"})
    for other in others:
        with pytest.raises(ValueError):
            model.set_env(made(**other))
        assert model.get_env() is env


@pytest.mark.parametrize(
    "settings",
    [
        {"policy_kwargs": {"candidates": 1, "refinements": 0, "width": 1, "instants": 2}},
        {"policy_kwargs": {**FEW, "per_refinement": 1, "checks": 1}},
        {"policy_kwargs": {**FEW, "checks": 10_000}},
        {"explore_uniformly": 0.0, "explore_candidates": 2, "next_candidates": 1},
        {"explore_uniformly": np.int64(1), "next_candidates": 500},
        {"gamma": 0.0},
    ],
)
@pytest.mark.parametrize("env_id", [REACH, MOVING])
def test_the_least_and_the_most_of_each_setting_can_be_learned_with(made, env_id, settings):
    env = made(env_id)
    model = model_on(env, **settings).learn(32)
    assert model._n_updates > 0
    assert torch.isfinite(weights(model)).all()
    actions = model.predict(env.reset())[0]
    assert (np.abs(actions) <= 1.0).all()


@pytest.fixture(scope="module")
def learned():
    """A model after a few updates, and what it decides on."""
    torch.set_num_threads(1)
    env = ViaVecEnv(PLANE, 8, seed=0)
    model = model_on(env, policy_kwargs={**FEW, "checks": 4}).learn(64)
    yield model, env.reset()
    env.close()


@pytest.mark.parametrize("checks", [0, 8])
def test_a_policy_that_is_saved_alone_decides_the_same(learned, checks):
    model, observation = learned
    policy, file = copy.deepcopy(model.policy), io.BytesIO()
    policy.checks = checks
    with pytest.raises(TypeError):
        model.save(file)
    policy.save(file)
    file.seek(0)
    for other in (ViaQPolicy.load(file), copy.deepcopy(policy)):
        assert other.checks == checks
        np.testing.assert_array_equal(other.predict(observation)[0], policy.predict(observation)[0])


def test_as_many_proposals_are_checked_as_one_says(learned):
    model, observation = learned
    alone, checked = (agent_method("agent", model, n).decide(observation, None) for n in (0, 48))
    assert not np.array_equal(alone, checked)
    assert model.policy.checks == 4
    own = agent_method("agent", model).decide(observation, None)
    np.testing.assert_array_equal(own, model.predict(observation)[0].astype(np.float64))


def test_the_outcome_is_known_only_where_the_terms_sum_to_the_reward():
    info = dict(zip(TERMS, (1.0, 0.0, 0.1, 0.0, -0.2, -0.3, 0.0), strict=True))
    found = Outcomes(*outcome_of(info, 0.6))
    told = (found.success, found.contact, found.clearance, found.goal_error, found.effort_terms)
    np.testing.assert_allclose(told, (1.0, 0.0, 0.1, 0.0, -0.5))
    assert np.isnan(outcome_of(info, 0.7)).all()
    assert np.isnan(outcome_of({}, 0.6)).all()


def test_refinement_solves_more_than_as_many_checks(made):
    env = made(number=64)
    model, observation = model_on(env), env.reset()
    solved = []
    for settings in ({"checks": 4}, {"refine": 4}):
        chosen = agent_method("agent", model, **{"checks": 0, **settings}).decide(observation, None)
        solved.append(env.step(chosen)[1].mean())
        observation = env.reset()
    assert solved[1] > solved[0] + 0.3
    replanning = model_on(made(MOVING))
    replanning.policy.refine = 4
    with pytest.raises(ValueError, match="refine"):
        replanning.predict(replanning.env.reset())
