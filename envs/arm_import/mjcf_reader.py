"""MJCF files of other projects and the arguments that describe an arm in them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.common.types import Float

FLATTEST = 1e-3
"""Least width of a workspace, in which places are drawn, [m]."""
BOUND = 0.95
"""Greatest coordinate of a place of the hand, [m]: observations end at 1."""


def path_of(value: Any) -> Path:
    """Of the arm's file."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise TypeError(f"path must be the name of an MJCF file, got {value!r}")
    path = Path(value)
    if not path.is_file():
        raise ValueError(f"there is no file {os.fspath(value)!r}")
    return path


def name_of(value: Any) -> str:
    """Of the arm, by which files of runs and models know it."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"name must be a string of a character or more, got {value!r}")
    return value


def names_of(joints: Any) -> tuple[str, ...]:
    """Of the joints."""
    names = tuple(joints) if isinstance(joints, Iterable) and not isinstance(joints, str) else ()
    if not names or not all(isinstance(each, str) for each in names):
        raise ValueError(f"joints must be names, in order from the base to the hand, got {joints!r}")
    if len(set(names)) < len(names):
        raise ValueError(f"joints must be named once each, got {joints!r}")
    return names


def one_for_each(name: str, values: Any, joints: tuple[str, ...]) -> Float:
    """A number for each joint; one that is given stands for all."""
    numbers = _numbers(values)
    if numbers is None or numbers.shape not in ((), (1,), (len(joints),)):
        raise ValueError(f"{name} must be {len(joints)} numbers, one for each joint, got {values!r}")
    return np.array(np.broadcast_to(numbers, (len(joints),)))


def ranges_of(values: Any, joints: tuple[str, ...]) -> Float:
    """Lowest and highest angle of each joint, shape (J, 2), [rad]."""
    ranges = _numbers(values)
    good = ranges is not None and ranges.shape == (len(joints), 2) and bool(np.isfinite(ranges).all())
    if ranges is None or not good or not (ranges[:, 0] < ranges[:, 1]).all():
        raise ValueError(
            f"joint_range must be {len(joints)} pairs of finite numbers in increasing order, got {values!r}"
        )
    return ranges


def point_of(name: str, values: Any) -> Float:
    """A place, shape (3,), [m]."""
    point = _numbers(values)
    if point is None or point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} must be three finite numbers, x, y and z in m, got {values!r}")
    return point


def box_of(values: Any) -> Float:
    """Lowest and highest corner of a box of which two opposite corners are given, shape (2, 3), [m]."""
    corners = _numbers(values)
    if corners is None or corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise ValueError(
            f"workspace must be two opposite corners, each of three finite numbers in m, got {values!r}"
        )
    far = corners[(np.abs(corners) >= BOUND).any(axis=-1)]
    if len(far):
        raise ValueError(
            f"the hand does not get to ({', '.join(f'{x:.4g}' for x in far[0])}) m: coordinates must be less than "
            f"{BOUND} m, where observations end; give another workspace or origin"
        )
    if (np.abs(corners[1] - corners[0]) < FLATTEST).any():
        raise ValueError(
            f"workspace must be a box that is {1e3 * FLATTEST:g} mm wide or more in x, y and z, got {values!r}"
        )
    return np.sort(corners, axis=0)


def radius_of(value: Any) -> float:
    """Of the hand, [m]."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0.0 < float(value) < BOUND):
        raise ValueError(f"hand_radius must be a positive number of m, less than {BOUND}, got {value!r}")
    return float(value)


def _numbers(values: Any) -> Float | None:
    """Real numbers as an array; None where they are something else."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # rows of different lengths, say
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiu" else None


CLOSE = 1e-6
"""Within which places and axes are the same, [m]."""
VELOCITY = 2.0
"""Limit of the joints where nothing is said, [rad/s]."""


ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""What drives a hinge itself."""


class ParsedMjcf(NamedTuple):
    """An arm as its file has it."""

    model: mujoco.MjModel
    """With the arm's joints alone; all others are held still."""
    joints: tuple[str, ...]
    hand_site: str
    home: Float
    """Shape (J,), [rad]."""
    joint_range: Float
    """Shape (J, 2), [rad]."""
    torque_limit: Float
    """Shape (J,), [N m]."""
    velocity_limit: Float
    """Shape (J,), [rad/s]."""


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
    """Read and check a file; see :func:`~viapoint.envs.arm_import.loader.load_arm`."""
    spec = _read(path)
    _known("site", (hand_site,), [site.name for site in spec.sites])
    _known("joint", joints, [joint.name for joint in spec.joints])
    whole = _compiled(spec, path)
    ranges = _ranges(whole, joints, joint_range)
    torque = (
        _torques(whole, joints)
        if torque_limit is None
        else one_for_each("torque_limit", torque_limit, joints)
    )
    if (
        velocity_limit is None
        and mujoco.mj_name2id(whole, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit") >= 0
    ):
        velocity_limit = whole.numeric("velocity_limit").data
    velocity = one_for_each("velocity_limit", VELOCITY if velocity_limit is None else velocity_limit, joints)
    for name, limit in (("torque_limit", torque), ("velocity_limit", velocity)):
        if not (np.isfinite(limit).all() and (limit > 0.0).all()):
            raise ValueError(f"{name} must be positive and finite, got {limit}")
    if home is None:
        address = [int(whole.joint(joint).qposadr[0]) for joint in joints]
        home = whole.key_qpos[0, address] if whole.nkey else ranges.mean(axis=1)
    home = one_for_each("home", home, joints)
    outside = [
        joint for joint, q, (low, high) in zip(joints, home, ranges, strict=True) if not low <= q <= high
    ]
    if outside:
        raise ValueError(f"home is outside the range of {', '.join(outside)}")
    model = _alone(spec, joints, whole)
    _check_order(model, joints, hand_site)
    return ParsedMjcf(model, joints, hand_site, home, ranges, torque, velocity)


def _read(path: Path) -> mujoco.MjSpec:
    """The file, in which something must be there to collide."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"{str(path)!r} is no MJCF file that MuJoCo can read: {error}") from None
    if not spec.geoms:
        raise ValueError(f"there are no geoms in {str(path)!r}: there is nothing to collide")
    return spec


def _compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo can make no model of {str(path)!r}: {error}") from None


def _known(kind: str, wanted: tuple[str, ...], there: list[str]) -> None:
    missing = [name for name in wanted if name not in there]
    if missing:
        named = ", ".join(filter(None, there)) or "none"
        raise ValueError(
            f"there is no {kind} {', '.join(map(repr, missing))} in the file; there are: {named}"
        )


def _ranges(model: mujoco.MjModel, joints: tuple[str, ...], given: Any) -> Float:
    if len(joints) < 5:
        raise ValueError(f"joints must be five or more, got {joints}")
    for name in joints:
        joint = model.joint(name)
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"joint {name!r} is no hinge; leave it out to hold it still")
        if given is None and not model.jnt_limited[joint.id]:
            raise ValueError(
                f"joint {name!r} has no limits; give it a range in the file, or give joint_range"
            )
    if given is not None:
        return ranges_of(given, joints)
    return np.array([model.joint(name).range for name in joints])


def _torques(model: mujoco.MjModel, joints: tuple[str, ...]) -> Float:
    """Of each joint: its own limit, or that of the actuator that drives it."""
    found = []
    for name in joints:
        joint = model.joint(name).id
        if model.jnt_actfrclimited[joint]:
            found.append(_both_ways(model.jnt_actfrcrange[joint]))
            continue
        driven = np.isin(model.actuator_trntype, ON_JOINTS) & (model.actuator_trnid[:, 0] == joint)
        limits = [_actuator_torque(model, int(index)) for index in np.flatnonzero(driven)]
        found.append(max(limits, default=np.nan))
    missing = [name for name, limit in zip(joints, found, strict=True) if not np.isfinite(limit)]
    if missing:
        raise ValueError(
            f"no actuator with a limited force drives {', '.join(missing)}; add one, or give torque_limit"
        )
    one_way = [name for name, limit in zip(joints, found, strict=True) if limit <= 0.0]
    if one_way:
        raise ValueError(
            f"the force on {', '.join(one_way)} is limited to one direction; give it a range about 0 in the file, or "
            "give torque_limit"
        )
    return np.array(found)


def _actuator_torque(model: mujoco.MjModel, index: int) -> float:
    gear = abs(float(model.actuator_gear[index, 0]))
    if model.actuator_forcelimited[index]:
        return gear * _both_ways(model.actuator_forcerange[index])
    plain = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
    if plain and model.actuator_ctrllimited[index]:
        gain = abs(float(model.actuator_gainprm[index, 0]))
        return gear * gain * _both_ways(model.actuator_ctrlrange[index])
    return np.nan


def _both_ways(limits: Float) -> float:
    """What a range leaves in either direction; 0 where it is one-sided."""
    return max(min(-float(limits[0]), float(limits[1])), 0.0)


def _alone(spec: mujoco.MjSpec, joints: tuple[str, ...], whole: mujoco.MjModel) -> mujoco.MjModel:
    """The model without what drives, couples or measures, every other joint held as in the first keyframe, if any."""
    for part in (
        *spec.actuators, *spec.equalities, *spec.sensors, *spec.tendons, *spec.keys, *spec.excludes, *spec.pairs,
    ):  # fmt: skip
        spec.delete(part)
    others = [joint for joint in spec.joints if joint.name not in joints]
    held = _held(whole, joints) if whole.nkey else None
    if held:
        for body in {joint.parent.id: joint.parent for joint in others}.values():
            _put(body, whole, held)
    for joint in others:
        spec.delete(joint)
    for body in spec.bodies:
        body.mocap = False
    model = spec.compile()
    if held:
        _check_held(model, whole, held, joints)
    return model


def _held(whole: mujoco.MjModel, joints: tuple[str, ...]) -> mujoco.MjData:
    """The places of everything with the arm as it is drawn and all other joints as in the first keyframe."""
    data = mujoco.MjData(whole)
    data.qpos[:] = whole.key_qpos[0]
    for name in joints:
        address = whole.joint(name).qposadr
        data.qpos[address] = whole.qpos0[address]
    mujoco.mj_kinematics(whole, data)
    return data


def _put(body: Any, whole: mujoco.MjModel, held: mujoco.MjData) -> None:
    """Write a body's place into it, in a frame of its own: it may be in another."""
    number, parent = body.id, whole.body_parentid[body.id]
    turn = held.xmat[parent].reshape(3, 3).T
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, (turn @ held.xmat[number].reshape(3, 3)).flatten())
    body.set_frame(body.parent.add_frame())
    body.pos, body.quat = turn @ (held.xpos[number] - held.xpos[parent]), quaternion
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _check_held(
    model: mujoco.MjModel, whole: mujoco.MjModel, held: mujoco.MjData, joints: tuple[str, ...]
) -> None:
    """Whether the arm's joints are still where the file has them."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name in joints:
        here, there = model.joint(name).id, whole.joint(name).id
        apart = np.abs(data.xanchor[here] - held.xanchor[there]).max()
        if max(apart, np.abs(data.xaxis[here] - held.xaxis[there]).max()) > CLOSE:
            raise ValueError(
                f"joints that are left out cannot be held where the file's keyframe has them, as that moves {name}; "
                "write that place into the file and leave the keyframe out"
            )


def _check_order(model: mujoco.MjModel, joints: tuple[str, ...], hand_site: str) -> None:
    """Whether each joint carries the next, and the last the hand."""
    bodies = [int(model.joint(name).bodyid[0]) for name in joints]
    for (before, carrier), (after, body) in zip(
        zip(joints, bodies, strict=True), zip(joints[1:], bodies[1:], strict=True), strict=False
    ):
        if carrier == body:
            raise ValueError(
                f"joints {before!r} and {after!r} belong to one body; leave one out to hold it still, or give each a "
                "body of its own in the file"
            )
        if carrier not in _ancestors(model, body):
            raise ValueError(f"joints must be in order from the base: {before!r} does not carry {after!r}")
    last = int(model.site(hand_site).bodyid[0])
    if model.body_weldid[last] != bodies[-1]:
        raise ValueError(f"site {hand_site!r} does not move with the last joint, {joints[-1]!r}")


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found
