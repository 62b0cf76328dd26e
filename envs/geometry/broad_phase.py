"""Broad phase: fast lower bounds of clearance, so that few exact distances need to be computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Single
from viapoint.envs.geometry.rows import has_shapes, rotation_axes, shape_columns
from viapoint.envs.geometry.shapes import SHAPES

CACHED = 48_000
"""Bounds per block, which fit into the cache."""
BOUND_ROUNDING = np.float32(4e-6)
"""Upper bound of the rounding error of squared distances within NEAR of the origin, [m^2]."""
NEAR = np.float32(2.0)
"""Distance from the origin up to which BOUND_ROUNDING holds, [m]; beyond, rounding grows with its square."""
PLACE_ROUNDING = np.float32(4e-6)
"""Upper bound of the rounding error of coordinates within NEAR of the origin, [m]."""


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
    matrix product for each scene gives them in single precision: a fraction of the time of exact distances. For shapes
    in a capsule that they do not fill, the distance from their bounding box counts if it is greater.

    Args:
        points: Centres of P balls in each of N scenes by :func:`lift_quadratic`, shape (N, 5, P).
        radii: Radii of the balls, shape (P,) or (N, P), [m].
        obstacles: Rows of either kind, shape (N, n, .), [m]; a radius of 0 means absent.
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
    if has_shapes(obstacles):
        _raise_to_boxes(
            bounds, points, around, obstacles, PLACE_ROUNDING * max(np.float32(1.0), farthest / NEAR)
        )
    return bounds


def _raise_to_boxes(
    bounds: Single, points: Single, around: Single, obstacles: NDArray[np.floating], rounding: np.float32
) -> None:
    """Raise bounds, in place, to the clearance of balls from the bounding boxes of shapes."""
    kind, centre, quaternion, half = shape_columns(np.asarray(obstacles, np.float64))
    ends = np.array([bool(shape.sizes) for shape in SHAPES.values()])  # a half-space has no bounding box
    scene, row = np.nonzero((obstacles[..., -1] > half.min(axis=-1)) & ends[kind])
    axes = np.stack(rotation_axes(quaternion[scene, row]), axis=1)  # shape (boxes, axes, 3)
    offset = -np.einsum("bij,bj->bi", axes, centre[scene, row])
    lifted = np.stack((*np.moveaxis(axes, 2, 0), np.zeros_like(offset), offset), axis=-1).astype(np.float32)
    size = (half[scene, row, :, None] + rounding).astype(np.float32)
    several = max(CACHED // (3 * max(points.shape[2], 1)), 1)
    for some in (slice(first, first + several) for first in range(0, len(scene), several)):
        which = scene[some], row[some]
        excess = np.matmul(lifted[some], points[which[0]])
        np.abs(excess, out=excess)
        excess -= size[some]
        inside = np.maximum(np.maximum(excess[:, 0], excess[:, 1]), excess[:, 2]).clip(-np.inf, 0.0)
        np.clip(excess, 0.0, np.inf, out=excess)
        excess *= excess
        signed = excess[:, 0] + excess[:, 1]
        signed += excess[:, 2]
        np.sqrt(signed, out=signed)
        signed += inside
        signed -= around[which[0], 0]
        bounds[which] = np.maximum(bounds[which], signed)
