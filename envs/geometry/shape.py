"""Base class of obstacle shapes: pose, validation, signed distances, and descriptions for MuJoCo, plots and networks.

A shape is a frozen record of its parameters and its pose. All distances are signed: negative inside. A shape of a new
kind is a subclass with a few methods that work in the shape's own frame, and an entry in
:data:`~viapoint.envs.geometry.shapes.SHAPES`:

    _signed          signed distance of points
    geoms            MuJoCo geoms
    bounding_sphere  sphere around the shape
    support          farthest point in each direction
    _nearest         optional: point of a segment with the least signed distance; a search by default
    _of_half         optional: parameters from the half lengths of the bounding box; `size` by default
    bound            optional: capsule around the shape; around its bounding box by default

The signed distance of a segment is the least of its points'. It is the usual distance of two bodies where they do not
touch, and negative where they overlap. For a convex shape it is convex along the segment, because the signed distance
from a convex body is the supremum of affine functions n . x - h(n) over its outer unit normals n, inside and outside.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from viapoint.envs.common.arrays import best_of, dot, frame_axes, frozen, norm
from viapoint.envs.common.types import Float
from viapoint.primitives.array_api import (
    Array,
    Namespace,
    as_floats,
    broadcast_batch,
    follows_gradient,
    like,
    namespace_of,
    to_numpy,
)

UNIT_TOLERANCE = 1e-3
"""Greatest error of a quaternion's length; smaller ones are corrected."""
GUARD = 1e-24
"""Summand that keeps the gradient of a root finite at 0, [m^2]; it changes distances by at most 1e-12 m."""
CONTACT = 1e-6
"""Distance below which a segment is looked at as one that enters a shape, [m]."""
BLOCK = 1 << 16
"""Numbers of a temporary table."""
SEARCH_STEPS = 40
"""Steps of the golden-section search; its interval is then 5e-9 of the segment."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""Share of the interval that remains after a step of the golden-section search."""
FLAT = 1e-9
"""Greatest height of obstacles in the plane, [m]; rounding of quaternions."""
TALL = 1.0
"""Half height of obstacles of arms in the plane whose height does not matter, [m]."""
OUTLINE_POINTS = 128
"""Corners of the outline of a round shape."""

Components = list[Array]
"""Components x, y and z of points or vectors, as separate arrays."""


class Geom(NamedTuple):
    """MuJoCo geom."""

    type: Any
    """mujoco.mjtGeom."""
    size: tuple[float, float, float]
    """Size in MuJoCo's convention, [m]."""
    position: Float
    """Centre, shape (3,), [m]."""
    quaternion: Float
    """Orientation, shape (4,)."""
    vertices: Float | None = None
    """Vertices of a mesh, shape (V, 3), [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape(abc.ABC):
    """Obstacle of some shape at some pose.

    Parameters may have leading axes, which are those of a batch: `Sphere(radius, position)` with shapes (N,) and (N, 3)
    is N spheres. They broadcast with the leading axes of points. Parameters and points are NumPy arrays or torch
    tensors; results follow the library and dtype of the points. NumPy parameters are read-only copies.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import Shape, Sphere
        >>> balls = Sphere(radius=np.array([0.05, 0.1]), position=np.array([(0.4, 0.0, 0.3), (0.0, 0.4, 0.3)]))
        >>> isinstance(balls, Shape), balls.distance(np.array([0.4, 0.0, 0.5])).round(3).tolist()
        (True, [0.15, 0.5])
    """

    kind: ClassVar[str] = ""
    """Name of the shape in dictionaries and in :data:`~viapoint.envs.geometry.shapes.SHAPES`."""
    sizes: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Names of the parameters that must be positive, with the shape of one value, in the order of MuJoCo's sizes."""
    in_scenes: ClassVar[bool] = True
    """Flag: the bounding box determines the shape, so that scenes can hold it as a row of numbers."""
    only_half: ClassVar[tuple[float, float, float] | None] = None
    """Half lengths of the bounding box of a shape of one size, [m]; None if the parameters determine them."""
    round: ClassVar[bool] = False
    """Flag: the shape is symmetric under rotations about the z axis of its frame."""

    position: Array = (0.0, 0.0, 0.0)
    """Origin of the shape's frame in the world, shape (..., 3), [m]."""
    quaternion: Array = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z), shape (..., 4); its length is 1."""
    name: str = ""
    """Name for error messages."""

    def __post_init__(self) -> None:
        """Convert and check the parameters."""
        if not isinstance(self.name, str):
            raise ValueError(f"{self.kind}: name must be a string, got {self.name!r:.60}")
        trailing = {**self.sizes, "position": (3,), "quaternion": (4,)}
        try:
            xp, arrays = as_floats(**{name: getattr(self, name) for name in trailing})
            values = dict(zip(trailing, arrays, strict=True))
            leading = {}
            for name, last in trailing.items():
                shape = tuple(values[name].shape)
                leading[name] = shape[: len(shape) - len(last)]
                if shape != leading[name] + last:
                    wanted = f"have shape (..., {last[0]})" if last else "be a number"
                    raise ValueError(f"{name} must {wanted}, got shape {shape}")
            for name in self.sizes:
                if not (values[name] > 0.0).all():
                    raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)!r}")
            broadcast_batch(**leading)
            values["quaternion"] = _unit(xp, values["quaternion"])
        except ValueError as error:
            raise self._error(str(error)) from None
        for name, value in values.items():
            object.__setattr__(self, name, frozen(value.copy()) if xp is np else value)
        self._check()

    def __eq__(self, other: object) -> bool:
        """Return True for a shape of the same kind with the same parameters and name."""
        return type(self) is type(other) and all(
            np.array_equal(to_numpy(mine), to_numpy(theirs)) if hasattr(mine, "shape") else mine == theirs
            for mine, theirs in ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        )

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def parameters(cls) -> list[str]:
        """Return the names of the parameters, those of the pose last."""
        return [f.name for f in sorted(fields(cls), key=lambda f: bool(f.kw_only)) if f.init]

    # Distances

    def distance(self, points: Array, radius: Array = 0.0) -> Array:
        """Return the signed distance of points, or of spheres around them, shape (...,), [m].

        Args:
            points: Shape (..., 3), [m].
            radius: Radius of the spheres, [m].
        """
        own, (points,), radius = self._matched(radius, points=points)
        return own._signed(own._relative(points)) - radius

    def segment_distance(self, first: Array, second: Array, radius: Array = 0.0) -> Array:
        """Return the least signed distance along segments, or capsules around them, shape (...,), [m].

        Args:
            first: One end of each segment, shape (..., 3), [m].
            second: The other end, [m]; it may be the same point.
            radius: Radius of the capsules, [m].
        """
        own, (first, second), radius = self._matched(radius, first=first, second=second)
        xp = namespace_of(first)
        start, end = own._relative(first), own._relative(second)

        def at(share: Array) -> Array:
            return own._signed([a + share * (b - a) for a, b in zip(start, end, strict=True)])

        with nullcontext() if xp is np else xp.no_grad():
            # At least one axis; sizes may have more of them than the ends.
            way = [(b - a)[None] for a, b in zip(start, end, strict=True)]
            along = own._nearest([a[None] for a in start], way)
            axes = (len(getattr(own, name).shape) - len(last) for name, last in self.sizes.items())
            along = along if len(along.shape) <= max(axes, default=0) else along[0]
        least = at(along)
        if not follows_gradient(least):
            return least - radius
        if least.dtype == xp.float32:  # the steps of `_with_gradient` would be 0.5 % of the segment
            return own.segment_distance(first.double(), second.double(), radius).to(xp.float32)
        return _with_gradient(xp, at, along, least) - radius

    @property
    @abc.abstractmethod
    def bounding_sphere(self) -> tuple[Array, Array]:
        """Centre, shape (..., 3), and radius, shape (...,), of a sphere that contains the shape, [m]."""

    @abc.abstractmethod
    def _signed(self, points: Components) -> Array:
        """Return the signed distance of points in the shape's frame."""

    def _nearest(self, start: Components, along: Components) -> Array:
        """Return t in [0, 1] for which the signed distance of start + t * along is least, in the shape's frame.

        Golden-section search. The least distance is exact to 5e-9 of the length of the segment, because the signed
        distance changes by at most the length of the way.
        """
        xp = namespace_of(start[0])

        def at(share: Array) -> Array:
            return self._signed([a + share * u for a, u in zip(start, along, strict=True)])

        low = xp.zeros_like(start[0] + along[0])
        width = xp.ones_like(low)
        left, right = at(low + (1.0 - GOLDEN) * width), at(low + GOLDEN * width)
        for _ in range(SEARCH_STEPS):
            lower = left <= right
            low = xp.where(lower, low, low + (1.0 - GOLDEN) * width)
            width = GOLDEN * width
            fresh = at(low + xp.where(lower, 1.0 - GOLDEN, GOLDEN) * width)
            left, right = xp.where(lower, fresh, right), xp.where(lower, left, fresh)
        return best_of(xp, at, (low + 0.5 * width, xp.zeros_like(low), xp.ones_like(low)))

    # Rows of scenes

    @classmethod
    def from_box(cls, centre: Array, quaternion: Array, half: Array) -> Self:
        """Return a batch of shapes from the boxes of :meth:`box`, without checks.

        Args:
            centre: Shape (..., 3), [m].
            quaternion: Shape (..., 4).
            half: Half lengths of the boxes, shape (..., 3), [m].
        """
        own = object.__new__(cls)
        own.__dict__.update(position=centre, quaternion=quaternion, name="", **cls._of_half(half))
        return own

    @classmethod
    def geom_size(cls, half: Float) -> Float:
        """Return the sizes of MuJoCo geoms from the half lengths of the bounding boxes, shape (..., 3) both, [m]."""
        found, values = np.zeros(half.shape), cls._of_half(half)
        sizes = [values[name].reshape(*half.shape[:-1], -1) for name in cls.sizes]
        for i, size in enumerate(np.moveaxis(np.concatenate(sizes, axis=-1), -1, 0) if sizes else ()):
            found[..., i] = size
        return found

    @classmethod
    def bound(cls, half: Float) -> tuple[Float, Float]:
        """Return half-axis, in the shape's frame, and radius of a capsule that contains the shape, [m].

        Args:
            half: Half lengths of the bounding box, shape (..., 3), [m].
        """
        axis = np.where(np.arange(3) == half.argmax(axis=-1)[..., None], half, 0.0)
        return axis, norm(half - axis)

    @classmethod
    def _of_half(cls, half: Array) -> dict[str, Array]:
        """Return the parameters of shapes from the half lengths of their bounding boxes."""
        return {"size": half}

    def in_plane(self) -> tuple[Float, Float]:
        """Return :meth:`box` of an obstacle of an arm in the plane: as tall as TALL where its height does not matter.

        Raises:
            ValueError: The cross-section at the height 0 is not that of all heights.
        """
        centre, half = self.box()
        upright = abs(abs(self.rotation[2, 2]) - 1.0) < FLAT
        if abs(centre[2]) > FLAT or not upright:
            raise ValueError(
                f"{self.kind} must lie in the plane, with its centre at z = 0 and its z axis upright, got centre "
                f"{centre.tolist()} and quaternion {to_numpy(self.quaternion).tolist()}"
            )
        return centre, np.array([*half[:2], TALL])

    # Descriptions

    def require_single(self) -> None:
        """Raise ValueError for a batch of shapes."""
        for name, last in {**self.sizes, "position": (3,), "quaternion": (4,)}.items():
            if (got := tuple(getattr(self, name).shape)) != last:
                raise self._error(f"must be one shape here, got a batch: {name} has shape {got}")

    def footprint(self, extent: float = 2.0) -> list[Float]:
        """Return the outlines of the shape seen from above, shape (K, 2) each, [m].

        Args:
            extent: Greatest coordinate that is drawn of shapes without an end, [m].
        """
        del extent
        self.require_single()
        turn = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS, endpoint=False)
        outward = np.stack((np.cos(turn), np.sin(turn), np.zeros_like(turn)), axis=-1)
        matrix = self.rotation
        points = self.support(outward @ matrix) @ matrix.T + to_numpy(self.position)
        return [points[:, :2]]

    @abc.abstractmethod
    def geoms(self) -> list[Geom]:
        """Return the MuJoCo geoms that make up the shape."""

    def box(self) -> tuple[Float, Float]:
        """Return the bounding box along the frame's axes: its centre in the world and half lengths, shape (3,), [m]."""
        self.require_single()
        reach = self.support(np.concatenate((np.eye(3), -np.eye(3))))
        high, low = np.diagonal(reach[:3]), np.diagonal(reach[3:])
        return to_numpy(self.position) + self.rotation @ (0.5 * (high + low)), 0.5 * (high - low)

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as plain numbers and lists, with the kind as `shape`."""
        values = {n: getattr(self, n) for n in self.parameters() if n != "name" or self.name}
        return {
            "shape": self.kind,
            **{name: to_numpy(v).tolist() if hasattr(v, "shape") else v for name, v in values.items()},
        }

    @property
    def rotation(self) -> Float:
        """Axes of the frame as columns of a rotation matrix, shape (..., 3, 3)."""
        return np.stack([np.stack([to_numpy(c) for c in axis], axis=-1) for axis in self._axes], axis=-1)

    def support(self, directions: Float) -> Float:
        """Return the point of the shape that is farthest in each direction, in its frame, shape (K, 3), [m].

        Raises:
            TypeError: The shape has no end.
        """
        raise TypeError(f"{self.kind} has no farthest points")

    def _geom(self, geom: Any, *size: Any) -> list[Geom]:
        """Return one geom at the shape's pose."""
        self.require_single()
        x, y, z = (*(float(to_numpy(s)) for s in size), 0.0, 0.0, 0.0)[:3]
        return [Geom(geom, (x, y, z), to_numpy(self.position), to_numpy(self.quaternion))]

    # Parameters

    def _check(self) -> None:  # noqa: B027  (most shapes have nothing to check)
        """Check what parameters must fulfil together."""

    def _error(self, message: str) -> ValueError:
        """Return an error that names the shape."""
        return self._refusal(self.name, message)

    @classmethod
    def _refusal(cls, name: str, message: str) -> ValueError:
        """Return an error that names a shape before it exists."""
        return ValueError(f"{cls.kind}{f' {name!r}' if name else ''}: {message}")

    def _matched(self, radius: Array, **points: Array) -> tuple[Self, list[Array], Array]:
        """Return the shape, points by name, and a radius in one array library, dtype and device.

        Raises:
            ValueError: Something is not numeric or finite, the radius is negative, or shapes do not broadcast.
        """
        own, arrays = self._converted(points)
        radius = checked_radius(radius, arrays[0])
        leading = {name: tuple(array.shape[:-1]) for name, array in zip(points, arrays, strict=True)}
        for name, last in {**self.sizes, "position": (3,), "quaternion": (4,)}.items():
            shape = tuple(getattr(own, name).shape)
            leading[name] = shape[: len(shape) - len(last)]
        try:
            broadcast_batch(
                **leading, **({} if type(radius) is float else {"radius of the points": tuple(radius.shape)})
            )
        except ValueError as error:
            raise self._error(str(error)) from None
        return own, arrays, radius

    def _converted(self, points: Mapping[str, Array]) -> tuple[Self, list[Array]]:
        """Return the shape and points in one array library, dtype and device."""
        if all(
            type(p) is np.ndarray and p.dtype == np.float64 and p.shape[-1:] == (3,)
            for p in (*points.values(), self.position)
        ):
            return self, list(points.values())
        _, arrays = as_floats(**points)
        for array in arrays:
            if tuple(array.shape[-1:]) != (3,):
                raise self._error(f"points must have shape (..., 3), got shape {tuple(array.shape)}")
        own = self
        if type(arrays[0]) is np.ndarray and type(self.position) is not np.ndarray:
            arrays = [like(namespace_of(self.position), a, self.position) for a in arrays]
        elif type(arrays[0]) is not type(self.position) or arrays[0].dtype != self.position.dtype:
            own = object.__new__(type(self))
            own.__dict__.update(self.__dict__)
            own.__dict__.pop("_axes", None)
            xp = namespace_of(arrays[0])
            for name in (*self.sizes, "position", "quaternion"):
                value = getattr(self, name)
                # a copy, because torch warns of arrays that are read-only
                value = (
                    like(xp, value.copy(), arrays[0]) if type(value) is np.ndarray else value.to(arrays[0])
                )
                object.__setattr__(own, name, value)
        return own, arrays

    @functools.cached_property
    def _axes(self) -> tuple[Components, Components, Components]:
        """Components of the axes of the shape's frame."""
        return frame_axes(self.quaternion)

    def _placed(self, centre: Float, radius: Array) -> tuple[Array, Array]:
        """Return a sphere around a point of the shape's frame, with its centre in the world."""
        xp = namespace_of(self.position)
        moved = [
            self.position[..., i]
            + sum(float(c) * axis[i] for c, axis in zip(centre, self._axes, strict=True))
            for i in range(3)
        ]
        return xp.stack(moved, -1), radius + xp.zeros_like(moved[0])

    def _offset(self, points: Array) -> Components:
        """Return points relative to the position, in the world's axes."""
        return [points[..., i] - self.position[..., i] for i in range(3)]

    def _relative(self, points: Array) -> Components:
        """Return points in the shape's frame; a round shape may keep the axes of the world."""
        offset = self._offset(points)
        return [dot(offset, axis) for axis in self._axes]


def _with_gradient(xp: Namespace, function: Any, t: Array, least: Array) -> Array:
    """Return the least value of a convex function f of t with the gradient of the minimum.

    At a smooth minimum, the gradient is that of f at t. At a kink, such as a point that is equally far from two faces,
    it is the mean of the gradients before and behind, with weights for which the mean of the slopes is 0.
    """
    step = float(xp.finfo(t.dtype).eps) ** (1.0 / 3.0)
    before, behind = function(xp.clip(t - step, 0.0, 1.0)), function(xp.clip(t + step, 0.0, 1.0))
    with xp.no_grad():
        slopes = behind + before - 2.0 * least
        kink = (t > step) & (t < 1.0 - step) & (slopes > 0.0)
        weight = (behind - least) / xp.where(kink, slopes, 1.0)
    mean = weight * before + (1.0 - weight) * behind
    return xp.where(kink, least.detach() + mean - mean.detach(), least)


def checked_radius(radius: Any, points: Array) -> Array:
    """Return a radius, 0 or greater, as a number, or as an array like the points.

    Raises:
        ValueError: It is not numeric or finite, or is negative.
    """
    if type(radius) is float and 0.0 <= radius < np.inf:
        return radius
    xp, (array,) = as_floats(radius=radius)
    if not (array >= 0.0).all():
        raise ValueError(f"radius must be 0 or greater, got {radius!r:.60}")
    if type(points) is np.ndarray:
        return like(np, to_numpy(array), points)
    return like(namespace_of(points), array, points) if xp is np else array.to(points)


def length(vector: Components) -> Array:
    """Return the length of a vector, with a finite gradient at 0."""
    return namespace_of(vector[0]).sqrt(dot(vector, vector) + GUARD)


def blocks(number: int, width: int) -> Iterator[slice]:
    """Yield slices of `number` columns such that tables of `width` rows and so many columns stay in the cache."""
    step = max(BLOCK // max(width, 1), 1)
    yield from (slice(first, first + step) for first in range(0, number, step))


def bounds_of_points(points: Float) -> tuple[Float, float]:
    """Return centre and radius of a sphere that contains points, shape (K, 3)."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return centre, float(norm(points - centre).max())


def _unit(xp: Namespace, quaternion: Array) -> Array:
    """Return quaternions of length 1."""
    size = xp.sqrt(dot(*2 * ([quaternion[..., i] for i in range(4)],)))[..., None]
    if not (xp.abs(size - 1.0) <= UNIT_TOLERANCE).all():
        wrong = to_numpy(size).reshape(-1)
        wrong = wrong[np.abs(wrong - 1.0).argmax()]
        raise ValueError(f"quaternion must have length 1 (within {UNIT_TOLERANCE:g}), got length {wrong:.6g}")
    # A quaternion that has been normalised stays as it is, so that reading what was written changes nothing.
    exact = xp.abs(size - 1.0) <= 8.0 * float(xp.finfo(quaternion.dtype).eps)
    return xp.where(exact, quaternion, quaternion / size)
