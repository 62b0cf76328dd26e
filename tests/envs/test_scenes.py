"""Laws of the scenes."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import ADULT
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import TARGETS, Scenes, check_scenes, rows_of_lights

NUMBER = 300


@pytest.fixture(scope="module", params=[False, True], ids=["hand", "whole arm"])
def sampled(request):
    sampler = SceneSampler(CollisionModel(ADULT, request.param), SceneDistribution())
    return sampler([np.random.default_rng(seed) for seed in range(NUMBER)]), request.param


def test_sampled_scenes_can_begin_and_end(sampled):
    scenes, whole_arm = sampled
    check_scenes(scenes, CollisionModel(ADULT, whole_arm))


def test_one_to_five_obstacles_all_numbers_posts_and_bars(sampled):
    scenes, _ = sampled
    assert set(scenes.present.sum(axis=-1)) == {1, 2, 3, 4, 5}
    bars = (scenes.obstacles[..., 2:4] ** 2).sum(axis=-1) > 0.0
    assert 0.2 < bars[scenes.present].mean() < 0.8
    assert (scenes.obstacles[~scenes.present] == 0.0).all()


def test_the_straight_line_always_hits_something(sampled):
    scenes, _ = sampled
    gap = np.sqrt(
        segment_distance_squared(scenes.start[:, None], scenes.goal[:, None], scenes.obstacles)[..., 0]
    )
    clearance = np.where(scenes.present, gap - scenes.obstacles[..., -1] - ADULT.hand_radius, np.inf)
    assert (clearance.min(axis=-1) < -0.003).all()


def test_a_scene_depends_on_its_own_generator_alone():
    sampler = SceneSampler(CollisionModel(ADULT, False), SceneDistribution())
    together = sampler([np.random.default_rng(seed) for seed in range(40)])
    for seed in (0, 7, 39):
        alone = sampler([np.random.default_rng(seed)])
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], all_[seed])


@pytest.mark.parametrize(
    ("env_id", "share"), [("viapoint/PlanarObstacles-v0", 0.85), ("viapoint/PlanarWholeArm-v0", 0.6)]
)
def test_the_straight_movement_fails_and_random_ones_solve_most_scenes(env_id, share):
    """Physics agrees with the construction: straight collides everywhere, and there is a way round."""
    env = gym.make_vec(env_id, num_envs=100)
    env.reset(seed=0)
    scenes = env.scenes
    *_, info = env.step(np.zeros((100, 3)))
    assert info["collision"].all()
    assert not info["is_success"].any()
    rng, solved = np.random.default_rng(0), np.zeros(100, dtype=bool)
    for _ in range(60):
        env.reset(options=scenes.as_options())
        *_, info = env.step(rng.uniform(-1.0, 1.0, (100, 3)))
        solved |= info["is_success"]
        if solved.mean() > share:
            break
    assert solved.mean() > share


@pytest.mark.parametrize("n_obstacles", [0, 3, (2, 4)])
def test_the_number_of_obstacles_is_as_asked_for(n_obstacles):
    env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=64, n_obstacles=n_obstacles)
    env.reset(seed=0)
    fewest, most = (n_obstacles, n_obstacles) if isinstance(n_obstacles, int) else n_obstacles
    counts = env.scenes.present.sum(axis=-1)
    assert counts.min() == fewest
    assert counts.max() == most


def scene(**changes):
    given = {"start": [-0.3, 0.4], "goal": [0.1, 0.4], "obstacles": [[-0.1, 0.4, 0.0, 0.1, 0.01]], **changes}
    return {name: np.array(value) for name, value in given.items() if value is not None}


def test_a_given_scene_is_set_up_and_seen():
    env = gym.make("viapoint/PlanarObstacles-v0")
    observation, _ = env.reset(seed=0, options=scene())
    np.testing.assert_allclose(observation["hand"], [-0.3, 0.4], atol=1e-7)
    np.testing.assert_allclose(observation["goal"], [0.1, 0.4], atol=1e-7)
    rows = env.unwrapped.observation_layout.obstacles(observation["obstacles"])
    np.testing.assert_array_equal(rows.present, [1, 0, 0, 0, 0])
    np.testing.assert_allclose(rows.half_axis[0], [0.0, 0.1], atol=1e-7)
    np.testing.assert_allclose(rows.radius[0], 0.01, atol=1e-7)


def test_what_is_not_given_is_sampled_to_fit():
    env = gym.make("viapoint/PlanarObstacles-v0")
    observation, _ = env.reset(seed=0, options={"start": [-0.2, 0.3]})
    np.testing.assert_allclose(observation["hand"], [-0.2, 0.3], atol=1e-7)
    *_, info = env.step(np.zeros(3, dtype=np.float32))
    assert info["collision"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": [2.0, 0.0]}, "goal .* out of the arm's reach"),
        ({"start": [0.0, 0.05]}, "start .* out of the arm's reach"),
        ({"goal": [-0.3, 0.4]}, "start and goal are 0.0000 m apart"),
        ({"obstacles": [[-0.3, 0.41, 0.0, 0.0, 0.02]]}, r"obstacle 0 .* touches the arm at the start"),
        (
            {"obstacles": [[0.4, 0.4, 0, 0, 0.02], [0.1, 0.41, 0, 0, 0.02]]},
            r"obstacle 1 .* touches the arm at the goal",
        ),
        ({"obstacles": [[-0.1, 0.4, 0.0, 0.1]]}, "obstacles"),
        ({"obstacles": np.zeros((6, 5))}, "at most 5"),
        ({"obstacles": [[-0.1, 0.4, 0.0, 0.1, -0.01]]}, "no positive radius"),
        ({"obstacles": [[-0.1, 0.4, 0.0, 0.9, 0.01]]}, "half-axis"),
        ({"start": [np.nan, 0.4]}, "finite"),
        ({"start": [0.1, 0.2, 0.3]}, "start.*shape"),
        ({"target": [0.1, 0.2]}, "'target'"),
        ({"obstacles": [[-0.1, 0.4, 0.0, 0.1, 0.0]]}, "no positive radius"),
        ({"goal": [2.0, 0.0], "obstacles": None}, "goal .* out of the arm's reach"),
        ({"goal": [-0.3, 0.4], "obstacles": None}, "start and goal are 0.0000 m apart"),
        ({"start": [0.0, 0.05], "goal": None, "obstacles": None}, "start .* out of the arm's reach"),
        ({"start": [-0.3 + 0.1j, 0.4]}, "start.*real numbers"),
    ],
)
def test_an_impossible_scene_is_refused_with_the_reason_and_nothing_changes(changes, message):
    env = gym.make("viapoint/PlanarObstacles-v0")
    env.reset(seed=0)
    before = Scenes(*(field.copy() for field in env.unwrapped.batch.scenes))
    with pytest.raises(ValueError, match=message):
        env.reset(options=scene(**changes))
    for now, then in zip(env.unwrapped.batch.scenes, before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_a_refused_scene_leaves_the_next_episodes_as_they_were():
    options = scene(obstacles=[[-0.3, 0.41, 0.0, 0.0, 0.02]])
    usual, refused = (gym.make("viapoint/PlanarObstacles-v0") for _ in range(2))
    for env in (usual, refused):
        env.reset(seed=0)
    for seed, given in (
        (9, options),
        (None, options),
        (None, {"obstacles": options["obstacles"], "start": options["start"]}),
    ):
        with pytest.raises(ValueError, match="touches"):
            refused.reset(seed=seed, options=given)
    expected, found = (env.reset()[0] for env in (usual, refused))
    for name, part in expected.items():
        np.testing.assert_array_equal(found[name], part)


def test_given_obstacles_get_ends_clear_of_them_and_an_empty_list_is_none():
    env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=64)
    env.reset(seed=0, options={"obstacles": [[-0.1, 0.42, 0.0, 0.1, 0.01]]})
    assert (env.unwrapped.scenes.present.sum(axis=-1) == 1).all()
    env.reset(options={"obstacles": []})
    assert not env.unwrapped.scenes.present.any()


def test_rows_of_lights_stand_across_the_middle_between_targets():
    pairs, scenes = rows_of_lights()
    check_scenes(scenes, CollisionModel(ADULT, False))
    assert ("T1", "T4") in pairs
    assert ("T6", "T3") in pairs
    line, axis = scenes.goal - scenes.start, scenes.obstacles[:, 0, 2:4]
    np.testing.assert_allclose((line * axis).sum(axis=-1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 0.125)
    first = pairs.index(("T1", "T4"))
    np.testing.assert_allclose(scenes.start[first], TARGETS["T1"])
    np.testing.assert_allclose(scenes.obstacles[first, 0, :2], (scenes.start[first] + scenes.goal[first]) / 2)


@pytest.mark.parametrize("bad", [{"n_obstacles": (3, 2)}, {"n_obstacles": (-1, 2)}, {"distance": (0.4, 0.2)}])
def test_a_distribution_that_cannot_be_sampled_is_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        SceneDistribution(**bad)
