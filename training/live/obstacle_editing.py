"""Changes of obstacles on the live page: new ones, and sizes by the names of their sliders."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from viapoint.envs import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.common.arrays import quaternion_to
from viapoint.envs.common.types import Float

if TYPE_CHECKING:
    from viapoint.training.live.scene import LiveScene
    from viapoint.training.live.setting import Setting

KINDS = {
    True: ("post", "bar", "box", "wall"),
    False: ("sphere", "capsule", "box", "cylinder", "wall"),
}
"""Names of new obstacles in the plane (True) and in space."""
BOX_SIZES = ("half-depth", "half-width", "half-height")
"""Names of the half lengths of a box."""
ANGLES = ("heading", "elevation")
"""Names of the sliders of directions."""
LEAST_SIZE = 1e-3
"""Least size of an obstacle, [m]."""
STEEPEST = 89.99
"""Greatest elevation that is set, [deg]: the heading is kept."""
WALL = 0.15
"""Distance of a new wall from the movement, at least, [m]."""
STEP, PLACES = 0.02, 20
"""Distance and number of the places to either side that are tried for a new obstacle, [m]."""


def new_obstacle(setting: Setting, scene: LiveScene, kind: str) -> Shape:
    """Return a new obstacle beside the middle of a movement, clear of the others and of both ends if there is room.

    A half-space is a wall along the movement, on the side away from the base of the arm.

    Args:
        setting: Arm and task.
        scene: Scene.
        kind: One of :data:`KINDS`.
    """
    start, goal = setting.tool(scene.start), setting.tool(scene.goal)
    line, middle = goal - start, 0.5 * (start + goal)
    aside = np.array([-line[1], line[0], 0.0])
    aside /= max(float(np.linalg.norm(aside)), 1e-9)
    way = STEP * np.arange(1, PLACES)[:, None] * aside
    if kind == "wall":
        side = 1.0 if aside @ middle >= 0.0 else -1.0
        shape: Shape = HalfSpace(quaternion=quaternion_to(-side * aside))
        places, radius = middle + side * (WALL * aside + way), 0.0
    else:
        shape = _shape(setting, kind, quaternion_to(aside))
        places = middle + np.stack((way, -way), axis=1).reshape(-1, 3)
        radius = float(np.min(shape.packed_size[:2])) if kind == "box" else float(shape.packed_size[0])
    arm = setting.task.arm
    free = np.ones(len(places), bool)
    if kind != "wall":
        for other in scene.obstacles:
            free &= other.distance(places, radius) > 0.0
    for end in (scene.start, scene.goal):
        centres = sphere_centres(arm.chain, arm.spheres, setting.task.space.joints(end))
        clear = shape.distance(centres - places[:, None]) > arm.spheres.radius
        free &= clear.all(axis=-1)
    return dataclasses.replace(shape, position=places[free.argmax()])


def _shape(setting: Setting, kind: str, across: Float) -> Shape:
    """Return a new obstacle at the origin; `across` is the orientation across the movement."""
    if not setting.planar:
        shapes: dict[str, Shape] = {
            "sphere": Sphere(0.06),
            "capsule": Capsule(0.035, 0.1, quaternion=across),
            "box": Box((0.05, 0.05, 0.05)),
            "cylinder": Cylinder(0.04, 0.08),
        }
        return shapes[kind]
    height = setting.height
    if kind == "post":
        return Cylinder(0.025, height)
    if kind == "box":
        return Box((0.03, 0.03, height))
    # A bar is a long box along the direction across the movement.
    angle = np.arctan2(*_axes(across)[1::-1, 2])
    return Box((0.09, 0.015, height), quaternion=_turn_about_z(angle))


def sizes_of(shape: Shape, planar: bool) -> dict[str, float]:
    """Return the sizes of an obstacle, by the names of their sliders, [m] and [deg].

    Round shapes have the direction of their z axis; boxes have the heading of their first axis seen from above. In the
    plane, the height does not matter and is left out.
    """
    found: dict[str, float] = {}
    if isinstance(shape, Sphere | Capsule | Cylinder):
        found["radius"] = shape.radius
    if isinstance(shape, Capsule | Cylinder) and not planar:
        found["half-length"] = shape.half_length
        axis = _axes(shape.quaternion)[:, 2]
        axis = axis if axis[0] > 0.0 or (axis[0] == 0.0 and axis[2] > 0.0) else -axis
        found["heading"] = _heading(axis)
        found["elevation"] = float(np.degrees(np.arcsin(np.clip(axis[2], -1.0, 1.0))))
    if isinstance(shape, Box):
        found |= dict(zip(BOX_SIZES[: 2 if planar else 3], map(float, shape.size), strict=False))
    if isinstance(shape, Box | HalfSpace):
        found["heading"] = (_heading(_axes(shape.quaternion)[:, _compass(shape)]) + 90.0) % 180.0 - 90.0
    return found


def resized(shape: Shape, name: str, value: float, planar: bool) -> Shape:
    """Return an obstacle with another size or direction, see :func:`sizes_of`."""
    sizes = sizes_of(shape, planar)
    if name not in ANGLES:
        value = max(value, LEAST_SIZE)
        if name in BOX_SIZES:
            size = np.array(shape.size)  # type: ignore[attr-defined]
            size[BOX_SIZES.index(name)] = value
            return dataclasses.replace(shape, size=size)  # type: ignore[call-arg]
        changed: dict[str, Any] = {name.replace("-", "_"): value}
        return dataclasses.replace(shape, **changed)
    if "elevation" not in sizes:
        turn = _turn_about_z(np.radians(value - sizes["heading"]))
        quaternion = np.empty(4)
        mujoco.mju_mulQuat(quaternion, turn, np.array(shape.quaternion))
        return dataclasses.replace(shape, quaternion=quaternion)
    sizes[name] = value
    heading = np.radians(sizes["heading"])
    elevation = np.radians(np.clip(sizes["elevation"], -STEEPEST, STEEPEST))
    flat = np.cos(elevation)
    axis = flat * np.cos(heading), flat * np.sin(heading), np.sin(elevation)
    return dataclasses.replace(shape, quaternion=quaternion_to(axis))


def _compass(shape: Shape) -> int:
    """Return the axis of a shape whose heading is shown: the normal of a wall."""
    return 2 if isinstance(shape, HalfSpace) else 0


def _axes(quaternion: Float) -> Float:
    """Return the axes of a frame as columns, shape (3, 3)."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, np.array(quaternion))
    return axes.reshape(3, 3)


def _turn_about_z(angle: float) -> Float:
    """Return the quaternion of a turn about the vertical axis, [rad]."""
    return np.array([np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)])


def _heading(axis: Float) -> float:
    """Return the direction of an axis seen from above, [deg]."""
    return float(np.degrees(np.arctan2(axis[1], axis[0])))
