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

from viapoint.envs.arms.mjcf import joint_frames
from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import dimension_of, shape_columns
from viapoint.envs.geometry.shapes import SHAPES

SIDES = 8
"""Sides of a tube."""
LOW, TALL = 0.030, 0.060
"""Height of obstacles in the plane, [m]: below links that pass above them, and where links collide."""
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


def obstacle_mesh(row: Float, floor: float, height: float) -> Triangles:
    """Return the mesh of an obstacle about its centre, in the plane a wall with its footprint.

    In space, the vertices are the farthest points of the shape in the directions of a sphere's vertices. The mesh of a
    half-space is that of its box.

    Args:
        row: Row with shapes, see :mod:`viapoint.envs.geometry.rows`, [m].
        floor: Height of the table of a planar arm, [m].
        height: Height up to which an obstacle of the plane rises, [m].
    """
    kind, centre, quaternion, half = shape_columns(row)
    name = list(SHAPES)[int(kind)]
    shape = SHAPES["box" if name == "half_space" else name].from_box(centre, quaternion, half)
    if dimension_of(row) == 2:
        (outline,) = shape.footprint()
        return _prism(outline - centre[:2], floor, height)
    directions, faces = _sphere()
    return Triangles(shape.support(directions) @ shape.rotation.T, faces)


@functools.cache
def _sphere() -> tuple[Float, NDArray[np.integer[Any]]]:
    """Return vertices and faces of a unit sphere with vertices on all axes."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.round(mesh.vertices, 12), np.asarray(mesh.faces)


def _prism(outline: Float, low: float, high: float) -> Triangles:
    """Return an upright prism with a convex outline, shape (n, 2), [m]."""
    n = len(outline)
    vertices = np.concatenate([in_space(outline, level) for level in (low, high, high)])  # sharp upper edge
    ring, following = np.arange(n), (np.arange(n) + 1) % n
    walls = np.stack((ring, following, following + n, ring, following + n, ring + n), axis=-1).reshape(-1, 3)
    fan = np.stack((np.zeros(n - 2, dtype=int), np.arange(1, n - 1), np.arange(2, n)), axis=-1) + 2 * n
    return Triangles(vertices, np.concatenate((walls, fan)))


class ArmDrawing:
    """Parts of an arm and their poses.

    Args:
        arm: Arm that moves.
        model: MuJoCo model of the environment.
        model_file: MJCF file that the arm was loaded from; its visible geoms replace the capsules.
    """

    def __init__(self, arm: Any, model: mujoco.MjModel, model_file: str | Path | None = None) -> None:
        self._offset, names = np.zeros(3), getattr(arm, "joint_names", ())
        if model_file is not None:
            frames = joint_frames(model, names)
            model = _read(model_file)
            self._offset = frames[0][1] - joint_frames(model, names)[0][1]
        self._model, self._data = model, mujoco.MjData(model)
        if model_file is not None and model.nkey:
            mujoco.mj_resetDataKeyframe(model, self._data, 0)
        every = [model.joint(name).qposadr[0] for name in names] or range(len(arm.joint_range))
        self._joints = np.array(every, dtype=np.int64)
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


def _read(path: str | Path) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be drawn: {' '.join(str(error).split())}") from None
