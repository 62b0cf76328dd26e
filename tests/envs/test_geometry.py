"""Signed distances of all shapes are those of independent libraries, and records refuse what is not allowed."""

import json
import sys
import tracemalloc
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
from viapoint.training import GeometrySearch

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from geometry import agreement, random_shape

ALL = pytest.mark.parametrize("kind", SHAPES)
CLOSED = [kind for kind, shape in SHAPES.items() if shape.in_scenes and shape.sizes]
"""Shapes whose parameters may be a batch of sizes."""
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) / 10


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
    values = {name: np.full(last, 0.1) for name, last in SHAPES[kind].sizes.items()}
    for name in {"vertices", "points"} & set(SHAPES[kind].parameters()):
        values[name] = 2.0 * CUBE - 0.1
    shape = SHAPES[kind](**values)
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
    turn, shift = Rotation.from_rotvec((0.5, -1.0, 2.0)), np.array([0.3, -0.1, 0.2])
    quaternion = (turn * Rotation.from_matrix(shape.rotation)).as_quat(scalar_first=True)
    place = turn.as_matrix() @ shape.position + shift
    moved = as_obstacle({**shape.to_dict(), "position": place, "quaternion": quaternion})
    there = [turn.apply(end) + shift for end in segments]
    np.testing.assert_allclose(moved.distance(there[0]), shape.distance(first), atol=1e-7)
    np.testing.assert_allclose(
        moved.segment_distance(*there), shape.segment_distance(first, second), atol=1e-7
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
    single = first.astype(np.float32)
    np.testing.assert_array_equal(shape.distance(single), shape.distance(single.astype(float)))
    np.testing.assert_array_equal(shape.distance(first.tolist()), shape.distance(first))


def test_a_sphere_is_observed_as_a_capsule_where_spheres_have_no_name():
    ball, capsule = Sphere(0.1), {"shape": "capsule", "radius": 0.1, "half_length": 1e-12}
    np.testing.assert_allclose(*(observation_rows([each], 1, ("capsule", "box")) for each in (ball, capsule)))


@ALL
def test_descriptions_contain_the_shape(kind, generator):
    shape = random_shape(kind, generator)
    centre, radius = shape.bounding_sphere
    places = centre + min(radius, 0.5) * generator.uniform(-1.0, 1.0, (4000, 3))
    inside = places[shape.distance(places) < 0.0]
    assert len(inside) > 40
    assert (np.linalg.norm(inside - centre, axis=-1) <= radius).all()
    covered = np.zeros(len(inside), dtype=bool)
    for outline in shape.footprint():
        edge, apart = np.roll(outline, -1, axis=0) - outline, inside[:, None, :2] - outline
        side = edge[:, 0] * apart[..., 1] - edge[:, 1] * apart[..., 0]
        covered |= (side >= -2e-4).all(axis=1)
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
    assert named != shape
    assert obstacles_from_json(obstacles_to_json([shape.to_dict(), named])) == [shape, named]
    assert json.loads(obstacles_to_json([shape]))[0]["shape"] == kind


def test_the_nearest_of_many_obstacles_is_the_least_of_all_distances(generator, segments, monkeypatch):
    obstacles = [random_shape(kind, generator) for kind in SHAPES for _ in range(4) if kind != "half_space"]
    obstacles.append(HalfSpace(position=(0.0, 0.0, -0.4)))
    radius = generator.uniform(0.0, 0.05, segments.shape[1])
    for ends in (segments[:1], segments):
        least = signed_distances(obstacles, *ends, radius=radius).min(axis=-1)
        for most in (np.inf, 0.05):
            found = nearest_distance(obstacles, *ends, radius=radius, most=most)
            np.testing.assert_allclose(found, np.minimum(least, most), atol=1e-12)
    np.testing.assert_array_equal(nearest_distance([], segments[0], most=1.0), 1.0)
    assert signed_distances([], segments[0]).shape == (200, 0)
    assert nearest_distance(obstacles, np.zeros((0, 3))).shape == (0,)
    asked = []
    measure = Sphere.distance
    monkeypatch.setattr(Sphere, "distance", lambda own, at, r: asked.append(len(at)) or measure(own, at, r))
    balls = [Sphere(0.05, position=place) for place in segments[1, :20]]
    nearest_distance(balls, segments[0])
    assert sum(asked) < 0.3 * len(balls) * len(segments[0])  # most are skipped


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("parts", [1, 2, 5, 7])
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
        assert (len(mesh.polytope.offsets), len(mesh.polytope.edges)) == (6, 12)
    for inside in (0.9 * axis[:1], np.array([0.99, 0.1, -0.3])):
        with pytest.raises(ValueError):
            ConvexMesh(np.concatenate((surface, placed(inside * np.ones((1, 3))))))


@pytest.mark.parametrize("flat", [1.0, 0.05])
def test_a_hull_is_closed_and_convex_and_its_faces_look_outwards(flat, generator):
    for number in (4, 8, 40, 300):
        points = generator.normal(size=(number, 3)) * (1.0, 1.0, flat)
        mesh = ConvexMesh.hull(points)
        body = mesh.polytope
        assert (points @ body.normals.T <= body.offsets + 1e-9).all()
        assert (mesh.vertices.mean(axis=0) @ body.normals.T < body.offsets).all()
        np.testing.assert_allclose(np.linalg.norm(body.normals, axis=1), 1.0, atol=1e-12)
        assert len(mesh.vertices) - len(body.edges) + len(body.offsets) == 2  # Euler's formula
        assert ConvexMesh.hull(mesh.vertices) == ConvexMesh.hull(points)
        assert (mesh.distance(points) <= 1e-9).all()
        np.testing.assert_allclose(mesh.distance(mesh.vertices), 0.0, atol=1e-9)


def test_the_memory_of_a_mesh_grows_with_its_faces(generator):
    points = generator.normal(size=(1500, 3))
    tracemalloc.start()
    mesh = ConvexMesh(points / np.linalg.norm(points, axis=1)[:, None])
    assert len(mesh.polytope.offsets) > 2980
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


def test_a_capsule_between_two_points_has_them_as_ends():
    bar = Capsule.between((0.1, 0.2, 0.3), (0.4, 0.1, 0.2), 0.02)
    np.testing.assert_allclose(bar.position + bar.half_axis, (0.4, 0.1, 0.2), atol=1e-12)
    np.testing.assert_allclose(bar.position - bar.half_axis, (0.1, 0.2, 0.3), atol=1e-12)
    assert Capsule.between((0.1, 0.2), (0.3, 0.2), 0.02).position.tolist() == pytest.approx([0.2, 0.2, 0.0])


def test_a_quaternion_is_normalised_if_it_is_nearly_a_unit():
    turned = Sphere(0.1, quaternion=(0.9995, 0.0, 0.0, 0.0))
    assert turned.quaternion.tolist() == [1.0, 0.0, 0.0, 0.0]


def test_a_half_space_faces_normals_of_any_length():
    np.testing.assert_allclose(
        HalfSpace.facing((1e-30, 0.0, 0.0)).rotation[:, 2], (1.0, 0.0, 0.0), atol=1e-12
    )


def test_functions_of_lists_take_dictionaries(segments):
    shapes = [Sphere(0.1), HalfSpace(name="floor")]
    values = [each.to_dict() for each in shapes]
    for distance in (signed_distances, nearest_distance):
        np.testing.assert_array_equal(distance(values, *segments), distance(shapes, *segments))
    assert add_to_model(mujoco.MjSpec(), values) == [["obstacle_0_0"], ["floor_0"]]
    batch = Sphere(np.array([0.1, 0.2]))
    assert signed_distances([batch, shapes[0]], segments[0, 0]).shape == (2, 2)


DENTED = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.1, 0.1, 0.1)])


REFUSED = {
    "sphere": [{"radius": radius} for radius in (0.0, np.nan, -0.1, "a")],
    "capsule": [{"radius": 0.1, "half_length": 0.1, "name": 3}, {"radius": 0.1}],
    "cylinder": [{"radius": np.ones(4), "half_length": 1.0, "position": np.zeros((3, 3))}],
    "box": [{}, {"size": (0.1, -0.1, 0.1)}, {"size": (0.1, 0.1)}, {"size": (1, 1, 1), "centre": 0}],
    "half_space": [
        *({"position": position} for position in ((0, 0), (0, 0, np.inf))),
        *({"quaternion": quaternion} for quaternion in ((1, 1, 0, 0), (0, 0, 0, 0))),
    ],
    "convex_mesh": [
        {"vertices": vertices}
        for vertices in (CUBE[:3], CUBE[:4], np.zeros((5, 3)), CUBE * np.nan, CUBE * 1e200, DENTED)
    ],
    "point_cloud": [
        *({"points": points} for points in ([(0, 0, 0), (0, np.nan, 0)], np.zeros((0, 3)))),
        *({"points": CUBE, "radius": radius} for radius in (0, np.ones(8))),
    ],
    "torus": [{}],
    3: [{}],
}


@pytest.mark.parametrize(
    "value", ["box", {"size": (1, 1, 1)}, *({"shape": kind, **each} for kind in REFUSED for each in REFUSED[kind])]
)  # fmt: skip
def test_invalid_obstacles_are_refused_with_their_index(value):
    with pytest.raises(ValueError, match=r"^obstacle 1: "):
        as_obstacles([Sphere(0.1), value])


POINT, BALL, BALLS = np.ones(3), Sphere(0.1), Sphere(np.ones(2))


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        *((HalfSpace.facing, (normal,)) for normal in ((0, 0, 0), (0, np.nan, 1), (0, 1))),
        *((Capsule.between, ((0, 1), end, 0.1)) for end in (np.zeros((2, 3)), (0, 1), (0, np.inf))),
        *((ConvexMesh.hull, (points,)) for points in (CUBE[:4], CUBE[:3])),
        *((PointCloud.covering, (CUBE, *numbers)) for numbers in ((-1.0,), (0.0,), (0.2, -0.1))),
        *((method, ()) for method in (BALLS.box, BALLS.footprint, BALLS.geoms)),
        (add_to_model, (mujoco.MjSpec(), [BALLS])),
        (add_to_model, (mujoco.MjSpec(), [Sphere(0.1, name="obstacle_1"), BALL])),
        *((signed_distances, (each, POINT)) for each in (BALL, None, [{"shape": "boxx"}])),
        *((nearest_distance, (each, POINT)) for each in (BALL, [BALLS])),
        *(
            (nearest_distance, ([BALL], *ends))
            for ends in ((None,), (POINT * np.nan,), (POINT, POINT * np.inf))
        ),
        (nearest_distance, ([BALL], POINT, None, 0.0, np.nan)),
        (nearest_distance, ([BALL], np.ones((4, 3)), None, np.ones(3))),
        (Cylinder(0.1, 0.2).segment_distance, (np.ones((4, 3)), np.ones((5, 3)))),
        (Box((0.1, 0.1, 0.1)).distance, (np.ones((2, 3)), np.ones(3))),
        *((obstacles_from_json, (text,)) for text in ("[", "{}", "[" * 100_000)),
        *((observation_rows, given) for given in (([BALL, BALL], 1), ([], 1.5))),
    ],
)
def test_invalid_arguments_are_refused(function, arguments):
    with pytest.raises(ValueError):
        function(*arguments)


@pytest.mark.parametrize(
    ("points", "radius"),
    [
        *((points, 0.0) for points in (0.1, (0.1,), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4), np.zeros((3, 4)))),
        *((POINT, radius) for radius in (np.nan, -0.1, True, "a", None, 1j, [0.1, np.inf])),
    ],
)
@ALL
def test_points_have_three_coordinates_and_a_radius_of_0_or_more(kind, points, radius, generator):
    shape = random_shape(kind, generator)
    for function, arguments in (
        (shape.distance, (points, radius)),
        (shape.segment_distance, (POINT, points, radius)),
        (signed_distances, ([shape], POINT, points, radius)),
        (nearest_distance, ([shape], points, None, radius)),
    ):
        with pytest.raises(ValueError):
            function(*arguments)


BARS = [Capsule.between((-0.1, 0.35), (0.0, 0.38), 0.02), Sphere(0.03, position=(0.1, 0.5, 0.0))]
ENDS = {"start": (-0.3, 0.3), "goal": (0.2, 0.35)}


def test_reset_and_plans_take_shapes_dictionaries_and_rows_alike():
    env, rows = gym.make("viapoint/PlanarObstacles-v0").unwrapped, obstacle_rows(BARS, 2)
    search, plans = GeometrySearch("viapoint/PlanarObstacles-v0", 32), []
    for obstacles in (BARS, [each.to_dict() for each in BARS], rows.tolist()):
        env.reset(seed=0, options={**ENDS, "obstacles": obstacles})
        np.testing.assert_array_equal(env.batch.scenes.obstacles[0, :2], rows)
        plans.append(search.plan(**ENDS, obstacles=obstacles).waypoints)
        np.testing.assert_array_equal(plans[0], plans[-1])
    np.testing.assert_allclose(obstacle_rows(obstacles_from_rows(rows), 2), rows, atol=1e-12)
    env.reset(seed=1, options={"obstacles": BARS})  # start and goal are drawn clear of them
    env.close()


@pytest.mark.parametrize("kind", CLOSED)
def test_sizes_pose_and_points_may_each_have_axes_of_a_batch(kind, generator):
    """The distance of each item is that of the single shape from the single segment."""
    for _ in range(40):
        axes = [generator.choice([1, 3], generator.integers(3)).tolist() for _ in range(4)]
        values = {
            name: generator.uniform(0.02, 0.6, (*axes[0], *last)) for name, last in SHAPES[kind].sizes.items()
        }
        values["position"] = generator.normal(size=(*axes[1], 3)) * 0.3
        turns = generator.normal(size=(*axes[1], 4))
        values["quaternion"] = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
        first, second = (generator.normal(size=(*each, 3)) for each in axes[2:])
        batch, common = SHAPES[kind](**values), np.broadcast_shapes(*axes)
        assert batch.segment_distance(first, second).shape == common
        found = np.broadcast_to(batch.distance(first), common), batch.segment_distance(first, second)

        def item(name, array, index, common=common):
            last = {**SHAPES[kind].sizes, "quaternion": (4,)}.get(name, (3,))
            return np.broadcast_to(array, (*common, *last))[index]

        for i in np.ndindex(common):
            alone = SHAPES[kind](**{name: item(name, value, i) for name, value in values.items()})
            a, b = item("first", first, i), item("second", second, i)
            assert found[0][i] == pytest.approx(alone.distance(a), abs=1e-12)
            assert found[1][i] == pytest.approx(alone.segment_distance(a, b), abs=1e-9)


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
