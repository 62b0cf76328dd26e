"""Forward kinematics and inverse dynamics of a serial chain of hinges.

All functions are batched, and compute in the precision of their arguments. A vector is kept as its three components,
each an array over the batch, so that every operation is one pass over contiguous memory. Products with constants that
are 0 or 1 in a robot's dimensions are skipped: most entries of its link frames are.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import cosine_and_sine
from viapoint.envs.common.types import Array

Vector = Any
"""Three components: an array of shape (3, ...) or three arrays."""
Constants = tuple[float, float, float]
"""Vector that is the same in the whole batch."""

GRAVITY = 9.81
"""Gravitational acceleration along -z, [m/s^2]."""


class Frame(NamedTuple):
    """Joint frame in the world: its axes, z along the joint, and its origin [m]."""

    x: Vector
    y: Vector
    z: Vector
    origin: Vector

    def rotate(self, vector: Constants) -> Vector:
        """Return a vector of this frame in world axes."""
        return _combine((self.x, self.y, self.z), vector)

    def transform(self, point: Constants) -> Vector:
        """Return the world position of a point of this frame, [m]."""
        return self.origin + self.rotate(point)


@dataclass(frozen=True, kw_only=True)
class Hinge:
    """Hinge about the z axis of its frame, with the mass of all bodies that move with it and no later hinge."""

    turn: tuple[Constants, Constants, Constants]
    """Axes x, y and z of the frame at angle 0, in the frame of the previous joint."""
    offset: Constants
    """Origin of the frame, in the frame of the previous joint, [m]."""
    mass: float
    """Mass, [kg]."""
    centre: Constants
    """Centre of mass, [m]."""
    inertia: tuple[Constants, Constants, Constants]
    """Rotational inertia about the centre of mass, [kg m^2]."""

    @functools.cached_property
    def first_moments(self) -> Constants:
        """First moments of the mass about the frame's origin, [kg m]."""
        x, y, z = self.centre
        return self.mass * x, self.mass * y, self.mass * z

    @functools.cached_property
    def second_moments(self) -> tuple[Constants, ...]:
        """Second moments of the mass about the frame's origin, the integral of r r^T dm, [kg m^2]."""
        inertia, centre = np.array(self.inertia), np.array(self.centre)
        about_centre = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        return tuple(map(tuple, (about_centre + self.mass * np.outer(centre, centre)).tolist()))

    def to_joint_frame(self, vector: Vector, cosine: Array, sine: Array) -> Vector:
        """Return a vector of the previous joint's frame in this joint's frame."""
        x, y, z = (_combine(vector, axis) for axis in self.turn)
        return [cosine * x + sine * y, cosine * y - sine * x, z]

    def to_previous_frame(self, vector: Vector, cosine: Array, sine: Array) -> Vector:
        """Return a vector of this joint's frame in the previous joint's frame."""
        x, y, z = vector
        turned = cosine * x - sine * y, sine * x + cosine * y, z
        return [_combine(turned, weights) for weights in zip(*self.turn, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Serial chain of J hinges from the world to the hand."""

    hinges: tuple[Hinge, ...]

    def frames(self, joints: Array) -> list[Frame]:
        """Return the world frame of every joint at angles of shape (..., J), [rad]."""
        frames: list[Frame] = []
        cosines, sines = self._cosines_and_sines(joints)
        units = np.eye(3, dtype=joints.dtype).reshape(3, 3, *[1] * (joints.ndim - 1))
        previous = Frame(units[0], units[1], units[2], np.zeros_like(units[0]))
        for hinge, cosine, sine in zip(self.hinges, cosines, sines, strict=True):
            x, y, z = (previous.rotate(axis) for axis in hinge.turn)
            origin = previous.transform(hinge.offset)
            previous = Frame(cosine * x + sine * y, cosine * y - sine * x, z, origin)
            frames.append(previous)
        return frames

    def points(self, joints: Array, places: tuple[tuple[int, Constants], ...]) -> Array:
        """Return the world positions of P points in frames of joints (index, point), shape (..., P, 3), [m]."""
        frames = self.frames(joints)
        placed = [frames[index].transform(point) for index, point in places]
        # Each component is contiguous in memory: callers mostly read one component after the other.
        shape = (3, *joints.shape[:-1])
        whole = [part if part.shape == shape else np.broadcast_to(part, shape) for part in placed]
        return np.moveaxis(np.stack(whole, axis=0), (0, 1), (-2, -1))

    def torques(self, joints: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
        """Return the torques of the motion without gravity, and those against gravity, shape (..., J) each, [N m].

        Recursive Newton-Euler algorithm in joint frames: J. Y. S. Luh, M. W. Walker and R. P. C. Paul, On-line
        computational scheme for mechanical manipulators, 1980. With f and n the force and the moment that act on a link
        from its predecessor, p the offset of the next frame and R its rotation, the inward recursion is

            f_i = F_i + R f_{i+1},   n_i = N_i + R n_{i+1} + p x R f_{i+1},   torque_i = (n_i)_z.

        Gravity needs no recursion of forces: the torque is that of the weight of all links further out, from their
        first moments of mass.

        Args:
            joints: Angles, shape (..., J), [rad].
            rates: Angular velocities, shape (..., J), [rad/s].
            accelerations: Angular accelerations, shape (..., J), [rad/s^2].
        """
        turns = list(zip(*self._cosines_and_sines(joints), strict=True))
        forces, moments, ups = self._inertial_forces(turns, rates, accelerations)
        moving, holding = [], []
        force, moment, lever, mass = forces[-1], moments[-1], list(self.hinges[-1].first_moments), 0.0
        for index in reversed(range(len(self.hinges))):
            hinge, up = self.hinges[index], ups[index]
            moving.append(moment[2])
            holding.append(GRAVITY * (lever[0] * up[1] - lever[1] * up[0]))  # z component of lever x up
            if index:
                previous = self.hinges[index - 1]
                mass += hinge.mass
                force, moment, lever = (
                    hinge.to_previous_frame(part, *turns[index]) for part in (force, moment, lever)
                )
                moment = _add(_add(moment, _cross(hinge.offset, force)), moments[index - 1])
                force = _add(force, forces[index - 1])
                lever = [
                    a + mass * b + c
                    for a, b, c in zip(lever, hinge.offset, previous.first_moments, strict=True)
                ]
        return np.stack(moving[::-1], axis=-1), np.stack(holding[::-1], axis=-1)

    def _inertial_forces(
        self, turns: list[tuple[Array, Array]], rates: Array, accelerations: Array
    ) -> tuple[list[Vector], list[Vector], list[Vector]]:
        """Return each link's inertial force F, its moment N about the joint, and the vertical, in joint frames.

        Outward recursion of the Newton-Euler algorithm. With angular velocity w, the acceleration of a point r of a
        link is a + A r, A = [w]x [w]x + [dw/dt]x. Integrated over the mass, with its first moments s,

            F = m a + A s,   N = s x a + integral of r x (A r) dm,

        in which the second moments S of the mass give the last term, e.g. along x: A_z . S_y - A_y . S_z (rows).
        """
        spin, turn, acceleration, up = [0.0] * 3, [0.0] * 3, [0.0] * 3, [0.0, 0.0, 1.0]
        rows: list[Vector] = [[0.0] * 3] * 3  # of A, in the previous frame
        forces, moments, ups = [], [], []
        for index, hinge in enumerate(self.hinges):
            acceleration = [
                a + _combine(row, hinge.offset) for a, row in zip(acceleration, rows, strict=True)
            ]
            spin, turn, acceleration, up = (
                hinge.to_joint_frame(part, *turns[index]) for part in (spin, turn, acceleration, up)
            )
            rate = rates[..., index]
            # The joint adds rate z to the angular velocity w, and its derivative, in which z turns with w.
            turn = [turn[0] + rate * spin[1], turn[1] - rate * spin[0], turn[2] + accelerations[..., index]]
            spin = [spin[0], spin[1], spin[2] + rate]
            rows = _acceleration_rows(spin, turn)
            forces.append(
                [
                    hinge.mass * a + _combine(row, hinge.first_moments)
                    for a, row in zip(acceleration, rows, strict=True)
                ]
            )
            (a, b, c), (x, y, z) = rows, hinge.second_moments
            pairs = ((c, y, b, z), (a, z, c, x), (b, x, a, y))
            spinning = [_combine(p, u) - _combine(q, v) for p, u, q, v in pairs]
            moments.append(_add(_cross(hinge.first_moments, acceleration), spinning))
            ups.append(up)
        return forces, moments, ups

    def _cosines_and_sines(self, joints: Array) -> tuple[Array, Array]:
        """Return cosine and sine of every angle, with the joints along the first axis."""
        angles = [joints[..., index] for index in range(len(self.hinges))]
        return cosine_and_sine(np.stack(angles, axis=0))


def _acceleration_rows(spin: Vector, turn: Vector) -> list[Vector]:
    """Return the rows of A = [w]x [w]x + [dw/dt]x for the angular velocity w and its derivative."""
    (x, y, z), (u, v, w) = spin, turn
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return [[-yy - zz, xy - w, xz + v], [xy + w, -xx - zz, yz - u], [xz - v, yz + u, -xx - yy]]


def _combine(axes: Any, weights: Constants) -> Any:
    """Return the sum of axes, or components, times constant weights; weights of 0 and 1 cost no product."""
    used = [(axis, weight) for axis, weight in zip(axes, weights, strict=True) if weight != 0.0]
    parts = [axis if weight == 1.0 else weight * axis for axis, weight in used] or [0.0 * axes[0]]
    return functools.reduce(operator.add, parts)


def _add(first: Vector, second: Vector) -> Vector:
    return [a + b for a, b in zip(first, second, strict=True)]


def _cross(constant: Constants, vector: Vector) -> Vector:
    """Return the cross product of a constant vector and a vector."""
    x, y, z = constant
    return [_combine(vector, weights) for weights in ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))]
