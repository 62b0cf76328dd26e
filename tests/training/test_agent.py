"""Laws of the policy: obstacles are a set, scenes are decided one by one, and checks never make a plan worse."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from tasks import MOVING, PANDA, PLANE, REACH, SENSED, WHOLE, problem_of, scenes_of

from viapoint.training import ViaQ, ViaVecEnv, load_agent
from viapoint.training.agents.agent import SAC
from viapoint.training.agents.viaq_policy import ViaQPolicy
from viapoint.training.io.files import BadFileError
from viapoint.training.planning.candidates import sobol_actions
from viapoint.training.planning.search import registered_task
from viapoint.training.rollouts.rollout import SceneSimulation

NUMBER = 12
"""Number of scenes."""


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


def test_it_takes_the_candidate_of_the_greatest_value_and_the_first_candidate_is_zero():
    task = registered_task(PLANE)
    policy, problem = policy_of(task), problem_of(task, NUMBER)
    actions, values = policy.propose(problem)
    assert (actions[:, 0] == 0.0).all()
    np.testing.assert_array_equal(policy._chosen(problem), actions[np.arange(NUMBER), values.argmax(axis=1)])


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
