"""Sampling of starts, goals and feasible paths, in the plane and in space.

An attempt at a scene is a function of one row of uniform numbers: it takes a start, a goal and a path of the hand
between them that stays within reach. Obstacles are placed clear of this path, so every scene has a solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.scenes.draws import FeasiblePath, between, directions

BASE_SIDE_SHARE = 0.85
"""Share of whole-arm paths that pass between base and obstacles: few others leave room for the links."""
Ends = tuple[Float, Float] | None
"""Given starts and goals, shape (N, D) each, [m], NaN where they are sampled; None to sample all."""


class DrawOrder(NamedTuple):
    """Amounts and order of the random numbers of an attempt; frozen scenes depend on all of them."""

    n_ends: int
    """Candidate pairs of start and goal."""
    n_paths: int
    """Candidate paths."""
    n_first: int
    """Candidate paths that are computed before the others: often one of them is feasible."""
    n_times: int
    """Times at which a path is computed."""
    by_column: bool
    """Storage of the candidates' numbers, see :meth:`Uniforms.take_table`."""
    via_points: Callable[[Float, Float, Float, Bool], Float]
    """Actions of candidate paths, shape (N, n_paths, m), of uniform numbers, start, goal and :meth:`steered`."""
    groups: tuple[int, ...]
    """Attempts that are drawn one after the other at a scene."""
    ahead: int
    """Attempts at all scenes up to which several groups are computed at once."""


def sample_ends(
    u: Float, arm: Arm, distance: tuple[float, float], steepness: float, reach_margin: float, ends: Ends
) -> tuple[Float, Float, Bool]:
    """Sample starts and goals in the workspace such that the straight line between them is within reach.

    Args:
        u: Uniform numbers of E candidates, shape (N, E, 2 D).
        arm: Arm whose hand moves.
        distance: Least and greatest distance, [m].
        steepness: Greatest height gained from start to goal, relative to the distance; 0 in the plane.
        reach_margin: Least distance of the line from the border of the reach, [m].
        ends: Given starts and goals.

    Returns:
        Starts and goals, shape (N, D) each, and which scenes have a good candidate, shape (N,).
    """
    low, high = (np.array(corner) for corner in arm.workspace)
    start = low + (high - low) * u[..., : arm.dimension]
    rise = steepness * (2.0 * u[..., arm.dimension] - 1.0)
    step = between(distance, u[..., -1:]) * directions(2.0 * np.pi * u[..., -2], rise, arm.dimension)
    if ends is not None:
        start = np.where(np.isnan(ends[0])[:, None], start, ends[0][:, None])
    goal = start + step
    good: Any = ((goal >= low) & (goal <= high)).all(axis=-1)
    if ends is not None:
        goal = np.where(np.isnan(ends[1])[:, None], goal, ends[1][:, None])
        good |= np.isfinite(ends[1][:, :1])
    first, last = start[good], goal[good]
    line = first[:, None] + (last - first)[:, None] * np.linspace(0.0, 1.0, 5)[:, None]
    good[good] = arm.reach_margin(line).min(axis=-1) > reach_margin
    each, chosen = np.arange(len(u)), good.argmax(axis=-1)
    return start[each, chosen], goal[each, chosen], good.any(axis=-1)


def sample_paths(
    u: Float, arm: Arm, start: Float, goal: Float, reach_margin: float, steered: Bool
) -> tuple[FeasiblePath, Bool]:
    """Return the first candidate path through one via-point that is within reach.

    Args:
        u: Uniform numbers, shape (N, n_paths, .).
        arm: Arm whose hand moves.
        start: Shape (N, D), [m].
        goal: Shape (N, D), [m].
        reach_margin: Least distance of the hand from the border of the reach, [m].
        steered: Which paths leave room on one side, shape (N,), see :class:`ObstacleSampler`.

    Returns:
        Paths, and which scenes have a feasible one, shape (N,).
    """
    first = DRAW_ORDER[arm.dimension].n_first
    path, good = _first_feasible(u[:, :first], arm, start, goal, reach_margin, steered)
    rest = np.flatnonzero(~good)
    if len(rest) and first < u.shape[1]:
        path[rest], good[rest] = _first_feasible(
            u[rest, first:], arm, start[rest], goal[rest], reach_margin, steered[rest]
        )
    return FeasiblePath(start, goal, path), good


def _first_feasible(
    u: Float, arm: Arm, start: Float, goal: Float, reach_margin: float, steered: Bool
) -> tuple[Float, Bool]:
    """Return paths, shape (N, T, D), [m], and which are feasible, shape (N,); for the arguments see above."""
    order = DRAW_ORDER[arm.dimension]
    action = order.via_points(u, start, goal, steered)
    first, last = (np.broadcast_to(end[:, None], (*u.shape[:2], arm.dimension)) for end in (start, goal))
    plan = ActionLayout(dimension=arm.dimension).decode(action, first, last)
    times = plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, order.n_times)
    paths = plan.trajectory()(times)
    good = (arm.reach_margin(paths) > reach_margin).all(axis=-1)
    chosen = good.argmax(axis=-1)
    return paths[np.arange(len(chosen)), chosen], good.any(axis=-1)


def _planar_via_points(u: Float, start: Float, goal: Float, steered: Bool) -> Float:
    """Return actions with a via-point on either side of the line; where steered, mostly on the base's side."""
    along, side = 1.6 * u[..., 0] - 0.8, 2.0 * u[..., 1] - 1.0
    across = np.copysign(0.15 + 0.8 * np.abs(side), side)
    if steered.any():
        line, middle = goal - start, 0.5 * (start + goal)
        base_is_left = line[:, :1] * middle[:, 1:] < line[:, 1:] * middle[:, :1]
        inward = np.where(base_is_left, np.abs(across), -np.abs(across))
        across = np.where(steered[:, None] & (u[..., 2] < BASE_SIDE_SHARE), inward, across)
    return np.stack((along, across, np.zeros_like(along)), axis=-1)


def _spatial_via_points(u: Float, start: Float, goal: Float, steered: Bool) -> Float:
    """Return actions with a via-point beside or above the line; where steered, above it."""
    angle = np.pi * np.where(steered[:, None], 0.25 + 0.5 * u[..., 0], 1.3 * u[..., 0] - 0.15)
    size, along = 0.45 + 0.5 * u[..., 1], u[..., 2] - 0.5
    return np.stack((along, size * np.cos(angle), size * np.sin(angle), np.zeros_like(along)), axis=-1)


DRAW_ORDER = {
    2: DrawOrder(
        n_ends=16, n_paths=6, n_first=6, n_times=40, by_column=True, via_points=_planar_via_points,
        groups=(1,) * 200, ahead=0,
    ),
    # A scene of clutter needs two attempts in the mean, one with a table 26.
    3: DrawOrder(
        n_ends=12, n_paths=8, n_first=2, n_times=16, by_column=False, via_points=_spatial_via_points,
        groups=(1, 2, 4, *[8] * 400), ahead=320,
    ),
}  # fmt: skip
"""Order of draws by the dimension of the arm's workspace."""
