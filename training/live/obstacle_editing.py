"""Changes of obstacles on the live page: new ones, and sizes by the names of their sliders."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import in_space, quaternion_to
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.half_space import EXTENT, HalfSpace
from viapoint.envs.geometry.rows import (
    dimension_of,
    obstacle_rows,
    obstacles_from_rows,
    quaternion_of_axes,
    rotation_axes,
    shape_columns,
    shape_rows,
)
from viapoint.envs.geometry.shape import TALL, Shape
from viapoint.envs.geometry.shapes import SHAPES, nearest_distance

if TYPE_CHECKING:
    from viapoint.training.live.scene_file import LiveScene

BOX_SIZES = ("half-depth", "half-width", "half-height")
"""Names of the half lengths of a box."""
LEAST_SIZE = 1e-4
"""Least size of an obstacle, [m]; a capsule of this half length has no direction."""
STEEPEST = 89.99
"""Greatest elevation that is set, [deg]: the heading is kept."""
WALL = 0.15
"""Distance of a new wall from the movement, [m]."""
STEP, PLACES = 0.02, 16
"""Distance and number of the places to either side that are tried for a new obstacle, [m]."""


class NewObstacle(NamedTuple):
    """Shape and size of a new obstacle."""

    shape: str
    half: tuple[float, float, float]
    """Half lengths of its box, [m]."""
    across: bool = False
    """True if its z axis lies across the movement, False if it is upright."""


KINDS: dict[int, dict[str, NewObstacle]] = {
    2: {
        "post": NewObstacle("capsule", (0.025, 0.025, 0.025)),
        "bar": NewObstacle("capsule", (0.025, 0.025, 0.085), across=True),
        "box": NewObstacle("box", (0.03, 0.03, TALL)),
        "wall": NewObstacle("half_space", (EXTENT, EXTENT, EXTENT)),
    },
    3: {
        "sphere": NewObstacle("capsule", (0.035, 0.035, 0.035)),
        "bar": NewObstacle("capsule", (0.035, 0.035, 0.115)),
        "box": NewObstacle("box", (0.03, 0.03, 0.03)),
        "cylinder": NewObstacle("cylinder", (0.03, 0.03, 0.06)),
        "wall": NewObstacle("half_space", (EXTENT, EXTENT, EXTENT)),
    },
}
"""Kinds of new obstacles by the dimension of the arm's space."""


def new_obstacle(scene: LiveScene, kind: str) -> Float:
    """Return the row of a new obstacle beside the middle of the movement, clear of the others if there is room.

    A half-space is a wall along the movement, on the side away from the base of the arm.

    Args:
        scene: Scene.
        kind: Key of :data:`KINDS` in the dimension of the scene.
    """
    d = len(scene.start)
    line, middle = scene.goal - scene.start, 0.5 * (scene.start + scene.goal)
    aside = np.zeros(3)
    aside[:2] = -line[1], line[0]
    aside /= max(float(np.linalg.norm(aside)), 1e-9)
    shape, half, across = KINDS[d][kind]
    if shape == HalfSpace.kind:
        side = aside if aside[:d] @ middle >= 0.0 else -aside
        wall = HalfSpace.facing(-side, in_space(middle) + WALL * side)
        return np.asarray(obstacle_rows([wall], d, tuple(SHAPES))[0])
    steps = np.outer(np.arange(1, PLACES) * STEP, aside[:d])
    places = middle + np.stack((steps, -steps), axis=1).reshape(-1, d)
    others = obstacles_from_rows(scene.obstacles)
    free = nearest_distance(others, in_space(places), radius=max(half[:2]), most=1.0) > 0.0
    centre = places[free.argmax()]
    turn = quaternion_to(aside if across else (0.0, 0.0, 1.0))
    (row,) = shape_rows(shape, centre[None], turn[None], np.array([half]))
    return np.asarray(row)


def sizes_of(row: Float) -> dict[str, float]:
    """Return the sizes of an obstacle, by the names of their sliders, [m] and [deg].

    A shape that is round about its z axis has the direction of that axis, another one that of its first axis, seen from
    above. A height that does not matter in the plane is left out.
    """
    shape, sizes = _shape(row), dict[str, float]()
    for name in shape.sizes:
        value = np.atleast_1d(getattr(shape, name))
        names = BOX_SIZES if len(value) == len(BOX_SIZES) else (name.replace("_", "-"),)
        sizes |= dict(zip(names, map(float, value), strict=True))
    first, _, third = rotation_axes(shape_columns(row).quaternion)
    if sizes and dimension_of(row) == 2 and shape_columns(row).half[2] == TALL:
        sizes.popitem()
    if not shape.round:
        sizes["heading"] = (_heading(first) + 90.0) % 180.0 - 90.0
    elif sizes.get("half-length", 0.0) > LEAST_SIZE:
        axis = third if third[0] > 0.0 or (third[0] == 0.0 and third[2] > 0.0) else -third
        sizes["heading"] = _heading(axis)
        if dimension_of(row) == 3:
            sizes["elevation"] = float(np.degrees(np.arcsin(np.clip(axis[2], -1.0, 1.0))))
    return sizes


def resized(row: Float, name: str, value: float) -> Float:
    """Return the row of an obstacle with another size or direction, see :func:`sizes_of`."""
    d, shape, (number, centre, quaternion, _) = dimension_of(row), _shape(row), shape_columns(row)
    before = {"heading": 0.0, "elevation": 90.0 if d == 3 else 0.0, **sizes_of(row)}
    wanted = {**before, name: value}
    parameters: dict[str, Any] = {}
    for each in shape.sizes:
        value_of = np.array(getattr(shape, each), dtype=np.float64)
        names = BOX_SIZES if value_of.ndim else (each.replace("_", "-"),)
        sizes = [wanted.get(part, old) for part, old in zip(names, np.atleast_1d(value_of), strict=True)]
        parameters[each] = np.maximum(sizes, LEAST_SIZE).reshape(value_of.shape)
    if not shape.round:
        turn = np.radians(wanted["heading"] - before["heading"])
        c, s = np.cos(turn), np.sin(turn)
        first, second, _ = (np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ axis
                            for axis in rotation_axes(quaternion))  # fmt: skip
        quaternion = quaternion_of_axes(first, second)
    elif "half-length" in before and (name in ("heading", "elevation") or d == 2):
        heading, elevation = np.radians(
            (wanted["heading"], np.clip(wanted["elevation"], -STEEPEST, STEEPEST))
        )
        flat = np.cos(elevation)
        quaternion = quaternion_to((flat * np.cos(heading), flat * np.sin(heading), np.sin(elevation)))
    _, half = dataclasses.replace(shape, **parameters).box()
    (found,) = shape_rows(list(SHAPES)[int(number)], centre[None, :d], quaternion[None], half[None])
    return np.asarray(found)


def _shape(row: Float) -> Shape:
    number, centre, quaternion, half = shape_columns(row)
    return list(SHAPES.values())[int(number)].from_box(centre, quaternion, half)


def _heading(axis: Float) -> float:
    return float(np.degrees(np.arctan2(axis[1], axis[0])))
