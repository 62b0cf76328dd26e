"""Broad phase: fast lower bounds of clearance, so that few exact distances need to be computed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Single
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


class HalfLinks(NamedTuple):
    """Links in balls, for bounds of their clearance from boxes."""

    axes: Single
    """Halves of the links' axes, shape (N, 3, P), [m]."""
    radii: Single
    """Radii of the links, shape (P,) or (N, P), [m]."""


def ball_bounds(
    points: Single, radii: Single, obstacles: NDArray[np.floating], links: HalfLinks | None = None
) -> Single:
    """Return lower bounds of the clearance of balls from obstacles, shape (N, n, P), [m]; infinity without an obstacle.

    For shapes in a capsule that they do not fill, it is the distance from their bounding box: that of the ball, or of
    the bounding box of the link in it, along the same axes.

    Args:
        points: Centres of P balls in each of N scenes by :func:`lift_quadratic`, shape (N, 5, P).
        radii: Radii of the balls, shape (P,) or (N, P), [m].
        obstacles: Rows of either kind, shape (N, n, .), [m]; a radius of 0 means absent.
        links: Links around the centres of the balls; the bounds are then those of their clearance.
    """
    (number, rows), places = obstacles.shape[:2], points.shape[2]
    farthest = max(float(np.sqrt(points[:, 3].max(initial=0.0))), np.abs(obstacles[..., :6]).max(initial=0.0))
    far = np.maximum(np.float32(1.0), np.float32(farthest) / NEAR)
    around = np.broadcast_to(radii, (number, places))
    if not has_shapes(obstacles):
        bounds = np.empty((number, rows, places), np.float32)
        for some in _blocks(number, rows * places):
            bounds[some] = _from_axes(points[some], around[some], obstacles[some], far)
        return bounds
    bounds = np.full((number, rows, places), np.inf, np.float32)
    kind, centre, quaternion, half = shape_columns(np.asarray(obstacles, np.float64))
    ends = np.array([bool(shape.sizes) for shape in SHAPES.values()])  # a half-space has no bounding box
    least = np.minimum(np.minimum(half[..., 0], half[..., 1]), half[..., 2])
    in_box = (obstacles[..., -1] > least) & ends[kind]
    scene, row = np.nonzero((obstacles[..., -1] > 0.0) & ~in_box)
    for some in _blocks(len(scene), places):
        which = scene[some], row[some]
        found = _from_axes(points[which[0]], around[which[0]], obstacles[which][:, None], far)
        bounds[which] = found[:, 0]
    scene, row = np.nonzero(in_box)
    if links is not None:
        around = np.broadcast_to(links.radii, (number, places))
    axes = np.stack(rotation_axes(quaternion[scene, row]), axis=1)  # shape (boxes, axes, 3)
    offset = -np.einsum("bij,bj->bi", axes, centre[scene, row])
    size = half[scene, row, :, None] + PLACE_ROUNDING * far
    for some in _blocks(len(scene), 3 * places):
        each = scene[some]
        along = None if links is None else links.axes[each]
        found = _from_boxes(points[each], along, axes[some], offset[some], size[some])
        found -= around[each]
        bounds[each, row[some]] = found
    return bounds


def _from_axes(points: Single, radii: Single, obstacles: NDArray[np.floating], far: np.floating) -> Single:
    """Return lower bounds of the clearance of balls from capsules, shape (N, n, P), [m].

    The squared distance of p from the segment c + t a, -1 <= t <= 1, is |p - c|^2 - t (2 s - t) |a|^2 with
    s = (p - c) . a / |a|^2 and t = s, clamped to [-1, 1]. Both |p - c|^2 and s are linear in (p, |p|^2, 1), so one
    matrix product for each scene gives them in single precision: a fraction of the time of exact distances.
    """
    parts = np.moveaxis(obstacles, -1, 0).astype(np.float32, order="C")
    centre, axis = parts[:3], parts[3:6]
    square = np.add.reduce(axis * axis)
    share = axis / np.maximum(square, np.float32(1e-12))
    one, zero = np.ones_like(square), np.zeros_like(square)
    nearest = np.add.reduce(centre * centre) - BOUND_ROUNDING * far * far
    squared = np.matmul(np.stack((*(-2.0 * centre), one, nearest), axis=-1), points)
    where = np.matmul(np.stack((*share, zero, -np.add.reduce(centre * share)), axis=-1), points)  # s
    inside = np.clip(where, np.float32(-1.0), np.float32(1.0))  # t
    where += where
    where -= inside
    where *= inside
    where *= square[..., None]
    squared -= where  # t (2 s - t) |a|^2
    np.clip(squared, np.float32(0.0), np.float32(np.inf), out=squared)
    bounds: Single = np.sqrt(squared, out=squared)
    bounds -= radii[:, None]
    bounds -= np.where(parts[-1] > 0.0, parts[-1], np.float32(-np.inf))[..., None]
    return bounds


def _from_boxes(points: Single, along: Single | None, axes: Float, offset: Float, size: Float) -> Single:
    """Return signed distances of points, or of segments around them, each from the box of one row, shape (M, P), [m].

    Args:
        points: Shape (M, 5, P), see :func:`lift_quadratic`.
        along: Half segments, shape (M, 3, P), [m]; the result is then a lower bound.
        axes: Axes of the boxes, shape (M, 3, 3).
        offset: Less the centres of the boxes along these axes, shape (M, 3), [m].
        size: Half lengths along them, shape (M, 3, 1), [m].
    """
    lifted = np.stack((*np.moveaxis(axes, 2, 0), np.zeros_like(offset), offset), axis=-1).astype(np.float32)
    excess = np.matmul(lifted, points)
    np.abs(excess, out=excess)
    excess -= size.astype(np.float32)
    if along is not None:
        extent = np.matmul(axes.astype(np.float32), along)
        excess -= np.abs(extent, out=extent)
    inside = np.maximum(np.maximum(excess[:, 0], excess[:, 1]), excess[:, 2]).clip(-np.inf, 0.0)
    np.clip(excess, 0.0, np.inf, out=excess)
    excess *= excess
    signed: Single = excess[:, 0] + excess[:, 1]
    signed += excess[:, 2]
    np.sqrt(signed, out=signed)
    signed += inside
    return signed


def _blocks(number: int, size: int) -> Iterator[slice]:
    """Yield slices of `number` tables of a size such that a slice fits into the cache."""
    several = max(CACHED // max(size, 1), 1)
    yield from (slice(first, first + several) for first in range(0, number, several))
