"""Laws of the scenes in space."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import check_scenes
from viapoint.envs.single_env import ReachVectorEnv

NUMBER, WHOLE_PANDA = 60, CollisionModel(PANDA, whole_arm=True)
IN_SPACE = scene_families(3)
FAMILIES = {name: family.n_obstacles for name, family in IN_SPACE.items()}
BEAMS = ("slot", "window", "tunnel")


def drawn(number=NUMBER, **distribution):
    sampler = SceneSampler(WHOLE_PANDA, SpaceDistribution(**distribution))
    return sampler([np.random.default_rng(seed) for seed in range(number)])


@pytest.fixture(scope="module")
def scenes():
    return drawn()


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_can_begin_and_end_and_stands_in_the_way_of_the_straight_movement(family):
    boxes = {} if IN_SPACE[family].shapes == ("capsule",) else {"shapes": ("box",), "n_obstacles": (1, 8)}
    scenes = drawn(24, families=(family,), **boxes)
    check_scenes(scenes, WHOLE_PANDA)
    assert (scenes.present.sum(axis=-1) >= FAMILIES[family]).all()
    line = scenes.start[:, None] + (scenes.goal - scenes.start)[:, None] * np.linspace(0, 1, 60)[:, None]
    assert (WHOLE_PANDA.least_clearance(line, scenes.obstacles, scenes.present) < -0.003).all()


def test_a_beam_is_above_the_hand_on_its_way_and_a_board_or_sill_below():
    for family in BEAMS:
        scenes = drawn(8, families=(family,), n_obstacles=(FAMILIES[family],) * 2)
        level = np.abs(scenes.obstacles[..., 5]) < 1e-9
        bars = scenes.present & level & (scenes.obstacles[..., 3:5] != 0.0).any(axis=-1)
        height = np.where(bars, scenes.obstacles[..., 2], np.nan)
        # The beam leaves room for what is above the hand, from the wrist down.
        assert (np.nanmax(height, axis=-1) - np.nanmin(height, axis=-1) > 0.2).all()


def test_one_to_six_obstacles_of_every_kind(scenes):
    assert set(scenes.present.sum(axis=-1)) == {1, 2, 3, 4, 5, 6}
    axis = scenes.obstacles[scenes.present][:, 3:6]
    upright = (axis[:, :2] == 0.0).all(axis=-1)
    spheres, posts = upright & (axis[:, 2] == 0.0), upright & (axis[:, 2] > 0.0)
    assert min(spheres.mean(), posts.mean(), (~upright).mean()) > 0.05
    assert (scenes.obstacles[~scenes.present] == 0.0).all()


def test_start_and_goal_are_as_far_apart_and_as_level_as_stated(scenes):
    line = scenes.goal - scenes.start
    length, d = np.linalg.norm(line, axis=-1), SpaceDistribution()
    assert ((length > d.distance[0] - 1e-9) & (length < d.distance[1] + 1e-9)).all()
    assert (np.abs(line[:, 2]) <= d.steepness * length + 1e-9).all()
    low, high = PANDA.workspace
    for place in (scenes.start, scenes.goal):
        assert ((place >= low) & (place <= high)).all()


def test_a_scene_depends_on_its_own_generator_alone(scenes):
    for seed in (0, 7, 39):
        alone = SceneSampler(WHOLE_PANDA, SpaceDistribution())([np.random.default_rng(seed)])
        for one, together in zip(alone, scenes, strict=True):
            np.testing.assert_array_equal(one[0], together[seed])


def test_the_straight_movement_fails_and_random_ones_solve_most_scenes(scenes):
    """Physics agrees with the construction: straight collides everywhere, and there is a way round."""
    env = gym.make_vec("viapoint/PandaObstacles-v0", num_envs=NUMBER, threads=1)
    env.reset(options=scenes.as_options())
    _, _, info = env.unwrapped.execute_actions(np.zeros((NUMBER, 4)))
    assert info["collision"].all()
    rng, solved = np.random.default_rng(0), np.zeros(NUMBER, dtype=bool)
    for _ in range(16):
        env.reset(options=scenes.as_options())
        _, _, info = env.unwrapped.execute_actions(rng.uniform(-1.0, 1.0, (NUMBER, 4)))
        solved |= info["is_success"]
        agree = info["collision"] == (info["min_clearance"] < 0.0)
        assert agree[info["reachable"]].all()
    assert solved.mean() > 0.6


@pytest.mark.parametrize("n_via", [1, 3])
def test_more_via_points(n_via):
    env = ReachVectorEnv(4, arm="panda", whole_arm=True, n_via=n_via, n_obstacles=(1, 6), threads=1)
    env.reset(seed=0)
    size = env.single_action_space.shape[0]
    assert size == 3 * n_via + 1
    _, _, info = env.execute_actions(np.zeros((4, size)))
    np.testing.assert_allclose(info["jerk_ratio"], 1.0, atol=1e-9)


def test_the_hand_alone_may_be_what_must_clear():
    env = ReachVectorEnv(32, arm="panda", n_obstacles=(1, 3), duration_range=(1.0, 2.0), threads=1)
    env.reset(seed=0)
    _, _, info = env.execute_actions(np.zeros((32, 4)))
    assert info["collision"].all()
    assert not env.model.geom("link5_0").contype


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"n_obstacles": (3, 2)}, "n_obstacles"),
        ({"n_obstacles": (0, 257)}, "n_obstacles"),
        ({"n_obstacles": (9, 9)}, "fewest <= 8"),
        ({"families": ("wall",)}, "clutter, pillar, shelf, gate, slot, window, tunnel"),
        ({"families": ("gate",), "n_obstacles": (1, 2)}, "take more than 2 obstacles"),
        ({"distance": (0.4, 0.2)}, "distance"),
    ],
)
def test_a_distribution_that_cannot_be_sampled_is_refused(bad, message):
    with pytest.raises(ValueError, match=message):
        SpaceDistribution(**bad)


def test_an_arm_may_be_named_and_a_task_is_plain_values():
    with pytest.raises(ValueError, match=r"one of planar, panda, got 'ur5'"):
        ReachVectorEnv(1, arm="ur5")
    task = ReachVectorEnv(1, arm="panda", whole_arm=True).task
    assert Task.from_dict(task.as_dict(), {"panda": PANDA}) == task
