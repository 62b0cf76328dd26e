"""Laws of the families of hard scenes: each is what its name says."""

import contextlib
import copy
import dataclasses
import doctest
import pickle
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import ADULT, PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.geometry.rows import shape_columns
from viapoint.envs.geometry.shapes import SHAPES
from viapoint.envs.mdp.task import family_sampler
from viapoint.envs.scenes import families
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.families import register_scene_family, scene_families
from viapoint.envs.scenes.feasible_path import DRAW_ORDER
from viapoint.envs.scenes.planar_families import FAMILY_ROWS
from viapoint.envs.scenes.sampler import SHARED_GROUPS, SceneSampler
from viapoint.envs.scenes.scene import check_scenes
from viapoint.envs.scenes.spatial_families import THICKNESS

PAGE = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text(encoding="utf-8")
HAND, WHOLE_ARM = "viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0"
SPACE = "viapoint/PandaObstacles-v0"
FAMILIES = tuple(scene_families(2))
IN_SPACE = scene_families(3).items()
SPACE_FAMILIES = {name: family.n_obstacles for name, family in IN_SPACE if family.shapes == ("capsule",)}
BOX_FAMILIES = {name: family.n_obstacles for name, family in IN_SPACE if family.shapes == ("box",)}
NUMBER = {HAND: 40, WHOLE_ARM: 4}


def task_of(env_id, **kwargs):
    env = gym.make_vec(env_id, num_envs=1, **kwargs)
    env.close()
    return env.unwrapped.task


@pytest.fixture(scope="module")
def tasks():
    return {env_id: task_of(env_id) for env_id in (HAND, WHOLE_ARM)}


@pytest.fixture(scope="module")
def drawn(tasks):
    """Scenes of every family for the hand, from generators of their own."""
    return {
        name: family_sampler(tasks[HAND], name)([np.random.default_rng(i) for i in range(NUMBER[HAND])])
        for name in FAMILIES
    }


def obstacles(scenes, i):
    rows = scenes.obstacles[i][scenes.present[i]]
    return rows[:, :2], rows[:, 2:4], rows[:, 4]


def ends_of(centre, axis):
    return np.stack((centre - axis, centre + axis), axis=-2)


@pytest.mark.parametrize("env_id", [HAND, WHOLE_ARM])
@pytest.mark.parametrize("name", FAMILIES)
def test_scenes_of_a_family_can_begin_and_end_and_something_is_in_the_way(name, env_id, tasks):
    sampler = family_sampler(tasks[env_id], name)
    scenes = sampler([np.random.default_rng(seed) for seed in range(NUMBER[env_id])])
    check_scenes(scenes, tasks[env_id].collision_model)
    assert scenes.obstacles.shape[1] == FAMILY_ROWS
    squared = segment_distance_squared(scenes.start[:, None], scenes.goal[:, None], scenes.obstacles)[..., 0]
    clearance = np.sqrt(squared) - scenes.obstacles[..., -1] - ADULT.hand_radius
    assert (np.where(scenes.present, clearance, 1.0).min(axis=-1) < -0.003).all()
    alone = sampler([np.random.default_rng(3)])
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


def test_what_has_no_families_is_refused(tasks):
    with pytest.raises(ValueError, match="gate, corridor, ring, oblique bar, cul-de-sac, got 'maze'"):
        family_sampler(tasks[HAND], "maze")
    with pytest.raises(ValueError, match="up to 5 obstacles"):
        family_sampler(task_of(HAND, n_obstacles=2), "gate")
    with pytest.raises(
        ValueError, match=r"clutter, pillar, shelf, gate, slot, window, tunnel, table.*, got 'ring'"
    ):
        family_sampler(task_of(SPACE), "ring")
    with pytest.raises(ValueError, match="tunnel needs a task with up to 6 obstacles, this one has 5"):
        family_sampler(task_of(SPACE, n_obstacles=5), "tunnel")


@pytest.mark.parametrize("name", SPACE_FAMILIES)
def test_each_family_of_space_is_drawn_by_its_name(name):
    sampler = family_sampler(task_of(SPACE), name)
    scenes = sampler([np.random.default_rng(i) for i in range(3)])
    assert (scenes.present.sum(axis=-1) >= SPACE_FAMILIES[name]).all()
    axis = scenes.obstacles[..., 3:6]
    lying = scenes.present & (np.hypot(axis[..., 0], axis[..., 1]) > 1e-9)
    standing = scenes.present & ~lying & (axis[..., 2] > 0.0)
    bars, posts = {"shelf": (3, 0), "gate": (1, 2), "slot": (4, 0), "window": (2, 2), "tunnel": (2, 4)}.get(
        name, (0, 0)
    )
    assert (lying.sum(axis=-1) >= bars).all()
    assert (standing.sum(axis=-1) >= posts).all()


@pytest.fixture(scope="module")
def boxes():
    envs = gym.make_vec(SPACE, num_envs=3, threads=1).unwrapped
    yield envs
    envs.close()


@pytest.mark.parametrize("name", BOX_FAMILIES)
def test_each_family_of_boxes_is_in_the_way(name, boxes):
    scenes = family_sampler(boxes.task, name)([np.random.default_rng(i) for i in range(3)])
    box = shape_columns(scenes.obstacles).kind == list(SHAPES).index("box")
    assert ((box & scenes.present).sum(axis=-1) >= BOX_FAMILIES[name]).all()
    boxes.reset(options=scenes.as_options())
    info = boxes.execute_actions(np.zeros(boxes.action_space.shape)).info
    assert (info["collision"] | ~info["reachable"]).all()
    with pytest.raises(ValueError, match=f"{name} needs a task with the shapes box, this one has capsule"):
        family_sampler(task_of(SPACE, shapes="capsule"), name)


def test_a_desk_has_two_things_on_it_and_two_under_it(boxes):
    scenes = family_sampler(boxes.task, "desk")([np.random.default_rng(i) for i in range(8)])
    for start, goal, row in zip(*scenes, strict=True):
        columns = shape_columns(row[row[:, -1] > 0.0])
        height, half = columns.centre[:, 2], columns.half[:, 2]
        top = np.abs(half - THICKNESS).argmin()
        stands = np.abs((height - half) - (height[top] + half[top])) < 1e-6
        below = (height + half) < (height[top] - half[top]) + 1e-6
        box = columns.kind == list(SHAPES).index("box")
        assert (stands & box).sum() >= 2
        assert height[top] + half[top] > min(start[2], goal[2])
        assert (height - half)[box].min() > -1e-6
        assert (below & box).sum() >= 2


def test_families_of_boxes_are_trained_or_held_out(boxes):
    families = scene_families(3)
    trained = set(boxes.task.scenes.families)
    assert {name for name in BOX_FAMILIES if name in trained} == {"table", "bin", "notch", "cupboard"}
    assert {name for name in BOX_FAMILIES if families[name].hard} == {"wall_window", "cage"}
    assert not trained & {"wall_window", "cage", "desk"}
    assert trained - set(BOX_FAMILIES) == set(task_of(SPACE, shapes="capsule").scenes.families)


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


@pytest.fixture
def registry(monkeypatch):
    """Families that a test registers are gone afterwards."""
    monkeypatch.setattr(families, "_FAMILIES", {d: dict(names) for d, names in families._FAMILIES.items()})


def test_the_family_of_the_page_stands_on_either_side_of_a_way_that_is_free(registry):
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (example,) = (each for each in examples if "register_scene_family" in each)
    names = {}
    exec(example, names)
    scenes, start = names["scenes"], names["observation"]["hand"]
    check_scenes(scenes, CollisionModel(ADULT, False))
    np.testing.assert_allclose(start, scenes.start[0], atol=1e-6)
    assert (scenes.present.sum(axis=1) == 2).all()
    names["env"].close()


def test_the_example_of_the_function_works(registry):
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder().find(register_scene_family, "register_scene_family", globs={}):
        runner.run(test)
    assert runner.summarize() == (0, 8)


def ball(uniforms, site):
    """A post in the plane, a sphere in space, in the middle of the line."""
    centre = site.start + (0.4 + 0.2 * uniforms.take(1)) * (site.goal - site.start)
    assert site.path.shape[::2] == centre.shape
    return np.concatenate((centre, np.zeros_like(centre), 0.02 + 0.02 * uniforms.take(1)), axis=-1)[:, None]


@pytest.mark.parametrize("env_id", [HAND, WHOLE_ARM, SPACE])
def test_one_function_makes_scenes_in_the_plane_and_in_space(env_id, registry):
    task = task_of(env_id, shapes="capsule")
    register_scene_family("ball", ball, dimension=task.arm.dimension, n_obstacles=1)
    sampler = family_sampler(task, "ball")
    scenes = sampler([np.random.default_rng(seed) for seed in range(12)])
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
    alone = sampler([np.random.default_rng(3)])
    for one, all_ in zip(alone, scenes, strict=True):
        np.testing.assert_array_equal(one[0], all_[3])


def test_registered_families_are_named_in_distributions_that_are_copied_and_pickled(registry):
    register_scene_family("ball", ball, dimension=3, n_obstacles=1)
    mixed = SpaceDistribution(families=("ball", "gate"))
    for again in (copy.deepcopy(mixed), pickle.loads(pickle.dumps(mixed))):
        assert again == mixed
    scenes = SceneSampler(CollisionModel(PANDA, True), mixed)(
        [np.random.default_rng(seed) for seed in range(8)]
    )
    check_scenes(scenes, CollisionModel(PANDA, True))
    assert "ball" not in scene_families(2)


def test_a_family_that_needs_few_obstacles_fits_into_tasks_with_few(registry):
    register_scene_family("ball", ball, n_obstacles=1)
    scenes = family_sampler(task_of(HAND, n_obstacles=1), "ball")([np.random.default_rng(0)])
    assert scenes.obstacles.shape == (1, 1, 5)


def test_frozen_families_are_not_those_that_are_registered(registry):
    before = {dimension: list(scene_families(dimension)) for dimension in (2, 3)}
    for dimension in (2, 3):
        register_scene_family("ball", ball, dimension=dimension, n_obstacles=1)
        added = set(scene_families(dimension)) - set(before[dimension])
        assert added == {"ball"}
        assert not scene_families(dimension)["ball"].hard


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("gate", ball), ValueError, "name must not be empty or one of gate, corridor, .* got 'gate'"),
        (("", ball), ValueError, "must not be empty"),
        ((3, ball), TypeError, "name must be a string, got 3"),
        (("ball", lambda site: None), TypeError, r"a function build\(uniforms, site\)"),
        (("ball", 3), TypeError, "3 is not a callable"),
    ],
)
def test_a_family_that_cannot_be_registered_is_refused(arguments, error, message, registry):
    with pytest.raises(error, match=message):
        register_scene_family(*arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dimension": 4}, "dimension must be one of 2, 3, got 4"),
        ({"n_obstacles": 0}, "n_obstacles must be a whole number, from 1 to 5, got 0"),
        ({"n_obstacles": 9, "dimension": 3}, "from 1 to 8, got 9"),
        ({"n_obstacles": 1.5}, "got 1.5"),
    ],
)
def test_numbers_of_a_family_are_checked(changes, message, registry):
    with pytest.raises(ValueError, match=message):
        register_scene_family("ball", ball, **changes)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda uniforms, site: np.zeros((3, 1, 5)), r"\(3, 1, 5\)"),
        (lambda uniforms, site: np.repeat(ball(uniforms, site), 2, axis=1), "with n at most 1"),
        (lambda uniforms, site: np.nan * ball(uniforms, site), "finite numbers, got nan"),
        (lambda uniforms, site: None, "got object of shape"),
    ],
)
def test_what_a_family_returns_is_checked(build, message, registry):
    register_scene_family("wrong", build, n_obstacles=1)
    sampler = family_sampler(task_of(HAND), "wrong")
    with pytest.raises(ValueError, match=f"family 'wrong' must return .*{message}"):
        sampler([np.random.default_rng(seed) for seed in range(8)])


def test_a_family_cannot_take_more_numbers_than_there_are(registry):
    register_scene_family("greedy", lambda uniforms, site: uniforms.take(7), dimension=3, n_obstacles=1)
    with pytest.raises(ValueError, match="7 uniform numbers were taken of 6"):
        family_sampler(task_of(SPACE), "greedy")([np.random.default_rng(0)])
