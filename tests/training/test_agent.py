"""Laws of the agent: its critic is a minimum over obstacles that are a set, it takes the best plan, and it learns."""

import json

import numpy as np
import pytest
import torch

from viapoint.envs.arms import ARMS
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.agents.viaq import ViaQ
from viapoint.training.agents.viaq_policy import ViaQPolicy
from viapoint.training.planning.candidates import sobol_actions
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.rollouts.vec_env import ViaVecEnv

IDS = (
    "viapoint/PlanarReach-v0",
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArm-v0",
    "viapoint/PandaObstacles-v0",
)


@pytest.fixture(scope="module", params=IDS)
def simulation(request):
    simulation = SceneSimulation(request.param, 64)
    yield simulation
    simulation.close()


def scenes_of(simulation, number=16, seed=0):
    return simulation.task.sampler()([np.random.default_rng(seed + i) for i in range(number)])


def policy_for(simulation, **kwargs):
    torch.manual_seed(0)
    env = next(iter(simulation._envs.values()))
    settings = {"width": 8, "candidates": 32, "refinements": 1, "per_refinement": 16, **kwargs}
    return ViaQPolicy(
        env.single_observation_space,
        env.single_action_space,
        lambda _: 1e-3,
        task=simulation.task.as_dict(),
        **settings,
    )


def margins(policy, observation):
    """Margin of 8 actions in each scene, [m]."""
    size = policy.task.action.size
    actions = np.broadcast_to(sobol_actions(8, size), (len(observation["hand"]), 8, size))
    with torch.no_grad():
        return policy.critic(policy.inputs(observation, actions)).margin.numpy()


def test_the_order_of_the_obstacles_is_irrelevant(simulation):
    scenes = scenes_of(simulation)
    if not scenes.obstacles.shape[1]:
        pytest.skip("there are no obstacles in this task")
    policy = policy_for(simulation)
    turned_over = Scenes(scenes.start, scenes.goal, scenes.obstacles[:, ::-1])
    one, other = (margins(policy, simulation.observe(each)) for each in (scenes, turned_over))
    np.testing.assert_allclose(one, other, atol=1e-5)


def test_the_margin_among_obstacles_is_the_least_of_those_from_each(simulation):
    scenes = scenes_of(simulation)
    number = scenes.obstacles.shape[1]
    if not number:
        pytest.skip("there are no obstacles in this task")
    policy = policy_for(simulation)
    rows = np.arange(number)
    alone = [
        Scenes(scenes.start, scenes.goal, np.where((rows == i)[:, None], scenes.obstacles, 0.0)) for i in rows
    ]
    each = np.array([margins(policy, simulation.observe(one)) for one in alone])
    np.testing.assert_allclose(margins(policy, simulation.observe(scenes)), each.min(axis=0), atol=1e-5)


def test_gradients_reach_the_pair_networks(simulation):
    policy, observation = policy_for(simulation), simulation.observe(scenes_of(simulation))
    actions = np.broadcast_to(sobol_actions(8, policy.task.action.size), (16, 8, policy.task.action.size))
    policy.critic(policy.inputs(observation, actions)).margin.sum().backward()
    weights = policy.critic.pairs.networks.weights
    if simulation.task.scenes.n_obstacles == (0, 0):
        assert all(each.grad is None or not each.grad.any() for each in weights)
    else:
        assert all(torch.isfinite(each.grad).all() and each.grad.any() for each in weights)


def test_margins_stay_when_everything_turns_about_the_base(simulation):
    if simulation.task.arm.dimension == 3:
        pytest.skip("the postures of an arm with spare joints do not turn with the scene")
    scenes, rows = scenes_of(simulation), scenes_of(simulation).obstacles.copy()
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    rows[..., :2], rows[..., 2:4] = rows[..., :2] @ turn, rows[..., 2:4] @ turn
    turned = Scenes(scenes.start @ turn, scenes.goal @ turn, rows)
    here, there = (margins(policy_for(simulation), simulation.observe(each)) for each in (scenes, turned))
    np.testing.assert_allclose(here, there, atol=1e-4)


def test_it_takes_the_candidate_of_the_greatest_value(simulation):
    policy, observation = policy_for(simulation), simulation.observe(scenes_of(simulation))
    actions, values = policy.propose(observation)
    np.testing.assert_array_equal(policy.decide(observation), actions[np.arange(16), values.argmax(axis=1)])


def test_the_task_survives_json(simulation):
    record = json.loads(json.dumps(simulation.task.as_dict()))
    assert Task.from_dict(record, ARMS) == simulation.task


def test_it_learns_within_a_minute_what_chance_does_not():
    """A few hundred decisions suffice to double the success of random ones, and to triple it with checks."""
    simulation = SceneSimulation(IDS[1], 256)
    scenes = scenes_of(simulation, 256, seed=10_000)
    observation = simulation.observe(scenes)
    chance = simulation(scenes, np.random.default_rng(0).uniform(-1.0, 1.0, (256, 3))).success.mean()
    env = ViaVecEnv(IDS[1], 64, seed=0)
    few = {"candidates": 128, "refinements": 1, "per_refinement": 32}
    model = ViaQ("ViaQPolicy", env, seed=0, learning_starts=512, gradient_steps=16, policy_kwargs=few)
    model.learn(64 * 24)
    alone = simulation(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    model.policy.checks = 16
    checked = simulation(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    assert alone > 2.0 * chance
    assert checked > 3.0 * chance
    assert checked > 0.7
    env.close()
    simulation.close()
