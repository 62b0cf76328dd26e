"""Convex meshes and point clouds in packed arrays, and the signed distance of a point."""

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
LEAF = 16  # Greatest number of points of a leaf of the tree
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
    on a triangle whose plane is below the point, but for rounding. `bound` is the radius of a sphere around the origin
    that contains the mesh.
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
    below = -DENT * bound
    for face in range(meshes.first[index], meshes.first[index + 1]):
        height = _height(meshes, face, x, y, z)
        if height > below and height * height < least:  # others cannot have the nearest point
            gx, gy, gz = _from_triangle(meshes, face, height, x, y, z)
            square = gx * gx + gy * gy + gz * gz
            if square < least:
                least = square
                dx, dy, dz = gx, gy, gz
    distance = math.sqrt(least)
    if distance <= -below:  # on the surface, where rounding has no direction, the gradient is the normal
        return distance, nx, ny, nz
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


def build_mesh(vertices: Float) -> Meshes:
    """Return the convex mesh of vertices, shape (V, 3), [m], with the triangles of their hull.

    Raises:
        ValueError: The vertices lie in a plane, or one is inside the hull.
    """
    hull = convex_hull(vertices, COPLANAR)
    corners, normals = vertices[hull.simplices], hull.equations[:, :3]
    size = np.ptp(vertices, axis=0).max()
    for vertex in np.setdiff1d(np.arange(len(vertices)), hull.simplices):
        depth = ((corners[:, 0] - vertices[vertex]) * normals).sum(axis=1).min()
        if depth > DENT * size:
            raise ValueError(
                f"vertices must be convex: vertex {vertex} lies {depth:.3g} m inside; ConvexMesh.hull(vertices) is "
                "the convex hull"
            )
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


class Clouds(NamedTuple):
    """Packed arrays of C point clouds, each in a frame of its own, with balanced binary trees of bounding boxes.

    The nodes of a tree with L leaves are numbered from 1, the root, to 2 L - 1; node i has the children 2 i and
    2 i + 1. Leaf j of a cloud of K points holds those from j K // L to (j + 1) K // L.
    """

    points: Float  # Points of all clouds, neighbours near one another, shape (P, 3), [m]
    radius: Float  # Radius of the spheres around the points, shape (C,), [m]
    first: Int  # Index of the first point of each cloud, and the number of all points, shape (C + 1,)
    node: Int  # Index of node 0 of each tree, and the number of all nodes, shape (C + 1,)
    # Least and greatest corner of the box of each node, shape (nodes, 6), [m]; node 0 of each tree has none
    boxes: Float


@kernel
def cloud_distance(
    clouds: Clouds, index: int, x: float, y: float, z: float, limit: float
) -> tuple[float, float, float, float]:
    """Return the distance of a point from the nearest sphere of a cloud, and its gradient.

    Beyond `limit`, the result is a lower bound.
    """
    radius = clouds.radius[index]
    bound = math.sqrt(_box_square(clouds.boxes, clouds.node[index] + 1, x, y, z)) - radius
    if bound > limit:
        return bound, 0.0, 0.0, 1.0
    nearest = _nearest_point(clouds, index, x, y, z, max(limit + radius, 0.0))
    if nearest < 0:  # none within the limit
        return limit, 0.0, 0.0, 1.0
    dx = x - clouds.points[nearest, 0]
    dy = y - clouds.points[nearest, 1]
    dz = z - clouds.points[nearest, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    if distance < TINY:
        return -radius, 0.0, 0.0, 1.0
    return distance - radius, dx / distance, dy / distance, dz / distance


@kernel
def _nearest_point(clouds: Clouds, index: int, x: float, y: float, z: float, reach: float) -> int:
    """Return the index of the point that is nearest to a place and nearer than `reach`, -1 for none.

    Nearer nodes come first. The bits of `waiting` say on which levels the sibling of the node must still be visited,
    so that no stack is needed.
    """
    start, root = clouds.first[index], clouds.node[index]
    number = clouds.first[index + 1] - start
    leaves = (clouds.node[index + 1] - root) // 2
    least, nearest = reach * reach, -1
    node, waiting = 1, 0
    if _box_square(clouds.boxes, root + node, x, y, z) >= least:
        return nearest
    while node > 0:
        if node < leaves:
            left = _box_square(clouds.boxes, root + 2 * node, x, y, z)
            right = _box_square(clouds.boxes, root + 2 * node + 1, x, y, z)
            if min(left, right) < least:
                waiting = 2 * waiting + (1 if max(left, right) < least else 0)  # one bit a level
                node = 2 * node + (1 if right < left else 0)
                continue
        else:
            leaf = node - leaves
            for point in range(start + leaf * number // leaves, start + (leaf + 1) * number // leaves):
                dx = x - clouds.points[point, 0]
                dy = y - clouds.points[point, 1]
                dz = z - clouds.points[point, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < least:
                    least, nearest = square, point
        node, waiting = _next_node(clouds.boxes, root, node, waiting, x, y, z, least)
    return nearest


@kernel
def _next_node(
    boxes: Float, root: int, node: int, waiting: int, x: float, y: float, z: float, least: float
) -> tuple[int, int]:
    """Return the next node whose box is nearer than a squared distance, 0 for none, and the levels that wait."""
    while waiting:
        while not waiting & 1:
            waiting >>= 1
            node >>= 1  # up again: nothing waits here
        waiting ^= 1
        node ^= 1  # the sibling
        if _box_square(boxes, root + node, x, y, z) < least:
            return node, waiting
    return 0, 0


@kernel
def _box_square(boxes: Float, node: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point from the box of a node, [m^2]."""
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return float(dx * dx + dy * dy + dz * dz)


def build_cloud(points: Float, radius: float) -> Clouds:
    """Return a cloud with its tree from points, shape (K, 3), [m].

    Level by level, each node is split along the longest side of its box (J. L. Bentley, Multidimensional binary search
    trees used for associative searching, 1975).
    """
    leaves = 1
    while leaves * LEAF < len(points):
        leaves *= 2  # a balanced tree has a power of two of them
    boxes = np.zeros((2 * leaves, 6))
    level = 1
    while True:
        first = np.arange(0, leaves, leaves // level) * len(points) // leaves
        low = np.minimum.reduceat(points, first)
        high = np.maximum.reduceat(points, first)
        boxes[level : 2 * level] = np.concatenate((low, high), axis=1)
        if level == leaves:
            break
        node = np.repeat(np.arange(level), np.diff(first, append=len(points)))
        side = (high - low).argmax(axis=1)
        width = np.take_along_axis(high - low, side[:, None], axis=1)[:, 0].clip(TINY)
        place = np.take_along_axis(points, side[node][:, None], axis=1)[:, 0]
        begin = np.take_along_axis(low, side[:, None], axis=1)[:, 0]
        points = points[np.argsort(node + 0.5 * (place - begin[node]) / width[node])]
        level *= 2
    return Clouds(points, np.array([radius]), np.array([0, len(points)]), np.array([0, len(boxes)]), boxes)


def join_clouds(clouds: Iterable[Clouds]) -> Clouds:
    """Return several records of one cloud each as one."""
    clouds = list(clouds)
    return Clouds(
        points=np.concatenate([np.empty((0, 3)), *(each.points for each in clouds)]),
        radius=np.concatenate([np.empty(0), *(each.radius for each in clouds)]),
        first=np.cumsum([0, *(len(each.points) for each in clouds)], dtype=np.int64),
        node=np.cumsum([0, *(len(each.boxes) for each in clouds)], dtype=np.int64),
        boxes=np.concatenate([np.empty((0, 6)), *(each.boxes for each in clouds)]),
    )


def split_clouds(clouds: Clouds) -> list[Clouds]:
    """Return a record of its own for each cloud."""
    found = []
    for i in range(len(clouds.radius)):
        points = clouds.points[clouds.first[i] : clouds.first[i + 1]]
        boxes = clouds.boxes[clouds.node[i] : clouds.node[i + 1]]
        first = np.array([0, len(points)])
        node = np.array([0, len(boxes)])
        found.append(Clouds(points, clouds.radius[i : i + 1], first, node, boxes))
    return found


NO_MESHES = join_meshes([])
NO_CLOUDS = join_clouds([])
