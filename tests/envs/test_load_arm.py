"""Laws of arms that are loaded from MJCF files."""

import itertools
import json
import pickle
import re
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from imported_arms import HOME, JOINTS, UR5E, ur5e, written

import viapoint.envs
from viapoint.envs.arm_import import capsule_fit
from viapoint.envs.arm_import.capsule_fit import cover_geom, cover_points, polytope_around
from viapoint.envs.arm_import.loader import load_arm
from viapoint.envs.arms import ARMS, PANDA, Arm, register_arm
from viapoint.envs.geometry.convex_mesh import ConvexMesh
from viapoint.envs.geometry.distance import point_distance_squared
from viapoint.envs.registration import OWN_ARM_TASKS

assert viapoint.envs, "importing it registers the environments"

CORNERS = " ".join(f"{x} {y} {z}" for x, y, z in np.ndindex(2, 2, 2))
CUBE_MESH = f'<mesh name="cube" vertex="{CORNERS}"/>'
DOCS = Path(__file__).parents[2] / "docs"
FETCH = {
    "hand_site": "robot0:grip",
    "joints": [
        f"robot0:{name}_joint"
        for name in (
            "shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll",
        )
    ],
    "joint_range": [(-1.6, 1.6), (-1.2, 1.5), (-3.1, 3.1), (-2.2, 2.2), (-3.1, 3.1), (-2.1, 2.1), (-3.1, 3.1)],
    "torque_limit": (33.8, 131.7, 76.9, 66.1, 29.3, 25.7, 7.3),
    "home": (0.0, -0.5, 0.0, 1.3, 0.0, 0.77, 0.0),
}  # fmt: skip


@pytest.fixture(scope="module")
def arm():
    return ur5e(velocity_limit=np.pi)


def places(arm, number=300):
    low, high = np.array(arm.ik.box)
    return np.random.default_rng(0).uniform(low, high, (number, 3))


def test_it_is_the_arm_of_the_file(arm):
    """The hand is where the file's model has it, for any posture, and so are mass and inertia."""
    model, data = (m := mujoco.MjModel.from_xml_path(str(UR5E))), mujoco.MjData(m)
    rng, full = np.random.default_rng(1), np.zeros((6, 6))
    for joints in rng.uniform(-3.0, 3.0, (20, 6)):
        data.qpos[:], data.qvel[:], data.qacc[:] = joints, 0.0, rng.uniform(-1, 1, 6)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(arm.hand_position(joints), data.site("hand").xpos, atol=1e-5)
        mujoco.mj_fullM(model, data, full)
        gain = rng.uniform(-1.0, 1.0, 6)
        moving, holding = arm.chain.torques(joints, 0.0 * joints, gain)
        np.testing.assert_allclose(moving, full @ gain, atol=1e-3)
        np.testing.assert_allclose(holding, data.qfrc_bias, atol=1e-2)


def test_everywhere_in_its_reach_the_hand_gets_there_turned_as_at_home(arm):
    hand = places(arm)
    joints = arm.inverse_kinematics(hand)
    np.testing.assert_allclose(arm.hand_position(joints), hand, atol=1e-6)
    low, high = np.array(arm.joint_range).T
    assert ((joints > low) & (joints < high)).all()
    model = arm.compile(0, whole_arm=True)
    data, turns = mujoco.MjData(model), []
    for posture in (np.array(HOME), *joints):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert data.ncon == 0
        turns.append(data.site("hand").xmat.reshape(3, 3).copy())
    turned = np.arccos(np.clip((np.einsum("nij,ij->n", turns, turns[0]) - 1.0) / 2.0, -1.0, 1.0))
    assert turned.max() < 0.4
    assert (arm.reach_margin(hand) >= 0.0).all()
    assert arm.reach_margin(np.array(arm.ik.box[1]) + 0.01) < 0.0


GEOMS = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .2 0 0  0 .1 0  .2 .1 0  0 0 .1  0 .1 .1"/></asset>
  <worldbody>
    <geom type="sphere" size=".05" pos=".1 .2 .3"/>
    <geom type="capsule" size=".04 .1" pos="0 .2 .1" euler="10 20 30"/>
    <geom type="box" size=".1 .04 .06" euler="40 10 0"/>
    <geom type="cylinder" size=".06 .15" euler="0 60 10"/>
    <geom type="ellipsoid" size=".04 .06 .12" pos=".3 0 0" euler="0 60 10"/>
    <geom type="mesh" mesh="wedge" pos="1 0 0" euler="0 30 10"/>
  </worldbody>
</mujoco>"""


def points_in(model, geom, rng, number=3000):
    """Random points of a geom in its frame, many of them on its surface."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
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


@pytest.mark.parametrize("tolerance", [0.02, 0.2])
def test_capsules_contain_every_geom_and_reach_no_farther_beyond_it_than_the_tolerance(tolerance):
    model = mujoco.MjModel.from_xml_string(GEOMS)
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    mujoco.mj_kinematics(model, data)
    for geom in range(2, model.ngeom):
        turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        found = cover_geom(model, data, geom, tolerance)
        rows = np.array(
            [[*each.ends.mean(0), *(0.5 * (each.ends[1] - each.ends[0])), each.radius] for each in found]
        )
        points = place + points_in(model, geom, rng) @ turn.T
        depth = np.sqrt(point_distance_squared(points, rows)) - rows[:, -1:]
        assert depth.min(axis=0).max() <= 0.0
        corners, larger = polytope_around(model, geom)
        body = ConvexMesh.hull(place + corners @ turn.T)
        ball = rng.normal(size=(4000, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        for each in found:
            farthest = body.distance(np.concatenate([end + each.radius * ball for end in each.ends])).max()
            assert each.excess - larger - 1.5e-3 <= farthest <= each.excess - larger <= tolerance - larger


def test_spheres_and_capsules_of_a_file_stay_as_they_are():
    model = mujoco.MjModel.from_xml_string(GEOMS)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    (ball,), (rod,) = (cover_geom(model, data, geom, 0.025) for geom in (0, 1))
    np.testing.assert_allclose(ball.ends, [(0.1, 0.2, 0.3)] * 2)
    np.testing.assert_allclose(0.5 * (rod.ends[1] - rod.ends[0]), 0.1 * data.geom_xmat[1].reshape(3, 3)[:, 2])
    assert (ball.radius, rod.radius, ball.excess, rod.excess) == (0.05, 0.04, 0.0, 0.0)


def test_a_cube_takes_one_capsule_and_many_where_little_may_stick_out(monkeypatch):
    cube = 0.05 * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    (ball,) = cover_points(cube, 0.04)
    assert ball.radius == pytest.approx(0.05 * 3**0.5, abs=2e-3)  # a short capsule is no better
    assert 2 < len(cover_points(cube, 0.02)) < 20
    monkeypatch.setattr(capsule_fit, "MOST_CAPSULES", 3)
    with pytest.raises(ValueError):
        cover_points(cube, 0.015)


def moves_as_planned(arm, error):
    """Straight movements reach their goal without obstacles, and touch one among obstacles."""
    for env_id, outcome in (("viapoint/Reach-v0", "is_success"), ("viapoint/Obstacles-v0", "collision")):
        env = gym.make_vec(env_id, num_envs=24, arm=arm, threads=1)
        inner = pickle.loads(pickle.dumps(env.unwrapped))
        inner.reset(seed=0)
        _, _, info = inner.execute_actions(np.zeros((24, 4)))
        assert info[outcome].all()
        if outcome == "is_success":
            assert info["tracking_error"].max() < error
            np.testing.assert_array_equal(info["stretch"], 1.0)


def test_environments_take_it_and_it_moves_as_planned(arm):
    moves_as_planned(arm, error=1e-3)


def test_single_equals_batch_bit_for_bit(arm):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4)).astype(np.float32)
    env = gym.make_vec("viapoint/Obstacles-v0", num_envs=12, arm=arm)
    single = gym.make("viapoint/Obstacles-v0", arm=arm)
    env.reset(seed=5)
    *_, together = env.step(actions)
    for i in range(12):
        single.reset(seed=5 + i)
        *_, alone = single.step(actions[i])
        assert alone == {name: together[name][i].item() for name in alone}


@pytest.mark.parametrize(("env_id", "like"), OWN_ARM_TASKS.items())
def test_without_one_they_are_the_pandas(env_id, like):
    one, other = gym.make(env_id), gym.make(like)
    assert one.unwrapped.task == other.unwrapped.task
    assert one.unwrapped.task.arm is PANDA


REFUSED = {
    "path": ["", "none.xml"],
    "hand_site": ["tool"],
    "name": [5],
    "joints": [
        5, "elbow", JOINTS[:4], (*JOINTS[:5], "wrist_4"), (*JOINTS[:5], JOINTS[0]), (JOINTS[1], JOINTS[0], *JOINTS[2:]),
    ],
    "home": [HOME[:3], (7.0, *HOME[1:]), (0.0, -1.57, 0.0, 0.0, 0.0, 0.0)],
    "origin": ["base", (0, 0), (0.0, 0.0, np.nan), (0.0, 0.0, -0.8), (0.0, 0.0, 0.25)],
    "workspace": [
        "table", (1, 2), ((0.3, -0.2), (0.5, 0.2)), ((np.nan, 0.0, 0.1), (0.5, 0.2, 0.3)),
        ((0.3, -0.2, 0.1), (1.2, 0.2, 0.3)),  # beyond the observation
        ((0.3, -0.4, 0.2), (0.9, 0.4, 0.4)),  # beyond the reach
        ((0.3, -0.4, 0.2), (0.55, 0.4, 0.2)), ((0.4, 0.1, 0.2), (0.45, 0.15, 0.25)),  # too small
    ],
    "joint_range": [
        {}, [(-np.inf, np.inf)] * 6, [(0.0, 1.0), (0.0,)],
        [*[(-6, 6)] * 4, (1.56, 6), (-6, 6)],  # a joint at the end of its range at home
    ],
    "velocity_limit": [{}],
    "torque_limit": [
        -1.0, [1e-3] * 6,
        [150.0, 25.0, 25.0, 28.0, 28.0, 28.0],  # enough at home, where the elbow bears most
    ],
    "hand_radius": [0, -1, np.nan, "small"],
    "tolerance": [0.0, "fine", np.nan],
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in REFUSED.items() for value in values]
)
def test_invalid_arguments_are_refused(name, value):
    with pytest.raises(ValueError):
        ur5e(**{name: value})


@pytest.mark.parametrize("path", [5, None, b"arm.xml"])
def test_a_path_is_the_name_of_a_file(path):
    with pytest.raises(TypeError):
        ur5e(path=path)


def test_joints_that_are_left_out_are_fixed():
    assert ur5e(joints=JOINTS[:5], home=HOME[:5]).link_joints[-1] == 4


@pytest.mark.parametrize(
    ("pattern", "other"),
    [
        (r' range="-6.2832 6.2832"', ""),  # joints without limits
        (r' actuatorfrcrange="[^"]*"', ""),  # and without torques
        (r'<joint name="elbow" range', '<joint name="elbow" type="slide" range'),
        (r"<geom[^>]*/>", ""),
        (r"<geom type[^>]*/>", ""),  # bodies without mass
        (r"(?s).{20}$", ""),  # no XML
        (r'<geom type="box"', '<geom type="sdf" mesh="cube" mass="0.1"/><geom type="box"'),
        (r'<joint name="wrist_1" class="wrist"/>((?s:.*?))<joint name="wrist_2"',
         r'\1<joint name="wrist_1" class="wrist" axis="0 1 0"/><joint name="wrist_2"'),  # two in one body
        (r'actuatorfrcrange="-28 28"', 'actuatorfrcrange="0 28"'),  # motors that pull one way
    ],
)  # fmt: skip
def test_files_that_lack_something_are_refused(tmp_path, pattern, other):
    text = UR5E.read_text(encoding="utf-8").replace("<worldbody>", f"<asset>{CUBE_MESH}</asset><worldbody>")
    changed, number = re.subn(pattern, other, text)
    assert number
    path = tmp_path / "arm.xml"
    path.write_text(changed, encoding="utf-8")
    with pytest.raises(ValueError):
        load_arm(path, hand_site="hand", joints=JOINTS, home=HOME)


def test_joints_may_have_any_names(tmp_path, arm):
    """Those of the parts that are added to the file, too."""
    names = ("hand_x", "hand_x_", "hand", "origin", "obstacle_0", "a/b")
    changes = [
        (f'joint name="{joint}"', f'joint name="{name}"') for joint, name in zip(JOINTS, names, strict=True)
    ]
    path = written(tmp_path / "arm.xml", *changes)
    other = load_arm(path, hand_site="hand", joints=names, home=HOME, velocity_limit=np.pi)
    outcomes = []
    for each in (arm, other):
        env = gym.make("viapoint/Obstacles-v0", arm=each)
        env.reset(seed=0)
        outcomes.append(env.step(np.zeros(4))[-1])
    assert outcomes[0] == outcomes[1]


def test_a_record_that_json_took_apart_is_refused(arm):
    spec = EnvSpec.from_json(gym.make("viapoint/Obstacles-v0", arm=arm).spec.to_json())
    with pytest.raises(TypeError):
        gym.make(spec)


@pytest.mark.parametrize("thing", [3, None, "panda", Arm])
def test_only_records_are_registered(thing):
    known = dict(ARMS)
    with pytest.raises(TypeError):
        register_arm(thing)
    assert known == ARMS


def test_goals_out_of_reach_and_obstacles_at_the_start_are_refused(arm):
    env = gym.make("viapoint/Obstacles-v0", arm=arm)
    start, goal = np.array(arm.workspace)
    touching = np.concatenate((start + 0.01, np.zeros(3), [0.03]))
    for far, obstacles in ((goal + 0.3, []), (goal, touching[None])):
        with pytest.raises(ValueError):
            env.reset(options={"start": start, "goal": far, "obstacles": obstacles})


@pytest.mark.skipif(find_spec("gymnasium_robotics") is None, reason="gymnasium-robotics is not installed")
def test_the_fetch_of_gymnasium_robotics():
    assets = Path(find_spec("gymnasium_robotics").submodule_search_locations[0]) / "envs" / "assets"
    path = assets / "fetch" / "reach.xml"
    for missing in ("joint_range", "torque_limit"):
        with pytest.raises(ValueError):
            load_arm(path, **{**FETCH, missing: None})
    moves_as_planned(load_arm(path, **FETCH), error=2e-3)


def test_the_examples_of_the_page_run(monkeypatch):
    monkeypatch.chdir(DOCS.parent)
    page, names = (DOCS / "bring-your-arm.md").read_text(encoding="utf-8"), {}
    for example in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        if "TrainConfig" not in example:
            exec(example, names)
    np.testing.assert_allclose(names["points"], [[0.45, 0.0, 0.2], [0.45, 0.3, 0.2]], atol=1e-6)


def test_by_default_capsules_reach_25_mm_beyond_geoms_at_most(arm):
    rows = {row["arm"]: row for row in json.loads((DOCS / "arm-contacts.json").read_text(encoding="utf-8"))}
    assert len(arm.shape) == rows["ur5e"]["capsules"]
    assert 1e3 * max(each.excess for each in arm.shape) == pytest.approx(rows["ur5e"]["excess"], abs=0.05)
    assert max(row.get("excess", 0.0) for row in rows.values()) <= 25.0
    assert {row["wrong"] for row in rows.values()} == {0}


def test_an_arm_is_known_by_its_name_once_it_is_registered(arm, monkeypatch):
    monkeypatch.delitem(ARMS, arm.name, raising=False)
    with pytest.raises(ValueError, match="register_arm registers an arm of your own"):
        gym.make("viapoint/Obstacles-v0", arm=arm.name)
    monkeypatch.setitem(ARMS, arm.name, arm)
    register_arm(arm)
    assert gym.make("viapoint/Obstacles-v0", arm=arm.name).unwrapped.task.arm is arm
    with pytest.raises(ValueError):
        register_arm(ur5e(velocity_limit=1.0))


def test_a_urdf_file_is_read_as_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["base", "upper", "lower", "wrist_1", "wrist_2", "wrist_3", "tool"]
    axes = ["0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0"]
    heights = [0.0, 0.1, 0.4, 0.35, 0.1, 0.1]
    inertia = '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
    tube = '<origin xyz="0 0 .1"/><geometry><cylinder radius=".03" length=".2"/></geometry>'
    links = [f'<link name="{name}">{inertia}<collision>{tube}</collision></link>' for name in names]
    joints = [
        f'<joint name="joint_{i}" type="revolute"><parent link="{names[i]}"/><child link="{names[i + 1]}"/>'
        f'<origin xyz="0 0 {heights[i]}"/><axis xyz="{axes[i]}"/>'
        '<limit lower="-3" upper="3" velocity="3" effort="80"/></joint>'
        for i in range(6)
    ]
    Path("my_arm.urdf").write_text(f'<robot name="r">{"".join(links + joints)}</robot>')
    page = (DOCS / "bring-your-arm.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    exec(snippet, {})
    order, home = [f"joint_{i}" for i in range(6)], (0.0, 0.3, 1.2, 1.6416, 0.0, 0.0)
    arm = load_arm("my_arm.xml", hand_site="hand", joints=order, home=home)
    assert arm.joint_names == tuple(order)
    np.testing.assert_allclose(arm.torque_limit, 80.0)
