"""An arm of one's own: from any MJCF file with hinges to a record and a model of our kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arm_import.capsule_fit import around_points, surface
from viapoint.envs.arm_import.mjcf_reader import (
    ParsedMjcf,
    box_of,
    name_of,
    names_of,
    parse_mjcf,
    path_of,
    point_of,
    radius_of,
)
from viapoint.envs.arm_import.reachability import (
    FIRST_OFF_TABLE,
    Body,
    Reachable,
    check_room,
    check_strength,
    good_map,
    postures_at_corners,
)
from viapoint.envs.arms.kinematics import Chain
from viapoint.envs.arms.mjcf import (
    at_zero,
    chain_of,
    in_frame,
    joint_frames,
    moving_with,
    principal,
    read_spec,
)
from viapoint.envs.arms.serial_arm import SerialArm, serial_arm
from viapoint.envs.common.types import Box, Float

Frames = list[tuple[Float, Float]]

STAGE = "stage.xml"
"""Table, lamp and cameras."""
INSIDE = 0.03
"""How far inside its reach movements start and end, [m]."""
OBSTACLES, SELF, TABLE = 1, 2, 4
"""Contact bits."""


def load_arm(
    path: str | Path,
    *,
    hand_site: str,
    joints: Sequence[str],
    name: str | None = None,
    home: Any = None,
    origin: Any = None,
    workspace: Any = None,
    joint_range: Any = None,
    torque_limit: Any = None,
    velocity_limit: Any = None,
    hand_radius: float = 0.02,
) -> SerialArm:
    """The record of the arm in an MJCF file.

    The file's links, joints, inertias and limits are taken over into a model of our kind: one capsule around the geoms
    of each link, other joints held where the first keyframe has them, everything else left out. The hand keeps the turn
    that it has at home.

    Args:
        path: The file.
        hand_site: A site that moves with the last joint: where the hand is.
        joints: Limited hinges from the base to the hand, five or more.
        name: Of the arm; by default the file's.
        home: A posture in the middle of things, shape (J,), [rad]; by default the file's first keyframe, or else the
            middle of the joints' ranges.
        origin: The point of the file's world that is ours, on the table, [m]; by default below the first joint, z = 0.
        workspace: Two opposite corners of the box in which movements start and end, [m]; by default it is searched for.
        joint_range: Lowest and highest angle of each joint, shape (J, 2), [rad]; by default those of the file.
        torque_limit: Of the joints, [N m]; by default those of the file's joints or actuators.
        velocity_limit: Of the joints, [rad/s]; by default the file's custom number of that name, or 2.
        hand_radius: [m].

    Raises:
        TypeError: The path is no name of a file.
        ValueError: Something is missing, with what there is, or the arm is too weak or has too little room.
    """
    file = path_of(path)
    given = None if workspace is None else box_of(workspace)
    there = None if origin is None else point_of("origin", origin)
    hand_radius = radius_of(hand_radius)
    name = name_of(file.stem if name is None else name)
    foreign = parse_mjcf(
        file,
        hand_site,
        names_of(joints),
        home=home,
        joint_range=joint_range,
        torque_limit=torque_limit,
        velocity_limit=velocity_limit,
    )
    frames = joint_frames(foreign.model, foreign.joints)
    zero = np.array([*frames[0][1][:2], 0.0]) if there is None else there
    bodies = _bodies(foreign, frames, hand_radius)
    chain = chain_of(_written(foreign, frames, zero, bodies, [], hand_radius).compile(), foreign.joints)
    hand_at = in_frame(frames[-1], at_zero(foreign.model).site(hand_site).xpos)
    reachable = Reachable(chain, hand_at, foreign, bodies, hand_radius)
    check_strength(foreign, chain, foreign.home[None], ["at home"])
    kept = np.stack((reachable.middle, reachable.middle)) if given is None else given
    place = good_map(chain, hand_at, foreign.home, reachable, reachable.box(given), kept)
    arm = serial_arm(
        _written(foreign, frames, zero, bodies, reachable.touching, hand_radius).to_xml(),
        name=name,
        joint_names=foreign.joints,
        hand_site="hand",
        place=place,
        workspace=_inside(place.box) if given is None else _box(given),
    )
    check_room(arm, place.box)
    check_strength(foreign, chain, *postures_at_corners(arm))
    return arm


def _bodies(foreign: ParsedMjcf, frames: Frames, hand_radius: float) -> list[Body]:
    """A capsule around each link's geoms, those that collide if there are any, and one from the last to the hand."""
    model, data, bodies = foreign.model, at_zero(foreign.model), []
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    for index, joint in enumerate(foreign.joints):
        moved = np.isin(model.geom_bodyid, moving_with(model, joint))
        geoms = np.flatnonzero(moved & collides) if (moved & collides).any() else np.flatnonzero(moved)
        parts = [surface(model, data, int(geom)) for geom in geoms]
        points = np.concatenate([np.empty((0, 3)), *(part[0] for part in parts)])
        if len(points):
            around = np.concatenate([np.full(len(part[0]), part[1]) for part in parts])
            ends, radius = around_points(points, around, np.array([frames[index][0][:, 2]]))
            bodies.append(
                Body(index, (in_frame(frames[index], ends[0]), in_frame(frames[index], ends[1])), radius)
            )
    if not bodies:
        raise ValueError(
            f"no geom moves with any of {', '.join(foreign.joints)}: there is nothing to collide"
        )
    last, hand = len(frames) - 1, in_frame(frames[-1], data.site(foreign.hand_site).xpos)
    ends = np.array(bodies[-1].ends if bodies[-1].joint == last else [(0.0, 0.0, 0.0)])
    nearest = ends[np.linalg.norm(ends - hand, axis=-1).argmin()]
    if np.linalg.norm(nearest - hand) < 1e-3:
        nearest = nearest - (0.0, 0.0, 2e-3)
    return [*bodies, Body(last, (tuple(map(float, nearest)), hand), hand_radius)]  # type: ignore[arg-type]


def _written(
    foreign: ParsedMjcf,
    frames: Frames,
    origin: Float,
    bodies: list[Body],
    touching: list[tuple[int, int]],
    hand_radius: float,
) -> mujoco.MjSpec:
    """The arm as a model of our kind."""
    spec = read_spec(STAGE)
    spec.add_numeric(name="velocity_limit", data=foreign.velocity_limit, size=len(foreign.joints))
    parent, before = spec.worldbody, (np.eye(3), origin)
    links: Chain = chain_of(foreign.model, foreign.joints)
    for index, (joint, hinge) in enumerate(zip(foreign.joints, links.hinges, strict=True)):
        turn = before[0].T @ frames[index][0]
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, turn.flatten())
        place = before[0].T @ (frames[index][1] - before[1])
        parent = parent.add_body(name=f"link_{index}", pos=place, quat=quaternion, gravcomp=1.0)
        parent.mass, parent.ipos, parent.explicitinertial = hinge.mass, hinge.centre, True
        parent.inertia, parent.iquat = principal(hinge.inertia)
        torque = foreign.torque_limit[index]
        parent.add_joint(
            name=joint, axis=(0.0, 0.0, 1.0), range=foreign.joint_range[index], limited=True,
            actfrcrange=(-torque, torque), actfrclimited=True, actgravcomp=True,
        )  # fmt: skip
        before = frames[index]
    for number, body in enumerate(bodies):
        spec.body(f"link_{body.joint}").add_geom(
            name=f"capsule_{number}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=np.ravel(body.ends),
            size=(body.radius, 0.0, 0.0), conaffinity=SELF,
            contype=OBSTACLES | SELF | (TABLE if body.joint >= FIRST_OFF_TABLE else 0),
        )  # fmt: skip
    hand = bodies[-1].ends[1]
    parent.add_geom(
        name="hand", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(hand_radius, 0.0, 0.0), pos=hand,
        contype=OBSTACLES | TABLE, conaffinity=0, rgba=(0.16, 0.20, 0.28, 1.0),
    )  # fmt: skip
    parent.add_site(name="hand", pos=hand, size=(0.004, 0.0, 0.0), rgba=(0.0, 0.0, 0.0, 0.0))
    for first, second in {(bodies[i].joint, bodies[j].joint) for i, j in touching}:
        spec.add_exclude(bodyname1=f"link_{first}", bodyname2=f"link_{second}", name=f"near_{first}_{second}")
    return spec


def _inside(box: Box) -> Box:
    low, high = (np.array(corner) for corner in box)
    return _box((low + INSIDE, high - INSIDE))


def _box(corners: Any) -> Box:
    low, high = np.asarray(corners, dtype=np.float64)
    return tuple(map(float, low)), tuple(map(float, high))
