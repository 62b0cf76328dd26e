"""Agents work as any algorithm of Stable-Baselines3; laws of policies and critics, and of what they learn from."""

import copy
import functools
import inspect
import io
import itertools

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from helpers import (
    MOVING,
    PANDA,
    PLANE,
    REACH,
    SENSED,
    WHOLE,
    configuration_clearances,
    problem_of,
    scenes_of,
)
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import viapoint.envs.geometry.clearance
import viapoint.training.planning.movements
import viapoint.training.planning.search
from viapoint.envs.geometry.obstacles import BOX, bounding_boxes, no_obstacles, unpack
from viapoint.envs.rewards import TERMS
from viapoint.training import GeometrySearch, ViaQ, ViaRank, ViaVecEnv, evaluate, load_agent
from viapoint.training.agents import viaq
from viapoint.training.agents.agent import SAC
from viapoint.training.agents.pairs import CLEAR, LENGTHS, NO_OBSTACLE, pairs_of
from viapoint.training.planning.baselines import agent_method
from viapoint.training.planning.beliefs import Sight, thick_points
from viapoint.training.planning.candidates import best_duration, candidate_actions, sobol_actions
from viapoint.training.planning.cautious import places_of
from viapoint.training.planning.movements import INSTANTS, OUTSIDE
from viapoint.training.planning.problem import Problem, moves_of
from viapoint.training.planning.search import CLEARANCE_MARGIN, plan_clearances, registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import scenes_for

FEW = {"width": 8, "instants": 8, "candidates": 32, "refinements": 1, "per_refinement": 16}
SMALL = {"learning_starts": 16, "batch_size": 8, "gradient_steps": 1, "explore_candidates": 16}
SMALL["policy_kwargs"] = FEW
NUMBER = 12  # Number of scenes in which policies are compared


def model_on(env, **kwargs):
    return ViaQ("ViaQPolicy", env, seed=0, **{**SMALL, **kwargs})


@pytest.mark.parametrize(
    "make",
    [
        lambda: ViaVecEnv(PLANE, 4, n_obstacles=2),
        lambda: make_vec_env(PLANE, 4, env_kwargs={"n_obstacles": 2}),
        lambda: VecNormalize(make_vec_env(PLANE, 4, env_kwargs={"n_obstacles": 2}), norm_obs=False),
    ],
)
def test_the_algorithm_is_used_as_those_of_stable_baselines(make, tmp_path):
    env = make()
    callback = CheckpointCallback(save_freq=8, save_path=str(tmp_path), name_prefix="agent")
    agent = ViaQ("ViaQPolicy", env, seed=0, **SMALL).learn(40, CallbackList([callback]))
    assert (agent.env_id, agent.env_kwargs) == (PLANE, {"n_obstacles": 2})
    for path in (tmp_path / "agent_32_steps", str(tmp_path / "agent_32_steps.zip")):
        again = ViaQ.load(path, env=env)
        assert again.num_timesteps == 32
        assert again.predict(env.reset())[0].shape == (4, 3)
    again.learn(8, reset_num_timesteps=False)
    assert again.num_timesteps == 40
    env.close()


def test_a_planned_movement_is_the_one_that_an_environment_executes():
    shapes = ("capsule", "box", "cylinder")
    env = gym.make(PLANE, shapes=shapes).unwrapped
    agent = ViaQ("ViaQPolicy", ViaVecEnv(PLANE, 4, seed=0, threads=1, shapes=shapes), seed=0)
    search = GeometrySearch(PLANE, 256, shapes=shapes)
    for method, seed in itertools.product((agent, search), range(3)):
        observation, _ = env.reset(seed=seed)
        scene = env.batch.scenes
        start, goal = env.task.space.coordinates(np.concatenate((scene.start, scene.goal)))
        plan = method.plan(start=start, goal=goal, obstacles=unpack(scene.obstacles, 0))
        lists = {name: part.tolist() for name, part in observation.items()}
        env.step(method.predict(lists, deterministic=True)[0])
        np.testing.assert_allclose(plan.waypoints, env.last_plan.waypoints, atol=1e-6)
        np.testing.assert_allclose(plan.durations, env.last_plan.durations, atol=1e-6)
        ends = plan.trajectory()(np.array([0.0, plan.durations.sum()]))
        np.testing.assert_allclose(ends, [start, goal], atol=1e-9)


def test_it_goes_on_in_other_scenes_of_its_task_only(made):
    model = model_on(made()).learn(24)
    model.set_env(made(n_obstacles=5))
    model.learn(8, reset_num_timesteps=False)
    env = model.get_env()
    for other in ({"env_id": PANDA}, {"duration_range": (0.5, 2.0)}, {"timing": "learned"}):
        with pytest.raises(ValueError):
            model.set_env(made(**other))
        assert model.get_env() is env


@pytest.mark.parametrize(
    "settings",
    [
        {"policy_kwargs": {"candidates": 1, "refinements": 0, "width": 1, "instants": 2}},
        {"policy_kwargs": {**FEW, "per_refinement": 1, "checks": 10_000}},
        {"explore_uniformly": 0.0, "explore_candidates": 2, "next_candidates": 1, "gamma": 0.0},
        {"explore_uniformly": np.int64(1), "next_candidates": 500},
    ],
)
@pytest.mark.parametrize("env_id", [REACH, MOVING])
def test_the_least_and_the_most_of_each_setting_can_be_learned_with(made, env_id, settings):
    env = made(env_id)
    model = model_on(env, **settings).learn(32)
    assert model._n_updates > 0
    assert all(torch.isfinite(part).all() for part in model.policy.parameters())
    assert (np.abs(model.predict(env.reset())[0]) <= 1.0).all()


def test_a_training_that_would_change_nothing_is_told(made):
    with pytest.warns(UserWarning, match="8 decisions"):
        assert model_on(made(), learning_starts=16).learn(8)._n_updates == 0


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
    for other in (viaq.ViaQPolicy.load(file), copy.deepcopy(policy)):
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
    info = dict(
        zip(TERMS, (1.0, 0.0, 0.1, 0.0, -0.2, -0.3, 0.0), strict=True), is_success=True, collision=False
    )
    np.testing.assert_allclose(viaq.outcome_of(info, 0.6), (1.0, 0.0, 0.1, 1.0, -0.5))
    assert np.isnan([viaq.outcome_of(info, 0.7), viaq.outcome_of({}, 0.6)]).all()


def test_refinement_solves_more_than_as_many_checks(made):
    env = made(number=64)
    model, observation = model_on(env), env.reset()
    solved = []
    for settings in ({"checks": 4}, {"refine": 4}):
        chosen = agent_method("agent", model, **{"checks": 0, **settings}).decide(observation, None)
        solved.append(env.step(chosen)[1].mean())
        observation = env.reset()
    assert solved[1] > solved[0] + 0.05


def policy_of(task, **kwargs):
    torch.manual_seed(0)
    settings = {"width": 8, "candidates": 32, "refinements": 1, "per_refinement": 16, **kwargs}
    actions = Box(-1.0, 1.0, (task.action.size,))
    return viaq.ViaQPolicy(task.observation.space(), actions, lambda _: 1e-3, task=task.as_dict(), **settings)


@pytest.mark.parametrize("env_id", [PLANE, SENSED, MOVING])
def test_no_scenes_have_no_actions(env_id):
    agent = load_agent(env_id)
    empty = {name: np.zeros((0, *box.shape), np.float32) for name, box in agent.observation_space.items()}
    assert agent.predict(empty)[0].shape == (0, *agent.action_space.shape)


def some_actions(task, number):
    """Return 8 actions, the same in each of some scenes."""
    size = task.action.size
    return np.broadcast_to(sobol_actions(8, size), (number, 8, size))


def margins(policy, problem):
    """Return the margins of 8 actions in each scene, [m]."""
    actions = some_actions(policy.task, len(problem.start))
    with torch.no_grad():
        return policy.critic(policy.inputs(problem, actions)).margin.numpy()


def with_rows(problem, rows):
    """Return a problem with some of the rows of its obstacles."""
    obstacles = problem.obstacles
    parts = {name: getattr(obstacles, name)[:, rows] for name in obstacles._fields[:5]}
    return problem._replace(obstacles=obstacles._replace(**parts))


@pytest.mark.parametrize("env_id", [PLANE, WHOLE, PANDA])
def test_margins_do_not_depend_on_the_order_of_obstacles_and_are_constant_without_any(env_id):
    task = registered_task(env_id)
    policy, problem = policy_of(task), problem_of(task, NUMBER)
    other = with_rows(problem, slice(None, None, -1))
    np.testing.assert_allclose(margins(policy, other), margins(policy, problem), atol=1e-5)
    empty = problem._replace(obstacles=no_obstacles(NUMBER))
    assert (margins(policy, empty) == NO_OBSTACLE).all()


def test_the_nearest_pairs_of_a_movement_are_among_those_of_each_obstacle():
    task, problem, _, moves = movements(PANDA)
    rows = range(problem.obstacles.kind.shape[1])
    alone = [pairs_of(task, with_rows(problem, [row]), moves, EVERY).features for row in rows]
    found = pairs_of(task, problem, moves, EVERY)
    same = (found.features[:, :, :, None] == torch.cat(alone, dim=2)[:, :, None]).all(dim=-1)
    assert same.any(dim=-1)[found.present].all()


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
    env = ViaVecEnv(PLANE, 64, seed=0)
    few = {"candidates": 128, "refinements": 1, "per_refinement": 32}
    model = ViaQ("ViaQPolicy", env, seed=0, learning_starts=512, gradient_steps=8, policy_kwargs=few)

    def outcome(actions):
        found = simulation(scenes, actions.astype(np.float64))
        return found["is_success"].mean(), found["reward"].mean()

    chance, untrained = outcome(random), outcome(model.predict(observation)[0])
    model.learn(64 * 16)
    learned = outcome(model.predict(observation)[0])
    assert learned[0] > 2.0 * chance[0]
    assert learned[1] > untrained[1] + 0.05  # far from all obstacles, its plans were clear before, but jerky
    model.policy.checks = 16
    assert outcome(model.predict(observation)[0])[0] > 0.7
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


def test_refined_candidates_are_apart_from_each_other(monkeypatch):
    refined = []

    def refine(task, problem, actions):
        refined.append(actions)
        return actions

    monkeypatch.setattr(viaq, "refined_actions", refine)
    agent = load_agent(PLANE)
    agent.policy.refine = 4
    problem = problem_of(agent.policy.task, 16)
    agent.policy._chosen(problem)
    vias = refined[0][..., :2]
    distance = np.linalg.norm(vias[:, :, None] - vias[:, None], axis=-1)
    assert distance[:, ~np.eye(4, dtype=bool)].min() >= viaq.APART
    actions, values = agent.policy.propose(problem)
    best = actions[np.arange(16), values.argmax(axis=1)]
    np.testing.assert_array_equal(refined[0][:, 0], best)


@pytest.mark.parametrize("env_id", [PLANE, SENSED])
def test_plans_out_of_reach_are_not_taken(env_id):
    """Not even where hundreds of them rank higher than the best one within reach."""
    policy = load_agent(env_id).policy
    problem = problem_of(policy.task, 40)
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1.0, 1.0, (40, 200, policy.task.action.size))
    alone = problem._replace(obstacles=no_obstacles(40))
    within = plan_clearances(policy.task, alone, actions, 0.1, 0.0, exact=True) > OUTSIDE
    values = generator.uniform(size=(40, 200)) - within
    best = policy.best_within_reach(problem, actions, values)
    some = within.any(axis=1)
    np.testing.assert_array_equal(best[some], np.where(within, values, -np.inf).argmax(axis=1)[some])
    assert 0.2 < within.mean() < 0.95


EVERY = np.arange(INSTANTS)


@pytest.fixture
def small(made):
    """Function that makes a small model and its environment."""

    def make(env_id, **kwargs):
        env = made(env_id, threads=1, **kwargs)
        return model_on(env, batch_size=16, explore_candidates=8), env

    return make


def movements(env_id, number=6, **kwargs):
    """Return a task, problems and movements of 8 actions in each."""
    task = registered_task(env_id, **kwargs)
    problem = problem_of(task, number, 3)
    actions = some_actions(task, number)
    return task, problem, actions, moves_of(task, problem, actions)


def refuse_geometry(monkeypatch):
    """Let every function that computes distances from obstacles fail, wherever it was imported to."""

    def refuse(*args, **kwargs):
        raise AssertionError("the geometry of obstacles was computed")

    for module in (viapoint.envs.geometry.clearance, viapoint.training.planning.search):
        for name, function in inspect.getmembers(module, callable):
            if getattr(function, "__module__", "") == module.__name__ and not inspect.isclass(function):
                monkeypatch.setattr(module, name, refuse)
                for user in (viaq, viapoint.training.planning.movements):
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


def test_an_obstacle_larger_than_all_in_training_is_seen_as_the_largest_as_far_away(learned):
    model, _ = learned
    network = model.policy.critic.pairs
    task, problem, _, moves = movements(PLANE)
    usual = pairs_of(task, problem, moves, EVERY)
    box = usual.features[..., LENGTHS + task.shapes.index("box")]
    longest = network.largest[task.shapes.index("box"), 0]
    assert 0.05 < longest <= 0.125  # what was met in training
    usual.features[..., 3] = torch.where(box > 0.0, longest, usual.features[..., 3])
    larger = usual._replace(features=usual.features.clone())
    larger.features[..., 0] += 0.2 * box
    larger.features[..., 3] += 0.2 * box
    torch.testing.assert_close(network(larger), network(usual))


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
        apart = configuration_clearances(arm, path, no_obstacles(INSTANTS))
        least = min(apart[:, 1].min(), CLEAR)
        # The table rounds passage times.
        assert float(found.self_clearance[scene, row]) == pytest.approx(least, abs=6e-3)


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
def test_as_many_plans_are_checked_as_one_says_and_the_best_is_taken(small, env_id, checks, monkeypatch):
    model, env = small(env_id)
    observation, checked, exact = env.reset(), {}, viaq.merits
    model.policy.checks = 0
    unchecked = model.policy.decide(observation)

    def counted(task, problem, actions):
        found = exact(task, problem, actions)
        for goal, some, worth in zip(problem.goal, actions, found, strict=True):
            checked.setdefault(goal.tobytes(), []).append((some, worth))
        return found

    monkeypatch.setattr(viaq, "merits", counted)
    model.policy.checks = checks
    decided = model.policy.decide(observation)
    most = min(checks, 48)  # there are 48 candidates
    problem = Problem.of_observation(observation, model.policy.task)
    for goal, action, alone in zip(problem.goal, decided, unchecked, strict=True):
        actions, worth = (np.concatenate(each) for each in zip(*checked[goal.tobytes()], strict=True))
        np.testing.assert_array_equal(action, actions[worth.argmax()])
        assert len(actions) == most
        # A plan is never worse than an unchecked one, which is among those that are checked.
        assert checks == 1 or (actions == alone).all(axis=-1).any()
        if env_id == MOVING:  # the plan under way is among them
            assert (actions == 0.0).all(axis=-1).any()


def test_merit_prefers_likely_success_and_orders_the_rest_by_its_probability():
    critic = policy_of(registered_task(PLANE)).critic
    zero = torch.zeros(1, 4)
    no_contact, effort = torch.tensor([[5.0, 5.0, -1.0, -3.0]]), torch.tensor([[0.0, -0.3, 9.0, 99.0]])
    values = viaq.Values(zero, zero, no_contact, zero + 5.0, zero, effort)
    merit = critic.merit(values)[0]
    assert merit.argsort(descending=True).tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(merit[:2], critic.value(values)[0, :2])


def test_a_saturated_prediction_is_pulled_back_but_never_pushed_out():
    values = torch.tensor([-2.0, -2.0, 0.0, 0.0, 2.0, 2.0], requires_grad=True)
    push = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])  # descent moves against the gradient
    viaq._Saturated.apply(values, -1.0, 1.0).backward(push)
    assert values.grad.tolist() == [0.0, -1.0, 1.0, -1.0, 1.0, 0.0]


def step(clearance, time):
    """Info of one decision, and its reward."""
    info = dict.fromkeys((*TERMS, "is_success", "collision"), 0.0)
    info |= {"reward_clearance": clearance, "elapsed": 0.3, "time": time}
    return info, np.array([sum(info[name] for name in TERMS)])


def test_clearance_is_summed_over_an_episode_and_the_decision_that_lowered_it_is_known(made):
    env = made(MOVING, 1)
    buffer = viaq.OutcomeReplayBuffer(16, env.observation_space, env.action_space, n_envs=1, device="cpu")
    observation = {name: part[:1] for name, part in env.reset().items()}
    action = np.zeros((1, 3), dtype=np.float32)
    # The third episode begins in the middle of the second one, whose end nobody sees.
    for info, reward in (
        step(0.1, 0.3), step(0.0, 0.6), step(-0.3, 0.9), step(0.0, 1.2),
        step(-0.2, 0.3), step(-0.1, 0.6), step(0.05, 0.3), step(0.0, 0.6),
    ):  # fmt: skip
        buffer.add(observation, observation, action, reward, np.array([False]), [info])
    kept = viaq.Outcomes(*buffer.outcomes[:8, 0].T)
    assert np.allclose(kept.clearance, [0.1, 0.1, -0.2, -0.2, -0.2, -0.3, 0.05, 0.05])
    assert kept.lower.tolist() == [1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    assert np.allclose(buffer.elapsed[:8], 0.3)


def test_without_terms_only_the_sum_is_learned_from(small):
    model, _ = small(PLANE)
    model.learn(64)
    model.replay_buffer.outcomes[:] = np.nan
    before = model.policy.critic.pairs.layers[0].weight.clone()
    losses = model._losses(model.replay_buffer.sample_places(16))
    assert losses["reward"].item() > 0.0
    assert all(loss.item() == 0.0 for name, loss in losses.items() if name != "reward")
    model.train(20, 16)
    assert not torch.equal(before, model.policy.critic.pairs.layers[0].weight)


def test_each_decision_is_looked_at_once_however_often_it_is_learned_from(small, monkeypatch):
    model = small(MOVING, n_obstacles=1)[0].learn(64)
    model.train(40, 64)
    monkeypatch.setattr(viaq.ViaQPolicy, "inputs", None)
    model.train(1, 64)


def test_a_clearance_that_is_predicted_too_high_weighs_more(small):
    outcomes = viaq.Outcomes(*torch.tensor([[0.0], [0.0], [0.0], [1.0], [0.0]]))

    def loss(margin):
        values = viaq.Values(*torch.full((6, 1), margin))
        return small(PLANE)[0]._clearance_loss(values, outcomes, torch.ones(1)).item()

    assert loss(0.004) / loss(-0.004) == pytest.approx(viaq.TOO_HIGH)


def effort_loss(model, ended, success=1.0):
    np.random.seed(0)  # noqa: NPY002 - of the replay buffer
    buffer = model.replay_buffer
    buffer.dones[:], buffer.outcomes[..., viaq.Outcomes._fields.index("success")] = ended, success
    return model._losses(buffer.sample_places(64))["effort"].item()


def test_what_follows_counts_only_where_an_episode_goes_on(small):
    model = small(MOVING, n_obstacles=1)[0].learn(128)
    goes_on, over = effort_loss(model, 0.0), effort_loss(model, 1.0)
    assert effort_loss(model, 1.0, success=0.0) == over
    model.gamma = 0.5
    assert effort_loss(model, 1.0) == over
    assert effort_loss(model, 0.0) != goes_on
    whole = small(PLANE)[0].learn(64)  # one that stops early says nothing about its plan
    assert effort_loss(whole, 1.0, success=0.0) == 0.0 < effort_loss(whole, 1.0)


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


def test_the_nearest_pairs_are_those_of_the_closest_approach():
    task, problem, _, _ = movements(PLANE, 60, shapes=("box",))
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 32, task.action.size))
    pairs = pairs_of(task, problem, moves_of(task, problem, actions), EVERY)
    radius = pairs.features[..., 6]
    nearest = torch.where(pairs.present, pairs.distance - radius, 1.0).amin(dim=-1).numpy()
    clearance = plan_clearances(task, problem, actions, 0.02, -0.05, exact=True)
    near = (np.abs(clearance) < 0.01) & pairs.inside.numpy()
    assert near.sum() > 100
    assert np.quantile(np.abs(nearest - clearance)[near], 0.95) < 1.5e-3


@pytest.fixture(scope="module")
def agent():
    # So success is that of the network alone.
    own = {"candidates": 64, "caution": 0.0, "effort": 0.05}
    few = {"explore_candidates": 32, "labels": 16, "batch_size": 48, "policy_kwargs": own}
    env = ViaVecEnv(SENSED, 32, seed=0)
    return ViaRank("ViaRankPolicy", env, seed=0, gradient_steps=8, **few).learn(256)


def test_it_learns_in_seconds(agent) -> None:
    # The untrained network solves 2 % of these scenes, and a search that knows only the points 20 %.
    result = evaluate(agent, scenes="validation", n_scenes=100, time_decisions=False)
    assert result.success_rate > 0.35


def test_predicted_success_is_calibrated(agent) -> None:
    simulation = SceneSimulation(SENSED)
    scenes = scenes_of(simulation.task, 300, 9)
    actions, predicted = agent.policy.assess(simulation.observe(scenes))
    assert abs(predicted.mean() - simulation(scenes, actions)["is_success"].mean()) < 0.08


def test_rounds_of_candidates_never_lower_the_best_value(agent) -> None:
    policy = agent.policy
    scenes = scenes_of(policy.task, 16, 5)
    problem, sight = Problem.of_scenes(scenes, policy.task), Sight.of_scenes(scenes, policy.task)
    rank = functools.partial(policy.rank, policy.beliefs(problem, sight), sight)
    actions, value = policy.proposals(16, rank)
    first = value[:, : policy.candidates].max(axis=1)
    assert actions.shape[1] == policy.all_candidates > policy.candidates
    assert (value.max(axis=1) >= first).all()
    assert (value.max(axis=1) > first).mean() > 0.5


def cleared_depths(policy, scenes, actions):
    """Return the depth that each action clears, as part of its worth."""
    problem, sight = Problem.of_scenes(scenes, policy.task), Sight.of_scenes(scenes, policy.task)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy, "effort", 0.0)
        patch.setattr(policy, "caution", policy.depths[-1])
        return policy.inputs(policy.beliefs(problem, sight), sight, actions)[1]


def test_cautious_plans_keep_from_what_may_be_behind_fronts(agent, monkeypatch) -> None:
    policy, simulation = agent.policy, SceneSimulation(SENSED)
    scenes = scenes_of(simulation.task, 32, 7)
    depths = []
    for caution in (0.0, 4.0):
        monkeypatch.setattr(policy, "caution", caution)
        actions = policy.decide(simulation.observe(scenes))[:, None]
        depths.append(cleared_depths(policy, scenes, actions))
    assert (depths[1] >= depths[0]).mean() > 0.9
    assert depths[1].mean() > depths[0].mean()


def test_a_plan_that_clears_a_depth_clears_lesser_ones(agent) -> None:
    policy, task = agent.policy, agent.policy.task
    scenes = scenes_of(task, 16, 3)
    problem, sight = Problem.of_scenes(scenes, task), Sight.of_scenes(scenes, task)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (16, 64, task.action.size))
    cleared = cleared_depths(policy, scenes, actions)
    np.testing.assert_allclose(np.unique(cleared), policy.depths)
    for depth in policy.depths[1:]:
        belief = problem._replace(obstacles=thick_points(task, sight, depth))
        clearance = plan_clearances(task, belief, actions, CLEARANCE_MARGIN, CLEARANCE_MARGIN)
        # Points of a deeper belief are in cubes of their own, so that few plans differ.
        assert ((cleared > depth - 1e-9) == (clearance >= CLEARANCE_MARGIN)).mean() > 0.9


def test_places_are_those_of_the_movement() -> None:
    task = registered_task(SENSED)
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


# Plans near the straight line are learned sooner.
LOOKING = {"sensor": "hand_rays", "decide_at": ["horizon"], "horizon": 0.3, "via_range": 1.0}


def test_it_learns_to_revise_plans() -> None:
    env = ViaVecEnv(SENSED, 32, seed=0, **LOOKING)
    own = {"candidates": 64, "refinements": 0, "caution": 0.0, "effort": 0.05}
    small = {"explore_candidates": 24, "labels": 12, "policy_kwargs": own}
    agent = ViaRank("ViaRankPolicy", env, seed=1, gradient_steps=8, **small).learn(256)
    settings = {"env": SENSED, "env_kwargs": LOOKING, "scenes": "validation", "n_scenes": 50}
    result = evaluate(agent, baselines=["untrained"], time_decisions=False, **settings)
    learned, untrained = [row["success"]["rate"] for row in result.rows]
    assert learned > untrained + 0.3


def test_what_any_look_saw_to_be_free_is_free() -> None:
    env = ViaVecEnv(SENSED, 16, seed=0, **LOOKING)
    task, observation = env.venv.unwrapped.task, env.reset()
    for _ in range(3):
        observation, *_ = env.step(np.zeros((16, task.action.size), np.float32))
    sight = Sight.of(observation, task)
    made = np.repeat(sight.made, task.sensor.n_rays, axis=1)
    assert sight.made[:, 1].any()
    assert not sight.made.all()
    # A place on a ray, before what the ray meets
    places = sight.eyes + 0.8 * (sight.points - sight.eyes)
    ray, distance = sight.towards(task.sensor, places.astype(np.float32))
    free = np.take_along_axis(sight.ranges, np.maximum(ray, 0), axis=1) >= distance
    assert ((ray >= 0) & free)[made].all()


def test_full_knowledge_is_the_best_belief() -> None:
    methods = ["known:search512", "seen:search512", "points:search512"]
    methods += ["thick:plan_motion", "deep:plan_motion"]
    result = evaluate(env=SENSED, scenes="validation", n_scenes=60, baselines=methods, time_decisions=False)
    known, seen, points, thick, deep = [row["success"]["rate"] for row in result.rows]
    assert known > 0.9
    assert known > seen > points
    assert deep > thick + 0.1  # less than on an idle machine: its time is limited


def test_sets_of_scenes_are_solvable_and_partly_hidden() -> None:
    task = registered_task(SENSED)
    frozen = scenes_for("validation", task)
    known = registered_task(PLANE)
    assert not np.isin(frozen.scenes.start[:, 0], scenes_for("validation", known).scenes.start[:, 0]).any()
    assert 0.1 < frozen.hidden.mean() < 0.5
    problem = Problem.of_scenes(frozen.scenes, task)
    straight = np.zeros((len(frozen.share), 1, task.action.size))
    assert (plan_clearances(task, problem, straight, 0.01, 0.0)[:, 0] < 0.01).all()
