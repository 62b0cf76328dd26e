"""From an MJCF file to the record of an arm."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.models import at_zero, chain_of, in_frame, joint_frames, moving_with, read_spec
from viapoint.envs.arms.serial import Link, Posture, SerialArm

Box = tuple[tuple[float, ...], tuple[float, ...]]

BANDWIDTH = 20.0
"""Natural frequency of the joints' springs, critically damped, [rad/s]: weak beside the hand's."""
HAND_BANDWIDTH, HAND_DAMPING = 50.0, 0.75
"""Natural frequency of the hand's servo, [rad/s], and its damping relative to the critical."""


def serial_arm(
    model_file: str,
    *,
    name: str,
    joint_names: tuple[str, ...],
    hand_site: str,
    place: Posture,
    workspace: Box,
    hand_gains: tuple[float, float] | None = None,
) -> SerialArm:
    """The record of an arm whose file has everything: capsules for links, a sphere `hand`, and limits.

    Args:
        model_file: Among the package's assets, or a path.
        name: Of the arm.
        joint_names: Hinges from the base to the hand.
        hand_site: Where the hand is.
        place: The posture for a place of the hand.
        workspace: Two opposite corners of the box in which movements start and end, [m].
        hand_gains: Stiffness [N/m] and damping [N s/m] of the hand; by default for its inertia in the middle.
    """
    model = read_spec(model_file).compile()
    data = at_zero(model)
    joints = [model.joint(joint) for joint in joint_names]
    middle = np.asarray(place(np.array(workspace).mean(axis=0)))
    moved, carried = _inertia_at(model, joint_names, hand_site, middle)
    if hand_gains is None:
        hand_gains = carried * HAND_BANDWIDTH**2, 2.0 * HAND_DAMPING * carried * HAND_BANDWIDTH
    return SerialArm(
        name=name,
        model_file=model_file,
        joint_names=joint_names,
        hand_site=hand_site,
        chain=chain_of(model, joint_names),
        place=place,
        shape=_capsules(model, data, joint_names),
        hand_at=in_frame(joint_frames(model, joint_names)[-1], data.site(hand_site).xpos),
        hand_radius=float(model.geom("hand").size[0]),
        joint_range=tuple((float(joint.range[0]), float(joint.range[1])) for joint in joints),
        velocity_limit=tuple(float(v) for v in model.numeric("velocity_limit").data),
        torque_limit=tuple(float(model.jnt_actfrcrange[joint.id, 1]) for joint in joints),
        workspace=workspace,
        joint_stiffness=tuple(float(m) * BANDWIDTH**2 for m in moved),
        joint_damping=tuple(2.0 * float(m) * BANDWIDTH for m in moved),
        hand_stiffness=hand_gains[0],
        hand_damping=hand_gains[1],
    )


def _capsules(model: mujoco.MjModel, data: mujoco.MjData, joint_names: tuple[str, ...]) -> tuple[Link, ...]:
    """The capsules that move with the joints."""
    links, frames = [], joint_frames(model, joint_names)
    for index, joint in enumerate(joint_names):
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, moving_with(model, joint))):
            if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
                continue
            radius, half = model.geom_size[geom, :2]
            axis = half * data.geom_xmat[geom].reshape(3, 3)[:, 2]
            ends: Any = tuple(
                in_frame(frames[index], data.geom_xpos[geom] + side * axis) for side in (1.0, -1.0)
            )
            body = model.body(model.geom_bodyid[geom]).name
            links.append(
                Link(name=model.geom(geom).name, body=body, joint=index, ends=ends, radius=float(radius))
            )
    return tuple(links)


def _inertia_at(
    model: mujoco.MjModel, joint_names: tuple[str, ...], hand_site: str, joints: Any
) -> tuple[Any, float]:
    """What each joint alone would have to turn, [kg m^2], and the hand's inertia, the mean of all directions, [kg]."""
    data = mujoco.MjData(model)
    address = [int(model.joint(name).qposadr[0]) for name in joint_names]
    freedom = [int(model.joint(name).dofadr[0]) for name in joint_names]
    data.qpos[address] = joints
    mujoco.mj_fwdPosition(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site(hand_site).id)
    mobility = jacobian @ np.linalg.solve(full, jacobian.T)
    return np.diag(full)[freedom], float(3.0 / np.trace(mobility))
