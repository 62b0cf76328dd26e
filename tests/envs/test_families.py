"""Laws of the families of hard scenes: each is what its name says."""

import contextlib
import copy
import dataclasses
import pickle

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import ADULT, PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.geometry.rows import CAPSULES, shape_columns, shape_number
from viapoint.envs.mdp.task import family_sampler
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.families import register_scene_family, scene_families
from viapoint.envs.scenes.feasible_path import DRAW_ORDER
from viapoint.envs.scenes.planar_families import FAMILY_ROWS
from viapoint.envs.scenes.sampler import SHARED_GROUPS, SceneSampler
from viapoint.envs.scenes.scene import check_scenes
from viapoint.envs.scenes.spatial_families import THICKNESS

HAND, WHOLE_ARM = "viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0"
SPACE = "viapoint/PandaObstacles-v0"
FAMILIES = tuple(scene_families(2))
BOX_FAMILIES = {name for name, family in scene_families(3).items() if family.shapes != CAPSULES}
NUMBER = {HAND: 40, WHOLE_ARM: 4, SPACE: 12}


def task_of(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped.task


def sampled(task, name, number):
    """Scenes of a family, each from a generator of its own."""
    return family_sampler(task, name)([np.random.default_rng(seed) for seed in range(number)])


@pytest.fixture(scope="module")
def envs():
    made = {env_id: gym.make_vec(env_id, num_envs=NUMBER[env_id], threads=1).unwrapped for env_id in NUMBER}
    yield made
    for env in made.values():
        env.close()


@pytest.fixture(scope="module")
def boxes(envs):
    return envs[SPACE]


@pytest.fixture(scope="module")
def drawn(envs):
    """Scenes of every family for the hand."""
    return {name: sampled(envs[HAND].task, name, NUMBER[HAND]) for name in FAMILIES}


def obstacles(scenes, i):
    rows = scenes.obstacles[i][scenes.present[i]]
    return rows[:, :2], rows[:, 2:4], rows[:, 4]


def ends_of(centre, axis):
    return np.stack((centre - axis, centre + axis), axis=-2)


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        *((env_id, name) for env_id in (HAND, WHOLE_ARM) for name in FAMILIES),
        *((SPACE, name) for name in scene_families(3)),
    ],
)
def test_scenes_of_a_family_can_begin_and_end_and_something_is_in_the_way(env_id, name, envs):
    env, task = envs[env_id], envs[env_id].task
    scenes = sampled(task, name, NUMBER[env_id])
    check_scenes(scenes, task.collision_model)
    line = scenes.goal - scenes.start
    positions = scenes.start[:, None] + line[:, None] * np.linspace(0.0, 1.0, 60)[:, None]
    clearance = task.collision_model.least_clearance(positions, scenes.obstacles, scenes.present)
    assert (clearance < -0.003).all()
    env.reset(options=scenes.as_options())
    info = env.execute_actions(np.zeros(env.action_space.shape)).info
    assert (info["collision"] | ~info["reachable"]).all()
    if env_id == SPACE:
        counted = scenes.present
        if name in BOX_FAMILIES:
            counted = counted & (shape_columns(scenes.obstacles).kind == shape_number("box"))
        assert (counted.sum(axis=-1) >= scene_families(3)[name].n_obstacles).all()
    else:
        assert scenes.obstacles.shape[1] == FAMILY_ROWS
    alone = family_sampler(task, name)([np.random.default_rng(3)])
    for one, all_ in zip(alone, scenes, strict=True):
        np.testing.assert_array_equal(one[0], all_[3])


def test_a_gate_is_two_walls_in_line_with_a_gap_little_wider_than_the_hand(drawn):
    for i in range(NUMBER[HAND]):
        centre, axis, radius = obstacles(drawn["gate"], i)
        assert len(centre) == 2
        first, second = ends_of(centre, axis)
        apart = np.linalg.norm(first[:, None] - second, axis=-1)
        gap = apart.min() - radius.sum() - 2.0 * ADULT.hand_radius
        assert 0.015 < gap < 0.05
        for point in first:
            line = second[1] - second[0]
            offset = point - second[0]
            assert abs(line[0] * offset[1] - line[1] * offset[0]) / np.linalg.norm(line) < 1e-9


def test_a_corridor_is_a_lane_between_parallel_bars_with_a_wall_to_either_side(drawn):
    for i in range(NUMBER[HAND]):
        centre, axis, radius = obstacles(drawn["corridor"], i)
        assert len(centre) == 4
        direction = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        across = np.abs(direction @ direction.T)
        np.testing.assert_allclose(np.sort(across, axis=-1)[:, :2], 0.0, atol=1e-9)
        np.testing.assert_allclose(np.sort(across, axis=-1)[:, 2:], 1.0, atol=1e-9)
        widths = []
        for a in range(4):
            for b in range(a):
                offset = centre[a] - centre[b]
                if across[a, b] > 0.5 and abs(offset @ direction[a]) < 1e-9:  # opposite each other
                    lane = abs(offset[0] * direction[a, 1] - offset[1] * direction[a, 0])
                    widths.append(lane - radius[a] - radius[b] - 2.0 * ADULT.hand_radius)
        assert any(0.02 < width < 0.07 for width in widths)


def test_a_ring_surrounds_start_or_goal_but_for_one_opening(drawn):
    angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    rays = 0.16 * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    scenes = drawn["ring"]
    for i in range(NUMBER[HAND]):
        blocked = []
        for end in (scenes.start[i], scenes.goal[i]):
            first = np.broadcast_to(end, rays.shape)
            squared = segment_distance_squared(first, end + rays, scenes.obstacles[i])
            room = scenes.obstacles[i, :, -1:] + ADULT.hand_radius
            blocked.append(((squared < room**2) & scenes.present[i][:, None]).any(axis=0))
        ring = max(blocked, key=np.mean)
        assert 0.7 < ring.mean() < 1.0
        assert (ring != np.roll(ring, 1)).sum() == 2  # one opening
        assert min(map(np.mean, blocked)) < 0.3


def test_oblique_bars_are_long_parallel_and_oblique(drawn):
    scenes = drawn["oblique bar"]
    for i in range(NUMBER[HAND]):
        _, axis, _ = obstacles(scenes, i)
        half = np.linalg.norm(axis, axis=-1, keepdims=True)
        assert (half > 0.12).all()
        line = scenes.goal[i] - scenes.start[i]
        angle = np.arccos(np.abs((axis / half) @ line) / np.linalg.norm(line))
        assert np.ptp(angle) < 1e-6
        assert np.radians(28.0) < angle[0] < np.radians(63.0)


def test_a_cul_de_sac_holds_what_comes_straight_from_the_start(drawn):
    """A wall with two sides at its ends, both on the start's side of it."""
    scenes = drawn["cul-de-sac"]
    for i in range(NUMBER[HAND]):
        centre, axis, _ = obstacles(scenes, i)
        ends = ends_of(centre, axis)
        found = False
        for back in range(len(centre)):
            others = [k for k in range(len(centre)) if k != back]
            near = {k: np.linalg.norm(ends[k][:, None] - ends[back], axis=-1) for k in others}
            sides = {int(near[k].min(axis=0).argmin()): k for k in others if near[k].min() < 1e-9}
            if len(sides) == 2:
                normal = np.array([-axis[back][1], axis[back][0]])
                ahead = np.sign((scenes.start[i] - centre[back]) @ normal)
                found |= all(np.sign((centre[k] - centre[back]) @ normal) == ahead for k in sides.values())
        assert found


@pytest.mark.parametrize(
    ("name", "bars", "posts"),
    [("shelf", 3, 0), ("gate", 1, 2), ("slot", 4, 0), ("window", 2, 2), ("tunnel", 2, 4)],
)
def test_families_of_space_have_their_bars_and_posts(name, bars, posts, boxes):
    scenes = sampled(boxes.task, name, 3)
    axis = scenes.obstacles[..., 3:6]
    lying = scenes.present & (np.hypot(axis[..., 0], axis[..., 1]) > 1e-9)
    standing = scenes.present & ~lying & (axis[..., 2] > 0.0)
    assert (lying.sum(axis=-1) >= bars).all()
    assert (standing.sum(axis=-1) >= posts).all()


@pytest.mark.parametrize("family", ["slot", "window", "tunnel"])
def test_a_beam_is_above_the_hand_on_its_way_and_a_board_or_sill_below(family):
    number = scene_families(3)[family].n_obstacles
    distribution = SpaceDistribution(families=(family,), n_obstacles=(number, number))
    sampler = SceneSampler(CollisionModel(PANDA, True), distribution)
    scenes = sampler([np.random.default_rng(i) for i in range(8)])
    level = np.abs(scenes.obstacles[..., 5]) < 1e-9
    bars = scenes.present & level & (scenes.obstacles[..., 3:5] != 0.0).any(axis=-1)
    height = np.where(bars, scenes.obstacles[..., 2], np.nan)
    # The beam leaves room for what is above the hand, from the wrist down.
    assert (np.nanmax(height, axis=-1) - np.nanmin(height, axis=-1) > 0.2).all()


def test_a_desk_has_two_things_on_it_and_two_under_it(boxes):
    scenes = sampled(boxes.task, "desk", 8)
    for start, goal, row in zip(*scenes, strict=True):
        columns = shape_columns(row[row[:, -1] > 0.0])
        height, half = columns.centre[:, 2], columns.half[:, 2]
        top = np.abs(half - THICKNESS).argmin()
        stands = np.abs((height - half) - (height[top] + half[top])) < 1e-6
        below = (height + half) < (height[top] - half[top]) + 1e-6
        box = columns.kind == shape_number("box")
        assert (stands & box).sum() >= 2
        assert height[top] + half[top] > min(start[2], goal[2])
        assert (height - half)[box].min() > -1e-6
        assert (below & box).sum() >= 2


def test_families_of_boxes_are_trained_or_held_out(boxes):
    trained = set(boxes.task.scenes.families)
    hard = {name for name in BOX_FAMILIES if scene_families(3)[name].hard}
    assert hard
    assert BOX_FAMILIES & trained
    assert not hard & trained
    assert trained - BOX_FAMILIES == set(task_of(SPACE, shapes="capsule").scenes.families)


def test_families_that_are_trained_on_fit_before_others_are_drawn_instead(boxes):
    """Otherwise a family is rarer in random scenes than its place among the families says."""
    order = DRAW_ORDER[3]._replace(groups=DRAW_ORDER[3].groups[:SHARED_GROUPS])
    task, seeds, found = boxes.task, range(24), {}
    for name in set(task.scenes.families):
        only = dataclasses.replace(task.scenes, families=(name,))
        sampler, fits = SceneSampler(task.collision_model, only, order=order), 0
        for seed in seeds:
            with contextlib.suppress(RuntimeError):
                sampler([np.random.default_rng(seed)])
                fits += 1
        found[name] = fits / len(seeds)
    assert min(found.values()) > 0.7, found


def ball(uniforms, site):
    """A post in the plane, a sphere in space, in the middle of the line."""
    centre = site.start + (0.4 + 0.2 * uniforms.take(1)) * (site.goal - site.start)
    assert site.path.shape[::2] == centre.shape
    return np.concatenate((centre, np.zeros_like(centre), 0.02 + 0.02 * uniforms.take(1)), axis=-1)[:, None]


@pytest.mark.parametrize("env_id", [HAND, WHOLE_ARM, SPACE])
def test_one_function_makes_scenes_in_the_plane_and_in_space(env_id, registry):
    task = task_of(env_id, shapes="capsule")
    register_scene_family("ball", ball, dimension=task.arm.dimension, n_obstacles=1)
    scenes = sampled(task, "ball", 12)
    check_scenes(scenes, task.collision_model)
    line = (scenes.goal - scenes.start)[:, None]
    offset = scenes.obstacles[..., : task.arm.dimension] - scenes.start[:, None]
    along = (offset * line).sum(axis=-1, keepdims=True) / (line**2).sum(axis=-1, keepdims=True)
    apart = np.linalg.norm(offset - along * line, axis=-1)
    if env_id == SPACE:
        round_ones = scenes.present & (scenes.obstacles[..., 3:6] == 0.0).all(axis=-1)
        assert (np.where(round_ones, apart, 1.0).min(axis=-1) < 0.1).all()  # it may have given way
    else:
        assert (np.where(scenes.present, apart, 1.0).min(axis=-1) < 1e-9).all()


def test_registered_families_are_named_in_distributions_that_are_copied_and_pickled(registry):
    register_scene_family("ball", ball, dimension=3, n_obstacles=1)
    mixed = SpaceDistribution(families=("ball", "gate"))
    for again in (copy.deepcopy(mixed), pickle.loads(pickle.dumps(mixed))):
        assert again == mixed
    model = CollisionModel(PANDA, True)
    check_scenes(SceneSampler(model, mixed)([np.random.default_rng(seed) for seed in range(8)]), model)
    assert "ball" not in scene_families(2)
    assert not scene_families(3)["ball"].hard  # frozen scenes stay as they are


def test_a_family_that_needs_few_obstacles_fits_into_tasks_with_few(registry):
    register_scene_family("ball", ball, n_obstacles=1)
    scenes = sampled(task_of(HAND, n_obstacles=1), "ball", 1)
    assert scenes.obstacles.shape == (1, 1, 5)
