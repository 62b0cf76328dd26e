"""Convex meshes: convex hulls of vertices."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import best_of, dot, frozen
from viapoint.envs.common.types import Float, Index
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.segments import lowest_of_lines, nearest_on_segments, nearest_to_origin
from viapoint.envs.geometry.shape import (
    Components,
    Geom,
    Shape,
    blocks,
    bounds_of_points,
    length,
)

DENT = 1e-6
"""Depth of a vertex below the hull, as a share of the mesh's size, from which a mesh is not convex."""
COPLANAR = 2e-7
"""Distance between neighbouring faces, as a share of the mesh's size, within which they are one face: several times the
rounding of vertices in single precision."""
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

    vertices: Any
    """Shape (V, 3), [m]."""

    @classmethod
    def hull(cls, points: Any, **pose: Any) -> Self:
        """Return the convex hull of points, shape (K, 3), [m]; `pose` are position, quaternion and name."""
        vertices = finite_array("vertices", points, (None, 3))
        return cls(vertices[_convex_hull(vertices).vertices], **pose)

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
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

    def in_plane(self) -> tuple[Float, Float]:
        """Raise ValueError: meshes are no obstacles of arms in the plane."""
        raise ValueError(f"{self.kind} is for arms in space; in the plane, use boxes, cylinders and capsules")

    def _check(self) -> None:
        vertices = finite_array("vertices", self.vertices, (None, 3))
        object.__setattr__(self, "vertices", frozen(vertices.copy()))
        _check_convex(self.vertices, self.polytope)

    def _signed(self, points: Components) -> Float:
        """Return the signed distance.

        The nearest point of the surface is on a face, if the foot of the perpendicular on the plane with the greatest
        height lies on that face, and on an edge otherwise. Below all planes the height is the signed distance.
        """
        parts = np.stack(np.broadcast_arrays(*points))
        flat = parts.reshape(3, -1)
        face, edge, on_face = self._features(flat)
        body = self.polytope
        height = dot(list(flat), list(body.normals[face].T)) - body.offsets[face]
        offset, along = list(flat - body.starts[edge].T), list(body.edges[edge].T)
        share = nearest_to_origin(offset, [-u for u in along])
        beside = length([o - share * u for o, u in zip(offset, along, strict=True)])
        return np.where(on_face, height, beside).reshape(parts.shape[1:])

    def _features(self, points: Float) -> tuple[Index, Index, Any]:
        """Return the highest plane, the nearest edge, and True where the plane's face is nearest, for points (3, M)."""
        body, number = self.polytope, points.shape[1]
        face, edge = np.zeros(number, np.intp), np.zeros(number, np.intp)
        on_face = np.ones(number, dtype=bool)
        size = FOOT_TOLERANCE * (1.0 + np.abs(body.offsets).max()) + 2.0 * body.depth
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

    def _nearest(self, start: Components, along: Components) -> Float:
        """Return t in [0, 1] for which the signed distance is least, exactly.

        Outside, the nearest point is an end, or it is nearest to an edge. Of a segment that enters the mesh, the
        deepest point is where the greatest of the heights above all planes is least.
        """
        vectors = np.stack(np.broadcast_arrays(*start, *along))
        flat = vectors.reshape(6, -1)
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

        def at(t: Float) -> Float:
            return self._signed(list(flat[:3] + t * flat[3:]))

        t = best_of(at, (beside, within, np.zeros(number), np.ones(number)))
        return t.reshape(vectors.shape[1:])

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

    vertices: Any = field(init=False, default=None)
    """Shape (V, 3), [m]."""

    @classmethod
    def named(cls, name: str, mesh: ConvexMesh) -> type[NamedMesh]:
        """Return the class of a mesh with a name; the pose of the mesh does not matter."""
        own = ConvexMesh(mesh.vertices)
        middle, half = own.box()
        values = {"kind": name, "mesh": own, "middle": middle, "only_half": tuple(half.tolist())}
        return type(name, (cls,), {**values, "__doc__": f"Convex mesh {name!r}."})

    @classmethod
    def from_box(cls, centre: Float, quaternion: Float, half: Float) -> Self:
        """Return meshes from their bounding boxes; see :meth:`Shape.from_box`."""
        own = super().from_box(centre, quaternion, half)
        offset = [
            sum(float(m) * axis[i] for m, axis in zip(cls.middle, own._axes, strict=True)) for i in range(3)
        ]
        position = np.stack([centre[..., i] - o for i, o in enumerate(offset)], axis=-1)
        object.__setattr__(own, "position", position)
        own._check()
        return own

    @classmethod
    def _of_half(cls, half: Float) -> dict[str, Float]:
        del half
        return {}

    def _check(self) -> None:
        self.__dict__.update(vertices=self.mesh.vertices, polytope=self.mesh.polytope)


def _convex_hull(vertices: Float, coplanar: float = 0.0) -> Any:
    """Return the :class:`scipy.spatial.ConvexHull` of vertices, as triangles.

    Args:
        vertices: Shape (V, 3), [m].
        coplanar: Distance within which neighbouring faces are one, whose triangles then have the same plane, as a share
            of the mesh's size.

    Raises:
        ValueError: The vertices lie in a plane, or numbers are too large.
    """
    from scipy.spatial import ConvexHull, QhullError  # here, because it takes as long as all of the package

    size = np.ptp(vertices, axis=0).max()
    around = (vertices - vertices.mean(axis=0)) / (size if size > 0.0 else 1.0)
    if len(vertices) < 4 or np.linalg.svd(around, compute_uv=False)[2] < DENT:
        raise ValueError("vertices must span a volume, they lie in a plane; use a thin box or a point cloud")
    try:
        hull = ConvexHull(vertices, qhull_options=f"Qt C{coplanar * size:g}" if coplanar else "Qt")
        finite = np.isfinite(hull.equations).all()
    except QhullError:
        finite = False
    if not finite:
        raise ValueError("vertices must have a hull with finite planes; give them in metres")
    return hull


def _polytope(vertices: Float) -> Polytope:
    """Return the planes and edges of the hull of vertices; edges between triangles of one face are none."""
    hull = _convex_hull(vertices, COPLANAR)
    planes, face = np.unique(hull.equations, axis=0, return_inverse=True)
    face, normals = face.ravel(), planes[:, :3]
    parts = blocks(len(vertices), len(normals))
    offsets = np.max([(normals @ vertices[some].T).max(axis=1) for some in parts], axis=0)
    inner = offsets[face, None] - np.einsum("fij,fj->fi", vertices[hull.simplices], normals[face])
    # Neighbour k of a triangle, and side k, are opposite to corner k.
    sides = hull.simplices[:, [[1, 2], [2, 0], [0, 1]]]
    between_faces = face[:, None] != face[hull.neighbors]
    edges = np.unique(np.sort(sides[between_faces], axis=1), axis=0)
    starts = vertices[edges[:, 0]]
    return Polytope(normals, offsets, starts, vertices[edges[:, 1]] - starts, float(inner.max()))


def _check_convex(vertices: Float, body: Polytope) -> None:
    """Check that all vertices lie on their hull."""
    parts = blocks(len(vertices), len(body.offsets))
    depth = np.concatenate([(body.offsets - vertices[some] @ body.normals.T).min(axis=1) for some in parts])
    deepest, size = int(depth.argmax()), np.ptp(vertices, axis=0).max()
    if depth[deepest] > DENT * size:
        raise ValueError(
            f"vertices are not those of a convex mesh: vertex {deepest} lies {depth[deepest]:.3g} m inside their hull; "
            "ConvexMesh.hull(vertices) is the hull"
        )
