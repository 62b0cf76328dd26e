"""Outlines of shapes from above."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from viapoint.envs import Box, ConvexMesh, Cylinder, HalfSpace, PointCloud, Shape
from viapoint.envs.common.types import Float

CIRCLE = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]  # Angles of the points of a circle, [rad]


def footprint(shape: Shape, rim: float = 0.0) -> list[Float]:
    """Return the outlines of a shape from above, widened by a rim, convex polygons of shape (K, 2) each, [m].

    A half-space is a large square if it is a wall; a floor or a ceiling has no outline.
    """
    if isinstance(shape, HalfSpace):
        normal = shape.rotation[:2, 2]
        if np.linalg.norm(normal) < 0.7:
            return []
        normal = normal / np.linalg.norm(normal)
        along = np.array([-normal[1], normal[0]])
        corners = [4.0 * (way * along - depth * normal) for way in (-1.0, 1.0) for depth in (0.0, 1.0)]
        return [outline(shape.position[:2] + np.array(corners), rim)]
    points, radius = _outer_points(shape)
    places = (points @ shape.rotation.T + shape.position)[:, :2]
    if isinstance(shape, PointCloud):
        return [outline(place[None], radius + rim) for place in places]
    return [outline(places, radius + rim)]


def outline(points: Float, radius: Any) -> Float:
    """Return the outline of the convex hull of discs around points, shape (K, 2), [m].

    Args:
        points: Centres of the discs, shape (n, 2), [m].
        radius: Radius of all discs, or of each, shape (n,), [m].
    """
    circle = np.stack((np.cos(CIRCLE), np.sin(CIRCLE)), axis=-1)
    discs = points[:, None] + np.reshape(radius, (-1, 1, 1)) * circle
    around = discs.reshape(-1, 2)
    return np.asarray(around[ConvexHull(around).vertices])


def _outer_points(shape: Shape) -> tuple[Float, float]:
    """Return points in the frame of a shape, (n, 3), and the radius of balls of which it is the hull, [m]."""
    if isinstance(shape, Box):
        return np.array(list(itertools.product(*((-half, half) for half in shape.size)))), 0.0
    if isinstance(shape, ConvexMesh):
        return np.asarray(shape.vertices), 0.0
    if isinstance(shape, PointCloud):
        return np.asarray(shape.points), shape.radius
    if isinstance(shape, Cylinder):
        rim = [shape.radius * np.cos(CIRCLE), shape.radius * np.sin(CIRCLE)]
        ends = [np.stack((*rim, np.full(len(CIRCLE), way * shape.half_length)), axis=-1) for way in (-1, 1)]
        return np.concatenate(ends), 0.0
    radius, half, _ = shape.packed_size
    return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(radius)
