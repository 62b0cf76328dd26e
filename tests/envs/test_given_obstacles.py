"""Errors of given obstacles name them, and the options of a scene survive JSON."""

import re

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
LISTS = "obstacles must be a list of shapes, dictionaries or rows of numbers"


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


def reset(env, obstacles, reason, ends):
    with pytest.raises(ValueError, match=re.escape(reason)) as caught:
        env.reset(seed=0, options={**ends, "obstacles": obstacles})
    assert "-0," not in str(caught.value)
    assert "-0)" not in str(caught.value)


@pytest.mark.parametrize("ends", [ENDS, {}], ids=["ends given", "ends drawn"])
@pytest.mark.parametrize(
    ("obstacles", "reason"),
    [
        ([HOUSE], "obstacle 0 'house' (box at (0.2, 0, 0.4) m, half lengths (0.3, 0.3, 0.3) m) touches"),
        ([[CRATE, HOUSE.to_dict()]], "obstacle 1 'house' (box at"),
        ([CRATE, Box((1.5, 0.1, 0.1), name="long")], "obstacle 1 'long' (box at"),
        ([Box((0.1, 0.1, 0.1), position=(3.0, 0.0, 0.0), name="far")], "obstacle 0 'far' (box at (3, 0, 0) m"),
        ([Cylinder(0.1, 0.1, name="can")], "obstacle 0 'can': the scenes of this environment have the shapes"),
        ([ConvexMesh([*np.eye(3), (0, 0, 0)], name="mesh")], "obstacle 0 'mesh': the scenes of this"),
        (
            [HalfSpace(position=(0.3, 0.0, -1.5))],
            "obstacle 0 (half_space through (0, 0, -1.5) m with normal (0, 0, 1)) has its surface over 1 m from",
        ),
        (
            [HalfSpace.facing((-1.0, 0.0, 0.0), position=(3.5, 0.0, 0.0), name="wall")],
            "obstacle 0 'wall' (half_space through (3.5, 0, 0) m with normal (-1, 0, 0)) has its surface over 1 m",
        ),
        ([HalfSpace(position=(0.0, 0.0, 0.9))], "half_space through (0, 0, 0.9) m with normal (0, 0, 1)) contains"),
        ([CRATE, PLINTH], "obstacle 1 'plinth' (box at (-0.04, 0, 0.05) m, half lengths (0.15, 0.12, 0.12) m) contain"),
    ],
)  # fmt: skip
def test_errors_name_the_obstacle_as_the_user_gave_it(env, obstacles, reason, ends):
    reset(env, obstacles, reason, ends)


def test_each_scene_of_a_batch_has_its_own_names():
    envs = gym.make_vec(PANDA, num_envs=2, shapes=SHAPES).unwrapped
    reset(envs, [[CRATE], [CRATE, HOUSE]], "scene 1: obstacle 1 'house' (box at", ENDS)
    reset(envs, [HOUSE], "scene 0: obstacle 0 'house' (box at", ENDS)
    envs.close()


@pytest.mark.parametrize("normal", np.vstack((np.eye(3), -np.eye(3), (0.6, 0.0, -0.8))))
def test_half_spaces_up_to_the_limit_are_in_the_observation_space(env, normal):
    surface = HalfSpace.facing(normal, position=-normal)
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": [surface]})
    assert env.observation_space.contains(observation)
    reset(env, [HalfSpace.facing(normal, position=-1.01 * normal)], "has its surface over 1 m", ENDS)


@pytest.mark.parametrize(
    ("obstacles", "reason"),
    [
        ([CRATE] * 9, "at most 8 obstacles, got 9"),
        (np.zeros((1, 9, 15)), "at most 8 obstacles, got 9"),
        (CRATE, f"{LISTS}; put a single obstacle in a list, got Box("),
        (CRATE.to_dict(), f"{LISTS}; put a single obstacle in a list, got {{"),
        (None, f"{LISTS}, got None"),
        (obstacles_to_json([CRATE]), f"{LISTS}, got '["),
        (np.array([CRATE]), f"{LISTS}, got array"),
        ((each for each in [CRATE]), f"{LISTS}, got <generator"),
        ([[0.1, 0.2], [0.3]], f"{LISTS}, got [["),
        (np.zeros((1, 7), dtype=bool), f"{LISTS}, got array"),
    ],
)
def test_what_is_no_list_of_obstacles_is_refused_with_what_is(env, obstacles, reason):
    reset(env, obstacles, reason, ENDS)


def test_observation_rows_take_dictionaries_and_name_shapes_that_they_lack():
    np.testing.assert_array_equal(observation_rows([HOUSE.to_dict()], 2), observation_rows([HOUSE], 2))
    with pytest.raises(ValueError, match="obstacle 0 'house': the shapes are capsule, not box"):
        observation_rows([HOUSE], 1, ("capsule",))
    with pytest.raises(ValueError, match="put a single obstacle in a list"):
        observation_rows(HOUSE, 1)


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
    with pytest.raises(ValueError, match=r"obstacle 0 of the scene file: unknown shape 'box'. Shapes are"):
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
    ("options", "reason"),
    [
        ({"begin": (0.1, 0.2)}, "not 'begin'"),
        ({"obstacles": HOUSE}, "put a single obstacle in a list"),
        ({"obstacles": [[HOUSE], [CRATE]]}, "options['obstacles'] must be real numbers"),
        ({"obstacles": [{"shape": "cube"}]}, "unknown shape 'cube'"),
        ({"goal": np.zeros((2, 3))}, "options['goal'] must be those of one scene, got 2 scenes"),
        ({"start": "here"}, "options['start'] must be real numbers"),
        ({"start": (np.nan, 0.0, 0.1)}, "options['start'] must be finite, got nan"),
        ({"start": (True, False, True)}, "options['start'] must be real numbers"),
        ([], "options must be those of reset, a dictionary, got []"),
    ],
)
def test_what_is_no_scene_is_not_written(options, reason):
    with pytest.raises(ValueError, match=re.escape(reason)):
        scene_to_json(options)


def test_a_batch_of_one_scene_is_written_as_that_scene():
    assert scene_to_json({"obstacles": [[HOUSE]]}) == scene_to_json({"obstacles": [HOUSE]})


@pytest.mark.parametrize("start", [0.45, [0.45], [[0.45]] * 3, [[[0.45, -0.33, 0.4]]], [0.45, -0.33]])
def test_ends_have_one_number_for_each_axis(several, start):
    with pytest.raises(ValueError, match=re.escape("options['start'] must have shape (3, 3) or (3,), got")):
        several.reset(seed=0, options={**ENDS, "start": start})


@pytest.mark.parametrize(
    ("obstacles", "reason"),
    [
        ([[CRATE], None, []], f"scene 1: {LISTS}, got None"),
        ([[CRATE], 3, []], f"scene 1: {LISTS}, got 3"),
        ([[CRATE], [[0.0] * 5], []], "scene 1: rows of obstacles must have 15 numbers, got shape (1, 5)"),
        ([[], []], "options['obstacles'] must have shape (n, 15) or (3, n, 15)"),
    ],
)
def test_obstacles_of_each_scene_are_lists(several, obstacles, reason):
    with pytest.raises(ValueError, match=re.escape(reason)):
        several.reset(seed=0, options={**ENDS, "obstacles": obstacles})


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
        ("box", (-0.3, 0.05, 0.05)),
        ("box", (0.0, 0.05, 0.05)),
        ("cylinder", (0.05, 0.06, 0.1)),
        ("cylinder", (0.05, 0.05, -0.1)),
        ("capsule", (0.05, 0.05, 0.02)),
        ("sphere", (0.05, 0.05, 0.1)),
    ],
)
def test_rows_of_shapes_have_possible_half_lengths(kind, half):
    env = gym.make(PANDA, shapes=("capsule", "sphere", "box", "cylinder")).unwrapped
    reset(env, box_row(half, kind), "is no row of a shape", ENDS)
    env.close()


def test_quaternions_of_rows_are_normalised_if_they_nearly_are(env):
    env.reset(seed=0, options={**ENDS, "obstacles": box_row(quaternion=(1.0009, 0.0, 0.0, 0.0))})
    begin = 2 * 3 + 1
    assert env.batch.scenes.obstacles[0, 0, begin : begin + 4].tolist() == [1.0, 0.0, 0.0, 0.0]
    reset(env, box_row(quaternion=(1.01, 0.0, 0.0, 0.0)), "is no row of a shape", ENDS)


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


@pytest.mark.parametrize("kind", [99.0, -1.0, 2.7])
def test_rows_of_unknown_kinds_are_refused(kind):
    good = shape_rows("box", np.zeros(3), np.array((1.0, 0.0, 0.0, 0.0)), np.full(3, 0.1))
    bad = good.copy()
    bad[6] = kind
    with pytest.raises(ValueError, match=f"obstacle 1 has the kind {kind:g}; kinds are 0 sphere, 1 capsule"):
        obstacles_from_rows(np.stack((good, bad)))


@pytest.mark.parametrize("rows", [np.ones(7), np.ones((2, 2, 7)), np.ones((1, 6)), "rows"])
def test_obstacles_are_read_from_a_table_of_rows(rows):
    with pytest.raises(ValueError, match=r"rows must have shape \(n, .\)"):
        obstacles_from_rows(rows)


def test_nothing_is_no_scene_file():
    with pytest.raises(ValueError, match="not JSON"):
        scene_from_json(None)


def test_misspelled_parts_of_a_scene_file_are_refused():
    with pytest.raises(ValueError, match="not 'obstacle'"):
        scene_from_json('{"format": "viapoint-scene", "goal": [0.1, 0.4], "obstacle": []}')
