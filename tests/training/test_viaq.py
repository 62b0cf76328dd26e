"""ViaQ works as any algorithm of Stable-Baselines3, and its policy obeys the symmetries of the task."""

import copy
import io

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from helpers import MOVING, PANDA, PLANE, REACH, SENSED, WHOLE, problem_of, scenes_of
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from viapoint.training import ViaQ, ViaVecEnv, load_agent
from viapoint.training.agents import viaq_policy
from viapoint.training.agents.agent import SAC
from viapoint.training.agents.viaq import Outcomes, outcome_of
from viapoint.training.agents.viaq_policy import ViaQPolicy
from viapoint.training.files import BadFileError
from viapoint.training.planning.baselines import agent_method
from viapoint.training.planning.candidates import sobol_actions
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.vec_env import TERMS

FEW = {"width": 8, "instants": 8, "candidates": 32, "refinements": 1, "per_refinement": 16}
SMALL = {
    "learning_starts": 16,
    "batch_size": 8,
    "gradient_steps": 1,
    "explore_candidates": 16,
    "policy_kwargs": FEW,
}


NUMBER = 12
"""Number of scenes in which policies are compared."""


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


def policy_of(task, **kwargs):
    torch.manual_seed(0)
    settings = {"width": 8, "candidates": 32, "refinements": 1, "per_refinement": 16, **kwargs}
    actions = Box(-1.0, 1.0, (task.action.size,))
    return ViaQPolicy(task.observation.space(), actions, lambda _: 1e-3, task=task.as_dict(), **settings)


@pytest.mark.parametrize("env_id", [PLANE, SENSED, MOVING])
def test_no_scenes_have_no_actions(env_id):
    agent = load_agent(env_id)
    empty = {name: np.zeros((0, *box.shape), np.float32) for name, box in agent.observation_space.items()}
    assert agent.predict(empty)[0].shape == (0, *agent.action_space.shape)


def margins(policy, problem):
    """Return the margins of 8 actions in each scene, [m]."""
    size = policy.task.action.size
    actions = np.broadcast_to(sobol_actions(8, size), (len(problem.start), 8, size))
    with torch.no_grad():
        return policy.critic(policy.inputs(problem, actions)).margin.numpy()


def with_rows(problem, rows):
    """Return a problem with some of the rows of its obstacles."""
    obstacles = problem.obstacles
    parts = {name: getattr(obstacles, name)[:, rows] for name in obstacles._fields[:5]}
    return problem._replace(obstacles=obstacles._replace(**parts))


@pytest.mark.parametrize("env_id", [WHOLE, PANDA])
def test_the_order_of_the_obstacles_is_irrelevant(env_id):
    task = registered_task(env_id)
    policy, problem = policy_of(task), problem_of(task, NUMBER)
    other = with_rows(problem, slice(None, None, -1))
    np.testing.assert_allclose(margins(policy, other), margins(policy, problem), atol=1e-5)


def test_the_margin_is_the_least_of_the_margins_from_each_obstacle():
    task = registered_task(PLANE)
    policy, problem = policy_of(task), problem_of(task, NUMBER)
    rows = range(problem.obstacles.kind.shape[1])
    alone = [margins(policy, with_rows(problem, [row])) for row in rows]
    np.testing.assert_allclose(margins(policy, problem), np.min(alone, axis=0), atol=1e-5)


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_margins_stay_when_everything_turns_about_the_base(env_id):
    task, angle = registered_task(env_id), 0.05
    problem = problem_of(task, NUMBER)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    obstacles = problem.obstacles
    moved = obstacles._replace(centre=obstacles.centre @ turn.T, rotation=turn @ obstacles.rotation)
    if task.space.of_hand:
        ends = problem.start @ turn[:2, :2].T, problem.goal @ turn[:2, :2].T
    else:
        step = angle * np.eye(problem.start.shape[1])[0]
        ends = problem.start + step, problem.goal + step
    other = problem._replace(start=ends[0], goal=ends[1], obstacles=moved)
    policy = policy_of(task)
    here, there = margins(policy, problem), margins(policy, other)
    # Plans beyond the range of the first joint are looked at only until they leave it.
    assert np.isclose(here, there, atol=1e-4).mean() > 0.95


@pytest.mark.parametrize("checks", [0, 8])
@pytest.mark.parametrize("env_id", [PLANE, WHOLE, PANDA])
def test_a_scene_is_decided_alone_as_in_a_batch(env_id, checks):
    task = registered_task(env_id)
    policy, problem = policy_of(task, checks=checks), problem_of(task, NUMBER)
    together = policy._chosen(problem)
    for scene in range(NUMBER):
        alone = policy._chosen(problem.take([scene]))
        np.testing.assert_allclose(alone[0], together[scene], atol=1e-6)


def test_it_learns_within_seconds_what_chance_does_not():
    simulation = SceneSimulation(PLANE, 256)
    scenes = scenes_of(simulation.task, 256, 10_000)
    observation = simulation.observe(scenes)
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (256, simulation.task.action.size))
    chance = simulation(scenes, random).success.mean()
    env = ViaVecEnv(PLANE, 64, seed=0)
    few = {"candidates": 128, "refinements": 1, "per_refinement": 32}
    model = ViaQ("ViaQPolicy", env, seed=0, learning_starts=512, gradient_steps=16, policy_kwargs=few)
    untrained = simulation(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    model.learn(64 * 24)
    alone = simulation(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    model.policy.checks = 16
    checked = simulation(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    assert alone > max(2.0 * chance, untrained)
    assert checked > 0.7
    env.close()
    simulation.close()


def test_a_learnt_entropy_coefficient_is_saved_and_loaded(tmp_path):
    env = ViaVecEnv(REACH, 4, seed=0)
    model = SAC("MultiInputPolicy", env, learning_starts=16, buffer_size=500, learning_rate=3e-2, seed=0)
    model.learn(100)
    model.save(tmp_path / "model")
    loaded = load_agent(tmp_path / "model", env=env)
    assert model.log_ent_coef.item() < -0.1
    assert loaded.log_ent_coef.item() == model.log_ent_coef.item()


def test_an_environment_of_another_task_is_to_blame_and_not_the_file():
    with pytest.raises(ValueError, match="env does not fit the agent") as raised:
        load_agent(PLANE, env=ViaVecEnv(PLANE, 2, n_via=2))
    assert not isinstance(raised.value, BadFileError)


def test_refined_candidates_are_apart_from_each_other(monkeypatch):
    refined = []

    def refine(task, problem, actions):
        refined.append(actions)
        return actions

    monkeypatch.setattr(viaq_policy, "refined_actions", refine)
    agent = load_agent(PLANE)
    agent.policy.refine = 4
    problem = problem_of(agent.policy.task, 16)
    agent.policy._chosen(problem)
    vias = refined[0][..., :2]
    distance = np.linalg.norm(vias[:, :, None] - vias[:, None], axis=-1)
    assert distance[:, ~np.eye(4, dtype=bool)].min() >= viaq_policy.APART
    actions, values = agent.policy.propose(problem)
    best = actions[np.arange(16), values.argmax(axis=1)]
    np.testing.assert_array_equal(refined[0][:, 0], best)


def test_one_of_many_good_plans_out_of_reach_is_not_taken():
    """In these scenes, the plans around the best one are out of reach, as it is."""
    agent = load_agent(PLANE)
    agent.policy.refinements = 4
    scenes = scenes_of(agent.policy.task, 175, seed=78).take([103, 114, 174])
    simulation = SceneSimulation(PLANE, 3)
    actions = agent.predict(simulation.observe(scenes))[0]
    assert (simulation(scenes, actions).info["duration"] > 0.0).all()
