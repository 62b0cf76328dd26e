"""Broad phase: fast lower bounds of clearance, so that few exact distances need to be computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Single

CACHED = 48_000
"""Bounds per block, which fit into the cache."""
BOUND_ROUNDING = np.float32(4e-6)
"""Upper bound of the rounding error of squared distances within NEAR of the origin, [m^2]."""
NEAR = np.float32(2.0)
"""Distance from the origin up to which BOUND_ROUNDING holds, [m]; beyond, rounding grows with its square."""


def lift_quadratic(places: Single) -> Single:
    """Return points p as (p, |p|^2, 1), of which squared distances are linear functions: (N, 5, P) from (N, 3, P)."""
    points = np.empty((len(places), 5, *places.shape[2:]), np.float32)
    points[:, :3], points[:, 4] = places, 1.0
    np.add.reduce(places * places, axis=1, out=points[:, 3])
    return points


def ball_bounds(points: Single, radii: Single, obstacles: NDArray[np.floating]) -> Single:
    """Return lower bounds of the clearance of balls from obstacles, shape (N, n, P), [m]; infinity without an obstacle.

    The squared distance of p from the segment c + t a, -1 <= t <= 1, is |p - c|^2 - t (2 s - t) |a|^2 with
    s = (p - c) . a / |a|^2 and t = s, clamped to [-1, 1]. Both |p - c|^2 and s are linear in (p, |p|^2, 1), so one
    matrix product for each scene gives them in single precision: a fraction of the time of exact distances.

    Args:
        points: Centres of P balls in each of N scenes by :func:`lift_quadratic`, shape (N, 5, P).
        radii: Radii of the balls, shape (P,) or (N, P), [m].
        obstacles: Rows as in :mod:`~viapoint.envs.geometry.distance`, shape (N, n, 7), [m]; a radius of 0 means absent.
    """
    (number, rows), places = obstacles.shape[:2], points.shape[2]
    farthest = max(float(np.sqrt(points[:, 3].max(initial=0.0))), np.abs(obstacles[..., :6]).max(initial=0.0))
    rounding = BOUND_ROUNDING * max(np.float32(1.0), np.square(np.float32(farthest) / NEAR))
    parts = np.moveaxis(obstacles, -1, 0).astype(np.float32, order="C")
    centre, axis = parts[:3], parts[3:6]
    square = np.add.reduce(axis * axis)
    share = axis / np.maximum(square, np.float32(1e-12))
    one, zero = np.ones_like(square), np.zeros_like(square)
    apart = np.stack((*(-2.0 * centre), one, np.add.reduce(centre * centre) - rounding), axis=-1)
    along = np.stack((*share, zero, -np.add.reduce(centre * share)), axis=-1)
    around = np.broadcast_to(radii, (number, places))[:, None]
    square, least = square[..., None], np.where(parts[-1] > 0.0, parts[-1], np.float32(-np.inf))[..., None]
    bounds = np.empty((number, rows, places), np.float32)
    several = max(CACHED // max(rows * places, 1), 1)
    for some in (slice(first, first + several) for first in range(0, number, several)):
        squared = np.matmul(apart[some], points[some], out=bounds[some])
        where = np.matmul(along[some], points[some])  # s
        inside = np.clip(where, np.float32(-1.0), np.float32(1.0))  # t
        where += where
        where -= inside
        where *= inside
        where *= square[some]
        squared -= where  # t (2 s - t) |a|^2
        np.clip(squared, np.float32(0.0), np.float32(np.inf), out=squared)
        np.sqrt(squared, out=squared)
        squared -= around[some]
        squared -= least[some]
    return bounds
