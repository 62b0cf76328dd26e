"""Convex meshes: convex hulls of vertices."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import best_of, frozen, norm, spread
from viapoint.envs.common.types import Float, Index
from viapoint.envs.common.validation import as_constants
from viapoint.envs.geometry.segments import lowest_of_lines, nearest_on_segments, nearest_to_origin
from viapoint.envs.geometry.shape import (
    Components,
    Geom,
    Shape,
    blocks,
    bounds_of_points,
    length,
)
from viapoint.primitives.array_api import Array, like, namespace_of, to_numpy

DENT = 1e-6
"""Depth of a vertex below the hull, as a share of the mesh's size, from which a mesh is not convex."""
COPLANAR = 2e-7
"""Distance from a face's plane, as a share of the mesh's size, within which triangles belong to the face: several times
the rounding of vertices in single precision."""
FOOT_TOLERANCE = 1e-8
"""Relative height above other planes up to which the foot of a perpendicular lies on its face."""


class Polytope(NamedTuple):
    """Planes and edges of a convex polytope: all points with normals @ x <= offsets."""

    normals: Float
    """Outer unit normals of the faces, shape (F, 3)."""
    offsets: Float
    """Distances of the faces' planes from the origin, shape (F,), [m]."""
    starts: Float
    """One end of each edge, shape (E, 3), [m]."""
    edges: Float
    """Vectors to the other end, shape (E, 3), [m]."""
    depth: float
    """Greatest depth of a vertex below the plane of its own face, from rounding, [m]."""


@dataclass(frozen=True, eq=False)
class ConvexMesh(Shape):
    """Convex hull of vertices in the shape's frame; the pose may be a batch, the vertices are those of one mesh.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import ConvexMesh
        >>> wedge = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 1), (0, 1, 1)]) / 10
        >>> mesh = ConvexMesh(wedge, position=(0.4, 0.0, 0.2))
        >>> mesh.distance([[0.5, 0.05, 0.3], [0.45, 0.05, 0.24]]).round(4).tolist()
        [0.0707, -0.0071]
        >>> ConvexMesh.hull([*wedge, (0.02, 0.05, 0.05)]).vertices.shape  # without the point inside
        (6, 3)
    """

    kind: ClassVar[str] = "convex_mesh"
    in_scenes: ClassVar[bool] = False

    vertices: Array
    """Shape (V, 3), [m]."""
    faces: Any = None
    """Triangles as indices of vertices, shape (F, 3); only needed to check that a mesh with these faces is convex."""

    @classmethod
    def hull(cls, points: Any, **pose: Any) -> Self:
        """Return the convex hull of points, shape (K, 3), [m]; `pose` are position, quaternion and name."""
        try:
            vertices = _checked_vertices(points)
            vertices = vertices[np.unique(hull_triangles(vertices))]
        except ValueError as error:
            raise cls._refusal(pose.get("name", ""), str(error)) from None
        return cls(vertices, **pose)

    @property
    def bounding_sphere(self) -> tuple[Array, Array]:
        """Centre and radius, [m]."""
        return self._placed(*bounds_of_points(self.vertices))

    @functools.cached_property
    def polytope(self) -> Polytope:
        """Planes and edges of the hull."""
        return _polytope(self.vertices)

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo mesh."""
        (geom,) = self._geom(mujoco.mjtGeom.mjGEOM_MESH)
        return [geom._replace(vertices=self.vertices)]

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as plain lists; the faces follow from the vertices."""
        return {name: value for name, value in super().to_dict().items() if name != "faces"}

    def in_plane(self) -> tuple[Float, Float]:
        """Raise ValueError: meshes are no obstacles of arms in the plane."""
        raise ValueError(f"{self.kind} is for arms in space; in the plane, use boxes, cylinders and capsules")

    def _check(self) -> None:
        try:
            object.__setattr__(self, "vertices", frozen(_checked_vertices(self.vertices)))
            _check_convex(self.vertices, self.polytope, self.faces)
        except ValueError as error:
            raise self._error(str(error)) from None
        object.__setattr__(self, "faces", None)

    def _signed(self, points: Components) -> Array:
        """Return the signed distance.

        The nearest point of the surface is on a face, if the foot of the perpendicular on the plane with the greatest
        height lies on that face, and on an edge otherwise. Below all planes the height is the signed distance.
        """
        xp = namespace_of(points[0])
        shape = points[0].shape
        flat = [p.reshape(-1) for p in spread(*points)]
        face, edge, on_face = self._features(np.stack([to_numpy(p) for p in flat]))
        body = self.polytope
        normal = [like(xp, c, flat[0]) for c in body.normals[face].T]
        height = sum(p * n for p, n in zip(flat, normal, strict=True)) - like(xp, body.offsets[face], flat[0])
        along = [like(xp, c, flat[0]) for c in body.edges[edge].T]
        offset = [p - like(xp, c, flat[0]) for p, c in zip(flat, body.starts[edge].T, strict=True)]
        share = nearest_to_origin(offset, [-u for u in along])
        beside = length([o - share * u for o, u in zip(offset, along, strict=True)])
        chosen = like(xp, on_face.astype(np.float64), flat[0]) > 0.5
        return xp.where(chosen, height, beside).reshape(shape)

    def _features(self, points: Float) -> tuple[Index, Index, Any]:
        """Return the highest plane, the nearest edge, and True where the plane's face is nearest, for points (3, M)."""
        body, number = self.polytope, points.shape[1]
        face, edge = np.zeros(number, np.intp), np.zeros(number, np.intp)
        on_face = np.ones(number, dtype=bool)
        size = FOOT_TOLERANCE * (1.0 + np.abs(body.offsets).max()) + 2.0 * body.depth
        points = points.astype(np.float64, copy=False)
        for some in blocks(number, len(body.offsets)):
            heights = body.normals @ points[:, some] - body.offsets[:, None]
            highest = heights.argmax(axis=0)
            height = heights[highest, np.arange(len(highest))]
            foot = points[:, some] - height * body.normals[highest].T
            off = (body.normals @ foot - body.offsets[:, None]).max(axis=0) > size
            face[some], on_face[some] = highest, ~(off & (height > 0.0))
        others = np.flatnonzero(~on_face)
        square = (body.edges * body.edges).sum(axis=1)[:, None]
        for part in blocks(len(others), 3 * len(body.edges)):
            here = points[:, others[part]]
            along = body.edges @ here - (body.edges * body.starts).sum(axis=1)[:, None]
            share = np.clip(along / square, 0.0, 1.0)
            # |p - s|^2 without |p|^2, which is common to all edges
            squared = (body.starts * body.starts).sum(axis=1)[:, None] - 2.0 * (body.starts @ here)
            edge[others[part]] = (squared - share * (2.0 * along - share * square)).argmin(axis=0)
        return face, edge, on_face

    def _nearest(self, start: Components, along: Components) -> Array:
        """Return t in [0, 1] for which the signed distance is least, exactly.

        Outside, the nearest point is an end, or it is nearest to an edge. Of a segment that enters the mesh, the
        deepest point is where the greatest of the heights above all planes is least.
        """
        xp = namespace_of(start[0])
        *vectors, first = spread(*start, *along, start[0] + along[0])
        flat = np.stack([to_numpy(v).astype(np.float64).reshape(-1) for v in vectors])
        body, number = self.polytope, flat.shape[1]
        beside, within = np.zeros(number), np.zeros(number)
        for some in blocks(number, 8 * len(body.edges)):
            here, way = flat[:3, some], flat[3:, some]
            gap = [p - s[:, None] for p, s in zip(here, body.starts.T, strict=True)]
            edge, link = [e[:, None] for e in body.edges.T], list(way)
            on_link, on_edge = nearest_on_segments(gap, link, edge)
            squared = sum(
                np.square(g + on_link * u - on_edge * e) for g, u, e in zip(gap, link, edge, strict=True)
            )
            beside[some] = on_link[squared.argmin(axis=0), np.arange(on_link.shape[1])]
            within[some] = lowest_of_lines(body.normals @ way, body.normals @ here - body.offsets[:, None])

        def at(t: Float) -> Any:
            return self._signed(list(flat[:3] + t * flat[3:]))

        t = best_of(np, at, (beside, within, np.zeros(number), np.ones(number)))
        return like(xp, t.reshape(first.shape), first)

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        return np.asarray(self.vertices[(directions @ self.vertices.T).argmax(axis=1)])


@dataclass(frozen=True, eq=False)
class NamedMesh(ConvexMesh):
    """Convex mesh of a registered name at some pose, see :func:`~viapoint.envs.geometry.shapes.register_mesh`.

    Each registered mesh is a subclass, a shape of one size, so its kind and pose in a row of numbers determine it.
    """

    in_scenes: ClassVar[bool] = True
    mesh: ClassVar[ConvexMesh]
    """Mesh in its own frame."""
    middle: ClassVar[Float]
    """Centre of the bounding box in the mesh's frame, shape (3,), [m]."""

    vertices: Array = field(init=False, default=None)
    """Shape (V, 3), [m]."""
    faces: Any = field(init=False, default=None)
    """None: the mesh is known to be convex."""

    @classmethod
    def named(cls, name: str, mesh: ConvexMesh) -> type[NamedMesh]:
        """Return the class of a mesh with a name; the pose of the mesh does not matter."""
        own = ConvexMesh(mesh.vertices)
        middle, half = own.box()
        values = {"kind": name, "mesh": own, "middle": middle, "only_half": tuple(half.tolist())}
        return type(name, (cls,), {**values, "__doc__": f"Convex mesh {name!r}."})

    @classmethod
    def from_box(cls, centre: Array, quaternion: Array, half: Array) -> Self:
        """Return meshes from their bounding boxes; see :meth:`Shape.from_box`."""
        own = super().from_box(centre, quaternion, half)
        offset = [
            sum(float(m) * axis[i] for m, axis in zip(cls.middle, own._axes, strict=True)) for i in range(3)
        ]
        position = namespace_of(centre).stack([centre[..., i] - o for i, o in enumerate(offset)], -1)
        object.__setattr__(own, "position", position)
        own._check()
        return own

    @classmethod
    def _of_half(cls, half: Array) -> dict[str, Array]:
        del half
        return {}

    def _check(self) -> None:
        self.__dict__.update(vertices=self.mesh.vertices, polytope=self.mesh.polytope)


def hull_triangles(vertices: Float) -> Index:
    """Return the triangles of the convex hull of vertices as indices, shape (F, 3); their order of corners is free.

    MuJoCo computes hulls (Qhull); only the indices are used, because it keeps vertices in single precision.

    Raises:
        ValueError: The vertices lie in a plane.
    """
    different, index = np.unique(vertices, axis=0, return_index=True)
    size = np.ptp(vertices, axis=0).max()
    unit = (different - vertices.mean(axis=0)) / (size if size > 0.0 else 1.0)
    if len(unit) < 4 or np.linalg.svd(unit - unit.mean(axis=0), compute_uv=False)[2] < DENT:
        raise ValueError("vertices must span a volume, they lie in a plane; use a thin box or a point cloud")
    spec = mujoco.MjSpec()
    spec.add_mesh(name="hull", uservert=unit.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", contype=1, conaffinity=1)
    graph = spec.compile().mesh_graph
    corners, triangles = graph[:2]
    faces = graph[2 + 3 * corners + 3 * triangles :].reshape(-1, 3)
    return np.asarray(index[faces])


def _checked_vertices(points: Any) -> Float:
    """Return vertices as an array, shape (V, 3)."""
    array = as_constants(
        "vertices", points, "(V, 3) with V at least 4", lambda *s: s[1:] == (3,) and s[0] > 3
    )
    if not np.isfinite(array).all():
        raise ValueError(f"vertices must be finite, got {array[~np.isfinite(array).all(axis=1)][0].tolist()}")
    return array


def _check_convex(vertices: Float, body: Polytope, faces: Any) -> None:
    """Check that all vertices lie on their hull, and that the faces, if given, enclose all of it."""
    parts = blocks(len(vertices), len(body.offsets))
    depth = np.concatenate([(body.offsets - vertices[some] @ body.normals.T).min(axis=1) for some in parts])
    deepest, size = int(depth.argmax()), np.ptp(vertices, axis=0).max()
    hint = "ConvexMesh.hull(vertices) is the hull"
    if depth[deepest] > DENT * size:
        raise ValueError(
            f"vertices are not those of a convex mesh: vertex {deepest} lies {depth[deepest]:.3g} m inside their hull; "
            f"{hint}"
        )
    if faces is None:
        return
    try:
        corners = np.asarray(faces)
    except ValueError:
        raise ValueError(
            "faces must be triangles, integers of shape (F, 3), got rows of different lengths"
        ) from None
    if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu":
        raise ValueError(f"faces must be triangles, integers of shape (F, 3), got shape {corners.shape}")
    wrong = corners[(corners < 0) | (corners >= len(vertices))]
    if wrong.size:
        raise ValueError(f"faces must be indices of the {len(vertices)} vertices, got {wrong[0]}")
    enclosed = abs(_volumes(vertices, corners).sum())
    whole = np.abs(_volumes(vertices, hull_triangles(vertices))).sum()
    if abs(enclosed - whole) > 10.0 * DENT * whole:
        raise ValueError(
            f"faces are not those of a convex mesh, or not all their corners turn the same way seen from outside: they "
            f"enclose {enclosed:.4g} m^3, their hull {whole:.4g} m^3; {hint}"
        )


def _volumes(vertices: Float, triangles: Any) -> Float:
    """Return the signed volumes between triangles and the middle of the vertices, shape (F,), [m^3]."""
    a, b, c = (vertices[triangles[:, i]] - vertices.mean(axis=0) for i in range(3))
    return np.asarray((a * np.cross(b, c)).sum(axis=1) / 6.0)


def _polytope(vertices: Float) -> Polytope:
    """Return the planes and edges of the hull of vertices; triangles of one plane become one face.

    The normal of a face is along the sum of its triangles' area vectors, which depends on its outline alone, so that
    triangles of nearly no area do not matter. Edges between triangles of one face are none.
    """
    triangles = hull_triangles(vertices)
    areas, height = _area_vectors(vertices, triangles)
    wide = height > DENT * np.ptp(vertices, axis=0).max()
    if not (np.isfinite(height).all() and wide.any()):
        raise ValueError("vertices must have a hull with finite planes; give them in metres")
    pairs, ends = _neighbours(triangles)
    face = _faces(vertices, triangles, areas, pairs)
    kept = np.unique(face[wide])
    normals = np.zeros_like(areas)
    np.add.at(normals, face, areas)
    normals = normals[kept] / norm(normals[kept])[:, None]
    parts = blocks(len(vertices), len(kept))
    offsets = np.max([(normals @ vertices[some].T).max(axis=1) for some in parts], axis=0)
    own = np.searchsorted(kept, face).clip(max=len(kept) - 1)
    inner = offsets[own, None] - np.einsum("fij,fj->fi", vertices[triangles], normals[own])
    edges = np.unique(ends[face[pairs[:, 0]] != face[pairs[:, 1]]], axis=0)
    starts = vertices[edges[:, 0]]
    depth = inner[kept[own] == face].max()
    return Polytope(normals, offsets, starts, vertices[edges[:, 1]] - starts, float(depth))


def _area_vectors(vertices: Float, triangles: Index) -> tuple[Float, Float]:
    """Return outward normals of triangles, as long as twice their areas, and their least heights, [m]."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    with np.errstate(all="ignore"):
        areas = np.cross(b - a, c - a)
        areas[(areas * (a - vertices.mean(axis=0))).sum(axis=1) < 0.0] *= -1.0
        return areas, norm(areas) / np.max([norm(b - a), norm(c - b), norm(a - c)], axis=0)


def _neighbours(triangles: Index) -> tuple[Index, Index]:
    """Return pairs of triangles with a common edge, shape (P, 2), and the vertices at the ends of these edges."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(sides.T)
    same = (sides[order[1:]] == sides[order[:-1]]).all(axis=1)
    return np.stack((order[:-1], order[1:]), axis=1)[same] // 3, sides[order[1:]][same]


def _faces(vertices: Float, triangles: Index, areas: Float, pairs: Index) -> Index:
    """Return the face of each triangle as the index of the face's largest triangle, shape (F,).

    A face grows from its largest triangle across common edges, as long as the corners lie in that triangle's plane.
    """
    adjacent: list[list[int]] = [[] for _ in triangles]
    for first, second in pairs.tolist():
        adjacent[first].append(second)
        adjacent[second].append(first)
    size, tolerance = norm(areas), COPLANAR * np.ptp(vertices, axis=0).max()
    face = np.full(len(triangles), -1)
    for seed in np.argsort(-size, kind="stable").tolist():
        if face[seed] >= 0:
            continue
        face[seed], grown = seed, [seed]
        normal = areas[seed] / max(size[seed], np.finfo(float).tiny)
        while grown:
            for other in adjacent[grown.pop()]:
                corners = vertices[triangles[other]] - vertices[triangles[seed, 0]]
                if face[other] < 0 and np.abs(corners @ normal).max() <= tolerance:
                    face[other] = seed
                    grown.append(other)
    return face
