"""Half-spaces: floors and walls without an end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import quaternion_to
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.shape import FLAT, Components, Geom, Shape

EXTENT = 1.0
"""Half length of the cube that stands for a half-space in rows of numbers, [m]."""
REACH = 5.0
"""Radius of a sphere about that cube, beyond which no arm reaches, [m]."""


@dataclass(frozen=True, eq=False)
class HalfSpace(Shape):
    """Solid below the plane through its position; the z axis of its frame is the outward normal.

    Example:
        >>> from viapoint.envs import HalfSpace
        >>> floor = HalfSpace(position=(0.0, 0.0, -0.1))
        >>> wall = HalfSpace.facing((-1.0, 0.0, 0.0), position=(0.8, 0.0, 0.0))  # all points with x > 0.8
        >>> point = [0.5, 0.0, 0.4]
        >>> floor.distance(point).item(), wall.distance(point).round(3).item()
        (0.5, 0.3)
    """

    kind: ClassVar[str] = "half_space"
    only_half: ClassVar[tuple[float, float, float]] = (EXTENT, EXTENT, EXTENT)
    round: ClassVar[bool] = True

    @classmethod
    def facing(cls, normal: Any, position: Any = (0.0, 0.0, 0.0), name: str = "") -> Self:
        """Return the half-space of an outward normal.

        Args:
            normal: Shape (3,), of any length.
            position: A point of the surface, shape (3,), [m].
            name: Name for error messages.
        """
        outward = finite_array("normal", normal, (3,))
        longest = np.abs(outward).max()
        if longest == 0.0:
            raise ValueError(f"normal must not be zero, got {outward.tolist()}")
        return cls(position=position, quaternion=quaternion_to(outward / longest), name=name)

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Position and infinity: no sphere contains a half-space."""
        return self.position, np.full_like(self.position[..., 0], np.inf)

    def footprint(self, extent: float = 2.0) -> list[Float]:
        """Return the part of a square of half length `extent` that is solid at the height 0; nothing if it is empty."""
        corners = extent * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        normal = self.rotation[:, 2]
        height = corners @ normal[:2] - normal @ self.position
        outline = []
        for i in range(4):  # Sutherland & Hodgman, Reentrant polygon clipping, 1974
            if height[i] <= 0.0:
                outline.append(corners[i])
            if height[i] * height[i - 3] < 0.0:
                share = height[i] / (height[i] - height[i - 3])
                outline.append(corners[i] + share * (corners[i - 3] - corners[i]))
        return [np.array(outline)] if outline else []

    def box(self) -> tuple[Float, Float]:
        """Return the cube of half length EXTENT below the point of the surface that is nearest to the origin."""
        normal = self.rotation[:, 2]
        return (self.position @ normal - EXTENT) * normal, np.full(3, EXTENT)

    @classmethod
    def from_box(cls, centre: Float, quaternion: Float, half: Float) -> Self:
        """Return half-spaces from the cubes of :meth:`box`; see :meth:`Shape.from_box`."""
        own = super().from_box(centre, quaternion, half)
        depth = half[..., 2]
        position = [centre[..., i] + depth * axis for i, axis in enumerate(own._axes[2])]
        object.__setattr__(own, "position", np.stack(position, axis=-1))
        return own

    @classmethod
    def bound(cls, half: Float) -> tuple[Float, Float]:
        """Return a sphere that contains all of the half-space that an arm can reach; see :meth:`Shape.bound`."""
        return np.zeros_like(half), np.full_like(half[..., 0], REACH)

    def in_plane(self) -> tuple[Float, Float]:
        """Return the box of a half-space that is bounded by a line in the plane; see :meth:`Shape.in_plane`."""
        if abs(self.rotation[2, 2]) > FLAT:
            raise ValueError(
                f"half_space must have a horizontal normal in the plane, got {self.rotation[:, 2].tolist()}"
            )
        return self.box()

    @classmethod
    def _of_half(cls, half: Float) -> dict[str, Float]:
        del half
        return {}

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo plane."""
        return self._geom(mujoco.mjtGeom.mjGEOM_PLANE, 0.0, 0.0, 0.01)

    def _relative(self, points: Float) -> Components:
        offset, normal = self._offset(points), self._axes[2]
        return [offset[0] * normal[0] + offset[1] * normal[1] + offset[2] * normal[2]]

    def _signed(self, points: Components) -> Float:
        return points[0]

    def _nearest(self, start: Components, along: Components) -> Float:
        return np.where(along[0] < 0.0, 1.0, 0.0)
