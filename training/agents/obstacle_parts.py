"""Obstacle parts and their poses relative to the bodies of an arm, as inputs of the pair networks.

Capsules are cut into parts of bounded length, because an obstacle is the union of its parts and short parts resemble
each other. Obstacles of any shape (:class:`ShapePairs`) stay whole; the frame is that of their bounding box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from viapoint.envs.geometry.rows import rotation_axes, shape_columns, shape_number
from viapoint.envs.geometry.shapes import SHAPES

PART = {2: 0.0625, 3: 0.15}
"""Maximum half-length of an obstacle part by spatial dimension, [m]."""


class Parts(NamedTuple):
    """Obstacle parts of B scenes, at most R in each."""

    centre: Tensor
    """Shape (B, R, D), [m]."""
    columns: Tensor
    """Numbers that describe the parts, shape (B, R, Q); for capsules half-axis (D) and radius, [m]."""
    velocity: Tensor
    """Shape (B, R, D), [m/s]."""
    present: Tensor
    """Shape (B, R), bool."""

    @property
    def half_axis(self) -> Tensor:
        """Half-axes of capsules, shape (B, R, D), [m]."""
        return self.columns[..., :-1]

    @property
    def radius(self) -> Tensor:
        """Radii of capsules, shape (B, R), [m]."""
        return self.columns[..., -1]


class Poses(NamedTuple):
    """Planned poses of L links at T instants of H plans in each of B scenes."""

    centre: Tensor
    """Shape (L, D, B, H, T), [m]."""
    axis: Tensor | None
    """Unit vectors along the links, shape (L, D, B, H, T); None if the only body is the spherical hand."""
    time: Tensor
    """Time since the start of the plan, shape (B, H, T), [s]."""
    half_length: Tensor | None = None
    """Half-lengths of the links, shape (L,), [m]; only needed to find near pairs."""
    radius: Tensor | None = None
    """Radii of the links, shape (L,), [m]; only needed to find near pairs."""


def cut_obstacles(
    rows: NDArray[np.floating], present: NDArray[np.bool_], velocity: NDArray[np.floating] | None = None
) -> Parts:
    """Cut capsules into parts of bounded length.

    Args:
        rows: Centre, half-axis and radius of n obstacles in B scenes, shape (B, n, 2 D + 1), [m].
        present: Mask of the rows that hold an obstacle, shape (B, n).
        velocity: Velocities, shape (B, n, D), [m/s]; zero if not given.
    """
    d = (rows.shape[-1] - 1) // 2
    centre, half = rows[..., :d], rows[..., d : 2 * d]
    length = np.sqrt((half * half).sum(axis=-1))
    count = np.where(present, np.maximum(np.ceil(length / PART[d] - 1e-4), 1.0), 0.0).astype(np.int64)
    scene, obstacle = (np.repeat(index, count.ravel()) for index in np.indices(count.shape).reshape(2, -1))
    place = np.arange(len(scene)) - np.repeat(np.cumsum(count.ravel()) - count.ravel(), count.ravel())
    number = count[scene, obstacle]
    column = np.arange(len(scene)) - np.searchsorted(scene, scene)
    most = max(int(count.sum(axis=1).max(initial=0)), 1)
    offset = ((2.0 * place + 1.0) / number - 1.0)[:, None] * half[scene, obstacle]
    values = {
        "centre": centre[scene, obstacle] + offset,
        "columns": np.concatenate(
            (half[scene, obstacle] / number[:, None], rows[scene, obstacle, -1:]), axis=-1
        ),
        "velocity": np.zeros_like(offset) if velocity is None else velocity[scene, obstacle],
        "present": np.ones(len(scene), dtype=bool),
    }
    return _table(len(rows), most, scene, column, values)


def whole_obstacles(
    rows: NDArray[np.float64], shapes: Sequence[str], velocity: NDArray[np.floating] | None = None
) -> Parts:
    """Return obstacles of any shape as parts with the columns of :class:`ShapePairs`.

    Args:
        rows: Rows with shapes, shape (B, n, .), see :mod:`viapoint.envs.geometry.rows`.
        shapes: Names of the shapes of the task.
        velocity: Velocities, shape (B, n, D), [m/s]; zero if not given.
    """
    scene, obstacle = np.nonzero(rows[..., -1] > 0.0)
    kind, centre, quaternion, half = shape_columns(rows[scene, obstacle])
    one_hot = kind[:, None] == np.array([shape_number(name) for name in shapes])
    turned = np.isin(kind, [number for number, shape in enumerate(SHAPES.values()) if shape.round])
    space = np.zeros((len(scene), 3))
    if velocity is not None:
        space[:, : velocity.shape[-1]] = velocity[scene, obstacle]
    values = {
        "centre": centre,
        "columns": np.concatenate((*rotation_axes(quaternion), half, turned[:, None], one_hot), axis=-1),
        "velocity": space,
        "present": np.ones(len(scene), dtype=bool),
    }
    column = np.arange(len(scene)) - np.searchsorted(scene, scene)
    return _table(len(rows), int(column.max(initial=0)) + 1, scene, column, values)


def _table(
    number: int, most: int, scene: NDArray[np.intp], column: NDArray[np.intp], values: dict[str, NDArray[Any]]
) -> Parts:
    """Return values of parts as tensors with one row for each scene, the parts of a scene first."""
    parts = {}
    for name, value in values.items():
        whole = np.zeros((number, most, *value.shape[1:]), dtype=bool if name == "present" else np.float32)
        whole[scene, column] = value
        parts[name] = torch.from_numpy(whole)
    return Parts(**parts)


class PairGeometry(Protocol):
    """Description of obstacle parts relative to bodies.

    The methods share these arguments, tensors whose shapes broadcast:

        apart    components of the vector from the centre of the body to that of the part, [m]
        axis     components of the unit axis of the body; None for a sphere
        columns  numbers that describe the part, see :class:`Parts`
    """

    inputs: int
    """Number of features."""
    near: float | None
    """Gap beyond that of the nearest pair of a plan up to which pairs determine its value in decisions, [m]; None for
    all pairs, which training always uses."""
    near_coarse: float
    """Gap up to which pairs count where values only select plans to check, [m]."""
    every: int
    """1 if gaps are computed at all instants; 2 if at every second one. In between, a pair is then near if it is so at
    the instant before or after."""

    def features(self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor]) -> list[Tensor]:
        """Return invariants of the pose of a part relative to a body."""

    def distance(self, features: Tensor) -> Tensor:
        """Return a rough distance of body and part, shape (L, N), from features of shape (L, F, N), [m]."""

    def gap(
        self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor], poses: Poses
    ) -> Tensor:
        """Return estimates of the clearance of L bodies from R parts, shape (L, R, H, T), [m]."""


class CapsulePairs:
    """Description of parts of capsules by the components of centre and half-axis relative to the body.

    Args:
        dimension: Spatial dimension D.
        links: True if the bodies are capsules, False for the spherical hand alone.
    """

    near: float | None = None
    near_coarse = 0.12
    every = 1

    def __init__(self, dimension: int, links: bool) -> None:
        self.inputs = dimension + 4 if links else 4

    def features(self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor]) -> list[Tensor]:
        """Return the features; see :class:`PairGeometry` and :func:`pair_features`."""
        return pair_features(apart, axis, columns[:-1], columns[-1])

    def distance(self, features: Tensor) -> Tensor:
        """Return the distance of the centres; see :class:`PairGeometry`."""
        return features[:, 0] if self.inputs == 4 else torch.hypot(features[:, 0], features[:, 1])

    def gap(
        self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor], poses: Poses
    ) -> Tensor:
        """Return the distance of the part's centre from the body's axis, less both radii and half its half-length."""
        size = columns[-1] + 0.5 * torch.sqrt(_dot(columns[:-1], columns[:-1]))
        return _distance_from_axis(apart, axis, poses) - size


class ShapePairs:
    """Description of obstacles of any shape by the pose of the body in the frame of the obstacle's bounding box.

    The features of a body with centre p and axis u, in this frame, are

        |p_i| - h_i        how far the centre is beyond each face of the box, at least -NEAREST
        u_i u_i            the body's axis, if it has one
        s_i s_j u_i u_j    for i < j, where s_i = p_i / FOLD, limited to -1 and 1
        h_i                half lengths, at most NEAREST: faraway faces do not matter
        one-hot            the shape

    They stay the same if the body's axis is reversed, and under reflections at the three planes through the centre of
    the box: such a reflection changes the signs of p_i and u_i. They are continuous where the body crosses these
    planes, as s_i is zero there. Shapes that are symmetric about their z axis (spheres, capsules, cylinders,
    half-spaces) are turned about it until the body's centre is at y = 0; then s_x = 1 and s_y = 0. In two dimensions
    the third coordinate is zero.

    Args:
        n_shapes: Number of shapes of the task.
        links: True if the bodies are capsules, False for the spherical hand alone.
    """

    NEAREST = 0.3
    """Depth below a face, and half length, beyond which features stay the same, [m]."""
    FOLD = 0.05
    """Distance of the body's centre from a plane of symmetry below which products of components are reduced, [m]."""
    UNIT = 0.125
    """Factor of features without a unit, in the networks' scale of lengths, [m]."""
    near: float | None = 0.09
    near_coarse = 0.06
    every = 2

    def __init__(self, n_shapes: int, links: bool) -> None:
        self.inputs = 6 + 6 * links + n_shapes

    def features(self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor]) -> list[Tensor]:
        """Return the features; see :class:`PairGeometry`."""
        frame, half, turned, one_hot = columns[:9], columns[9:12], columns[12] > 0.5, columns[13:]
        x, y, z = _in_frame(apart, frame)
        across = _root(x * x + y * y)
        excess = [
            torch.where(turned, across, x.abs()) - half[0],
            torch.where(turned, 0.0, y.abs()) - half[1],
            z.abs() - half[2],
        ]
        found = [each.clamp_min(-self.NEAREST) for each in excess]
        if axis is not None:
            a, b, c = _in_frame(axis, frame)
            u = torch.where(turned, (a * x + b * y) / across, a)
            v = torch.where(turned, (b * x - a * y) / across, b)
            fold_x, fold_y, fold_z = ((each / self.FOLD).clamp(-1.0, 1.0) for each in (x, y, z))
            fold_u, fold_v = torch.where(turned, 1.0, fold_x), torch.where(turned, 0.0, fold_y)
            products = (
                u * u,
                v * v,
                c * c,
                u * v * fold_u * fold_v,
                u * c * fold_u * fold_z,
                v * c * fold_v * fold_z,
            )
            found += [self.UNIT * each for each in products]
        like = torch.zeros_like(found[0])
        found += [each.clamp_max(self.NEAREST) + like for each in half]
        return found + [self.UNIT * each + like for each in one_hot]

    def distance(self, features: Tensor) -> Tensor:
        """Return the distance of the body's centre from the box; see :class:`PairGeometry`."""
        outside = features[:, :3].clamp_min(0.0)
        return torch.sqrt((outside * outside).sum(dim=1) + 1e-10)

    def gap(
        self, apart: list[Tensor], axis: list[Tensor] | None, columns: list[Tensor], poses: Poses
    ) -> Tensor:
        """Return the distance from the box of the point of the body's axis nearest to the part, less the radius."""
        frame, half = columns[:9], columns[9:12]
        centre = _in_frame(apart, frame)  # of the part, seen from the body
        if axis is None or poses.half_length is None or poses.radius is None:
            return _box_distance(centre, half)
        along = _in_frame(axis, frame)
        length, radius = (each[:, None, None, None] for each in (poses.half_length, poses.radius))
        t = torch.minimum(torch.maximum(_dot(centre, along), -length), length)
        return _box_distance([c - t * u for c, u in zip(centre, along, strict=True)], half) - radius


def pair_features(
    centre: list[Tensor], axis: list[Tensor] | None, half_axis: list[Tensor], radius: Tensor
) -> list[Tensor]:
    """Return invariants of the pose of an obstacle part relative to a body.

    They do not change if body and part are rotated or reflected together, or if the half-axis is reversed. For a sphere
    they are the distance of the part, the components of the half-axis towards it (absolute) and across, and the radius.
    For a body with an axis they are the components of the part's centre along and across this axis; with t and r, the
    components of the half-axis along the body's axis and across it towards the part, and with the half-axis' length l,
    the products t t / l, r r / l and 2 t r / l; in space also l, which two components do not determine; the radius.
    Products do not depend on the sign of the half-axis, so they are continuous where a sign of t or r changes.

    Args:
        centre: D components of the vector from the centre of the body to that of the part, [m].
        axis: D components of the unit axis of the body; None for a sphere.
        half_axis: D components of the half-axis of the part, [m].
        radius: Radius of the part, [m].
    """
    square, across, length = _dot(centre, centre), _dot(half_axis, centre), _dot(half_axis, half_axis)
    if axis is None:
        away = torch.sqrt(square + 1e-12)
        radial = torch.abs(across) / away
        return [away, radial, _root(length - radial * radial), radius.expand_as(away)]
    along, turned = _dot(centre, axis), _dot(half_axis, axis)
    away = _root(square - along * along)
    radial = (across - along * turned) / away
    size = _root(length)
    products = [turned * turned / size, radial * radial / size, 2.0 * turned * radial / size]
    lengths = [size.expand_as(away)] if len(centre) == 3 else []
    return [along, away, *products, *lengths, radius.expand_as(away)]


def _distance_from_axis(apart: list[Tensor], axis: list[Tensor] | None, poses: Poses) -> Tensor:
    """Return distances of points from bodies, less the radii of these, shape (L, R, H, T), [m].

    Args:
        apart: D components of the vector from the centres of the bodies.
        axis: D components of the unit axes of the bodies; None for a sphere, whose radius is left out.
        poses: Half-lengths and radii of the bodies.
    """
    # Not point_axis_squared of the geometry: bodies have unit axes, and the floor of the root keeps gradients finite.
    square = _dot(apart, apart)
    if axis is None or poses.half_length is None or poses.radius is None:
        return _root(square)
    half_length, radius = (each[:, None, None, None] for each in (poses.half_length, poses.radius))
    along = _dot(apart, axis)
    inside = torch.minimum(torch.maximum(along, -half_length), half_length)
    return _root(square - inside * (2.0 * along - inside)) - radius


def _dot(first: list[Tensor], second: list[Tensor]) -> Tensor:
    total = first[0] * second[0]
    for u, v in zip(first[1:], second[1:], strict=True):
        total += u * v
    return total


def _root(square: Tensor) -> Tensor:
    return torch.sqrt(square.clamp_min(1e-10))


def _in_frame(vector: list[Tensor], frame: list[Tensor]) -> list[Tensor]:
    """Return the three components of a vector, of D components, along the axes of a frame of nine numbers."""
    return [_dot(vector, frame[3 * i : 3 * i + len(vector)]) for i in range(3)]


def _box_distance(place: list[Tensor], half: list[Tensor]) -> Tensor:
    """Return the distance of a point from a box around the origin."""
    beyond = [(p.abs() - h).clamp_min_(0.0) for p, h in zip(place, half, strict=True)]
    return _root(_dot(beyond, beyond))
