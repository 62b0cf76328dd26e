"""Capsules contain the geoms that they cover, and contact in MuJoCo implies that spheres overlap."""

import mujoco
import numpy as np
import pytest
from helpers import check_contact_implies_overlap

from viapoint.envs.arms.capsule_fit import cover_geom, polytope_around
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.arms.spheres import grouped
from viapoint.envs.geometry.shapes import ConvexMesh

GEOMS = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .2 0 0  0 .1 0  .2 .1 0  0 0 .1  0 .1 .1"/></asset>
  <worldbody>
    <geom type="sphere" size=".05" pos=".1 .2 .3"/>
    <geom type="capsule" size=".04 .1" pos="0 .2 .1" euler="10 20 30"/>
    <geom type="box" size=".1 .04 .06" euler="40 10 0"/>
    <geom type="cylinder" size=".06 .15" euler="0 60 10"/>
    <geom type="ellipsoid" size=".04 .06 .12" pos=".3 0 0" euler="0 60 10"/>
    <geom type="mesh" mesh="wedge" pos="1 0 0" euler="0 30 10"/>
    <geom type="cylinder" size=".28 .165" pos="2 0 0"/>
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
    corners, _ = polytope_around(model, geom)
    weights = rng.dirichlet(np.full(len(corners), 0.2), number)
    return np.concatenate((corners, weights @ corners))


def depth(capsule, points):
    """Signed distance of points from a capsule, [m]."""
    first, second = capsule.ends
    axis = second - first
    share = np.clip((points - first) @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
    return np.linalg.norm(points - first - share[:, None] * axis, axis=1) - capsule.radius


@pytest.mark.parametrize("tolerance", [0.02, 0.2])
@pytest.mark.parametrize("geom", range(2, 7))
def test_capsules_contain_a_geom_and_reach_no_farther_beyond_it_than_the_tolerance(geom, tolerance):
    model, rng = mujoco.MjModel.from_xml_string(GEOMS), np.random.default_rng(2)
    found = cover_geom(model, geom, tolerance)
    points = points_in(model, geom, rng)
    assert np.min([depth(each, points) for each in found], axis=0).max() <= 0.0
    corners, larger = polytope_around(model, geom)
    body = ConvexMesh.hull(corners)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    for each in found:
        farthest = max(body.distance(end + each.radius * ball).max() for end in each.ends)
        assert each.excess - larger - 1.5e-3 <= farthest <= each.excess - larger <= tolerance - larger


def test_bounding_balls_are_hardly_larger_than_the_smallest_ones():
    corners = np.array(list(np.ndindex(2, 2, 2))) * (0.2, 0.4, 0.4) + 1.0
    spheres = grouped([corners], [np.full(8, 0.05)], [1], [])
    np.testing.assert_allclose(spheres.ball_centre[0], (1.1, 1.2, 1.2), atol=1e-3)
    assert 0.35 <= spheres.ball_radius[0] < 0.351


def test_spheres_and_capsules_of_a_file_stay_as_they_are():
    model = mujoco.MjModel.from_xml_string(GEOMS)
    (ball,), (rod,) = (cover_geom(model, geom, 0.025) for geom in (0, 1))
    np.testing.assert_array_equal(ball.ends, np.zeros((2, 3)))
    np.testing.assert_array_equal(rod.ends, [(0.0, 0.0, -0.1), (0.0, 0.0, 0.1)])
    assert (ball.radius, rod.radius, ball.excess, rod.excess) == (0.05, 0.04, 0.0, 0.0)
