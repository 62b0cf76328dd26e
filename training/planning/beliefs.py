"""Beliefs: obstacles that a planner assumes where a sensor sees only fronts.

A belief is a set of obstacles, so that every planner of this package can plan with it. The simplest are point clouds of
what was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.common.arrays import Bool, Float, Single
from viapoint.envs.geometry.obstacles import Obstacles, pack, quaternions_of
from viapoint.envs.geometry.shapes import Box, PointCloud, Shape
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task

ROUNDING = 1e-4  # Distance from the greatest range within which nothing was met, [m]
POINT_RADIUS = 0.01  # Radius of the spheres around points, [m]
# Depth to which the space behind a seen surface is believed to be occupied, [m]
THICKNESS = {"hand": 0.06, "joints": 0.05}
# Distance of points behind a surface, and edge of the cubes of which each holds one point, [m]
SPACING = 0.015
# Clearance that is believed at start and goal, which are known to be free, [m]
END_CLEARANCE = 0.01
CUBES = 1 << 16  # Greatest number of cubes along an axis
CONNECTED = 0.06  # Distance of points of one obstacle, [m]
LEAST_HALF = 0.01  # Least half length of a fitted box, [m]
CURVED = 0.12  # Depth of a front relative to its width from which on it is believed to be curved


class Sight(NamedTuple):
    """Readings of L looks of a sensor in B scenes, as an observation tells them, the newest first."""

    origin: Float  # Places of the sensor, shape (B, L, 3), [m]
    rotation: Float  # Axes of the sensor as columns, shape (B, L, 3, 3)
    ranges: Float  # Ranges of the R rays of all looks, shape (B, R), [m]
    points: Float  # Ends of the rays, shape (B, R, 3), [m]
    eyes: Float  # Places from which they were seen, shape (B, R, 3), [m]
    hit: Bool  # True for rays that met something, shape (B, R)
    # Centres of the arm's spheres at start and goal, where nothing can be, shape (B, E, 3), [m]
    free: Float
    free_radius: Float  # Radii of these spheres, shape (E,), [m]

    def take(self, rows: Any) -> Sight:
        """Return the readings of some of the scenes, by indices, mask or slice."""
        return self._replace(
            **{name: part[rows] for name, part in self._asdict().items() if name != "free_radius"}
        )

    @property
    def made(self) -> Bool:
        """True for looks that were made, shape (B, L): their rays have a length."""
        number, looks = self.origin.shape[:2]
        return np.asarray((self.points != self.eyes).reshape(number, looks, -1).any(axis=-1))

    def towards(self, sensor: Sensor, places: Any) -> tuple[NDArray[np.int32], Single]:
        """Return the rays in whose direction places lie, -1 if out of view, and their distances from the sensor, [m].

        Of several looks it is the one that saw farthest beyond the place. Places have the shape (B, n, 3), and what is
        returned the shape (B, n).
        """
        found = np.full(places.shape[:2], -1, np.int32)
        distance = np.zeros(found.shape, np.float32)
        farthest = np.full(found.shape, -np.inf, np.float32)
        made = self.made
        for look in np.flatnonzero(made.any(axis=0)):
            away = places - self.origin[:, None, look].astype(np.float32)
            local = away @ self.rotation[:, look].astype(np.float32)
            length = np.sqrt((local**2).sum(axis=-1))
            ray = sensor.ray_towards(local)
            first = look * sensor.n_rays
            seen = np.take_along_axis(self.ranges, first + np.maximum(ray, 0), axis=1)
            in_view = (ray >= 0) & made[:, look, None]
            beyond = np.where(in_view, seen - length, -np.inf).astype(np.float32)
            better = beyond > farthest
            found = np.where(better, first + ray, found)
            distance = np.where(better | (look == 0), length, distance)
            farthest = np.where(better, beyond, farthest)
        return found, distance

    @classmethod
    def of(cls, observation: Mapping[str, Any], task: Task) -> Sight:
        """Return the readings of B observations, parts of shape (B, .) each."""
        sensor, spheres = task.sensor, task.arm.spheres
        assert sensor is not None
        parts = {name: np.asarray(part, np.float64) for name, part in observation.items()}
        ranges, joints = parts["ranges"], parts["joints"]
        points = parts["points"].reshape(*ranges.shape, 3)
        rotation, origin = (part[:, None] for part in sensor.pose(task.arm, joints))
        if "eyes" in parts:
            origin = parts["eyes"].reshape(len(joints), -1, 3)
            rays = points.reshape(*origin.shape[:2], -1, 3) - origin[:, :, None]
            rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-9)
            rotation = np.concatenate((rotation, _axes(rays[:, 1:], sensor.directions)), axis=1)
        eyes = np.repeat(origin, sensor.n_rays, axis=1)
        hit = ranges < sensor.range - ROUNDING
        if task.space_name == "hand":
            free = np.stack((parts["hand"], parts["goal"]), axis=1)
            radius = np.full(2, float(spheres.radius[-1]))
        else:
            ends = joints, parts["goal_joints"]
            free = np.concatenate([sphere_centres(task.arm.chain, spheres, each) for each in ends], axis=1)
            radius = np.tile(spheres.radius, 2)
        return cls(origin, rotation, ranges, points, eyes, hit, free, radius)

    @classmethod
    def of_scenes(cls, scenes: Scenes, task: Task) -> Sight:
        """Return the readings at the beginning of B scenes."""
        assert task.sensor is not None
        found = task.sensor.read(task.arm, scenes.start, scenes.obstacles)
        observation = {"joints": scenes.start, "goal_joints": scenes.goal}
        observation |= {"ranges": found.ranges, "points": found.points}
        if task.space_name == "hand":
            observation |= {"hand": task.arm.hand(scenes.start), "goal": task.arm.hand(scenes.goal)}
        return cls.of(observation, task)


def _axes(rays: Float, directions: Float) -> Float:
    """Return the axes of sensors as columns, shape (..., 3, 3), of which rays have the directions in their frames.

    It is the rotation of the least squared error (W. Kabsch, 1976), also for the rays of a fan, which lie in a plane.
    """
    left, _, right = np.linalg.svd(np.einsum("...ri,rj->...ij", rays, directions))
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def thick_points(task: Task, sight: Sight, depth: float | None = None) -> Obstacles:
    """Return clouds of the points that were seen and of the space behind each, THICKNESS or another depth, [m].

    A cloud has one point in each cube of SPACING, and none at the ends of the movement.
    """
    steps = np.arange(0.0, (THICKNESS[task.space_name] if depth is None else depth) + 1e-9, SPACING)
    scenes: list[list[Shape]] = []
    for b, hit in enumerate(sight.hit):
        seen = sight.points[b, hit]
        away = seen - sight.eyes[b, hit]
        away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), ROUNDING)  # a reading may be 0
        points = (seen[:, None] + steps[:, None] * away[:, None]).reshape(-1, 3)
        cubes = np.floor(points / SPACING).astype(np.int64) + CUBES // 2
        numbers = (cubes[:, 0] * CUBES + cubes[:, 1]) * CUBES + cubes[:, 2]
        _, first = np.unique(numbers, return_index=True)
        points = points[first]
        away = ((points[:, None] - sight.free[b]) ** 2).sum(axis=-1)
        points = points[(away >= (sight.free_radius + POINT_RADIUS + END_CLEARANCE) ** 2).all(axis=-1)]
        scenes.append([PointCloud(points, radius=POINT_RADIUS)] if len(points) else [])
    return pack(scenes, rows=1)


def fitted_boxes(task: Task, sight: Sight) -> Obstacles:
    """Return one box for each connected group of points, as deep as it is wide."""
    scenes = []
    for origin, points, hit in zip(sight.origin[:, 0], sight.points, sight.hit, strict=True):
        seen = points[hit]
        shapes: list[Shape] = []
        if len(seen):
            first, second = cKDTree(seen).query_pairs(CONNECTED, output_type="ndarray").T
            near = coo_array((np.ones(len(first)), (first, second)), shape=(len(seen), len(seen)))
            number, group = connected_components(near, directed=False)
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
    local = (points - middle) @ axes
    away = (middle - origin) @ axes
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
