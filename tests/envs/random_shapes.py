"""Shapes of random size and pose."""

import numpy as np

from viapoint.envs.geometry.shapes import ConvexMesh, as_obstacle


def random_shape(kind, rng, *, moving=False):
    """Return a shape of a kind near the origin."""
    quaternion = rng.normal(size=4)
    a, b, c = rng.uniform(0.02, 0.2, 3)
    some, many = (0.1 * rng.normal(size=(number, 3)) for number in rng.integers((4, 1), (30, 60)))
    sizes = {
        "sphere": {"radius": a},
        "capsule": {"radius": a, "half_length": b},
        "cylinder": {"radius": a, "half_length": b},
        "box": {"size": (a, b, c)},
        "half_space": {},
        "convex_mesh": {"vertices": ConvexMesh.hull(some).vertices},
        "point_cloud": {"points": many, "radius": 0.3 * a},
    }
    return as_obstacle(
        {
            "shape": kind,
            "position": rng.uniform(-0.2, 0.2, 3),
            "quaternion": quaternion / np.linalg.norm(quaternion),
            "velocity": rng.uniform(-0.5, 0.5, 3) * moving,
            **sizes[kind],
        }
    )
