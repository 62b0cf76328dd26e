"""Laws of the arm with seven joints."""

import dataclasses
import itertools
import json
import re
from importlib.resources import files
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms import PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.serial_arm import LIMIT_SHARE, serial_arm
from viapoint.envs.geometry.distance import MAX_CLEARANCE, arm_clearance
from viapoint.envs.geometry.narrow_phase import ends_of, nearest_approach
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.sim.simulator import Simulator

DOCS = Path(__file__).parents[2] / "docs"
PANDA_FILE = files("viapoint.envs") / "assets" / "panda.xml"
CAPSULE = 'fromto="0 0.0421 -0.1081 0 0.064 0.0008" size="0.068"'
BALL = 'type="sphere" pos="0 0.053 -0.054" size="0.08"'
WITH_SPHERES = serial_arm(
    PANDA_FILE.read_text(encoding="utf-8").replace(CAPSULE, BALL), name="with-spheres", ik=PANDA.ik,
    joint_names=PANDA.joint_names, hand_site="hand", workspace=PANDA.workspace,
)  # fmt: skip
LAYOUT = ActionLayout(dimension=3, duration_range=(1.0, 2.0))


def movements(number=150, seed=0, duration=0.0):
    """Movements within reach through random via-points; `duration` is the component of the action."""
    rng = np.random.default_rng(seed)
    low, high = np.array(PANDA.workspace)
    start, goal = rng.uniform(low, high, (2, 8 * number, 3))
    action = rng.uniform(-1.0, 1.0, (8 * number, 4))
    action[:, 3] = duration
    apart = np.linalg.norm(goal - start, axis=-1)
    plan = LAYOUT.decode(action, start, goal)
    path = plan.trajectory()(plan.durations.sum(axis=-1)[:, None] * np.linspace(0.0, 1.0, 200))
    good = (apart > 0.3) & (apart < 0.5) & (PANDA.reach_margin(path) >= 0.0).all(axis=-1)
    return plan.take(np.flatnonzero(good)[:number])


def looked_at(plan, times=200):
    return plan.trajectory().sample(plan.durations.sum(axis=-1)[:, None] * np.linspace(0.0, 1.0, times))


def test_the_file_has_the_published_dimensions():
    """At zero the arm stands upright, its hand pointing down: sums of the Denavit-Hartenberg table."""
    assert PANDA.hand_position(np.zeros(7)) == pytest.approx(
        [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107 - 0.1034]
    )
    assert PANDA.hand_position(np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, 0])) == pytest.approx(
        [0.0825 + 0.384 + 0.088, 0.0, 0.333 + 0.316 + 0.0825 - 0.107 - 0.1034]
    )
    assert PANDA.torque_limit == (87.0,) * 4 + (12.0,) * 3
    assert PANDA.velocity_limit == (2.175,) * 4 + (2.61,) * 3


def test_torques_are_the_inverse_dynamics_of_mujoco():
    """Motion and weight apart: as gravity is compensated by the actuators, both count towards their limits."""
    model = PANDA.compile(0, whole_arm=True)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    low, high = np.array(PANDA.joint_range).T
    for _ in range(20):
        joints, rates, accelerations = rng.uniform(low, high), rng.uniform(-2, 2, 7), rng.uniform(-9, 9, 7)
        data.qpos[:], data.qvel[:], data.qacc[:] = joints, rates, accelerations
        mujoco.mj_inverse(model, data)
        moving, holding = PANDA.chain.torques(joints, rates, accelerations)
        np.testing.assert_allclose(moving + holding, data.qfrc_inverse, atol=1e-9)
        np.testing.assert_allclose(holding, data.qfrc_gravcomp, atol=1e-9)


def test_the_hand_points_down_and_keeps_its_heading_and_nothing_touches_itself_or_the_table():
    model = PANDA.compile(0, whole_arm=True)
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    places = rng.uniform((-0.2, -0.8, 0.0), (0.8, 0.8, 0.8), (8000, 3))
    for joints in PANDA.inverse_kinematics(places[PANDA.reach_margin(places) >= 0.0])[:800]:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        np.testing.assert_allclose(
            data.site("hand").xmat.reshape(3, 3), np.diag([1.0, -1.0, -1.0]), atol=1e-4
        )
        assert data.ncon == 0


def test_postures_change_smoothly():
    """Differences over steps of very different lengths give the same joint rates."""
    position, velocity, _ = looked_at(movements(40))
    short, long = (
        (PANDA.inverse_kinematics(position + step * velocity) - PANDA.inverse_kinematics(position)) / step
        for step in (1e-7, 1e-5)
    )
    np.testing.assert_allclose(short, long, atol=1e-3)


def test_movements_of_the_centre_duration_are_tracked_and_links_are_where_they_were_foreseen():
    """Hand within 1 mm rms and 2 mm at worst, links within 5 mm."""
    plan = movements()
    position, velocity, acceleration = looked_at(plan)
    factor = PANDA.required_time_scale(position, velocity, acceleration)
    steps = np.arange(0.0, 1.6 * LAYOUT.centre_duration * factor.max(), 0.004)
    trajectory = plan._replace(durations=plan.durations * factor[:, None]).trajectory()
    position, velocity, acceleration = trajectory.sample(steps)
    number = len(position)
    simulator = Simulator(CollisionModel(PANDA, True), n_obstacles=0, num_envs=number, threads=1)
    none = np.zeros((number, 0, 7)), np.zeros((number, 0), dtype=bool)
    simulator.place(np.arange(number), PANDA.inverse_kinematics(position[:, 0]), *none)
    record = simulator.rollout(
        np.arange(number), PANDA.controls(*(part[:, :-1] for part in (position, velocity, acceleration)))
    )
    error = np.linalg.norm(PANDA.hand_position(record.joints) - position[:, 1:], axis=-1)
    assert np.sqrt((error**2).mean(axis=-1)).max() < 1e-3
    assert error.max() < 2e-3
    foreseen = PANDA.links(PANDA.inverse_kinematics(position[:, 1:]))
    assert np.linalg.norm(PANDA.links(record.joints) - foreseen, axis=-1).max() < 5e-3
    assert not record.contact.any()
    assert not record.unstable.any()


def test_a_movement_too_fast_is_slowed_down_just_enough():
    plan = movements(60, seed=5)
    plan = plan._replace(durations=plan.durations * 0.3)
    position, velocity, acceleration = looked_at(plan)
    factor = PANDA.required_time_scale(position, velocity, acceleration)
    assert (factor > 1.0).all()
    slower = plan._replace(durations=plan.durations * factor[:, None])
    position, velocity, acceleration = looked_at(slower)
    np.testing.assert_allclose(PANDA.required_time_scale(position, velocity, acceleration), 1.0, atol=1e-4)
    joints, time = PANDA.inverse_kinematics(position), slower.durations.sum(axis=-1)[:, None, None] / 199
    rates = np.abs(np.diff(joints, axis=1) / time).max(axis=1) / np.array(PANDA.velocity_limit)
    moving, holding = PANDA.chain.torques(
        joints[:, 1:-1],
        (joints[:, 2:] - joints[:, :-2]) / (2 * time),
        (joints[:, 2:] - 2 * joints[:, 1:-1] + joints[:, :-2]) / time**2,
    )
    used = (np.abs(moving) / (np.array(PANDA.torque_limit) - np.abs(holding))).max(axis=1)
    assert (np.maximum(rates, used).max(axis=-1) <= 1.01 * LIMIT_SHARE).all()
    assert np.median(np.maximum(rates, np.sqrt(used)).max(axis=-1)) > 0.98 * LIMIT_SHARE


def test_torque_limits_act():
    """A movement of a tenth of the time that the limits ask for is not followed, and no torque exceeds its limit."""
    plan = movements(1, seed=8)
    path = plan._replace(durations=plan.durations * 0.06).trajectory()
    model = PANDA.compile(0, whole_arm=True)
    data = mujoco.MjData(model)
    position, velocity, acceleration = path.sample(np.arange(60) * 0.004)
    data.qpos[:] = PANDA.inverse_kinematics(position[0, 0])
    greatest = np.zeros(7)
    for control in PANDA.controls(position, velocity, acceleration)[0]:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        greatest = np.maximum(greatest, np.abs(data.qfrc_actuator))
    assert (greatest <= np.array(PANDA.torque_limit) + 1e-9).all()
    assert (greatest[:4] > 86.9).any()


@pytest.mark.parametrize("arm", [PANDA, WITH_SPHERES], ids=lambda arm: arm.name)
def test_contact_exactly_where_a_link_reaches_into_an_obstacle(arm):
    number, rng = 2000, np.random.default_rng(4)
    places = rng.uniform(*np.array(arm.workspace), (number, 3))
    centre = places[:, None] + rng.uniform(-0.25, 0.25, (number, 3, 3))
    axis = rng.uniform(-0.12, 0.12, (number, 3, 3)) * (rng.random((number, 3, 1)) < 0.6)
    obstacles = np.concatenate((centre, axis, rng.uniform(0.01, 0.05, (number, 3, 1))), axis=-1)
    present = rng.random((number, 3)) < 0.6
    simulator = Simulator(CollisionModel(arm, True), n_obstacles=3, num_envs=number, threads=1)
    joints = arm.inverse_kinematics(places)
    simulator.place(np.arange(number), joints, obstacles, present)
    contact = simulator.rollout(np.arange(number), np.zeros((number, 1, 10))).contact[:, 0]
    clearance = arm_clearance(arm.links(joints)[:, None], arm.link_radii, obstacles, present).min(axis=-1)
    clearance = np.minimum(clearance, arm.self_clearance(joints))
    np.testing.assert_array_equal(contact, clearance < 0.0)
    assert 0.1 < contact.mean() < 0.9


@pytest.mark.parametrize("arm", [PANDA, WITH_SPHERES], ids=lambda arm: arm.name)
def test_contact_with_itself_and_the_table_exactly_where_the_clearance_from_itself_is_negative(arm):
    model, rng = arm.compile(0, whole_arm=True), np.random.default_rng(7)
    data, joints = mujoco.MjData(model), rng.uniform(*np.array(arm.joint_range).T, (600, 7))
    clearance, contact = arm.self_clearance(joints), np.zeros(600, dtype=bool)
    for i, data.qpos[:] in enumerate(joints):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        contact[i] = data.ncon > 0
    np.testing.assert_array_equal(contact, clearance < 0.0)
    assert 0.2 < contact.mean() < 0.8
    np.testing.assert_allclose(arm.self_clearance(joints.reshape(6, 100, 7)).ravel(), clearance, atol=1e-12)


def test_links_that_are_not_compared_never_touch():
    """But neighbours, and forearm and flange, whose capsules overlap within reach although the links do not."""
    every = (*PANDA.shape, *PANDA.base)
    distant = [(i, j) for i, j in itertools.combinations(range(len(every)), 2)
               if abs(every[i].joint - every[j].joint) > 1
               and [every[i].name[:5], every[j].name[:5]] != ["link5", "link7"]]  # fmt: skip
    arm = dataclasses.replace(PANDA, self_pairs=tuple({*distant} - {*PANDA.self_pairs}), off_table=())
    joints = np.random.default_rng(5).uniform(*np.array(PANDA.joint_range).T, (5000, 7))
    assert 0.0 < arm.self_clearance(joints).min() < MAX_CLEARANCE
    assert {*PANDA.self_pairs} < {*distant}


def test_measured_bounds_of_the_capsules():
    """benchmarks/panda_collision.py: Franka's geometry is inside, and the capsules reach at most 25 mm beyond it."""
    found = json.loads((DOCS / "panda-collision.json").read_text(encoding="utf-8"))
    joints = [capsule.joint for capsule in (*PANDA.shape, *PANDA.base)]
    assert [row["capsules"] for row in found["links"]] == [joints.count(joint) for joint in range(-1, 7)]
    assert max(row["outside"] for row in found["links"]) == 0.0
    assert max(row["excess"] for row in found["links"]) <= 25.0
    apart = found["forearm_and_flange"]
    assert apart["capsules"] < 0.0 < 10.0 < apart["geometry"]


def test_the_nearest_approach_is_the_least_of_all_times():
    rng, plan = np.random.default_rng(6), movements(30)
    position, *_ = looked_at(plan, 160)
    links = PANDA.links(PANDA.inverse_kinematics(position))
    middle = position[:, 80, None] + rng.uniform(-0.3, 0.3, (30, 5, 3))
    axis = rng.uniform(-0.1, 0.1, (30, 5, 3))
    obstacles = np.concatenate((middle, axis, rng.uniform(0.01, 0.05, (30, 5, 1))), axis=-1)
    present = rng.random((30, 5)) < 0.7
    brute = arm_clearance(links, PANDA.link_radii, obstacles, present).min(axis=-1)
    found = nearest_approach(ends_of(links), PANDA.link_radii, obstacles, present)
    np.testing.assert_allclose(found, brute, atol=1e-9)
    half = nearest_approach(ends_of(links), PANDA.link_radii, obstacles, present, np.full(30, 79))
    brute = arm_clearance(links[:, :80], PANDA.link_radii, obstacles, present).min(axis=-1)
    np.testing.assert_allclose(half, brute, atol=1e-9)
    floor = float(np.median(found))
    floored = nearest_approach(ends_of(links), PANDA.link_radii, obstacles, present, floor=floor)
    assert (floored[found >= floor] == found[found >= floor]).all()
    assert (floored[found < floor] < floor).all()
    assert (floored != found).any()
    nothing = nearest_approach(ends_of(links), PANDA.link_radii, obstacles, np.zeros((30, 5), dtype=bool))
    np.testing.assert_array_equal(nothing, MAX_CLEARANCE)


def test_straight_movements_of_drawn_scenes_are_not_slowed_down():
    """The number of scenes is that of docs/environments-panda.md."""
    envs = gym.make_vec("viapoint/PandaObstacles-v0", num_envs=500)
    for seed in range(4):
        envs.reset(seed=1000 * seed)
        scenes = envs.unwrapped.scenes
        plan = LAYOUT.decode(np.zeros((500, LAYOUT.size)), scenes.start, scenes.goal)
        position, velocity, acceleration = looked_at(plan)
        np.testing.assert_array_equal(PANDA.required_time_scale(position, velocity, acceleration), 1.0)
    envs.close()


def test_the_example_of_the_page_puts_a_scene_of_a_family_into_the_environment():
    page = (DOCS / "environments-panda.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(example, names)
    assert names["scenes"].present.sum(axis=-1).min() >= scene_families(3)["tunnel"].n_obstacles
    assert names["observation"]["hand"] == pytest.approx(names["scenes"].start[0], abs=1e-6)
