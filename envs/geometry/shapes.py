"""Shapes of obstacles as users write them, with one compiled function each: the signed distance of a point.

A new shape is a name in KINDS with a constant, a function with a line in :func:`local_distance`, and a class in SHAPES.
Everything else follows; CONTRIBUTING.md shows it for an ellipsoid.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import Float, frame_matrices, frozen, quaternion_to
from viapoint.envs.common.validation import finite_array, number_of_at_least, unit_quaternion
from viapoint.envs.geometry.compiled import TINY, Vector, inlined, kernel
from viapoint.envs.geometry.meshes import (
    FAR,
    NO_CLOUDS,
    NO_MESHES,
    Clouds,
    Meshes,
    build_cloud,
    build_mesh,
    cloud_distance,
    convex_hull,
    mesh_distance,
)

# Kinds of obstacles; the number of a kind is its place in this table
KINDS = ("sphere", "capsule", "cylinder", "box", "half_space", "convex_mesh", "point_cloud")
SPHERE, CAPSULE, CYLINDER, BOX, HALF_SPACE, MESH, POINT_CLOUD = range(len(KINDS))
ABSENT = -1  # Kind of a row that holds no obstacle
# Kinds whose first size is an index of a table, and whose second is the radius of a bounding sphere
IN_TABLES = (MESH, POINT_CLOUD)
# Kinds that are known by their sizes alone
PLAIN_KINDS = tuple(kind for number, kind in enumerate(KINDS) if number not in IN_TABLES)
LEAST_SPACING = 1e-6  # Least edge of the cubes of :meth:`PointCloud.covering`, [m]

Matrix = tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]
Distance = tuple[float, float, float, float]  # Signed distance, [m], and the components of its gradient


@kernel
def sphere_distance(radius: float, x: float, y: float, z: float) -> Distance:
    """Return the signed distance of a point from a sphere around the origin, and its gradient."""
    length = math.sqrt(x * x + y * y + z * z)
    if length < TINY:
        return -radius, 0.0, 0.0, 1.0
    return length - radius, x / length, y / length, z / length


@kernel
def capsule_distance(radius: float, half_length: float, x: float, y: float, z: float) -> Distance:
    """Return the signed distance of a point from a capsule along the z axis, and its gradient."""
    beyond = z - min(max(z, -half_length), half_length)
    length = math.sqrt(x * x + y * y + beyond * beyond)
    if length < TINY:
        return -radius, 1.0, 0.0, 0.0
    return length - radius, x / length, y / length, beyond / length


@kernel
def cylinder_distance(radius: float, half_length: float, x: float, y: float, z: float) -> Distance:
    """Return the signed distance of a point from a cylinder along the z axis, and its gradient."""
    from_axis = math.sqrt(x * x + y * y)
    side, end = from_axis - radius, abs(z) - half_length
    beside, beyond = max(side, 0.0), max(end, 0.0)
    outside = math.sqrt(beside * beside + beyond * beyond)
    distance = outside + min(max(side, end), 0.0)
    if outside < TINY:
        # Inside, the nearest point is on the side or on an end.
        outside = 1.0
        beside = 1.0 if side > end else 0.0
        beyond = 1.0 - beside
    upward = math.copysign(beyond / outside, z)
    if from_axis < TINY:
        return distance, beside / outside, 0.0, upward
    share = beside / (outside * from_axis)
    return distance, share * x, share * y, upward


@kernel
def box_distance(a: float, b: float, c: float, x: float, y: float, z: float) -> Distance:
    """Return the signed distance of a point from a box with half lengths a, b and c, and its gradient."""
    over_x = abs(x) - a
    over_y = abs(y) - b
    over_z = abs(z) - c
    nearest = max(over_x, over_y, over_z)
    nx = max(over_x, 0.0)
    ny = max(over_y, 0.0)
    nz = max(over_z, 0.0)
    outside = math.sqrt(nx * nx + ny * ny + nz * nz)
    distance = outside + min(nearest, 0.0)
    if outside < TINY:
        # Inside, the nearest point is on one of the faces.
        outside = 1.0
        nx = 1.0 if over_x == nearest else 0.0
        ny = 1.0 if nx == 0.0 and over_y == nearest else 0.0
        nz = 1.0 - nx - ny
    nx, ny, nz = nx / outside, ny / outside, nz / outside
    return distance, math.copysign(nx, x), math.copysign(ny, y), math.copysign(nz, z)


@inlined
def local_distance(
    kind: int, size: Vector, meshes: Meshes, clouds: Clouds, point: Vector, limit: float
) -> Distance:
    """Return the signed distance of a point in the frame of a shape, and its gradient.

    The size is :attr:`Shape.packed_size`. Beyond `limit`, any number between it and the distance may be returned, [m].
    """
    a, b, c = size
    x, y, z = point
    if kind == SPHERE:
        found = sphere_distance(a, x, y, z)
    elif kind == CAPSULE:
        found = capsule_distance(a, b, x, y, z)
    elif kind == CYLINDER:
        found = cylinder_distance(a, b, x, y, z)
    elif kind == BOX:
        found = box_distance(a, b, c, x, y, z)
    elif kind == HALF_SPACE:
        found = z, 0.0, 0.0, 1.0
    elif kind == MESH:
        found = mesh_distance(meshes, int(a), b, x, y, z, limit)
    elif kind == POINT_CLOUD:
        found = cloud_distance(clouds, int(a), x, y, z, limit)
    else:
        found = FAR, 0.0, 0.0, 1.0
    return found


@kernel
def _distances(kind: int, size: Float, meshes: Meshes, clouds: Clouds, points: Float, found: Float) -> None:
    """Fill in the signed distances of points, shape (M, 3), in the frame of a shape."""
    sizes = size[0], size[1], size[2]
    for i in range(len(points)):
        point = points[i, 0], points[i, 1], points[i, 2]
        found[i] = local_distance(kind, sizes, meshes, clouds, point, FAR)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    """Obstacle of some shape at some pose, which may move with a constant velocity.

    Numbers are checked, and kept in double precision. Arrays are read-only.

    Example:
        >>> from viapoint.envs import Shape, Sphere
        >>> isinstance(Sphere(0.1, position=(0.5, 0.0, 0.2), velocity=(0.1, 0.0, 0.0)), Shape)
        True
    """

    number: ClassVar[int]
    """Number of the kind."""
    geom: ClassVar[mujoco.mjtGeom]
    """MuJoCo's geom of the shape."""
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {}
    """Names of the positive parameters with the shapes of their values, in the order of MuJoCo's sizes."""
    box: ClassVar[Matrix] = (0, 0, 0), (0, 0, 0), (0, 0, 0)
    """Matrix M of the half lengths of the bounding box, which are `packed_size @ M`."""

    position: Any = (0.0, 0.0, 0.0)
    """Origin of the shape's frame in the world at time 0, shape (3,), [m]."""
    quaternion: Any = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z), shape (4,); its length is 1."""
    velocity: Any = (0.0, 0.0, 0.0)
    """Shape (3,), [m/s]."""
    name: str = ""
    """Name for messages."""
    mesh: Meshes | None = field(init=False, repr=False, default=None)
    """Triangles of a mesh."""
    cloud: Clouds | None = field(init=False, repr=False, default=None)
    """Point cloud with its tree."""

    def __post_init__(self) -> None:
        """Convert and check the parameters."""
        if not isinstance(self.name, str):
            raise ValueError(f"{self.kind}: name must be a string, got {self.name!r:.60}")
        try:
            for name, shape in self.sizes.items():
                values = finite_array(name, getattr(self, name), shape)
                if not (values > 0.0).all():
                    raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)!r}")
                self._set(name, values if shape else float(values))
            self._set("position", finite_array("position", self.position, (3,)))
            self._set("velocity", finite_array("velocity", self.velocity, (3,)))
            self._set("quaternion", unit_quaternion("quaternion", self.quaternion))
            self._complete()
        except ValueError as error:
            named = f"{self.kind} {self.name!r}" if self.name else self.kind
            raise ValueError(f"{named}: {error}") from None

    def __eq__(self, other: object) -> bool:
        """Return True for a shape of the same kind with the same parameters and name."""
        return type(self) is type(other) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in self.parameters()
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def kind(self) -> str:
        """Name of the kind in dictionaries."""
        return KINDS[self.number]

    @classmethod
    def parameters(cls) -> list[str]:
        """Return the names of the parameters, those of all shapes last."""
        return [each.name for each in sorted(fields(cls), key=lambda each: bool(each.kw_only)) if each.init]

    @functools.cached_property
    def rotation(self) -> Float:
        """Axes of the shape's frame as columns, shape (3, 3)."""
        rotation: Float = frozen(frame_matrices(self.quaternion))
        return rotation

    def distance(self, points: Any, radius: Any = 0.0) -> Any:
        """Return the signed distance of points, or of spheres around them, at time 0, shape (...,), [m].

        Args:
            points: Shape (..., 3), [m].
            radius: Radius of the spheres, [m].
        """
        points = finite_array("points", points, (..., 3))
        radius = finite_array("radius", radius)
        if (radius < 0.0).any():
            raise ValueError(f"radius must be 0 or greater, got {radius.min()}")
        local = (points.reshape(-1, 3) - self.position) @ self.rotation
        tables = self.mesh or NO_MESHES, self.cloud or NO_CLOUDS
        found = np.empty(len(local))
        _distances(self.number, self.packed_size, *tables, local, found)
        return found.reshape(points.shape[:-1]) - radius

    @property
    def packed_size(self) -> Float:
        """Sizes in MuJoCo's convention, shape (3,), [m]; missing ones are 0, see also :class:`Obstacles`."""
        given = [np.ravel(getattr(self, name)) for name in self.sizes]
        return np.concatenate((*given, np.zeros(3)))[:3]

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as plain numbers and lists, with the kind as `shape`."""
        values: dict[str, Any] = {"shape": self.kind}
        for each in self.parameters():
            value = getattr(self, each)
            if each in ("name", "velocity") and not np.any(value):
                continue
            values[each] = value.tolist() if isinstance(value, np.ndarray) else value
        return values

    def _complete(self) -> None:
        """Check and derive what belongs to one kind of shape."""

    def _set(self, name: str, value: Any) -> None:
        """Set an attribute of the record while it is made; arrays are read-only copies."""
        object.__setattr__(self, name, frozen(value.copy()) if isinstance(value, np.ndarray) else value)


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    """Sphere around its position.

    Example:
        >>> from viapoint.envs.geometry.shapes import Sphere
        >>> ball = Sphere(0.05, position=(0.4, 0.0, 0.3))
        >>> ball.distance([0.4, 0.0, 0.5], radius=0.03).round(3).item()  # of a sphere of 3 cm, [m]
        0.12
    """

    number: ClassVar[int] = SPHERE
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_SPHERE
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": ()}
    box: ClassVar[Matrix] = (1, 1, 1), (0, 0, 0), (0, 0, 0)

    radius: Any
    """[m]."""


@dataclass(frozen=True, eq=False)
class Capsule(Shape):
    """Capsule around a part of its z axis: all points within a radius of the segment.

    Example:
        >>> from viapoint.envs.geometry.shapes import Capsule
        >>> bar = Capsule.between((0.2, -0.1, 0.3), (0.2, 0.1, 0.3), radius=0.02)
        >>> bar.distance([0.5, 0.0, 0.3]).round(3).item()
        0.28
    """

    number: ClassVar[int] = CAPSULE
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_CAPSULE
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": (), "half_length": ()}
    box: ClassVar[Matrix] = (1, 1, 1), (0, 0, 1), (0, 0, 0)

    radius: Any
    """[m]."""
    half_length: Any
    """Half length of the segment, [m]."""

    @classmethod
    def between(cls, first: Any, second: Any, radius: Any, **others: Any) -> Self:
        """Return the capsule around the segment between two points, shape (3,) each, [m].

        `others` are the velocity and the name.
        """
        first = finite_array("first", first, (3,))
        second = finite_array("second", second, (3,))
        half = 0.5 * (second - first)
        length = float(np.linalg.norm(half))
        if not 0.0 < length < np.inf:
            raise ValueError(f"ends of a capsule must differ, got {first.tolist()} and {second.tolist()}")
        return cls(radius, length, position=first + half, quaternion=quaternion_to(half / length), **others)


@dataclass(frozen=True, eq=False)
class Cylinder(Shape):
    """Solid cylinder around a part of its z axis, with flat ends.

    Example:
        >>> from viapoint.envs.geometry.shapes import Cylinder
        >>> can = Cylinder(0.03, 0.06, position=(0.5, 0.1, 0.06))  # 12 cm high
        >>> can.distance([[0.5, 0.1, 0.2], [0.5, 0.1, 0.06]]).round(3).tolist()
        [0.08, -0.03]
    """

    number: ClassVar[int] = CYLINDER
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_CYLINDER
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": (), "half_length": ()}
    box: ClassVar[Matrix] = (1, 1, 0), (0, 0, 1), (0, 0, 0)

    radius: Any
    """[m]."""
    half_length: Any
    """Half length along the z axis, [m]."""


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """Box around its position, with faces along the axes of its frame.

    Example:
        >>> from viapoint.envs.geometry.shapes import Box
        >>> table = Box((0.4, 0.6, 0.02), position=(0.5, 0.0, 0.2), name="table")  # 0.8 m x 1.2 m x 4 cm
        >>> table.distance([[0.5, 0.0, 0.3], [0.5, 0.1, 0.21]]).round(3).tolist()
        [0.08, -0.01]
    """

    number: ClassVar[int] = BOX
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_BOX
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"size": (3,)}
    box: ClassVar[Matrix] = (1, 0, 0), (0, 1, 0), (0, 0, 1)

    size: Any
    """Half lengths along the axes of the frame, shape (3,), [m]."""


@dataclass(frozen=True, eq=False)
class HalfSpace(Shape):
    """Solid below the plane through its position; the z axis of its frame is the outward normal.

    Example:
        >>> from viapoint.envs.geometry.shapes import HalfSpace
        >>> floor = HalfSpace(position=(0.0, 0.0, -0.1))
        >>> wall = HalfSpace.facing((-1.0, 0.0, 0.0), position=(0.8, 0.0, 0.0))  # all points with x > 0.8
        >>> point = [0.5, 0.0, 0.4]
        >>> floor.distance(point).item(), wall.distance(point).round(3).item()
        (0.5, 0.3)
    """

    number: ClassVar[int] = HALF_SPACE
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_PLANE

    @classmethod
    def facing(cls, normal: Any, position: Any = (0.0, 0.0, 0.0), **others: Any) -> Self:
        """Return the half-space of an outward normal, shape (3,), of any length.

        `position` is a point of the surface, shape (3,), [m]; `others` are the velocity and the name.
        """
        outward = finite_array("normal", normal, (3,))
        longest = np.abs(outward).max()
        if longest == 0.0:
            raise ValueError(f"normal must not be zero, got {outward.tolist()}")
        return cls(position=position, quaternion=quaternion_to(outward / longest), **others)


@dataclass(frozen=True, eq=False)
class ConvexMesh(Shape):
    """Convex mesh in the shape's frame.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs.geometry.shapes import ConvexMesh
        >>> wedge = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 1), (0, 1, 1)]) / 10
        >>> mesh = ConvexMesh(wedge, position=(0.4, 0.0, 0.2))
        >>> mesh.distance([[0.5, 0.05, 0.3], [0.45, 0.05, 0.24]]).round(4).tolist()
        [0.0707, -0.0071]
        >>> ConvexMesh.hull([*wedge, (0.02, 0.05, 0.05)]).vertices.shape  # without the point inside
        (6, 3)
    """

    number: ClassVar[int] = MESH
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_MESH

    vertices: Any
    """Shape (V, 3), [m]."""

    @classmethod
    def hull(cls, points: Any, **others: Any) -> Self:
        """Return the convex hull of points, shape (K, 3), [m]; `others` are the pose, the velocity and the name."""
        vertices = finite_array("points", points, (None, 3))
        return cls(vertices[convex_hull(vertices).vertices], **others)

    @property
    def packed_size(self) -> Float:
        """Index in a table of one mesh, and radius of its bounding sphere, shape (3,)."""
        return np.array([0.0, np.linalg.norm(self.vertices, axis=1).max(), 0.0])

    def _complete(self) -> None:
        self._set("vertices", finite_array("vertices", self.vertices, (None, 3)))
        self._set("mesh", build_mesh(np.array(self.vertices)))


@dataclass(frozen=True, eq=False)
class PointCloud(Shape):
    """Spheres of one radius around points, as a depth camera sees them.

    The signed distance is that of the nearest sphere. Inside overlapping spheres this is at most the depth below the
    surface of their union.

    Example:
        >>> from viapoint.envs.geometry.shapes import PointCloud
        >>> cloud = PointCloud([(0.4, 0.0, 0.2), (0.4, 0.02, 0.2), (0.42, 0.0, 0.21)], radius=0.01)
        >>> cloud.distance([0.4, 0.0, 0.3]).round(4).item()
        0.0822
        >>> len(PointCloud.covering(cloud.points, spacing=0.05).points)  # fewer and larger spheres
        1
    """

    number: ClassVar[int] = POINT_CLOUD
    geom: ClassVar[mujoco.mjtGeom] = mujoco.mjtGeom.mjGEOM_SPHERE
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": ()}

    points: Any
    """Shape (K, 3), [m]."""
    radius: Any = 0.01
    """Radius of the spheres, [m]."""

    @classmethod
    def covering(cls, points: Any, spacing: float, radius: float = 0.0, **others: Any) -> Self:
        """Return a cloud of fewer points whose spheres contain those around the given points.

        The space is divided into cubes; one sphere encloses each cube that holds a point.

        Args:
            points: Shape (K, 3), [m].
            spacing: Edge of the cubes, [m].
            radius: Radius of the spheres around the given points, [m].
            **others: Pose, velocity and name.
        """
        number_of_at_least("spacing", spacing, LEAST_SPACING)
        number_of_at_least("radius", radius, 0.0)
        given = finite_array("points", points, (None, 3))
        cubes = np.unique(np.floor(given / spacing), axis=0)
        return cls((cubes + 0.5) * spacing, radius=0.5 * np.sqrt(3.0) * spacing + radius, **others)

    @property
    def packed_size(self) -> Float:
        """Index in a table of one cloud, and radius of its bounding sphere, shape (3,)."""
        return np.array([0.0, np.linalg.norm(self.points, axis=1).max() + self.radius, 0.0])

    def _complete(self) -> None:
        self._set("points", finite_array("points", self.points, (None, 3)))
        self._set("cloud", build_cloud(np.array(self.points), self.radius))


SHAPES: tuple[type[Shape], ...] = (Sphere, Capsule, Cylinder, Box, HalfSpace, ConvexMesh, PointCloud)
"""Classes of the kinds, in the order of KINDS."""
REGISTERED_MESHES: dict[str, ConvexMesh] = {}  # Meshes with a name of their own, see :func:`register_mesh`


def register_mesh(name: str, vertices: Any) -> None:
    """Register a convex mesh under a name, so that scenes and observations may contain it.

    The name is then a shape: dictionaries take it as `shape`, environments in `shapes`. Registering the same mesh again
    changes nothing.

    Args:
        name: Identifier, which no other shape has.
        vertices: Vertices of a convex mesh, shape (V, 3), [m].

    Example:
        >>> from viapoint.envs.geometry.shapes import as_obstacle, register_mesh
        >>> wedge = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.1, 0.1, 0), (0, 0, 0.1), (0, 0.1, 0.1)]
        >>> register_mesh("wedge", wedge)
        >>> as_obstacle({"shape": "wedge", "position": (0.4, 0.0, 0.2)}).distance([0.5, 0.05, 0.3]).round(4).item()
        0.0707
    """
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"the name of a mesh must be an identifier such as 'rock', got {name!r}")
    mesh = ConvexMesh(vertices)
    known = REGISTERED_MESHES.get(name)
    if name in KINDS or (known is not None and not np.array_equal(known.vertices, mesh.vertices)):
        raise ValueError(f"another shape has the name {name!r}; give this mesh another one")
    REGISTERED_MESHES[name] = mesh


def registered_name(vertices: Float, among: Iterable[str] | None = None) -> str:
    """Return the name of the registered mesh with the same vertices in any order; empty for none.

    Args:
        vertices: Vertices, shape (V, 3), [m]; repeated ones do not matter.
        among: Names that count; all by default.
    """
    wanted = np.unique(vertices, axis=0)
    for name in REGISTERED_MESHES if among is None else among:
        mesh = REGISTERED_MESHES.get(name)
        if mesh is not None and np.array_equal(np.unique(mesh.vertices, axis=0), wanted):
            return name
    return ""


def as_obstacle(value: Shape | Mapping[str, Any]) -> Shape:
    """Return a shape from its dictionary; a shape is returned as it is.

    Args:
        value: Shape, or a mapping with its kind as `shape` and its parameters.

    Raises:
        ValueError: The kind or a parameter is unknown or missing, or a value is not allowed.

    Example:
        >>> from viapoint.envs.geometry.shapes import as_obstacle
        >>> box = as_obstacle({"shape": "box", "size": (0.1, 0.2, 0.02), "position": (0.5, 0.0, 0.3)})
        >>> box.distance([0.5, 0.0, 0.5]).round(3).item()
        0.18
        >>> as_obstacle({"shape": "box", "sizes": (0.1, 0.2, 0.02)})
        Traceback (most recent call last):
        ValueError: box: parameters are size, position, quaternion, velocity, name; unknown: sizes; missing: size
    """
    if isinstance(value, Shape):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"an obstacle must be a shape or a dictionary, got {value!r:.80}")
    values = dict(value)
    kind = values.pop("shape", None)
    (name,) = check_kinds([kind])
    if name in REGISTERED_MESHES:
        values["vertices"] = REGISTERED_MESHES[name].vertices
        name = KINDS[MESH]
    shape = SHAPES[KINDS.index(name)]
    allowed = shape.parameters()
    needed = [each.name for each in fields(shape) if each.init and each.default is MISSING]
    unknown = ", ".join(str(each) for each in values if each not in allowed)
    missing = ", ".join(each for each in needed if each not in values)
    if unknown or missing:
        faults = (unknown and f"; unknown: {unknown}") + (missing and f"; missing: {missing}")
        raise ValueError(f"{kind}: parameters are {', '.join(allowed)}{faults}")
    return shape(**values)


def as_obstacles(values: Iterable[Shape | Mapping[str, Any]]) -> list[Shape]:
    """Return shapes from a list of shapes and dictionaries; an error names the index of the obstacle.

    Example:
        >>> from viapoint.envs.geometry.shapes import as_obstacles
        >>> as_obstacles([{"shape": "sphere", "radius": 0.1}, {"shape": "sphere", "radius": -1.0}])
        Traceback (most recent call last):
        ValueError: obstacle 1: sphere: radius must be greater than 0, got -1.0
    """
    single = isinstance(values, Shape | Mapping | str) or getattr(values, "ndim", 1) == 0
    if single or not isinstance(values, Iterable):
        raise ValueError(f"obstacles must be a list of shapes or dictionaries, got {values!r:.80}")
    found = []
    for i, value in enumerate(values):
        try:
            found.append(as_obstacle(value))
        except ValueError as error:
            raise ValueError(f"obstacle {i}: {error}") from None
    return found


def check_kinds(names: Iterable[Any]) -> tuple[str, ...]:
    """Return names of kinds or registered meshes.

    Raises:
        ValueError: A name is unknown or repeated.
    """
    names = (names,) if isinstance(names, str) else tuple(names)
    for name in names:
        if not isinstance(name, str) or (name not in KINDS and name not in REGISTERED_MESHES):
            known = ", ".join((*KINDS, *REGISTERED_MESHES))
            raise ValueError(f"shape must be one of {known}, got {name!r}; register_mesh adds a convex mesh")
    if len(set(names)) < len(names):
        raise ValueError(f"shapes must not be repeated, got {', '.join(names)}")
    return names


def obstacles_to_json(obstacles: Iterable[Shape | Mapping[str, Any]]) -> str:
    """Return obstacles as JSON.

    Example:
        >>> from viapoint.envs.geometry.shapes import Sphere, obstacles_from_json, obstacles_to_json
        >>> text = obstacles_to_json([Sphere(0.1, position=(0.5, 0.0, 0.3))])
        >>> text
        '[{"shape": "sphere", "radius": 0.1, "position": [0.5, 0.0, 0.3], "quaternion": [1.0, 0.0, 0.0, 0.0]}]'
        >>> obstacles_from_json(text) == [Sphere(0.1, position=(0.5, 0.0, 0.3))]
        True
    """
    return json.dumps([each.to_dict() for each in as_obstacles(obstacles)])


def obstacles_from_json(text: str) -> list[Shape]:
    """Return the obstacles of :func:`obstacles_to_json`.

    Raises:
        ValueError: The text is not JSON, not a list, or an obstacle is not allowed.

    Example:
        >>> from viapoint.envs.geometry.shapes import obstacles_from_json
        >>> [table] = obstacles_from_json('[{"shape": "box", "size": [0.4, 0.6, 0.02], "name": "table"}]')
        >>> table.name, table.size.tolist()
        ('table', [0.4, 0.6, 0.02])
    """
    try:
        values = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"obstacles must be JSON ({error})") from None
    if not isinstance(values, list):
        raise ValueError(f"obstacles must be a JSON list of dictionaries, got {type(values).__name__}")
    return as_obstacles(values)
