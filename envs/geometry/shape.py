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
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from viapoint.envs.common.arrays import best_of, dot, frame_axes, frozen, norm
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array
from viapoint.primitives.array_api import broadcast_batch

UNIT_TOLERANCE = 1e-3
"""Greatest error of a quaternion's length; smaller ones are corrected."""
GUARD = 1e-24
"""Summand of squares below roots that divisors may be, [m^2]; it changes distances by at most 1e-12 m."""
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

Components = list[Float]
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
    is N spheres. They broadcast with the leading axes of points. Parameters are stored as read-only copies in double
    precision, in which all distances are computed.

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

    position: Any = (0.0, 0.0, 0.0)
    """Origin of the shape's frame in the world, shape (..., 3), [m]."""
    quaternion: Any = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z), shape (..., 4); its length is 1."""
    name: str = ""
    """Name for error messages."""

    def __post_init__(self) -> None:
        """Convert and check the parameters."""
        if not isinstance(self.name, str):
            raise ValueError(f"{self.kind}: name must be a string, got {self.name!r:.60}")
        try:
            values = {
                name: finite_array(name, getattr(self, name), (..., *last))
                for name, last in self._trailing().items()
            }
            for name in self.sizes:
                if not (values[name] > 0.0).all():
                    raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)!r}")
            values["quaternion"] = _unit(values["quaternion"])
            for name, value in values.items():
                object.__setattr__(self, name, frozen(value.copy()))
            broadcast_batch(**self._leading())
            self._check()
        except ValueError as error:
            raise self._error(str(error)) from None

    def __eq__(self, other: object) -> bool:
        """Return True for a shape of the same kind with the same parameters and name."""
        return type(self) is type(other) and all(
            np.array_equal(mine, theirs) if isinstance(mine, np.ndarray) else mine == theirs
            for mine, theirs in ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        )

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def parameters(cls) -> list[str]:
        """Return the names of the parameters, those of the pose last."""
        return [f.name for f in sorted(fields(cls), key=lambda f: bool(f.kw_only)) if f.init]

    # Distances

    def distance(self, points: Any, radius: Any = 0.0) -> Any:
        """Return the signed distance of points, or of spheres around them, shape (...,), [m].

        Args:
            points: Shape (..., 3), [m].
            radius: Radius of the spheres, [m].
        """
        (points,), radius = self._arguments(radius, points=points)
        return self._signed(self._relative(points)) - radius

    def segment_distance(self, first: Any, second: Any, radius: Any = 0.0) -> Any:
        """Return the least signed distance along segments, or capsules around them, shape (...,), [m].

        Args:
            first: One end of each segment, shape (..., 3), [m].
            second: The other end, [m]; it may be the same point.
            radius: Radius of the capsules, [m].
        """
        (first, second), radius = self._arguments(radius, first=first, second=second)
        start, end = self._relative(first), self._relative(second)
        way = [b - a for a, b in zip(start, end, strict=True)]
        # At least one axis; sizes may have more of them than the ends.
        share = self._nearest([a[None] for a in start], [u[None] for u in way])
        most = max((getattr(self, name).ndim - len(last) for name, last in self.sizes.items()), default=0)
        share = share if share.ndim <= most else share[0]
        return self._signed([a + share * u for a, u in zip(start, way, strict=True)]) - radius

    @property
    @abc.abstractmethod
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre, shape (..., 3), and radius, shape (...,), of a sphere that contains the shape, [m]."""

    @abc.abstractmethod
    def _signed(self, points: Components) -> Float:
        """Return the signed distance of points in the shape's frame."""

    def _nearest(self, start: Components, along: Components) -> Float:
        """Return t in [0, 1] for which the signed distance of start + t * along is least, in the shape's frame.

        Golden-section search. The least distance is exact to 5e-9 of the length of the segment, because the signed
        distance changes by at most the length of the way.
        """

        def at(share: Float) -> Float:
            return self._signed([a + share * u for a, u in zip(start, along, strict=True)])

        low = np.zeros_like(start[0] + along[0])
        width = np.ones_like(low)
        left, right = at(low + (1.0 - GOLDEN) * width), at(low + GOLDEN * width)
        for _ in range(SEARCH_STEPS):
            lower = left <= right
            low = np.where(lower, low, low + (1.0 - GOLDEN) * width)
            width = GOLDEN * width
            fresh = at(low + np.where(lower, 1.0 - GOLDEN, GOLDEN) * width)
            left, right = np.where(lower, fresh, right), np.where(lower, left, fresh)
        return best_of(at, (low + 0.5 * width, np.zeros_like(low), np.ones_like(low)))

    # Rows of scenes

    @classmethod
    def from_box(cls, centre: Float, quaternion: Float, half: Float) -> Self:
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
    def _of_half(cls, half: Float) -> dict[str, Float]:
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
                f"{centre.tolist()} and quaternion {self.quaternion.tolist()}"
            )
        return centre, np.array([*half[:2], TALL])

    # Descriptions

    def require_single(self) -> None:
        """Raise ValueError for a batch of shapes."""
        for name, leading in self._leading().items():
            if leading:
                got = getattr(self, name).shape
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
        points = self.support(outward @ matrix) @ matrix.T + self.position
        return [points[:, :2]]

    @abc.abstractmethod
    def geoms(self) -> list[Geom]:
        """Return the MuJoCo geoms that make up the shape."""

    def box(self) -> tuple[Float, Float]:
        """Return the bounding box along the frame's axes: its centre in the world and half lengths, shape (3,), [m]."""
        self.require_single()
        reach = self.support(np.concatenate((np.eye(3), -np.eye(3))))
        high, low = np.diagonal(reach[:3]), np.diagonal(reach[3:])
        return self.position + self.rotation @ (0.5 * (high + low)), 0.5 * (high - low)

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as plain numbers and lists, with the kind as `shape`."""
        values = {n: getattr(self, n) for n in self.parameters() if n != "name" or self.name}
        return {
            "shape": self.kind,
            **{name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()},
        }

    @property
    def rotation(self) -> Float:
        """Axes of the frame as columns of a rotation matrix, shape (..., 3, 3)."""
        return np.stack([np.stack(axis, axis=-1) for axis in self._axes], axis=-1)

    def support(self, directions: Float) -> Float:
        """Return the point of the shape that is farthest in each direction, in its frame, shape (K, 3), [m].

        Raises:
            TypeError: The shape has no end.
        """
        raise TypeError(f"{self.kind} has no farthest points")

    def _geom(self, geom: Any, *size: Any) -> list[Geom]:
        """Return one geom at the shape's pose."""
        self.require_single()
        x, y, z = (*map(float, size), 0.0, 0.0, 0.0)[:3]
        return [Geom(geom, (x, y, z), self.position, self.quaternion)]

    # Parameters

    def _check(self) -> None:  # noqa: B027  (most shapes have nothing to check)
        """Check what parameters must fulfil together."""

    def _error(self, message: str) -> ValueError:
        """Return an error that names the shape."""
        return ValueError(f"{self.kind}{f' {self.name!r}' if self.name else ''}: {message}")

    @classmethod
    def _trailing(cls) -> dict[str, tuple[int, ...]]:
        """Return the shape of one value of each parameter that may be a batch."""
        return {**cls.sizes, "position": (3,), "quaternion": (4,)}

    def _leading(self) -> dict[str, tuple[int, ...]]:
        """Return the leading axes of the parameters."""
        found = {}
        for name, last in self._trailing().items():
            shape = getattr(self, name).shape
            found[name] = shape[: len(shape) - len(last)]
        return found

    def _arguments(self, radius: Any, **points: Any) -> tuple[list[Float], Any]:
        """Return points by name, and a radius, as numbers that fit to one another and to the shape.

        Raises:
            ValueError: Something is not numeric or finite, the radius is negative, or shapes do not broadcast.
        """
        try:
            arrays = [_as_double(name, each) for name, each in points.items()]
            size = checked_radius(radius)
            leading = {name: array.shape[:-1] for name, array in zip(points, arrays, strict=True)}
            leading |= self._leading()
            if type(size) is not float:
                leading["radius of the points"] = size.shape
            broadcast_batch(**leading)
        except ValueError as error:
            raise self._error(str(error)) from None
        return arrays, size

    @functools.cached_property
    def _axes(self) -> tuple[Components, Components, Components]:
        """Components of the axes of the shape's frame."""
        return frame_axes(self.quaternion)

    def _placed(self, centre: Float, radius: Any) -> tuple[Float, Float]:
        """Return a sphere around a point of the shape's frame, with its centre in the world."""
        moved = [
            self.position[..., i]
            + sum(float(c) * axis[i] for c, axis in zip(centre, self._axes, strict=True))
            for i in range(3)
        ]
        return np.stack(moved, axis=-1), radius + np.zeros_like(moved[0])

    def _offset(self, points: Float) -> Components:
        """Return points relative to the position, in the world's axes."""
        return [points[..., i] - self.position[..., i] for i in range(3)]

    def _relative(self, points: Float) -> Components:
        """Return points in the shape's frame; a round shape may keep the axes of the world."""
        offset = self._offset(points)
        return [dot(offset, axis) for axis in self._axes]


def _as_double(name: str, values: Any) -> Float:
    """Return finite points, shape (..., 3); an array in double precision is not searched for infinite numbers."""
    if type(values) is np.ndarray and values.dtype == np.float64 and values.shape[-1:] == (3,):
        return values
    return finite_array(name, values, (..., 3))


def checked_radius(radius: Any) -> Any:
    """Return a radius, 0 or greater, as a number or an array.

    Raises:
        ValueError: It is not numeric or finite, or is negative.
    """
    if type(radius) is float and 0.0 <= radius < np.inf:
        return radius
    array = finite_array("radius", radius)
    if not (array >= 0.0).all():
        raise ValueError(f"radius must be 0 or greater, got {radius!r:.60}")
    return array


def length(vector: Components) -> Float:
    """Return the length of a vector."""
    return np.asarray(np.sqrt(dot(vector, vector) + GUARD))


def blocks(number: int, width: int) -> Iterator[slice]:
    """Yield slices of `number` columns such that tables of `width` rows and so many columns stay in the cache."""
    step = max(BLOCK // max(width, 1), 1)
    yield from (slice(first, first + step) for first in range(0, number, step))


def bounds_of_points(points: Float) -> tuple[Float, float]:
    """Return centre and radius of a sphere that contains points, shape (K, 3)."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return centre, float(norm(points - centre).max())


def _unit(quaternion: Float) -> Float:
    """Return quaternions of length 1."""
    parts = [quaternion[..., i] for i in range(4)]
    size = np.sqrt(dot(parts, parts))[..., None]
    off = np.abs(size - 1.0)
    if not (off <= UNIT_TOLERANCE).all():
        wrong = size.ravel()[off.argmax()]
        raise ValueError(f"quaternion must have length 1 (within {UNIT_TOLERANCE:g}), got length {wrong:.6g}")
    # A quaternion that has been normalised stays as it is, so that reading what was written changes nothing.
    exact = off <= 8.0 * np.finfo(np.float64).eps
    return np.where(exact, quaternion, quaternion / size)
