"""Shapes of random size and pose."""

import numpy as np

from viapoint.envs.geometry.shapes import (
    Box,
    Capsule,
    ConvexMesh,
    Cylinder,
    HalfSpace,
    PointCloud,
    Sphere,
)


def random_shape(kind, rng, *, moving=False):
    """Return a shape of a kind near the origin."""
    quaternion = rng.normal(size=4)
    others = {
        "position": rng.uniform(-0.2, 0.2, 3),
        "quaternion": quaternion / np.linalg.norm(quaternion),
        "velocity": rng.uniform(-0.5, 0.5, 3) * moving,
    }
    a, b, c = rng.uniform(0.02, 0.2, 3)
    match kind:
        case "sphere":
            return Sphere(a, **others)
        case "capsule":
            return Capsule(a, b, **others)
        case "cylinder":
            return Cylinder(a, b, **others)
        case "box":
            return Box((a, b, c), **others)
        case "half_space":
            return HalfSpace(**others)
        case "convex_mesh":
            return ConvexMesh.hull(0.1 * rng.normal(size=(rng.integers(4, 30), 3)), **others)
        case "point_cloud":
            return PointCloud(0.1 * rng.normal(size=(rng.integers(1, 60), 3)), 0.3 * a, **others)
    raise ValueError(kind)
