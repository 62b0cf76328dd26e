"""Laws of the agent: its critic is a minimum over obstacles that are a set, it takes the best plan, and it learns."""

import json

import numpy as np
import pytest
import torch

from viapoint.envs.arms import ARMS
from viapoint.envs.geometry.rows import has_shapes, quaternion_of_axes, rotation_axes, shape_columns
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.algorithms import viaq_policy
from viapoint.training.algorithms.viaq import ViaQ
from viapoint.training.algorithms.viaq_policy import ViaQPolicy, seen_from_line
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.search.candidates import sobol_actions
from viapoint.training.search.plan_checks import CLEARANCE_MARGIN, REACH_MARGIN, check_plans, merit

IDS = (
    "viapoint/PlanarReach-v0",
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArm-v0",
    "viapoint/PandaObstacles-v0",
)
FORMS = (
    {"form": "poses"},
    {"form": "action", "pooling": "minimum", "heads": 2},
    {"form": "action", "pooling": "sum"},
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


@pytest.mark.parametrize("form", FORMS)
def test_the_order_of_the_obstacles_is_irrelevant(simulation, form):
    scenes = scenes_of(simulation)
    if not scenes.obstacles.shape[1]:
        pytest.skip("there are no obstacles in this task")
    policy = policy_for(simulation, **form)
    turned_over = Scenes(scenes.start, scenes.goal, scenes.obstacles[:, ::-1])
    one, other = (margins(policy, simulation.observe(each)) for each in (scenes, turned_over))
    np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize("form", FORMS[:2])
def test_the_margin_among_obstacles_is_the_least_of_those_from_each(simulation, form):
    scenes = scenes_of(simulation)
    number = scenes.obstacles.shape[1]
    if not number:
        pytest.skip("there are no obstacles in this task")
    policy = policy_for(simulation, **form)
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


def test_a_scene_is_seen_along_its_line(simulation):
    """Turning start, goal and obstacles about the vertical through the base changes nothing of the obstacles' view."""
    scenes, d = scenes_of(simulation), simulation.task.arm.dimension
    turn = np.eye(d)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    rows = scenes.obstacles.copy()
    rows[..., :d], rows[..., d : 2 * d] = rows[..., :d] @ turn.T, rows[..., d : 2 * d] @ turn.T
    if has_shapes(rows):
        first, second, _ = rotation_axes(shape_columns(rows).quaternion)
        rows[..., 2 * d + 1 : 2 * d + 5] = quaternion_of_axes(first @ turn.T, second @ turn.T)
    other = Scenes(scenes.start @ turn.T, scenes.goal @ turn.T, rows)
    here, there = (_seen(simulation, each) for each in (scenes, other))
    np.testing.assert_array_equal(here[2], there[2])
    present = here[2][..., None]
    sense = d == 2  # in space a half-axis across the line may be seen either way
    mine, theirs = ((rows if sense else np.abs(rows)) * present for rows in (here[1], there[1]))
    np.testing.assert_allclose(mine, theirs, atol=1e-4)


def _seen(simulation, scenes):
    rows = simulation.task.observation.observed_obstacles(scenes)
    observation = {"hand": scenes.start, "goal": scenes.goal}
    return seen_from_line({**observation, "obstacles": rows} if rows.size else observation, simulation.task)


def test_it_takes_the_candidate_of_the_greatest_value(simulation):
    policy, observation = policy_for(simulation), simulation.observe(scenes_of(simulation))
    actions, values = policy.propose(observation)
    np.testing.assert_array_equal(policy.decide(observation), actions[np.arange(16), values.argmax(axis=1)])


@pytest.mark.parametrize("checks", [0, 8])
def test_rounds_of_refinement_merge_where_only_the_hand_must_clear_and_plans_are_checked(
    simulation, checks, monkeypatch
):
    policy, observation = (
        policy_for(simulation, checks=checks, refinements=2),
        simulation.observe(scenes_of(simulation)),
    )
    sizes, values = [], policy.values

    def observed(observation, actions, *rest, **kwargs):
        sizes.append(actions.shape[1])
        return values(observation, actions, *rest, **kwargs)

    monkeypatch.setattr(policy, "values", observed)
    assert policy.propose(observation)[0].shape[1] == 32 + 2 * 16
    one = simulation.task.action.n_via <= 1 and not simulation.task.whole_arm and not policy.replanning
    merged = checks > 0 and one
    assert sizes == ([32, 32] if merged else [32, 16, 16])


@pytest.mark.parametrize("checks", [1, 12, viaq_policy.PROPOSALS])
def test_of_the_candidates_that_are_checked_it_takes_the_best(simulation, checks, monkeypatch):
    policy, observation = policy_for(simulation, checks=checks), simulation.observe(scenes_of(simulation))
    every, values = policy.propose(observation)
    seen, score_plans = [], viaq_policy.score_plans

    def observed(observation, actions, *rest, **kwargs):
        seen.append(actions)
        return score_plans(observation, actions, *rest, **kwargs)

    monkeypatch.setattr(viaq_policy, "score_plans", observed)
    decided = policy.decide(observation)
    (checked,) = seen
    assert checked.shape[1] == min(checks, every.shape[1])
    for row in range(16):
        candidates = {each.tobytes() for each in every[row]}
        assert len({each.tobytes() for each in checked[row]} & candidates) == checked.shape[1]
    merits = merit(check_plans(observation, checked, simulation.task), CLEARANCE_MARGIN, REACH_MARGIN)
    best = checked[np.arange(16), merits.argmax(axis=-1)]
    np.testing.assert_array_equal(decided, best)
    if checks > 1:
        greatest = every[np.arange(16), values.argmax(axis=1)]
        assert (checked == greatest[:, None]).all(axis=-1).any(axis=1).all()


def test_the_task_survives_json(simulation):
    record = json.loads(json.dumps(simulation.task.as_dict()))
    assert Task.from_dict(record, ARMS) == simulation.task
    with pytest.raises(ValueError, match=r"arm must be one of planar.*, got 'octopus'"):
        Task.from_dict({**record, "arm": "octopus"}, ARMS)


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
