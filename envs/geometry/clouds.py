"""Point clouds in packed arrays: trees of bounding boxes, and the distance of a point."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Float, Int
from viapoint.envs.geometry.kernels import kernel

LEAF = 16
"""Greatest number of points of a leaf of the tree."""
CELLS, CELLS_PER_POINT = 1 << 15, 8
"""Greatest number of cells of a grid, and for each point."""
FAR = 1e6
"""Distance beyond everything, [m]."""
TINY = 1e-12
"""Length below which a vector has no direction, [m]."""


class Cloud(NamedTuple):
    """Point cloud with a balanced binary tree of bounding boxes.

    The nodes of a tree with L leaves are numbered from 1, the root, to 2 L - 1; node i has the children 2 i and
    2 i + 1. Leaf j holds the points from j K // L to (j + 1) K // L.
    """

    points: Float
    """Points, neighbours near one another, shape (K, 3), [m]."""
    radius: float
    """Radius of the spheres around the points, [m]."""
    boxes: Float
    """Least and greatest corner of the box of each node, shape (2 L, 6), [m]; node 0 has none."""
    edge: float
    """Edge of the cells of a grid over the box of the root, [m]."""
    cells: Int
    """Number of cells along each axis, shape (3,)."""
    gap: Float
    """Distance from the centre of each cell to the nearest point, shape (cells,), [m]."""


class Clouds(NamedTuple):
    """Packed arrays of C point clouds, each in a frame of its own; see :class:`Cloud`."""

    points: Float
    """Points of all clouds, shape (P, 3), [m]."""
    radius: Float
    """Radius of the spheres around the points, shape (C,), [m]."""
    first: Int
    """Index of the first point of each cloud, and the number of all points, shape (C + 1,)."""
    node: Int
    """Index of node 0 of each tree, and the number of all nodes, shape (C + 1,)."""
    boxes: Float
    """Boxes of all trees, shape (nodes, 6), [m]."""
    edge: Float
    """Edge of the cells of each grid, shape (C,), [m]."""
    cells: Int
    """Number of cells of each grid along each axis, shape (C, 3)."""
    cell: Int
    """Index of the first cell of each grid, and the number of all cells, shape (C + 1,)."""
    gap: Float
    """Distance from the centre of each cell to the nearest point, shape (cells,), [m]."""


@kernel
def cloud_distance(
    clouds: Clouds, index: int, x: float, y: float, z: float, limit: float
) -> tuple[float, float, float, float]:
    """Return the distance of a point from the nearest sphere of a cloud, and its gradient.

    The grid gives a lower bound at once, the result where it is beyond `limit`. Otherwise the tree gives the nearest
    point; if there is none within `limit`, the result is `limit`.
    """
    radius = clouds.radius[index]
    bound = _lower_bound(clouds, index, x, y, z) - radius
    if bound > limit:
        return bound, 0.0, 0.0, 1.0
    nearest = _nearest_point(clouds, index, x, y, z, max(limit + radius, 0.0))
    if nearest < 0:
        return limit, 0.0, 0.0, 1.0
    dx = x - clouds.points[nearest, 0]
    dy = y - clouds.points[nearest, 1]
    dz = z - clouds.points[nearest, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    if distance < TINY:
        return -radius, 0.0, 0.0, 1.0
    return distance - radius, dx / distance, dy / distance, dz / distance


@kernel
def _lower_bound(clouds: Clouds, index: int, x: float, y: float, z: float) -> float:
    """Return a lower bound of the distance of a place from the points of a cloud, [m]."""
    box = clouds.node[index] + 1
    edge = clouds.edge[index]
    number = 0
    beyond, within = 0.0, 0.0
    for axis in range(3):
        place = x if axis == 0 else y if axis == 1 else z
        inside = min(max(place, clouds.boxes[box, axis]), clouds.boxes[box, axis + 3])
        offset = (inside - clouds.boxes[box, axis]) / edge
        cell = min(int(offset), clouds.cells[index, axis] - 1)
        number = number * clouds.cells[index, axis] + cell
        beyond += (place - inside) ** 2
        within += (offset - cell - 0.5) ** 2
    # A point x of a box is at least as far from p as sqrt(|p - q|^2 + |q - x|^2), where q is nearest to p in the box.
    gap = max(clouds.gap[clouds.cell[index] + number] - edge * math.sqrt(within), 0.0)
    return math.sqrt(beyond + gap * gap)


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
                waiting = 2 * waiting + (1 if max(left, right) < least else 0)
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
            node >>= 1
        waiting ^= 1
        node ^= 1
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


def build_cloud(points: Float, radius: float) -> Cloud:
    """Return a cloud with its tree and grid from points, shape (K, 3), [m]."""
    points, boxes = _tree(points)
    extent = boxes[1, 3:] - boxes[1, :3]
    edge = max(float(extent.max()), TINY)
    most = min(CELLS_PER_POINT * len(points), CELLS)
    while edge > TINY and np.prod(np.ceil(extent / (0.8 * edge)).clip(1.0)) <= most:
        edge *= 0.8
    cells = np.ceil(extent / edge).clip(1.0).astype(np.int64)
    gap = np.zeros(int(cells.prod()))
    cloud = Cloud(points, radius, boxes, edge, cells, gap)
    _fill_gaps(join_clouds([cloud]), gap)
    return cloud


def _tree(points: Float) -> tuple[Float, Float]:
    """Return points, shape (K, 3), in the order of a tree, and the boxes of its nodes, shape (2 L, 6), [m].

    Level by level, each node is split along the longest side of its box (J. L. Bentley, Multidimensional binary search
    trees used for associative searching, 1975).
    """
    leaves = 1
    while leaves * LEAF < len(points):
        leaves *= 2
    boxes = np.zeros((2 * leaves, 6))
    level = 1
    while True:
        first = np.arange(0, leaves, leaves // level) * len(points) // leaves
        low = np.minimum.reduceat(points, first)
        high = np.maximum.reduceat(points, first)
        boxes[level : 2 * level] = np.concatenate((low, high), axis=1)
        if level == leaves:
            return points, boxes
        node = np.repeat(np.arange(level), np.diff(first, append=len(points)))
        side = (high - low).argmax(axis=1)
        width = np.take_along_axis(high - low, side[:, None], axis=1)[:, 0].clip(TINY)
        place = np.take_along_axis(points, side[node][:, None], axis=1)[:, 0]
        begin = np.take_along_axis(low, side[:, None], axis=1)[:, 0]
        points = points[np.argsort(node + 0.5 * (place - begin[node]) / width[node])]
        level *= 2


@kernel
def _fill_gaps(clouds: Clouds, gap: Float) -> None:
    """Fill in the distances from the centres of the cells of one cloud to the nearest points, [m]."""
    edge, cells = clouds.edge[0], clouds.cells[0]
    number = 0
    for i in range(cells[0]):
        x = clouds.boxes[1, 0] + (i + 0.5) * edge
        for j in range(cells[1]):
            y = clouds.boxes[1, 1] + (j + 0.5) * edge
            for k in range(cells[2]):
                z = clouds.boxes[1, 2] + (k + 0.5) * edge
                # Neighbouring cells differ by at most an edge.
                reach = gap[number - 1] + 1.001 * edge if k > 0 else FAR
                point = _nearest_point(clouds, 0, x, y, z, reach)
                dx = x - clouds.points[point, 0]
                dy = y - clouds.points[point, 1]
                dz = z - clouds.points[point, 2]
                gap[number] = math.sqrt(dx * dx + dy * dy + dz * dz)
                number += 1


def join_clouds(clouds: Iterable[Cloud]) -> Clouds:
    """Return clouds as packed arrays."""
    clouds = list(clouds)
    return Clouds(
        points=np.concatenate([np.empty((0, 3)), *(each.points for each in clouds)]),
        radius=np.array([each.radius for each in clouds], np.float64),
        first=np.cumsum([0, *(len(each.points) for each in clouds)], dtype=np.int64),
        node=np.cumsum([0, *(len(each.boxes) for each in clouds)], dtype=np.int64),
        boxes=np.concatenate([np.empty((0, 6)), *(each.boxes for each in clouds)]),
        edge=np.array([each.edge for each in clouds], np.float64),
        cells=np.array([each.cells for each in clouds], np.int64).reshape(-1, 3),
        cell=np.cumsum([0, *(len(each.gap) for each in clouds)], dtype=np.int64),
        gap=np.concatenate([np.empty(0), *(each.gap for each in clouds)]),
    )


def split_clouds(clouds: Clouds) -> list[Cloud]:
    """Return the clouds of packed arrays."""
    return [
        Cloud(
            points=clouds.points[clouds.first[i] : clouds.first[i + 1]],
            radius=float(clouds.radius[i]),
            boxes=clouds.boxes[clouds.node[i] : clouds.node[i + 1]],
            edge=float(clouds.edge[i]),
            cells=clouds.cells[i],
            gap=clouds.gap[clouds.cell[i] : clouds.cell[i + 1]],
        )
        for i in range(len(clouds.radius))
    ]
