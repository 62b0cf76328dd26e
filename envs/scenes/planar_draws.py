"""What every scene is drawn from: uniform numbers, two ends, and a movement between them that is kept clear."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import Arm, CollisionModel
from viapoint.envs.common.types import Float

ENDS, WITNESSES, PHASES = 16, 6, 40
"""How many pairs of ends and witnesses are drawn at once, and at how many times a movement is looked at."""
INWARD = 0.85
"""Share of witnesses that pass between base and obstacles, where links count: few others leave room for them."""


class Uniforms:
    """Rows of uniform numbers, taken in order."""

    def __init__(self, values: Float) -> None:
        self._values = values
        self._next = 0

    def take(self, count: int) -> Float:
        """The next `count` numbers of each row, shape (N, count)."""
        self._next += count
        return self._values[:, self._next - count : self._next]


class FeasiblePath(NamedTuple):
    """Movements that solve N scenes: obstacles are placed clear of them."""

    start: Float
    """Shape (N, D), [m]."""
    goal: Float
    """Shape (N, D), [m]."""
    path: Float
    """Positions of the hand, shape (N, PHASES, D), [m]."""


def draw_ends(
    uniforms: Uniforms,
    arm: Arm,
    distance: tuple[float, float],
    reach_margin: float,
    ends: tuple[Float, Float] | None,
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Starts and goals inside the workspace with the straight line between them inside the reach, and which are good.

    Args:
        uniforms: 4 ENDS numbers are taken.
        arm: Whose hand moves.
        distance: Least and greatest, [m].
        reach_margin: How far inside the reach the line stays, [m].
        ends: Given ones, NaN where they are to be drawn.
    """
    low, high = (np.array(corner) for corner in arm.workspace)
    inside: Any
    start = low + (high - low) * np.stack([uniforms.take(ENDS), uniforms.take(ENDS)], axis=-1)
    angle = 2.0 * np.pi * uniforms.take(ENDS)
    length = between(distance, uniforms.take(ENDS))
    step = length[..., None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    if ends is not None:
        start = np.where(np.isnan(ends[0])[:, None], start, ends[0][:, None])
    goal = start + step
    if ends is not None:
        goal = np.where(np.isnan(ends[1])[:, None], goal, ends[1][:, None])
    line = start[..., None, :] + (goal - start)[..., None, :] * np.linspace(0.0, 1.0, 5)[:, None]
    margin = arm.reach_margin(line).min(axis=-1)
    inside = ((goal >= low) & (goal <= high)).all(axis=-1)
    if ends is not None:
        inside |= np.isfinite(ends[1][:, :1])
    good: Any = inside & (margin > reach_margin)
    first = good.argmax(axis=-1)
    rows = np.arange(len(first))
    return start[rows, first], goal[rows, first], good.any(axis=-1)


def draw_witness(
    uniforms: Uniforms, collision_model: CollisionModel, ends: tuple[Float, Float], reach_margin: float
) -> tuple[FeasiblePath, NDArray[np.bool_]]:
    """Movements through one via-point inside the reach, and which of them are.

    Args:
        uniforms: 2 WITNESSES numbers are taken, 3 where links count.
        collision_model: Arm that moves.
        ends: Starts and goals, shape (N, D) each, [m].
        reach_margin: How far inside the reach the hand stays, [m].
    """
    (start, goal), arm = ends, collision_model.arm
    layout = ActionLayout(dimension=arm.dimension)
    along = 1.6 * uniforms.take(WITNESSES) - 0.8
    side = 2.0 * uniforms.take(WITNESSES) - 1.0
    across = np.copysign(0.15 + 0.8 * np.abs(side), side)
    if collision_model.whole_arm:
        across = np.where(
            uniforms.take(WITNESSES) < INWARD, np.abs(across) * _side_of_base(start, goal), across
        )
    action = np.stack((along, across, np.zeros_like(along)), axis=-1)
    every = np.broadcast_to(start[:, None], (*action.shape[:2], start.shape[-1]))
    plan = layout.decode(action, every, np.broadcast_to(goal[:, None], every.shape))
    times = plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, PHASES)
    paths = plan.trajectory()(times)
    good = (arm.reach_margin(paths) > reach_margin).all(axis=-1)
    first = good.argmax(axis=-1)
    return FeasiblePath(start, goal, paths[np.arange(len(first)), first]), good.any(axis=-1)


def _side_of_base(start: Float, goal: Float) -> Float:
    """1 where the arm's base lies to the left of the straight line, -1 where to its right, shape (N, 1)."""
    line, middle = goal - start, 0.5 * (start + goal)
    return np.where(line[:, :1] * middle[:, 1:2] < line[:, 1:2] * middle[:, :1], 1.0, -1.0)


def unit(vectors: Float) -> Float:
    """Vectors of length one, or 0."""
    return np.asarray(vectors / np.maximum(np.sqrt((vectors**2).sum(axis=-1, keepdims=True)), 1e-9))


def left(vectors: Float) -> Float:
    """Vectors of the plane turned by a quarter to the left."""
    return np.stack((-vectors[..., 1], vectors[..., 0]), axis=-1)


def turned(vectors: Float, angle: Float) -> Float:
    """Vectors of the plane turned to the left by angles, [rad]."""
    return np.asarray(np.cos(angle)[..., None] * vectors + np.sin(angle)[..., None] * left(vectors))


def between(bounds: tuple[float, float], u: Any) -> Any:
    """Uniform numbers between bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * u
