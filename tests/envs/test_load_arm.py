"""Arms that are loaded from MJCF files are those of the file."""

import dataclasses
import itertools
import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import trimesh
from helpers import UR5E, check_contact_implies_overlap

from viapoint.envs.arms import load
from viapoint.envs.arms.choices import KNOWN_VELOCITIES, known_limits
from viapoint.envs.arms.kinematics import forward, sphere_centres, torques
from viapoint.envs.arms.load import load_arm, read_model
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.arms.spheres import overlapping
from viapoint.envs.arms.stored import write_arm
from viapoint.envs.geometry.clearance import row_clearances
from viapoint.envs.geometry.obstacles import pack

TEXT = UR5E.read_text(encoding="utf-8")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
HOME = (0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28)


# An arm of two hinges with vertical axes that point up or down
TWO_LINKS = """<mujoco><worldbody><body><joint name="s" axis="0 0 {}" range="-115 115"/>
<geom type="capsule" fromto=".05 0 0 .27 0 0" size=".02"/><body pos=".3 0 0">
<joint name="e" axis="0 0 {}" range="6 143"/><geom type="capsule" fromto=".05 0 0 .25 0 0" size=".02"/>
<site name="tool" pos=".25 0 0"/></body></body></worldbody></mujoco>"""


def ur5e(file=TEXT, **changes):
    arguments = {"tool": "hand", "joints": JOINTS, "home": HOME, "velocity_limit": np.pi, "tolerance": 0.1}
    return load_arm(file, **{**arguments, **changes})


def changed(*pairs, text=TEXT):
    """Text of a file with some words replaced, which must be there."""
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def without(pattern, other=""):
    """Text of the file with what matches a pattern replaced, which must be there."""
    text, number = re.subn(pattern, other, TEXT)
    assert number
    return text


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Folder of stored arms, which is empty at first."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="module")
def arm():
    return ur5e(tolerance=0.02)


def check_it_is_the_arm_of(text, arm):
    """Hand and torques are those of the file's model, and spheres contain its boxes and the centres of its geoms."""
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    address = [int(model.joint(name).qposadr[0]) for name in arm.joint_names]
    freedom = [int(model.joint(name).dofadr[0]) for name in arm.joint_names]
    corners = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    for joints in rng.uniform(*arm.joint_range.T, (20, len(address))):
        rates, changes = rng.normal(size=(2, len(address)))
        data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
        data.qpos[address], data.qvel[freedom], data.qacc[freedom] = joints, rates, changes
        mujoco.mj_inverse(model, data)
        position, axes = forward(arm.chain, joints)
        np.testing.assert_allclose(position, data.site("hand").xpos, atol=1e-9)
        np.testing.assert_allclose(axes, data.site("hand").xmat.reshape(3, 3), atol=1e-9)
        if len(address) == model.nv:
            needed = torques(arm.chain, joints, rates, changes)
            np.testing.assert_allclose(needed, data.qfrc_inverse + data.qfrc_constraint, rtol=1e-3, atol=1e-2)
        centres = sphere_centres(arm.chain, arm.spheres, joints)
        for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
            is_box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
            reach = is_box * corners * model.geom_size[geom]
            points = data.geom_xpos[geom] + reach @ data.geom_xmat[geom].reshape(3, 3).T
            apart = np.linalg.norm(points[:, None] - centres, axis=-1) - arm.spheres.radius
            assert apart.min(axis=1).max() < 1e-5


def test_it_is_the_arm_of_the_file(arm):
    check_it_is_the_arm_of(TEXT, arm)
    assert arm.joint_names == JOINTS
    assert arm.excess <= 0.03
    np.testing.assert_allclose(arm.torque_limit, [150.0] * 3 + [28.0] * 3)
    check_contact_implies_overlap(arm)


@pytest.mark.parametrize("left_out", [None, 3])
def test_joints_of_one_body_move_it_one_after_another(tmp_path, left_out):
    joints = [name for i, name in enumerate(JOINTS) if i != left_out]
    home = [position for i, position in enumerate(HOME) if i != left_out]
    arm = ur5e(SHARED, joints=joints, home=home)
    check_it_is_the_arm_of(SHARED, arm)
    check_contact_implies_overlap(arm)
    write_arm(tmp_path / "arm.xml", arm)
    again = load_arm(tmp_path / "arm.xml")
    assert (again.xml, again.left_out) == (arm.xml, arm.left_out)
    assert ("forearm", "wrist_2", "consecutive links") in arm.left_out  # as in MuJoCo


def test_its_file_its_text_and_its_specification_are_the_same_arm():
    spec = mujoco.MjSpec.from_string(TEXT)
    same = ur5e(str(UR5E)), ur5e(UR5E), ur5e(), ur5e(spec)
    assert [each.name for each in same] == ["ur5e", "ur5e", "ur5e-like", "ur5e-like"]
    assert all(each.xml == same[0].xml for each in same)
    assert len(spec.joints) == 6  # the specification of the caller is not changed


HAND_OF_TEXT = '<site name="hand" pos="0 0 0.2596"/>'
END = "</worldbody>"


def gripper(number, joint="finger", depth=1):
    """Fingers with joints in a row."""
    finger = [
        f'<body name="{joint}_{{0}}_{k}" pos="0 {{1}} .1"><joint name="{joint}_{{0}}_{k}" axis="1 0 0" '
        'range="-1 1"/><geom size=".01" mass=".01"/>'
        for k in range(depth)
    ]
    text = "".join(finger) + "</body>" * depth
    return "".join(text.format(side, 0.04 * side) for side in range(number))


SHOULDER = '<body name="shoulder" pos="0 0 0.1625">'
CARRIAGE = (
    '<body name="carriage"><joint name="lift" type="slide" axis="0 0.6 0.8" range="0 0.5" damping="3" armature="2" '
    'actuatorfrcrange="-900 900"/><geom type="box" size=".05 .05 .05" mass="2"/>' + SHOULDER
)


@pytest.mark.parametrize("moves", [False, True])
def test_a_slide_is_fixed_as_in_the_keyframe_or_is_a_joint(moves):
    qpos = " ".join(map(str, (0.2, *HOME)))
    key = f'</worldbody><keyframe><key qpos="{qpos}"/></keyframe>'
    text = changed((SHOULDER, CARRIAGE), ("</body>\n  </worldbody>", "</body></body>" + key))
    names = ("lift", *JOINTS) if moves else JOINTS
    home = (0.2, *HOME) if moves else HOME
    arm = ur5e(text, joints=names, home=home, origin=(0.0, 0.0, 0.0))
    assert arm.chain.sliding.tolist() == ([True] if moves else []) + [False] * 6
    assert "carriage" in arm.group_names
    check_it_is_the_arm_of(text, arm)


def test_pairs_that_the_file_does_not_let_collide_are_left_out():
    bits = ('size="0.055" mass="8.058"', 'size="0.055" mass="8.058" contype="2" conaffinity="2"')
    exclude = ("</worldbody>", '</worldbody><contact><exclude body1="shoulder" body2="wrist_3"/></contact>')
    arm = ur5e(changed(bits, exclude))
    out = {frozenset(pair[:2]) for pair in arm.left_out if pair.reason == "excluded in the file"}
    others = ("base_0", "wrist_1", "wrist_2", "wrist_3")
    assert out == {frozenset(("shoulder", "wrist_3")), *(frozenset(("upper_arm", each)) for each in others)}


def test_joints_and_bodies_may_have_any_names(arm):
    names = ("hand", "obstacle_0", "origin", "world", "a/b", "meshes")
    pairs = [(f'joint name="{old}"', f'joint name="{new}"') for old, new in zip(JOINTS, names, strict=True)]
    other = ur5e(changed(*pairs, ('body name="wrist_1"', 'body name="obstacle_0"')), joints=names)
    np.testing.assert_array_equal(other.hand(HOME), arm.hand(HOME))
    assert other.compile(2).nbody == arm.compile(2).nbody


@pytest.mark.parametrize(("gap", "reason"), [(0.004, "always near"), (-0.001, "in contact at home")])
def test_bodies_that_never_touch_or_touch_at_home_are_left_out(gap, reason):
    arm = three(gap=gap)
    assert [pair[:2] for pair in arm.left_out if reason in pair.reason] == [("a", "c")]


POST = '<geom type="cylinder" size=".02 .5" pos="0 .25 .3"/>'


@pytest.mark.parametrize(
    ("in_world", "on_base", "name"),
    [
        (POST, "", "base_0"),
        (POST, '<body name="base_0"/>', "base_0_"),
        ("", f'<body name="post">{POST}</body>', "post"),
    ],
)
def test_the_first_link_is_compared_with_the_base_except_with_bodies_that_carry_it(in_world, on_base, name):
    text = f"""
    <mujoco><compiler angle="radian"/><worldbody>{in_world}
      <body name="base">{on_base}<geom type="cylinder" size=".05 .3"/>
        <body name="upper" pos="0 0 .3"><joint name="one" axis="0 0 1" range="-2 2"/>
          <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/>
          <body name="fore" pos=".5 0 0"><joint name="two" axis="0 0 1" range="-2 2"/>
            <geom type="capsule" fromto="0 0 0 .1 0 0" size=".03" mass="1"/>
          </body>
        </body>
      </body>
    </worldbody></mujoco>"""
    arm = load_arm(text, velocity_limit=1.0, torque_limit=10.0)
    names = arm.group_names
    assert [(names[a], names[b]) for a, b in arm.spheres.pairs] == [(name, "upper")]
    assert ("base", "upper", "consecutive links") in arm.left_out
    check_contact_implies_overlap(arm)


RAIL = """
    <mujoco><compiler angle="radian"/><worldbody><body name="rail" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1"/><geom type="box" size=".1 .1 .05" mass="5"/>
      <body name="carriage" pos="0 0 -.1"><joint name="lift" type="slide" axis="0 0 1" range="-.5 0"/>
        <geom type="box" size=".05 .05 .05" mass="2"/>
        <body name="mast" pos="-.09 .11 0">{}<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".2"/></body>
        <body name="upper" pos=".1 0 -.1"><joint name="shoulder" axis="0 0 1" range="-2.6 2.6"/>
          <geom type="capsule" fromto=".1 0 0 .3 0 0" size=".03" mass="1"/>
          <body name="fore" pos=".35 0 0"><joint name="elbow" axis="0 0 1" range="-2.6 2.6"/>
            <geom type="capsule" fromto=".1 0 0 .3 0 0" size=".03" mass="1"/>{}
    </body></body></body></body></worldbody></mujoco>"""
"""Arm of two hinges on a carriage, beside which a mast stands that may turn."""


@pytest.mark.parametrize("camera", ["", '<joint name="pan" axis="0 0 1" range="-1 1"/>'])
@pytest.mark.parametrize("tool", ["", '<site name="tcp" pos=".3 0 0"/>'])
def test_what_stands_beside_an_arm_on_a_carriage_is_no_part_of_it_and_no_finger(camera, tool):
    arm = load_arm(RAIL.format(camera, tool), velocity_limit=1.0, torque_limit=500.0)
    assert arm.joint_names == ("x", "lift", "shoulder", "elbow")
    names = arm.group_names
    assert {"mast", "upper"} in [{names[a], names[b]} for a, b in arm.spheres.pairs]


def near_arm(gap):
    """Three links, of which the third has a box at a distance from a ball of the first."""
    return f"""
    <mujoco><worldbody>
      <body name="a"><joint name="one" axis="0 0 1" range="-1 1"/><geom size="0.05" mass="1"/>
        <body name="b" pos="0 0 0.5"><joint name="two" axis="1 0 0" range="-1 1"/><geom size="0.05" mass="1"/>
          <body name="c"><joint name="three" axis="0 1 0" range="-1 1"/>
            <geom type="box" size="0.02 0.02 0.02" pos="0 0 {-0.5 + 0.05 + 0.02 + gap}" mass="0.1"/>
            <site name="tool" pos="0 0 0.2"/>
          </body>
        </body>
      </body>
    </worldbody></mujoco>"""


THREE = {"tool": "tool", "joints": ("one", "two", "three"), "velocity_limit": 1.0, "torque_limit": 1e3}


def three(*pairs, gap=0.02, **changes):
    """Return the arm of three links with some words of its file replaced."""
    return load_arm(changed(*pairs, text=near_arm(gap)), **{**THREE, **changes})


def test_spheres_leave_room_between_bodies_that_pass_close_by_one_another():
    """A plate sweeps over a box and tilts; apart at home, spheres as large as there touch elsewhere."""
    text = """
    <mujoco><compiler angle="radian"/><worldbody><body name="base"><geom type="box" size=".4 .4 .1"/>
      <body name="turn" pos="0 0 .12"><joint name="one" axis="0 0 1" range="-3 3"/><geom size=".02" mass="1"/>
        <body name="plate" pos="0 0 .03"><joint name="two" axis="0 1 0" range="-.1 .1"/>
          <geom type="box" size=".2 .1 .02" pos=".2 0 0" mass="1"/>
    </body></body></body></worldbody></mujoco>"""
    arm = load_arm(text, velocity_limit=1.0, torque_limit=50.0)
    drawn = np.random.default_rng(1).uniform(*arm.joint_range.T, (300, 2))
    apart = 0.03 - 0.4 * np.sin(drawn[:, 1]) > 0.015  # [m]
    assert overlapping(arm.chain, arm.spheres, drawn)[apart].mean() < 0.05


def test_two_tools_side_by_side_on_a_wrist_are_refused():
    """Where both are in one place, it is one tool."""
    two = '<site name="left_tcp" pos="0 0.1 0.1"/><site name="right_tcp" pos="0 -0.1 0.1"/>'
    with pytest.raises(ValueError, match="left_tcp, right_tcp; name one with tool="):
        load_arm(changed((HAND_OF_TEXT, two)))
    assert "tool: 'left_tcp'" in load_arm(changed((HAND_OF_TEXT, two.replace("-", "")))).notes
    # Where one carries the other, the outer one is taken.
    outer = '<body name="arm_tool" pos="0 0 .1"><body name="hand_tool" pos="0 0 .1"/></body>'
    with pytest.warns(UserWarning, match="'hand_tool', but could be arm_tool"):
        load_arm(changed((HAND_OF_TEXT, outer)))


def test_a_file_may_hold_velocity_limits():
    custom = '<custom><numeric name="velocity_limit" data="1 2 3 4 5 6"/></custom><worldbody>'
    arm = ur5e(changed(("<worldbody>", custom)), velocity_limit=None)
    np.testing.assert_array_equal(arm.velocity_limit, np.arange(1.0, 7.0))


ONE = TEXT[TEXT.index(SHOULDER) : TEXT.rindex(END)]
LEFT = re.sub(r'name="(\w+)"', r'name="left_\1"', ONE)
TWO = TEXT.replace(END, f'<body name="left" pos="0 1 0">{LEFT}</body>{END}')
"""Two arms side by side."""
SLIDING = f'<body><joint type="slide" limited="false"/>{HAND_OF_TEXT}<geom size=".01"/></body>'
# The fourth joint moves the body of the fifth one
SHARED = without(
    r'<joint name="wrist_1" class="wrist"/>((?s:.*?))<joint name="wrist_2"',
    r'\1<joint name="wrist_1" class="wrist" axis="0.6 0 0.8" pos=".02 0 .01"/><joint name="wrist_2"',
)
REFUSED = [
    ({"file": 5}, TypeError), ({"file": None}, TypeError), ({"file": b"arm.xml"}, TypeError),
    ({"file": ""}, ValueError), ({"file": "none.xml"}, ValueError),
    ({"tool": "tool"}, ValueError), ({"name": 5}, ValueError), ({"name": ""}, ValueError),
    *[({"joints": joints}, ValueError) for joints in (
        5, "elbow", JOINTS[:1], (*JOINTS[:5], "wrist_4"), (*JOINTS[:5], JOINTS[0]), (JOINTS[1], JOINTS[0], *JOINTS[2:]),
    )],
    ({"file": SHARED, "joints": (*JOINTS[:3], "wrist_2", "wrist_1", "wrist_3")}, ValueError),
    *[({"home": home}, ValueError) for home in (HOME[:3], (7.0, *HOME[1:]), "up", (np.nan, *HOME[1:]))],
    *[({"origin": origin}, ValueError) for origin in ("base", (0, 0), (0.0, 0.0, np.nan))],
    *[({"joint_range": ranges}, ValueError) for ranges in (
        {}, [(-np.inf, np.inf)] * 6, [(0.0, 1.0), (0.0,)], [(1.0, -1.0)] * 6,
    )],
    *[({"velocity_limit": limit}, ValueError) for limit in ({}, 0.0, -1.0, [1.0, 2.0])],
    *[({"torque_limit": limit}, ValueError) for limit in (-1.0, [1e-3] * 6, "strong")],
    *[({"tolerance": tolerance}, ValueError) for tolerance in (0.0, "fine", np.nan)],
    ({"file": near_arm(1e-4), "home": None, **THREE}, ValueError),  # bodies too close at home
    ({"file": near_arm(0.02).replace('pos="0 0 0.5"', 'pos="0 0 500"'), "home": None, **THREE}, ValueError),
    ({"file": "<?xml version='1.0'?><robot name='r'><link name='a'/></robot>"}, ValueError),  # text of a URDF
    ({"file": changed((END, END + '<custom><numeric name="velocity_limit" data="3 3"/></custom>')),
      "velocity_limit": None}, ValueError),
    *[({"file": TWO, "base": base, "tool": None, "joints": None}, ValueError) for base in (None, "right")],
    ({"file": TWO.replace("left_hand", "left_pinch"), "tool": None, "joints": None}, ValueError),
    ({"file": changed((HAND_OF_TEXT, SLIDING)), "tool": None, "joints": None, "home": None}, ValueError),  # no limits
    *[({"file": without(pattern, other)}, ValueError) for pattern, other in (
        ('<joint name="elbow" range', '<joint name="elbow" type="ball" range'), (r"<geom[^>]*/>", ""),
        (r"<geom type[^>]*/>", ""),  # bodies without mass
        (r"(?s).{20}$", ""),  # no XML
    )],
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "error"), REFUSED)
def test_invalid_arguments_are_refused(arguments, error):
    with pytest.raises(error):
        ur5e(**arguments)


def test_nothing_but_the_file_is_needed(arm):
    alone = load_arm(UR5E, home=HOME)
    assert alone.joint_names == JOINTS
    np.testing.assert_array_equal(alone.hand(HOME), arm.hand(HOME))
    np.testing.assert_array_equal(alone.velocity_limit, 3.14)  # a well-known arm
    assert any(note.startswith("tool: 'hand'") for note in alone.notes)
    assert "shoulder_pan: -6.283 to 6.283 rad, at most 3.14 rad/s and 150 N m" in alone.report()
    assert arm_of(UR5E) is arm_of(str(UR5E))
    searched = load_arm(UR5E)
    own = row_clearances(arm.chain, arm.spheres, searched.home[None], pack([[]]), 1.0)[1]
    assert own[0] > 0.0


@pytest.mark.parametrize(
    ("tool", "where"),
    [("hand", None), ("wrist_3", (0.0, 0.0, 0.0)), (("wrist_3", (0.0, 0.1, 0.2)), (0.0, 0.1, 0.2))],
)
def test_tools_are_sites_bodies_or_points(arm, tool, where):
    other = load_arm(UR5E, tool=tool, home=HOME)
    model = mujoco.MjModel.from_xml_path(str(UR5E))
    data = mujoco.MjData(model)
    data.qpos[:] = HOME
    mujoco.mj_kinematics(model, data)
    body = data.body("wrist_3")
    expected = arm.hand(HOME) if where is None else body.xpos + body.xmat.reshape(3, 3) @ where
    np.testing.assert_allclose(other.hand(HOME), expected, atol=1e-5)


def test_a_frame_alone_on_the_last_link_is_the_tool():
    plate = '<body name="plate" pos="0 0 0.1"/><body><geom size="0.01"/></body>'
    arm = three(('<site name="tool" pos="0 0 0.2"/>', plate), tool=None)
    assert arm.notes[0] == "tool: \"the frame of 'plate'\""
    sited = three(('<site name="tool"', '<body name="plate"/><site name="tip"'), tool=None)
    assert sited.notes[0] == "tool: \"the site 'tip' of 'c'\""


ONLY_SEEN = 'contype="0" conaffinity="0"'
BALL = '<geom size=".02" mass=".1" {1}/>'


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("geoms", "seen", "away"),
    [
        ('<geom type="capsule" fromto="0 0 0 .03 {0} .02" size=".01" mass=".1" {1}/>', "", 0.21),
        ('<geom type="capsule" fromto="0 0 0 .03 {0} .02" size=".01" mass=".1" {1}/>', ONLY_SEEN, 0.21),
        ('<geom type="box" pos="0 {0} 0" euler="0 0 45" size=".1 .1 .02" mass=".1" {1}/>', "", 0.341421),
        (BALL + '<body pos="0 {0} 0"><geom size=".03" mass=".1" {1}/></body>', "", 0.23),
        (BALL + f'<geom pos="0 1 0" size=".1" mass="0" {ONLY_SEEN}/>', "", 0.0),
    ],
)
def test_the_tip_of_the_last_link_is_where_its_geoms_end_and_is_mirrored_with_them(geoms, seen, away, side):
    geoms = geoms.format(0.2 * side, seen)
    text = re.sub(r'(?s)<geom type="box".*?<site[^>]*/>', geoms, near_arm(0.02))
    arm = load_arm(text, **{**THREE, "tool": None})
    np.testing.assert_allclose(arm.hand(np.zeros(3)), (0.0, side * away, 0.5), atol=1e-6)
    sign = "-" if side < 0.0 else ""
    tip = f"the tip of 'c', {away:.3g} m along {sign}y of its frame" if away else "the frame of 'c'"
    assert arm.notes[0] == f'tool: "{tip}"'


def test_a_frame_between_fingers_is_the_tool():
    finger = (
        '<body pos="{0} 0 .1"><joint type="slide" axis="{0} 0 0" range="0 .02"/><geom size=".01"/></body>'
    )
    hand = f'<body name="flange" pos="0 0 .07"/>{finger.format(0.03)}{finger.format(-0.03)}'
    text = re.sub(r'<site name="tool"[^>]*/>', hand, near_arm(0.02))
    arm = load_arm(text, **{**THREE, "tool": None, "joints": None})
    np.testing.assert_allclose(arm.hand(np.zeros(3)), (0.0, 0.0, 0.57), atol=1e-9)
    assert arm.joint_names == THREE["joints"]


def test_joints_without_names_get_some_and_those_that_follow_others_are_told():
    nameless = three(*((f'joint name="{name}"', "joint") for name in THREE["joints"]), joints=None)
    assert nameless.joint_names == ("unnamed_0", "unnamed_1", "unnamed_2")
    equality = '<equality><joint joint1="three" joint2="two" polycoef="0 -1 0 0 0"/></equality></mujoco>'
    with pytest.warns(UserWarning, match="three follows"):
        three(("</mujoco>", equality))


def damped(damping):
    """Arm whose second joint is damped."""
    return three(('name="two"', f'name="two" damping="{damping}"'))


def test_damping_is_that_of_the_file_unless_no_motor_could_overcome_it():
    with pytest.warns(UserWarning, match="damping"):
        arm = damped(1e11)
    np.testing.assert_array_equal(arm.chain.damping, 0.0)
    np.testing.assert_array_equal(damped(2e3).chain.damping, (0.0, 2e3, 0.0))
    much = damped(9)  # returns as fast as others
    rate = much.stiffness / (much.damping + much.chain.damping)
    np.testing.assert_allclose(rate, 25.0)  # half of the servos' natural frequency, [1/s]


@pytest.mark.parametrize(
    ("name", "known"), [("KUKA iiwa_14", "iiwa14"), ("fr3v2", "fr3"), ("z12", None), ("sandpiper", None)]
)
def test_well_known_arms_are_known_by_whole_words(name, known):
    for number in (6, 7):
        found = known_limits(KNOWN_VELOCITIES, name, number)
        wanted = KNOWN_VELOCITIES[known] if known else ()
        assert (found is None) == (len(wanted) != number)


def test_limits_that_the_file_lacks_are_chosen_and_told():
    with pytest.warns(UserWarning, match="torque limits"):
        arm = ur5e(re.sub(r' actuatorfrcrange="[^"]*"', "", TEXT))
    weight = np.abs(torques(arm.chain, np.array(HOME), np.zeros(6), np.zeros(6)))
    assert (arm.torque_limit > 2.0 * weight).all()
    endless = ur5e(TEXT.replace(' range="-6.2832 6.2832"', ' limited="false"'))
    assert np.allclose(endless.joint_range[0], (-np.pi, np.pi), atol=1e-5)
    assert any("continuous" in note for note in endless.notes)


ON_PEDESTAL = """
    <mujoco><option><flag gravity="disable"/></option><worldbody>
      <geom type="box" size=".1 .1 {0}" pos="0 0 {0}"/>
      <body name="turret" pos="0 0 {1}"><joint name="a" axis="0 0 1" limited="false"/>
        <inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 1e-9"/><geom type="cylinder" size=".04 .1" pos="0 0 .1"/>
        <body pos="0 0 .2"><joint name="b" axis="0 1 0" range="-90 90"/>
          <geom type="capsule" fromto="0 0 .05 0 0 .3" size=".02" mass="1"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("half", [0.05, 0.1, 0.15])
def test_an_arm_of_rods_on_a_pedestal_loads_wherever_its_first_joint_is(half):
    names = np.array(["a", "b"])
    text, limits = ON_PEDESTAL.format(half, 2.0 * half), {"velocity_limit": 1.0, "torque_limit": 9.0}
    arm = load_arm(text, joints=names, home=(7.0, 0.5), **limits)
    assert ("base_0", "turret", "in contact at home") in arm.left_out  # whatever the rounding error is
    np.testing.assert_allclose(arm.home, (7.0 - 2.0 * np.pi, 0.5))
    assert not torques(arm.chain, arm.home, np.zeros(2), np.zeros(2)).any()  # there is no gravity
    assert {type(name) for name in arm.joint_names} == {str}


def test_bodies_that_never_touch_are_left_out_and_others_are_not(arm):
    """The geoms of the file decide, as MuJoCo sees them, not the spheres around them."""
    model = mujoco.MjModel.from_xml_string(TEXT)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    places = [model.joint(name).qposadr[0] for name in JOINTS]
    geoms = {"base_0": []} | {model.body(body).name: [] for body in range(1, model.nbody)}
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        body = int(model.geom_bodyid[geom])
        geoms[model.body(body).name if body else "base_0"].append(int(geom))
    never = [pair[:2] for pair in arm.left_out if pair.reason.startswith("in contact in none")]
    names = arm.group_names
    compared = {(names[a], names[b]) for a, b in arm.spheres.pairs}
    assert never
    assert not compared & set(never)
    touched = set()
    for joints in rng.uniform(*arm.joint_range.T, (4_000, 6)):
        data.qpos[places] = joints
        mujoco.mj_kinematics(model, data)
        for pair in never + list(compared - touched):
            some = itertools.product(geoms[pair[0]], geoms[pair[1]])
            if any(mujoco.mj_geomDistance(model, data, *each, 0.01, None) <= 0.0 for each in some):
                touched.add(pair)
    assert touched == compared


URDF = """<robot name="crane">
  <link name="base"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="post"/><origin xyz="0.1 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.4" effort="900" velocity="0.3"/></joint>
  <link name="post"><inertial><mass value="3"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><cylinder radius="0.04" length="0.2"/></geometry></collision></link>
  <joint name="turn" type="continuous"><parent link="post"/><child link="boom"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 0 1"/><limit effort="80" velocity="1.5"/></joint>
  <link name="boom"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/boom.dae"/></geometry></visual>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.06 0.06"/></geometry></collision></link>
  <joint name="tilt" type="revolute"><parent link="boom"/><child link="wrist"/><origin xyz="0.4 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="50" velocity="2"/></joint>
  <link name="wrist"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.1 0 0"/>
      <geometry><mesh filename="package://crane_description/meshes/wrist.obj"/></geometry></collision></link>
  <joint name="mount" type="fixed"><parent link="wrist"/><child link="tool0"/><origin xyz="0.25 0 0.02"/></joint>
  <link name="tool0"/>
</robot>"""


@pytest.fixture
def crane(tmp_path):
    """Folder of a package with a URDF and a mesh."""
    package = tmp_path / "crane_description"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    trimesh.creation.box(bounds=((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))).export(package / "meshes" / "wrist.obj")
    return package


def written(folder, *pairs):
    """Path of the URDF with some words replaced."""
    path = folder / "urdf" / "crane.urdf"
    path.write_text(changed(*pairs, text=URDF))
    return path


def test_urdf_files_are_arms(crane):
    arm = load_arm(written(crane))
    assert arm.name == "crane"
    assert arm.joint_names == ("lift", "turn", "tilt")
    np.testing.assert_array_equal(arm.velocity_limit, (0.3, 1.5, 2.0))
    np.testing.assert_array_equal(arm.torque_limit, (900.0, 80.0, 50.0))
    np.testing.assert_allclose(arm.joint_range, [(0.0, 0.4), (-np.pi, np.pi), (-1.0, 2.0)], atol=1e-5)
    assert "wrist" in arm.group_names
    assert "lift: 0 to 0.4 m, at most 0.3 m/s and 900 N" in arm.report()
    with pytest.warns(UserWarning, match=r"greater than the arm's own, \[0.3\], of lift"):
        load_arm(written(crane), velocity_limit=1.0)
    joints = (0.2, np.pi / 2, 0.0)
    np.testing.assert_allclose(arm.hand(joints), (0.1, 0.65, 0.52), atol=1e-5)
    np.testing.assert_allclose(arm.hand((0.0, 0.0, np.pi / 2)), (0.52, 0.0, 0.05), atol=1e-5)


def test_joints_that_carry_no_weight_get_torques_that_move_the_arm(crane):
    path = written(crane, *((f' effort="{limit}"', "") for limit in (900, 80, 50)))
    with pytest.warns(UserWarning, match="at least enough for 5 rad/s"):
        arm = load_arm(path)
    np.testing.assert_allclose(arm.torque_limit[1], 5.0 * arm.stiffness[1] / 50.0**2, rtol=1e-3)


def test_the_weight_of_a_slide_is_that_within_its_range():
    text = """
    <mujoco><worldbody><body><joint name="tilt" axis="0 1 0" range="-90 90"/><geom size=".05" mass="1"/>
      <body><joint name="reach" type="slide" axis="1 0 0" range="0 .1"/><geom size=".05" pos=".3 0 0" mass="1"/>
    </body></body></worldbody></mujoco>"""
    with pytest.warns(UserWarning, match="torque limits"):
        arm = load_arm(text, velocity_limit=1.0)
    assert 0.9 < arm.torque_limit[0] / (3.0 * 9.81 * 0.4) <= 1.0


def test_limits_hold_masses_that_the_file_lacks(crane):
    """Also in other configurations than home, in which the joint bears nothing."""
    path = written(crane, ('effort="50"', 'effort="0.01"'))
    path.write_text(re.sub(r"<inertial>.*?</inertial>", "", path.read_text(), flags=re.DOTALL))
    with pytest.warns(UserWarning, match="tilt"):
        arm = load_arm(path, home=(0.0, 0.0, 0.5 * np.pi))
    weighed = np.random.default_rng(0).uniform((0.0, -3.0, -1.0), (0.4, 3.0, 2.0), (300, 3))
    weight = np.abs(torques(arm.chain, weighed, np.zeros(1), np.zeros(1))).max(axis=0)
    assert (weight <= arm.torque_limit).all()


LIMIT = '<limit lower="-1" upper="2" effort'
MESH = "package://crane_description/meshes/wrist.obj"


@pytest.mark.parametrize(
    ("limit", "found"),
    [
        ('<limit upper="2" effort', (0.0, 2.0)),  # what is missing is 0
        (f'<limit lower="{-np.pi!r}" upper="{np.pi!r}" effort', (-np.pi, np.pi)),
    ],
)
def test_limits_of_a_urdf_are_kept(crane, limit, found):
    assert load_arm(written(crane, (LIMIT, limit))).joint_range[2].tolist() == list(found)


@pytest.mark.parametrize("limit", ['<limit lower="1" upper="1" effort', "<limit effort"])
def test_a_joint_without_limits_is_told(crane, limit):
    with pytest.warns(UserWarning, match="joint tilt"):
        assert load_arm(written(crane, (LIMIT, limit))).continuous == ("turn", "tilt")


def test_ranges_without_end_in_practice_are_none(crane):
    """As for a mobile base: to check a movement of a thousand kilometres takes forever."""
    wide = '<limit lower="-1e6" upper="1e6" effort'
    arm = load_arm(written(crane, (LIMIT, wide), ('<limit lower="0" upper="0.4" effort', wide)))
    assert (arm.joint_names, arm.continuous) == (("turn", "tilt"), ("turn", "tilt"))
    with pytest.raises(ValueError, match="joint_range"):
        load_arm(written(crane), joint_range=[(0.0, 0.4), (-1.0, 1.0), (-1e6, 1e6)])


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (LIMIT, '<limit lower="2" upper="1" effort', "tilt"),
        (LIMIT, '<limit lower="low" upper="2" effort', "low"),
        ('radius="0.04"', 'radius="thin"', "thin"),
        ('radius="0.04" ', "", "post"),
        ('xyz="0.4 0 0"', 'xyz="0.4 0 nan"', "tilt"),
        ('xyz="0.4 0 0"', 'xyz="0.4 0"', "tilt"),
        ('"tilt" type="revolute"', '"tilt" type="Revolute"', "tilt"),
        ('mass value="3"', 'mass value="heavy"', "heavy"),
        (MESH, "package://elsewhere/wrist.obj", "elsewhere"),
        (MESH, "missing.stl", "missing.stl"),
        (URDF, "<robot", ""),
        ("</robot>", "<a:b></robot>", ""),
        (URDF, "<mujoco/>", ""),
        (URDF, '<robot name="x"><include/></robot>', ""),  # of xacro
        # Links that are no tree
        ('<link name="tool0"/>', '<link name="wrist"/>', "wrist"),
        ('<joint name="tilt"', '<joint name="turn"', "turn"),
        ('<parent link="wrist"/>', '<parent link="hand"/>', "hand"),
        ('<parent link="wrist"/>', "", "mount"),
        ('<child link="tool0"/>', '<child link="boom"/>', "boom"),
        ('<parent link="wrist"/><child link="tool0"/>', '<parent link="wrist"/><child link="base"/>', "base"),
    ],
)
def test_urdf_files_at_fault_are_refused_and_the_fault_is_named(crane, old, new, named):
    with pytest.raises(ValueError, match=f"crane.urdf.*{named}"):
        load_arm(written(crane, (old, new)))


@pytest.mark.parametrize(
    ("robot", "files", "note"),
    [
        ("crane", ["urdf/crane.srdf"], "those of"),
        ("crane", ["srdf/any.srdf"], "those of any.srdf"),
        ("crane", ["srdf/any.srdf", "srdf/other.srdf"], "other.srdf is not used"),
        ("ship", ["urdf/crane.srdf"], "crane.srdf is not used"),
    ],
)
def test_pairs_of_an_srdf_of_the_same_robot_beside_it_are_not_compared(crane, robot, files, note):
    path = written(crane, ('"base"', '"world"'))
    (crane / "srdf").mkdir()
    pairs = "".join(f'<disable_collisions link1="wrist" link2="{link}"/>' for link in ("post", "world"))
    for file in files:
        (crane / file).write_text(f'<robot name="{robot}">{pairs}</robot>')
    arm = load_arm(path)
    for link in ("post", "base_0"):  # a name of MuJoCo's own is changed
        assert ((link, "wrist", "excluded in the file") in arm.left_out) == (note.startswith("those"))
    assert note in "\n".join(arm.notes)


def test_links_of_an_srdf_that_the_urdf_does_not_have_are_told(crane):
    pair = '<disable_collisions link1="wrist" link2="psot"/>'
    (crane / "urdf" / "crane.srdf").write_text(f'<robot name="crane">{pair}</robot>')
    with pytest.warns(UserWarning, match=r"crane\.srdf .* psot$"):
        load_arm(written(crane))


VISUAL = '<visual><geometry><mesh filename="../meshes/{}"/></geometry><material name="red"/></visual>'
RED = '<material name="red"><color rgba="1 0 0 1"/></material></robot>'


def test_visual_geoms_of_a_urdf_are_drawn_and_count_for_nothing_else(crane):
    plain = load_arm(written(crane))
    boxes = [trimesh.creation.box(bounds=((x, 0, 0), (x + 1, 1, 1))) for x in (0, 7)]
    trimesh.Scene(boxes).export(crane / "meshes" / "two.obj")  # MuJoCo reads the first object only
    (crane / "meshes" / "broken.obj").write_text("version https://git-lfs.github.com/spec/v1")
    visuals = VISUAL.format("two.obj") + VISUAL.format("broken.obj")
    collision = '<collision><origin xyz="0.2 0 0"/>'
    alone = '<link name="tool0"/>', f'<link name="tool0">{VISUAL.format("wrist.obj")}</link>'
    path = written(crane, (collision, visuals + collision), ("</robot>", RED), alone)
    arm = load_arm(path)
    assert arm.xml == plain.xml
    model = read_model(path)
    shown = np.flatnonzero(model.geom_group < 3)
    bodies = [model.body(model.geom_bodyid[geom]).name for geom in shown]
    assert bodies == ["base", "post", "boom", "wrist", "tool0"]  # all but two show what collides
    np.testing.assert_array_equal(model.geom_rgba[shown[2]], (1.0, 0.0, 0.0, 1.0))
    assert model.geom_rbound[shown[2]] > 4.0  # all of the file
    path.write_text(path.read_text().replace("1 0 0 1", "red"))
    assert read_model(path).nmesh == 1
    np.testing.assert_equal(parts_of(load_arm(path)), parts_of(arm))


def test_packages_are_looked_for_in_given_folders(crane, tmp_path):
    path = tmp_path / "other" / "crane.urdf"
    path.parent.mkdir()
    path.write_text(URDF.replace("crane_description", "my%20parts"))
    (tmp_path / "store").mkdir()
    crane.rename(tmp_path / "store" / "my parts")
    for packages in ([tmp_path / "store"], tmp_path / "store", str(tmp_path / "store")):
        assert load_arm(path, packages=packages).joint_names == ("lift", "turn", "tilt")
    with pytest.raises(ValueError):
        load_arm(URDF)  # a text has no folder


def test_of_two_arms_one_is_named():
    left = load_arm(TWO, base="left")
    assert left.joint_names[0] == "left_shoulder_pan"
    assert load_arm(TWO, tool="hand").joint_names == JOINTS
    with pytest.raises(ValueError):
        load_arm(TWO, tool="hand", base="left")  # which carries another one


def parts_of(arm):
    """Numbers and texts of an arm."""
    found = dataclasses.asdict(dataclasses.replace(arm, chain=None, spheres=None))
    return {**found, **arm.chain._asdict(), **arm.spheres._asdict()}


def test_the_second_time_an_arm_comes_from_the_cache(cache, monkeypatch):
    changes = {"name": "stored", "velocity_limit": None}
    text = changed(("ur5e-like", "other"))
    with pytest.warns(UserWarning, match="2 rad/s"):
        first = ur5e(text, **changes)
    np.testing.assert_array_equal(first.velocity_limit, 2.0)
    monkeypatch.setattr(load, "_load", None)  # would fail
    with pytest.warns(UserWarning, match="2 rad/s"):
        second = ur5e(text, **changes)
    np.testing.assert_equal(parts_of(second), parts_of(first))
    for other in ({**changes, "home": np.array(HOME) + 1e-9}, {**changes, "tolerance": 0.019}):
        with pytest.raises(TypeError):
            ur5e(text, **other)
    with pytest.raises(TypeError):
        ur5e(text.replace("0.1625", "0.1626"), **changes)


# The last one is that of the joint.
@pytest.mark.parametrize(("control", "force", "found"), [(20, 50, 40.0), (50, 20, 40.0), (900, 900, 150.0)])
def test_the_least_of_the_limits_of_actuator_and_joint_is_the_torque_limit(control, force, found):
    limits = f'ctrlrange="-{control} {control}" forcerange="-{force} {force}"'
    motor = f'<actuator><motor joint="elbow" gear="2" {limits}/></actuator>'
    arm = ur5e(changed((END, END + motor)))
    assert arm.torque_limit[2] == found


def test_what_a_user_hardly_means_is_told():
    folded = (*HOME[:2], 3.1, *HOME[3:])
    with pytest.warns(UserWarning, match="in contact at the given home"):
        ur5e(TEXT, home=folded)
    with pytest.warns(UserWarning, match=r"own, \[3.14"):  # degrees per second
        ur5e(TEXT, velocity_limit=180.0)
    with pytest.warns(UserWarning, match="degrees"):
        ur5e(TEXT, joint_range=[(-170.0, 170.0)] * 6)
    with pytest.warns(UserWarning, match="wall; give them as obstacles"):
        load_arm(changed((END, WALL.format(""))))
    with pytest.warns(UserWarning, match="millimetres"):  # of geoms alone
        three(
            ('geom size="0.05" mass="1"/>\n        <body name="b"', 'geom size="50" mass="1"/><body name="b"')
        )


def test_a_written_arm_is_the_same_arm_and_takes_other_limits(tmp_path):
    slow, path = ur5e(velocity_limit=1.0), tmp_path / "slow.xml"
    write_arm(path, arm_of("planar"))
    np.testing.assert_equal(parts_of(load_arm(path)), parts_of(arm_of("planar")))
    write_arm(path, slow)
    for same in (load_arm(path), load_arm(path.read_text()), arm_of(path)):
        np.testing.assert_equal(parts_of(dataclasses.replace(same, file="")), parts_of(slow))
    with pytest.warns(UserWarning, match="velocity_limit is greater"):
        fast = load_arm(path, velocity_limit=2.0, name="fast")
    assert (fast.name, fast.xml, fast.left_out) == ("fast", slow.xml, slow.left_out)
    np.testing.assert_array_equal(fast.velocity_limit, np.full(6, 2.0))
    np.testing.assert_array_equal(fast.torque_limit, slow.torque_limit)
    for given in ({"tool": "hand"}, {"home": HOME}, {"torque_limit": 1e-3}):
        with pytest.raises(ValueError):
            load_arm(path, **given)
    with pytest.raises(ValueError):
        write_arm(tmp_path / "slow.urdf", slow)
    for part, fault in (("</worldbody>", "MuJoCo cannot read"), ("notes", "not what write_arm wrote")):
        path.write_text(path.read_text().replace(part, ""))
        with pytest.raises(ValueError, match=fault):
            load_arm(path)
        write_arm(path, slow)


def test_a_capsule_of_hardly_any_length_is_covered():
    arm = three(('size="0.05"', 'type="capsule" size="0.05 1e-9"'))
    assert arm.spheres.radius.max() == pytest.approx(0.05)


@pytest.mark.parametrize("fault", ["broken", "file", "shape"])
def test_a_cache_that_cannot_be_used_is_ignored(fault, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = three()
    (stored,) = (tmp_path / "viapoint" / "arms").iterdir()
    if fault == "broken":
        stored.write_bytes(stored.read_bytes()[:1000])
    elif fault == "shape":
        stored.write_text("<mujoco><custom><text name='viapoint_arm' data='{}'/></custom></mujoco>")
    else:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    np.testing.assert_equal(parts_of(three()), parts_of(first))


MOBILE = (
    '<body name="carriage"><joint name="x" type="slide" limited="false"/><joint name="turn"/>'
    '<geom size=".05" mass="2"/>'
)
WALL = '<body name="wall" pos="2 0 0">{}<geom type="box" size=".1 1 1"/></body></worldbody>'
TORSO = '<worldbody><body name="torso"><joint type="ball" name="ball" range="0 1"/><geom size=".01"/>'
PINCH = gripper(2, "bar").replace("</body>", '<site name="pinch"/></body>', 1)


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ([(HAND_OF_TEXT, gripper(2))], "tool:"),
        ([(HAND_OF_TEXT, gripper(2, "knuckle", depth=3))], "tool:"),
        ([(HAND_OF_TEXT, gripper(1, "gripperMover"))], "tool:"),
        ([(HAND_OF_TEXT, PINCH)], "fixed: bar_0_0"),  # its tool moves with the last joint of the arm
        ([(SHOULDER, MOBILE + SHOULDER), ("</body>\n  </worldbody>", "</body></body></worldbody>")], "fixed: turn, x"),
        ([(END, WALL.format("<freejoint/>"))], "left out, not part of the arm: wall"),
        ([("<worldbody>", TORSO), (END, "</body>" + END)], "fixed: ball"),
        ([(END, f'<geom type="plane" size="1 1 1"/>{END}')], "warning: left out: planes"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:left out")
def test_what_is_not_part_of_the_arm_is_fixed_or_left_out_and_told(changes, note):
    arm = load_arm(changed(*changes))
    assert arm.joint_names == JOINTS
    assert any(each.startswith(note) for each in arm.notes)
    assert "wall" not in arm.group_names


@pytest.mark.parametrize(("suffix", "there"), [("obj", False), ("obj", True), ("stl", True), ("msh", True)])
def test_what_is_only_seen_may_be_missing_or_broken_and_what_collides_is_named(tmp_path, suffix, there):
    assets = (
        f'<asset><mesh name="cover" file="cover.{suffix}"/><texture name="skin" type="2d" file="skin.png"/>'
        '<material name="skin" texture="skin"/></asset><worldbody>'
    )
    geom = '<geom type="mesh" mesh="cover" material="skin" contype="{0}" conaffinity="{0}" mass="0"/>'
    if there:  # a pointer of Git LFS
        for name in (f"cover.{suffix}", "skin.png"):
            (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\nsize 12345\n")
    path = tmp_path / "arm.xml"
    path.write_text(changed(("<worldbody>", assets), (SHOULDER, SHOULDER + geom.format(0))))
    arm = load_arm(path)
    assert arm.name == "ur5e-like"  # as "arm" tells nothing
    for part in (f"visual mesh cover.{suffix}", "texture skin"):
        assert f"left out: {part}, which is missing or broken" in arm.notes
    path.write_text(changed(("<worldbody>", assets), (END, f'<body name="lid">{geom.format(0)}</body>{END}')))
    with pytest.warns(UserWarning, match="nothing of lid can collide"):
        load_arm(path)
    path.write_text(changed(("<worldbody>", assets), (SHOULDER, SHOULDER + geom.format(1))))
    with pytest.raises(ValueError, match=rf"cover\.{suffix}.*shoulder"):
        load_arm(path)


FLOATING = '<joint name="base_joint" type="floating"><parent link="odom"/><child link="base"/></joint>'
ODD = [
    (MESH, "package://renamed_description/meshes/wrist.stl"),
    ('<geometry><box size="0.4 0.06 0.06"/>', '<geometry><mesh filename="../meshes/boom.dae"/>'),
    ('<geometry><cylinder radius="0.04" length="0.2"/>', '<geometry><mesh filename="post.dae"/>'),
    ("</robot>", "<xacro:thing a:b='1'/></robot>"),
    ('<mass value="2"/>\n    <inertia ixx="0.1"', '<mass value="2"/><inertia ixx="-0.1"'),
    ('<mass value="1"/>\n    <inertia ixx="0.1"', '<mass value="1"/><inertia ixx="nan"'),
    (
        '<mass value="3"/>\n    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>',
        '<mass value="3"/>',
    ),
    ("0.2 0.2 0.1", "0 0 0"),
    ('<link name="base">', f'<link name="odom"/>{FLOATING}<link name="base">'),
]


@pytest.mark.parametrize("axes", [(1, 1), (-1, -1), (1, -1)])
def test_starts_and_goals_are_reached_whichever_way_the_axes_point(axes):
    arm = load_arm(TWO_LINKS.format(*axes), velocity_limit=2.0, torque_limit=50.0)
    env = gym.make("viapoint/Obstacles-v0", arm=arm).unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        scenes = env.batch.scenes
        assert not env.step(np.zeros(env.action_space.shape, np.float32))[4]["is_success"]
        assert row_clearances(arm.chain, arm.spheres, scenes.goal, scenes.obstacles, 1.0)[0].min() > 0.0


def test_urdf_files_with_odd_parts_load(crane):
    stl = crane / "meshes" / "wrist.stl"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(stl, file_type="stl_ascii")
    stl.write_bytes(stl.read_bytes().upper().replace(b"SOLID ", b"solid"))
    (crane / "meshes" / "boom.dae").write_text("<COLLADA/>")
    with pytest.warns(UserWarning, match=r"post, boom: MuJoCo|no size"):
        arm = load_arm(written(crane, *ODD))
    assert arm.joint_names == ("lift", "turn", "tilt")
    assert "wrist" in arm.group_names
    assert "boom" not in arm.group_names
    notes = "\n".join(arm.notes)
    for told in ("fixed: base_joint", "mass of base", "its box has no size", "of post, boom: MuJoCo"):
        assert told in notes
    for link in ("post", "boom", "wrist"):
        assert f"inertia of {link}" in notes


@pytest.mark.parametrize("place", [(3.0, 0.0, 0.0), (0.0, -2.5, 1.5)])
def test_scenes_move_with_the_arm_and_are_observed_there(place):
    found = []
    for origin in (np.zeros(3), np.negative(place)):
        envs = gym.make_vec("viapoint/Obstacles-v0", num_envs=4, arm=ur5e(origin=origin)).unwrapped
        observation, _ = envs.reset(seed=0)
        np.testing.assert_allclose(observation["hand"], envs.task.arm.hand(envs.scenes.start), atol=1e-6)
        found.append(envs.scenes)
    near, far = found
    np.testing.assert_allclose((near.start, near.goal), (far.start, far.goal), atol=1e-9)
    moved = (far.obstacles.centre - near.obstacles.centre)[near.obstacles.present]
    np.testing.assert_allclose(moved, np.broadcast_to(place, moved.shape), atol=1e-9)
