"""Laws of drawn scenes, of those about a feasible path and of uniform ones, and of given scenes."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import ADULT, PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.geometry.rows import CAPSULES, shape_columns, shape_number
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.draws import Uniforms
from viapoint.envs.scenes.sampler import SceneSampler, UniformSampler
from viapoint.envs.scenes.scene import TARGETS, check_scenes, rest_clearance, rows_of_lights
from viapoint.envs.vector_env import ReachVectorEnv

NUMBER = 96
HAND, WHOLE_ARM, SPACE = (
    f"viapoint/{name}-v0" for name in ("PlanarObstacles", "PlanarWholeArm", "PandaObstacles")
)
WHOLE_PANDA = CollisionModel(PANDA, whole_arm=True)


def seeded(number=NUMBER):
    return [np.random.default_rng(seed) for seed in range(number)]


def lines(scenes):
    """Positions along straight movements."""
    return scenes.start[:, None] + (scenes.goal - scenes.start)[:, None] * np.linspace(0, 1, 60)[:, None]


def assert_same(one, other):
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.fixture(scope="module", params=[HAND, WHOLE_ARM, SPACE], ids=["hand", "whole arm", "space"])
def env(request):
    made = gym.make_vec(request.param, num_envs=NUMBER, threads=1).unwrapped
    yield made
    made.close()


@pytest.fixture(scope="module", params=[SceneSampler, UniformSampler], ids=["path", "uniform"])
def sampler(request, env):
    return request.param(env.task.collision_model, env.task.scenes)


@pytest.fixture(scope="module")
def scenes(sampler):
    return sampler(seeded())


def test_scenes_can_begin_and_end_and_the_straight_movement_collides(env, sampler, scenes):
    model, distribution = env.task.collision_model, env.task.scenes
    check_scenes(scenes, model)
    margin = distribution.end_margin if isinstance(sampler, UniformSampler) else 0.0
    for point in (scenes.start, scenes.goal):
        clearance = rest_clearance(scenes, point, model)[:, :-1]
        assert (clearance[scenes.present] > margin).all()
        assert (env.arm.reach_margin(point) > distribution.reach_margin).all()
    assert (model.least_clearance(lines(scenes), scenes.obstacles, scenes.present) < -0.003).all()
    env.reset(options=scenes.as_options())
    info = env.execute_actions(np.zeros(env.action_space.shape)).info
    assert info["collision"].all()
    assert not info["is_success"].any()


def test_numbers_and_sizes_of_obstacles_are_those_of_the_task(env, scenes):
    distribution = env.task.scenes
    fewest, most = distribution.n_obstacles
    assert set(scenes.present.sum(axis=-1)) == set(range(fewest, most + 1))
    assert (scenes.obstacles[~scenes.present] == 0.0).all()
    radii = [distribution.post_radius, distribution.bar_radius]
    radii += [distribution.sphere_radius, distribution.pillar_radius] if env.arm.dimension == 3 else []
    some = scenes.obstacles[scenes.present]
    capsule = shape_columns(some).kind == shape_number("capsule")
    assert capsule.all() == (distribution.shapes == CAPSULES)
    radius = some[capsule, -1]
    assert radius.min() >= min(low for low, _ in radii)
    assert radius.max() <= max(high for _, high in radii)


def test_a_scene_depends_on_its_own_generator_alone(sampler, scenes):
    for row in (0, 7, 39):
        assert_same(sampler([seeded()[row]]), scenes.take([row]))


@pytest.mark.parametrize("kind", [SceneSampler, UniformSampler])
@pytest.mark.parametrize("env_id", [WHOLE_ARM, SPACE])
def test_room_for_given_obstacles_does_not_change_drawn_ones(env_id, kind):
    drawn = []
    for most in (8, 24):
        task = gym.make(env_id, n_obstacles=(1, most)).unwrapped.task
        drawn.append(kind(task.collision_model, task.scenes)(seeded(6)))
    few, many = drawn
    np.testing.assert_array_equal(many.obstacles[:, :8], few.obstacles)
    assert many.obstacles.shape[1] == 24
    assert not many.present[:, 8:].any()


@pytest.mark.parametrize(("env_id", "share"), [(HAND, 0.85), (WHOLE_ARM, 0.6), (SPACE, 0.6)])
def test_random_movements_solve_most_scenes(env_id, share):
    """Physics agrees with the construction about a feasible path."""
    env = gym.make_vec(env_id, num_envs=60, threads=1).unwrapped
    env.reset(seed=0)
    scenes, rng, solved = env.scenes, np.random.default_rng(0), np.zeros(60, dtype=bool)
    for _ in range(60):
        env.reset(options=scenes.as_options())
        info = env.execute_actions(rng.uniform(-1.0, 1.0, env.action_space.shape)).info
        solved |= info["is_success"]
        agree = info["collision"] == (info["min_clearance"] < 0.0)
        assert agree[info["reachable"]].all()
        if solved.mean() > share:
            break
    assert solved.mean() > share


@pytest.mark.parametrize("whole_arm", [False, True])
def test_in_the_plane_the_straight_line_hits_posts_and_bars(whole_arm):
    scenes = SceneSampler(CollisionModel(ADULT, whole_arm), SceneDistribution())(seeded(300))
    bars = (scenes.obstacles[..., 2:4] ** 2).sum(axis=-1) > 0.0
    assert 0.2 < bars[scenes.present].mean() < 0.8
    squared = segment_distance_squared(scenes.start[:, None], scenes.goal[:, None], scenes.obstacles)[..., 0]
    clearance = np.sqrt(squared) - scenes.obstacles[..., -1] - ADULT.hand_radius
    assert (np.where(scenes.present, clearance, np.inf).min(axis=-1) < -0.003).all()


def test_in_space_ends_are_as_far_apart_and_as_level_as_stated_and_obstacles_of_every_kind():
    scenes, d = SceneSampler(WHOLE_PANDA, SpaceDistribution())(seeded(60)), SpaceDistribution()
    line = scenes.goal - scenes.start
    length = np.linalg.norm(line, axis=-1)
    assert ((length > d.distance[0] - 1e-9) & (length < d.distance[1] + 1e-9)).all()
    assert (np.abs(line[:, 2]) <= d.steepness * length + 1e-9).all()
    low, high = PANDA.workspace
    for place in (scenes.start, scenes.goal):
        assert ((place >= low) & (place <= high)).all()
    axis = scenes.obstacles[scenes.present][:, 3:6]
    upright = (axis[:, :2] == 0.0).all(axis=-1)
    spheres, posts = upright & (axis[:, 2] == 0.0), upright & (axis[:, 2] > 0.0)
    assert min(spheres.mean(), posts.mean(), (~upright).mean()) > 0.05


def test_ends_and_obstacles_of_uniform_scenes_are_anywhere_in_the_workspace(env):
    scenes = UniformSampler(env.task.collision_model, env.task.scenes)(seeded())
    low, high = (np.array(corner) for corner in env.arm.workspace)
    apart = np.linalg.norm(scenes.goal - scenes.start, axis=-1)
    assert apart.min() < env.task.scenes.distance[0]
    assert apart.max() > env.task.scenes.distance[1]
    centre = scenes.obstacles[scenes.present][:, :2]  # posts on the table have other heights
    for points in (scenes.start, scenes.goal, centre):
        size = points.shape[1]
        share = (points - low[:size]) / (high - low)[:size]
        assert ((share >= 0.0) & (share <= 1.0)).all()
        assert (share.min(axis=0) < 0.12).all()
        assert (share.max(axis=0) > 0.88).all()
    d = env.arm.dimension
    bars = scenes.obstacles[scenes.present][:, d : 2 * d]
    angle = np.arctan2(*bars[(bars[:, :2] != 0.0).any(axis=-1)][:, 1::-1].T) % np.pi
    assert (np.histogram(angle, 4, (0.0, np.pi))[0] > 0.1 * len(angle)).all()


def test_an_attempt_at_a_uniform_scene_takes_the_numbers_it_says(env):
    capsules = dataclasses.replace(env.task.scenes, shapes=CAPSULES)
    uniform = UniformSampler(env.task.collision_model, capsules)
    numbers = np.random.default_rng(0).random((40, uniform.size))
    uniform.attempt(Uniforms(numbers), None)
    with pytest.raises(ValueError):
        uniform.attempt(Uniforms(numbers[:, 1:]), None)


def test_uniform_scenes_may_have_no_obstacles():
    task = gym.make(HAND, n_obstacles=(0, 1)).unwrapped.task
    found = UniformSampler(task.collision_model, task.scenes)(seeded())
    assert 0 < (~found.present.any(axis=-1)).sum() < NUMBER


@pytest.mark.parametrize("n_obstacles", [0, 3, (2, 4)])
def test_the_number_of_obstacles_is_as_asked_for(n_obstacles):
    env = gym.make_vec(HAND, num_envs=64, n_obstacles=n_obstacles).unwrapped
    observation, _ = env.reset(seed=0)
    fewest, most = (n_obstacles, n_obstacles) if isinstance(n_obstacles, int) else n_obstacles
    counts = env.scenes.present.sum(axis=-1)
    assert (counts.min(), counts.max()) == (fewest, most)
    assert ("obstacles" in observation) == bool(most)


def test_a_given_scene_is_set_up_and_seen():
    env = gym.make(HAND)
    rows = [[-0.1, 0.4, 0.0, 0.1, 0.01]]
    options = {"start": [-0.3, 0.4], "goal": [0.1, 0.4], "obstacles": rows}
    observation, _ = env.reset(seed=0, options=options)
    np.testing.assert_allclose(observation["hand"], [-0.3, 0.4], atol=1e-7)
    np.testing.assert_allclose(observation["goal"], [0.1, 0.4], atol=1e-7)
    seen = env.unwrapped.observation_layout.obstacles(observation["obstacles"])
    np.testing.assert_array_equal(seen.present, [1, 0, 0, 0, 0])
    np.testing.assert_allclose(seen.half_axis[0], [0.0, 0.1], atol=1e-7)
    np.testing.assert_allclose(seen.radius[0], 0.01, atol=1e-7)


def test_what_is_not_given_is_sampled_to_fit():
    env = gym.make_vec(HAND, num_envs=64).unwrapped
    observation, _ = env.reset(seed=0, options={"start": [-0.2, 0.3]})
    np.testing.assert_allclose(observation["hand"], np.tile([-0.2, 0.3], (64, 1)), atol=1e-7)
    assert env.execute_actions(np.zeros((64, 3))).info["collision"].all()
    env.reset(options={"obstacles": [[-0.1, 0.42, 0.0, 0.1, 0.01]]})
    assert (env.scenes.present.sum(axis=-1) == 1).all()
    check_scenes(env.scenes, env.task.collision_model)
    env.reset(options={"obstacles": []})
    assert not env.scenes.present.any()


def test_rows_of_lights_stand_across_the_middle_between_targets():
    pairs, scenes = rows_of_lights()
    check_scenes(scenes, CollisionModel(ADULT, False))
    assert {("T1", "T4"), ("T6", "T3")} <= set(pairs)
    line, axis = scenes.goal - scenes.start, scenes.obstacles[:, 0, 2:4]
    np.testing.assert_allclose((line * axis).sum(axis=-1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 0.125)
    first = pairs.index(("T1", "T4"))
    np.testing.assert_allclose(scenes.start[first], TARGETS["T1"])
    np.testing.assert_allclose(scenes.obstacles[first, 0, :2], (scenes.start[first] + scenes.goal[first]) / 2)


@pytest.mark.parametrize("n_via", [1, 3])
def test_in_space_the_zero_action_is_straight_with_any_number_of_via_points(n_via):
    env = ReachVectorEnv(4, arm="panda", whole_arm=True, n_via=n_via, n_obstacles=(1, 6), threads=1)
    env.reset(seed=0)
    assert env.single_action_space.shape == (3 * n_via + 1,)
    info = env.execute_actions(np.zeros(env.action_space.shape)).info
    np.testing.assert_allclose(info["jerk_ratio"], 1.0, atol=1e-9)
    assert Task.from_dict(env.task.as_dict(), {"panda": PANDA}) == env.task


def test_the_hand_of_the_panda_alone_may_be_what_must_clear():
    env = ReachVectorEnv(32, arm="panda", n_obstacles=(1, 3), duration_range=(1.0, 2.0), threads=1)
    env.reset(seed=0)
    assert env.execute_actions(np.zeros((32, 4))).info["collision"].all()
    assert not env.model.geom("link5_0").contype
