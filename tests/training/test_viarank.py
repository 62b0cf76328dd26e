"""Laws of agents that see obstacles with a sensor."""

import functools

import numpy as np
import pytest
from helpers import PLANE, scenes_of
from helpers import SENSED as ENV

from viapoint.training import ViaRank, ViaVecEnv, evaluate
from viapoint.training.planning.beliefs import Sight
from viapoint.training.planning.cautious import places_of
from viapoint.training.planning.problem import Problem, moves_of
from viapoint.training.planning.search import plan_clearances, registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import scenes_for


@pytest.fixture(scope="module")
def agent():
    small = {"candidates": 128}
    env = ViaVecEnv(ENV, 32, seed=0)
    return ViaRank("ViaRankPolicy", env, seed=0, gradient_steps=8, policy_kwargs=small).learn(320)


def test_it_learns_in_seconds(agent) -> None:
    # The untrained network solves 2 % of these scenes, and a search that knows only the points 20 %.
    result = evaluate(agent, scenes="validation", n_scenes=100, time_decisions=False)
    assert result.success_rate > 0.35


def test_predicted_success_is_calibrated(agent) -> None:
    simulation = SceneSimulation(ENV)
    scenes = scenes_of(simulation.task, 300, 9)
    actions, predicted = agent.policy.assess(simulation.observe(scenes))
    assert abs(predicted.mean() - simulation(scenes, actions).success.mean()) < 0.08


def test_rounds_of_candidates_never_lower_the_best_value(agent) -> None:
    policy = agent.policy
    scenes = scenes_of(policy.task, 16, 5)
    problem, sight = Problem.of_scenes(scenes, policy.task), Sight.of_scenes(scenes, policy.task)
    rank = functools.partial(policy.rank, problem, sight)
    actions, value = policy.proposals(16, rank)
    first = value[:, : policy.candidates].max(axis=1)
    assert actions.shape[1] == policy.all_candidates > policy.candidates
    assert (value.max(axis=1) >= first).all()
    assert (value.max(axis=1) > first).mean() > 0.5


def test_places_are_those_of_the_movement() -> None:
    task = registered_task(ENV)
    scenes = scenes_of(task, 4)
    problem, sight = Problem.of_scenes(scenes, task), Sight.of_scenes(scenes, task)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 6, task.action.size))
    moves = moves_of(task, problem, actions)
    places = places_of(task, problem, moves, sight, np.arange(64))
    for instant, end in ((0, scenes.start), (-1, scenes.goal)):
        expected = np.repeat(task.space.coordinates(end)[:, None], 6, 1)
        assert np.allclose(places.centre[:, :, instant, 0, :2][places.inside], expected[places.inside])
    # A place at a seen point has the depth 0.
    ranges = sight.ranges[0][sight.hit[0]]
    local = ranges[:, None] * task.sensor.directions[sight.hit[0]]
    assert np.array_equal(task.sensor.ray_towards(local), np.flatnonzero(sight.hit[0]))


def test_full_knowledge_is_the_best_belief() -> None:
    methods = ["known:search512", "seen:search512", "points:search512", "thick:plan_motion"]
    result = evaluate(env=ENV, scenes="validation", n_scenes=60, baselines=methods, time_decisions=False)
    known, seen, points, _ = [row["success"]["rate"] for row in result.rows]
    assert known > 0.95
    assert known > seen > points


def test_sets_of_scenes_are_solvable_and_partly_hidden() -> None:
    task = registered_task(ENV)
    frozen = scenes_for("validation", task)
    known = registered_task(PLANE)
    assert not np.isin(frozen.scenes.start[:, 0], scenes_for("validation", known).scenes.start[:, 0]).any()
    assert 0.1 < frozen.hidden.mean() < 0.5
    problem = Problem.of_scenes(frozen.scenes, task)
    straight = np.zeros((len(frozen.share), 1, task.action.size))
    assert (plan_clearances(task, problem, straight, 0.01, 0.0)[:, 0] < 0.01).all()
