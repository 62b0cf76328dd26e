"""Obstacles of N scenes as packed arrays, as MuJoCo's geoms, and as rows of observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import mujoco
import numpy as np

from viapoint.envs.common.arrays import Bool, Float, Int, frame_matrices
from viapoint.envs.geometry.meshes import (
    NO_CLOUDS,
    NO_MESHES,
    Clouds,
    Meshes,
    join_clouds,
    join_meshes,
    split_clouds,
    split_meshes,
)
from viapoint.envs.geometry.shapes import (
    ABSENT,
    BOX,
    CAPSULE,
    CYLINDER,
    HALF_SPACE,
    IN_TABLES,
    KINDS,
    MESH,
    POINT_CLOUD,
    REGISTERED_MESHES,
    SHAPES,
    SPHERE,
    ConvexMesh,
    PointCloud,
    Shape,
    as_obstacles,
    registered_name,
)

__all__ = [
    "ABSENT", "BOX", "CAPSULE", "CYLINDER", "HALF_SPACE", "KINDS", "MESH", "POINT_CLOUD", "POSE_SIZE", "SPHERE",
    "Obstacles", "add_to_model", "geom_fields", "geom_meshes", "no_obstacles", "observation_rows",
    "obstacles_from_rows", "pack", "unpack",
]  # fmt: skip

POSE_SIZE = 16
"""Numbers of an obstacle in an observation after those of its kind: centre 3, axes 6, half lengths 3, velocity 3,
present 1."""
EXTENT = 1.0  # Half length of the cube that stands for a half-space in observations, [m]
# Matrices of bounding boxes by kind, see :attr:`Shape.box`
BOXES = np.array([shape.box for shape in SHAPES], np.float64)
GEOMS = np.array([shape.geom for shape in SHAPES])  # MuJoCo's geoms by kind

Table = TypeVar("Table", Meshes, Clouds)


class Obstacles(NamedTuple):
    """Up to n obstacles in each of N scenes.

    The meaning of `size` depends on the kind, in MuJoCo's convention: sphere (radius, -, -), capsule and cylinder
    (radius, half length, -), box (three half lengths), half-space (-, -, -), mesh and point cloud (index of the table,
    radius of the bounding sphere around the origin of the frame, -).

    Example:
        >>> from viapoint.envs import Box, Sphere
        >>> from viapoint.envs.geometry.obstacles import pack
        >>> obstacles = pack([[Sphere(0.1)], [Sphere(0.1), Box((0.1, 0.1, 0.2))]])
        >>> obstacles.present.tolist()
        [[True, False], [True, True]]
    """

    kind: Int
    """Number of the kind, or ABSENT, shape (N, n)."""
    centre: Float
    """Origins of the frames at time 0, shape (N, n, 3), [m]."""
    rotation: Float
    """Rotation matrices, the axes of the frames as columns, shape (N, n, 3, 3)."""
    size: Float
    """Sizes, shape (N, n, 3), [m]."""
    velocity: Float
    """Velocities, shape (N, n, 3), [m/s]."""
    meshes: Meshes
    """Meshes that obstacles refer to."""
    clouds: Clouds
    """Point clouds that obstacles refer to."""

    @property
    def present(self) -> Bool:
        """True for rows that hold an obstacle, shape (N, n)."""
        return np.asarray(self.kind != ABSENT)

    def take(self, scenes: Any) -> Obstacles:
        """Return some of the scenes, by indices, mask or slice."""
        scenes = np.arange(len(self.kind))[scenes]
        kind, centre, rotation, size, velocity = (part[scenes] for part in self[:5])
        return Obstacles(kind, centre, rotation, size, velocity, self.meshes, self.clouds)

    def with_rows(self, rows: int) -> Obstacles:
        """Return the obstacles with another number of rows in each scene; those behind are left out."""
        wide = no_obstacles(len(self.kind), rows)
        kept = min(rows, self.kind.shape[1])
        present = self.present[:, :kept]
        for mine, theirs in zip(wide[:5], self[:5], strict=True):
            mine[:, :kept][present] = theirs[:, :kept][present]
        return wide._replace(meshes=self.meshes, clouds=self.clouds)

    def put(self, scenes: Any, others: Obstacles) -> Obstacles:
        """Return the obstacles after scenes, by indices, mask or slice, were overwritten in place; only tables are new.

        The others have as many rows.
        """
        for mine, theirs in zip(self[:5], others[:5], strict=True):
            mine[scenes] = theirs
        tables = (self.meshes.normals, others.meshes.normals, self.clouds.points, others.clouds.points)
        if not any(map(len, tables)):
            return self
        new = np.zeros(self.kind.shape, bool)
        new[scenes] = True
        meshes = self._merged(MESH, new, split_meshes(self.meshes), split_meshes(others.meshes))
        clouds = self._merged(POINT_CLOUD, new, split_clouds(self.clouds), split_clouds(others.clouds))
        return self._replace(meshes=join_meshes(meshes), clouds=join_clouds(clouds))

    def _merged(self, kind: int, new: Bool, before: list[Table], added: list[Table]) -> list[Table]:
        """Return the different tables of a kind in use, and set the indices of the obstacles that refer to them.

        Those that are `new`, shape (N, n), refer to the added tables.
        """
        rows = self.kind == kind
        number = self.size[rows][:, 0].astype(np.int64) + len(before) * new[rows]
        used, place = np.unique(number, return_inverse=True)
        tables = [(before + added)[i] for i in used]
        contents = [tuple(np.asarray(part).tobytes() for part in table) for table in tables]
        different = dict(zip(contents, tables, strict=True))
        index = np.array([list(different).index(content) for content in contents], np.float64)
        self.size[rows, 0] = index[place]
        return list(different.values())


def no_obstacles(n_scenes: int, n_rows: int = 0) -> Obstacles:
    """Return scenes without obstacles, with rows for some."""
    shape = (n_scenes, n_rows)
    rotation = np.tile(np.eye(3), (*shape, 1, 1))
    centre, size, velocity = np.zeros((3, *shape, 3))
    kind = np.full(shape, ABSENT, np.int64)
    return Obstacles(kind, centre, rotation, size, velocity, NO_MESHES, NO_CLOUDS)


def pack(scenes: Sequence[Iterable[Shape | Mapping[str, Any]]], rows: int | None = None) -> Obstacles:
    """Return the obstacles of N scenes as packed arrays.

    Args:
        scenes: Shapes or dictionaries of each scene.
        rows: Number of rows for obstacles, enough for each scene; by default, the greatest number of obstacles of one.

    Raises:
        ValueError: An obstacle is not allowed.
    """
    shapes = [as_obstacles(scene) for scene in scenes]
    if rows is None:
        rows = max(map(len, shapes), default=0)
    found = no_obstacles(len(shapes), rows)
    meshes: list[Meshes] = []
    clouds: list[Clouds] = []
    for scene, each in enumerate(shapes):
        if not each:
            continue
        present = slice(len(each))
        found.kind[scene, present] = [shape.number for shape in each]
        found.centre[scene, present] = [shape.position for shape in each]
        # One call for all is ten times as fast as the attribute of each shape.
        found.rotation[scene, present] = frame_matrices(np.array([shape.quaternion for shape in each]))
        found.size[scene, present] = [shape.packed_size for shape in each]
        found.velocity[scene, present] = [shape.velocity for shape in each]
        for row, shape in enumerate(each):
            if shape.mesh is not None:
                found.size[scene, row, 0] = len(meshes)
                meshes.append(shape.mesh)
            if shape.cloud is not None:
                found.size[scene, row, 0] = len(clouds)
                clouds.append(shape.cloud)
    if not meshes and not clouds:
        return found
    found = found._replace(meshes=join_meshes(meshes), clouds=join_clouds(clouds))
    # Each different table is kept once.
    return no_obstacles(len(shapes), rows).put(slice(None), found)


def unpack(obstacles: Obstacles, scene: int) -> list[Shape]:
    """Return the obstacles of a scene as shapes, without names; meshes have the vertices of their triangles."""
    found = list[Shape]()
    quaternions = quaternions_of(obstacles.rotation[scene])
    for row in np.flatnonzero(obstacles.kind[scene] != ABSENT):
        shape = SHAPES[obstacles.kind[scene, row]]
        size = obstacles.size[scene, row]
        values: dict[str, Any] = {
            "position": obstacles.centre[scene, row],
            "quaternion": quaternions[row],
            "velocity": obstacles.velocity[scene, row],
        }
        if shape is ConvexMesh:
            corners = split_meshes(obstacles.meshes)[int(size[0])].corners
            values["vertices"] = np.unique(corners.reshape(-1, 3), axis=0)
        elif shape is PointCloud:
            cloud = split_clouds(obstacles.clouds)[int(size[0])]
            values.update(points=cloud.points, radius=float(cloud.radius[0]))
        else:
            sizes = iter(size)
            for name, each in shape.sizes.items():
                values[name] = [next(sizes) for _ in range(3)] if each else next(sizes)
        found.append(shape(**values))
    return found


def quaternions_of(rotation: Float) -> Float:
    """Return the quaternions, shape (..., 4), of rotation matrices, shape (..., 3, 3)."""
    matrices = rotation.reshape(-1, 9)
    found = np.empty((len(matrices), 4))
    for quaternion, matrix in zip(found, matrices, strict=True):
        mujoco.mju_mat2Quat(quaternion, matrix)
    return found.reshape(*rotation.shape[:-2], 4)


def mesh_names(meshes: Meshes, among: Iterable[str] | None = None) -> list[str]:
    """Return the registered names of packed meshes, empty for others; `among` are the names that count."""
    return [registered_name(mesh.corners.reshape(-1, 3), among) for mesh in split_meshes(meshes)]


def bounding_boxes(obstacles: Obstacles) -> tuple[Float, Float]:
    """Return centres in the world and half lengths along the axes of boxes around obstacles, (N, n, 3) each, [m].

    The box of a half-space is a cube below the point of the surface that is nearest to the origin.
    """
    kind, rotation = obstacles.kind, obstacles.rotation
    half = np.einsum("...i,...ij->...j", obstacles.size, BOXES[kind])
    middle = np.zeros_like(half)
    for number in IN_TABLES:
        rows = kind == number
        if rows.any():
            boxes = _mesh_boxes(obstacles.meshes) if number == MESH else _cloud_boxes(obstacles.clouds)
            box = boxes[obstacles.size[rows][:, 0].astype(np.int64)]
            middle[rows] = 0.5 * (box[:, 1] + box[:, 0])
            half[rows] = 0.5 * (box[:, 1] - box[:, 0])
    centre = obstacles.centre + np.einsum("...ij,...j->...i", rotation, middle)
    walls = kind == HALF_SPACE  # which have no size
    normal = rotation[walls][:, :, 2]
    depth = (centre[walls] * normal).sum(axis=-1, keepdims=True)
    centre[walls] = (depth - EXTENT) * normal
    half[walls] = EXTENT
    return centre, half


def _mesh_boxes(meshes: Meshes) -> Float:
    """Return the least and greatest corner of meshes, shape (M, 2, 3), [m]."""
    low = np.minimum.reduceat(meshes.corners.min(axis=1), meshes.first[:-1])
    high = np.maximum.reduceat(meshes.corners.max(axis=1), meshes.first[:-1])
    return np.stack((low, high), axis=1)


def _cloud_boxes(clouds: Clouds) -> Float:
    """Return the least and greatest corner of clouds, shape (C, 2, 3), [m]."""
    roots = clouds.boxes[clouds.node[:-1] + 1].reshape(-1, 2, 3)
    return np.asarray(roots + clouds.radius[:, None, None] * np.array([[-1.0], [1.0]]))


def observation_rows(obstacles: Obstacles, kinds: Sequence[str]) -> Float:
    """Return obstacles as rows of numbers for networks, shape (N, n, K + POSE_SIZE); absent rows are zero.

    A row is (one-hot kind K, centre 3, rotation 6, half lengths 3, velocity 3, present 1). Centre and half lengths are
    those of the bounding box along the axes of the frame, [m]. The rotation is the first two axes of the frame (Zhou
    et al., On the continuity of rotation representations in neural networks, 2019).

    Args:
        obstacles: Obstacles of N scenes.
        kinds: Names of K kinds or registered meshes.

    Raises:
        ValueError: An obstacle has none of the kinds.

    Example:
        >>> from viapoint.envs.geometry.obstacles import observation_rows, pack
        >>> from viapoint.envs.geometry.shapes import Box
        >>> obstacles = pack([[Box((0.1, 0.2, 0.25), position=(0.5, 0.0, 0.25))]])
        >>> observation_rows(obstacles, ("box",))[0, 0].tolist()
        [1.0, 0.5, 0.0, 0.25, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.1, 0.2, 0.25, 0.0, 0.0, 0.0, 1.0]
    """
    columns = np.array([kinds.index(kind) if kind in kinds else -1 for kind in KINDS])
    column = columns[obstacles.kind]
    for index, name in enumerate(mesh_names(obstacles.meshes, kinds)):
        if name:
            column[(obstacles.kind == MESH) & (obstacles.size[..., 0] == index)] = kinds.index(name)
    present = obstacles.present
    unknown = present & (column < 0)
    if unknown.any():
        names = sorted({KINDS[kind] for kind in obstacles.kind[unknown]})
        raise ValueError(f"obstacles must have the shapes {', '.join(kinds)}, not {', '.join(names)}")
    centre, half = bounding_boxes(obstacles)
    axes = obstacles.rotation
    one_hot = column[..., None] == np.arange(len(kinds))
    parts = (one_hot, centre, axes[..., 0], axes[..., 1], half, obstacles.velocity, present[..., None])
    return np.where(present[..., None], np.concatenate(parts, axis=-1), 0.0)


def obstacles_from_rows(rows: Float, kinds: Sequence[str]) -> Obstacles:
    """Return the obstacles of :func:`observation_rows`, to the precision of the rows.

    Raises:
        ValueError: A row is a mesh without a name or a point cloud, which rows do not describe.

    Example:
        >>> from viapoint.envs import Sphere, obstacles_from_rows
        >>> from viapoint.envs.geometry.obstacles import observation_rows, pack
        >>> rows = observation_rows(pack([[Sphere(0.1)]]), ["sphere", "box"])
        >>> obstacles_from_rows(rows, ["sphere", "box"]).size[0, 0, 0].round(6)
        np.float64(0.1)
    """
    named = {name: mesh for name in kinds if (mesh := REGISTERED_MESHES.get(name)) is not None}
    numbers = np.array([MESH if name in named else KINDS.index(name) for name in kinds])
    tables = np.array([list(named).index(name) if name in named else -1 for name in kinds])
    meshes = join_meshes(shape.mesh for shape in named.values() if shape.mesh is not None)
    found = no_obstacles(*rows.shape[:2])._replace(meshes=meshes)
    present = rows[..., -1] > 0.5
    column = rows[present][:, : len(kinds)].argmax(axis=-1)
    kind, table = numbers[column], tables[column]
    if ((kind == POINT_CLOUD) | ((kind == MESH) & (table < 0))).any():
        raise ValueError("rows do not describe point clouds, and meshes without a name")
    values = rows[present][:, len(kinds) :].astype(np.float64)
    centre = values[:, :3]
    half = values[:, 9:12]
    velocity = values[:, 12:15]
    # Rows in single precision have axes that are not quite orthonormal.
    first = values[:, 3:6] / np.linalg.norm(values[:, 3:6], axis=-1, keepdims=True)
    third = np.cross(first, values[:, 6:9])  # orthogonal to the first whatever the second is
    third /= np.linalg.norm(third, axis=-1, keepdims=True)
    rotation = np.stack((first, np.cross(third, first), third), axis=-1)
    size = np.einsum("...i,...ij->...j", half, np.linalg.pinv(BOXES)[kind])
    centre = centre + EXTENT * third * (kind == HALF_SPACE)[:, None]
    for index, (box, shape) in enumerate(zip(_mesh_boxes(meshes), named.values(), strict=True)):
        same = table == index
        centre[same] -= rotation[same] @ box.mean(axis=0)
        size[same] = (index, shape.packed_size[1], 0.0)
    for array, part in zip(found[:5], (kind, centre, rotation, size, velocity), strict=True):
        array[present] = part
    return found


def geom_meshes(obstacles: Obstacles, among: Iterable[str] | None = None) -> Any:
    """Return the registered names of meshes, empty for other shapes, shape (N, n), after a check of all obstacles.

    `among` are the names that count; all by default.

    Raises:
        ValueError: An obstacle is a point cloud, which has many geoms, or a mesh without a name.
    """
    kind = obstacles.kind
    if (kind == POINT_CLOUD).any():
        raise ValueError("a point cloud is no single geom; use a sphere for each of PointCloud.covering")
    meshes = kind == MESH
    names = np.array([*mesh_names(obstacles.meshes, among), ""])
    found = names[np.where(meshes, obstacles.size[..., 0], -1).astype(np.int64)]
    if (meshes & (found == "")).any():
        raise ValueError("meshes must have a name; register_mesh gives them one")
    return found


def geom_fields(obstacles: Obstacles) -> dict[str, Any]:
    """Return the values of MuJoCo's fields of geoms, shape (N, n, ...); absent obstacles are small spheres.

    Those of meshes are incomplete: MuJoCo turns a mesh into a frame of its own.
    """
    kind, present = obstacles.kind, obstacles.present
    meshes = kind == MESH
    size = np.where((present & ~meshes)[..., None], obstacles.size, (0.01, 0.0, 0.0))
    # MuJoCo's bounding spheres: planes have none, and the sizes of other shapes are legs of a right angle.
    bound = np.where(kind == CAPSULE, size.sum(axis=-1), np.linalg.norm(size, axis=-1))
    bound = np.where(meshes, obstacles.size[..., 1], bound)
    _, half = bounding_boxes(obstacles)
    half = np.where(present[..., None], half, size[..., :1])
    return {
        "geom_type": np.where(present, GEOMS[kind], mujoco.mjtGeom.mjGEOM_SPHERE).astype(np.int64),
        "geom_size": np.where((kind == HALF_SPACE)[..., None], (0.0, 0.0, 0.01), size),
        "geom_rbound": np.where(kind == HALF_SPACE, 0.0, bound),
        "geom_aabb": np.concatenate((np.zeros_like(half), half), axis=-1),
    }


def add_to_model(
    spec: mujoco.MjSpec, obstacles: Iterable[Shape | Mapping[str, Any]], body: Any = None, **attributes: Any
) -> list[list[str]]:
    """Add the geoms of obstacles to a MuJoCo model, and return their names, one list for each obstacle.

    Args:
        spec: Model.
        obstacles: Shapes or dictionaries, with different names; a point cloud becomes a sphere for each point.
        body: Body of the geoms; the world by default.
        **attributes: Attributes of all geoms, such as `contype` or `rgba`.
    """
    body = spec.worldbody if body is None else body
    shapes = as_obstacles(obstacles)
    named = [shape.name or f"obstacle_{i}" for i, shape in enumerate(shapes)]
    if len(set(named)) < len(named):
        raise ValueError(f"obstacles must have different names, got {', '.join(named)}")
    found = []
    for name, shape in zip(named, shapes, strict=True):
        places, size, mesh = [shape.position], shape.packed_size, {}
        if isinstance(shape, PointCloud):
            places = list(shape.points @ shape.rotation.T + shape.position)
            size = np.array([shape.radius, 0.0, 0.0])
        elif isinstance(shape, ConvexMesh):
            mesh = {"meshname": f"{name}_0"}
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=f"{name}_0", uservert=shape.vertices.ravel(), inertia=shell)
        elif shape.number == HALF_SPACE:
            size = np.array([0.0, 0.0, 0.01])
        found.append([f"{name}_{i}" for i in range(len(places))])
        for geom, place in zip(found[-1], places, strict=True):
            pose = {"pos": place, "quat": shape.quaternion}
            body.add_geom(name=geom, type=shape.geom, size=size, **pose, **mesh, **attributes)
    return found
