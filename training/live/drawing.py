"""Triangle meshes of what the live page draws: tubes along paths, obstacles, and the parts of an arm."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import trimesh
from mjviser.conversions import get_geom_texture_id, merge_geoms
from numpy.typing import NDArray

from viapoint.envs import Arm, Box, Capsule, ConvexMesh, Cylinder, HalfSpace, PointCloud, Shape, Sphere
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float

SIDES = 8
"""Sides of a tube."""
ROUND = 40
"""Sides of a cylinder."""
WALL = 1.0, 0.02
"""Half length and half thickness of the plate that stands for a half-space, [m]."""
MOST_POINTS = 2_000
"""Greatest number of points of a cloud that are drawn."""
VISUAL_GROUPS = 3
"""Geoms of this group and higher ones are hidden by MuJoCo's viewers: they only collide."""


class Triangles(NamedTuple):
    """Triangle mesh."""

    vertices: Float
    """Shape (V, 3), [m]."""
    faces: NDArray[np.integer[Any]]
    """Shape (F, 3)."""


class Part(NamedTuple):
    """Part of an arm that moves with one body, of one colour or with textures."""

    body: int
    mesh: Any
    """Mesh of the library `trimesh`."""
    colour: tuple[int, int, int] | None
    """Colour in 0 to 255; None for a textured mesh."""


def tube(points: Float, radius: float) -> Triangles:
    """Return a closed tube along points, shape (n, 3), [m]."""
    number, along = len(points), np.gradient(points, axis=0)
    along = along / np.maximum(norm(along), 1e-12)[:, None]
    side = np.eye(3)[np.abs(along[0]).argmin()]
    sides = np.empty_like(points)
    for i, direction in enumerate(along):  # parallel transport: the tube does not twist
        side = side - direction * (direction @ side)
        length = float(np.sqrt(side @ side))
        side = side / length if length > 1e-9 else np.eye(3)[np.abs(direction).argmin()]
        sides[i] = side
    across = np.cross(along, sides)
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    ring = np.cos(angle)[:, None] * sides[:, None] + np.sin(angle)[:, None] * across[:, None]
    vertices = (points[:, None] + radius * ring).reshape(-1, 3)
    return Triangles(np.concatenate((vertices, points[[0, -1]])), _tube_faces(number))


@functools.cache
def _tube_faces(number: int) -> NDArray[np.integer[Any]]:
    """Return the faces of a tube of `number` rings whose end points are the last two vertices."""
    first = np.arange(number - 1)[:, None] * SIDES
    here, there = first + np.arange(SIDES), first + (np.arange(SIDES) + 1) % SIDES
    walls = np.stack((here, there, there + SIDES, here, there + SIDES, here + SIDES), axis=-1).reshape(-1, 3)
    ring, following = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    last = (number - 1) * SIDES
    begin = np.stack((np.full(SIDES, number * SIDES), following, ring), axis=-1)
    end = np.stack((np.full(SIDES, number * SIDES + 1), ring + last, following + last), axis=-1)
    return np.concatenate((walls, begin, end))


def obstacle_mesh(shape: Shape, levels: tuple[float, float] | None = None) -> Triangles:
    """Return the mesh of an obstacle around its position, turned as it is in the world.

    Args:
        shape: Obstacle.
        levels: Least and greatest height of an obstacle in the plane, which is cut off there, [m]; None for space.
    """
    mesh = _mesh(shape)
    vertices = np.asarray(mesh.vertices) @ shape.rotation.T
    if levels is not None:
        vertices[:, 2] = np.clip(vertices[:, 2] + shape.position[2], *levels) - shape.position[2]
    return Triangles(vertices, np.asarray(mesh.faces))


def _mesh(shape: Shape) -> Any:
    """Return the mesh of a shape in its own frame."""
    create = trimesh.creation
    match shape:
        case Sphere():
            return create.icosphere(subdivisions=3, radius=shape.radius)
        case Capsule():
            return create.capsule(height=2.0 * shape.half_length, radius=shape.radius, count=(ROUND, ROUND))
        case Cylinder():
            return create.cylinder(radius=shape.radius, height=2.0 * shape.half_length, sections=ROUND)
        case Box():
            return create.box(extents=2.0 * np.asarray(shape.size))
        case HalfSpace():
            length, thick = WALL
            plate = create.box(extents=(2.0 * length, 2.0 * length, 2.0 * thick))
            return plate.apply_translation((0.0, 0.0, -thick))
        case ConvexMesh():
            return trimesh.convex.convex_hull(np.reshape(shape.vertices, (-1, 3)))
        case PointCloud():
            ball = create.icosphere(subdivisions=1, radius=shape.radius)
            points = shape.points[:: -(-len(shape.points) // MOST_POINTS)]
            return trimesh.util.concatenate([ball.copy().apply_translation(point) for point in points])
    raise ValueError(f"obstacles of the shape {shape.kind} cannot be drawn")


class ArmDrawing:
    """Parts of an arm and their poses.

    Args:
        arm: Arm that moves.
        model: MuJoCo model of the environment.
        model_file: MJCF file that the arm was loaded from; its visible geoms replace the capsules.
    """

    def __init__(self, arm: Arm, model: mujoco.MjModel, model_file: str | Path | None = None) -> None:
        self._offset = np.zeros(3)
        if model_file is not None:
            own = _first_anchor(model, arm)
            model = _read(model_file)
            self._offset = own - _first_anchor(model, arm)
        self._model, self._data = model, mujoco.MjData(model)
        if model_file is not None and model.nkey:
            mujoco.mj_resetDataKeyframe(model, self._data, 0)
        self._joints = np.array([model.joint(name).qposadr[0] for name in arm.joint_names])
        self.parts = tuple(self._find_parts(own=model_file is not None))
        """Parts of the arm."""

    def poses(self, joints: Float) -> list[tuple[Float, Float]]:
        """Return quaternion and position of each part for joint angles, shape (J,), [rad]."""
        self._data.qpos[self._joints] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return [
            (self._data.xquat[part.body].copy(), self._data.xpos[part.body] + self._offset)
            for part in self.parts
        ]

    def _find_parts(self, *, own: bool) -> list[Part]:
        """Return the visible geoms of the arm, those of one body and colour together."""
        model, groups = self._model, dict[tuple[int, Any], list[int]]()
        visible = [g for g in range(model.ngeom) if self._visible(g)]
        shown = [g for g in visible if model.geom_group[g] < VISUAL_GROUPS] or visible if own else visible
        for geom in shown:
            textured = get_geom_texture_id(model, geom) >= 0
            material = int(model.geom_matid[geom])
            rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            colour = None if textured else tuple(int(255 * c) for c in rgba[:3])
            groups.setdefault((int(model.geom_bodyid[geom]), colour), []).append(geom)
        return [Part(body, merge_geoms(model, geoms), colour) for (body, colour), geoms in groups.items()]

    def _visible(self, geom: int) -> bool:
        model, body = self._model, self._model.geom_bodyid[geom]
        plane = model.geom_type[geom] in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        return not plane and model.body_mocapid[body] < 0 and model.geom_rgba[geom, 3] > 0.0


def _first_anchor(model: mujoco.MjModel, arm: Arm) -> Float:
    """Return the place of the first joint in a model, [m]."""
    data = mujoco.MjData(model)
    joint = model.joint(arm.joint_names[0])
    data.qpos[joint.qposadr[0]] = 0.0
    mujoco.mj_kinematics(model, data)
    return np.array(data.xanchor[joint.id])


def _read(path: str | Path) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be drawn: {' '.join(str(error).split())}") from None
