"""MuJoCo models: reading them, turning their joints into kinematic chains, adding obstacles."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants, Hinge
from viapoint.envs.common.types import Float

SMALLEST = 1e-12
"""Principal moment of inertia of a link, [kg m^2]."""
THICK = 2e-5
"""By how much less than the sum of the others a moment is at least, relative to it: files have six digits."""
DIGITS = 12
"""To which constants are rounded, so that what should be zero is and costs nothing."""


def read_spec(model_file: str) -> mujoco.MjSpec:
    """An MJCF file: one of the package's `assets` by its name, any other by its path, or its text."""
    if model_file.lstrip().startswith("<"):
        return mujoco.MjSpec.from_string(model_file)
    own = files("viapoint.envs") / "assets" / model_file
    if Path(model_file).name == model_file and own.is_file():
        return mujoco.MjSpec.from_string(own.read_text(encoding="utf-8"))
    return mujoco.MjSpec.from_file(model_file)


def at_zero(model: mujoco.MjModel) -> mujoco.MjData:
    """The model's places with all joints at 0."""
    data = mujoco.MjData(model)
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            data.qpos[model.jnt_qposadr[joint]] = 0.0
    mujoco.mj_kinematics(model, data)
    return data


def joint_frames(model: mujoco.MjModel, names: tuple[str, ...]) -> list[tuple[Float, Float]]:
    """Axes, as columns of a matrix whose last is the joint's, and origin of each joint's frame at angle 0."""
    data, frames = at_zero(model), []
    for name in names:
        joint = model.joint(name).id
        turn = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
        frames.append((_with_last_axis(turn, data.xaxis[joint]), data.xanchor[joint].copy()))
    return frames


def chain_of(model: mujoco.MjModel, names: tuple[str, ...]) -> Chain:
    """The chain of the hinges `names`, in order from the base; everything else moves with the hinge before it."""
    data, frames, hinges = at_zero(model), joint_frames(model, names), []
    before: tuple[Float, Float] = np.eye(3), np.zeros(3)
    for name, (turn, origin) in zip(names, frames, strict=True):
        moved = moving_with(model, name)
        mass = float(model.body_mass[moved].sum())
        centre = (model.body_mass[moved, None] * data.xipos[moved]).sum(axis=0) / mass
        relative = before[0].T @ turn
        hinges.append(
            Hinge(
                turn=(_constants(relative[:, 0]), _constants(relative[:, 1]), _constants(relative[:, 2])),
                offset=_constants(before[0].T @ (origin - before[1])),
                mass=mass,
                centre=_constants(turn.T @ (centre - origin)),
                inertia=_rows(turn.T @ _inertia(model, data, moved, centre) @ turn),
            )
        )
        before = turn, origin
    return Chain(hinges=tuple(hinges))


def moving_with(model: mujoco.MjModel, name: str) -> list[int]:
    """The bodies that move with a joint and no later one."""
    body = model.jnt_bodyid[model.joint(name).id]
    return [other for other in range(model.nbody) if model.body_weldid[other] == body]


def in_frame(frame: tuple[Float, Float], point: Any) -> Constants:
    """A point of the world in a joint's frame."""
    return _constants(frame[0].T @ (np.asarray(point) - frame[1]))


def principal(inertia: tuple[Constants, ...]) -> tuple[Float, Float]:
    """Principal moments, shape (3,), and the quaternion that turns their axes into the frame's.

    Of a flat or tiny body they are those of a possible one: positive, and none as great as the sum of the others, so
    that they can be written down with fewer digits.
    """
    moments, axes = np.linalg.eigh(np.array(inertia))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    moments = np.maximum(moments, SMALLEST)
    moments[2] = min(moments[2], (1.0 - THICK) * (moments[0] + moments[1]))
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.flatten())
    return moments, quaternion


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int], centre: Float) -> Float:
    """Of bodies together about a point, in the world's axes."""
    total = np.zeros((3, 3))
    for body in bodies:
        axes, away = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
        total += axes @ np.diag(model.body_inertia[body]) @ axes.T
        total += model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    return total


def _with_last_axis(turn: Float, axis: Float) -> Float:
    """The axes of a body, in another order or turned a little, so that the last is `axis`."""
    nearest = int(np.abs(axis @ turn).argmax())
    first = turn[:, (nearest + 1) % 3]
    first = first - axis * (axis @ first)
    first = first / np.linalg.norm(first)
    return np.stack((first, np.cross(axis, first), axis), axis=-1)


def _constants(values: Float) -> Constants:
    x, y, z = (float(value) + 0.0 for value in np.round(values, DIGITS))
    return x, y, z


def _rows(matrix: Float) -> tuple[Constants, Constants, Constants]:
    return _constants(matrix[0]), _constants(matrix[1]), _constants(matrix[2])


def add_obstacles(spec: mujoco.MjSpec, number: int) -> None:
    """Add movable capsules `obstacle_0`, `obstacle_1`, ... that collide with geoms of contact type 1."""
    for row in range(number):
        body = spec.worldbody.add_body(name=f"obstacle_{row}", mocap=True, pos=(0.0, 0.0, -10.0))
        body.add_geom(
            name=f"obstacle_{row}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(0.02, 0.02, 0.0),
            contype=0,
            conaffinity=1,
            condim=1,
            rgba=(0.83, 0.52, 0.30, 1.0),
        )
