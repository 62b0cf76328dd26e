"""Point clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from viapoint.envs.common.arrays import TINY, frozen
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array, number_of_at_least
from viapoint.envs.geometry.shape import (
    OUTLINE_POINTS,
    Components,
    Geom,
    Shape,
    blocks,
    bounds_of_points,
    length,
)

LEAST_SPACING = 1e-6
"""Least edge of the cubes of :meth:`PointCloud.covering`, [m]."""


@dataclass(frozen=True, eq=False)
class PointCloud(Shape):
    """Spheres of one radius around points, as a depth camera sees them; the pose may be a batch.

    The signed distance is that of the nearest sphere. Inside overlapping spheres this is at most the depth below the
    surface of their union.

    Example:
        >>> from viapoint.envs import PointCloud
        >>> cloud = PointCloud([(0.4, 0.0, 0.2), (0.4, 0.02, 0.2), (0.42, 0.0, 0.21)], radius=0.01)
        >>> cloud.distance([0.4, 0.0, 0.3]).round(4).item()
        0.0822
        >>> len(PointCloud.covering(cloud.points, spacing=0.05).points)  # fewer and larger spheres
        1
    """

    kind: ClassVar[str] = "point_cloud"
    in_scenes: ClassVar[bool] = False
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": ()}

    points: Any
    """Shape (K, 3), [m]."""
    radius: Any = 0.01
    """Radius of the spheres, [m]."""

    @classmethod
    def covering(cls, points: Any, spacing: float, radius: float = 0.0, **pose: Any) -> Self:
        """Return a cloud of fewer points whose spheres contain those around the given points.

        The space is divided into cubes; one sphere encloses each cube that holds a point.

        Args:
            points: Shape (K, 3), [m].
            spacing: Edge of the cubes, [m].
            radius: Radius of the spheres around the given points, [m].
            **pose: `position`, `quaternion` and `name`.
        """
        number_of_at_least("spacing", spacing, LEAST_SPACING)
        number_of_at_least("radius", radius, 0.0)
        given = cls(points, **pose).points
        cubes = np.unique(np.floor(given / spacing), axis=0)
        return cls((cubes + 0.5) * spacing, radius=0.5 * np.sqrt(3.0) * spacing + radius, **pose)

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre and radius, [m]."""
        centre, size = bounds_of_points(self.points)
        return self._placed(centre, size + self.radius)

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo sphere for each point."""
        (geom,) = self._geom(mujoco.mjtGeom.mjGEOM_SPHERE, self.radius)
        places = self.points @ self.rotation.T + self.position
        return [geom._replace(position=place) for place in places]

    def footprint(self, extent: float = 2.0) -> list[Float]:
        """Return a circle for each point; see :meth:`Shape.footprint`."""
        del extent
        turn = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS // 8, endpoint=False)
        circle = float(self.radius) * np.stack((np.cos(turn), np.sin(turn)), axis=-1)
        return [geom.position[:2] + circle for geom in self.geoms()]

    def _check(self) -> None:
        if self.radius.shape:
            raise ValueError(f"radius must be one number for all points, got shape {self.radius.shape}")
        points = finite_array("points", self.points, (None, 3))
        object.__setattr__(self, "points", frozen(points.copy()))

    def _signed(self, points: Components) -> Float:
        parts = np.stack(np.broadcast_arrays(*points))
        flat = parts.reshape(3, -1)
        offset = flat - self._nearest_points(flat)
        return np.asarray(length(list(offset)).reshape(parts.shape[1:]) - self.radius)

    def _nearest_points(self, points: Float) -> Float:
        """Return the points of the cloud that are nearest to other points, shape (3, M) both."""
        nearest = np.empty_like(points)
        square = (self.points * self.points).sum(axis=1)[:, None]
        for some in blocks(points.shape[1], len(self.points)):
            # |p - q|^2 without |p|^2, which is common to all points of the cloud
            index = (square - 2.0 * (self.points @ points[:, some])).argmin(axis=0)
            nearest[:, some] = self.points[index].T
        return nearest

    def _nearest(self, start: Components, along: Components) -> Float:
        """Return t in [0, 1] for which the segment is nearest to a point of the cloud, exactly."""
        vectors = np.stack(np.broadcast_arrays(*start, *along))
        flat = vectors.reshape(6, -1)
        found = np.zeros(flat.shape[1])
        for some in blocks(len(found), 8 * len(self.points)):
            gap = [q[:, None] - p for q, p in zip(self.points.T, flat[:3, some], strict=True)]
            link = flat[3:, some]
            square = np.maximum((link * link).sum(axis=0), TINY)
            t = (sum(g * u for g, u in zip(gap, link, strict=True)) / square).clip(0.0, 1.0)
            squared = sum(np.square(g - t * u) for g, u in zip(gap, link, strict=True))
            found[some] = t[squared.argmin(axis=0), np.arange(t.shape[1])]
        return found.reshape(vectors.shape[1:])

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        farthest = self.points[(directions @ self.points.T).argmax(axis=1)]
        return np.asarray(farthest + float(self.radius) * directions)
