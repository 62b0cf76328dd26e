"""Scenes that are uniform in the workspace: nothing is built about a feasible path; the straight line is blocked."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.geometry.rows import CAPSULES, shape_columns, shape_number
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.draws import Uniforms
from viapoint.envs.scenes.sampler import SceneSampler, UniformSampler, scene_sampler
from viapoint.envs.scenes.scene import check_scenes, rest_clearance
from viapoint.envs.scenes.uniform import UniformScenes

NUMBER = 96
IDS = ("viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0", "viapoint/PandaObstacles-v0")


def seeded(number=NUMBER):
    return [np.random.default_rng(seed) for seed in range(number)]


@pytest.fixture(scope="module", params=IDS, ids=[env_id[9:-3] for env_id in IDS])
def env(request):
    made = gym.make_vec(request.param, num_envs=NUMBER, uniform_share=1.0, threads=1).unwrapped
    yield made
    made.close()


@pytest.fixture(scope="module")
def scenes(env):
    return UniformSampler(env.task.collision_model, env.task.scenes)(seeded())


def test_they_can_begin_and_end_and_the_straight_movement_collides(env, scenes):
    check_scenes(scenes, env.task.collision_model)
    for point in (scenes.start, scenes.goal):
        clearance = rest_clearance(scenes, point, env.task.collision_model)[:, :-1]
        assert (clearance[scenes.present] > env.task.scenes.end_margin).all()
        assert (env.arm.reach_margin(point) > env.task.scenes.reach_margin).all()
    env.reset(options=scenes.as_options())
    *_, info = env.step(np.zeros((NUMBER, env.single_action_space.shape[0])))
    assert info["collision"].all()


def test_ends_and_obstacles_are_anywhere_in_the_workspace(env, scenes):
    low, high = (np.array(corner) for corner in env.arm.workspace)
    d = env.arm.dimension
    apart = np.linalg.norm(scenes.goal - scenes.start, axis=-1)
    assert apart.min() < env.task.scenes.distance[0]
    assert apart.max() > env.task.scenes.distance[1]
    centre = scenes.obstacles[scenes.present][:, :2]  # posts on the table have other heights
    for points, corners in (
        (scenes.start, (low, high)),
        (scenes.goal, (low, high)),
        (centre, (low[:2], high[:2])),
    ):
        share = (points - corners[0]) / (corners[1] - corners[0])
        assert ((share >= 0.0) & (share <= 1.0)).all()
        assert (share.min(axis=0) < 0.12).all()
        assert (share.max(axis=0) > 0.88).all()
    bars = scenes.obstacles[scenes.present][:, d : 2 * d]
    angle = np.arctan2(*bars[(bars[:, :2] != 0.0).any(axis=-1)][:, 1::-1].T) % np.pi
    assert (np.histogram(angle, 4, (0.0, np.pi))[0] > 0.1 * len(angle)).all()


def test_numbers_and_sizes_are_those_of_the_task(env, scenes):
    limits, d = env.task.scenes.n_obstacles, env.arm.dimension
    assert set(scenes.present.sum(axis=-1)) <= set(range(limits[0], limits[1] + 1))
    assert (~scenes.present[:, 0]).sum() == 0
    some = scenes.obstacles[scenes.present]
    radii = [env.task.scenes.post_radius, env.task.scenes.bar_radius]
    radii += [env.task.scenes.sphere_radius] if d == 3 else []
    capsule = shape_columns(some).kind == shape_number("capsule")
    assert capsule.all() == (env.task.scenes.shapes == CAPSULES)
    assert some[capsule, -1].min() >= min(low for low, _ in radii)
    assert some[:, -1].max() <= max(
        high for _, high in radii
    )  # other shapes are inside capsules of these sizes


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("env_id", ["PlanarWholeArm", "PandaObstacles"])
def test_room_for_given_obstacles_does_not_change_drawn_ones(env_id, share):
    drawn = []
    for most in (8, 24):
        env = gym.make_vec(
            f"viapoint/{env_id}-v0", num_envs=1, threads=1, n_obstacles=(1, most), uniform_share=share
        )
        drawn.append(env.unwrapped.task.sampler()([np.random.default_rng(seed) for seed in range(6)]))
        env.close()
    few, many = drawn
    np.testing.assert_array_equal(many.obstacles[:, :8], few.obstacles)
    assert many.obstacles.shape[1] == 24
    assert not many.present[:, 8:].any()
    with pytest.raises(ValueError, match="fewest <= 8"):
        gym.make_vec(f"viapoint/{env_id}-v0", num_envs=1, n_obstacles=(9, 24))


def test_a_scene_depends_on_its_own_generator_alone(env, scenes):
    sample = UniformSampler(env.task.collision_model, env.task.scenes)
    for row in (0, 5, 17):
        for one, many in zip(sample([seeded()[row]]), scenes, strict=True):
            np.testing.assert_array_equal(one[0], many[row])


def test_each_mixed_scene_comes_from_one_of_the_two_samplers_in_the_given_share(env):
    model = env.task.collision_model
    mixed = dataclasses.replace(env.task.scenes, uniform_share=0.3)
    found, kinds = scene_sampler(model, mixed)(seeded()), []
    usual, uniform = SceneSampler(model, mixed), UniformSampler(model, mixed)
    for row, generator in enumerate(seeded(24)):
        kinds.append(generator.random() < 0.3)
        wanted = (uniform if kinds[-1] else usual)([generator])
        for one, many in zip(wanted, found, strict=True):
            np.testing.assert_array_equal(one[0], many[row])
    assert 0 < sum(kinds) < 24


def test_without_a_share_the_sampler_is_the_usual_one(env):
    usual = dataclasses.replace(env.task.scenes, uniform_share=0.0)
    assert type(scene_sampler(env.task.collision_model, usual)) is SceneSampler


def test_scenes_without_obstacles_have_free_lines():
    task = gym.make_vec(IDS[0], num_envs=1, uniform_share=1.0, n_obstacles=(0, 1)).unwrapped.task
    found = task.sampler()(seeded())
    empty = ~found.present.any(axis=-1)
    assert 0 < empty.sum() < NUMBER
    nothing = gym.make_vec("viapoint/PlanarReach-v0", num_envs=4, uniform_share=1.0)
    assert "obstacles" not in nothing.reset(seed=0)[0]


def test_given_parts_stay_and_the_others_are_sampled():
    env = gym.make_vec(IDS[0], num_envs=8, uniform_share=0.5)
    observation, _ = env.reset(seed=0, options={"start": (-0.2, 0.3), "goal": (0.1, 0.4)})
    assert np.allclose(observation["hand"], (-0.2, 0.3), atol=1e-6)
    assert np.allclose(observation["goal"], (0.1, 0.4))
    assert (observation["obstacles"].reshape(8, 5, 6)[..., -1].sum(axis=-1) >= 1).all()


def test_obstacles_that_move_are_drawn_among_uniform_scenes_too():
    env = gym.make_vec("viapoint/PlanarMovingObstacles-v0", num_envs=8, uniform_share=1.0)
    observation, _ = env.reset(seed=0)
    assert np.isfinite(observation["obstacles"]).all()
    assert (observation["obstacle_velocities"] != 0.0).any()


@pytest.mark.parametrize("share", [-0.1, 1.1, "half", True, float("nan"), None])
def test_a_share_that_is_none_is_refused(share):
    for kind in (SceneDistribution, SpaceDistribution):
        with pytest.raises(ValueError, match="uniform_share must be a number from 0 to 1, got"):
            kind(uniform_share=share)
    with pytest.raises(ValueError, match="uniform_share must be"):
        gym.make_vec(IDS[0], num_envs=1, uniform_share=share)


def test_an_attempt_takes_the_numbers_it_says(env):
    uniform = UniformScenes(env.task.collision_model, env.task.scenes)
    rows, scenes = uniform(Uniforms(np.random.default_rng(0).random((40, uniform.size))), None)
    assert len(rows) == len(scenes.start)
    with pytest.raises(ValueError, match="were taken"):
        uniform(Uniforms(np.random.default_rng(0).random((40, uniform.size - 1))), None)
