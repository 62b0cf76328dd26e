"""Laws of the critic, of what it learns from, and of learning without the geometry of obstacles."""

import inspect

import numpy as np
import pytest
import torch
from helpers import MOVING, PANDA, PLANE, WHOLE, problem_of

import viapoint.envs.geometry.clearance
import viapoint.envs.geometry.distance
import viapoint.training.planning.movements
import viapoint.training.planning.search
from viapoint.envs.geometry.clearance import configuration_clearances
from viapoint.envs.geometry.obstacles import BOX, bounding_boxes, no_obstacles
from viapoint.training import ViaQ
from viapoint.training.agents import viaq_policy
from viapoint.training.agents.pairs import CLEAR, NO_OBSTACLE, pairs_of
from viapoint.training.agents.viaq import OutcomeReplayBuffer, Outcomes
from viapoint.training.agents.viaq_critic import Values, _Saturated
from viapoint.training.planning.candidates import best_duration, candidate_actions, sobol_actions
from viapoint.training.planning.movements import INSTANTS
from viapoint.training.planning.problem import Problem, moves_of
from viapoint.training.planning.search import INFEASIBLE, plan_clearances, registered_task
from viapoint.training.vec_env import TERMS

KNOW_OBSTACLES = (
    viapoint.envs.geometry.clearance,
    viapoint.envs.geometry.distance,
    viapoint.training.planning.search,
)
FEW = {"candidates": 32, "refinements": 1, "per_refinement": 16, "width": 8}
EVERY = np.arange(INSTANTS)


@pytest.fixture
def small(made):
    """Function that makes a small model and its environment."""
    settings = {"learning_starts": 16, "batch_size": 16, "gradient_steps": 1, "explore_candidates": 8}

    def make(env_id, **kwargs):
        env = made(env_id, threads=1, **kwargs)
        return ViaQ("ViaQPolicy", env, seed=0, policy_kwargs=dict(FEW), **settings), env

    return make


def movements(env_id, number=6, **kwargs):
    """Return a task, problems and movements of 8 actions in each."""
    task = registered_task(env_id, **kwargs)
    problem = problem_of(task, number, 3)
    actions = np.broadcast_to(sobol_actions(8, task.action.size), (number, 8, task.action.size))
    return task, problem, actions, moves_of(task, problem, actions)


def refuse_geometry(monkeypatch):
    """Let every function that computes distances from obstacles fail, wherever it was imported to."""

    def refuse(*args, **kwargs):
        raise AssertionError("the geometry of obstacles was computed")

    for module in KNOW_OBSTACLES:
        for name, function in inspect.getmembers(module, callable):
            if getattr(function, "__module__", "") == module.__name__ and not inspect.isclass(function):
                monkeypatch.setattr(module, name, refuse)
                for user in (viaq_policy, viapoint.training.planning.movements):
                    if getattr(user, name, None) is function:
                        monkeypatch.setattr(user, name, refuse)


@pytest.mark.parametrize("env_id", [PLANE, WHOLE, PANDA, MOVING])
def test_nothing_is_learned_or_decided_from_distances_of_obstacles(small, env_id, monkeypatch):
    model, env = small(env_id)
    model.learn(32)
    observation = env.reset()
    model.policy.checks = 0
    model.predict(observation)  # what is compiled now stays as it is
    refuse_geometry(monkeypatch)
    model.train(2, 8)
    model._sample_action(0, None, 8)
    actions, _ = model.predict(observation)
    assert actions.shape == (8, *env.action_space.shape)
    model.policy.checks = 4
    with pytest.raises(AssertionError, match="geometry"):
        model.predict(observation)


def test_of_an_obstacle_only_bounding_box_and_kind_are_seen():
    """The compiled part cannot be refused, so what it returns must not depend on the surface."""
    task, problem, _, moves = movements(PANDA, shapes=("sphere", "box", "cylinder"))
    _, half = bounding_boxes(problem.obstacles)
    kind = np.where(problem.obstacles.present, BOX, problem.obstacles.kind)
    boxes = problem._replace(obstacles=problem.obstacles._replace(kind=kind, size=half))
    before, after = (pairs_of(task, each, moves, EVERY) for each in (problem, boxes))
    torch.testing.assert_close(after.features[..., :7], before.features[..., :7])
    torch.testing.assert_close(after.distance, before.distance)
    assert (after.features[..., 7:] != before.features[..., 7:]).any()


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_without_obstacles_the_margin_is_constant(small, env_id):
    task, problem, _, _ = movements(env_id)
    model, _ = small(env_id)
    empty = problem._replace(obstacles=no_obstacles(len(problem.start)))
    actions = np.broadcast_to(sobol_actions(8, task.action.size), (len(problem.start), 8, task.action.size))
    values = model.policy.critic(model.policy.inputs(empty, actions))
    assert (values.margin == NO_OBSTACLE).all()


def test_the_clearance_of_the_arm_from_itself_is_computed():
    task, problem, actions, moves = movements(PANDA)
    found = pairs_of(task, problem, moves, EVERY)
    shape = actions.shape[:2]
    ends = (np.broadcast_to(each[:, None], (*shape, each.shape[1])) for each in (problem.start, problem.goal))
    plan = task.action.decode(np.asarray(actions, np.float64), *ends)
    arm = task.arm
    for scene, row in np.argwhere(found.inside.numpy()):
        one = plan.take((scene, row))
        path = one.trajectory()(np.linspace(0.0, one.durations.sum(), INSTANTS))
        apart = configuration_clearances(
            arm.chain, arm.spheres, path, no_obstacles(INSTANTS), np.zeros(INSTANTS)
        )
        least = min(apart[:, 1].min(), CLEAR)
        assert float(found.self_clearance[scene, row]) == pytest.approx(
            least, abs=6e-3
        )  # the table rounds passage times


def test_only_instants_that_were_carried_out_count():
    task, problem, _, moves = movements(PLANE)
    until = 0.4 * moves.duration
    cut = pairs_of(task, problem, moves, EVERY, until)
    some = pairs_of(task, problem, moves, EVERY[EVERY <= 0.4 * (INSTANTS - 1)])
    for mine, theirs in zip(cut, some, strict=True):
        torch.testing.assert_close(mine, theirs)
    whole = pairs_of(task, problem, moves, EVERY)
    endless = pairs_of(task, problem, moves, EVERY, np.full_like(until, np.inf))
    torch.testing.assert_close(endless.features, whole.features)


@pytest.mark.parametrize("checks", [1, 11, 64])
@pytest.mark.parametrize("env_id", [WHOLE, PANDA, MOVING])
def test_as_many_plans_are_checked_as_one_says_and_the_best_of_them_is_taken(
    small, env_id, checks, monkeypatch
):
    model, env = small(env_id)
    observation, checked, exact = env.reset(), {}, viaq_policy.merits
    model.policy.checks = 0
    unchecked = model.policy.decide(observation)

    def counted(task, problem, actions):
        found = exact(task, problem, actions)
        for goal, some, worth in zip(problem.goal, actions, found, strict=True):
            checked.setdefault(goal.tobytes(), []).append((some, worth))
        return found

    monkeypatch.setattr(viaq_policy, "merits", counted)
    model.policy.checks = checks
    decided = model.policy.decide(observation)
    most = min(checks, 48)  # there are 48 candidates
    problem = Problem.of_observation(observation, model.policy.task)
    for goal, action, alone in zip(problem.goal, decided, unchecked, strict=True):
        actions, worth = (np.concatenate(each) for each in zip(*checked[goal.tobytes()], strict=True))
        np.testing.assert_array_equal(action, actions[worth.argmax()])
        assert len(actions) <= most
        # A plan is never worse than an unchecked one, which is among those that are checked.
        assert checks == 1 or (actions == alone).all(axis=-1).any()
        if env_id == MOVING:  # the plan under way is among them
            assert (actions == 0.0).all(axis=-1).any()
        elif len(actions) < most:  # further plans are checked only where none is clear
            assert worth.max() > 0.5 * INFEASIBLE


def test_merit_prefers_likely_success_and_orders_the_rest_by_its_probability(small):
    model, _ = small(PLANE)
    zero = torch.zeros(1, 4)
    no_contact, effort = torch.tensor([[5.0, 5.0, -1.0, -3.0]]), torch.tensor([[0.0, -0.3, 9.0, 99.0]])
    values = Values(zero, zero, no_contact, zero + 5.0, zero, effort)
    merit = model.policy.critic.merit(values)[0]
    assert merit.argsort(descending=True).tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(merit[:2], model.policy.critic.value(values)[0, :2])


def test_a_saturated_prediction_is_pulled_back_but_never_pushed_out():
    values = torch.tensor([-2.0, -2.0, 0.0, 0.0, 2.0, 2.0], requires_grad=True)
    push = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])  # descent moves against the gradient
    _Saturated.apply(values, -1.0, 1.0).backward(push)
    assert values.grad.tolist() == [0.0, -1.0, 1.0, -1.0, 1.0, 0.0]


def step(clearance, done=False, **more):
    """Info of one decision."""
    info = dict.fromkeys(TERMS, 0.0) | {"reward_clearance": clearance, "elapsed": 0.3, **more}
    return info, sum(info[name] for name in TERMS), done


def test_clearance_is_summed_over_an_episode_and_the_decision_that_lowered_it_is_known(made):
    env = made(MOVING, 1)
    buffer = OutcomeReplayBuffer(16, env.observation_space, env.action_space, n_envs=1, device="cpu")
    observation = {name: part[:1] for name, part in env.reset().items()}
    for info, reward, done in (
        step(0.1), step(0.0), step(-0.3), step(0.0, True), step(-0.2), step(-0.1), step(0.05, True),
    ):  # fmt: skip
        action = np.zeros((1, 3), dtype=np.float32)
        buffer.add(observation, observation, action, np.array([reward]), np.array([done]), [info])
    kept = Outcomes(*buffer.outcomes[:7, 0].T)
    assert np.allclose(kept.clearance, [0.1, 0.1, -0.2, -0.2, -0.2, -0.3, -0.25])
    assert kept.lower.tolist() == [1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0]
    assert np.allclose(buffer.elapsed[:7], 0.3)
    for clearance in (-0.3, 0.04, 0.0):
        if clearance > 0.0:
            buffer.begin()  # the environment is reset in the middle of an episode
        reward, info = np.array([clearance]), step(clearance)[0]
        buffer.add(observation, observation, action, reward, np.array([False]), [info])
    assert np.allclose(buffer.outcomes[7:10, 0, Outcomes._fields.index("clearance")], [-0.3, 0.04, 0.04])


def test_without_terms_only_the_sum_is_learned_from(small):
    model, _ = small(PLANE)
    model.learn(64)
    model.replay_buffer.outcomes[:] = np.nan
    before = model.policy.critic.pairs.layers[0].weight.clone()
    losses = model._losses(model.replay_buffer.sample_outcomes(16))
    assert losses["reward"].item() > 0.0
    assert all(loss.item() == 0.0 for name, loss in losses.items() if name != "reward")
    model.train(20, 16)
    assert not torch.equal(before, model.policy.critic.pairs.layers[0].weight)


def test_what_follows_counts_only_where_an_episode_goes_on(small):
    model, _ = small(MOVING, n_obstacles=1)
    model.learn(128)
    batch = model.replay_buffer.sample_outcomes(64)

    def effort(ended, gamma):
        model.gamma = gamma
        return model._losses(batch._replace(ended=np.full_like(batch.ended, ended)))["effort"].item()

    assert effort(1.0, 0.5) == effort(1.0, 1.0) != effort(0.0, 1.0)


@pytest.mark.parametrize("temperature", [1e-3, 1e6])
def test_exploration_goes_from_the_best_candidate_to_any(small, temperature, monkeypatch):
    model, env = small(PLANE)
    model.explore_uniformly, model.temperature, model.num_timesteps = 0.0, temperature, 100
    model._last_obs = env.reset()
    seen = {}

    def valued(observation, candidates):
        seen["candidates"] = candidates
        return np.tile(np.linspace(0.0, 1.0, 8, dtype=np.float32), (8, 1))

    monkeypatch.setattr(model.policy, "values", valued)
    chosen = []
    for _ in range(60):
        actions, _ = model._sample_action(0, None, 8)
        chosen += (seen["candidates"] == actions[:, None]).all(axis=-1).argmax(axis=1).tolist()
    counts = np.bincount(chosen, minlength=8)
    assert counts[7] == 480 if temperature < 1.0 else counts.min() > 30  # of 60 each


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_candidates_are_different_allowed_and_begin_with_the_straight_movement(env_id):
    task = registered_task(env_id)
    actions = candidate_actions(task, 64, replanning=False)
    assert (actions[0] == 0.0).all()
    assert (np.abs(actions) <= 1.0).all()
    assert len(np.unique(actions, axis=0)) == 64
    at = task.action.n_via * task.action.dimension
    assert np.allclose(actions[1:, at], best_duration(task))
    # The reward is stationary where 5 w_smoothness / (T^6 + T) = w_duration.
    relative = np.exp(best_duration(task) * task.action.log_half_range)
    slope = 5.0 * task.weights.smoothness / (relative**6 + relative)
    assert slope == pytest.approx(task.weights.duration, rel=0.05)


def test_the_nearest_pairs_are_those_of_the_closest_approach_between_the_instants():
    task, problem, _, _ = movements(PLANE, 60, shapes=("box",))
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 32, task.action.size))
    pairs = pairs_of(task, problem, moves_of(task, problem, actions), np.arange(0, INSTANTS, 3))
    radius = pairs.features[..., 6]
    nearest = torch.where(pairs.present, pairs.distance - radius, 1.0).amin(dim=-1).numpy()
    clearance = plan_clearances(task, problem, actions, 0.02, -0.05, exact=True)
    near = (np.abs(clearance) < 0.01) & pairs.inside.numpy()
    assert near.sum() > 100
    assert np.quantile(np.abs(nearest - clearance)[near], 0.95) < 1e-3
