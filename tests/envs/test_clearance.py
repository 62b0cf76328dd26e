"""Clearance is the least of all spheres, and is the same however it is computed."""

import dataclasses

import mujoco
import numpy as np
import pytest
from helpers import check_contact_implies_overlap, configuration_clearances, least_pair_distance, random_shape

from viapoint.envs.arms.capsule_fit import cover_geom, hull_of
from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.geometry.clearance import (
    FAR,
    RESOLUTION,
    ROUGHLY,
    bounds_memory,
    memory,
    movement_clearance,
)
from viapoint.envs.geometry.obstacles import KINDS, pack
from viapoint.envs.geometry.shapes import ConvexMesh, as_obstacle


def some_shapes(rng, number):
    """Return moving shapes around the arm."""
    shapes = []
    for kind in rng.choice(KINDS, number):
        shape = random_shape(kind, rng, moving=True)
        shapes.append(as_obstacle({**shape.to_dict(), "position": rng.uniform(-0.7, 0.7, 3)}))
    return shapes


def some_joints(rng, arm, *shape):
    low, high = arm.joint_range.T
    return rng.uniform(low, high, (*shape, len(low)))


@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_is_that_of_the_nearest_sphere(name):
    rng, arm = np.random.default_rng(0), arm_of(name)
    number = 60
    joints = some_joints(rng, arm, number)
    scenes = [some_shapes(rng, 4) for _ in range(number)]
    times = rng.uniform(0.0, 1.0, number)
    found = configuration_clearances(arm, joints, pack(scenes), times)
    link = np.repeat(arm.spheres.link, np.diff(arm.spheres.first))
    for i in range(number):
        centres = sphere_centres(arm.chain, arm.spheres, joints[i])
        moves = link > 0
        distances = [
            shape.distance(centres[moves] - times[i] * shape.velocity, arm.spheres.radius[moves])
            for shape in scenes[i]
        ]
        assert max(found[i, 0], -FAR) == pytest.approx(np.clip(np.min(distances), -FAR, FAR), abs=1e-9)
    own = least_pair_distance(arm, joints).min(axis=-1, initial=FAR)
    np.testing.assert_allclose(found[:, 1], own, atol=1e-9)


@pytest.mark.parametrize("number", [0, 5])
@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_of_a_movement_is_that_of_its_nearest_configuration(name, number):
    """Though most configurations of these winding movements are skipped."""
    rng, arm = np.random.default_rng(1), arm_of(name)
    share = np.linspace(0.0, 1.0, 400)[:, None]
    step, placed = 0.004, memory(arm.chain, arm.spheres)
    bounds = bounds_memory(arm.chain, arm.spheres, False)
    for _ in range(50):
        obstacles = pack([some_shapes(rng, number)]).with_rows(5)
        start, goal, bend = some_joints(rng, arm, 3)
        path = start + share * (goal - start) + 0.3 * np.sin(3.0 * np.pi * share) * (bend - start)
        path = np.clip(path, *arm.joint_range.T)
        found = movement_clearance(
            arm.chain, arm.spheres, arm.reach, path, obstacles, 0, 0.0, step, placed, bounds, 0.0
        )
        scenes = obstacles.take(np.zeros(len(path), int))
        each = configuration_clearances(arm, path, scenes, step * np.arange(len(path)))
        np.testing.assert_allclose(np.maximum(found, -FAR), np.maximum(each.min(axis=0), -FAR), atol=1e-9)


@pytest.mark.parametrize(("name", "number"), [("planar", 9), ("panda", 9), ("panda", 97)])
def test_clearance_between_configurations_is_that_of_many_more(name, number):
    """Of a path with few of them, among obstacles that move."""
    rng, arm = np.random.default_rng(1), arm_of(name)
    placed = memory(arm.chain, arm.spheres)
    all_times, these_times = (bounds_memory(arm.chain, arm.spheres, between) for between in (True, False))
    corners, few, many = (np.linspace(0.0, 1.0, each) for each in (9, number, 4001))
    duration = 0.5
    deeper = 0
    for _ in range(60):
        shapes = [
            dataclasses.replace(each, velocity=rng.uniform(-0.2, 0.2, 3)) for each in some_shapes(rng, 5)
        ]
        turns = some_joints(rng, arm, 9).T
        path = np.stack([np.interp(few, corners, joint) for joint in turns], axis=-1)
        dense = np.stack([np.interp(many, corners, joint) for joint in turns], axis=-1)
        body = arm.chain, arm.spheres, arm.reach
        least = []
        for joints, bounds in ((path, all_times), (dense, these_times), (path, these_times)):
            step = duration / (len(joints) - 1)
            found = movement_clearance(*body, joints, pack([shapes]), 0, 0.0, step, placed, bounds, 0.0)
            least.append(max(min(found), -FAR))
        # Many configurations may miss something, too.
        assert least[1] - 3e-3 <= least[0] <= least[1] + ROUGHLY
        assert least[0] < 0.0 or least[1] > -RESOLUTION
        deeper += least[0] < least[2] - (0.01 if number == 9 else 1e-3)
    assert deeper > 10  # something passes between the configurations


GEOMS = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .2 0 0  0 .1 0  .2 .1 0  0 0 .1  0 .1 .1"/>
    <mesh name="detailed" builtin="sphere" params="4" scale=".05 .08 .2"/></asset>
  <worldbody>
    <geom type="sphere" size=".05" pos=".1 .2 .3"/>
    <geom type="capsule" size=".04 .1" pos="0 .2 .1" euler="10 20 30"/>
    <geom type="box" size=".1 .04 .06" euler="40 10 0"/>
    <geom type="cylinder" size=".06 .15" euler="0 60 10"/>
    <geom type="ellipsoid" size=".04 .06 .12" pos=".3 0 0" euler="0 60 10"/>
    <geom type="mesh" mesh="wedge" pos="1 0 0" euler="0 30 10"/>
    <geom type="cylinder" size=".28 .165" pos="2 0 0"/>
    <geom type="mesh" mesh="detailed"/>
  </worldbody>
</mujoco>"""


def test_contact_of_the_panda_with_itself_implies_that_spheres_overlap():
    check_contact_implies_overlap(arm_of("panda"))


def points_in(model, geom, rng, number=3000):
    """Random points of a geom in its frame, many of them on its surface."""
    size, kind = model.geom_size[geom], mujoco.mjtGeom(int(model.geom_type[geom]))
    ball = rng.normal(size=(number, 3))
    ball *= (rng.random((number, 1)) ** 0.1) / np.linalg.norm(ball, axis=1, keepdims=True)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return size * ball
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        disc = rng.normal(size=(number, 2))
        disc *= np.sqrt(rng.random((number, 1))) / np.linalg.norm(disc, axis=1, keepdims=True)
        return np.concatenate((size[0] * disc, size[1] * rng.uniform(-1, 1, (number, 1))), axis=1)
    corners = hull_of(model, geom)[0]
    weights = rng.dirichlet(np.full(len(corners), 0.2), number)
    return np.concatenate((corners, weights @ corners))


def depth(capsule, points):
    """Signed distance of points from a capsule, [m]."""
    first, second = capsule.ends
    axis = second - first
    share = np.clip((points - first) @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
    return np.linalg.norm(points - first - share[:, None] * axis, axis=1) - capsule.radius


@pytest.mark.parametrize("tolerance", [0.02, 0.2])
@pytest.mark.parametrize("geom", range(2, 8))
def test_capsules_contain_a_geom_and_reach_no_farther_beyond_it_than_the_tolerance(geom, tolerance):
    model, rng = mujoco.MjModel.from_xml_string(GEOMS), np.random.default_rng(2)
    found = cover_geom(model, geom, tolerance)
    points = points_in(model, geom, rng)
    assert np.min([depth(each, points) for each in found], axis=0).max() <= 0.0
    corners, _, larger = hull_of(model, geom)
    body = ConvexMesh.hull(corners)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    for each in found:
        farthest = max(body.distance(end + each.radius * ball).max() for end in each.ends)
        assert each.excess - larger - 1.5e-3 <= farthest <= each.excess - larger <= tolerance - larger


def test_spheres_and_capsules_of_a_file_stay_as_they_are():
    model = mujoco.MjModel.from_xml_string(GEOMS)
    (ball,), (rod,) = (cover_geom(model, geom, 0.025) for geom in (0, 1))
    np.testing.assert_array_equal(ball.ends, np.zeros((2, 3)))
    np.testing.assert_array_equal(rod.ends, [(0.0, 0.0, -0.1), (0.0, 0.0, 0.1)])
    assert (ball.radius, rod.radius, ball.excess, rod.excess) == (0.05, 0.04, 0.0, 0.0)
