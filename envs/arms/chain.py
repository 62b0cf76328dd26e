"""A chain of hinges: where its points are, and what torques move it.

Vectors have their three components first, apart in memory, so that every operation works on whole batches, and what is
constant and zero in a robot's dimensions is never multiplied. NumPy arrays and torch tensors alike.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viapoint.envs._arrays import Array, cosine_and_sine, namespace_of

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

        The recursive Newton-Euler equations (Luh, Walker and Paul 1980) without gravity; then gravity alone.

        Args:
            joints: Angles, shape (..., J), [rad].
            rates: Their first derivatives, likewise, [rad/s].
            accelerations: Their second derivatives, likewise, [rad/s^2].
        """
        xp = namespace_of(joints)
        frames = self.frames(joints)
        centres = [frame.place(hinge.centre) for frame, hinge in zip(frames, self.hinges, strict=True)]
        forces, moments = self._inertial(frames, centres, rates, accelerations)
        moving, holding = [], []
        nothing: Vector = [0.0, 0.0, 0.0]
        force, moment, weight, lever = nothing, nothing, 0.0, nothing
        for index in reversed(range(len(self.hinges))):
            frame, centre, hinge = frames[index], centres[index], self.hinges[index]
            # Moments are taken about the origin of the world, where those of further links simply add up.
            force = _sum(force, forces[index])
            moment = _sum(moment, _sum(moments[index], _cross(centre, forces[index])))
            weight, lever = weight + hinge.mass, _sum(lever, [hinge.mass * part for part in centre])
            moving.append(_dot(frame.z, _less(moment, _cross(frame.origin, force))))
            hanging = [part - weight * at for part, at in zip(lever, frame.origin, strict=True)]
            holding.append(GRAVITY * (frame.z[1] * -hanging[0] + frame.z[0] * hanging[1]))
        zero = 0.0 * joints[..., 0]
        whole = [xp.stack([part + zero for part in parts[::-1]], axis=-1) for parts in (moving, holding)]
        return whole[0], whole[1]

    def _inertial(
        self, frames: list[Frame], centres: list[Vector], rates: Array, accelerations: Array
    ) -> tuple[list[Vector], list[Vector]]:
        """Force and moment about the centre of mass that each link's motion takes."""
        spin: Vector = [0.0, 0.0, 0.0]
        turn, pull, origin = spin, spin, spin
        forces, moments = [], []
        for index, (frame, hinge) in enumerate(zip(frames, self.hinges, strict=True)):
            arm = _less(frame.origin, origin)
            pull = _sum(pull, _swept(spin, turn, arm))
            rate = [rates[..., index] * part for part in frame.z]
            gain = [accelerations[..., index] * part for part in frame.z]
            turn = _sum(_sum(turn, gain), _cross(spin, rate))
            spin, origin = _sum(spin, rate), frame.origin
            swept = _swept(spin, turn, _less(centres[index], origin))
            forces.append([hinge.mass * (a + b) for a, b in zip(pull, swept, strict=True)])
            momentum = _resisting(frame, hinge, spin)
            moments.append(_sum(_resisting(frame, hinge, turn), _cross(spin, momentum)))
        return forces, moments


GRAVITY = 9.81
"""[m/s^2], downwards along z."""


def _resisting(frame: Frame, hinge: Hinge, vector: Vector) -> Vector:
    """A link's inertia times a vector of the world."""
    local = [_dot(axis, vector) for axis in (frame.x, frame.y, frame.z)]
    times = [_added([i * v for i, v in zip(row, local, strict=True)]) for row in hinge.inertia]
    return [_added([axis[k] * part for axis, part in zip(frame[:3], times, strict=True)]) for k in range(3)]


def _swept(spin: Vector, turn: Vector, arm: Vector) -> Vector:
    """Acceleration of a point of a turning body, `arm` away from one at rest."""
    return _sum(_cross(turn, arm), _cross(spin, _cross(spin, arm)))


def _combined(axes: tuple[Vector, Vector, Vector], weights: Constants) -> Vector:
    """Axes times constant weights, where these are not zero."""
    used = [(axis, weight) for axis, weight in zip(axes, weights, strict=True) if weight != 0.0]
    return _added([axis if weight == 1.0 else weight * axis for axis, weight in used] or [0.0 * axes[0]])


def _sum(first: Vector, second: Vector) -> Vector:
    return [a + b for a, b in zip(first, second, strict=True)]


def _less(first: Vector, second: Vector) -> Vector:
    return [a - b for a, b in zip(first, second, strict=True)]


def _dot(first: Vector, second: Vector) -> Array:
    return _added([a * b for a, b in zip(first, second, strict=True)])


def _added(parts: list[Array]) -> Array:
    return functools.reduce(operator.add, parts)


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
