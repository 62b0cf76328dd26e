"""Narrow phase: the exact least clearance of links from obstacles over a movement, without computing every distance.

A movement is cut into short stretches. In each, a link stays inside a ball: the one around it in the middle of the
stretch, enlarged by the excursions of its ends. Distances are computed only for balls that could contain the nearest
point of all, so the result is exact over all given times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Index, Int, Single
from viapoint.envs.geometry.broad_phase import HalfLinks, ball_bounds, lift_quadratic
from viapoint.envs.geometry.distance import MAX_CLEARANCE, pair_clearance

STRETCH = 8
"""Times per stretch."""
SWEEP_ROUNDING = 1e-5
"""Upper bound of the rounding error of a distance in single precision, [m]."""


class LinkPositions(NamedTuple):
    """Positions of points on an arm at T times of N movements."""

    places: Float
    """Positions, shape (N, T, P, 3), [m]."""
    hand: int
    """Index of the hand among the points."""
    links: Int
    """Indices of both ends of each link's axis among the points, shape (L, 2)."""


def ends_of(links: Float) -> LinkPositions:
    """Return positions from link segments, shape (N, T, L, 2, 3), [m]; the last link ends in the hand."""
    number = links.shape[2]
    places = links.reshape(*links.shape[:2], 2 * number, 3)
    return LinkPositions(places, 2 * number - 1, np.arange(2 * number).reshape(number, 2))


def nearest_approach(
    traced: LinkPositions,
    radii: tuple[float, ...],
    obstacles: Float,
    present: Bool,
    last: Int | None = None,
    floor: float = -np.inf,
) -> Float:
    """Return the least clearance of links over a movement and all obstacles, shape (N,), [m]; at most MAX_CLEARANCE.

    Args:
        traced: Positions of the links.
        radii: Radii of the L links, [m].
        obstacles: Rows of obstacles of either kind, shape (N, n, .), [m].
        present: True for rows that are obstacles, shape (N, n).
        last: Index of each movement's last time, shape (N,); by default all times count.
        floor: Value below which the result need not be exact, [m].
    """
    least = np.full(len(obstacles), MAX_CLEARANCE)
    if not present.any():
        return least
    places, links = traced.places, traced.links
    last = np.full(len(least), places.shape[1] - 1) if last is None else last
    starts = np.arange(0, places.shape[1], STRETCH)
    middles = np.minimum(np.minimum(starts + STRETCH // 2, places.shape[1] - 1), last[:, None])
    about = places.astype(np.float32, order="C")
    seen = about[np.arange(len(least))[:, None], middles]
    excursion = _excursions(about, seen)[:, :, links].max(axis=-1) + np.float32(SWEEP_ROUNDING)
    first, second = seen[:, :, links[:, 0]], seen[:, :, links[:, 1]]
    thick, half = excursion + np.array(radii, np.float32), np.float32(0.5) * (second - first)
    centres, axes = (np.moveaxis(each, -1, 1).reshape(len(least), 3, -1) for each in (first + half, half))
    shown = np.where(present[..., None], obstacles, 0.0)
    around, thick = (each.reshape(len(least), -1) for each in (norm(half) + thick, thick))
    bounds = ball_bounds(lift_quadratic(centres), around, shown, HalfLinks(axes, thick))
    size = np.array(radii)

    def clearance(each: Index, row: Index, link: Index, times: Index) -> Float:
        """Return the clearance of M links, each from one obstacle at some times, shape (M, .), [m]."""
        first, second = (_take(places, each[:, None], times, links[link, end, None]) for end in (0, 1))
        return pair_clearance(first, second, obstacles[each, row], size[link])

    def at_middle(each: Index, ball: Index) -> Float:
        """Return the clearance of balls from obstacles in the middle of their stretches, shape (M,), [m]."""
        row, ball = np.divmod(ball, bounds.shape[-1])
        stretch, link = np.divmod(ball, len(size))
        return clearance(each, row, link, middles[each, stretch, None])[:, 0]

    # All times of the stretches that are still near enough after their middles.
    each, ball, nearest = branch_and_bound(bounds.reshape(len(least), -1), least, at_middle, floor)
    row, ball = np.divmod(ball, bounds.shape[-1])
    stretch, link = np.divmod(ball, len(size))
    nearer = (nearest - excursion[each, stretch, link] < least[each]) & (least[each] >= floor)
    each, row, stretch, link = each[nearer], row[nearer], stretch[nearer], link[nearer]
    times = np.minimum(starts[stretch, None] + np.arange(STRETCH), last[each, None])
    np.minimum.at(least, each, clearance(each, row, link, times).min(axis=-1))
    return least


def branch_and_bound(
    bounds: Single, least: Float, exact: Callable[[Index, Index], Float], floor: float = -np.inf
) -> tuple[Index, Index, Float]:
    """Lower the least values of M groups, in place, to those of the candidates whose bounds are below them.

    The candidate with the least bound of each group comes first; its value excludes most of the others.

    Args:
        bounds: Lower bounds of the values of K candidates in each group, shape (M, K).
        least: Values above which candidates do not matter, shape (M,).
        exact: Function that returns the values of candidates from the indices of groups and candidates.
        floor: Value below which the result need not be exact.

    Returns:
        Groups, candidates and values that were computed, shape (L,) each.
    """
    nearest = bounds.argmin(axis=-1)
    some = np.flatnonzero(bounds[np.arange(len(least)), nearest] < least)
    first = some, nearest[some], exact(some, nearest[some])
    np.minimum.at(least, some, first[2])
    some = some[least[some] >= floor]
    below = bounds.take(some, axis=0) < least[some, None].astype(np.float32)
    below[np.arange(len(some)), nearest[some]] = False
    which, candidate = np.nonzero(below)
    if not len(which):
        return first
    values = exact(some[which], candidate)
    np.minimum.at(least, some[which], values)
    group, which, found = (
        np.concatenate(each) for each in zip(first, (some[which], candidate, values), strict=True)
    )
    return group, which, found


def _take(positions: Float, each: Int, times: Int, point: Int) -> Float:
    """Return `positions[each, times, point]`; `take` on contiguous arrays is several times as fast as this."""
    if not positions.flags.c_contiguous:
        return np.asarray(positions[each, times, point])
    rows = (each * positions.shape[1] + times) * positions.shape[2] + point
    return np.asarray(positions.reshape(-1, 3).take(rows, axis=0))


def _excursions(positions: Single, seen: Single) -> Single:
    """Return how far each point moves at most in each stretch from where it is seen, shape (N, K, P), [m]."""
    most, least = positions[:, ::STRETCH].copy(), positions[:, ::STRETCH].copy()
    for later in range(1, min(STRETCH, positions.shape[1])):
        here = positions[:, later::STRETCH]
        some = slice(0, here.shape[1])
        np.maximum(most[:, some], here, out=most[:, some])
        np.minimum(least[:, some], here, out=least[:, some])
    return norm(np.maximum(most - seen, seen - least))
