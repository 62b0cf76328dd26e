"""Signed distances of all shapes are those of independent libraries, and records say what is not allowed."""

import json
import re
import sys
import tracemalloc
import warnings
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch

from viapoint.envs import (
    SHAPES,
    Box,
    Capsule,
    ConvexMesh,
    Cylinder,
    HalfSpace,
    PointCloud,
    Shape,
    Sphere,
    add_to_model,
    as_obstacle,
    as_obstacles,
    nearest_distance,
    observation_rows,
    obstacle_rows,
    obstacles_from_json,
    obstacles_from_rows,
    obstacles_to_json,
    signed_distances,
)
from viapoint.envs.geometry import shapes
from viapoint.training import GeometrySearch

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from geometry import Probes, agreement, random_shape

ALL = pytest.mark.parametrize("kind", SHAPES)
CLOSED = [kind for kind, shape in SHAPES.items() if shape.in_scenes and shape.sizes]
"""Shapes whose parameters may be a batch of sizes."""
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) / 10
POSE = {"position": (0.1, -0.2, 0.3), "quaternion": (0.5, -0.5, 0.1, 0.7)}


def searched(kind):
    """True for a shape whose distances of segments come from the search of Shape."""
    shape = SHAPES[kind]
    return (shape._nearest, shape.segment_distance) == (Shape._nearest, Shape.segment_distance)


@pytest.fixture
def generator():
    return np.random.default_rng(8)


@pytest.fixture
def segments(generator):
    """Ends of segments that pass by shapes, touch them, and lie inside, shape (200, 3)."""
    return generator.uniform(-0.5, 0.5, (2, 200, 3)) * np.where(np.arange(200) % 2, 1.0, 0.3)[:, None]


@ALL
@pytest.mark.parametrize("long", [False, True])
def test_distances_and_contacts_agree_with_coal_and_mujoco(kind, long):
    found = agreement(kind, 500, 1, long=long)
    assert max(found.coal, found.mujoco) < 1e-6
    assert found.depth < (1e-4 if searched(kind) else 1e-6)
    assert 100 < found.contacts < 400
    assert found.wrong == 0


@ALL
def test_a_segment_is_as_near_as_its_nearest_point(kind, generator, segments):
    shape, (first, second) = random_shape(kind, generator), segments
    share = np.linspace(0.0, 1.0, 1001)[:, None, None]
    brute = shape.distance(first + share * (second - first)).min(axis=0)
    found = shape.segment_distance(first, second)
    assert (found <= brute + 1e-9).all()
    np.testing.assert_allclose(found, brute, atol=1e-3)
    assert (found < -0.01).any()
    assert (found > 0.1).any()
    np.testing.assert_allclose(shape.segment_distance(first, first), shape.distance(first), atol=1e-9)
    np.testing.assert_allclose(shape.segment_distance(second, first), found, atol=1e-9)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if kind != "point_cloud"])
def test_the_search_that_a_new_shape_inherits_finds_the_same(kind, generator, segments):
    shape, (first, second) = random_shape(kind, generator), segments
    start, end = shape._relative(first), shape._relative(second)
    t = Shape._nearest(shape, start, [b - a for a, b in zip(start, end, strict=True)])
    searched = shape.distance(first + t[:, None] * (second - first))
    np.testing.assert_allclose(searched, shape.segment_distance(first, second), atol=1e-8)


@ALL
def test_capsules_along_faces_edges_and_axes(kind):
    """Where formulas divide by zero: segments that are parallel to, perpendicular to, or on something."""
    shape = as_obstacle(
        {
            "shape": kind,
            **{name: np.full(shape, 0.1) for name, shape in SHAPES[kind].sizes.items()},
            **{
                name: 2.0 * CUBE - 0.1 for name in ("vertices", "points") if name in SHAPES[kind].parameters()
            },
        }
    )
    places = 0.1 * np.array(np.meshgrid(*3 * [np.arange(-2, 3)], indexing="ij")).reshape(3, -1).T
    first, second = np.repeat(places, len(places), axis=0), np.tile(places, (len(places), 1))
    found = shape.segment_distance(first, second)
    share = np.linspace(0.0, 1.0, 61)[:, None, None]
    brute = shape.distance(first + share * (second - first)).min(axis=0)
    assert np.isfinite(found).all()
    assert (found <= brute + 1e-9).all()
    assert (found >= brute - 0.006).all()


@ALL
def test_distances_move_with_the_shape(kind, generator, segments):
    shape, (first, second) = random_shape(kind, generator), segments
    turn, shift = HalfSpace(**POSE).rotation, np.array([0.3, -0.1, 0.2])
    matrix = turn @ shape.rotation
    w = 0.5 * np.sqrt(max(1.0 + np.trace(matrix), 1e-9))
    x, y, z = (
        np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
        / 4
        / w
    )
    values = {**shape.to_dict(), "position": turn @ shape.position + shift, "quaternion": (w, x, y, z)}
    moved = as_obstacle(values)
    for distance, ends in (("distance", [first]), ("segment_distance", [first, second])):
        there = [end @ turn.T + shift for end in ends]
        np.testing.assert_allclose(
            getattr(moved, distance)(*there), getattr(shape, distance)(*ends), atol=1e-7
        )


@ALL
def test_radii_shrink_distances_and_leading_axes_broadcast(kind, generator, segments):
    shape, (first, second) = random_shape(kind, generator), segments
    radius = generator.uniform(0.0, 0.1, (5, 1))
    np.testing.assert_allclose(shape.distance(first, radius), shape.distance(first) - radius, atol=1e-15)
    found = shape.segment_distance(first.reshape(4, 50, 3), second[:50], 0.02)
    for i in range(4):
        alone = shape.segment_distance(first[50 * i : 50 * (i + 1)], second[:50]) - 0.02
        np.testing.assert_allclose(found[i], alone, atol=1e-12)
    assert np.shape(shape.segment_distance(first[0], second[0])) == ()
    assert shape.distance(first[:0]).shape == shape.segment_distance(first[:0], second[:0]).shape == (0,)


@pytest.mark.parametrize("kind", CLOSED)
def test_a_batch_of_shapes_is_those_shapes(kind, generator, segments):
    each = [random_shape(kind, generator) for _ in range(6)]
    batch = SHAPES[kind](
        **{
            name: np.stack([getattr(s, name) for s in each])
            for name in each[0].parameters()
            if name != "name"
        }
    )
    first, second = (end[:30, None] for end in segments)
    np.testing.assert_allclose(batch.distance(first), signed_distances(each, first[:, 0]), atol=1e-14)
    np.testing.assert_allclose(
        batch.segment_distance(first, second), signed_distances(each, first[:, 0], second[:, 0]), atol=1e-12
    )
    centre, radius = batch.bounding_sphere
    assert centre.shape == (6, 3)
    assert radius.shape == (6,)


@ALL
def test_torch_and_single_precision_give_the_same(kind, generator, segments):
    shape, (first, second) = random_shape(kind, generator), segments
    exact = shape.distance(first), shape.segment_distance(first, second)
    tensors = [torch.as_tensor(end) for end in segments]
    for mine, theirs in zip(
        exact, (shape.distance(tensors[0]), shape.segment_distance(*tensors)), strict=True
    ):
        assert theirs.dtype == torch.float64
        np.testing.assert_allclose(theirs.numpy(), mine, atol=1e-12)
    single = [end.astype(np.float32) for end in segments]
    for mine, theirs in zip(exact, (shape.distance(single[0]), shape.segment_distance(*single)), strict=True):
        assert theirs.dtype == np.float32
        np.testing.assert_allclose(theirs, mine, atol=2e-6)
    assert shape.distance(tensors[0].float()).dtype == torch.float32


def test_cylinders_in_single_precision_are_right_to_a_tenth_of_a_millimetre(generator):
    for radius, half_length in ((0.2, 0.2), (0.05, 0.3)):
        shape, ends = Cylinder(radius, half_length), generator.uniform(-1.0, 1.0, (2, 100_000, 3))
        single = shape.segment_distance(*ends.astype(np.float32))
        np.testing.assert_allclose(single, shape.segment_distance(*ends), atol=1e-4)


@ALL
def test_gradients_are_those_of_finite_differences(kind, generator, segments):
    shape, step = random_shape(kind, generator), 1e-6
    points, ends = segments[0][:60], np.concatenate(segments[:, :60])
    for distance, places in (
        (shape.distance, points),
        (lambda ends: shape.segment_distance(ends[:60], ends[60:]), ends),
    ):
        tensor = torch.as_tensor(places).requires_grad_()
        distance(tensor).sum().backward()
        shifted = [step * np.eye(3)[i] for i in range(3)]
        for i, shift in enumerate(shifted):
            each = np.zeros_like(places)
            for half in np.split(np.arange(len(places)), len(places) // 60):
                there = np.zeros_like(places)
                there[half] = shift
                each[half, i] = (distance(places + there) - distance(places - there)) / (2.0 * step)
            error = np.abs(each[:, i] - tensor.grad.numpy()[:, i])
            assert (error < (1e-4 if searched(kind) else 1e-5)).mean() > 0.97  # not at kinks
    wall = torch.as_tensor(np.asarray(shape.position) + 0.0 * points).requires_grad_()
    shape.distance(wall).sum().backward()
    assert torch.isfinite(wall.grad).all()


@ALL
def test_gradients_in_single_precision_are_those_in_double(kind, generator, segments):
    shape, found = random_shape(kind, generator), []
    for dtype in (torch.float32, torch.float64):
        ends = torch.as_tensor(segments).to(torch.float32).to(dtype).requires_grad_()
        shape.segment_distance(*ends).sum().backward()
        assert ends.grad.dtype == dtype
        found.append(ends.grad.double().numpy())
    np.testing.assert_allclose(found[0], found[1], atol=5e-4 if searched(kind) else 1e-5)


def test_points_that_are_no_numbers_are_refused():
    for ends in (([np.nan, 0.0, 0.0],), ([0.0, 0.0, 0.0], [0.0, np.inf, 0.0])):
        with pytest.raises(ValueError, match=rf"{('first', 'second')[len(ends) - 1]} must be finite"):
            nearest_distance([Sphere(0.1)], *ends)


@pytest.mark.parametrize("distance", [signed_distances, nearest_distance])
def test_a_single_shape_is_no_list(distance):
    with pytest.raises(ValueError, match="put a single obstacle in a list"):
        distance(Sphere(0.1), [0.0, 0.0, 0.0])


def test_a_sphere_is_observed_as_a_capsule_where_spheres_have_no_name():
    ball, capsule = Sphere(0.1), {"shape": "capsule", "radius": 0.1, "half_length": 1e-12}
    np.testing.assert_allclose(*(observation_rows([each], 1, ("capsule", "box")) for each in (ball, capsule)))


@pytest.mark.parametrize("kind", CLOSED)
def test_gradients_reach_sizes_and_poses(kind, generator, segments):
    shape, step = random_shape(kind, generator), 1e-6
    values = {n: getattr(shape, n) for n in shape.parameters() if n not in ("name", "quaternion")}
    tensors = {n: torch.tensor(v, dtype=torch.float64, requires_grad=True) for n, v in values.items()}
    pose = {"quaternion": shape.quaternion}
    ends = [torch.as_tensor(end) for end in segments]
    SHAPES[kind](**tensors, **pose).segment_distance(*ends).sum().backward()
    for name, tensor in tensors.items():
        for index in np.ndindex(tensor.shape):
            changed = []
            for sign in (1.0, -1.0):
                other = np.array(values[name], dtype=float)
                other[index] += sign * step
                changed.append(
                    SHAPES[kind](**{**values, name: other}, **pose).segment_distance(*segments).sum()
                )
            slope = (changed[0] - changed[1]) / (2.0 * step)
            assert tensor.grad.numpy()[index] == pytest.approx(slope, abs=1e-3)


@ALL
def test_descriptions_contain_the_shape(kind, generator):
    shape = random_shape(kind, generator)
    centre, radius = shape.bounding_sphere
    places = centre + min(radius, 0.5) * generator.uniform(-1.0, 1.0, (4000, 3))
    inside = places[shape.distance(places) < 0.0]
    assert len(inside) > 40
    assert (np.linalg.norm(inside - centre, axis=-1) <= radius).all()
    outlines = shape.footprint()
    covered = np.zeros(len(inside), dtype=bool)
    for outline in outlines:
        following = np.roll(outline, -1, axis=0)
        side = np.cross(
            np.append(following - outline, np.zeros((len(outline), 1)), axis=1)[:, None],
            np.append(inside[:, :2] - outline[:, None], np.zeros((len(outline), len(inside), 1)), axis=-1),
        )[..., 2]
        covered |= (side >= -2e-4).all(axis=0)
    assert kind == "half_space" or covered.all()
    middle, half = shape.box()
    if kind != "half_space":
        assert (np.abs((inside - middle) @ shape.rotation) <= half + 1e-9).all()
    (row, absent) = observation_rows([shape], 2)
    assert list(SHAPES)[row[: len(SHAPES)].argmax()] == kind
    assert row[: len(SHAPES)].sum() == row[-1] == 1.0
    np.testing.assert_allclose(row[-4:-1], half, rtol=1e-6)
    np.testing.assert_allclose(row[-13:-10], middle, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(row[-10:-4].reshape(2, 3), shape.rotation[:, :2].T, atol=1e-6)
    assert not absent.any()


def test_a_wall_seen_from_above_covers_its_side():
    (outline,) = HalfSpace.facing((1.0, 0.0, 0.0), position=(0.5, 0.0, 0.0)).footprint(extent=1.0)
    assert sorted(map(tuple, outline)) == [(-1.0, -1.0), (-1.0, 1.0), (0.5, -1.0), (0.5, 1.0)]
    assert HalfSpace(position=(0.0, 0.0, -1.0)).footprint() == []


@ALL
def test_json_keeps_obstacles_as_they_are(kind, generator):
    every = [random_shape(kind, generator).to_dict() for _ in range(30)]
    every = as_obstacles({**each, "quaternion": 1.0005 * np.array(each["quaternion"])} for each in every)
    assert obstacles_from_json(obstacles_to_json(every)) == every
    shape = every[0]
    named = as_obstacle({**shape.to_dict(), "name": "it"})
    assert named.name == "it"
    assert named != shape
    assert obstacles_from_json(obstacles_to_json([shape, named])) == [shape, named]
    assert obstacles_from_json(obstacles_to_json([shape.to_dict()])) == [shape]
    assert json.loads(obstacles_to_json([shape]))[0]["shape"] == kind


def test_the_nearest_of_many_obstacles_is_the_least_of_all_distances(generator, segments, monkeypatch):
    obstacles = [random_shape(kind, generator) for kind in SHAPES for _ in range(4) if kind != "half_space"]
    obstacles.append(HalfSpace(position=(0.0, 0.0, -0.4)))
    first, second = segments
    radius = generator.uniform(0.0, 0.05, len(first))
    asked = []
    original = shapes.signed_distances

    def counted(which, points, *others):
        asked.append(len(points))
        return original(which, points, *others)

    monkeypatch.setattr(shapes, "signed_distances", counted)
    for ends in ((first,), (first, second)):
        least = original(obstacles, *ends, radius=radius[:, None][:, 0]).min(axis=-1)
        for most in (np.inf, 0.05):
            found = nearest_distance(obstacles, *ends, radius=radius, most=most)
            np.testing.assert_allclose(found, np.minimum(least, most), atol=1e-12)
    assert sum(asked) < 0.6 * 4 * len(first) * len(obstacles)
    np.testing.assert_array_equal(nearest_distance([], first, most=1.0), 1.0)
    assert signed_distances([], first).shape == (200, 0)


def test_a_mesh_of_a_box_is_the_box(generator, segments):
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (0.1, 0.2, 0.05)
    box, mesh = Box((0.1, 0.2, 0.05), **POSE_UNIT), ConvexMesh(corners, **POSE_UNIT)
    assert len(mesh.polytope.offsets) == 6
    assert len(mesh.polytope.edges) == 12
    np.testing.assert_allclose(mesh.distance(segments[0]), box.distance(segments[0]), atol=1e-9)
    np.testing.assert_allclose(mesh.segment_distance(*segments), box.segment_distance(*segments), atol=1e-9)


POSE_UNIT = {**POSE, "quaternion": np.array(POSE["quaternion"]) / np.linalg.norm(POSE["quaternion"])}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("parts", [2, 5, 7])
def test_a_mesh_of_a_subdivided_box_is_the_box(parts, dtype, generator, segments):
    """Corners in lines give triangles of no area, and rounding tilts the others."""
    half, axis = np.array([0.05, 0.05, 0.08]), np.linspace(-1.0, 1.0, parts + 1)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    box = Box(half, position=(0.6, 0.3, 0.5), quaternion=HalfSpace.facing((1.0, 2.0, 3.0)).quaternion)

    def placed(points):
        return (points * half @ box.rotation.T + box.position).astype(dtype)

    surface = placed(grid[np.abs(grid).max(axis=1) == 1.0])
    mesh, atol = ConvexMesh(surface), 1e-7 if dtype is np.float32 else 1e-9
    ends = segments + box.position
    near = placed(generator.uniform(-1.1, 1.1, (500, 3))).astype(float)
    for points in (*ends, near):
        np.testing.assert_allclose(mesh.distance(points), box.distance(points), atol=atol)
    np.testing.assert_allclose(mesh.segment_distance(*ends), box.segment_distance(*ends), atol=atol)
    if dtype is np.float64:
        assert len(mesh.polytope.offsets) == 6
    for inside in (0.9 * axis[:1], np.array([0.99, 0.1, -0.3])):
        with pytest.raises(ValueError, match="not those of a convex mesh"):
            ConvexMesh(np.concatenate((surface, placed(inside * np.ones((1, 3))))))


def test_the_memory_of_a_mesh_grows_with_its_faces(generator):
    points = generator.normal(size=(1500, 3))
    tracemalloc.start()
    mesh = ConvexMesh(points / np.linalg.norm(points, axis=1)[:, None])
    assert (len(mesh.polytope.offsets), len(mesh.polytope.edges)) == (2996, 4494)
    assert tracemalloc.get_traced_memory()[1] < 3e7  # a table of all pairs of faces has 2e8 bytes
    tracemalloc.stop()


@ALL
def test_the_arrays_of_a_shape_are_its_own(kind, generator):
    given = random_shape(kind, generator)
    values = {n: np.array(v) for n in given.parameters() if hasattr(v := getattr(given, n), "shape")}
    shape = SHAPES[kind](**values)
    for name, value in values.items():
        value[...] = 9.0
        assert not getattr(shape, name).flags.writeable
    assert shape == given
    tensor = torch.zeros(3, dtype=torch.float64)
    assert HalfSpace(position=tensor).position is tensor
    torch.set_warn_always(True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # torch warns of tensors that share read-only arrays
        shape.distance(tensor)
    torch.set_warn_always(False)


def test_a_capsule_between_two_points_has_them_as_ends():
    bar = Capsule.between((0.1, 0.2, 0.3), (0.4, 0.1, 0.2), 0.02)
    np.testing.assert_allclose(bar.position + bar.half_axis, (0.4, 0.1, 0.2), atol=1e-12)
    np.testing.assert_allclose(bar.position - bar.half_axis, (0.1, 0.2, 0.3), atol=1e-12)
    assert Capsule.between((0.1, 0.2), (0.3, 0.2), 0.02).position.tolist() == pytest.approx([0.2, 0.2, 0.0])


def test_a_quaternion_is_normalised_if_it_is_nearly_a_unit():
    turned = Sphere(0.1, quaternion=(0.9995, 0.0, 0.0, 0.0))
    assert turned.quaternion.tolist() == [1.0, 0.0, 0.0, 0.0]


DENTED = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.1, 0.1, 0.1)])
STAR = ((0, 1, 2), (0, 1, 4), (1, 2, 4), (0, 2, 4))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (
            {"shape": "boks", "size": (1, 1, 1)},
            "unknown shape 'boks', did you mean 'box'? Shapes are sphere,",
        ),
        ({"shape": "torus"}, "unknown shape 'torus'. Shapes are sphere, capsule, cylinder, box"),
        ({"shape": 3}, "unknown shape 3. Shapes are"),
        ({"size": (1, 1, 1)}, "the key 'shape' is missing. Shapes are"),
        ("box", "must be a shape of viapoint.envs or a dictionary, got 'box'"),
        ({"shape": "box"}, "box: missing size"),
        ({"shape": "cylinder", "radius": 0.1}, "cylinder: missing half_length"),
        (
            {"shape": "box", "size": (1, 1, 1), "centre": 0},
            "box: unknown parameter 'centre'. Parameters are size,",
        ),
        ({"shape": "sphere", "radius": 0.0}, "sphere: radius must be greater than 0, got 0.0"),
        ({"shape": "sphere", "radius": -0.1, "name": "ball"}, "sphere 'ball': radius must be greater than 0"),
        (
            {"shape": "box", "size": (0.1, -0.1, 0.1)},
            "box: size must be greater than 0, got (0.1, -0.1, 0.1)",
        ),
        ({"shape": "box", "size": (0.1, 0.1)}, "box: size must have shape (..., 3), got shape (2,)"),
        (
            {"shape": "capsule", "radius": "a", "half_length": 1},
            "capsule: radius must be an array of real numbers",
        ),
        ({"shape": "sphere", "radius": np.nan}, "sphere: radius must be finite, got nan"),
        ({"shape": "half_space", "position": (0, 0)}, "half_space: position must have shape (..., 3)"),
        ({"shape": "half_space", "position": (0, 0, np.inf)}, "half_space: position must be finite, got inf"),
        (
            {"shape": "half_space", "quaternion": (1, 1, 0, 0)},
            "quaternion must have length 1 (within 0.001), got",
        ),
        ({"shape": "half_space", "quaternion": (0, 0, 0, 0)}, "got length 0"),
        (
            {"shape": "convex_mesh", "vertices": CUBE[:3]},
            "vertices must have shape (V, 3) with V at least 4, got",
        ),
        ({"shape": "convex_mesh", "vertices": CUBE[:4]}, "vertices must span a volume, they lie in a plane"),
        ({"shape": "convex_mesh", "vertices": np.zeros((5, 3))}, "vertices must span a volume"),
        ({"shape": "convex_mesh", "vertices": CUBE * np.nan}, "vertices must be finite"),
        (
            {"shape": "convex_mesh", "vertices": DENTED},
            "not those of a convex mesh: vertex 4 lies 0.1 m inside their hull; ConvexMesh.hull(vertices) is",
        ),
        (
            {
                "shape": "convex_mesh",
                "vertices": DENTED[:4],
                "faces": ((0, 1, 2), (0, 1, 3), (1, 2, 9), (0, 2, 3)),
            },
            "faces must be indices of the 4 vertices, got 9",
        ),
        (
            {
                "shape": "convex_mesh",
                "vertices": DENTED[:4],
                "faces": ((0, 1, 2), (0, 1, 3), (1, 2, 0), (0, 2, 3)),
            },
            "faces are not those of a convex mesh",
        ),
        (
            {"shape": "point_cloud", "points": [(0, 0, 0), (0, np.nan, 0)]},
            "points must be finite, got [0.0, nan,",
        ),
        (
            {"shape": "point_cloud", "points": np.zeros((0, 3))},
            "points must have shape (K, 3) with K at least 1",
        ),
        ({"shape": "point_cloud", "points": CUBE, "radius": 0}, "point_cloud: radius must be greater than 0"),
        (
            {"shape": "point_cloud", "points": CUBE, "radius": np.ones(8)},
            "radius must be one number for all points",
        ),
        (
            {"shape": "sphere", "radius": np.ones(4), "position": np.zeros((3, 3))},
            "leading dimensions do not broadcast: radius (4,), position (3,)",
        ),
    ],
)
def test_what_is_no_obstacle_is_refused_with_its_index_and_what_is_allowed(value, reason):
    with pytest.raises(ValueError, match=r"^obstacle 1: ") as caught:
        as_obstacles([Sphere(0.1), value])
    assert reason in str(caught.value)


FOLLOWED = torch.zeros(4, 3, requires_grad=True)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: HalfSpace.facing((0, 0, 0), name="it"), "normal must be finite and not zero"),
        (lambda: HalfSpace.facing((0, np.nan, 1), name="it"), "normal must be finite and not zero"),
        (lambda: HalfSpace.facing((0, 1), name="it"), "normal must have shape (3,), got shape (2,)"),
        (
            lambda: Capsule.between((0, 1), np.zeros((2, 3)), 0.1, "it"),
            "ends must have shape (3,) or (2,), got",
        ),
        (lambda: Capsule.between((0, 1), (0, 1), 0.1, "it"), "a capsule without a length is a Sphere"),
        (lambda: Capsule.between((0, 1), (0, np.inf), 0.1, "it"), "ends must be finite and different"),
        (lambda: ConvexMesh.hull(CUBE[:4], name="it"), "vertices must span a volume"),
        (lambda: ConvexMesh.hull(CUBE[:3], name="it"), "vertices must have shape (V, 3)"),
        (lambda: ConvexMesh(1e200 * CUBE, name="it"), "vertices must have a hull with finite planes"),
        (lambda: ConvexMesh(FOLLOWED, name="it"), "must not require a gradient, use vertices.detach()"),
        (lambda: ConvexMesh.hull(FOLLOWED, name="it"), "vertices must not require a gradient"),
        (lambda: PointCloud(FOLLOWED, name="it"), "points must not require a gradient, use points.detach()"),
        (lambda: PointCloud.covering(CUBE, -1.0, name="it"), "spacing must be greater than 0, got -1.0"),
        (
            lambda: nearest_distance([Sphere(np.ones(4), name="it")], np.zeros(3)),
            "must be one shape here, got a batch",
        ),
        (lambda: Box((1, 1, 1), position=np.zeros((3, 3)), name="it").box(), "position has shape (3, 3)"),
        (lambda: Sphere(np.ones(2), name="it").footprint(), "radius has shape (2,)"),
        (lambda: add_to_model(mujoco.MjSpec(), [Sphere(np.ones(2), name="it")]), "radius has shape (2,)"),
    ],
)
def test_errors_of_all_constructors_have_the_name_of_the_obstacle(make, reason):
    with pytest.raises(ValueError, match=r"^(obstacle 0: )?\w+ 'it': ") as caught:
        make()
    assert reason in str(caught.value)


def test_a_half_space_faces_normals_of_any_length():
    np.testing.assert_allclose(
        HalfSpace.facing((1e-30, 0.0, 0.0)).rotation[:, 2], (1.0, 0.0, 0.0), atol=1e-12
    )


@pytest.mark.parametrize(
    "points", [0.1, (0.1,), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4), np.zeros((3, 4)), torch.zeros(2)]
)
@ALL
def test_points_have_three_coordinates(kind, points, generator):
    shape = random_shape(kind, generator)
    for distance in (
        shape.distance,
        lambda at: shape.segment_distance((0.0, 0.0, 0.0), at),
        lambda at: nearest_distance([shape], at),
        lambda at: signed_distances([shape], (0.0, 0.0, 0.0), at),
    ):
        with pytest.raises(ValueError, match=r"points must have shape \(\.\.\., 3\), got shape"):
            distance(points)


def test_functions_of_lists_take_dictionaries(segments):
    shapes = [Sphere(0.1), HalfSpace(name="floor")]
    values, (first, second) = [each.to_dict() for each in shapes], segments
    for distance in (signed_distances, nearest_distance):
        np.testing.assert_array_equal(distance(values, first, second), distance(shapes, first, second))
    assert add_to_model(mujoco.MjSpec(), values) == [["obstacle_0_0"], ["floor_0"]]
    with pytest.raises(ValueError, match="obstacle 1: box: missing size"):
        nearest_distance([shapes[0], {"shape": "box"}], first)


def test_obstacles_of_one_name_are_refused_before_the_model_changes():
    spec = mujoco.MjSpec()
    with pytest.raises(ValueError, match="obstacle 1: obstacle 0 has the name 'obstacle_1', too"):
        add_to_model(spec, [Sphere(0.1, name="obstacle_1"), Sphere(0.1)])
    assert not spec.geoms


def test_the_nearest_of_tensors_is_a_tensor_with_its_gradient(generator, segments):
    obstacles = [random_shape(kind, generator) for kind in SHAPES]
    first, second = (torch.as_tensor(end).requires_grad_() for end in segments)
    for most in (np.inf, 0.05):
        found = nearest_distance(obstacles, first, second, 0.01, most)
        wanted = nearest_distance(obstacles, *segments, 0.01, most)
        np.testing.assert_allclose(found.detach(), wanted, atol=1e-12)
    found.sum().backward()
    moved = (first.grad + second.grad).numpy()
    np.testing.assert_array_equal(moved.any(axis=1), wanted < 0.05)
    radius = torch.tensor(0.1, requires_grad=True)
    nearest_distance([Sphere(0.1), Sphere(radius, position=(1.0, 0.0, 0.0))], [1.5, 0.0, 0.0]).backward()
    assert radius.grad == -1.0
    assert nearest_distance([], first, most=1.0).tolist() == 200 * [1.0]


def test_text_that_is_no_list_of_obstacles_is_refused():
    for text, reason in (("[", "must be JSON"), ("{}", "must be a JSON list of dictionaries, got dict")):
        with pytest.raises(ValueError, match=reason):
            obstacles_from_json(text)
    with pytest.raises(ValueError, match="at most 1 obstacles, got 2"):
        observation_rows([Sphere(0.1), Sphere(0.1)], 1)


def test_a_mesh_with_the_faces_of_its_hull_is_convex():
    faces = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
    assert ConvexMesh(DENTED[:4], faces) == ConvexMesh(DENTED[:4])
    assert len(ConvexMesh.hull(DENTED).vertices) == 4


def test_probes_are_near_contact(generator):
    shape = Cylinder(0.1, 0.1)
    probes = Probes.around(shape, 100, generator, long=True)
    assert (np.abs(probes.clearance(shape)) < 0.006).mean() > 0.3
    assert PointCloud([(0.0, 0.0, 0.0)]).radius == 0.01


BARS = [Capsule.between((-0.1, 0.35), (0.0, 0.38), 0.02), Sphere(0.03, position=(0.1, 0.5, 0.0))]
ENDS = {"start": (-0.3, 0.3), "goal": (0.2, 0.35)}


def test_reset_takes_shapes_and_dictionaries_as_obstacles():
    env = gym.make("viapoint/PlanarObstacles-v0").unwrapped
    rows = obstacle_rows(BARS, 2)
    wanted, _ = env.reset(seed=0, options={**ENDS, "obstacles": rows})
    for obstacles in (BARS, tuple(each.to_dict() for each in BARS)):
        observation, _ = env.reset(seed=0, options={**ENDS, "obstacles": obstacles})
        np.testing.assert_array_equal(observation["obstacles"], wanted["obstacles"])
    assert [each.kind for each in obstacles_from_rows(env.batch.scenes.obstacles[0])] == ["capsule", "sphere"]
    again = obstacle_rows(obstacles_from_rows(env.batch.scenes.obstacles[0]), 2)
    np.testing.assert_allclose(again, rows, atol=1e-12)
    several, _ = env.reset(seed=1, options={"obstacles": BARS})  # start and goal are drawn clear of them
    assert several["obstacles"][-7] == 0.0
    env.close()


def test_a_batch_takes_a_list_of_obstacles_for_each_scene():
    envs = gym.make_vec("viapoint/PandaObstacles-v0", num_envs=3).unwrapped
    ball = Sphere(0.04, position=(0.5, 0.1, 0.4))
    envs.reset(
        seed=0, options={"obstacles": [[ball], [], [ball, Capsule(0.02, 0.1, position=(0.6, -0.2, 0.3))]]}
    )
    assert envs.scenes.present.sum(axis=1).tolist() == [1, 0, 2]
    envs.reset(seed=0, options={"obstacles": [ball]})
    assert envs.scenes.present.sum(axis=1).tolist() == [1, 1, 1]
    with pytest.raises(
        ValueError,
        match=r"options\['obstacles'\]: scene 1: obstacle 0: the scenes of this environment have the shapes",
    ):
        envs.reset(options={"obstacles": [[], [Cylinder(0.1, 0.1)], []]})
    envs.close()


def test_plans_avoid_shapes_as_they_avoid_rows():
    search = GeometrySearch("viapoint/PlanarObstacles-v0", 32)
    plans = [search.plan(**ENDS, obstacles=each) for each in (BARS, obstacle_rows(BARS, 2).tolist())]
    np.testing.assert_array_equal(plans[0].waypoints, plans[1].waypoints)


@pytest.mark.parametrize(
    ("obstacle", "reason"),
    [
        (
            Box((0.1, 0.1, 0.1)),
            "obstacle 1: the scenes of this environment have the shapes capsule, sphere, not box; make it with "
            "shapes=('capsule', 'box')",
        ),
        (Sphere(0.02, position=(0.1, 0.4, 0.1)), "obstacle 1: sphere must lie in the plane, with z = 0"),
        (Capsule(0.02, 0.1, position=(0.1, 0.4, 0.0)), "obstacle 1: capsule must lie in the plane"),
        (
            Sphere(np.full(3, 0.02), position=np.zeros((3, 3))),
            "obstacle 1: sphere: must be one shape here, got a batch",
        ),
        ({"shape": "sphere", "radius": 0}, "obstacle 1: sphere: radius must be greater than 0, got 0"),
        ({"shape": "sphere", "radius": 0.5, "position": (0.1, 0.4, 0.0)}, "has a radius over 0.1 m"),
        ({"shape": "sphere", "radius": 0.1, "position": (-0.3, 0.3, 0.0)}, "touches the arm at the start"),
    ],
)
def test_obstacles_that_environments_lack_are_refused_with_their_index(obstacle, reason):
    env = gym.make("viapoint/PlanarObstacles-v0")
    with pytest.raises(ValueError, match=re.escape(reason)):
        env.reset(seed=0, options={**ENDS, "obstacles": [BARS[0], obstacle]})
    env.close()


@pytest.mark.parametrize("library", [np.asarray, torch.asarray])
@pytest.mark.parametrize("kind", CLOSED)
def test_sizes_pose_and_points_may_each_have_axes_of_a_batch(kind, library, generator):
    """The distance of each item is that of the single shape from the single segment."""
    for _ in range(40):
        axes = [
            tuple(3 if generator.random() < 0.5 else 1 for _ in range(2))[generator.integers(3) :]
            for _ in range(4)
        ]
        sizes, poses, *points = axes
        size = {
            name: generator.uniform(0.02, 0.6, (*sizes, *last)) for name, last in SHAPES[kind].sizes.items()
        }
        position = generator.normal(size=(*poses, 3)) * 0.3
        first, second = (generator.normal(size=(*each, 3)) for each in points)
        found = SHAPES[kind](**size, position=position).segment_distance(library(first), library(second))
        shape = np.broadcast_shapes(*axes)
        assert found.shape == shape
        for i in np.ndindex(shape):
            one = {
                name: np.broadcast_to(size[name], (*shape, *last))[i]
                for name, last in SHAPES[kind].sizes.items()
            }
            alone = SHAPES[kind](**one, position=np.broadcast_to(position, (*shape, 3))[i])
            ends = (np.broadcast_to(each, (*shape, 3))[i] for each in (first, second))
            assert found[i].item() == pytest.approx(alone.segment_distance(*ends).item(), abs=1e-9)


def test_cylinders_are_as_near_to_parallel_and_tangent_segments_as_to_their_nearest_points(generator):
    number, share = 20_000, np.linspace(0.0, 1.0, 401)
    radius, half = generator.uniform(0.02, 0.5, (2, number)).round(2)
    turn = generator.uniform(-np.pi, np.pi, number)
    outward = np.stack((np.cos(turn), np.sin(turn), 0.0 * turn), axis=-1)
    tangent = np.stack((-np.sin(turn), np.cos(turn), 0.0 * turn), axis=-1)
    beside = outward * (radius * generator.choice([0.5, 1.0, 1.0 + 1e-9, 1.1], number))[:, None]
    along = np.where(generator.random((number, 1)) < 0.5, (0.0, 0.0, 1.0), tangent)
    along += 1e-3 * generator.normal(size=(number, 1)) * outward * (generator.random((number, 1)) < 0.3)
    level = np.where(generator.random(number) < 0.5, half, 0.3 * half)[:, None] * (0.0, 0.0, 1.0)
    before, behind = generator.uniform(-2.0, 2.0, (2, number, 1)).round(1)
    first, second = (beside + level + each * along for each in (before, behind))
    quaternion = generator.normal(size=(number, 4)).round(1)
    quaternion[:, 0] += 1e-3
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    cylinder = Cylinder(radius, half, quaternion=quaternion)
    axes = cylinder.rotation
    first, second = ((axes @ each[..., None])[..., 0] for each in (first, second))
    found = cylinder.segment_distance(first, second)
    sampled = np.full(number, np.inf)
    for t in share:
        sampled = np.minimum(sampled, cylinder.distance(first + t * (second - first)))
    assert (found - sampled).max() < 1e-9
    np.testing.assert_allclose(cylinder.segment_distance(second, first), found, atol=1e-9)


@pytest.mark.parametrize("radius", [np.nan, -0.1, True, "a", None, 1j, [0.1, np.inf]])
def test_a_radius_of_points_is_0_or_greater(radius):
    ball, point = Sphere(0.1), np.ones((2, 3))
    calls = (
        lambda: ball.distance(point, radius),
        lambda: ball.segment_distance(point, point, radius),
        lambda: Capsule(0.1, 0.1).segment_distance(point, point, radius),
        lambda: signed_distances([ball], point, radius=radius),
        lambda: nearest_distance([ball], point, radius=radius),
    )
    for call in calls:
        with pytest.raises(ValueError, match="radius"):
            call()


def test_what_does_not_fit_together_is_named():
    with pytest.raises(ValueError, match="most must be a number, got nan"):
        nearest_distance([Sphere(0.1)], np.ones(3), most=np.nan)
    with pytest.raises(
        ValueError, match=r"cylinder: leading dimensions do not broadcast: first \(4,\), second \(5,\)"
    ):
        Cylinder(0.1, 0.2).segment_distance(np.ones((4, 3)), np.ones((5, 3)))
    with pytest.raises(ValueError, match=r"radius of the points \(3,\)"):
        Box((0.1, 0.1, 0.1)).distance(np.ones((2, 3)), np.ones(3))
    with pytest.raises(ValueError, match="first must be an array of real numbers, got None"):
        nearest_distance([Sphere(0.1)], None)
    with pytest.raises(ValueError, match="obstacles must be JSON"):
        obstacles_from_json("[" * 100_000)
    with pytest.raises(ValueError, match="got -1"):
        ConvexMesh(CUBE, faces=[[0, 1, -1]])
    with pytest.raises(ValueError, match="faces must be triangles"):
        ConvexMesh(CUBE, faces=[[0, 1, 2], [0, 1]])
    with pytest.raises(ValueError, match=r"radius must be 0 or greater, got -0\.1"):
        PointCloud.covering(CUBE, spacing=0.2, radius=-0.1)
    with pytest.raises(ValueError, match="n_rows must be a whole number"):
        observation_rows([], 1.5)
    with pytest.raises(ValueError, match=r"must broadcast, got the shapes \(4, 3\), \(3,\)"):
        nearest_distance([Sphere(0.1)], np.ones((4, 3)), radius=np.ones(3))
    with pytest.raises(ValueError, match="obstacle 1: sphere: must be one shape here, got a batch"):
        nearest_distance([Sphere(0.1), Sphere(np.ones(2))], np.ones((4, 3)))
    with pytest.raises(ValueError, match=r"obstacles must be a list .*, got None"):
        signed_distances(None, np.ones(3))
    with pytest.raises(ValueError, match="obstacle 0: 'crate': unknown shape 'boxx', did you mean 'box'"):
        signed_distances([{"shape": "boxx", "name": "crate"}], np.ones(3))


@pytest.mark.parametrize("segments", [False, True])
@pytest.mark.parametrize("kind", CLOSED)
def test_a_batch_of_quaternions_is_a_batch_of_shapes(kind, segments):
    sizes = {name: np.full(last, 0.1) for name, last in SHAPES[kind].sizes.items()}
    shape = SHAPES[kind](**sizes, quaternion=np.eye(4))
    ends = [np.array((1.0, 0.2, 0.3)), np.array((0.5, 0.2, 0.3))][: 1 + segments]
    found = shape.segment_distance(*ends) if segments else shape.distance(*ends)
    assert found.shape == (4,)


def test_lists_may_mix_libraries_and_batches():
    points = np.ones((2, 3))
    tensor, array = Sphere(0.1, position=torch.zeros(3, requires_grad=True)), Sphere(0.1)
    for both in ([tensor, array], [array, tensor]):
        found = signed_distances(both, points)
        np.testing.assert_allclose(found.detach().numpy(), 3.0**0.5 - 0.1, rtol=1e-6)
    batch = Sphere(np.array([0.1, 0.2]))
    assert signed_distances([batch, array], points[0]).shape == (2, 2)
    assert nearest_distance([array], np.zeros((0, 3))).shape == (0,)
    rows = obstacle_rows(
        [Sphere(torch.tensor(0.03, requires_grad=True), position=(0.5, 0.0, 0.1))], dimension=3
    )
    assert rows[0, -1] == pytest.approx(0.03)
