"""Targets and rows of lights of Flash & Hogan 1985."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs import Box
from viapoint.envs.common.types import Float

TARGETS = {
    "T1": (-0.32, 0.42),
    "T2": (-0.22, 0.27),
    "T3": (-0.02, 0.27),
    "T4": (0.08, 0.42),
    "T5": (-0.02, 0.57),
    "T6": (-0.22, 0.57),
}
"""The six targets of Flash & Hogan 1985, Fig. 2, [m], shoulder at the origin.

The figure gives no coordinates. Its movements T1-T4, T2-T5 and T3-T6 (Figs. 1, 3 and 4) are the three diagonals of a
hexagon here, 40, 36 and 36 cm long, in front of the right shoulder and within the reach of the arm.
"""
LEAST_APART = 0.3
"""Least distance of the targets of a movement, [m]."""


class RowOfLights(NamedTuple):
    """Movement between two targets, and the row of lights across its middle."""

    first: str
    last: str
    """Names of the targets."""
    start: Float
    """Shape (2,), [m]."""
    goal: Float
    """Shape (2,), [m]."""
    lights: Box


def rows_of_lights(
    length: float = 0.25, radius: float = 0.008, half_height: float = 0.04
) -> list[RowOfLights]:
    """Return the obstacle paradigm of Flash & Hogan 1985, one for each two targets that are far apart.

    Args:
        length: Length of the row, [m]; the paper's rows were up to 25 cm long.
        radius: Half width of the row, [m].
        half_height: Half height of the obstacle that stands for it, [m].

    Example:
        >>> from viapoint.training.paper.lights import rows_of_lights
        >>> rows = rows_of_lights()
        >>> len(rows), rows[0].first, rows[0].last
        (14, 'T1', 'T3')
    """
    found = []
    for first, start in TARGETS.items():
        for last, goal in TARGETS.items():
            line = np.subtract(goal, start)
            if np.hypot(*line) < LEAST_APART:
                continue
            across = 0.5 * (np.arctan2(line[1], line[0]) + 0.5 * np.pi)
            lights = Box(
                size=(0.5 * length, radius, half_height),
                position=(*(0.5 * np.add(start, goal)), 0.0),
                quaternion=(np.cos(across), 0.0, 0.0, np.sin(across)),
            )
            found.append(RowOfLights(first, last, np.array(start), np.array(goal), lights))
    return found
