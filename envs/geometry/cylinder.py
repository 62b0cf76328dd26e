"""Cylinders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from viapoint.envs.common.arrays import best_of, safe_ratio
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.shape import CONTACT, Components, Geom, Shape, length

NEWTON_STEPS = 12
"""Steps of the safeguarded Newton iteration for segments beside the rim."""


@dataclass(frozen=True, eq=False)
class Cylinder(Shape):
    """Solid cylinder around a part of its z axis, with flat ends.

    Example:
        >>> from viapoint.envs import Cylinder
        >>> can = Cylinder(0.03, 0.06, position=(0.5, 0.1, 0.06))  # 12 cm high
        >>> can.distance([[0.5, 0.1, 0.2], [0.5, 0.1, 0.06]]).round(3).tolist()
        [0.08, -0.03]
    """

    kind: ClassVar[str] = "cylinder"
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"radius": (), "half_length": ()}
    round: ClassVar[bool] = True

    radius: Any
    """Shape (...,), [m]."""
    half_length: Any
    """Half length along the z axis, shape (...,), [m]."""

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre and radius, [m]."""
        square = self.radius * self.radius + self.half_length * self.half_length
        return self.position, np.sqrt(square)

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo cylinder."""
        return self._geom(mujoco.mjtGeom.mjGEOM_CYLINDER, self.radius, self.half_length)

    @classmethod
    def bound(cls, half: Float) -> tuple[Float, Float]:
        """Return the capsule around the cylinder's axis; see :meth:`Shape.bound`."""
        return np.array([0.0, 0.0, 1.0]) * half[..., 2:], half[..., 0]

    @classmethod
    def _of_half(cls, half: Float) -> dict[str, Float]:
        return {"radius": half[..., 0], "half_length": half[..., 2]}

    def _signed(self, points: Components) -> Float:
        return _signed(points, self.radius, self.half_length)

    def _nearest(self, start: Components, along: Components) -> Float:
        """Return t in [0, 1] for which the signed distance is least.

        Outside, half the derivative of the squared distance rises with t. It is smooth between the values of t at
        which the line crosses the side or the plane of an end; between two of these values, its root follows by
        Newton's method, kept within the bracket. Inside, the deepest point is a minimum of the distance from the axis,
        the middle plane, or a place that is equally far from the side and an end: a quadratic equation.
        """
        x, y, z, dx, dy, dz, radius, half = np.broadcast_arrays(*start, *along, self.radius, self.half_length)
        line = _Line((x, y, z), (dx, dy, dz), radius, half)
        t = line.nearest_outside()
        inside = line.signed(t) < CONTACT
        if inside.any():
            start, along = ([part[inside] for part in each] for each in (line.start, line.along))
            part = _Line(tuple(start), tuple(along), radius[inside], half[inside])
            t[inside] = best_of(part.signed, (t[inside], *part.deepest()))
        return t

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        flat = directions * np.array([1.0, 1.0, 0.0])
        size = np.sqrt((flat * flat).sum(axis=-1, keepdims=True))
        side = float(self.radius) * flat / np.where(size > 0.0, size, 1.0)
        return np.asarray(side + np.sign(directions) * np.array([0.0, 0.0, float(self.half_length)]))


def _signed(points: Components, radius: Float, half: Float) -> Float:
    """Return the signed distance of points from a cylinder around the z axis."""
    side = length(points[:2]) - radius
    end = np.abs(points[2]) - half
    outside = length([np.maximum(side, 0.0), np.maximum(end, 0.0)])
    return outside + np.minimum(np.maximum(side, end), 0.0)


@dataclass(frozen=True)
class _Line:
    """Lines start + t * along beside cylinders of a radius and a half length around the z axis."""

    start: tuple[Float, ...]
    along: tuple[Float, ...]
    radius: Float
    half: Float

    def signed(self, t: Float) -> Float:
        """Return the signed distance at t."""
        return _signed(
            [p + t * u for p, u in zip(self.start, self.along, strict=True)], self.radius, self.half
        )

    def nearest_outside(self) -> Float:
        """Return t in [0, 1] for which the distance is least, or any t inside."""
        z, dz = self.start[2], self.along[2]
        low, high = np.zeros_like(z), np.ones_like(z)
        falling, rising = self.rise(low)[0], self.rise(high)[0]
        ends = np.where(falling >= 0.0, low, high)
        within = (falling < 0.0) & (rising > 0.0)
        crossings = (
            safe_ratio(-self.half - z, dz),
            safe_ratio(self.half - z, dz),
            *self.crossings(self.radius, 0.0),
        )
        for crossing in crossings:
            t = crossing.clip(0.0, 1.0)
            at, _ = self.rise(t)
            later, sooner = (at < 0.0) & (t > low), (at >= 0.0) & (t < high)
            low, falling = np.where(later, t, low), np.where(later, at, falling)
            high, rising = np.where(sooner, t, high), np.where(sooner, at, rising)
        bracket = low, high
        t = low + (high - low) * safe_ratio(falling, falling - rising)
        for _ in range(NEWTON_STEPS):
            at, slope = self.rise(t)
            low, high = np.where(at < 0.0, t, low), np.where(at < 0.0, high, t)
            step = t - safe_ratio(at, slope)
            t = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        # The derivative jumps in slope where the line crosses an end, which rounding may put just beyond the bracket.
        return best_of(self.signed, (np.where(within, t, ends).clip(0.0, 1.0), *bracket))

    def rise(self, t: Float) -> tuple[Float, Float]:
        """Return half the first and second derivative of the squared distance at t."""
        dx, dy, dz = self.along
        x, y, z = (p + t * u for p, u in zip(self.start, self.along, strict=True))
        from_axis = length([x, y])
        outward = x * dx + y * dy  # half the derivative of the squared distance from the axis
        beside = from_axis > self.radius
        share = np.where(beside, 1.0 - self.radius / from_axis, 0.0)
        bent = np.where(beside, self.radius * outward * outward / (from_axis * from_axis * from_axis), 0.0)
        beyond = z - z.clip(-self.half, self.half)
        return (
            share * outward + beyond * dz,
            share * (dx * dx + dy * dy) + bent + np.where(beyond != 0.0, dz * dz, 0.0),
        )

    def crossings(self, radius: Float, cone: float) -> tuple[Float, Float]:
        """Return t at which the distance from the axis is radius + cone * z, twice; any number where it never is."""
        (x, y, z), (dx, dy, dz) = self.start, self.along
        level, steep = radius + cone * z, cone * dz
        a = dx * dx + dy * dy - steep * steep
        b = x * dx + y * dy - level * steep
        c = x * x + y * y - level * level
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        q = -(b + np.where(b < 0.0, -root, root))  # without cancellation
        return safe_ratio(q, a), safe_ratio(c, q)

    def deepest(self) -> tuple[Float, ...]:
        """Return candidates for t of the least signed distance of segments that enter the cylinder."""
        (x, y, z), (dx, dy, dz) = self.start, self.along
        depth = self.radius - self.half
        found = (
            safe_ratio(-(x * dx + y * dy), dx * dx + dy * dy),
            safe_ratio(-z, dz),
            *self.crossings(depth, 1.0),
            *self.crossings(depth, -1.0),
        )
        return *(t.clip(0.0, 1.0) for t in found), np.zeros_like(x), np.ones_like(x)
