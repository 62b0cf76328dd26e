"""Movements of the paper between its targets, straight or through a via-point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.scene import TARGETS
from viapoint.primitives import Trajectory, passage_durations, point_to_point, through


def target(name: str) -> Float:
    """Return the position of one of the paper's targets T1 to T6, shape (2,), [m]."""
    return np.asarray(TARGETS[name], dtype=np.float64)


def straight(first: str, last: str, duration: float = 0.8, *, order: int = 3) -> Trajectory:
    """Return the straight movement between two targets (Eq. 2); order 2, 3, 4 minimises acceleration, jerk, snap."""
    return point_to_point(target(first), target(last), duration, order=order)


def via_waypoints(start: ArrayLike, goal: ArrayLike, along: ArrayLike, height: ArrayLike) -> Float:
    """Return start, via-point and goal by the construction of Fig. 1B.

    Args:
        start: Shape (2,), [m].
        goal: Shape (2,), [m].
        along: d1 / (d1 + d2), shape (...,): where the perpendicular through the via-point meets the line.
        height: d3 / (d1 + d2), shape (...,); positive is to the left of the movement.

    Returns:
        Shape (..., 3, 2), [m].
    """
    x0, xf = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
    along, height = np.broadcast_arrays(np.asarray(along, dtype=np.float64), height)
    line = xf - x0
    left = np.array([-line[1], line[0]])
    via = x0 + along[..., None] * line + height[..., None] * left
    ends = np.broadcast_to(x0, via.shape), np.broadcast_to(xf, via.shape)
    return np.stack((ends[0], via, ends[1]), axis=-2)


def construction(waypoints: Float) -> tuple[Float, Float]:
    """Return d1 / (d1 + d2) and unsigned d3 / (d1 + d2) of waypoints (..., 3, 2), the inverse of `via_waypoints`."""
    line = waypoints[..., 2, :] - waypoints[..., 0, :]
    offset = waypoints[..., 1, :] - waypoints[..., 0, :]
    square = (line * line).sum(axis=-1)
    turn = line[..., 0] * offset[..., 1] - line[..., 1] * offset[..., 0]
    return (line * offset).sum(axis=-1) / square, np.abs(turn) / square


def minimum_jerk_through(waypoints: ArrayLike, duration: Any = 1.0) -> Trajectory:
    """Return the movement through (..., K + 2, 2) waypoints [m] with free passage times (Eqs. 4, 5 and C16)."""
    return through(waypoints, passage_durations(waypoints, duration))


def curved(first: str, last: str, along: ArrayLike, height: ArrayLike, duration: Any = 1.0) -> Trajectory:
    """Return the movement between two targets through a via-point, see :func:`via_waypoints`."""
    return minimum_jerk_through(via_waypoints(target(first), target(last), along, height), duration)


def passage_share(movement: Trajectory) -> Float:
    """Return t1 / (t1 + t2) of movements through one via-point, shape (...,)."""
    return np.asarray(movement.knots[..., 1] / movement.knots[..., 2])
