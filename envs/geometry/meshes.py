"""Convex meshes in packed arrays, and the signed distance of a point."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import Float, Int
from viapoint.envs.geometry.compiled import TINY, kernel

FAR = 1e6  # Distance beyond everything, [m]
DENT = 1e-6  # Depth of a vertex below the hull from which a mesh is not convex, as a share of the mesh's size
COPLANAR = 2e-7
"""Distance between neighbouring faces within which they are one face, as a share of the mesh's size: several times the
rounding of vertices in single precision."""
HULL_HINT = "ConvexMesh.hull(vertices) is the convex hull"  # Hint of error messages
SLIVER = 1e-12
"""Area of triangles that are left out, as a share of the square of the mesh's size; their neighbours cover them."""


class Meshes(NamedTuple):
    """Packed arrays of M convex meshes, each in a frame of its own."""

    first: Int  # Index of the first face of each mesh, and the number of all faces, shape (M + 1,)
    corners: Float  # Corners of all triangles, counterclockwise as seen from outside, shape (F, 3, 3), [m]
    normals: Float  # Outward unit normals of all triangles, shape (F, 3)


@kernel
def mesh_distance(
    meshes: Meshes, index: int, bound: float, x: float, y: float, z: float, limit: float
) -> tuple[float, float, float, float]:
    """Return the signed distance of a point from a convex mesh, and its gradient; a lower bound beyond `limit`.

    Inside, the distance is the greatest height above the plane of a face, and negative. Outside, the nearest point is
    on a triangle whose plane is below the point. `bound` is the radius of a sphere around the origin that contains
    the mesh.
    """
    away = math.sqrt(x * x + y * y + z * z) - bound
    if away > max(limit, 0.0):
        return away, 0.0, 0.0, 1.0
    highest, top = -FAR, 0
    for face in range(meshes.first[index], meshes.first[index + 1]):
        height = _height(meshes, face, x, y, z)
        if height > highest:
            highest, top = height, face
    nx = meshes.normals[top, 0]
    ny = meshes.normals[top, 1]
    nz = meshes.normals[top, 2]
    if highest <= 0.0 or highest > limit:  # inside, or a lower bound that is enough
        return highest, nx, ny, nz
    least = FAR * FAR
    dx, dy, dz = 0.0, 0.0, 0.0
    for face in range(meshes.first[index], meshes.first[index + 1]):
        height = _height(meshes, face, x, y, z)
        if height > 0.0 and height * height < least:  # others cannot have the nearest point
            gx, gy, gz = _from_triangle(meshes, face, height, x, y, z)
            square = gx * gx + gy * gy + gz * gz
            if square < least:
                least = square
                dx, dy, dz = gx, gy, gz
    distance = math.sqrt(least)
    if distance < TINY:  # on the surface the gradient of the distance is the normal
        return highest, nx, ny, nz
    return distance, dx / distance, dy / distance, dz / distance


@kernel
def _height(meshes: Meshes, face: int, x: float, y: float, z: float) -> float:
    """Return the height of a point above the plane of a face, [m]."""
    return float(
        meshes.normals[face, 0] * (x - meshes.corners[face, 0, 0])
        + meshes.normals[face, 1] * (y - meshes.corners[face, 0, 1])
        + meshes.normals[face, 2] * (z - meshes.corners[face, 0, 2])
    )


@kernel
def _from_triangle(
    meshes: Meshes, face: int, height: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return the vector to a point, at a height above the plane of a triangle, from the nearest point of the triangle.

    The foot of the perpendicular is the nearest point, unless it lies beyond an edge; then the nearest point is on
    such an edge.
    """
    nx = meshes.normals[face, 0]
    ny = meshes.normals[face, 1]
    nz = meshes.normals[face, 2]
    least = FAR * FAR
    dx, dy, dz = height * nx, height * ny, height * nz
    for corner in range(3):
        following = (corner + 1) % 3
        # Edge, and the point relative to the beginning of the edge
        ex = meshes.corners[face, following, 0] - meshes.corners[face, corner, 0]
        ey = meshes.corners[face, following, 1] - meshes.corners[face, corner, 1]
        ez = meshes.corners[face, following, 2] - meshes.corners[face, corner, 2]
        px = x - meshes.corners[face, corner, 0]
        py = y - meshes.corners[face, corner, 1]
        pz = z - meshes.corners[face, corner, 2]
        beyond = px * (ey * nz - ez * ny) + py * (ez * nx - ex * nz) + pz * (ex * ny - ey * nx)
        if beyond <= 0.0:
            continue
        share = (px * ex + py * ey + pz * ez) / (ex * ex + ey * ey + ez * ez)
        share = min(max(share, 0.0), 1.0)
        gx = px - share * ex
        gy = py - share * ey
        gz = pz - share * ez
        square = gx * gx + gy * gy + gz * gz
        if square < least:
            least = square
            dx, dy, dz = gx, gy, gz
    return dx, dy, dz


def build_mesh(vertices: Float, faces: Int | None) -> Meshes:
    """Return the convex mesh of vertices, shape (V, 3), [m], with the triangles of their hull.

    Given faces, shape (F, 3), must be closed and convex.

    Raises:
        ValueError: The vertices lie in a plane, or the mesh is open or not convex.
    """
    hull = convex_hull(vertices, COPLANAR)
    corners, normals = vertices[hull.simplices], hull.equations[:, :3]
    size = np.ptp(vertices, axis=0).max()
    for vertex in np.setdiff1d(np.arange(len(vertices)), hull.simplices):
        depth = ((corners[:, 0] - vertices[vertex]) * normals).sum(axis=1).min()
        if depth > DENT * size:
            raise ValueError(
                f"vertices must be convex: vertex {vertex} lies {depth:.3g} m inside; {HULL_HINT}"
            )
    if faces is not None:
        _check_faces(vertices, faces, hull.volume, DENT * size**3)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    clockwise = (area * normals).sum(axis=1) < 0.0  # Qhull does not order corners
    corners[clockwise] = corners[clockwise, ::-1]
    wide = np.linalg.norm(area, axis=1) > SLIVER * size**2
    return Meshes(np.array([0, int(wide.sum())]), corners[wide], normals[wide])


def convex_hull(vertices: Float, coplanar: float = 0.0) -> Any:
    """Return the :class:`scipy.spatial.ConvexHull` of vertices, shape (V, 3), as triangles.

    Neighbouring faces within the distance `coplanar`, as a share of the size, have the same plane.

    Raises:
        ValueError: The vertices lie in a plane, or numbers are too large.
    """
    from scipy.spatial import ConvexHull, QhullError  # here, because it takes as long as all of the package

    size = np.ptp(vertices, axis=0).max()
    around = (vertices - vertices.mean(axis=0)) / (size if size > 0.0 else 1.0)
    if len(vertices) < 4 or np.linalg.svd(around, compute_uv=False)[2] < DENT:
        raise ValueError("vertices must span a volume, but lie in a plane; use a thin box or a point cloud")
    try:
        hull = ConvexHull(vertices, qhull_options=f"Qt C{coplanar * size:g}" if coplanar else "Qt")
        finite = np.isfinite(hull.equations).all()
    except QhullError:
        finite = False
    if not finite:
        raise ValueError("vertices must have a hull with finite planes; give them in metres")
    return hull


def _check_faces(vertices: Float, faces: Int, volume: float, tolerance: float) -> None:
    """Check that triangles are closed, look to one side, and contain the volume of the hull, [m^3]."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).tolist()
    known = {(first, second) for first, second in edges}
    if len(known) < len(edges) or any((second, first) not in known for first, second in known):
        raise ValueError(f"faces must be closed: each edge belongs to two, in both directions; {HULL_HINT}")
    inside = np.linalg.det(vertices[faces]).sum() / 6.0
    if abs(abs(inside) - volume) > tolerance:
        raise ValueError(
            f"faces must be convex, but contain {abs(inside):.4g} of the {volume:.4g} m^3 of their hull; {HULL_HINT}"
        )


def join_meshes(meshes: Iterable[Meshes]) -> Meshes:
    """Return several records of one mesh each as one."""
    meshes = list(meshes)
    return Meshes(
        np.cumsum([0, *(len(each.normals) for each in meshes)], dtype=np.int64),
        np.concatenate([np.empty((0, 3, 3)), *(each.corners for each in meshes)]),
        np.concatenate([np.empty((0, 3)), *(each.normals for each in meshes)]),
    )


def split_meshes(meshes: Meshes) -> list[Meshes]:
    """Return a record of its own for each mesh."""
    found = []
    for first, last in itertools.pairwise(meshes.first):
        part = slice(first, last)
        found.append(Meshes(np.array([0, last - first]), meshes.corners[part], meshes.normals[part]))
    return found
