"""Arguments of `load_arm`, and MJCF files of other projects."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.arms.mjcf import quaternion_of
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array

MIN_WORKSPACE_WIDTH = 1e-3
"""Least width of a workspace along each axis, [m]."""
MAX_COORDINATE = 0.95
"""Greatest coordinate of a hand position, [m]: observations end at 1."""
MIN_RADIUS = 1e-6
"""Least radius of the hand, [m]."""
MIN_TOLERANCE = 0.005
"""Least tolerance of fitted capsules, [m]."""
POSITION_TOLERANCE = 1e-6
"""Greatest difference of positions and axes that count as equal, [m]."""
DEFAULT_VELOCITY_LIMIT = 2.0
"""Velocity limit of joints without one, [rad/s]."""
MIN_JOINTS = 5
"""Least number of hinges: three for the hand's position, two for its direction."""
JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""Transmissions of actuators that drive a hinge directly."""


def file_path(value: Any) -> Path:
    """Return the path of an existing file."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise TypeError(f"path must be the name of an MJCF file, got {value!r}")
    path = Path(value)
    if not path.is_file():
        raise ValueError(f"there is no file {os.fspath(value)!r}")
    return path


def joint_names(joints: Any) -> tuple[str, ...]:
    """Return different names of joints."""
    names = tuple(joints) if isinstance(joints, Iterable) and not isinstance(joints, str) else ()
    if not all(isinstance(each, str) for each in names) or not MIN_JOINTS <= len(set(names)) == len(names):
        raise ValueError(
            f"joints must be {MIN_JOINTS} or more different names, in order from the base to the hand, got {joints!r}"
        )
    return names


def per_joint(name: str, values: Any, joints: tuple[str, ...]) -> Float:
    """Return one number for each joint, shape (J,); a single number applies to all."""
    numbers = finite_array(name, values, (len(joints),), (1,), ())
    return np.array(np.broadcast_to(numbers, (len(joints),)))


def workspace_corners(values: Any) -> Float:
    """Return the lowest and the highest corner of a box from any two opposite corners, shape (2, 3), [m]."""
    corners = np.sort(finite_array("workspace", values, (2, 3)), axis=0)
    if np.abs(corners).max() >= MAX_COORDINATE or (corners[1] - corners[0] < MIN_WORKSPACE_WIDTH).any():
        raise ValueError(
            f"workspace must be a box {MIN_WORKSPACE_WIDTH:g} m wide or more in x, y and z, with coordinates less than "
            f"{MAX_COORDINATE} m, where observations end, got {values!r}"
        )
    return corners


class ParsedMjcf(NamedTuple):
    """Arm in the form of its file."""

    model: mujoco.MjModel
    """Model with the arm's joints only; all other joints are fixed."""
    joints: tuple[str, ...]
    hand_site: str
    home: Float
    """Home configuration, shape (J,), [rad]."""
    joint_range: Float
    """Lowest and highest angles, shape (J, 2), [rad]."""
    torque_limit: Float
    """Torque limits, shape (J,), [N m]."""
    velocity_limit: Float
    """Velocity limits, shape (J,), [rad/s]."""


def parse_mjcf(
    path: Path,
    hand_site: str,
    joints: tuple[str, ...],
    *,
    home: Any,
    joint_range: Any,
    torque_limit: Any,
    velocity_limit: Any,
) -> ParsedMjcf:
    """Read and check a file; see :func:`~viapoint.envs.arm_import.loader.load_arm` for arguments and errors."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        whole = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {str(path)!r} as an MJCF file: {error}") from None
    if not spec.geoms:
        raise ValueError(f"there are no geoms in {str(path)!r}: nothing of the arm can collide")
    _check_exist("site", (hand_site,), [site.name for site in spec.sites])
    _check_exist("joint", joints, [joint.name for joint in spec.joints])
    ranges = _ranges(whole, joints, joint_range)
    torque = (
        _torques(whole, joints) if torque_limit is None else per_joint("torque_limit", torque_limit, joints)
    )
    if velocity_limit is None:
        given = mujoco.mj_name2id(whole, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit") >= 0
        velocity_limit = whole.numeric("velocity_limit").data if given else DEFAULT_VELOCITY_LIMIT
    velocity = per_joint("velocity_limit", velocity_limit, joints)
    for name, limit in (("torque_limit", torque), ("velocity_limit", velocity)):
        if not (limit > 0.0).all():
            raise ValueError(f"{name} must be positive, got {limit}")
    if home is None:
        address = [int(whole.joint(joint).qposadr[0]) for joint in joints]
        home = whole.key_qpos[0, address] if whole.nkey else ranges.mean(axis=1)
    home = per_joint("home", home, joints)
    outside = [
        name for name, q, (low, high) in zip(joints, home, ranges, strict=True) if not low <= q <= high
    ]
    if outside:
        raise ValueError(f"home is outside the range of {', '.join(outside)}")
    model = _isolate(spec, joints, whole)
    _check_order(model, joints, hand_site)
    return ParsedMjcf(model, joints, hand_site, home, ranges, torque, velocity)


def _check_exist(kind: str, wanted: tuple[str, ...], there: list[str]) -> None:
    missing = [name for name in wanted if name not in there]
    if missing:
        named = ", ".join(filter(None, there)) or "none"
        raise ValueError(
            f"there is no {kind} {', '.join(map(repr, missing))} in the file; there are: {named}"
        )


def _ranges(model: mujoco.MjModel, joints: tuple[str, ...], given: Any) -> Float:
    for name in joints:
        joint = model.joint(name)
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"joint {name!r} is not a hinge; leave it out to fix it")
        if given is None and not model.jnt_limited[joint.id]:
            raise ValueError(
                f"joint {name!r} has no limits; give it a range in the file, or give joint_range"
            )
    if given is not None:
        ranges = finite_array("joint_range", given, (len(joints), 2))
        if (ranges[:, 0] >= ranges[:, 1]).any():
            raise ValueError(f"joint_range must be pairs in increasing order, got {given!r}")
        return ranges
    return np.array([model.joint(name).range for name in joints])


def _torques(model: mujoco.MjModel, joints: tuple[str, ...]) -> Float:
    """Return the torque limit of each joint: its own, or the greatest of the actuators that drive it."""
    found = []
    for name in joints:
        joint = model.joint(name).id
        if model.jnt_actfrclimited[joint]:
            found.append(_symmetric_limit(model.jnt_actfrcrange[joint]))
            continue
        driven = np.isin(model.actuator_trntype, JOINT_TRANSMISSIONS) & (model.actuator_trnid[:, 0] == joint)
        limits = [_actuator_torque(model, int(index)) for index in np.flatnonzero(driven)]
        found.append(max(limits, default=np.nan))
    missing = [name for name, torque in zip(joints, found, strict=True) if not torque > 0.0]
    if missing:
        raise ValueError(
            f"no actuator with a force limited to a range about 0 drives {', '.join(missing)}; add one, or give "
            "torque_limit"
        )
    return np.array(found)


def _actuator_torque(model: mujoco.MjModel, index: int) -> float:
    """Return an actuator's torque limit: that of its force, or that of its control where force is gain * control."""
    gear = abs(float(model.actuator_gear[index, 0]))
    if model.actuator_forcelimited[index]:
        return gear * _symmetric_limit(model.actuator_forcerange[index])
    plain = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
    if plain and model.actuator_ctrllimited[index]:
        gain = abs(float(model.actuator_gainprm[index, 0]))
        return gear * gain * _symmetric_limit(model.actuator_ctrlrange[index])
    return np.nan


def _symmetric_limit(limits: Float) -> float:
    """Return the limit that a range leaves in both directions; 0 if it is one-sided."""
    return max(min(-float(limits[0]), float(limits[1])), 0.0)


def _isolate(spec: mujoco.MjSpec, joints: tuple[str, ...], whole: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model without actuators, constraints and sensors, all other joints fixed as in the first keyframe.

    The model of the file, `spec`, is changed; `whole` is the compiled model of the whole file.
    """
    for part in (
        *spec.actuators, *spec.equalities, *spec.sensors, *spec.tendons, *spec.keys, *spec.excludes, *spec.pairs,
    ):  # fmt: skip
        spec.delete(part)
    others = [joint for joint in spec.joints if joint.name not in joints]
    fixed = _keyframe_positions(whole, joints) if whole.nkey else None
    if fixed:
        for body in {joint.parent.id: joint.parent for joint in others}.values():
            _fix_body(body, whole, fixed)
    for joint in others:
        spec.delete(joint)
    for body in spec.bodies:
        body.mocap = False
    model = spec.compile()
    if fixed:
        _check_fixed(model, whole, fixed, joints)
    return model


def _keyframe_positions(whole: mujoco.MjModel, joints: tuple[str, ...]) -> mujoco.MjData:
    """Return the positions of all parts with the arm's joints at rest and the others as in the first keyframe."""
    data = mujoco.MjData(whole)
    data.qpos[:] = whole.key_qpos[0]
    for name in joints:
        address = whole.joint(name).qposadr
        data.qpos[address] = whole.qpos0[address]
    mujoco.mj_kinematics(whole, data)
    return data


def _fix_body(body: Any, whole: mujoco.MjModel, fixed: mujoco.MjData) -> None:
    """Write a body's pose into the model, in a frame of its own because the body may be inside another frame."""
    number, parent = body.id, whole.body_parentid[body.id]
    turn = fixed.xmat[parent].reshape(3, 3).T
    body.set_frame(body.parent.add_frame())
    body.pos = turn @ (fixed.xpos[number] - fixed.xpos[parent])
    body.quat = quaternion_of(turn @ fixed.xmat[number].reshape(3, 3))
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _check_fixed(
    model: mujoco.MjModel, whole: mujoco.MjModel, fixed: mujoco.MjData, joints: tuple[str, ...]
) -> None:
    """Check that the arm's joints are still where the file has them."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name in joints:
        here, there = model.joint(name).id, whole.joint(name).id
        apart = np.abs(data.xanchor[here] - fixed.xanchor[there]).max()
        if max(apart, np.abs(data.xaxis[here] - fixed.xaxis[there]).max()) > POSITION_TOLERANCE:
            raise ValueError(
                f"joints that are left out cannot be fixed as in the file's keyframe, because that moves {name}; "
                "write their positions into the file and remove the keyframe"
            )


def _check_order(model: mujoco.MjModel, joints: tuple[str, ...], hand_site: str) -> None:
    """Check that each joint carries the next one, and the last one the hand."""
    bodies = [int(model.joint(name).bodyid[0]) for name in joints]
    for i in range(1, len(joints)):
        first, second = joints[i - 1], joints[i]
        if bodies[i - 1] == bodies[i]:
            raise ValueError(
                f"joints {first!r} and {second!r} belong to one body; leave one out to fix it, or give each a body of "
                "its own in the file"
            )
        if bodies[i - 1] not in _ancestors(model, bodies[i]):
            raise ValueError(f"joints must be in order from the base: {first!r} does not carry {second!r}")
    last = int(model.site(hand_site).bodyid[0])
    if model.body_weldid[last] != bodies[-1]:
        raise ValueError(f"site {hand_site!r} does not move with the last joint, {joints[-1]!r}")


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found
