"""Random numbers, feasible paths, vectors and shapes that all samplers of obstacles share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.types import Bool, Float, Index
from viapoint.envs.geometry.rows import (
    CAPSULES,
    dimension_of,
    shape_columns,
    shape_number,
    shape_rows,
    turn_up_to,
    widened,
)
from viapoint.envs.geometry.shape import TALL
from viapoint.envs.geometry.shapes import SHAPES

IN_THE_WAY = 0.004
"""Depth by which the straight movement must cut into an obstacle that is in the way, [m]."""
RESHAPE_NUMBERS = 3
"""Uniform numbers of an obstacle that decide its shape."""


class Uniforms:
    """Rows of uniform numbers in [0, 1), shape (..., n), of which the first `taken` are taken."""

    def __init__(self, values: Float, taken: int = 0) -> None:
        self._values, self._taken = values, taken

    def take(self, count: int) -> Float:
        """Return the next `count` numbers of each row, shape (..., count).

        Raises:
            ValueError: The rows hold fewer numbers.
        """
        self._taken += count
        if self._taken > self._values.shape[-1]:
            raise ValueError(f"{self._taken} uniform numbers were taken of {self._values.shape[-1]}")
        return self._values[..., self._taken - count : self._taken]

    def peek(self, count: int) -> Float:
        """Return the next `count` numbers of each row, shape (..., count), without taking them."""
        return self._values[..., self._taken : self._taken + count]

    def take_table(self, rows: int, columns: int, *, by_column: bool = False) -> Float:
        """Return the next numbers as tables, shape (N, rows, columns), stored row by row or column by column."""
        numbers = self.take(rows * columns)
        if by_column:
            return numbers.reshape(-1, columns, rows).swapaxes(1, 2)
        return numbers.reshape(-1, rows, columns)

    def at(self, rows: Index) -> Uniforms:
        """Return the rest of some rows, at the same position."""
        return Uniforms(self._values[rows], self._taken)

    def flat(self) -> Uniforms:
        """Return the rows in one dimension."""
        return Uniforms(self._values.reshape(-1, self._values.shape[-1]), self._taken)


class FeasiblePath(NamedTuple):
    """Paths of the hand that solve N scenes: obstacles are placed clear of them."""

    start: Float
    """Shape (N, D), [m]."""
    goal: Float
    """Shape (N, D), [m]."""
    path: Float
    """Positions of the hand at T times, shape (N, T, D), [m]."""

    @property
    def ends(self) -> Float:
        """Start and goal, shape (N, 2, D), [m]."""
        return np.stack((self.start, self.goal), axis=1)

    def take(self, rows: Index) -> FeasiblePath:
        """Return the paths at `rows`."""
        return FeasiblePath(*(part[rows] for part in self))

    def near(self, fraction: Float, margin: float) -> tuple[Index, Float, Float]:
        """Return points on the middle part of the paths.

        Args:
            fraction: Position along the middle part, from 0 to 1, shape (N, C).
            margin: Share of the path before the middle part, and after it.

        Returns:
            Indices of the times, shape (N, C), positions and central differences there, shape (N, C, D), [m].
        """
        number, times = self.path.shape[:2]
        time = (margin * times + (1.0 - 2.0 * margin) * times * fraction).astype(np.int64)
        each = np.arange(number)[:, None]
        return time, self.path[each, time], self.path[each, time + 1] - self.path[each, time - 1]


@dataclass(frozen=True, kw_only=True)
class Site:
    """Feasible paths of N scenes, beside which the obstacles of a family are placed."""

    feasible: FeasiblePath
    room: float
    """Radius of the part that must pass: the hand, or the last link of a planar arm whose links count, [m]."""
    whole_arm: bool
    """Flag: every link must clear the obstacles, not the hand alone."""

    @property
    def start(self) -> Float:
        """Shape (N, D), [m]."""
        return self.feasible.start

    @property
    def goal(self) -> Float:
        """Shape (N, D), [m]."""
        return self.feasible.goal

    @property
    def path(self) -> Float:
        """Positions of the hand at T times, from start to goal, shape (N, T, D), [m]."""
        return self.feasible.path


class ObstacleSampler(Protocol):
    """Sampler of obstacles clear of feasible paths."""

    path_numbers: int
    """Uniform numbers that make one candidate path."""
    fixed: int | None
    """Index of the number, among those of the obstacles, that early attempts at a scene share; None for none."""

    @property
    def rows(self) -> int:
        """Greatest number of obstacles in a scene."""

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""

    def steered(self, uniforms: Uniforms, number: int) -> Bool:
        """Return which of `number` paths must leave room on one side (above; in the plane towards the base)."""

    def __call__(self, uniforms: Uniforms, feasible: FeasiblePath) -> tuple[Float, Bool]:
        """Return obstacles, shape (N, rows, 2 D + 1), [m], and which scenes are good, shape (N,)."""


def directions(angle: Float, rise: Float, dimension: int) -> Float:
    """Return unit vectors, shape (..., D), of their horizontal angle [rad] and their third component, the rise."""
    level = np.sqrt(1.0 - rise**2)
    return np.stack((level * np.cos(angle), level * np.sin(angle), rise), axis=-1)[..., :dimension]


def unit(vectors: Float) -> Float:
    """Return vectors scaled to length one; zero vectors stay zero."""
    return np.asarray(vectors / np.maximum(norm(vectors)[..., None], 1e-9))


def left(vectors: Float) -> Float:
    """Return the horizontal parts of vectors, turned to the left by a quarter turn."""
    turned = np.zeros_like(vectors)
    turned[..., 0], turned[..., 1] = -vectors[..., 1], vectors[..., 0]
    return turned


def rotate(vectors: Float, angle: Float) -> Float:
    """Return horizontal vectors turned to the left by angles, [rad]."""
    return np.asarray(np.cos(angle)[..., None] * vectors + np.sin(angle)[..., None] * left(vectors))


def between(bounds: tuple[float, float], u: Any) -> Any:
    """Return uniform numbers between bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * u


def whole_between(bounds: tuple[int, int], u: Float) -> Float:
    """Return uniform whole numbers between bounds, both included."""
    return bounds[0] + np.floor((bounds[1] - bounds[0] + 1) * u)


def present_first(rows: Float, count: int) -> Float:
    """Return the first `count` obstacles of each scene; absent ones, without a radius, come last."""
    order = np.argsort(rows[..., -1] <= 0.0, axis=-1, kind="stable")[:, :count]
    return np.take_along_axis(rows, order[..., None], axis=1)


def shuffle_rows(rows: Float, chance: Float) -> Float:
    """Return obstacles, shape (N, K, 2 D + 1), in the order of uniform numbers, shape (N, K)."""
    return np.take_along_axis(rows, np.argsort(chance, axis=-1, kind="stable")[..., None], axis=1)


def reshaped(rows: Float, u: Float, shapes: Sequence[str]) -> Float:
    """Return obstacles as rows with shapes, in which every capsule has become one of some shapes inside it.

    Whatever is clear of a capsule is clear of a shape inside it. Obstacles of other shapes stay as they are.

    Args:
        rows: Rows of either kind, shape (..., .), [m].
        u: Uniform numbers, shape (..., RESHAPE_NUMBERS).
        shapes: Names of the shapes of scenes; those of one size do not fit into every capsule.
    """
    names, d = [name for name in shapes if SHAPES[name].only_half is None], dimension_of(rows)
    if not names or tuple(shapes) == CAPSULES:
        return rows if tuple(shapes) == CAPSULES else widened(rows)
    found = widened(rows).copy()
    capsule = (rows[..., -1] > 0.0) & (shape_columns(rows).kind == shape_number("capsule"))
    which = np.where(capsule, (u[..., 0] * len(names)).astype(np.int64), -1)
    for number, name in enumerate(names):
        some = which == number
        axes = np.concatenate((rows[some][:, : 2 * d], rows[some][:, -1:]), axis=-1)
        quaternion, half = _inside(name, axes, u[some, 1:])
        found[some] = shape_rows(name, axes[:, :d], quaternion, half)
    return found


def box_rows(centre: Float, heading: Float, half: Float) -> Float:
    """Return upright boxes as rows with shapes, shape (..., .), [m].

    Args:
        centre: Shape (..., D), [m].
        heading: Horizontal vectors along the first axes of the boxes, shape (..., D).
        half: Half lengths along the heading, to its left and upwards, shape (..., 3), [m].
    """
    return shape_rows("box", centre, yaw(heading), half)


def yaw(heading: Float) -> Float:
    """Return the quaternions, shape (..., 4), that turn the first axis to horizontal vectors, shape (..., D)."""
    angle = 0.5 * np.arctan2(heading[..., 1], heading[..., 0])
    none = np.zeros_like(angle)
    return np.stack((np.cos(angle), none, none, np.sin(angle)), axis=-1)


def _inside(name: str, rows: Float, u: Float) -> tuple[Float, Float]:
    """Return quaternions and half lengths of shapes that touch the capsules around them from inside."""
    d, radius = dimension_of(rows), rows[:, -1]
    axis = rows[:, d : 2 * d]
    length = norm(axis)
    if name == "sphere":
        return turn_up_to(in_space(axis), 0.0 * length), np.stack(3 * [radius], axis=-1)
    if name == "capsule":
        return turn_up_to(in_space(axis), length), np.stack((radius, radius, length + radius), axis=-1)
    slant, aspect = 0.5 * np.pi * (0.15 + 0.7 * u.T)
    wide, long = radius * np.cos(slant), length + radius * np.sin(slant)
    if d == 2 and SHAPES[name].round:
        return turn_up_to(in_space(axis), 0.0 * length), np.stack(
            (radius, radius, 0.0 * radius + TALL), axis=-1
        )
    if d == 2:
        return yaw(axis), np.stack((long, wide, 0.0 * wide + TALL), axis=-1)
    across = (wide, wide) if SHAPES[name].round else (wide * np.cos(aspect), wide * np.sin(aspect))
    return turn_up_to(axis, length), np.stack((*across, long), axis=-1)
