"""Signed distances of points and their gradients are those of independent libraries and of differences."""

import subprocess
import sys

import coal
import mujoco
import numpy as np
import pytest
from helpers import random_shape
from scipy.spatial.transform import Rotation

import viapoint.envs as ve
from viapoint.envs.geometry.clearance import point_distance_and_normal
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import KINDS, add_to_model, no_obstacles, pack

ALL = pytest.mark.parametrize("kind", KINDS)
CONVEX = pytest.mark.parametrize("kind", KINDS[:-1])
FAR = 1e3
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def places(rng, number):
    """Points around the origin, half of them close to it."""
    return rng.uniform(-0.5, 0.5, (number, 3)) * np.where(np.arange(number) % 2, 1.0, 0.3)[:, None]


@compiled
def measure(obstacles, points, time, limit, found, normals):
    """Fill in distances and gradients, shapes (N, n, M) and (N, n, M, 3)."""
    for scene in range(found.shape[0]):
        for row in range(found.shape[1]):
            for i in range(len(points)):
                x, y, z = points[i]
                distance, nx, ny, nz = point_distance_and_normal(obstacles, scene, row, x, y, z, time, limit)
                found[scene, row, i] = distance
                normals[scene, row, i] = nx, ny, nz


def measured(obstacles, points, time=0.0, limit=FAR):
    """Distances, shape (N, n, M), and gradients."""
    found = np.empty((*obstacles.kind.shape, len(points)))
    normals = np.empty((*found.shape, 3))
    measure(obstacles, points, time, limit, found, normals)
    return found, normals


@compiled
def raised(value, by=1):
    return value + by


@compiled
def raised_by_constants(value):
    return raised(value) + raised(value, 2) + raised(0, value)


def test_constants_and_defaults_compile_no_function_again():
    assert raised_by_constants(1) == 6
    assert len(raised.overloads) <= 1  # none if the caller came from the cache


def coal_bodies(shape):
    """The shape as geometries and poses of coal."""
    turn, place = shape.rotation, np.array(shape.position)
    pose = coal.Transform3s(turn, place)
    match shape:
        case ve.Sphere():
            return [(coal.Sphere(shape.radius), pose)]
        case ve.Capsule():
            return [(coal.Capsule(shape.radius, 2.0 * shape.half_length), pose)]
        case ve.Cylinder():
            return [(coal.Cylinder(shape.radius, 2.0 * shape.half_length), pose)]
        case ve.Box():
            return [(coal.Box(*(2.0 * shape.size)), pose)]
        case ve.HalfSpace():
            return [(coal.Halfspace(turn[:, 2], float(turn[:, 2] @ place)), coal.Transform3s())]
        case ve.ConvexMesh():
            points = coal.StdVec_Vec3s()
            points.extend(list(shape.vertices))
            return [(coal.Convex.convexHull(points, False, "Qt"), pose)]
        case ve.PointCloud():
            ball = coal.Sphere(shape.radius)
            centres = shape.points @ turn.T + place
            return [(ball, coal.Transform3s(np.eye(3), centre)) for centre in centres]


def coal_distances(shape, points, radius):
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = request.epa_tolerance = 1e-9
    request.gjk_max_iterations = request.epa_max_iterations = 1000
    found = []
    for point in points:
        probe, pose = coal.Sphere(radius), coal.Transform3s(np.eye(3), point)
        each = []
        for body, place in coal_bodies(shape):
            result.clear()
            each.append(coal.distance(body, place, probe, pose, request, result))
        found.append(min(each))
    return np.array(found)


def mujoco_distances(shape, points, radius):
    spec = mujoco.MjSpec()
    (names,) = add_to_model(spec, [shape])
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(radius, 0.0, 0.0))
    model = spec.compile()
    data = mujoco.MjData(model)
    pairs = [(model.geom(name).id, model.geom("probe").id) for name in names]
    found = []
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        found.append(min(mujoco.mj_geomDistance(model, data, *pair, 10.0, None) for pair in pairs))
    return np.array(found)


@ALL
def test_distances_agree_with_coal_and_mujoco(kind, rng):
    touching = 0
    for _ in range(8):
        shape, radius = random_shape(kind, rng), rng.uniform(0.01, 0.1)
        points = np.array(shape.position) + places(rng, 60)
        found = shape.distance(points, radius)
        apart = found > 0.0
        touching += (~apart).sum()
        np.testing.assert_allclose(coal_distances(shape, points[apart], radius), found[apart], atol=1e-6)
        np.testing.assert_allclose(mujoco_distances(shape, points, radius), found, atol=1e-6)
    assert touching > 50


@CONVEX
def test_inside_a_shape_the_surface_is_as_near_as_the_distance_says(kind, rng):
    """No point within the distance is outside, and the foot of the normal is on the surface."""
    shape = random_shape(kind, rng)
    points = np.array(shape.position) + places(rng, 4000)
    distance, normals = (part[0, 0] for part in measured(pack([[shape]]), points))
    inside = distance < 0.0
    assert inside.sum() > 20
    points, distance, normals = points[inside], distance[inside], normals[inside]
    foot = points - distance[:, None] * normals
    np.testing.assert_allclose(shape.distance(foot), 0.0, atol=1e-9)
    for _ in range(50):
        ways = rng.normal(size=points.shape)
        ways *= 0.999 * -distance[:, None] / np.linalg.norm(ways, axis=1)[:, None]
        assert (shape.distance(points + ways) < 0.0).all()


@ALL
def test_normals_are_gradients(kind, rng):
    step = 1e-6
    shapes = [random_shape(kind, rng, moving=True) for _ in range(5)]
    obstacles = pack([shapes[:3], shapes[3:]])
    points, time = places(rng, 500), 0.3
    distance, normals = measured(obstacles, points, time)
    slopes = np.empty_like(normals)
    bent = np.zeros(distance.shape, bool)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, normals_ahead = measured(obstacles, points + shift, time)
        behind, normals_behind = measured(obstacles, points - shift, time)
        slopes[..., axis] = (ahead - behind) / (2.0 * step)
        bent |= np.abs(normals_ahead - normals_behind).max(axis=-1) > 1e-3
    present = np.broadcast_to(obstacles.present[..., None], distance.shape)
    np.testing.assert_allclose(np.linalg.norm(normals[present], axis=-1), 1.0, atol=1e-12)
    smooth = present & ~bent  # on few points, the nearest point of the surface jumps
    assert smooth.sum() > 0.98 * present.sum()
    np.testing.assert_allclose(normals[smooth], slopes[smooth], atol=2e-5)


@ALL
def test_numbers_beyond_the_limit_are_between_it_and_the_distance(kind, rng):
    obstacles = pack([[random_shape(kind, rng) for _ in range(10)]])
    points = places(rng, 300)
    exact, normals = measured(obstacles, points)
    for limit in (-0.05, 0.0, 0.03, 0.2):
        found, near_normals = measured(obstacles, points, limit=limit)
        near = exact <= limit - 1e-12
        np.testing.assert_allclose(found[near], exact[near], atol=1e-15)
        np.testing.assert_allclose(near_normals[near], normals[near], atol=1e-12)
        assert (found[~near] >= np.minimum(exact[~near], limit) - 1e-9).all()
        assert (found[~near] <= exact[~near] + 1e-9).all()


@ALL
def test_distances_move_and_turn_with_the_shape(kind, rng):
    shape, points, velocity = random_shape(kind, rng), places(rng, 200), rng.normal(size=3)
    turn, shift = Rotation.from_rotvec((0.5, -1.0, 2.0)), np.array([0.3, -0.1, 0.2])
    quaternion = (turn * Rotation.from_matrix(shape.rotation)).as_quat(scalar_first=True)
    place = turn.apply(np.array(shape.position)) + shift
    moved = ve.as_obstacle({**shape.to_dict(), "position": place, "quaternion": quaternion})
    there = turn.apply(points) + shift
    np.testing.assert_allclose(moved.distance(there), shape.distance(points), atol=1e-9)
    before, before_normals = measured(pack([[shape]]), points)
    _, normals = measured(pack([[moved]]), there)
    np.testing.assert_allclose(normals[0, 0], turn.apply(before_normals[0, 0]), atol=1e-6)
    flying = ve.as_obstacle({**shape.to_dict(), "velocity": velocity})
    after, after_normals = measured(pack([[flying]]), points + 0.7 * velocity, 0.7)
    np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(after_normals, before_normals, atol=1e-6)


@ALL
def test_lists_batches_and_radii(kind, rng):
    shapes, points = [random_shape(kind, rng) for _ in range(3)], places(rng, 60)
    radius = rng.uniform(0.0, 0.1, (5, 1))
    every = ve.signed_distances([shapes[0], *(each.to_dict() for each in shapes[1:])], points)
    for i, shape in enumerate(shapes):
        np.testing.assert_array_equal(every[:, i], shape.distance(points))
    np.testing.assert_allclose(every.T, measured(pack([shapes]), points)[0][0], atol=1e-15)
    found = ve.signed_distances(shapes, points.reshape(5, 12, 3), radius)
    np.testing.assert_allclose(found, every.reshape(5, 12, 3) - radius[..., None], atol=1e-15)
    assert np.shape(shapes[0].distance(points[0])) == ()
    assert shapes[0].distance(points[:0]).shape == (0,)
    assert ve.signed_distances([], points).shape == (60, 0)
    assert (measured(no_obstacles(1, 2), points)[0] > FAR).all()


@pytest.mark.parametrize("number", [1, 2, 15, 16, 17, 33, 100, 3000])
@pytest.mark.parametrize("flat", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_the_nearest_point_of_a_cloud_is_that_of_all_points(number, flat, rng):
    points = rng.normal(size=(number, 3)) * flat
    points[: number // 3] = points[-1]  # several are the same
    cloud = ve.PointCloud(points, 0.02)
    asked = np.concatenate(
        (2.0 * rng.normal(size=(300, 3)), points[:50] + 1e-3 * rng.normal(size=(len(points[:50]), 3)))
    )
    brute = np.linalg.norm(asked[:, None] - points, axis=-1).min(axis=1) - 0.02
    np.testing.assert_allclose(cloud.distance(asked), brute, atol=1e-12)
    np.testing.assert_allclose(cloud.distance(points), -0.02, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("parts", [1, 2, 5])
def test_a_mesh_of_a_subdivided_box_is_the_box(parts, dtype, rng):
    """Corners in lines give triangles of no area, and rounding tilts the others."""
    half, axis = np.array([0.05, 0.05, 0.08]), np.linspace(-1.0, 1.0, parts + 1)
    box = ve.Box(half, position=(0.1, -0.2, 0.1), quaternion=ve.HalfSpace.facing((1.0, 2.0, 3.0)).quaternion)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)

    def placed(points):
        return (points * half @ box.rotation.T + box.position).astype(dtype)

    surface = placed(grid[np.abs(grid).max(axis=1) == 1.0])
    mesh = ve.ConvexMesh(surface)
    points = np.concatenate((places(rng, 500), placed(rng.uniform(-1.1, 1.1, (500, 3)))))
    atol = 1e-7 if dtype is np.float32 else 1e-9
    np.testing.assert_allclose(mesh.distance(points), box.distance(points), atol=atol)
    with pytest.raises(ValueError, match="hull"):
        ve.ConvexMesh(np.concatenate((surface, placed(np.array([(0.99, 0.1, -0.3)])))))


@CONVEX
def test_gradients_are_unit_vectors_on_planes_axes_and_corners(kind):
    """Where formulas divide by zero."""
    values = {"convex_mesh": {"vertices": 0.1 * CORNERS}, "box": {"size": (0.1, 0.1, 0.1)}}
    sizes = {"radius": 0.1, "half_length": 0.1} if kind in ("capsule", "cylinder") else {"radius": 0.1}
    shape = {"shape": kind, **values.get(kind, {} if kind == "half_space" else sizes)}
    points = 0.1 * np.array(np.meshgrid(*3 * [np.arange(-2, 3)], indexing="ij")).reshape(3, -1).T
    distance, normals = measured(pack([[shape]]), points)
    assert np.isfinite(distance).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-12)


CALLED = """
from typing import NamedTuple
from viapoint.envs.geometry.compiled import kernel

class Length(NamedTuple):
    metres: float

@kernel
def scaled(length):
    return {factor} * length.metres
"""
CALLER = """
from {module} import Length, scaled
from viapoint.envs.geometry.compiled import compiled

@compiled
def result(length):
    return scaled(length)
"""
USE = "from caller import Length, result; print(result(Length(1.5)))"


def test_machine_code_of_an_earlier_version_is_not_used(tmp_path):
    """Functions that are called may have changed, and records may have moved to another module."""

    def printed(module, factor):
        (tmp_path / f"{module}.py").write_text(CALLED.format(factor=factor))
        done = subprocess.run([sys.executable, "-c", USE], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    (tmp_path / "caller.py").write_text(CALLER.format(module="before"))
    assert printed("before", 2.0) == 3.0
    assert printed("before", 4.0) == 6.0
    (tmp_path / "before.py").unlink()
    (tmp_path / "caller.py").write_text(CALLER.format(module="after"))
    assert printed("after", 2.0) == 3.0
