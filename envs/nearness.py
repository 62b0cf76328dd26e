"""How near balls may be to obstacles: bounds that are quick to compute, so that few distances need be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Single = NDArray[np.float32]

CACHED = 24_000
"""Bounds that are computed together: few enough for the cache."""
ROUNDING = np.float32(4e-6)
"""More than what rounding adds to a squared distance of places within NEAR of the origin, [m^2]."""
NEAR = np.float32(2.0)
"""Where places are expected; rounding grows with the square of their distance from the origin, [m]."""


def ball_bounds(centres: Single, radii: Single, obstacles: NDArray[np.floating]) -> Single:
    """No more than the distances of balls from the obstacles' axes, shape (N, n, P), [m].

    The squared distance of p from the segment c + s a, -1 <= s <= 1, is |p - c|^2 - s (2 q - s |a|^2) with
    q = (p - c) . a and s = q / |a|^2, no farther out than the ends. Both p - c and q are linear in (p, |p|^2, 1), so
    they come from one product of matrices for each scene.

    Args:
        centres: Of P balls in each of N scenes, shape (N, 3, P), [m].
        radii: Shape (P,) or (N, P), [m].
        obstacles: Shape (N, n, 7), [m]; their radii do not count.
    """
    number, rows, places = len(obstacles), obstacles.shape[1], centres.shape[2]
    square = (centres * centres).sum(axis=1, keepdims=True)
    points = np.concatenate((centres, square, np.ones_like(square)), axis=1)
    centre, axis = obstacles[..., :3].astype(np.float32), obstacles[..., 3:6].astype(np.float32)
    length = (axis * axis).sum(axis=-1, keepdims=True)
    farthest = max(float(np.sqrt(square.max(initial=0.0))), np.abs(obstacles[..., :6]).max(initial=0.0))
    rounding = ROUNDING * max(np.float32(1.0), np.square(np.float32(farthest) / NEAR))
    apart = np.concatenate(
        (-2.0 * centre, np.ones_like(length), (centre * centre).sum(axis=-1, keepdims=True) - rounding),
        axis=-1,
    )
    double = np.concatenate(
        (2.0 * axis, np.zeros_like(length), -2.0 * (centre * axis).sum(axis=-1, keepdims=True)), axis=-1
    )
    half_inverse = np.float32(0.5) / np.maximum(length, np.float32(1e-12))
    bounds = np.empty((number, rows, places), np.float32)
    around = np.broadcast_to(radii, (number, places))[:, None]
    several = max(CACHED // max(rows * places, 1), 1)
    for some in (slice(first, first + several) for first in range(0, number, several)):
        squared = np.matmul(apart[some], points[some], out=bounds[some])
        twice = np.matmul(double[some], points[some])
        share = twice * half_inverse[some]
        np.clip(share, np.float32(-1.0), np.float32(1.0), out=share)
        twice -= share * length[some]
        twice *= share
        squared -= twice
        np.maximum(squared, np.float32(0.0), out=squared)
        np.sqrt(squared, out=squared)
        squared -= around[some]
    return bounds
