"""Laws of the minimum critics, of what they learn from, and of learning without the geometry of obstacles."""

import inspect
import itertools

import gymnasium as gym
import numpy as np
import pytest
import torch
from contacts import KINDS, random_obstacles
from hypothesis import given, settings
from hypothesis import strategies as st

import viapoint.envs.geometry.broad_phase
import viapoint.envs.geometry.distance
import viapoint.envs.geometry.narrow_phase
import viapoint.envs.scenes.dynamic_scene
import viapoint.envs.sim.outcome
import viapoint.training.planning.plan_checks
import viapoint.training.planning.planned_clearance
import viapoint.training.planning.search
from viapoint.training.agents import viaq_policy
from viapoint.training.agents.obstacle_parts import (
    PART,
    Poses,
    ShapePairs,
    cut_obstacles,
    pair_features,
    whole_obstacles,
)
from viapoint.training.agents.outcome_buffer import OutcomeReplayBuffer, Outcomes, outcome_of
from viapoint.training.agents.pair_networks import PairMinimum
from viapoint.training.agents.viaq import ViaQ
from viapoint.training.agents.viaq_critic import Values, _Saturated
from viapoint.training.planning.candidates import best_duration, candidate_actions
from viapoint.training.planning.plan_checks import INFEASIBLE
from viapoint.training.planning.search import score_plans
from viapoint.training.rollouts.vec_env import TERMS, ViaVecEnv

PLANE, WHOLE, SPACE = (
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArm-v0",
    "viapoint/PandaObstacles-v0",
)
MOVING = "viapoint/PlanarMovingObstacles-v0"
KNOW_OBSTACLES = (
    viapoint.envs.geometry.narrow_phase,
    viapoint.envs.geometry.distance,
    viapoint.envs.scenes.dynamic_scene,
    viapoint.envs.geometry.broad_phase,
    viapoint.envs.sim.outcome,
    viapoint.training.planning.plan_checks,
    viapoint.training.planning.planned_clearance,
    viapoint.training.planning.search,
)
FEW = {"candidates": 32, "refinements": 1, "per_refinement": 16, "width": 8}


def small(env_id, **kwargs):
    env = ViaVecEnv(env_id, 8, seed=0, threads=1, **kwargs)
    settings = {"learning_starts": 16, "batch_size": 16, "gradient_steps": 1, "explore_candidates": 8}
    model = ViaQ("ViaQPolicy", env, seed=0, policy_kwargs=dict(FEW), **settings)
    return model, env


def refuse_geometry(monkeypatch):
    """Let every function that could know of obstacles fail, wherever it was imported to."""

    def refuse(*args, **kwargs):
        raise AssertionError("the geometry of obstacles was computed")

    for module in KNOW_OBSTACLES:
        for name, function in inspect.getmembers(module, inspect.isfunction):
            if function.__module__ == module.__name__:
                monkeypatch.setattr(module, name, refuse)
                for user in (viaq_policy, viapoint.training.agents.viaq):
                    if getattr(user, name, None) is function:
                        monkeypatch.setattr(user, name, refuse)


@pytest.mark.parametrize("env_id", [PLANE, WHOLE, SPACE, MOVING])
@pytest.mark.parametrize("shapes", [("capsule",), ("capsule", "box", "cylinder")])
def test_nothing_is_learned_or_decided_from_the_geometry_of_obstacles(env_id, shapes, monkeypatch):
    model, env = small(env_id, shapes=shapes)
    model.learn(32)
    observation = env.reset()
    refuse_geometry(monkeypatch)
    model.policy.checks = 0
    model.train(2, 8)
    model._sample_action(0, None, 8)
    actions, _ = model.predict(observation)
    assert actions.shape == (8, *env.action_space.shape)
    model.policy.checks = 4
    with pytest.raises(AssertionError, match="geometry"):
        model.predict(observation)
    env.close()


@pytest.mark.parametrize("env_id", [WHOLE, MOVING])
@pytest.mark.parametrize("checks", [1, 3, 11, 64])
def test_as_many_plans_are_checked_as_one_says_and_the_best_of_them_is_taken(env_id, checks, monkeypatch):
    model, env = small(env_id)
    observation, scored = env.reset(), {}

    def score(observation, actions, task, margins):
        merits = score_plans(observation, actions, task, margins)
        for goal, *found in zip(observation["goal"], actions, merits, strict=True):
            scored.setdefault(goal.tobytes(), []).append(found)
        return merits

    monkeypatch.setattr(viaq_policy, "score_plans", score)
    model.policy.checks = checks
    decided = model.policy.decide(observation)
    numbers, most = set(), min(checks, 48)  # there are 48 candidates
    for goal, action in zip(observation["goal"], decided, strict=True):
        actions, merits = (np.concatenate(each) for each in zip(*scored[goal.tobytes()], strict=True))
        numbers.add(len(actions))
        np.testing.assert_array_equal(action, actions[merits.argmax()])
        if env_id == MOVING:  # the plan under way is among them
            assert (actions == 0.0).all(axis=-1).any()
        elif len(actions) < most:  # further plans are checked only where none is clear
            assert merits.max() > 0.5 * INFEASIBLE
    env.close()
    assert numbers <= {most} if env_id == MOVING else max(numbers) == most
    assert numbers <= {most, viaq_policy.PROPOSALS}


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    st.lists(st.floats(-0.17, 0.17), min_size=3, max_size=3),
    st.floats(0.005, 0.1),
    st.sampled_from([2, 3]),
)
def test_the_parts_of_an_obstacle_are_short_and_together_are_the_obstacle(centre, half, radius, d):
    row = np.array([[[*centre[:d], *half[:d], radius]]])
    parts = cut_obstacles(row, np.ones((1, 1), dtype=bool))
    assert parts.present.all()
    lengths = parts.half_axis.norm(dim=-1)
    assert (lengths <= PART[d] * 1.001 + 1e-5).all()
    assert lengths.sum() == pytest.approx(np.linalg.norm(half[:d]), abs=1e-5)
    ends = torch.cat((parts.centre - parts.half_axis, parts.centre + parts.half_axis), dim=1)[0]
    for sign in (
        -1.0,
        1.0,
    ):  # both ends of the obstacle are ends of parts, and each part begins where one ends
        end = torch.tensor(centre[:d]) + sign * torch.tensor(half[:d])
        assert (ends - end).norm(dim=-1).min() < 1e-5
    first, last = (parts.centre + sign * parts.half_axis for sign in (-1.0, 1.0))
    for before, after in itertools.pairwise(range(parts.centre.shape[1])):
        assert torch.allclose(last[0, before], first[0, after], atol=1e-5)
    assert torch.allclose(parts.radius, torch.full_like(parts.radius, radius))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("with_axis", [False, True])
def test_a_pair_looks_the_same_from_everywhere(d, with_axis):
    """Rotations, reflections and the direction in which an obstacle is written change nothing."""
    generator = torch.Generator().manual_seed(0)
    centre, axis, half = (torch.randn(64, d, generator=generator, dtype=torch.float64) for _ in range(3))
    axis = axis / axis.norm(dim=-1, keepdim=True)
    radius = torch.rand(64, generator=generator, dtype=torch.float64)

    def features(turn, sign=1.0):
        parts = [[(each @ turn)[:, i] for i in range(d)] for each in (centre, axis, sign * half)]
        return torch.stack(pair_features(parts[0], parts[1] if with_axis else None, parts[2], radius))

    seen = features(torch.eye(d, dtype=torch.float64))
    for _ in range(5):
        turn, _ = torch.linalg.qr(torch.randn(d, d, generator=generator, dtype=torch.float64))
        assert torch.allclose(features(turn), seen, atol=1e-4)
    assert torch.allclose(features(torch.eye(d, dtype=torch.float64), -1.0), seen, atol=1e-4)


@pytest.mark.parametrize("d", [2, 3])
def test_features_of_a_link_change_little_when_an_obstacle_turns_a_little(d):
    """Also where the obstacle is parallel or square to the link: a jump there would be two inputs for one pose."""
    angle = torch.linspace(0.0, 2.0 * torch.pi, 10_001)
    half = [0.05 * torch.cos(angle), 0.05 * torch.sin(angle), torch.full_like(angle, 0.02)][:d]
    for place in ((0.0, 0.1, 0.02), (0.1, 0.1, 0.0), (0.2, -0.03, 0.0)):
        centre = [torch.full_like(angle, each) for each in place[:d]]
        axis = [torch.full_like(angle, each) for each in (1.0, 0.0, 0.0)[:d]]
        seen = torch.stack(pair_features(centre, axis, half, torch.tensor(0.01)))
        assert (seen[:, 1:] - seen[:, :-1]).abs().max() < 1e-4
        if d == 2:  # half a turn is the same obstacle
            assert torch.allclose(seen[:, :5000], seen[:, 5000:-1], atol=1e-5)


def scene(number=4, plans=5, instants=6, networks=(0, 1), d=3):
    torch.manual_seed(1)
    bodies = max(len(networks), 1)
    poses = Poses(
        torch.randn(bodies, d, number, plans, instants),
        torch.nn.functional.normalize(torch.randn(bodies, d, number, plans, instants), dim=1),
        torch.linspace(0.0, 1.0, instants).expand(number, plans, -1),
        torch.linspace(0.1, 0.2, bodies),
        torch.linspace(0.03, 0.05, bodies),
    )
    rows = np.random.default_rng(0).uniform(-0.2, 0.2, (number, 3, 2 * d + 1))
    rows[..., -1] = 0.02
    return poses, rows, PairMinimum(d, networks, 8)


@pytest.mark.parametrize("networks", [(0, 1), (0, 0, 1)])
def test_the_minimum_is_that_of_all_bodies_instants_and_obstacles(networks):
    poses, rows, network = scene(networks=networks)
    present = np.array([[True, True, True], [True, False, True], [False, True, False], [False, False, False]])
    whole = network(poses, cut_obstacles(rows, present))
    single = []
    for obstacle, instant, body in itertools.product(range(3), range(6), range(len(networks))):
        only = present & (np.arange(3) == obstacle)
        one = Poses(
            poses.centre[..., instant : instant + 1],
            poses.axis[..., instant : instant + 1],
            poses.time[..., :1],
            *poses[3:],
        )
        parts = cut_obstacles(rows, only)
        values = network._values(one, parts, *torch.nonzero(parts.present, as_tuple=True))[:, :, body, 0]
        scenes = torch.nonzero(parts.present, as_tuple=True)[0]
        each = torch.full(whole.shape, torch.inf)
        for row, value in zip(scenes, values, strict=True):
            each[row] = torch.minimum(each[row], value * 0.05)
        single.append(each)
    expected = torch.stack(single).amin(dim=0)
    assert torch.allclose(whole[:3], expected[:3], atol=1e-5)
    assert (whole[3] == 1.0).all()
    with torch.no_grad():
        assert torch.allclose(network(poses, cut_obstacles(rows, present)), whole, atol=1e-5)


@pytest.mark.parametrize("size", ["half_length", "radius"])
def test_bodies_that_share_a_network_differ_by_their_size(size):
    """Of two bodies in one place one is longer or thicker: values differ, and they change places with the bodies."""
    poses, rows, network = scene(networks=(0, 0, 1))
    parts = cut_obstacles(rows, np.ones((4, 3), dtype=bool))
    scenes = torch.nonzero(parts.present, as_tuple=True)
    same = poses._replace(**{each: getattr(poses, each)[[0, 0, 2]] for each in ("half_length", "radius")})
    same = same._replace(centre=poses.centre[[0, 0, 2]], axis=poses.axis[[0, 0, 2]])
    values, swapped = (
        network._values(same._replace(**{size: getattr(poses, size)[order]}), parts, *scenes)
        for order in ([0, 1, 2], [1, 0, 2])
    )
    assert not torch.allclose(values[:, :, 0], values[:, :, 1])
    torch.testing.assert_close(values, swapped[:, :, [1, 0, 2]])


@pytest.mark.parametrize("networks", [(), (0, 1), (0, 0, 1)])
def test_near_pairs_give_an_upper_bound_of_the_minimum_and_all_pairs_give_the_minimum(networks):
    poses, rows, network = scene(networks=networks)
    if not networks:
        poses = Poses(poses.centre, None, poses.time)
    present = np.array([[True, True, True], [True, False, True], [False, True, False], [False, False, False]])
    velocity = np.random.default_rng(1).uniform(-0.2, 0.2, (4, 3, 3))
    for moving in (None, velocity):
        parts = cut_obstacles(rows, present, moving)
        with torch.no_grad():
            whole = network(poses, parts)
        least = []
        for near in (0.0, 0.12, np.inf):
            least.append(network.of_near_pairs(poses, parts, near))
            assert (least[-1] >= whole - 1e-6).all()
        assert not networks or (least[0] > whole + 1e-3).any()  # one pair of links is not enough
        assert torch.allclose(least[-1], whole, atol=1e-6)


def test_only_what_was_carried_out_counts_where_one_says_until_when():
    poses, rows, network = scene()
    parts = cut_obstacles(rows, np.ones((4, 3), dtype=bool))
    some = Poses(poses.centre[..., :3], poses.axis[..., :3], poses.time[..., :3])
    until = torch.full(poses.time.shape[:2], 0.45)  # instants are 0, .2, .4, .6, .8 and 1
    assert torch.allclose(network(poses, parts, until), network(some, parts))
    assert torch.allclose(network(poses, parts, until + torch.inf), network(poses, parts))


def test_gradients_flow_through_the_responsible_pair_alone():
    poses, rows, network = scene()
    parts = cut_obstacles(rows, np.ones((4, 3), dtype=bool))
    with torch.no_grad():
        searched = network(poses, parts)
    learned = network(poses, parts)
    assert torch.allclose(searched, learned, atol=1e-6)
    centre = poses.centre.clone().requires_grad_()
    network(poses._replace(centre=centre), parts)[0, 0].backward()
    touched = (centre.grad.abs().sum(dim=1) > 0.0).nonzero()
    assert len(touched) <= 1


def test_a_saturated_prediction_is_pulled_back_but_never_pushed_out():
    values = torch.tensor([-2.0, -2.0, 0.0, 0.0, 2.0, 2.0], requires_grad=True)
    push = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])  # descent moves against the gradient
    _Saturated.apply(values, -1.0, 1.0).backward(push)
    assert values.grad.tolist() == [0.0, -1.0, 1.0, -1.0, 1.0, 0.0]


def test_merit_prefers_likely_success_and_orders_the_rest_by_its_probability():
    model, env = small(PLANE)
    zero = torch.zeros(1, 4)
    values = Values(
        zero, torch.tensor([[5.0, 5.0, -1.0, -3.0]]), zero + 5.0, zero, torch.tensor([[0.0, -0.3, 9.0, 99.0]])
    )
    merit = model.policy.critic.merit(values)[0]
    assert merit.argsort(descending=True).tolist() == [0, 1, 2, 3]
    assert torch.allclose(merit[:2], model.policy.critic.value(values)[0, :2])
    env.close()


def step(clearance, done=False, **more):
    """Info of one decision."""
    info = dict.fromkeys(TERMS, 0.0) | {"reward_clearance": clearance, "elapsed": 0.3, **more}
    return info, sum(info[name] for name in TERMS), done


def test_clearance_is_summed_over_an_episode_and_the_decision_that_lowered_it_is_known():
    env = ViaVecEnv(MOVING, 1, seed=0)
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
    env.close()


def test_without_terms_only_the_sum_is_learned_from():
    assert np.isnan(outcome_of({"is_success": True}, 1.0)).all()
    model, env = small(PLANE)
    model.learn(64)
    model.replay_buffer.outcomes[:] = np.nan
    before = model.policy.critic.pairs.networks.weights[0].clone()
    losses = model._losses(model.replay_buffer.sample_outcomes(16))
    assert losses["reward"].item() > 0.0
    assert all(loss.item() == 0.0 for name, loss in losses.items() if name != "reward")
    model.train(20, 16)
    assert not torch.equal(before, model.policy.critic.pairs.networks.weights[0])
    env.close()


def test_what_follows_counts_only_where_an_episode_goes_on():
    model, env = small(MOVING, n_obstacles=1)
    model.learn(128)
    batch = model.replay_buffer.sample_outcomes(64)

    def effort(ended, gamma):
        model.gamma = gamma
        return model._losses(batch._replace(ended=np.full_like(batch.ended, ended)))["effort"].item()

    assert effort(1.0, 0.5) == effort(1.0, 1.0) != effort(0.0, 1.0)
    env.close()


@pytest.mark.parametrize("temperature", [1e-3, 1e6])
def test_exploration_goes_from_the_best_candidate_to_any(temperature, monkeypatch):
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
    env.close()


@pytest.mark.parametrize("env_id", [PLANE, SPACE])
def test_candidates_are_different_allowed_and_begin_with_the_straight_movement(env_id):
    task = gym.make(env_id).unwrapped.task
    actions = candidate_actions(task, 64, replanning=False)
    assert (actions[0] == 0.0).all()
    assert (np.abs(actions) <= 1.0).all()
    assert len(np.unique(actions, axis=0)) == 64
    at = task.action.n_via * task.action.dimension
    assert np.allclose(actions[1:, at], best_duration(task))
    low, high = task.action.duration_range
    durations = np.linspace(-1.0, 1.0, 401)
    relative = (high / low) ** (0.5 * durations)
    worth = 5.0 * task.weights.smoothness * np.log(relative) - task.weights.duration * (relative - 1.0)
    assert durations[worth.argmax()] == pytest.approx(best_duration(task), abs=0.01)


def shape_pairs(count=64):
    """Bodies near obstacles of all kinds: vectors to the obstacles, axes of the bodies, and obstacles' columns."""
    generator = np.random.default_rng(0)
    rows = np.concatenate([random_obstacles(kind, np.zeros((count, 3)), generator) for kind in KINDS])
    parts = whole_obstacles(rows[:, None], KINDS)
    apart, axis = generator.normal(size=(2, len(rows), 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    columns = list(parts.columns[:, 0].T)
    return *(list(torch.tensor(each.T, dtype=torch.float32)) for each in (0.3 * apart, axis)), columns


def test_features_of_shapes_do_not_change_with_the_symmetries_of_their_boxes():
    pairs, (apart, axis, columns) = ShapePairs(len(KINDS), True), shape_pairs()
    wanted = torch.stack(pairs.features(apart, axis, columns))
    assert wanted.shape == (pairs.inputs, 64 * len(KINDS))
    for flipped in range(3):  # a frame with one axis reversed is that of the same box
        other = [-each if index // 3 == flipped else each for index, each in enumerate(columns)]
        np.testing.assert_allclose(torch.stack(pairs.features(apart, axis, other)), wanted, atol=1e-5)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    rotate = lambda vector: list(turn @ torch.stack(vector))  # noqa: E731
    other = [*rotate(columns[:3]), *rotate(columns[3:6]), *rotate(columns[6:9]), *columns[9:]]
    again = pairs.features(rotate(apart), rotate(axis), other)
    np.testing.assert_allclose(torch.stack(again), wanted, atol=1e-5)


def test_features_of_shapes_change_little_when_a_body_moves_a_little():
    """Also where it crosses the planes of symmetry of the box."""
    pairs, (apart, axis, columns) = ShapePairs(len(KINDS), True), shape_pairs(8)
    share = torch.linspace(-1.0, 1.0, 10_001)[:, None]
    for direction in torch.eye(3):
        moved = [0.5 * each + 0.3 * along * share for each, along in zip(apart, direction, strict=True)]
        seen = torch.stack([each.expand(len(share), -1) for each in pairs.features(moved, axis, columns)])
        steps = (seen[:, 1:] - seen[:, :-1]).abs().amax(dim=(0, 1))
        boxes = torch.arange(8) + 8 * KINDS.index("box")
        assert steps[boxes].max() < 1e-3


def test_round_shapes_may_turn_about_their_axis():
    pairs, (apart, axis, columns) = ShapePairs(len(KINDS), True), shape_pairs()
    first, second = (torch.stack(columns[i : i + 3]) for i in (0, 3))
    other = [*(0.6 * first + 0.8 * second), *(0.6 * second - 0.8 * first), *columns[6:]]
    wanted, again = (torch.stack(pairs.features(apart, axis, each)) for each in (columns, other))
    changed = (wanted - again).abs().amax(dim=0).reshape(len(KINDS), -1).amax(dim=1) > 1e-4
    assert [kind for kind, each in zip(KINDS, changed, strict=True) if each] == ["box"]


def test_gaps_of_shapes_are_those_of_the_axis_at_its_point_nearest_to_the_part():
    poses, _, _ = scene(number=1)
    pairs, (_, _, columns) = ShapePairs(len(KINDS), True), shape_pairs(1)
    columns = [each[:, None, None] for each in columns]
    apart, axis = (
        torch.stack([each[:, i, 0, None].expand(-1, len(KINDS), -1, -1) for i in range(3)])
        for each in (-poses.centre, poses.axis)
    )
    gap = pairs.gap([*apart], [*axis], columns, poses)
    length, radius = (each[:, None, None, None] for each in (poses.half_length, poses.radius))
    points = torch.stack([apart - t * length * axis for t in np.linspace(-1.0, 1.0, 2001)])
    nearest = points.norm(dim=1).argmin(dim=0)
    points = points.gather(0, nearest[None, None].expand(1, 3, *nearest.shape))[0]
    wanted = pairs.gap([*points], None, columns, poses) - radius
    np.testing.assert_allclose(gap, wanted, atol=1e-3)


def test_near_pairs_of_shapes_give_an_upper_bound_that_is_mostly_the_minimum():
    model, env = small(SPACE, shapes=("capsule", "box", "cylinder"))
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 16, 4)).astype(np.float32)
    with torch.no_grad():
        inputs = model.policy.inputs(env.reset(), actions)
        pairs, parts = model.policy.critic.pairs, inputs.scene.parts
        whole = pairs(inputs.poses, parts)
        near = pairs.of_near_pairs(inputs.poses, parts, ShapePairs.near)
        everywhere = pairs.of_near_pairs(inputs.poses, parts, np.inf)
    assert (near >= whole - 1e-6).all()
    assert (near - whole < 1e-6).float().mean() > 0.5
    assert torch.allclose(everywhere, whole, atol=1e-6)
    env.close()
