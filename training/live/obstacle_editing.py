"""Changes of obstacles on the live page: new ones, and sizes by the names of their sliders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import (
    CAPSULES,
    dimension_of,
    has_shapes,
    rotation_axes,
    shape_columns,
    shape_rows,
    widened,
)
from viapoint.envs.geometry.shape import TALL
from viapoint.envs.geometry.shapes import SHAPES

if TYPE_CHECKING:
    from viapoint.training.live.scene_file import LiveScene

CAPSULE_KINDS = ("post", "bar")
"""Kinds of new obstacles that are capsules."""
BOX_SIZES = ("half-depth", "half-width", "half-height")
"""Names of the half lengths of an obstacle's box."""


def obstacle_kinds(shapes: Sequence[str]) -> tuple[str, ...]:
    """Return the kinds of new obstacles where scenes may have some shapes."""
    others = tuple(name for name in shapes if name not in ("capsule", "half_space"))
    return (*(CAPSULE_KINDS if "capsule" in shapes else ()), *others)


def new_obstacle(scene: LiveScene, shape: str, shapes: Sequence[str] = CAPSULES) -> Float:
    """Return the row of a new obstacle near the middle of the movement, where it touches neither end.

    Args:
        scene: Scene.
        shape: One of :func:`obstacle_kinds`.
        shapes: Names of the shapes that the scene may have.
    """
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
    if shape not in CAPSULE_KINDS:
        size = np.full((1, 3), 0.03)
        (row,) = shape_rows(shape, centre[None], np.array([[1.0, 0.0, 0.0, 0.0]]), _fitting(shape, size, d))
        return np.asarray(row)
    row = np.array([*centre, *half, 0.025 if d == 2 else 0.035])
    return row if tuple(shapes) == CAPSULES else widened(row)


def sizes_of(row: Float) -> dict[str, float]:
    """Return the sizes of an obstacle, by the names of their sliders."""
    if has_shapes(row):
        _, _, quaternion, half = shape_columns(row)
        first = rotation_axes(quaternion)[0]
        heading = float(np.degrees(np.arctan2(first[1], first[0])))
        return {
            **dict(zip(BOX_SIZES, map(float, half), strict=True)),
            "heading": (heading + 90.0) % 180.0 - 90.0,
        }
    d = dimension_of(row)
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
    if has_shapes(row):
        return _resized_shape(row, name, value)
    row, d = row.copy(), dimension_of(row)
    if name == "radius":
        row[-1] = value
        return row
    sizes = {"heading": 0.0, "elevation": 90.0 if d == 3 else 0.0, **sizes_of(row), name: value}
    heading, elevation = np.radians(sizes["heading"]), np.radians(sizes["elevation"])
    flat = np.cos(elevation) if d == 3 else 1.0
    direction = np.array([flat * np.cos(heading), flat * np.sin(heading), np.sin(elevation)])
    row[d : 2 * d] = sizes["half-length"] * direction[:d]
    return row


def _resized_shape(row: Float, name: str, value: float) -> Float:
    """Return the row of an obstacle of any shape with another size, or turned about the vertical."""
    d, (number, centre, quaternion, half) = dimension_of(row), shape_columns(row)
    kind, half = list(SHAPES)[int(number)], half.copy()
    if name in BOX_SIZES:
        half[BOX_SIZES.index(name)] = max(value, 0.005)
        if SHAPES[kind].round and name != BOX_SIZES[2]:
            half[:2] = max(value, 0.005)
    elif name == "heading":
        turn = 0.5 * np.radians(value - sizes_of(row)["heading"])
        w, x, y, z = quaternion
        c, s = np.cos(turn), np.sin(turn)
        quaternion = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    if d == 2 and kind == "capsule" and rotation_axes(quaternion)[2][2] > 0.5:
        half[2] = half[0]  # a post
    (turned,) = shape_rows(kind, centre[None, :d], quaternion[None], _fitting(kind, half[None], d))
    return np.asarray(turned)


def _fitting(kind: str, half: Float, dimension: int) -> Float:
    """Return half lengths that a shape can have: those of a sphere are equal, a capsule is as long as it is wide."""
    half = half.copy()
    if kind == "sphere":
        half[:] = half[:, :1]
    elif kind == "capsule":
        half[:, 2] = np.maximum(half[:, 2], half[:, 0])
    elif dimension == 2:
        half[:, 2] = TALL
    return half
