"""Laws of the arms."""

import copy
import doctest
import importlib
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest

from viapoint.envs.arms import ADULT, ARMS
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.scenes.scene import TARGETS
from viapoint.envs.sim.simulator import Simulator
from viapoint.primitives import point_to_point


@pytest.fixture(params=sorted(ARMS))
def arm(request):
    return ARMS[request.param]


def postures(arm, number=500, seed=0):
    low, high = np.array(arm.joint_range).T
    return np.random.default_rng(seed).uniform(low + 0.05, high - 0.05, (number, len(low)))


def places(arm, number=500, seed=0):
    """Places of the hand all over its reach."""
    draws = np.random.default_rng(seed).uniform(-0.8, 0.8, (40 * number, arm.dimension))
    return draws[arm.reach_margin(draws) >= 0.0][:number]


def test_posture_puts_the_hand_there_within_the_joints_ranges(arm):
    hand = places(arm)
    assert len(hand) == 500
    joints = arm.inverse_kinematics(hand)
    np.testing.assert_allclose(arm.hand_position(joints), hand, atol=2e-5)
    low, high = np.array(arm.joint_range).T
    assert ((joints >= low) & (joints <= high)).all()


def test_posture_inverts_hand_where_there_is_one_only():
    joints = postures(ADULT)
    np.testing.assert_allclose(ADULT.inverse_kinematics(ADULT.hand_position(joints)), joints, atol=1e-9)


def test_kinematics_agree_with_mujoco(arm):
    model = arm.compile(0, whole_arm=True)
    data = mujoco.MjData(model)
    for joints in postures(arm, 20):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(
            data.site("hand").xpos[: arm.dimension], arm.hand_position(joints), atol=1e-12
        )
        np.testing.assert_allclose(arm.links(joints)[-1, 1], arm.hand_position(joints), atol=1e-12)
        traced = np.array([data.site(name).xpos for name in arm.traced])
        if len(traced):
            np.testing.assert_allclose(traced[0], arm.hand_position(joints), atol=1e-12)
            np.testing.assert_allclose(traced[1:], arm.links(joints).reshape(-1, 3), atol=1e-12)


def test_links_are_known_without_angles():
    """Beyond the reach, too, where the forearm is drawn out to the hand instead of pointing at it."""
    hand = np.random.default_rng(0).uniform(-0.9, 0.9, (50, 8, 2))
    (shoulder, elbow), (joint, end) = ADULT.links_at(hand)
    exact, distance = ADULT.links(ADULT.inverse_kinematics(hand)), np.linalg.norm(hand, axis=-1)
    np.testing.assert_array_equal(shoulder, 0.0)
    np.testing.assert_array_equal(elbow, joint)
    np.testing.assert_allclose(elbow, exact[..., 0, 1, :], atol=1e-14)
    np.testing.assert_array_equal(end, hand)
    reached = (distance > ADULT.reach[0]) & (distance < ADULT.reach[1])
    np.testing.assert_allclose(end[reached], exact[reached][:, 1, 1], atol=1e-14)
    assert 0.2 < reached.mean() < 0.8


def test_links_are_known_with_the_hand_in_the_shoulder():
    """Where no posture puts it and any direction would do; a straight movement may pass there."""
    hand = np.zeros((2, 2))
    links = ADULT.links(ADULT.inverse_kinematics(hand))
    for i, (start, _) in enumerate(ADULT.links_at(hand)):
        np.testing.assert_allclose(start, links[:, i, 0], atol=1e-14)


@pytest.mark.parametrize("module", ["arms.planar", "registration"])
def test_examples_run(module, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    results = doctest.testmod(importlib.import_module(f"viapoint.envs.{module}"))
    assert results.attempted > 0
    assert results.failed == 0


def test_copies_of_an_arm_are_equal(arm):
    for other in (pickle.loads(pickle.dumps(arm)), copy.deepcopy(arm)):
        assert other == arm
        assert hash(other) == hash(arm)


def test_links_hang_together_and_have_their_lengths():
    arm = ADULT
    links = arm.links(postures(arm))
    np.testing.assert_allclose(links[:, 1:, 0], links[:, :-1, 1], atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(links[:, :, 1] - links[:, :, 0], axis=-1), np.tile(arm.lengths, (500, 1)), atol=1e-12
    )


def test_reach_margin_is_positive_exactly_where_a_posture_gets_there():
    """Inside the ranges of the joints it is positive, just beyond each of their limits negative."""
    low, high = np.array(ADULT.joint_range).T
    assert (ADULT.reach_margin(ADULT.hand_position(postures(ADULT))) > 0.0).all()
    middle = 0.5 * (low + high)
    for joint in range(2):
        for limit, step in ((low, -0.02), (high, 0.02)):
            beyond = middle.copy()
            beyond[joint] = limit[joint] + step
            assert ADULT.reach_margin(ADULT.hand_position(beyond)) < 0.0 or joint == 1
    far = ADULT.hand_position(np.array([middle[0], low[1]]))
    near = ADULT.hand_position(np.array([middle[0], high[1]]))
    assert ADULT.reach_margin(1.001 * far) < 0.0 < ADULT.reach_margin(0.999 * far)
    assert ADULT.reach_margin(0.999 * near) < 0.0 < ADULT.reach_margin(1.001 * near)


def test_controls_are_the_inverse_dynamics_of_mujoco():
    """On the reference itself the servo is silent and the torque that of mj_inverse."""
    model = ADULT.compile(0, whole_arm=False)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for _ in range(20):
        goal, start = (
            ADULT.hand_position(postures(ADULT, 1, int(rng.integers(1 << 30)))[0]) for _ in range(2)
        )
        time = np.array([0.37])
        path = point_to_point(start, goal, np.asarray(0.9))
        position, velocity, acceleration = (path(time, nu) for nu in range(3))
        if ADULT.reach_margin(position) < 0.02:
            continue
        step = 1e-4
        around = ADULT.inverse_kinematics(path(time + step * np.array([-1.0, 0.0, 1.0])))
        data.qpos[:], data.qvel[:] = around[1], (around[2] - around[0]) / (2 * step)
        data.qacc[:] = (around[2] - 2 * around[1] + around[0]) / step**2
        mujoco.mj_inverse(model, data)
        control = ADULT.controls(position, velocity, acceleration)[0]
        torque = control - ADULT.stiffness * data.qpos - ADULT.damping * data.qvel
        np.testing.assert_allclose(torque, data.qfrc_inverse, rtol=1e-4, atol=1e-3)


def test_a_reach_of_40_cm_in_800_ms_is_tracked_within_2_mm_rms():
    targets = {name: np.array(place) for name, place in TARGETS.items()}
    simulator = Simulator(CollisionModel(ADULT, False), n_obstacles=0, num_envs=1, threads=1)
    none = np.zeros((1, 0, 5)), np.zeros((1, 0), dtype=bool)
    for first, second in (("T1", "T4"), ("T4", "T1"), ("T2", "T5"), ("T3", "T6")):
        start, goal = targets[first], targets[second]
        path = point_to_point(
            start, start + 0.4 * (goal - start) / np.linalg.norm(goal - start), np.asarray(0.8)
        )
        times = simulator.timestep * np.arange(451)
        position, velocity, acceleration = (path(times, nu) for nu in range(3))
        simulator.place(np.array([0]), ADULT.inverse_kinematics(start)[None], *none)
        record = simulator.rollout(
            np.array([0]), ADULT.controls(position[:-1], velocity[:-1], acceleration[:-1])[None]
        )
        error = np.linalg.norm(ADULT.hand_position(record.joints[0]) - position[1:], axis=-1)
        assert np.sqrt((error**2).mean()) < 2e-3
        assert error[-1] < 1e-4


def test_single_precision_gives_the_same(arm):
    hand = places(arm, 50)
    for function in (
        arm.inverse_kinematics,
        arm.reach_margin,
        lambda h: arm.links(arm.inverse_kinematics(h)),
    ):
        single = function(hand.astype(np.float32))
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, function(hand), atol=2e-4)


def test_the_targets_are_in_reach_and_the_diagonals_cross_in_the_middle():
    places = {name: np.array(place) for name, place in TARGETS.items()}
    assert all(ADULT.reach_margin(place) > 0.02 for place in places.values())
    middles = [0.5 * (places[a] + places[b]) for a, b in (("T1", "T4"), ("T2", "T5"), ("T3", "T6"))]
    np.testing.assert_allclose(middles, [middles[0]] * 3, atol=1e-12)
