"""Obstacles are the same as shapes, dictionaries, JSON, packed arrays, rows and geoms; bad input is refused."""

import json

import mujoco
import numpy as np
import pytest
from helpers import random_shape

import viapoint.envs as ve
from viapoint.envs.geometry.obstacles import (
    ABSENT,
    KINDS,
    POSE_SIZE,
    add_to_model,
    bounding_boxes,
    geom_fields,
    geom_meshes,
    no_obstacles,
    pack,
    quaternions_of,
    unpack,
)
from viapoint.envs.geometry.shapes import check_kinds

ALL = pytest.mark.parametrize("kind", KINDS)
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) / 10
WEDGE = CUBE[[0, 1, 2, 3, 4, 5]]


@pytest.fixture
def wedge():
    """Name of a registered mesh."""
    ve.register_mesh("wedge", WEDGE)
    return "wedge"


def some_shapes(rng, kinds=KINDS, number=3):
    return [random_shape(kind, rng, moving=True) for kind in kinds for _ in range(number)]


def assert_same_distances(obstacles, scenes, rng, atol=1e-9):
    """Check that the obstacles of each scene have the distances of its shapes from random points."""
    points = rng.uniform(-0.5, 0.5, (100, 3))
    for i, shapes in enumerate(scenes):
        found = ve.signed_distances(unpack(obstacles, i), points)
        np.testing.assert_allclose(found, ve.signed_distances(shapes, points), atol=atol)


@ALL
def test_dictionaries_and_json_keep_shapes_as_they_are(kind, rng):
    every = some_shapes(rng, [kind], 20)
    off = [{**shape.to_dict(), "quaternion": 1.0005 * shape.quaternion, "name": "it"} for shape in every]
    every += ve.as_obstacles(off)
    assert ve.obstacles_from_json(ve.obstacles_to_json(every)) == every
    assert every[0] != ve.as_obstacle({**every[0].to_dict(), "name": "it"})
    assert every[0] != every[1]
    assert json.loads(ve.obstacles_to_json(every))[0]["shape"] == kind
    np.testing.assert_allclose([np.linalg.norm(each.quaternion) for each in every], 1.0, atol=1e-12)


def test_packed_obstacles_are_unpacked_as_the_same_shapes(rng):
    scenes = [some_shapes(rng), [], some_shapes(rng, KINDS[:3], 1)]
    obstacles = pack(scenes)
    assert obstacles.present.sum(axis=1).tolist() == [len(scene) for scene in scenes]
    assert_same_distances(obstacles, scenes, rng)
    for i, scene in enumerate(scenes):
        again = unpack(obstacles, i)
        assert [shape.kind for shape in again] == [shape.kind for shape in scene]
        for one, other in zip(again, scene, strict=True):
            np.testing.assert_array_equal(one.velocity, other.velocity)
    assert pack([scenes[0]], rows=30).kind.shape == (1, 30)


def test_scenes_are_taken_and_put(rng):
    """Tables hold what is in use, once."""
    first, second = some_shapes(rng), some_shapes(rng)
    obstacles = pack([first, first, second])
    other = pack([second, second], rows=len(first))
    assert len(obstacles.meshes.first) - 1 == len(obstacles.clouds.radius) == 6
    assert obstacles.take(np.array([True, False, True])).kind.shape[0] == 2
    before = obstacles.take([0, 1])
    changed = obstacles.put([1], other.take(slice(1, 2)))
    changed = changed.put([2], changed.take([0]))
    assert_same_distances(changed, (first, second, first), rng)
    assert len(changed.meshes.first) - 1 == 6
    np.testing.assert_array_equal(changed.kind, obstacles.kind)  # in place
    assert len(changed.put([1], before.take([0])).clouds.radius) == 3
    empty = no_obstacles(2, 4)
    assert (empty.kind == ABSENT).all()
    assert all(np.isfinite(part).all() for part in empty[:5])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_of_observations_are_read_back(dtype, rng, wedge):
    kinds = ("box", wedge, "half_space", "sphere", "capsule", "cylinder")
    meshes = [{"shape": wedge, "position": rng.normal(size=3), "velocity": (0.1, 0.2, 0.3)} for _ in range(2)]
    scenes = [some_shapes(rng, KINDS[:5]), [*meshes, *some_shapes(rng, KINDS[:2])], []]
    rows = ve.observation_rows(pack(scenes, rows=20), kinds)
    assert rows.shape == (3, 20, len(kinds) + POSE_SIZE)
    assert (rows[~pack(scenes, rows=20).present] == 0.0).all()
    again = ve.obstacles_from_rows(rows.astype(dtype), kinds)
    atol = 1e-5 if dtype is np.float32 else 1e-9
    assert_same_distances(again, scenes, rng, atol)
    np.testing.assert_allclose(ve.observation_rows(again, kinds), rows, atol=atol)


def test_bounding_boxes_contain_the_shapes(rng):
    shapes = some_shapes(rng)
    centre, half = (part[0] for part in bounding_boxes(pack([shapes])))
    for shape, middle, size in zip(shapes, centre, half, strict=True):
        points = middle + rng.uniform(-1.2, 1.2, (20_000, 3)) * size @ shape.rotation.T
        inside = points[shape.distance(points) < 0.0]
        if shape.kind == "half_space":
            assert shape.distance(middle) == pytest.approx(-1.0)
            continue
        local = np.abs((inside - middle) @ shape.rotation) / size
        assert (local.max(axis=0) <= 1.0 + 1e-12).all()
        assert (local.max(axis=0) > 0.8).all()


def test_geoms_are_those_that_mujoco_compiles(rng, wedge):
    shapes = [*some_shapes(rng, KINDS[:5]), ve.as_obstacle({"shape": wedge, "position": (0.1, 0.2, 0.3)})]
    spec = mujoco.MjSpec()
    assert add_to_model(spec, shapes)[0] == ["obstacle_0_0"]
    obstacles = pack([shapes, []], rows=len(shapes))
    model, fields = spec.compile(), geom_fields(obstacles)
    assert geom_meshes(obstacles)[0].tolist() == [""] * 15 + [wedge]
    np.testing.assert_array_equal(fields["geom_type"][0], model.geom_type)
    # Neither the mesh, nor boxes around half-spaces, which MuJoCo does not have
    for name, last in (("geom_size", 15), ("geom_rbound", 15), ("geom_aabb", 12)):
        mine, theirs = fields[name][0, :last], getattr(model, name)[:last]
        np.testing.assert_allclose(mine, theirs, atol=1e-12)
    turns = np.abs((quaternions_of(obstacles.rotation[0]) * model.geom_quat).sum(axis=-1))
    np.testing.assert_allclose(turns[:15], 1.0, atol=1e-12)


def test_bars_have_their_ends_and_half_spaces_face_normals_of_any_length():
    bar = ve.Capsule.between((0.1, 0.2, 0.3), (0.4, 0.1, 0.2), 0.02, name="bar")
    way = bar.half_length * bar.rotation[:, 2]
    np.testing.assert_allclose((bar.position - way, bar.position + way), [(0.1, 0.2, 0.3), (0.4, 0.1, 0.2)])
    wall = ve.HalfSpace.facing((1e-30, 0.0, 0.0), position=(0.5, 0.0, 0.0))
    np.testing.assert_allclose(wall.rotation[:, 2], (1.0, 0.0, 0.0), atol=1e-12)


@pytest.mark.parametrize("flat", [1.0, 0.05])
def test_hulls_are_closed_and_convex_and_look_outwards(flat, rng):
    for number in (4, 8, 40, 300):
        points = rng.normal(size=(number, 3)) * (1.0, 1.0, flat)
        mesh = ve.ConvexMesh.hull(points)
        corners, normals = mesh.mesh.corners, mesh.mesh.normals
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((across * normals).sum(axis=1) > 0.0).all()
        assert ((points[:, None] - corners[:, 0]) * normals).sum(axis=-1).max() < 1e-6
        assert len(corners) == 2 * len(mesh.vertices) - 4  # Euler's formula
        assert ve.ConvexMesh.hull(mesh.vertices) == mesh
        np.testing.assert_allclose(mesh.distance(mesh.vertices), 0.0, atol=1e-9)


def test_points_of_a_mesh_are_on_its_surface_where_many_faces_are_in_one_plane_but_for_rounding(rng):
    grid = np.stack(np.meshgrid(*[np.linspace(-size, size, 5) for size in (0.05, 0.03, 0.1)]), axis=-1)
    for _ in range(10):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        points = np.float32(grid.reshape(-1, 3) @ turn.T + rng.normal(size=3))
        outside = np.abs(grid.reshape(-1, 3) / (0.05, 0.03, 0.1)).max(axis=1) == 1.0
        distance = ve.ConvexMesh.hull(points).distance(points)
        np.testing.assert_allclose(distance[outside], 0.0, atol=1e-6)
        assert (distance[~outside] < -0.01).all()


def test_a_covering_cloud_contains_the_spheres_of_its_points(rng):
    points = rng.normal(size=(500, 3)) * 0.2
    cloud = ve.PointCloud.covering(points, spacing=0.1, radius=0.01)
    assert len(cloud.points) < 450
    assert (cloud.distance(points) <= -0.01 + 1e-12).all()


def test_a_registered_mesh_is_a_shape_whose_name_is_taken(wedge):
    ve.register_mesh(wedge, WEDGE.tolist())  # the same again
    placed = ve.as_obstacle({"shape": wedge, "position": (1.0, 0.0, 0.0)})
    assert placed == ve.ConvexMesh(WEDGE, position=(1.0, 0.0, 0.0))
    assert check_kinds(["box", wedge]) == ("box", wedge)
    with pytest.raises(ValueError, match="another shape"):
        ve.register_mesh(wedge, CUBE)


REFUSED = {
    "sphere": [{"radius": radius} for radius in (0.0, np.nan, -0.1, "a", None, True, (0.1, 0.1), 1j)],
    "capsule": [{"radius": 0.1, "half_length": 0.1, "name": 3}, {"radius": 0.1}],
    "cylinder": [{"radius": np.ones(4), "half_length": 1.0}, {"radius": 0.1, "half_length": np.inf}],
    "box": [{}, {"size": (0.1, -0.1, 0.1)}, {"size": (0.1, 0.1)}, {"size": (1, 1, 1), "centre": 0}],
    "half_space": [
        *({"position": position} for position in ((0, 0), (0, 0, np.inf), "abc", np.zeros((2, 3)))),
        *({"quaternion": quaternion} for quaternion in ((1, 1, 0, 0), (0, 0, 0, 0), (1.002, 0, 0, 0), (1, 0, 0))),
        *({"velocity": velocity} for velocity in ((0, 0), (0, 0, np.nan))),
    ],
    "convex_mesh": [
        *({"vertices": given} for given in (CUBE[:3], CUBE[:4], np.zeros((5, 3)), CUBE * np.nan, CUBE * 1e200)),
        {"vertices": [*CUBE, (0.05, 0.05, 0.05)]},
        {"vertices": CUBE, "faces": [(0, 1, 2)]},
    ],
    "point_cloud": [
        *({"points": points} for points in ([(0, 0, 0), (0, np.nan, 0)], np.zeros((0, 3)))),
        *({"points": CUBE, "radius": radius} for radius in (0, np.ones(8))),
    ],
    "torus": [{}],
    3: [{}],
}  # fmt: skip


@pytest.mark.parametrize(
    "value", ["box", {"size": (1, 1, 1)}, *({"shape": kind, **each} for kind in REFUSED for each in REFUSED[kind])]
)  # fmt: skip
def test_invalid_obstacles_are_refused_with_their_index(value):
    with pytest.raises(ValueError, match=r"^obstacle 1: "):
        ve.as_obstacles([ve.Sphere(0.1), value])


def test_shapes_cannot_be_changed():
    with pytest.raises(AttributeError):
        ve.Sphere(0.1).radius = 0.2
    with pytest.raises(ValueError):
        ve.Box((0.1, 0.1, 0.1)).size[0] = 0.2
    assert ve.Cylinder(0.1, 0.2) == ve.Cylinder(radius=0.1, half_length=0.2)
