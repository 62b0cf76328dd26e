"""Laws of planned movements, of their computed checks, and of the search among them."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import MOVING, PANDA, PANDA_MOVING, PLANE, REACH, WHOLE

from viapoint import primitives
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.training import GeometrySearch
from viapoint.training.planning import search as search_module
from viapoint.training.planning.movements import INSTANTS, OUTSIDE, table_with
from viapoint.training.planning.problem import Problem, moves_of, worth_of
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    INFEASIBLE,
    merits,
    plan_clearances,
    refined_actions,
)

AMONG_OBSTACLES = (PLANE, WHOLE, PANDA)


def drawn(env_id, number=16, **kwargs):
    env = gym.make_vec(env_id, num_envs=number, **kwargs).unwrapped
    observation, _ = env.reset(seed=1)
    return env, observation, Problem.of_observation(observation, env.task)


def random_actions(task, *shape, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (*shape, task.action.size))


@pytest.mark.parametrize("timing", ["optimal", "learned"])
@pytest.mark.parametrize("n_via", [0, 1, 2, 3])
@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_planned_movements_are_nearly_those_of_the_environment(env_id, n_via, timing):
    env, _, problem = drawn(env_id, 6, n_via=n_via, timing=timing)
    actions = random_actions(env.task, 6, 20)
    start, goal = (np.repeat(end[:, None], 20, axis=1) for end in (problem.start, problem.goal))
    plan = env.task.action.decode(actions, start, goal)
    moves = moves_of(env.task, problem, actions)
    basis = moves.table.basis[moves.times]
    path = problem.start[:, None, None] + np.einsum("bhti,bhid->bhtd", basis, moves.offsets)
    executed = plan.trajectory()(plan.duration[..., None] * np.linspace(0.0, 1.0, INSTANTS))
    assert np.median(np.abs(moves.duration / plan.duration - 1.0)) < (0.05 if timing == "optimal" else 3e-3)
    size = np.abs(moves.offsets[:, :, : n_via + 1]).max()
    assert np.median(np.abs(path - executed)) < 0.01 * size
    np.testing.assert_allclose(path[..., -1, :], executed[..., -1, :], atol=1e-9)


@pytest.mark.parametrize("env_id", [MOVING, PANDA_MOVING])
def test_revised_movements_last_as_long_as_those_of_the_environment(env_id):
    env, _, problem = drawn(env_id, 24)
    for decision in range(2):  # from rest, and under way
        actions = random_actions(env.task, 24, seed=decision)
        planned = moves_of(env.task, problem, actions[:, None]).duration[:, 0]
        observation, *_ = env.step(actions.astype(np.float32))
        assert np.median(np.abs(planned / env.last_plan.duration - 1.0)) < 0.05
        problem = Problem.of_observation(observation, env.task)


@pytest.mark.parametrize("env_id", AMONG_OBSTACLES)
def test_what_is_planned_to_be_clear_succeeds(env_id):
    env, observation, problem = drawn(env_id, 200, threads=1)
    actions = GeometrySearch(env.task, 256).decide(observation)
    actions[::4] = random_actions(env.task, 50)  # some touch something
    clearance = plan_clearances(env.task, problem, actions[:, None], 0.1, -0.1, exact=True)[:, 0]
    worth = worth_of(env.task, problem, moves_of(env.task, problem, actions[:, None]))[:, 0]
    decision = env.execute_actions(actions)
    success = decision.info["is_success"]
    assert success[clearance >= 0.0].all()
    # Spheres are up to 5 mm outside the arm, so that a movement may touch a sphere but not the arm.
    assert not success[(clearance < -0.006) & (clearance > OUTSIDE)].any()
    assert 100 < success.sum() < 200
    low, high = CLEARANCE_RANGE
    expected = worth + env.task.weights.clearance * np.clip(clearance, low, high) / CLEARANCE_UNIT
    kept = success & (decision.info["stretch"] == 1.0)
    assert np.median(np.abs(expected - decision.reward)[kept]) < 0.02


@pytest.mark.parametrize("env_id", [*AMONG_OBSTACLES, MOVING, REACH])
def test_looking_at_the_most_promising_plans_first_finds_the_best(env_id):
    env, _, problem = drawn(env_id)
    actions = random_actions(env.task, 16, 200)
    found = merits(env.task, problem, actions)
    clearance = plan_clearances(env.task, problem, actions, CLEARANCE_RANGE[1], CLEARANCE_MARGIN)
    worth = worth_of(env.task, problem, moves_of(env.task, problem, actions))
    every = worth + env.task.weights.clearance * clearance / CLEARANCE_UNIT
    every[clearance < CLEARANCE_MARGIN] = INFEASIBLE
    solved = every.max(axis=1) > INFEASIBLE
    assert solved.any()
    np.testing.assert_allclose(found.max(axis=1)[solved], every.max(axis=1)[solved], atol=1e-6)


@pytest.mark.parametrize("n_via", [0, 1, 2, 5])
def test_tables_hold_the_movements_of_the_primitives(n_via):
    rng = np.random.default_rng(n_via)
    shares = rng.dirichlet(np.full(n_via + 1, 5.0), 3)
    table, instants = table_with(shares), np.linspace(0.0, 1.0, INSTANTS)
    offsets = rng.normal(size=(3, n_via + 3, 2))
    waypoints = np.concatenate((np.zeros((3, 1, 2)), offsets[:, : n_via + 1]), axis=1)
    motion = {"start_velocity": offsets[:, -2], "start_acceleration": offsets[:, -1]}
    trajectory = primitives.through(waypoints, shares, **motion)
    for part, expected in zip(
        (table.basis, table.rate, table.bend), trajectory.sample(instants), strict=True
    ):
        np.testing.assert_allclose(np.einsum("mti,mid->mtd", part, offsets), expected, atol=1e-9)
    cost = np.einsum("mij,mid,mjd->m", table.cost, offsets, offsets)
    np.testing.assert_allclose(cost, trajectory.cost(), rtol=1e-9)


@pytest.mark.parametrize("env_id", AMONG_OBSTACLES)
def test_more_checks_never_give_a_worse_plan(env_id):
    env, observation, problem = drawn(env_id)
    before = np.full(16, 3.0 * INFEASIBLE)
    for more in ({"n_checks": 1}, {"n_checks": 16}, {"n_checks": 64}, {"n_checks": 64, "refinements": 3}):
        actions = GeometrySearch(env.task, **more).decide(observation)
        worth = merits(env.task, problem, actions[:, None])[:, 0]
        feasible = before > 0.5 * INFEASIBLE
        assert (worth >= before - 1e-6)[feasible].all()
        before = worth
    assert (before > 0.5 * INFEASIBLE).mean() > 0.5


@pytest.mark.parametrize("env_id", [*AMONG_OBSTACLES, MOVING])
def test_a_decision_depends_on_its_scene_alone(env_id):
    env, observation, _ = drawn(env_id, 40)
    search = GeometrySearch(env.task, 64, refinements=2, per_round=16)
    together = search.decide(observation)
    for row in (0, 17, 39):
        action, state = search.predict({name: values[row] for name, values in observation.items()})
        assert state is None
        np.testing.assert_allclose(action, together[row], atol=1e-6)
    batch, _ = search.predict(observation, deterministic=True)
    np.testing.assert_array_equal(batch, together.astype(np.float32))
    assert (np.abs(together) <= 1.0).all()


def test_exactly_the_stated_number_of_plans_is_checked(monkeypatch):
    env, observation, _ = drawn(PLANE, 4)
    counted = []

    def counting(task, problem, actions, setting=None):
        counted.append(actions.shape[1])
        return merits(task, problem, actions, setting)

    monkeypatch.setattr(search_module, "merits", counting)
    search = GeometrySearch(env.task, 50, refinements=3, per_round=10)
    search.decide(observation)
    assert sum(counted) == search.total_checks == 80
    assert search.name == "search80"


def test_a_plan_that_stays_clear_is_kept():
    env, observation, _ = drawn(MOVING, 64)
    observation, *_ = env.step(0.3 * random_actions(env.task, 64).astype(np.float32))
    problem = Problem.of_observation(observation, env.task)
    actions = GeometrySearch(env.task, 64).decide(observation)
    zero = np.zeros((64, 1, env.task.action.size))
    clearance = plan_clearances(env.task, problem, zero, 0.1, -0.1)[:, 0]
    under_way = (problem.remaining > 0.3) & (problem.time_left > 1.0) & problem.velocity.any(axis=-1)
    assert (under_way & (clearance > 0.003)).sum() > 5
    assert (actions[under_way & (clearance > 0.003)] == 0.0).all(axis=-1).mean() > 0.9


@pytest.mark.parametrize("kwargs", [{}, {"n_via": 2, "timing": "learned"}])
@pytest.mark.parametrize("env_id", [WHOLE, PANDA])
def test_refined_actions_are_clear_more_often_and_keep_their_duration(env_id, kwargs):
    env, _, problem = drawn(env_id, 24, **kwargs)
    actions = random_actions(env.task, 24, 2)
    refined = refined_actions(env.task, problem, actions)
    at = env.task.n_via * env.task.action.dimension
    np.testing.assert_array_equal(refined[..., at], actions[..., at])
    assert np.abs(refined).max() <= 1.0

    def clear(vectors):
        return plan_clearances(env.task, problem, vectors, 0.0, 0.0, exact=True) >= 0.0

    assert clear(refined).mean() > clear(actions).mean() + 0.3
    # A problem alone is refined as it is among others.
    np.testing.assert_array_equal(refined_actions(env.task, problem.take([5]), actions[5:6]), refined[5:6])
