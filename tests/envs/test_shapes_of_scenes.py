"""Scenes with obstacles of any shape: rows, simulation, observation and given scenes agree with the shapes."""

import re
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import (
    SHAPES,
    Box,
    Capsule,
    ConvexMesh,
    Cylinder,
    HalfSpace,
    Plan,
    PointCloud,
    Sphere,
    as_obstacle,
    obstacle_rows,
    obstacles_from_json,
    obstacles_from_rows,
    obstacles_to_json,
    register_mesh,
)
from viapoint.envs.arms import ADULT
from viapoint.envs.arms import PANDA as FRANKA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance
from viapoint.envs.geometry.rows import (
    pair_distance,
    quaternion_of_axes,
    rotation_axes,
    shape_columns,
    widened,
)
from viapoint.envs.scenes.draws import RESHAPE_NUMBERS, reshaped
from viapoint.training import GeometrySearch

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from contacts import KINDS, contacts, random_obstacles, register_example

EVERY = pytest.mark.parametrize("kind", KINDS)
PANDA = "viapoint/PandaObstacles-v0"
WHOLE_PANDA = CollisionModel(FRANKA, whole_arm=True)
ENDS = {"start": (0.45, -0.33, 0.4), "goal": (0.45, 0.33, 0.4)}
CRATE = Box((0.03, 0.03, 0.03), position=(0.2, 0.6, 0.4))
SCENE = [
    Box((0.1, 0.02, 0.03), position=(0.5, 0.0, 0.4), quaternion=(0.96, 0.0, 0.0, 0.28)),
    Cylinder(0.03, 0.1, position=(0.6, 0.25, 0.1)),
    HalfSpace(position=(0.0, 0.0, -0.05)),
    Sphere(0.03, position=(0.5, 0.0, 0.6)),
    Capsule(0.02, 0.1, position=(0.7, -0.2, 0.1), quaternion=(0.6, 0.8, 0.0, 0.0)),
]


@pytest.fixture
def generator():
    return np.random.default_rng(3)


@pytest.fixture
def env():
    made = gym.make(PANDA, shapes=KINDS).unwrapped
    yield made
    made.close()


@EVERY
@pytest.mark.parametrize(
    "model", [WHOLE_PANDA, CollisionModel(ADULT, whole_arm=False)], ids=["panda", "hand"]
)
def test_contact_in_mujoco_is_negative_clearance(model, kind):
    found = contacts(model, kind, 400)
    assert 50 < found.contacts < 390
    assert found.wrong == 0


@EVERY
def test_rows_keep_the_shape(kind, generator):
    rows = random_obstacles(kind, generator.uniform(-0.3, 0.3, (20, 3)), generator)
    if kind == "half_space":  # whose centre is chosen
        rows = obstacle_rows(obstacles_from_rows(rows), 3, KINDS)
    again = obstacle_rows(obstacles_from_rows(rows), 3, KINDS)
    np.testing.assert_allclose(again, rows, atol=1e-12)
    first, second = generator.uniform(-0.5, 0.5, (2, 20, 3))
    for row, shape, a, b in zip(rows, obstacles_from_rows(rows), first, second, strict=True):
        assert shape.kind == kind
        exact = shape.distance(a), shape.segment_distance(a, b)
        np.testing.assert_allclose(pair_distance(row[None], a[None]), exact[0], atol=1e-12)
        np.testing.assert_allclose(pair_distance(row[None], a[None], b[None]), exact[1], atol=1e-12)


@EVERY
def test_the_capsule_of_a_row_bounds_distances_from_below(kind, generator):
    rows = random_obstacles(kind, generator.uniform(-0.3, 0.3, (300, 3)), generator)
    points = generator.uniform(-0.6, 0.6, (300, 3))
    capsules, present = np.concatenate((rows[:, :6], rows[:, -1:]), axis=-1), np.ones((300, 1), dtype=bool)
    bound = hand_clearance(points[:, None], 0.0, capsules[:, None], present)[:, 0]
    assert (bound <= pair_distance(rows, points) + 1e-9).all()


@EVERY
@pytest.mark.parametrize("dimension", [2, 3])
def test_least_clearance_is_that_of_the_shapes(kind, dimension, generator):
    rows = random_obstacles(kind, generator.uniform(-0.3, 0.3, (6, dimension)), generator)[None]
    links = generator.uniform(-0.5, 0.5, (1, 8, 3, 2, dimension))
    present = np.ones((1, 6), dtype=bool)
    radii = (0.01, 0.02, 0.03)
    flat = np.concatenate((links, np.zeros((*links.shape[:-1], 3 - dimension))), axis=-1)[0]
    wanted = [
        min(
            (shape.segment_distance(flat[:, i, 0], flat[:, i, 1]) - radius).min()
            for i, radius in enumerate(radii)
        )
        for shape in obstacles_from_rows(rows[0])
    ]
    np.testing.assert_allclose(arm_clearance(links, radii, rows, present)[0], wanted, atol=1e-9)
    wanted = [shape.distance(flat[:, 0, 0]).min() - 0.01 for shape in obstacles_from_rows(rows[0])]
    np.testing.assert_allclose(hand_clearance(links[..., 0, 0, :], 0.01, rows, present)[0], wanted, atol=1e-9)


def test_quaternions_are_those_of_axes(generator):
    quaternion = generator.normal(size=(500, 4))
    quaternion[np.arange(100), generator.integers(4, size=100)] = 0.0
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    axes = rotation_axes(quaternion)
    again = quaternion_of_axes(*axes[:2])
    np.testing.assert_allclose(np.abs((again * quaternion).sum(axis=-1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.stack(axes, axis=-1)[0], Box((1, 1, 1), quaternion=quaternion[0]).rotation)


def test_observation_and_scene_agree(env):
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": SCENE})
    assert env.observation_space.contains(observation)
    rows = env.batch.scenes.obstacles
    seen = env.observation_layout.scene_rows(observation["obstacles"][None])
    np.testing.assert_allclose(seen, rows, atol=1e-6)
    assert (observation["obstacles"][5:] == 0.0).all()
    given = obstacles_from_rows(rows[0])
    assert [each.kind for each in given] == [each.kind for each in SCENE]
    points = np.random.default_rng(0).uniform(-0.5, 0.8, (200, 3))
    for mine, theirs in zip(given, SCENE, strict=True):
        np.testing.assert_allclose(mine.distance(points), theirs.distance(points), atol=1e-9)


def test_scenes_are_given_as_records_dictionaries_json_and_rows(env):
    wanted, _ = env.reset(seed=0, options={**ENDS, "obstacles": SCENE})
    text = obstacles_to_json(obstacles_from_rows(env.batch.scenes.obstacles[0]))
    rows = env.batch.scenes.obstacles[0]
    for obstacles in ([each.to_dict() for each in SCENE], obstacles_from_json(text), rows):
        observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": obstacles})
        np.testing.assert_allclose(observation["obstacles"], wanted["obstacles"], atol=1e-6)
    bar = obstacle_rows([Capsule(0.02, 0.1, position=(0.7, -0.2, 0.1))], 3)
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": bar})  # rows of capsules are taken, too
    assert observation["obstacles"][0, KINDS.index("capsule")] == 1.0


@pytest.mark.parametrize(
    ("env_id", "shapes"),
    [
        (PANDA, ("capsule", "box")),
        ("viapoint/PlanarWholeArm-v0", ("box", "cylinder")),
        ("viapoint/PlanarObstacles-v0", ("sphere", "capsule", "box")),
        ("viapoint/PandaMovingObstacles-v0", ("capsule", "box")),
    ],
)
def test_random_scenes_have_all_shapes_and_contact_is_negative_clearance(env_id, shapes):
    envs = gym.make_vec(env_id, num_envs=24, threads=1, shapes=shapes).unwrapped
    observation, _ = envs.reset(seed=0)
    scenes, space = envs.scenes, envs.observation_space
    kinds = np.array(list(SHAPES))[shape_columns(scenes.obstacles).kind[scenes.present]]
    assert set(kinds) == set(shapes)
    assert all(space[name].contains(part) for name, part in observation.items())
    *_, info = envs.step(np.zeros(envs.action_space.shape))
    assert info["collision"].mean() > 0.1
    # Physics sees the last state of a decision in the next one, when a moving obstacle is some millimetres farther.
    apart = np.abs(info["min_clearance"]) > (2e-3 if "Moving" in env_id else 1e-4)
    assert ((info["min_clearance"] < 0.0) == info["collision"])[apart].all()
    state = envs.state()
    envs.step(np.zeros(envs.action_space.shape))
    envs.restore(state)
    envs.close()


def test_what_replaces_a_capsule_is_inside_it(generator):
    for d in (2, 3):
        rows = np.full((200, 2 * d + 1), 0.03)
        rows[:, :d] = generator.uniform(-0.3, 0.3, (200, d))
        rows[:, d : 2 * d] = generator.uniform(-0.1, 0.1, (200, d))
        rows[::2, d : 2 * d] = 0.0
        other = reshaped(rows, generator.random((200, RESHAPE_NUMBERS)), ("sphere", "box", "cylinder"))
        points = np.zeros((200, 3))
        points[:, :d] = generator.uniform(-0.4, 0.4, (200, d))
        assert (pair_distance(other, points) >= pair_distance(widened(rows), points) - 1e-9).all()
        np.testing.assert_array_equal(other[:, :d], rows[:, :d])


def test_the_ellipsoid_of_contributing_can_be_in_scenes(monkeypatch, generator):
    page = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (code,) = [each for each in blocks if "class Ellipsoid" in each]
    names = {}
    exec(code.partition("SHAPES[Ellipsoid.kind]")[0], names)
    monkeypatch.setitem(SHAPES, "ellipsoid", names["Ellipsoid"])
    values = {"size": (0.03, 0.04, 0.06), "position": (0.45, 0.0, 0.4), "quaternion": (0.6, 0.8, 0.0, 0.0)}
    egg, points = as_obstacle({"shape": "ellipsoid", **values}), generator.uniform(-0.2, 0.8, (200, 3))
    env = gym.make(PANDA, shapes=("capsule", "ellipsoid")).unwrapped
    observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": [egg]})
    np.testing.assert_allclose(observation["obstacles"][0, -4:-1], egg.size, atol=1e-6)
    (again,) = obstacles_from_rows(env.batch.scenes.obstacles[0])
    assert again.kind == "ellipsoid"
    np.testing.assert_allclose(again.distance(points), egg.distance(points), atol=1e-9)
    *_, info = env.step(np.zeros(4))  # straight through it
    assert info["collision"]
    assert info["min_clearance"] < 0.0
    env.close()


CUBE = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]


@pytest.fixture
def mesh():
    name = register_example("lump")
    yield SHAPES[name]
    del SHAPES[name]


def test_contact_with_a_mesh_in_mujoco_is_negative_clearance(mesh):
    found = contacts(WHOLE_PANDA, "lump", 1000)
    assert 200 < found.contacts < 900
    assert found.wrong == 0


def test_a_registered_mesh_is_an_obstacle_of_scenes(mesh, generator):
    pose = {"position": (0.45, 0.0, 0.4), "quaternion": (0.6, 0.0, 0.8, 0.0)}
    shape, named = ConvexMesh(mesh.mesh.vertices, **pose), {"shape": "lump", **pose}
    envs = gym.make_vec(PANDA, num_envs=2, shapes=("box", "lump"))
    points = generator.uniform(-0.2, 0.8, (200, 3))
    observation, _ = envs.reset(options={**ENDS, "obstacles": [[shape], [CRATE, as_obstacle(named)]]})
    centre, half = shape.box()
    np.testing.assert_allclose(observation["obstacles"][0, 0, :5], (0, 1, *centre), atol=1e-6)
    np.testing.assert_allclose(observation["obstacles"][0, 0, -4:-1], half, atol=1e-6)
    (first,), (_, second) = (obstacles_from_rows(rows) for rows in envs.unwrapped.scenes.obstacles)
    for again in (first, second, *obstacles_from_json(obstacles_to_json([first]))):
        assert again.kind == "lump"
        np.testing.assert_allclose(again.distance(points), shape.distance(points), atol=1e-9)
    *_, info = envs.step(np.zeros((2, 4)))  # straight through it
    assert info["collision"].all()
    assert (info["min_clearance"] < 0.0).all()
    plan = GeometrySearch(PANDA, n_checks=256, shapes=("box", "lump")).plan(**ENDS, obstacles=[named])
    both = Plan(*(np.stack((part, part)) for part in plan))
    envs.reset(options={**ENDS, "obstacles": [[shape], [named]]})
    _, _, info = envs.unwrapped.execute_plan(both)
    assert info["is_success"].all()
    envs.close()


def test_random_scenes_have_no_registered_meshes(mesh):
    envs = gym.make_vec(PANDA, num_envs=32, shapes=("box", "lump"))
    envs.reset(seed=0)
    rows = envs.unwrapped.scenes.obstacles
    assert set(np.unique(shape_columns(rows).kind[rows[..., -1] > 0.0])) == {list(SHAPES).index("box")}
    envs.close()


def test_rows_of_a_mesh_have_its_size(mesh):
    env = gym.make(PANDA, shapes=("box", "lump")).unwrapped
    rows = obstacle_rows([mesh(position=(0.45, 0.0, 0.4))], 3, ("box", "lump"))
    rows[0, -2] *= 2.0  # half of the height
    with pytest.raises(ValueError):
        env.reset(options={**ENDS, "obstacles": rows})
    env.close()


def test_a_name_belongs_to_one_mesh(mesh):
    register_mesh("lump", ConvexMesh(mesh.mesh.vertices, name="again"))
    die = ConvexMesh(CUBE)
    for name, other, error in (
        ("other", ConvexMesh(CUBE, position=(1.0, 0.0, 0.0)), ValueError),
        ("lump", die, ValueError),
        ("box", die, ValueError),
        ("two words", die, ValueError),
        ("die", CUBE, TypeError),
    ):
        with pytest.raises(error):
            register_mesh(name, other)
    with pytest.raises(ValueError):
        gym.make("viapoint/PlanarObstacles-v0", shapes=("box", "lump"))
    with pytest.raises(ValueError):
        gym.make("viapoint/PlanarObstacles-v0").reset(options={"obstacles": [die]})


@pytest.mark.parametrize("shapes", [("capsule",), ("sphere", "box")])
def test_a_point_cloud_is_its_spheres(shapes, generator):
    points = generator.uniform((-0.1, -0.02, -0.1), (0.1, 0.02, 0.1), (40, 3))
    cloud = PointCloud(
        points, radius=0.02, position=(0.5, 0.0, 0.4), quaternion=(0.6, 0.0, 0.0, 0.8), name="scan"
    )
    env = gym.make(PANDA, n_obstacles=(0, 40), shapes=shapes).unwrapped
    env.reset(seed=0, options={**ENDS, "obstacles": [cloud]})
    seen = obstacles_from_rows(env.batch.scenes.obstacles[0])
    assert len(seen) == 40
    where = generator.uniform(-0.2, 0.8, (200, 3))
    least = np.min([each.distance(where) for each in seen], axis=0)
    np.testing.assert_allclose(least, cloud.distance(where), atol=1e-12)
    *_, info = env.step(np.zeros(4))
    assert info["collision"]
    env.close()


def test_a_coarse_cloud_contains_the_fine_one(generator):
    points = generator.uniform(-0.1, 0.1, (500, 3))
    fine = PointCloud(points, radius=0.005, position=(0.1, 0.2, 0.3), quaternion=(0.6, 0.8, 0.0, 0.0))
    coarse = PointCloud.covering(points, 0.05, 0.005, position=fine.position, quaternion=fine.quaternion)
    assert len(coarse.points) <= 4**3
    where = generator.uniform(-0.3, 0.6, (500, 3))
    assert (coarse.distance(where) <= fine.distance(where) + 1e-12).all()


@pytest.mark.parametrize("shapes", [(), ("box", "box"), ("pyramid",), ("convex_mesh",), ("half_space",), 3])
def test_unknown_shapes_of_scenes_are_refused(shapes):
    with pytest.raises(ValueError):
        gym.make(PANDA, shapes=shapes)


@pytest.mark.parametrize(
    "obstacle",
    [
        Box((0.1, 0.1, 0.1), position=(0.0, 0.4, 0.1)),
        Cylinder(0.1, 0.1, position=(0.0, 0.4, 0.0), quaternion=(0.6, 0.8, 0.0, 0.0)),
        HalfSpace(position=(0.0, 0.4, 0.0)),
        Sphere(0.02, position=(0.1, 0.4, 0.1)),
        Capsule(0.02, 0.1, position=(0.1, 0.4, 0.0)),
        Sphere(np.full(3, 0.02), position=np.zeros((3, 3))),
    ],
)
def test_obstacles_of_planar_arms_lie_in_the_plane_or_stand_upright(obstacle):
    with pytest.raises(ValueError):
        obstacle_rows([obstacle], 2, KINDS)
