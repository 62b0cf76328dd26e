"""Import of arms from MJCF files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from viapoint.envs.arm_import import mjcf_reader
from viapoint.envs.arm_import.capsule_fit import cover_geom
from viapoint.envs.arm_import.mjcf_reader import MAX_COORDINATE, MIN_RADIUS, MIN_TOLERANCE, ParsedMjcf
from viapoint.envs.arm_import.reachability import (
    FIRST_OFF_TABLE,
    Feasibility,
    check_room,
    check_strength,
    corner_configurations,
    fit_feasible_table,
)
from viapoint.envs.arms.mjcf import (
    Pose,
    as_box,
    bodies_moved_by,
    in_frame,
    joint_frames,
    kinematic_chain,
    principal_inertia,
    quaternion_of,
    read_spec,
    zero_configuration,
)
from viapoint.envs.arms.serial_arm import LinkCapsule, SerialArm, serial_arm
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array, number_of_at_least

STAGE = "stage.xml"
"""Asset with table, light and cameras."""
WORKSPACE_MARGIN = 0.03
"""Distance of the default workspace from the faces of the reach, [m]."""
OBSTACLE_BIT, SELF_BIT, TABLE_BIT = 1, 2, 4
"""Contact bits."""


def load_arm(
    path: str | Path,
    *,
    hand_site: str,
    joints: Sequence[str],
    name: str | None = None,
    home: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    workspace: ArrayLike | None = None,
    joint_range: ArrayLike | None = None,
    torque_limit: ArrayLike | None = None,
    velocity_limit: ArrayLike | None = None,
    hand_radius: float = 0.02,
    tolerance: float = 0.025,
) -> SerialArm:
    """Load an arm from an MJCF file.

    The arm keeps the file's joints, inertias and limits, and the spheres and capsules of its links. Capsules cover the
    links' other geoms: nothing sticks out of them. Other joints are fixed as in the file's first keyframe, and
    everything else is left out. The hand keeps the orientation that it has at home; the reach is a box of hand
    positions around home.

    Args:
        path: MJCF file.
        hand_site: Site of the hand's position, which moves with the last joint.
        joints: Names of the limited hinges from the base to the hand, five or more.
        name: Name of the arm; by default that of the file.
        home: Home configuration, shape (J,), [rad]; by default the file's first keyframe, or else the middle of the
            joint ranges.
        origin: Point of the file's world that becomes the origin, on the table, [m]; by default the point below the
            first joint with z = 0.
        workspace: Two opposite corners of the box in which movements start and end, [m]; by default the reach less 3 cm
            on each side.
        joint_range: Lowest and highest angle of each joint, shape (J, 2), [rad]; by default those of the file.
        torque_limit: Torque limit of each joint or of all, [N m]; by default those of the file's joints or actuators.
        velocity_limit: Velocity limit of each joint or of all, [rad/s]; by default the file's custom number of that
            name, or 2.
        hand_radius: Radius of the sphere that is the hand, [m].
        tolerance: Greatest distance by which the capsules that cover a geom reach beyond it, 0.005 or more, [m].
            Smaller values take more capsules, and more time to load the arm and to compute clearances.

    Returns:
        The arm. Pass it to `gymnasium.make(id, arm=...)`, or register it with `register_arm`.

    Raises:
        TypeError: The path is not the name of a file.
        ValueError: An argument is invalid, the file lacks something, or the arm is too weak or has too little room. The
            message lists the allowed values.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import load_arm
        >>> arm = load_arm(
        ...     "docs/ur5e.xml",
        ...     hand_site="hand",
        ...     joints=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
        ...     home=(0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28),
        ... )
        >>> joints = arm.inverse_kinematics(np.array([[0.45, 0.0, 0.2], [0.45, 0.3, 0.2]]))  # m
        >>> joints.shape  # rad
        (2, 6)
        >>> hands = arm.hand_position(joints)  # m
        >>> np.allclose(hands, [[0.45, 0.0, 0.2], [0.45, 0.3, 0.2]], atol=1e-6)
        True
    """
    file = mjcf_reader.file_path(path)
    corners = None if workspace is None else mjcf_reader.workspace_corners(workspace)
    zero = None if origin is None else finite_array("origin", origin, (3,))
    hand_radius = number_of_at_least("hand_radius", hand_radius, MIN_RADIUS, MAX_COORDINATE)
    tolerance = number_of_at_least("tolerance", tolerance, MIN_TOLERANCE, MAX_COORDINATE)
    name = file.stem if name is None else name
    if not isinstance(name, str) or not name:
        raise ValueError(f"name must be a string of one or more characters, got {name!r}")
    parsed = mjcf_reader.parse_mjcf(
        file,
        hand_site,
        mjcf_reader.joint_names(joints),
        home=home,
        joint_range=joint_range,
        torque_limit=torque_limit,
        velocity_limit=velocity_limit,
    )
    frames = joint_frames(parsed.model, parsed.joints)
    zero = np.array([*frames[0][1][:2], 0.0]) if zero is None else zero
    capsules = _link_capsules(parsed, frames, hand_radius, tolerance)
    # The chain is that of the written model, whose first frame is relative to the new origin.
    chain = kinematic_chain(_write(parsed, frames, zero, capsules, [], hand_radius).compile(), parsed.joints)
    hand_offset = in_frame(frames[-1], zero_configuration(parsed.model).site(hand_site).xpos)
    check = Feasibility(chain, hand_offset, parsed, capsules, hand_radius)
    check_strength(parsed, chain, parsed.home[None], ["at home"])
    required = np.stack((check.home_position, check.home_position)) if corners is None else corners
    table = fit_feasible_table(check, check.reachable_box(corners), required)
    if corners is None:
        low, high = (np.array(corner) for corner in table.box)
        corners = np.stack((low + WORKSPACE_MARGIN, high - WORKSPACE_MARGIN))
    arm = serial_arm(
        _write(parsed, frames, zero, capsules, check.may_touch, hand_radius).to_xml(),
        name=name,
        joint_names=parsed.joints,
        hand_site="hand",
        ik=table,
        workspace=as_box(corners),
    )
    shape = (written._replace(excess=each.excess) for written, each in zip(arm.shape, capsules, strict=True))
    arm = replace(arm, shape=tuple(shape))
    check_room(arm, table.box)
    check_strength(parsed, chain, *corner_configurations(arm))
    return arm


def _link_capsules(
    parsed: ParsedMjcf, frames: list[Pose], hand_radius: float, tolerance: float
) -> list[LinkCapsule]:
    """Return the capsules of each link's geoms, those that collide if any do, and one from the last to the hand."""
    model, data, capsules = parsed.model, zero_configuration(parsed.model), []
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    for index, (joint, frame) in enumerate(zip(parsed.joints, frames, strict=True)):
        moved = np.isin(model.geom_bodyid, bodies_moved_by(model, joint))
        for geom in np.flatnonzero(moved & collides if (moved & collides).any() else moved):
            for ends, radius, excess in cover_geom(model, data, int(geom), tolerance):
                first, second = (in_frame(frame, end) for end in ends)
                capsules.append(LinkCapsule(index, (first, second), radius, excess=excess))
    if not capsules:
        raise ValueError(
            f"no geom moves with any of {', '.join(parsed.joints)}: nothing of the arm can collide"
        )
    last, hand = len(frames) - 1, in_frame(frames[-1], data.site(parsed.hand_site).xpos)
    ends = np.array(capsules[-1].ends if capsules[-1].joint == last else [(0.0, 0.0, 0.0)])
    nearest = ends[np.linalg.norm(ends - hand, axis=-1).argmin()]
    if np.linalg.norm(nearest - hand) < 1e-3:  # a capsule needs a length
        nearest = nearest - (0.0, 0.0, 2e-3)
    x, y, z = map(float, nearest)
    return [*capsules, LinkCapsule(last, ((x, y, z), hand), hand_radius)]


def _write(
    parsed: ParsedMjcf,
    frames: list[Pose],
    origin: Float,
    capsules: list[LinkCapsule],
    may_touch: list[tuple[int, int]],
    hand_radius: float,
) -> mujoco.MjSpec:
    """Return the arm as a complete model: one body and hinge for each link, and its capsules.

    A point `origin`, (3,), [m], becomes the origin. Contacts between pairs of links that `may_touch` do not count.
    """
    spec = read_spec(STAGE)
    spec.add_numeric(name="velocity_limit", data=parsed.velocity_limit, size=len(parsed.joints))
    parent, (turn, place) = spec.worldbody, (np.eye(3), origin)
    chain = kinematic_chain(parsed.model, parsed.joints)
    for index, (joint, hinge, frame) in enumerate(zip(parsed.joints, chain.hinges, frames, strict=True)):
        parent = parent.add_body(
            name=f"link_{index}", pos=turn.T @ (frame[1] - place), quat=quaternion_of(turn.T @ frame[0]), gravcomp=1.0,
        )  # fmt: skip
        parent.mass, parent.ipos, parent.explicitinertial = hinge.mass, hinge.centre, True
        parent.inertia, parent.iquat = principal_inertia(hinge.inertia)
        torque = parsed.torque_limit[index]
        parent.add_joint(
            name=joint, axis=(0.0, 0.0, 1.0), range=parsed.joint_range[index], limited=True,
            actfrcrange=(-torque, torque), actfrclimited=True, actgravcomp=True,
        )  # fmt: skip
        turn, place = frame
    for number, capsule in enumerate(capsules):
        spec.body(f"link_{capsule.joint}").add_geom(
            name=f"capsule_{number}", **_geometry(capsule), conaffinity=SELF_BIT,
            contype=OBSTACLE_BIT | SELF_BIT | (TABLE_BIT if capsule.joint >= FIRST_OFF_TABLE else 0),
        )  # fmt: skip
    hand = capsules[-1].ends[1]
    parent.add_geom(
        name="hand", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(hand_radius, 0.0, 0.0), pos=hand,
        contype=OBSTACLE_BIT | TABLE_BIT, conaffinity=0, rgba=(0.16, 0.20, 0.28, 1.0),
    )  # fmt: skip
    parent.add_site(name="hand", pos=hand, size=(0.004, 0.0, 0.0), rgba=(0.0, 0.0, 0.0, 0.0))
    for first, second in may_touch:
        spec.add_exclude(bodyname1=f"link_{first}", bodyname2=f"link_{second}", name=f"near_{first}_{second}")
    return spec


def _geometry(capsule: LinkCapsule) -> dict[str, Any]:
    """Return type, place and size of a capsule's geom."""
    first, second = capsule.ends
    if first == second:
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "pos": first, "size": (capsule.radius, 0.0, 0.0)}
    ends = np.ravel(capsule.ends)
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": ends, "size": (capsule.radius, 0.0, 0.0)}
