"""Changes of obstacles on the live page: new ones, and sizes by the names of their sliders."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from viapoint.envs.common.types import Float

if TYPE_CHECKING:
    from viapoint.training.live.scene_file import LiveScene

SHAPES = ("post", "bar")
"""Kinds of new obstacles."""


def new_obstacle(scene: LiveScene, shape: str) -> Float:
    """Return the row of a new obstacle near the middle of the movement, where it touches neither end."""
    d = len(scene.start)
    line = scene.goal - scene.start
    aside = np.zeros(d)
    aside[:2] = -line[1], line[0]
    aside /= max(float(np.linalg.norm(aside)), 1e-9)
    centre = 0.5 * (scene.start + scene.goal) + 0.02 * aside * (1 + len(scene.obstacles))
    half = np.zeros(d)
    if shape == "bar":
        half[-1 if d == 3 else 0] = 0.08
        if d == 2:
            half = 0.06 * aside
    return np.array([*centre, *half, 0.025 if d == 2 else 0.035])


def sizes_of(row: Float) -> dict[str, float]:
    """Return the sizes of an obstacle, by the names of their sliders."""
    d = (len(row) - 1) // 2
    half = row[d : 2 * d]
    length = float(np.sqrt(half @ half))
    sizes = {"radius": float(row[-1]), "half-length": length}
    if length > 1e-9:
        half = half if half[0] > 0.0 or (half[0] == 0.0 and half[-1] > 0.0) else -half
        sizes["heading"] = float(np.degrees(np.arctan2(half[1], half[0])))
        if d == 3:
            sizes["elevation"] = float(np.degrees(np.arcsin(half[2] / length)))
    return sizes


def resized(row: Float, name: str, value: float) -> Float:
    """Return the row of an obstacle with another size."""
    row, d = row.copy(), (len(row) - 1) // 2
    if name == "radius":
        row[-1] = value
        return row
    sizes = {"heading": 0.0, "elevation": 90.0 if d == 3 else 0.0, **sizes_of(row), name: value}
    heading, elevation = np.radians(sizes["heading"]), np.radians(sizes["elevation"])
    flat = np.cos(elevation) if d == 3 else 1.0
    direction = np.array([flat * np.cos(heading), flat * np.sin(heading), np.sin(elevation)])
    row[d : 2 * d] = sizes["half-length"] * direction[:d]
    return row
