"""The nearest approach of links to obstacles over a movement, without looking at every link, obstacle and time.

A movement is cut into short stretches. In each, a link stays inside the ball around it in the middle of the stretch,
widened by how far its ends go from there; where even that ball is not the nearest of all, nothing is looked at. So the
result is exact, over every time that is given.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Int, Single
from viapoint.envs.geometry.broad_phase import ball_bounds, lift_quadratic
from viapoint.envs.geometry.distance import MAX_CLEARANCE, segment_distance_squared

STRETCH = 8
"""Times of a stretch."""
SWEEP_ROUNDING = 1e-5
"""More than what rounding adds to a distance, [m]."""


class LinkPositions(NamedTuple):
    """Places on arms at T times of N movements."""

    places: Float
    """Shape (N, T, P, 3), [m]."""
    hand: int
    """Int of the hand's."""
    links: Int
    """Indices of both ends of each link's axis, shape (L, 2)."""


def ends_of(links: Float) -> LinkPositions:
    """Links alone, shape (N, T, L, 2, 3), [m], the last of which ends in the hand."""
    number = links.shape[2]
    places = links.reshape(*links.shape[:2], 2 * number, 3)
    return LinkPositions(places, 2 * number - 1, np.arange(2 * number).reshape(number, 2))


def nearest_approach(
    traced: LinkPositions,
    radii: tuple[float, ...],
    obstacles: Float,
    present: NDArray[np.bool_],
    last: Int | None = None,
) -> Float:
    """Least clearance of links over a movement and all obstacles, shape (N,), [m]; at most MAX_CLEARANCE.

    Args:
        traced: Where the links are.
        radii: Of the L links, [m].
        obstacles: Shape (N, n, 7), [m].
        present: Whether a row is an obstacle, shape (N, n), bool.
        last: Int of each movement's last time, shape (N,); all by default.
    """
    least = np.full(len(obstacles), MAX_CLEARANCE)
    if not present.any():
        return least
    places, links = traced.places, traced.links
    last = np.full(len(least), places.shape[1] - 1) if last is None else last
    starts = np.arange(0, places.shape[1], STRETCH)
    looks = np.minimum(np.minimum(starts + STRETCH // 2, places.shape[1] - 1), last[:, None])
    about = places.astype(np.float32, order="C")
    seen = about[np.arange(len(least))[:, None], looks]
    strayed = _strayed(about, seen)[:, :, links].max(axis=-1) + np.float32(SWEEP_ROUNDING)
    first, second = seen[:, :, links[:, 0]], seen[:, :, links[:, 1]]
    around = np.float32(0.5) * _norm(second - first) + strayed + np.array(radii, np.float32)
    centres = np.moveaxis(np.float32(0.5) * (first + second), -1, 1).reshape(len(least), 3, -1)
    shown = np.where(present[..., None], obstacles, 0.0)
    bounds = ball_bounds(lift_quadratic(centres), around.reshape(len(least), -1), shown)
    size = np.array(radii)

    def clearance(each: Int, row: Int, link: Int, times: Int) -> Float:
        """Of links from obstacles, shape (M, .), one after the other, at times of that shape."""
        first, second = (_picked(places, each[:, None], times, links[link, end, None]) for end in (0, 1))
        squared = segment_distance_squared(first, second, obstacles[each, row][:, None])[:, 0]
        return np.asarray(np.sqrt(squared) - (obstacles[each, row, -1] + size[link])[:, None])

    flat, each = bounds.reshape(len(least), -1), np.arange(len(least))
    row, ball = np.divmod(flat.argmin(axis=-1), bounds.shape[-1])
    stretch, link = np.divmod(ball, len(size))
    nearest = clearance(each, row, link, looks[each, stretch, None])[:, 0]
    np.minimum(least, np.where(present[each, row], nearest, MAX_CLEARANCE), out=least)
    each, row, ball = np.nonzero(bounds < least[:, None, None])
    stretch, link = np.divmod(ball, len(size))
    nearest = clearance(each, row, link, looks[each, stretch, None])[:, 0]
    np.minimum.at(least, each, nearest)
    nearer = nearest - strayed[each, stretch, link] < least[each]
    each, row, stretch, link = each[nearer], row[nearer], stretch[nearer], link[nearer]
    times = np.minimum(starts[stretch, None] + np.arange(STRETCH), last[each, None])
    np.minimum.at(least, each, clearance(each, row, link, times).min(axis=-1))
    return least


def _picked(places: Float, each: Int, times: Int, place: Int) -> Float:
    """The same as `places[each, times, place]`, several times as fast where these are one after the other in memory."""
    if not places.flags.c_contiguous:
        return np.asarray(places[each, times, place])
    rows = (each * places.shape[1] + times) * places.shape[2] + place
    return np.asarray(places.reshape(-1, 3).take(rows, axis=0))


def _strayed(places: Single, seen: Single) -> Single:
    """How far each place goes at most, in each stretch, from where it is seen, shape (N, K, P), [m]."""
    most, least = places[:, ::STRETCH].copy(), places[:, ::STRETCH].copy()
    for later in range(1, min(STRETCH, places.shape[1])):
        here = places[:, later::STRETCH]
        some = slice(0, here.shape[1])
        np.maximum(most[:, some], here, out=most[:, some])
        np.minimum(least[:, some], here, out=least[:, some])
    return _norm(np.maximum(most - seen, seen - least))


def _norm(vectors: Single) -> Single:
    x, y, z = (vectors[..., i] for i in range(3))
    return np.asarray(np.sqrt(x * x + y * y + z * z))
