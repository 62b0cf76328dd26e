"""A chain of hinges: where its points are, and what torques move it.

Vectors have their three components first, apart in memory, so that every operation works on whole batches, and what is
constant and zero in a robot's dimensions is never multiplied. NumPy arrays and torch tensors alike.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import cosine_and_sine
from viapoint.primitives.array_api import Array, namespace_of

Vector = Array
"""Three components, an array of shape (3, ...) or three arrays."""
Constants = tuple[float, float, float]


class Frame(NamedTuple):
    """Where a joint's frame is: its axes, z along the joint, and its origin, in the world."""

    x: Vector
    y: Vector
    z: Vector
    origin: Vector

    def turned(self, vector: Constants) -> Vector:
        """A constant vector of this frame, in the world."""
        return _combined((self.x, self.y, self.z), vector)

    def place(self, point: Constants) -> Vector:
        """A constant point of this frame, in the world."""
        return self.origin + self.turned(point)


@dataclass(frozen=True, kw_only=True)
class Hinge:
    """A joint and everything that moves with it up to the next, in the joint's frame, whose z axis it turns about."""

    turn: tuple[Constants, Constants, Constants]
    """Axes x, y and z of the frame at angle 0, in the frame of the joint before."""
    offset: Constants
    """Origin of the frame, in the frame of the joint before, [m]."""
    mass: float
    """[kg]."""
    centre: Constants
    """Of mass, [m]."""
    inertia: tuple[Constants, Constants, Constants]
    """About the centre of mass, [kg m^2]."""

    @functools.cached_property
    def lever(self) -> Constants:
        """First moments of the mass about the frame's origin, [kg m]."""
        x, y, z = self.centre
        return self.mass * x, self.mass * y, self.mass * z

    @functools.cached_property
    def spread(self) -> tuple[Constants, ...]:
        """Second moments of the mass about the frame's origin, the integral of r r^T, [kg m^2]."""
        inertia, centre = np.array(self.inertia), np.array(self.centre)
        about_centre = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        return tuple(map(tuple, (about_centre + self.mass * np.outer(centre, centre)).tolist()))

    def inwards(self, vector: Vector, cosine: Array, sine: Array) -> Vector:
        """A vector of the frame before in this one."""
        x, y, z = (_combined(vector, axis) for axis in self.turn)
        return [cosine * x + sine * y, cosine * y - sine * x, z]

    def outwards(self, vector: Vector, cosine: Array, sine: Array) -> Vector:
        """A vector of this frame in the one before."""
        x, y, z = vector
        turned = cosine * x - sine * y, sine * x + cosine * y, z
        return [_combined(turned, weights) for weights in zip(*self.turn, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Hinges from the world on, one after the other."""

    hinges: tuple[Hinge, ...]

    def frames(self, joints: Array) -> list[Frame]:
        """Every joint's frame at angles of shape (..., J), [rad]."""
        xp = namespace_of(joints)
        frames: list[Frame] = []
        angles = xp.stack([joints[..., index] for index in range(len(self.hinges))], axis=0)
        cosines, sines = cosine_and_sine(angles)
        units = xp.reshape(xp.asarray(np.eye(3), dtype=joints.dtype), (3, 3, *[1] * (joints.ndim - 1)))
        before = Frame(units[0], units[1], units[2], xp.zeros_like(units[0]))
        for hinge, cosine, sine in zip(self.hinges, cosines, sines, strict=True):
            x, y, z = (before.turned(axis) for axis in hinge.turn)
            before = Frame(cosine * x + sine * y, cosine * y - sine * x, z, before.place(hinge.offset))
            frames.append(before)
        return frames

    def points(self, joints: Array, places: tuple[tuple[int, Constants], ...]) -> Array:
        """Points fixed to joints' frames, shape (..., P, 3), [m].

        Args:
            joints: Angles, shape (..., J), [rad].
            places: Index of the joint and point in its frame [m], P times.
        """
        xp = namespace_of(joints)
        frames = self.frames(joints)
        placed = [frames[index].place(point) for index, point in places]
        # Components apart in memory: they are mostly read one after the other.
        shape = (3, *joints.shape[:-1])
        whole = [part if part.shape == shape else xp.broadcast_to(part, shape) for part in placed]
        return xp.moveaxis(xp.stack(whole, axis=0), (0, 1), (-2, -1))

    def torques(self, joints: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
        """What moves the chain, and what only holds it against gravity, shape (..., J) each, [N m].

        The recursive Newton-Euler equations (Luh, Walker and Paul 1980) in the joints' frames, without gravity; then
        gravity alone.

        Args:
            joints: Angles, shape (..., J), [rad].
            rates: Their first derivatives, likewise, [rad/s].
            accelerations: Their second derivatives, likewise, [rad/s^2].
        """
        xp = namespace_of(joints)
        each = range(len(self.hinges))
        turns = list(zip(*cosine_and_sine(xp.stack([joints[..., i] for i in each], axis=0)), strict=True))
        forces, moments, ups = self._inertial(turns, rates, accelerations)
        moving, holding = [], []
        force, moment, lever, weight = forces[-1], moments[-1], list(self.hinges[-1].lever), 0.0
        for index in reversed(each):
            hinge, up = self.hinges[index], ups[index]
            moving.append(moment[2])
            holding.append(GRAVITY * (lever[0] * up[1] - lever[1] * up[0]))
            if index:
                before = self.hinges[index - 1]
                weight += hinge.mass
                force, moment, lever = (
                    hinge.outwards(part, *turns[index]) for part in (force, moment, lever)
                )
                moment = _sum(_sum(moment, _cross(hinge.offset, force)), moments[index - 1])
                force = _sum(force, forces[index - 1])
                lever = [
                    a + weight * b + c for a, b, c in zip(lever, hinge.offset, before.lever, strict=True)
                ]
        return xp.stack(moving[::-1], axis=-1), xp.stack(holding[::-1], axis=-1)

    def _inertial(
        self, turns: list[tuple[Array, Array]], rates: Array, accelerations: Array
    ) -> tuple[list[Vector], list[Vector], list[Vector]]:
        """Force on each link and moment about its joint that its motion takes, and the vertical, in its joint's frame.

        A point r of a link is accelerated by a + A r, with A = [w]x [w]x + [dw/dt]x. So force and moment are m a + A s
        and s x a + the skew part of A S, with the first and second moments s and S of its mass.
        """
        spin, turn, pull, up = [0.0] * 3, [0.0] * 3, [0.0] * 3, [0.0, 0.0, 1.0]
        swept: list[Vector] = [[0.0] * 3] * 3
        forces, moments, ups = [], [], []
        for index, hinge in enumerate(self.hinges):
            pull = [a + _combined(row, hinge.offset) for a, row in zip(pull, swept, strict=True)]
            spin, turn, pull, up = (hinge.inwards(part, *turns[index]) for part in (spin, turn, pull, up))
            rate = rates[..., index]
            turn = [turn[0] + rate * spin[1], turn[1] - rate * spin[0], turn[2] + accelerations[..., index]]
            spin = [spin[0], spin[1], spin[2] + rate]
            swept = _swept(spin, turn)
            forces.append(
                [hinge.mass * a + _combined(row, hinge.lever) for a, row in zip(pull, swept, strict=True)]
            )
            (a, b, c), (x, y, z) = swept, hinge.spread
            pairs = ((c, y, b, z), (a, z, c, x), (b, x, a, y))
            skew = [_combined(p, u) - _combined(q, v) for p, u, q, v in pairs]
            moments.append(_sum(_cross(hinge.lever, pull), skew))
            ups.append(up)
        return forces, moments, ups


GRAVITY = 9.81
"""[m/s^2], downwards along z."""


def _swept(spin: Vector, turn: Vector) -> list[Vector]:
    """Rows of the matrix that makes a point's acceleration of its place, in a body that turns about the origin."""
    (x, y, z), (u, v, w) = spin, turn
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return [[-yy - zz, xy - w, xz + v], [xy + w, -xx - zz, yz - u], [xz - v, yz + u, -xx - yy]]


def _combined(axes: Any, weights: Constants) -> Any:
    """Sum of axes, or components, times constant weights, where these are not zero."""
    used = [(axis, weight) for axis, weight in zip(axes, weights, strict=True) if weight != 0.0]
    return _added([axis if weight == 1.0 else weight * axis for axis, weight in used] or [0.0 * axes[0]])


def _sum(first: Vector, second: Vector) -> Vector:
    return [a + b for a, b in zip(first, second, strict=True)]


def _added(parts: list[Array]) -> Array:
    return functools.reduce(operator.add, parts)


def _cross(place: Constants, vector: Vector) -> Vector:
    x, y, z = place
    return [_combined(vector, weights) for weights in ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))]
