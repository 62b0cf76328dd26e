"""Signed distance of a point from packed obstacles, and its gradient; `shapes` has the formula of each shape."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import Float
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.compiled import compiled, inlined, rotated, rotated_back
from viapoint.envs.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.geometry.shapes import Distance, Shape, as_obstacles, local_distance


@inlined
def point_distance(
    obstacles: Obstacles, scene: int, row: int, x: float, y: float, z: float, time: float, limit: float
) -> float:
    """Return the signed distance of a point from an obstacle, [m]; see :func:`point_distance_and_normal`."""
    # The compiler leaves out the gradient, because nothing uses it.
    return point_distance_and_normal(obstacles, scene, row, x, y, z, time, limit)[0]


@inlined
def point_distance_and_normal(
    obstacles: Obstacles, scene: int, row: int, x: float, y: float, z: float, time: float, limit: float
) -> Distance:
    """Return the signed distance of a point from an obstacle, [m], and its gradient, the outward normal.

    The obstacle has moved for `time` since it was at its centre; absent ones are far away. Beyond `limit`, [m], any
    number between it and the distance may be returned.
    """
    centre, velocity, size = obstacles.centre, obstacles.velocity, obstacles.size
    dx = x - centre[scene, row, 0] - time * velocity[scene, row, 0]
    dy = y - centre[scene, row, 1] - time * velocity[scene, row, 1]
    dz = z - centre[scene, row, 2] - time * velocity[scene, row, 2]
    axes = obstacles.rotation[scene, row]
    here = rotated_back(axes, (dx, dy, dz))
    sizes = size[scene, row, 0], size[scene, row, 1], size[scene, row, 2]
    kind, meshes, clouds = obstacles.kind[scene, row], obstacles.meshes, obstacles.clouds
    distance, nx, ny, nz = local_distance(kind, sizes, meshes, clouds, here, limit)
    nx, ny, nz = rotated(axes, (nx, ny, nz))
    return distance, nx, ny, nz


@compiled
def point_clearances(obstacles: Obstacles, point: tuple[float, float, float]) -> Float:
    """Return the signed distance of a point from the nearest obstacle of each of N scenes, shape (N,), at most 1 m."""
    x, y, z = point
    found = np.ones(len(obstacles.kind))
    for scene in range(len(found)):
        for row in range(obstacles.kind.shape[1]):
            if obstacles.kind[scene, row] != ABSENT:
                apart = point_distance(obstacles, scene, row, x, y, z, 0.0, 1.0)
                found[scene] = min(found[scene], apart)
    return found


def signed_distances(obstacles: Iterable[Shape | Mapping[str, Any]], points: Any, radius: Any = 0.0) -> Float:
    """Return the signed distances of points, or spheres, from n obstacles at time 0, shape (..., n), [m].

    Args:
        obstacles: n shapes or dictionaries.
        points: Shape (..., 3), [m].
        radius: Radius of the spheres, which broadcasts with the leading axes, [m].

    Example:
        >>> from viapoint.envs.geometry.distance import signed_distances
        >>> from viapoint.envs.geometry.shapes import Box, Sphere
        >>> scene = [Box((0.4, 0.6, 0.02), position=(0.5, 0.0, 0.2)), Sphere(0.05, position=(0.5, 0.2, 0.27))]
        >>> signed_distances(scene, [0.5, 0.0, 0.27], radius=0.03).round(3).tolist()
        [0.02, 0.12]
    """
    points = finite_array("points", points, (..., 3))
    shapes = as_obstacles(obstacles)
    if not shapes:
        return np.zeros((*points.shape[:-1], 0))
    return np.stack([shape.distance(points, radius) for shape in shapes], axis=-1)
