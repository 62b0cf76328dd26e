"""Bounds and searches that skip distances give the results of all distances."""

import numpy as np
import pytest

from viapoint.envs.arms import PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.broad_phase import HalfLinks, ball_bounds, lift_quadratic
from viapoint.envs.geometry.distance import point_distance_squared, segment_distance_squared
from viapoint.envs.geometry.rows import pair_distance, shape_rows
from viapoint.envs.geometry.shapes import SHAPES
from viapoint.envs.scenes.swept_volume import SweptVolume

N, TIMES, ROWS = 40, 16, 12


def obstacles(generator):
    """Spheres, posts and bars, and rows that are none."""
    rows = np.concatenate(
        (
            generator.uniform((0.2, -0.5, 0.0), (0.8, 0.5, 0.8), (N, ROWS, 3)),
            generator.normal(0.0, 0.1, (N, ROWS, 3)),
            generator.uniform(0.01, 0.05, (N, ROWS, 1)),
        ),
        axis=-1,
    )
    rows[:, ::3, 3:6] = 0.0
    rows[:, 1::3, 3:5] = 0.0
    rows[generator.random((N, ROWS)) < 0.2] = 0.0
    return rows


@pytest.fixture
def generator():
    return np.random.default_rng(3)


@pytest.fixture
def bodies(generator):
    """The links near the hand, on straight movements."""
    low, high = (np.array(corner) for corner in PANDA.workspace)
    start, goal = (low + (high - low) * generator.random((N, 1, 3)) for _ in range(2))
    path = start + (goal - start) * np.linspace(0.0, 1.0, TIMES)[:, None]
    return SweptVolume.of(CollisionModel(PANDA, True), path).outer


def everything(bodies, rows):
    """Clearance of all rows from all links at all times, shape (N, ROWS, TIMES)."""
    single = rows.astype(np.float32)
    each = [
        np.sqrt(segment_distance_squared(*np.moveaxis(bodies.ends[:, :, :, b], 1, -1), single))
        - np.float32(radius)
        for b, radius in enumerate(bodies.radii)
    ]
    return np.where(rows[..., -1:] > 0.0, np.min(each, axis=0) - rows[..., -1:], np.inf)


@pytest.mark.parametrize("away", [0.0, 50.0])
def test_balls_are_bounded_from_below_and_closely(away, generator):
    rows, centres = obstacles(generator), generator.uniform(-1.0, 1.0, (N, 3, 50)) + away
    rows[rows[..., -1] > 0.0, :3] += away
    radii = generator.uniform(0.0, 0.2, 50).astype(np.float32)
    centres = centres.astype(np.float32)
    distance = np.sqrt(point_distance_squared(np.moveaxis(centres, 1, -1).astype(float), rows)) - radii
    clearance = np.where(rows[..., -1:] > 0.0, distance - rows[..., -1:], np.inf)
    bounds = ball_bounds(lift_quadratic(centres), radii, rows)
    assert (bounds <= clearance + 1e-6).all()
    if not away:
        assert (bounds >= clearance - 1e-4)[distance > 0.1].all()


@pytest.mark.parametrize("most", [-0.01, 1e-6, 0.05, np.inf])
def test_least_clearance_is_exact_up_to_the_most_that_matters(generator, bodies, most):
    rows, margin = obstacles(generator), generator.uniform(0.0, 0.02, TIMES)
    plain = np.minimum((everything(bodies, rows) - margin).min(axis=-1), most)
    assert (bodies.clearance(rows, most, margin) == plain).all()
    assert (plain < most).any()


def test_rows_that_belong_together_have_one_clearance(generator, bodies):
    rows = obstacles(generator)
    plain = np.minimum(everything(bodies, rows).reshape(N, ROWS // 4, -1).min(axis=-1), 0.03)
    assert (bodies.clearance(rows, 0.03, together=4) == plain).all()
    floored = bodies.clearance(rows, 0.03, together=4, floor=0.0)
    assert (floored[plain >= 0.0] == plain[plain >= 0.0]).all()
    assert (floored[plain < 0.0] < 0.0).all()
    assert (floored != plain).any()


@pytest.mark.parametrize("kind", ["capsule", "box"])
def test_obstacles_that_are_hit_come_closer_than_the_margin(kind, generator, bodies):
    rows, margin = shapes(kind, generator, (N, ROWS)), generator.uniform(0.0, 0.02, TIMES)
    clearance = bodies.clearance(rows, np.inf, margin)
    for more in np.linspace(0.0, 0.1, 51):
        hits = bodies.hits(rows, margin + more)
        assert (clearance[hits] < more).all()
        assert hits.sum() > 0.5 * (clearance < more).sum() > 0.0


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "sphere", "half_space"])
def test_balls_are_bounded_from_below_by_shapes_and_closely_by_boxes(kind, generator):
    centres = generator.uniform(-1.0, 1.0, (N, 3, 50)).astype(np.float32)
    radii = generator.uniform(0.0, 0.2, 50).astype(np.float32)
    rows = shapes(kind, generator, (N, ROWS))
    rows[generator.random((N, ROWS)) < 0.2] = 0.0
    present = rows[..., -1] > 0.0
    scene, row, ball = (each.ravel() for each in np.indices((N, ROWS, 50)))
    distance = pair_distance(rows[scene, row], centres[scene, :, ball]).reshape(N, ROWS, 50)
    clearance = np.where(present[..., None], distance - radii, np.inf)
    bounds = ball_bounds(lift_quadratic(centres), radii, rows)
    assert (bounds <= clearance + 1e-6)[clearance > -1.0].all()  # no arm is deeper in a half-space
    if kind == "box":
        assert (bounds >= clearance - 1e-4)[present].all()


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule"])
def test_links_in_balls_have_bounds_between_those_of_the_balls_and_their_clearance(kind, generator):
    centres = generator.uniform(-1.0, 1.0, (N, 3, 50)).astype(np.float32)
    half = generator.uniform(-0.2, 0.2, (N, 3, 50)).astype(np.float32)
    radii = generator.uniform(0.0, 0.1, 50).astype(np.float32)
    rows = shapes(kind, generator, (N, ROWS))
    scene, row, ball = (each.ravel() for each in np.indices((N, ROWS, 50)))
    ends = (centres + sign * half for sign in (-1.0, 1.0))
    distance = pair_distance(rows[scene, row], *(end[scene, :, ball] for end in ends))
    clearance = distance.reshape(N, ROWS, 50) - radii
    lifted, around = lift_quadratic(centres), np.sqrt((half * half).sum(axis=1)) + radii
    of_balls = ball_bounds(lifted, around, rows)
    bounds = ball_bounds(lifted, around, rows, HalfLinks(half, radii))
    assert (bounds <= clearance + 1e-6).all()
    assert (bounds >= of_balls - 1e-5).all()
    assert (bounds > of_balls + 0.05).any() == (kind != "capsule")


def shapes(kind, generator, shape):
    """Rows with shapes of one kind, in any pose."""
    half = generator.uniform(0.02, 0.3, (*shape, 3))
    if SHAPES[kind].round:
        half[..., 1] = half[..., 0]
    if kind == "capsule":
        half[..., 2] += half[..., 0]
    if kind == "sphere":
        half[..., 2] = half[..., 0]
    if kind == "half_space":
        half[...] = 1.0
    quaternion = generator.normal(size=(*shape, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return shape_rows(kind, generator.uniform(-0.5, 0.5, (*shape, 3)), quaternion, half)
