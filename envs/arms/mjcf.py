"""MuJoCo models of arms: files, joint frames, kinematic chains, and the bodies of obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants, Hinge
from viapoint.envs.common.types import Box, Float
from viapoint.envs.geometry.shapes import SHAPES, add_to_model

Pose = tuple[Float, Float]
"""Axes, as the columns of a rotation matrix, and origin of a frame in the world, [m]."""

MIN_INERTIA = 1e-12
"""Least principal moment of inertia of a link, [kg m^2]."""
INERTIA_MARGIN = 2e-5
"""Relative margin of the triangle inequality of principal moments; model files keep six digits."""
HIDDEN_GROUP = 5
"""Group of geoms that MuJoCo does not draw."""
DIGITS = 12
"""Decimal places of constants, so that entries that should be 0 are 0, and cost nothing."""


def read_spec(model_file: str) -> mujoco.MjSpec:
    """Return an MJCF model: one of the package's `assets` by name, another file by its path, or the text of a file."""
    if model_file.lstrip().startswith("<"):
        return mujoco.MjSpec.from_string(model_file)
    own = files("viapoint.envs") / "assets" / model_file
    if Path(model_file).name == model_file and own.is_file():
        return mujoco.MjSpec.from_string(own.read_text(encoding="utf-8"))
    return mujoco.MjSpec.from_file(model_file)


def zero_configuration(model: mujoco.MjModel) -> mujoco.MjData:
    """Return the positions of all parts of the model with every hinge at angle 0."""
    data = mujoco.MjData(model)
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    data.qpos[model.jnt_qposadr[hinges]] = 0.0
    mujoco.mj_kinematics(model, data)
    return data


def joint_frames(model: mujoco.MjModel, names: tuple[str, ...]) -> list[Pose]:
    """Return the frame of each joint at angle 0; its z axis is the joint's axis."""
    data, frames = zero_configuration(model), []
    for name in names:
        joint = model.joint(name).id
        turn = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
        frames.append((_with_last_axis(turn, data.xaxis[joint]), data.xanchor[joint].copy()))
    return frames


def kinematic_chain(model: mujoco.MjModel, names: tuple[str, ...]) -> Chain:
    """Return the chain of some hinges, in order from the base; other bodies move with the nearest hinge below them."""
    data, hinges = zero_configuration(model), []
    previous: Pose = np.eye(3), np.zeros(3)
    for name, (turn, origin) in zip(names, joint_frames(model, names), strict=True):
        moved = bodies_moved_by(model, name)
        mass = float(model.body_mass[moved].sum())
        centre = (model.body_mass[moved, None] * data.xipos[moved]).sum(axis=0) / mass
        relative = previous[0].T @ turn
        hinges.append(
            Hinge(
                turn=(_constants(relative[:, 0]), _constants(relative[:, 1]), _constants(relative[:, 2])),
                offset=in_frame(previous, origin),
                mass=mass,
                centre=in_frame((turn, origin), centre),
                inertia=_rows(turn.T @ _inertia(model, data, moved, centre) @ turn),
            )
        )
        previous = turn, origin
    return Chain(hinges=tuple(hinges))


def bodies_moved_by(model: mujoco.MjModel, joint: str) -> list[int]:
    """Return the bodies that move with a joint and with no later one."""
    body = model.jnt_bodyid[model.joint(joint).id]
    return [other for other in range(model.nbody) if model.body_weldid[other] == body]


def in_frame(frame: Pose, point: Any) -> Constants:
    """Return a point of the world in a frame."""
    return _constants(frame[0].T @ (np.asarray(point) - frame[1]))


def quaternion_of(matrix: Float) -> Float:
    """Return the quaternion of a rotation matrix."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, matrix.flatten())
    return quaternion


def principal_inertia(inertia: tuple[Constants, ...]) -> tuple[Float, Float]:
    """Return the principal moments, shape (3,), and the quaternion of their axes.

    The moments of a physical body are positive, and none exceeds the sum of the others. Those of flat and tiny bodies
    are changed until this holds with a margin, because a model file has fewer digits.
    """
    moments, axes = np.linalg.eigh(np.array(inertia))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    moments = np.maximum(moments, MIN_INERTIA)
    moments[2] = min(moments[2], (1.0 - INERTIA_MARGIN) * (moments[0] + moments[1]))
    return moments, quaternion_of(axes)


def add_obstacles(spec: mujoco.MjSpec, number: int, meshes: Sequence[str] = ()) -> None:
    """Add movable capsules `obstacle_0`, `obstacle_1`, ... that collide with geoms of contact type 1.

    Each mesh, a name of :data:`~viapoint.envs.geometry.shapes.SHAPES`, is added as the geom `mesh_NAME_0`. It collides
    with nothing; the model then holds what obstacles of this shape need.
    """
    if meshes:
        store = spec.worldbody.add_body(name="meshes", pos=(0.0, 0.0, -10.0))
        shapes = [SHAPES[name](name=f"mesh_{name}") for name in meshes]
        add_to_model(spec, shapes, store, contype=0, conaffinity=0, group=HIDDEN_GROUP)
    for row in range(number):
        name = f"obstacle_{row}"
        body = spec.worldbody.add_body(name=name, mocap=True, pos=(0.0, 0.0, -10.0))
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.02, 0.02, 0.0), contype=0, conaffinity=1, condim=1,
            rgba=(0.83, 0.52, 0.30, 1.0),
        )  # fmt: skip


def as_box(corners: Any) -> Box:
    """Return two corners, shape (2, D), as tuples."""
    low, high = np.asarray(corners, dtype=np.float64)
    return tuple(map(float, low)), tuple(map(float, high))


def grid(axes: Any) -> Float:
    """Return all points of a rectilinear grid, shape (A, B, C, 3), from its coordinates along each axis."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int], centre: Float) -> Float:
    """Return the rotational inertia of bodies together about a point, in world axes (parallel axis theorem)."""
    total = np.zeros((3, 3))
    for body in bodies:
        axes, away = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
        total += axes @ np.diag(model.body_inertia[body]) @ axes.T
        total += model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    return total


def _with_last_axis(turn: Float, axis: Float) -> Float:
    """Return the axes of a body, reordered and turned as little as possible, so that the last one is `axis`."""
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
