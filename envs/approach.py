"""The nearest approach of links to obstacles over a movement, without looking at every link, obstacle and time.

In between two looks a capsule comes no nearer than its ends have travelled; where even that could not make it the
nearest of all, nothing is looked at. So the result is exact, over every time that is given.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.clearance import FAR, segment_distance_squared

Float = NDArray[np.float64]

STRETCH = 12
"""Times from one look to the next."""


def nearest_approach(
    links: Float, radii: tuple[float, ...], obstacles: Float, present: NDArray[np.bool_]
) -> Float:
    """Least clearance of links over a movement and all obstacles, shape (N,), [m]; at most FAR.

    Args:
        links: End points of their axes, shape (N, T, L, 2, 3), [m].
        radii: Of the L links, [m].
        obstacles: Shape (N, n, 7), [m].
        present: Whether a row is an obstacle, shape (N, n), bool.
    """
    size = np.array(radii)
    looks = np.append(np.arange(0, links.shape[1] - 1, STRETCH), links.shape[1] - 1)
    seen = links[:, looks]
    clearance = np.stack(
        [
            np.sqrt(segment_distance_squared(seen[:, :, i, 0], seen[:, :, i, 1], obstacles))
            - (obstacles[..., None, -1] + radius)
            for i, radius in enumerate(radii)
        ],
        axis=1,
    )  # (N, L, n, looks)
    clearance = np.where(present[:, None, :, None], np.minimum(clearance, FAR), FAR)
    least: Float = clearance.min(axis=(1, 2, 3), initial=FAR)
    if len(looks) < 2 or not present.any():
        return least
    bound = 0.5 * (clearance[..., 1:] + clearance[..., :-1] - _travelled(links, looks)[:, :, None])
    each, link, row, stretch = np.nonzero((bound < least[:, None, None, None]) & (bound < FAR))
    times = np.minimum(looks[stretch, None] + np.arange(1, STRETCH), looks[stretch + 1, None])
    ends = links[each[:, None], times, link[:, None]]
    near = np.sqrt(segment_distance_squared(ends[:, :, 0], ends[:, :, 1], obstacles[each, row][:, None])).min(
        axis=(1, 2)
    )
    np.minimum.at(least, each, near - (obstacles[each, row, -1] + size[link]))
    return least


def _travelled(links: Float, looks: NDArray[np.int64]) -> Float:
    """How far the farther-moving end of each link travels between looks, shape (N, L, looks - 1), [m]."""
    step = np.diff(links, axis=1)
    length = np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2 + step[..., 2] ** 2)
    return np.moveaxis(np.add.reduceat(length, looks[:-1], axis=1).max(axis=-1), 1, 2)
