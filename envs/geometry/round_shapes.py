"""Spheres and capsules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import in_space, norm, quaternion_to
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.segments import nearest_to_origin, point_axis_squared, segment_axis_squared
from viapoint.envs.geometry.shape import FLAT, GUARD, Components, Geom, Shape, length


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    """Sphere around its position.

    Example:
        >>> from viapoint.envs import Sphere
        >>> ball = Sphere(0.05, position=(0.4, 0.0, 0.3))
        >>> ball.distance([0.4, 0.0, 0.5], radius=0.03).round(3).item()  # of a sphere of 3 cm, [m]
        0.12
    """

    kind: ClassVar[str] = "sphere"
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": ()}
    round: ClassVar[bool] = True

    radius: Any
    """Shape (...,), [m]."""

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre and radius, [m]."""
        return self.position, self.radius

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo sphere."""
        return self._geom(mujoco.mjtGeom.mjGEOM_SPHERE, self.radius)

    @classmethod
    def bound(cls, half: Float) -> tuple[Float, Float]:
        """Return the sphere itself; see :meth:`Shape.bound`."""
        return np.zeros_like(half), half[..., 0]

    def in_plane(self) -> tuple[Float, Float]:
        """Return the box of a sphere in the plane; see :meth:`Shape.in_plane`."""
        centre, half = self.box()
        if abs(centre[2]) > FLAT:
            raise ValueError(f"sphere must lie in the plane, with z = 0, got centre {centre.tolist()}")
        return centre, half

    @classmethod
    def _of_half(cls, half: Float) -> dict[str, Float]:
        return {"radius": half[..., 0]}

    def _relative(self, points: Float) -> Components:
        offset = self._offset(points)
        if self.quaternion.ndim == 1:
            return offset
        return [part + 0.0 * self.quaternion[..., 0] for part in offset]  # they turn nothing, but are a batch

    def _signed(self, points: Components) -> Float:
        return np.asarray(length(points) - self.radius)

    def _nearest(self, start: Components, along: Components) -> Float:
        return nearest_to_origin(start, along)

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        return np.asarray(self.radius * directions)


@dataclass(frozen=True, eq=False)
class Capsule(Shape):
    """Capsule around a part of its z axis: all points within a radius of the segment.

    Example:
        >>> from viapoint.envs import Capsule
        >>> bar = Capsule.between((0.2, -0.1, 0.3), (0.2, 0.1, 0.3), radius=0.02)
        >>> bar.distance([0.5, 0.0, 0.3]).round(3).item()
        0.28
        >>> bar.segment_distance([0.5, 0.0, 0.3], [0.3, 0.0, 0.3], radius=0.05).round(3).item()
        0.03
    """

    kind: ClassVar[str] = "capsule"
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": (), "half_length": ()}
    round: ClassVar[bool] = True

    radius: Any
    """Shape (...,), [m]."""
    half_length: Any
    """Half length of the segment, shape (...,), [m]."""

    @classmethod
    def between(cls, first: Any, second: Any, radius: Any, name: str = "") -> Self:
        """Return the capsule around the segment between two points.

        Args:
            first: One end, shape (3,), or (2,) for an obstacle in the plane, [m].
            second: The other end, [m].
            radius: [m].
            name: Name for error messages.
        """
        first = in_space(finite_array("first", first, (3,), (2,)))
        second = in_space(finite_array("second", second, (3,), (2,)))
        half = 0.5 * (second - first)
        turn, size = quaternion_to(half), norm(half)
        if not 0.0 < size < np.inf:
            raise ValueError(
                f"ends must be different, got {first.tolist()} and {second.tolist()}; a capsule without a length is a "
                "Sphere"
            )
        return cls(radius, size, position=0.5 * (first + second), quaternion=turn, name=name)

    @property
    def half_axis(self) -> Float:
        """Vector from the centre to one end of the segment, shape (..., 3), [m]."""
        return np.stack(self._half_axis, axis=-1)

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre and radius, [m]."""
        return self.position, self.radius + self.half_length

    def segment_distance(self, first: Any, second: Any, radius: Any = 0.0) -> Any:
        """Return the distance from segments; see :meth:`Shape.segment_distance`."""
        (first, second), radius = self._arguments(radius, first=first, second=second)
        start, half = self._offset(first), self._half_axis
        gap = [p + h for p, h in zip(start, half, strict=True)]
        link = [second[..., i] - first[..., i] for i in range(3)]
        squared = segment_axis_squared(gap, link, [2.0 * h for h in half])
        return np.sqrt(squared + GUARD) - self.radius - radius

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo capsule."""
        return self._geom(mujoco.mjtGeom.mjGEOM_CAPSULE, self.radius, self.half_length)

    @classmethod
    def bound(cls, half: Float) -> tuple[Float, Float]:
        """Return the capsule itself; see :meth:`Shape.bound`."""
        return np.array([0.0, 0.0, 1.0]) * (half[..., 2:] - half[..., :1]), half[..., 0]

    def in_plane(self) -> tuple[Float, Float]:
        """Return the box of a capsule in the plane; see :meth:`Shape.in_plane`."""
        centre, half = self.box()
        if max(abs(centre[2]), abs(float(self.half_axis[2]))) > FLAT:
            raise ValueError(
                f"capsule must lie in the plane, with z = 0 and without a rise, got centre {centre.tolist()} and "
                f"half-axis {self.half_axis.tolist()}"
            )
        return centre, half

    @classmethod
    def _of_half(cls, half: Float) -> dict[str, Float]:
        return {"radius": half[..., 0], "half_length": half[..., 2] - half[..., 0]}

    @property
    def _half_axis(self) -> Components:
        return [self.half_length * c for c in self._axes[2]]

    def _relative(self, points: Float) -> Components:
        return self._offset(points)

    def _signed(self, points: Components) -> Float:
        squared = point_axis_squared(points, self._half_axis)
        return np.asarray(np.sqrt(squared + GUARD) - self.radius)

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        ends = np.sign(directions[:, 2:]) * np.array([0.0, 0.0, float(self.half_length)])
        return np.asarray(self.radius * directions + ends)
