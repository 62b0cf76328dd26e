"""The nearest approach of links to obstacles over a movement, without looking at every link, obstacle and time.

In between two looks a capsule comes no nearer than its ends have travelled; where even that could not make it the
nearest of all, nothing is looked at. So the result is exact, over every time that is given.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.clearance import FAR, segment_distance_squared

Float = NDArray[np.float64]

STRETCH = 12
"""Times from one look to the next."""


class Traced(NamedTuple):
    """Places on arms at T times of N movements."""

    places: Float
    """Shape (N, T, P, 3), [m]."""
    hand: int
    """Index of the hand's."""
    links: NDArray[np.int64]
    """Indices of both ends of each link's axis, shape (L, 2)."""


def ends_of(links: Float) -> Traced:
    """Links alone, shape (N, T, L, 2, 3), [m], the last of which ends in the hand."""
    number = links.shape[2]
    places = links.reshape(*links.shape[:2], 2 * number, 3)
    return Traced(places, 2 * number - 1, np.arange(2 * number).reshape(number, 2))


def nearest_approach(
    traced: Traced,
    radii: tuple[float, ...],
    obstacles: Float,
    present: NDArray[np.bool_],
    last: NDArray[np.int64] | None = None,
) -> Float:
    """Least clearance of links over a movement and all obstacles, shape (N,), [m]; at most FAR.

    Args:
        traced: Where the links are.
        radii: Of the L links, [m].
        obstacles: Shape (N, n, 7), [m].
        present: Whether a row is an obstacle, shape (N, n), bool.
        last: Index of each movement's last time, shape (N,); all by default.
    """
    size, number = np.array(radii), traced.places.shape[1]
    last = np.full(len(obstacles), number - 1) if last is None else last
    looks = np.append(np.arange(0, number - 1, STRETCH), number - 1)
    seen = traced.places[np.arange(len(last))[:, None], np.minimum(looks, last[:, None])]
    clearance = np.stack(
        [
            np.sqrt(segment_distance_squared(seen[:, :, first], seen[:, :, second], obstacles))
            - (obstacles[..., None, -1] + radius)
            for (first, second), radius in zip(traced.links, radii, strict=True)
        ],
        axis=1,
    )  # (N, L, n, looks)
    clearance = np.where(present[:, None, :, None], np.minimum(clearance, FAR), FAR)
    least: Float = clearance.min(axis=(1, 2, 3), initial=FAR)
    if len(looks) < 2 or not present.any():
        return least
    travelled = _travelled(traced.places, looks)[:, traced.links].max(axis=2)
    bound = 0.5 * (clearance[..., 1:] + clearance[..., :-1] - travelled[:, :, None])
    each, link, row, stretch = np.nonzero((bound < least[:, None, None, None]) & (bound < FAR))
    times = np.minimum(looks[stretch, None] + np.arange(1, STRETCH), looks[stretch + 1, None])
    times = np.minimum(times, last[each, None])
    first, second = (traced.places[each[:, None], times, traced.links[link, end][:, None]] for end in (0, 1))
    near = np.sqrt(segment_distance_squared(first, second, obstacles[each, row][:, None])).min(axis=(1, 2))
    np.minimum.at(least, each, near - (obstacles[each, row, -1] + size[link]))
    return least


def _travelled(places: Float, looks: NDArray[np.int64]) -> Float:
    """How far each place travels between looks, shape (N, P, looks - 1), [m]."""
    step = np.diff(places, axis=1)
    length = np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2 + step[..., 2] ** 2)
    return np.moveaxis(np.add.reduceat(length, looks[:-1], axis=1), 1, 2)
