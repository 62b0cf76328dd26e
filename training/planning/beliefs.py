"""Beliefs: obstacles that a planner assumes where a sensor sees only fronts.

A belief is a set of obstacles, so that every planner of this package can plan with it. The simplest are point clouds of
what was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from viapoint.envs.common.types import Bool, Float
from viapoint.envs.geometry.obstacles import Obstacles, pack, quaternions_of
from viapoint.envs.geometry.shapes import Box, PointCloud, Shape
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task

ROUNDING = 1e-4
"""Distance from the greatest range within which nothing was met, [m]."""
POINT_RADIUS = 0.01
"""Radius of the spheres around points, [m]."""
THICKNESS = {"hand": 0.06, "joints": 0.05}
"""Depth to which the space behind a seen surface is believed to be occupied, [m]."""
SPACING = 0.015
"""Distance of points behind a surface, and edge of the cubes of which each holds one point, [m]."""
CUBES = 1 << 16
"""Greatest number of cubes along an axis."""
CONNECTED = 0.06
"""Distance of points of one obstacle, [m]."""
LEAST_HALF = 0.01
"""Least half length of a fitted box, [m]."""
CURVED = 0.12
"""Depth of a front relative to its width from which on it is believed to be curved."""


class Sight(NamedTuple):
    """Readings of a sensor in B scenes, as an observation tells them."""

    origin: Float
    """Places of the sensor, shape (B, 3), [m]."""
    rotation: Float
    """Axes of the sensor as columns, shape (B, 3, 3)."""
    ranges: Float
    """Shape (B, R), [m]."""
    points: Float
    """Shape (B, R, 3), [m]."""
    hit: Bool
    """True for rays that met something, shape (B, R)."""

    @classmethod
    def of(cls, observation: Mapping[str, Any], task: Task) -> Sight:
        """Return the readings of B observations, parts of shape (B, .) each."""
        assert task.sensor is not None
        joints = np.asarray(observation["joints"], np.float64)
        ranges = np.asarray(observation["ranges"], np.float64)
        points = np.asarray(observation["points"], np.float64).reshape(*ranges.shape, 3)
        rotation, origin = task.sensor.pose(task.arm, joints)
        return cls(origin, rotation, ranges, points, ranges < task.sensor.range - ROUNDING)

    @classmethod
    def of_scenes(cls, scenes: Scenes, task: Task) -> Sight:
        """Return the readings at the beginning of B scenes."""
        sensor = task.sensor
        assert sensor is not None
        rotation, origin = sensor.pose(task.arm, scenes.start)
        found = sensor.read(task.arm, scenes.start, scenes.obstacles)
        return cls(origin, rotation, found.ranges, found.points, found.ranges < sensor.range - ROUNDING)


def points_alone(task: Task, sight: Sight) -> Obstacles:
    """Return clouds of the points that were seen."""
    return _clouds([points[hit] for points, hit in zip(sight.points, sight.hit, strict=True)])


def thick_points(task: Task, sight: Sight) -> Obstacles:
    """Return clouds of the points that were seen and of some space behind each."""
    steps = np.arange(0.0, THICKNESS[task.space_name] + 1e-9, SPACING)
    found = []
    for origin, points, hit in zip(sight.origin, sight.points, sight.hit, strict=True):
        away = points[hit] - origin
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        found.append((points[hit][:, None] + steps[:, None] * away[:, None]).reshape(-1, 3))
    return _clouds(found)


def fitted_boxes(task: Task, sight: Sight) -> Obstacles:
    """Return one box for each connected group of points, as deep as it is wide."""
    scenes = []
    for origin, points, hit in zip(sight.origin, sight.points, sight.hit, strict=True):
        seen = points[hit]
        shapes: list[Shape] = []
        if len(seen):
            pairs = cKDTree(seen).sparse_distance_matrix(cKDTree(seen), CONNECTED)
            number, group = connected_components(pairs)
            for each in range(number):
                shapes.append(_box_around(seen[group == each], origin, THICKNESS[task.space_name]))
        scenes.append(shapes)
    return pack(scenes)


def _box_around(points: Float, origin: Float, deepest: float) -> Box:
    """Return a box along the principal axes of points, and some space behind them as seen from an origin.

    A curved front is believed to be as deep as it is wide, and a flat one to be thin.
    """
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(np.concatenate((points - middle, np.zeros((3, 3)))), full_matrices=False)
    axes = axes.T
    local, away = (points - middle) @ axes, (middle - origin) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    extent = high - low
    # Rays of a fan lie in a plane: the second axis is the depth of the front, and the third one tells nothing.
    depth = 1 if extent[2] < 1e-6 else 2
    width = float(extent[depth - 1])
    curved = extent[depth] > CURVED * width
    behind = max((min(width, deepest) if curved else 2.0 * LEAST_HALF) - extent[depth], 0.0)
    if away[depth] > 0.0:
        high[depth] += behind
    else:
        low[depth] -= behind
    half = np.maximum(0.5 * (high - low) + POINT_RADIUS, LEAST_HALF)
    sign = float(np.linalg.det(axes))
    axes = axes * sign
    place = middle + sign * axes @ (0.5 * (high + low))
    return Box(half, position=place, quaternion=quaternions_of(axes))


def _clouds(points: list[Float]) -> Obstacles:
    """Return one cloud for each scene that has points, with one point in each cube of SPACING."""
    scenes: list[list[Shape]] = []
    for each in points:
        cubes = np.floor(each / SPACING).astype(np.int64) + CUBES // 2
        numbers = (cubes[:, 0] * CUBES + cubes[:, 1]) * CUBES + cubes[:, 2]
        _, first = np.unique(numbers, return_index=True)
        scenes.append([PointCloud(each[first], radius=POINT_RADIUS)] if len(each) else [])
    return pack(scenes, rows=1)
