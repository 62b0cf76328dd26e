"""Boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from viapoint.envs.common.arrays import dot, safe_ratio
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.segments import lowest_of_lines
from viapoint.envs.geometry.shape import CONTACT, Components, Geom, Shape, length


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """Box around its position, with faces along the axes of its frame.

    Example:
        >>> from viapoint.envs import Box
        >>> table = Box((0.4, 0.6, 0.02), position=(0.5, 0.0, 0.2), name="table")  # 0.8 m x 1.2 m x 4 cm
        >>> table.distance([[0.5, 0.0, 0.3], [0.5, 0.1, 0.21]]).round(3).tolist()
        [0.08, -0.01]
        >>> table.segment_distance([1.1, 0.0, 0.2], [1.0, 0.0, 0.5], radius=0.05).round(3).item()
        0.133
    """

    kind: ClassVar[str] = "box"
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {"size": (3,)}

    size: Any
    """Half lengths along the axes of the frame, shape (..., 3), [m]."""

    @property
    def bounding_sphere(self) -> tuple[Float, Float]:
        """Centre and radius, [m]."""
        return self.position, np.sqrt(dot(self._half, self._half))

    def geoms(self) -> list[Geom]:
        """Return one MuJoCo box."""
        return self._geom(mujoco.mjtGeom.mjGEOM_BOX, *self._half)

    @property
    def _half(self) -> Components:
        return [self.size[..., i] for i in range(3)]

    def _signed(self, points: Components) -> Float:
        return _signed(points, self._half)

    def _nearest(self, start: Components, along: Components) -> Float:
        """Return t in [0, 1] for which the signed distance is least, exactly.

        Outside, half the derivative of the squared distance is sum_i along_i excess_i(t), where excess_i is how far the
        point is beyond the box along axis i. It rises with t, and is linear between the six values of t at which the
        line crosses a plane of a face, so its root follows from the two of these values around it. A segment that
        enters the box has its deepest point where two of the planes are equally far: a problem of six lines.
        """
        vectors = list(np.broadcast_arrays(*start, *along, *self._half))
        falling, rising = _rise(vectors, 0.0), _rise(vectors, 1.0)
        t = np.where(falling >= 0.0, 0.0, 1.0)
        between = (falling < 0.0) & (rising > 0.0)
        if between.any():
            t[between] = _root([each[between] for each in vectors], falling[between], rising[between])
        start, along, half = vectors[:3], vectors[3:6], vectors[6:]
        inside = _signed([p + t * u for p, u in zip(start, along, strict=True)], half) < CONTACT
        if inside.any():
            some = [each[inside] for each in (*start, *along, *half)]
            lines = [(u, p - h) for p, u, h in zip(some[:3], some[3:6], some[6:], strict=True)]
            lines += [(-u, -p - h) for p, u, h in zip(some[:3], some[3:6], some[6:], strict=True)]
            t[inside] = lowest_of_lines(*(np.stack(each) for each in zip(*lines, strict=True)))
        return t

    def support(self, directions: Float) -> Float:
        """Return the farthest points; see :meth:`Shape.support`."""
        return np.asarray(np.sign(directions) * self.size)


def _rise(vectors: Components, t: Any) -> Float:
    """Return half the derivative by t of the squared distance from a box; components of start, along and half sizes."""
    start, along, half = vectors[:3], vectors[3:6], vectors[6:]
    places = [p + t * u for p, u in zip(start, along, strict=True)]
    return np.asarray(dot(along, [q - q.clip(-h, h) for q, h in zip(places, half, strict=True)]))


def _root(vectors: Components, falling: Float, rising: Float) -> Float:
    """Return where :func:`_rise` is 0, if it is `falling` < 0 at t = 0 and `rising` > 0 at t = 1."""
    low, high = np.zeros_like(falling), np.ones_like(falling)
    for p, u, h in zip(vectors[:3], vectors[3:6], vectors[6:], strict=True):
        for face in (-h, h):
            t = safe_ratio(face - p, u).clip(0.0, 1.0)
            at = _rise(vectors, t)
            later, sooner = (at < 0.0) & (t > low), (at >= 0.0) & (t < high)
            low, falling = np.where(later, t, low), np.where(later, at, falling)
            high, rising = np.where(sooner, t, high), np.where(sooner, at, rising)
    return (low + (high - low) * safe_ratio(falling, falling - rising)).clip(0.0, 1.0)


def _signed(points: Components, half: Components) -> Float:
    """Return the signed distance of points from a box with given half lengths."""
    x, y, z = (np.abs(p) - h for p, h in zip(points, half, strict=True))
    outside = [np.maximum(each, 0.0) for each in (x, y, z)]
    inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
    return length(outside) + inside
