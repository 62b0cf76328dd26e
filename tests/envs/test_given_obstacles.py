"""Errors of given obstacles name them, and the options of a scene survive JSON."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import (
    Box,
    Capsule,
    ConvexMesh,
    Cylinder,
    HalfSpace,
    PointCloud,
    Sphere,
    observation_rows,
    obstacle_rows,
    obstacles_from_rows,
    obstacles_to_json,
    scene_from_json,
    scene_to_json,
)
from viapoint.envs.geometry import shapes as geometry_shapes
from viapoint.envs.geometry.rows import shape_rows

PANDA = "viapoint/PandaObstacles-v0"
SHAPES = ("capsule", "box", "half_space")
ENDS = {"start": (0.45, -0.33, 0.4), "goal": (0.45, 0.33, 0.4)}
HOUSE = Box((0.3, 0.3, 0.3), position=(0.2, 0.0, 0.4), name="house")
PLINTH = Box((0.15, 0.12, 0.12), position=(-0.04, 0.0, 0.05), name="plinth")
CRATE = Box((0.03, 0.03, 0.03), position=(0.2, 0.6, 0.4))


@pytest.fixture(scope="module")
def env():
    made = gym.make(PANDA, shapes=SHAPES).unwrapped
    yield made
    made.close()


@pytest.fixture(scope="module")
def several():
    made = gym.make_vec(PANDA, num_envs=3, threads=1, shapes=SHAPES).unwrapped
    yield made
    made.close()


CUBE = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]


@pytest.mark.parametrize("ends", [ENDS, {}], ids=["ends given", "ends drawn"])
@pytest.mark.parametrize(
    "obstacles",
    [
        [HOUSE], [[CRATE, HOUSE.to_dict()]], [CRATE, PLINTH], [HalfSpace(position=(0.0, 0.0, 0.9))],  # touch the arm
        [Box((1.5, 0.1, 0.1))], [Box((0.1, 0.1, 0.1), position=(3.0, 0.0, 0.0))],  # too large, too far
        [HalfSpace(position=(0.3, 0.0, -1.5))], [HalfSpace.facing((-1.0, 0.0, 0.0), position=(3.5, 0.0, 0.0))],
        [Cylinder(0.1, 0.1)], [ConvexMesh(CUBE)], [{"shape": "pyramid"}],  # not among the shapes
        [PointCloud([*CUBE, *CUBE])], [PointCloud(np.full((300, 3), 0.3))], [CRATE] * 9,  # too many
        np.zeros((1, 9, 15)),
        CRATE, CRATE.to_dict(), None, obstacles_to_json([CRATE]), np.array([CRATE]), (each for each in [CRATE]),
        [[0.1, 0.2], [0.3]], [[0.5, 0.0, 0.3, 0.0, 0.0, 0.1, -0.03]], np.zeros((1, 7), dtype=bool),
        np.full((1, 7), np.nan), np.full((1, 15), 0.1),  # no row of a shape
    ],
)  # fmt: skip
def test_impossible_obstacles_are_refused(env, obstacles, ends):
    with pytest.raises(ValueError):
        env.reset(seed=0, options={**ends, "obstacles": obstacles})


def test_each_scene_of_a_batch_has_its_own_names(several):
    for obstacles, words in (
        ([[CRATE], [CRATE, HOUSE], []], "scene 1: obstacle 1 'house'"),
        ([HOUSE], "scene 0: obstacle 0 'house'"),
    ):
        with pytest.raises(ValueError, match=words):
            several.reset(seed=0, options={**ENDS, "obstacles": obstacles})


@pytest.mark.parametrize("normal", np.vstack((np.eye(3), -np.eye(3), (0.6, 0.0, -0.8))))
def test_half_spaces_up_to_the_limit_are_in_the_observation_space(env, normal):
    surface = HalfSpace.facing(normal, position=-normal)
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": [surface]})
    assert env.observation_space.contains(observation)
    with pytest.raises(ValueError):
        env.reset(options={**ENDS, "obstacles": [HalfSpace.facing(normal, position=-1.01 * normal)]})


def test_observation_rows_take_dictionaries():
    np.testing.assert_array_equal(observation_rows([HOUSE.to_dict()], 2), observation_rows([HOUSE], 2))
    for obstacles, shapes in (([HOUSE], ("capsule",)), (HOUSE, None)):
        with pytest.raises(ValueError):
            observation_rows(obstacles, 1, shapes)


def test_options_of_a_scene_survive_json(env):
    """Shapes keep their names, and numbers all their digits."""
    third = Capsule(0.1 / 3.0, 0.2 / 3.0, position=(1.0 / 3.0, 0.6, 0.1), name="post")
    options = {**ENDS, "start": (0.45, -1.0 / 3.0, 0.4), "obstacles": [third, CRATE.to_dict()]}
    again = scene_from_json(scene_to_json(options, PANDA))
    assert again == {**{name: list(options[name]) for name in ENDS}, "obstacles": [third, CRATE]}
    env.reset(options=options)
    scenes = env.batch.scenes
    for given in (again, scene_from_json(scene_to_json(scenes.as_options()))):
        env.reset(options=given)
        for now, then in zip(env.batch.scenes, scenes, strict=True):
            np.testing.assert_array_equal(now, then)


@pytest.fixture
def table():
    """Table of shapes, which a test may change."""
    kept = dict(geometry_shapes.SHAPES)
    yield geometry_shapes.SHAPES
    geometry_shapes.SHAPES.clear()
    geometry_shapes.SHAPES.update(kept)


def test_rows_of_a_scene_file_keep_their_shapes_where_the_table_has_another_order(env, table):
    env.reset(options={**ENDS, "obstacles": [CRATE]})
    text, again = scene_to_json(env.batch.scenes.as_options()), dict(reversed(table.items()))
    table.clear()
    table.update(again)
    (found,) = obstacles_from_rows(np.array(scene_from_json(text)["obstacles"]))
    assert found == CRATE
    del table["box"]
    with pytest.raises(ValueError):
        scene_from_json(text)


def test_builtin_shapes_keep_their_numbers():
    """Frozen sets of scenes and checkpoints hold them."""
    kinds = ["sphere", "capsule", "cylinder", "box", "half_space", "convex_mesh", "point_cloud"]
    assert list(geometry_shapes.SHAPES)[: len(kinds)] == kinds


def test_changes_of_a_scene_survive_json():
    env = gym.make("viapoint/PlanarMovingObstacles-v0").unwrapped
    env.reset(seed=3)
    options = env.batch.scenes.as_options()
    again = scene_from_json(scene_to_json(options))
    assert list(again) == list(options)
    for name, (value,) in options.items():
        np.testing.assert_array_equal(again[name], value)
    env.close()


@pytest.mark.parametrize(
    "options",
    [
        [], {"begin": (0.1, 0.2)}, {"goal": np.zeros((2, 3))},
        {"start": "here"}, {"start": (np.nan, 0.0, 0.1)}, {"start": (True, False, True)},
        {"obstacles": HOUSE}, {"obstacles": [[HOUSE], [CRATE]]}, {"obstacles": [{"shape": "cube"}]},
    ],
)  # fmt: skip
def test_invalid_scenes_are_not_written(options):
    with pytest.raises(ValueError):
        scene_to_json(options)


def test_a_batch_of_one_scene_is_written_as_that_scene():
    assert scene_to_json({"obstacles": [[HOUSE]]}) == scene_to_json({"obstacles": [HOUSE]})


@pytest.mark.parametrize(
    "options",
    [
        *({"start": start} for start in (0.45, [0.45], [[0.45]] * 3, [[[0.45, -0.33, 0.4]]], [0.45, -0.33])),
        {"obstacles": [[CRATE], None, []]},
        {"obstacles": [[CRATE], 3, []]},
        {"obstacles": [[CRATE], [[0.0] * 5], []]},
        {"obstacles": [[], []]},
    ],
)
def test_options_fit_the_number_of_scenes_and_axes(several, options):
    with pytest.raises(ValueError):
        several.reset(seed=0, options={**ENDS, **options})


def test_scenes_may_have_lists_and_rows_of_different_lengths(several):
    cloud = PointCloud([(0.2, 0.5, 0.4), (0.2, 0.6, 0.4)], radius=0.02)
    capsule = obstacle_rows([Sphere(0.03, position=(0.2, 0.6, 0.4))], dimension=3)
    several.reset(seed=0, options={**ENDS, "obstacles": [[CRATE, cloud], capsule, []]})
    assert several.scenes.present.sum(axis=1).tolist() == [3, 1, 0]


def box_row(half=(0.03, 0.04, 0.05), kind="box", quaternion=(1.0, 0.0, 0.0, 0.0)):
    return shape_rows(kind, np.array([0.2, 0.6, 0.4]), np.array(quaternion), np.array(half))[None]


@pytest.mark.parametrize(
    ("kind", "half"),
    [
        ("box", (-0.3, 0.05, 0.05)), ("box", (0.0, 0.05, 0.05)), ("cylinder", (0.05, 0.06, 0.1)),
        ("cylinder", (0.05, 0.05, -0.1)), ("capsule", (0.05, 0.05, 0.02)), ("sphere", (0.05, 0.05, 0.1)),
    ],
)  # fmt: skip
def test_rows_of_shapes_have_possible_half_lengths(kind, half):
    env = gym.make(PANDA, shapes=("capsule", "sphere", "box", "cylinder")).unwrapped
    with pytest.raises(ValueError):
        env.reset(seed=0, options={**ENDS, "obstacles": box_row(half, kind)})
    env.close()


def test_quaternions_of_rows_are_normalised_if_they_nearly_are(env):
    env.reset(seed=0, options={**ENDS, "obstacles": box_row(quaternion=(1.0009, 0.0, 0.0, 0.0))})
    begin = 2 * 3 + 1
    assert env.batch.scenes.obstacles[0, 0, begin : begin + 4].tolist() == [1.0, 0.0, 0.0, 0.0]
    with pytest.raises(ValueError):
        env.reset(seed=0, options={**ENDS, "obstacles": box_row(quaternion=(1.01, 0.0, 0.0, 0.0))})


def test_obstacles_may_overlap_the_base(env):
    low = Box((0.15, 0.12, 0.05), position=PLINTH.position)
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": [low]})
    assert env.observation_space.contains(observation)


@pytest.mark.parametrize(
    ("env_id", "ends"),
    [
        (PANDA, ENDS),
        ("viapoint/PandaMovingObstacles-v0", ENDS),
        ("viapoint/PlanarMovingObstacles-v0", {"start": (-0.2, 0.3), "goal": (0.2, 0.3)}),
    ],
)
def test_walls_are_observed_where_they_are(env_id, ends):
    """Also where obstacles may move: their cubes are up to 2 m away."""
    env = gym.make(env_id, shapes=SHAPES).unwrapped
    wall = HalfSpace.facing((0.0, -1.0, 0.0), position=(0.0, 0.9, 0.0))
    observation, _ = env.reset(seed=0, options={**ends, "obstacles": [wall]})
    seen = env.observation_layout.obstacles(observation["obstacles"][0])
    np.testing.assert_allclose(seen.centre, (0.0, 1.9, 0.0), atol=1e-6)
    assert env.observation_space.contains(observation)
    env.close()


GOOD = shape_rows("box", np.zeros(3), np.array((1.0, 0.0, 0.0, 0.0)), np.full(3, 0.1))
UNKNOWN = [np.where(np.arange(len(GOOD)) == 6, kind, GOOD)[None] for kind in (99.0, -1.0, 2.7)]


@pytest.mark.parametrize("rows", [*UNKNOWN, np.ones(7), np.ones((2, 2, 7)), np.ones((1, 6)), "rows"])
def test_obstacles_are_read_from_a_table_of_rows_of_known_kinds(rows):
    with pytest.raises(ValueError):
        obstacles_from_rows(rows)


@pytest.mark.parametrize("text", [None, '{"format": "viapoint-scene", "goal": [0.1, 0.4], "obstacle": []}'])
def test_invalid_scene_files_are_refused(text):
    with pytest.raises(ValueError):
        scene_from_json(text)
