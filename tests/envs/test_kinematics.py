"""Kinematics, dynamics, inverse kinematics and control agree with MuJoCo and with one another."""

import re

import mujoco
import numpy as np
import pytest
from helpers import UR5E

from viapoint.envs.arms.arm import arm_from_xml
from viapoint.envs.arms.inverse_kinematics import (
    in_planar_reach,
    inverse_kinematics,
    planar_joints,
    planar_limits,
    planar_motion,
    solve_planar,
)
from viapoint.envs.arms.kinematics import forward, link_poses, sphere_centres, tool_jacobian, torques
from viapoint.envs.arms.load import load_arm
from viapoint.envs.arms.registry import arm_of

GANTRY = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" gravity="1 2 -9.81"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
    <body name="mast" pos="0.1 0.2 0.3" quat="0.96 0.2 0.15 0.1">
      <joint name="turn" axis="0 0.6 0.8" range="-2 2" damping="0.3" armature="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0.1 0.4" size="0.05" mass="2"/>
      <body name="sledge" pos="0 0.3 0.1" quat="0.7 0.7 0.1 0">
        <joint name="slide" type="slide" axis="1 0 0" range="-0.3 0.4" armature="1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.04" mass="1.5"/>
        <body name="fork" pos="0.3 0 0" quat="0.7 0 0.7 0.1">
          <joint name="swing" pos="0.02 0 0.01" axis="0 1 0" range="-1 2" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0.1 0.2 0.1" size="0.03" mass="1"/>
          <body name="tip" pos="0.1 0.2 0.1" quat="0.8 0.1 0.2 0.5">
            <geom type="sphere" size="0.03" mass="0.4"/>
            <site name="tool" pos="0.01 0.02 0.03" quat="0.9 0 0.1 0.4"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def gantry():
    joints = ("turn", "slide", "swing")
    limits = {"velocity_limit": (1.0, 0.5, 1.0), "torque_limit": (300.0, 300.0, 100.0)}
    return arm_from_xml("gantry", GANTRY, joints=joints, tool="tool", home=(0.1, 0.1, 0.3), **limits)


@pytest.fixture(params=["planar", "panda", "gantry"])
def arm(request, gantry):
    return gantry if request.param == "gantry" else arm_of(request.param)


def states(arm, number=50):
    rng = np.random.default_rng(0)
    low, high = arm.joint_range.T
    return rng.uniform(low, high, (number, len(low))), *rng.normal(size=(2, number, len(low)))


def test_places_jacobians_and_torques_are_those_of_mujoco(arm):
    model = arm.compile(0)
    data = mujoco.MjData(model)
    site = model.nsite - 1
    position, velocity, acceleration = states(arm)
    places, axes = forward(arm.chain, position)
    rotation, origin = link_poses(arm.chain, position)
    needed = torques(arm.chain, position, velocity, acceleration)
    jacobian, found = np.empty((2, 6, len(arm.joint_names)))
    anchors = [model.joint(name).id for name in arm.joint_names]
    for i in range(len(position)):
        data.qpos[:], data.qvel[:], data.qacc[:] = position[i], velocity[i], acceleration[i]
        mujoco.mj_inverse(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        np.testing.assert_allclose(places[i], data.site_xpos[site], atol=1e-9)
        np.testing.assert_allclose(axes[i], data.site_xmat[site].reshape(3, 3), atol=1e-9)
        np.testing.assert_allclose(rotation[i, 1:, :, 2], data.xaxis[anchors], atol=1e-9)
        slides = arm.chain.sliding
        np.testing.assert_allclose(origin[i, 1:][~slides], data.xanchor[anchors][~slides], atol=1e-9)
        tool_jacobian(arm.chain, rotation[i], origin[i], places[i], found)
        np.testing.assert_allclose(found, jacobian, atol=1e-9)
        contact = data.qfrc_constraint  # of joints at their limits
        np.testing.assert_allclose(needed[i], data.qfrc_inverse + contact, atol=1e-9 * 1e2)


def test_inverse_kinematics_finds_what_forward_kinematics_gives(arm):
    position, _, _ = states(arm, 20)
    places, axes = forward(arm.chain, position)
    for place in places:
        for joints in inverse_kinematics(arm, place, n_seeds=16)[:3]:
            np.testing.assert_allclose(arm.hand(joints), place, atol=2e-6)
            assert (joints >= arm.joint_range[:, 0]).all()
            assert (joints <= arm.joint_range[:, 1]).all()
    if len(arm.joint_names) < 6:
        return
    for place, frame in zip(places, axes, strict=True):
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, frame.ravel())
        joints = inverse_kinematics(arm, place, quaternion)[0]
        np.testing.assert_allclose(forward(arm.chain, joints)[1], frame, atol=1e-4)


def test_inverse_kinematics_makes_no_needless_turns():
    """Each hinge is less than half a turn from the seed, where that is in range; no two solutions differ by turns."""
    arm = load_arm(UR5E)
    low, high = arm.joint_range.T
    for seed in np.random.default_rng(1).uniform(-3.0, 3.0, (5, 6)):
        found = inverse_kinematics(arm, (0.4, 0.3, 0.4), (0.0, 1.0, 0.0, 0.0), seed=seed)
        assert len(found) > 2
        for joints in found:
            nearer = joints - 2.0 * np.pi * np.sign(joints - seed)
            assert ((np.abs(joints - seed) <= np.pi + 1e-6) | (nearer < low) | (nearer > high)).all()
        turned = np.sin(0.5 * (found[:, None] - found))
        assert (np.abs(turned).max(axis=-1) + np.eye(len(found)) > 1e-4).all()


def test_a_pose_out_of_reach_is_an_error_with_the_nearest_distance():
    arm, place = arm_of("panda"), (0.1, 1.8, 0.5)
    with pytest.raises(ValueError, match=r"nearest place found is [0-9.]+ mm") as error:
        inverse_kinematics(arm, place)
    told = 1e-3 * float(re.search(r"is ([0-9.]+) mm", str(error.value))[1])
    sampled = arm.hand(np.random.default_rng(0).uniform(*arm.joint_range.T, (20_000, 7)))
    least = np.linalg.norm(sampled - place, axis=-1).min()
    assert least - 0.2 < told < least + 1e-3


def test_the_closed_form_moves_the_hand_as_it_should():
    arm = arm_of("planar")
    position, _, _ = states(arm, 200)
    hand = arm.hand(position)
    np.testing.assert_allclose(hand[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(planar_joints(arm, hand[:, :2]), position, atol=1e-9)
    rng = np.random.default_rng(1)
    velocity, acceleration = rng.normal(size=(2, 200, 2))
    joints, rates, changes = planar_motion(arm.chain, arm.joint_range, hand[:, :2], velocity, acceleration)
    step = 1e-5
    ahead = planar_joints(arm, hand[:, :2] + step * velocity + 0.5 * step**2 * acceleration)
    behind = planar_joints(arm, hand[:, :2] - step * velocity + 0.5 * step**2 * acceleration)
    sound = np.abs(np.sin(position[:, 1])) > 0.2
    np.testing.assert_allclose(rates[sound], (ahead - behind)[sound] / (2 * step), rtol=1e-5, atol=1e-5)
    second = (ahead - 2 * joints + behind) / step**2
    np.testing.assert_allclose(changes[sound], second[sound], rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("limits", [None, [[-0.5, 0.9], [-2.0, -0.3]], [[-3.0, 3.0], [0.2, 3.1]]])
def test_reach_in_the_plane_without_angles(limits):
    arm = arm_of("planar")
    limits = arm.joint_range if limits is None else np.array(limits)
    known, joints = planar_limits(arm.chain, limits), np.empty(2)
    for x, y in np.random.default_rng(0).uniform(-0.8, 0.8, (2000, 2)):
        assert in_planar_reach(arm.chain, known, x, y) == solve_planar(arm.chain, limits, x, y, joints)


def test_spheres_contain_the_geoms_and_stick_out_little(arm):
    model = arm.compile(0)
    data = mujoco.MjData(model)
    position, _, _ = states(arm, 3)
    rng = np.random.default_rng(2)
    for joints in position:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        centres, radii = sphere_centres(arm.chain, arm.spheres, joints), arm.spheres.radius
        outside = np.full(len(radii), np.inf)
        for geom in range(model.ngeom):
            if not model.geom_contype[geom]:
                continue
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE.value:
                axis = 0.0 * axis
            away = rng.normal(size=(500, 3))
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            centre, radius = data.geom_xpos[geom], model.geom_size[geom, 0]
            surface = centre + rng.uniform(-1, 1, (500, 1)) * axis + radius * away
            assert ((np.linalg.norm(surface[:, None] - centres, axis=-1) - radii).min(axis=1) < 1e-9).all()
            share = np.clip((centres - centre) @ axis / max(axis @ axis, 1e-12), -1.0, 1.0)
            from_axis = np.linalg.norm(centres - centre - share[:, None] * axis, axis=1)
            outside = np.minimum(outside, from_axis + radii - radius)
        assert outside.max() <= arm.excess + 1e-9 <= 0.005 + 2e-9
