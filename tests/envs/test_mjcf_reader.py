"""MJCF files of other projects: fixed joints, unusual inertias and forces, and errors."""

import dataclasses

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from imported_arms import HOME, JOINTS, UR5E, ur5e, written

import viapoint.envs
from viapoint.envs.arm_import import reachability
from viapoint.envs.arm_import.reachability import infeasible_positions
from viapoint.envs.arms.mjcf import principal_inertia

assert viapoint.envs, "importing it registers the environments"

SHOULDER = '<body name="shoulder" pos="0 0 0.1625">'
LIFT = SHOULDER + '<joint name="lift" type="slide" axis="0 0 1" range="0.1 0.5" actuatorfrclimited="false"/>'
KEYFRAME = '</worldbody><keyframe><key qpos="{}"/></keyframe>'


def hand_of(path, joints):
    """Where MuJoCo has the hand at a configuration of the file's model, [m]."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(model, data)
    return data.site("hand").xpos


@pytest.mark.parametrize("frame", ["", '<frame pos="0 .1 0" euler="0 0 0.2">'])
@pytest.mark.parametrize("lift", [None, 0.1, 0.2])
def test_joints_that_are_left_out_stay_where_the_keyframe_has_them(tmp_path, lift, frame):
    carriage = '<body name="carriage">' + LIFT.replace(
        SHOULDER, '<geom size=".01" pos="0 0 .05"/>' + SHOULDER
    )
    qpos = (lift or 0.0, *HOME)
    keyframe = KEYFRAME.format(" ".join(map(str, qpos))) if lift else "</worldbody>"
    end = "</body></body>" + ("</frame>" if frame else "") + keyframe
    path = written(tmp_path / "lift.xml", (SHOULDER, frame + carriage), ("</body>\n  </worldbody>", end))
    arm = ur5e(path=path, home=HOME, origin=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(arm.hand_position(np.array(HOME)), hand_of(path, qpos), atol=1e-9)


def test_where_they_cannot_the_file_is_refused(tmp_path):
    """A second hinge of a body, after the one that moves: its place is no place of the body alone."""
    second = '<joint name="wrist_1" class="wrist"/><joint name="twist" class="wrist" axis="1 0 0"/>'
    qpos = " ".join(map(str, (*HOME[:4], 0.5, *HOME[4:])))
    path = written(
        tmp_path / "twist.xml",
        ('<joint name="wrist_1" class="wrist"/>', second),
        ("</worldbody>", KEYFRAME.format(qpos)),
    )
    with pytest.raises(ValueError):
        ur5e(path=path)


FLAT = [
    (1.0, 2.0, 3.0),
    (0.6694526, 0.9031057, 1.5725583),
    *np.random.default_rng(5).uniform(0.1, 1.0, (4, 3)),
]


@pytest.mark.parametrize(
    ("scale", "moments"), [(3e-13, (1.0, 1.0, 1.0)), *((1e-2, moments) for moments in FLAT)]
)
def test_bodies_may_be_tiny_or_flat(tmp_path, scale, moments):
    """The third moment of a flat body is the sum of the others."""
    first, second, third = moments
    numbers = f"{scale * first:.9g} {scale * second:.9g} {min(scale * third, scale * (first + second)):.9g}"
    mass = 1e-7 if scale < 1e-9 else 2.8
    inertial = f'<inertial pos="-.2 0 0.1" mass="{mass}" diaginertia="{numbers}" euler="0.1 0.2 0.3"/>'
    before = '<body name="wrist_3" pos="0 0 0.0997" quat="1 -1 0 0">'
    path = written(
        tmp_path / "odd.xml", (before, before + inertial), ("autolimits", 'balanceinertia="true" autolimits')
    )
    chain, whole = ur5e(path=path).chain, mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(whole)
    acceleration = np.arange(1.0, 7.0)
    data.qpos[:], data.qacc[:] = HOME, acceleration
    mujoco.mj_inverse(whole, data)
    moving, holding = chain.torques(np.array(HOME), np.zeros(6), acceleration)
    np.testing.assert_allclose(moving + holding, data.qfrc_inverse, rtol=1e-4, atol=1e-7)


def test_inertias_are_written_as_they_are():
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = rng.normal(size=(5, 3))
        inertia = sum(p @ p * np.eye(3) - np.outer(p, p) for p in points)
        moments, quaternion = principal_inertia(tuple(map(tuple, inertia)))
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, quaternion)
        turn = turn.reshape(3, 3)
        np.testing.assert_allclose(turn @ np.diag(moments) @ turn.T, inertia, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("limit", "factor"), [(0.3, 2.0), (1.0, 1.3)])
def test_weak_joints_are_given_time(limit, factor):
    """The base of an arm carries no weight, so it may be as weak as it likes."""
    arm = ur5e(velocity_limit=np.pi, torque_limit=[limit, 150, 150, 28, 28, 28])
    env = gym.make_vec("viapoint/Reach-v0", num_envs=16, arm=arm)
    env.reset(seed=0)
    *_, info = env.step(np.zeros((16, 4), np.float32))
    assert info["is_success"].all()
    assert info["stretch"].mean() > factor
    centre = env.unwrapped.action_layout.centre_duration
    np.testing.assert_allclose(info["duration"], centre * info["stretch"])
    env.close()


def test_actuators_may_act_on_the_joint_in_its_parents_frame(tmp_path):
    motor = '</worldbody><actuator><motor jointinparent="elbow" ctrlrange="-120 120"/></actuator>'
    elbow = ('range="-3.1416 3.1416"/>', 'range="-3.1416 3.1416" actuatorfrclimited="false"/>')
    arm = ur5e(path=written(tmp_path / "parent.xml", elbow, ("</worldbody>", motor)))
    assert arm.torque_limit[JOINTS.index("elbow")] == 120.0


def test_a_workspace_that_is_reached_is_taken_whatever_its_corners():
    box = ((0.24, -0.40, 0.09), (0.61, 0.41, 0.37))
    arm = ur5e(workspace=((0.61, -0.40, 0.37), (0.24, 0.41, 0.09)))
    assert arm.workspace == box
    low, high = np.array(arm.ik.box)
    assert (low <= box[0]).all()
    assert (high >= box[1]).all()


PANDA_JOINTS = [f"joint{number}" for number in range(1, 8)]
TWISTED = [0.42, -0.6, -0.53, -2.65, -0.2, 2.81, 0.2]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"home": (0.3, -0.55, -1.84, -1.55, 1.38, -0.27)},
        {"path": UR5E.parents[1] / "envs/assets/panda.xml", "joints": PANDA_JOINTS, "home": TWISTED},
    ],
)
def test_postures_are_good_everywhere_in_the_reach_and_follow_the_hand(changes):
    arm = ur5e(**changes)
    low, high = np.array(arm.ik.box)
    rng = np.random.default_rng(0)
    places = rng.uniform(low, high, (5000, 3))
    joints = arm.inverse_kinematics(places)
    np.testing.assert_allclose(arm.hand_position(joints), places, atol=1e-6)
    least, most = np.array(arm.joint_range).T
    assert (np.minimum(joints - least, most - joints) > 0.02).all()
    step = 1e-4 * rng.normal(size=(5000, 3))
    near = np.clip(places + step, low, high)
    turned = np.abs(arm.inverse_kinematics(near) - joints).max(axis=-1)
    assert (turned <= 30.0 * np.linalg.norm(near - places, axis=-1) + 1e-12).all()


def test_maps_that_turn_the_hand_or_crowd_the_links_are_seen(monkeypatch):
    seen = []
    monkeypatch.setattr(
        reachability,
        "infeasible_positions",
        lambda place, reachable: seen.append((place, reachable)) or infeasible_positions(place, reachable),
    )
    arm = ur5e()
    place, reachable = seen[-1]
    assert place == arm.ik
    assert not len(infeasible_positions(place, reachable))
    for joint in range(3, 6):
        table = np.array(place.coefficients)
        table[0, joint] += 1.0  # everywhere, and the steps that follow put the hand where it belongs again
        moved = dataclasses.replace(place, coefficients=tuple(map(tuple, table)))
        assert len(infeasible_positions(moved, reachable))
