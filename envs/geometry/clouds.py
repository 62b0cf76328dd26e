"""Point clouds in packed arrays: trees of bounding boxes, and the distance of a point."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.arrays import Float, Int
from viapoint.envs.geometry.compiled import TINY, kernel

LEAF = 16  # Greatest number of points of a leaf of the tree


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
