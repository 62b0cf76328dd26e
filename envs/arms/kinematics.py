"""Forward kinematics, Jacobians, inverse dynamics and limits of movements of a chain of joints with spheres.

Compiled functions work on one configuration and fill arrays of the caller. The functions at the end of the module are
batched over leading axes; they check their arguments and return new arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.compiled import Vector, compiled, inlined, inner, kernel, rotated, rotated_back

PART = 16  # Greatest number of spheres of a part of a group
LIMIT_SHARE = 0.97  # Share of the velocity and torque limits that plans may use; feedback uses the rest
# Least share of a joint's torque limit that counts as available for motion, however heavy the arm is
LEAST_TORQUE_SHARE = 0.01
TORQUE_STRIDE = 2  # Torques are looked at in every second configuration: they change slowly


class Chain(NamedTuple):
    """Serial chain of J joints with one link each.

    Link 0 is the base, which does not move; link j moves with joints 1 to j. The frame of a link is that of its joint;
    its z axis is the axis of the joint.
    """

    origin: Float  # Origin of each joint's frame at 0, in the frame of the link before, shape (J, 3), [m]
    rotation: Float  # Axes of this frame as columns, in the frame of the link before, shape (J, 3, 3)
    sliding: Bool  # True for joints that slide along their z axis, False for hinges about it, shape (J,)
    tool_origin: Float  # Origin of the tool's frame in that of the last link, shape (3,), [m]
    tool_rotation: Float  # Axes of the tool's frame as columns, shape (3, 3)
    mass: Float  # Mass of each moving link with all that is fixed to it, shape (J,), [kg]
    centre: Float  # Centre of mass in the link's frame, shape (J, 3), [m]
    inertia: Float  # Inertia about the centre of mass, in the link's frame, shape (J, 3, 3), [kg m^2]
    armature: Float  # Inertia of the motors seen at the joints, shape (J,), [kg m^2] or [kg]
    damping: Float  # Viscous friction of the joints, shape (J,), [N m s/rad] or [N s/m]
    gravity: Float  # Gravitational acceleration, shape (3,), [m/s^2]
    # Of an arm in the plane: angles of the upper arm in the frame of the shoulder, of the forearm in that of the elbow,
    # of the latter in the former, and of the former in the world, [rad], and the lengths of both, [m]
    first_two: tuple[float, float, float, float, float, float]


class Spheres(NamedTuple):
    """Spheres that cover an arm, in G groups; a group is rigid and belongs to one body of the model."""

    centre: Float  # Centres in the frame of the link, shape (S, 3), [m]
    radius: Float  # Radii, shape (S,), [m]
    first: Int  # Index of the first sphere of each group, and the number of spheres, shape (G + 1,)
    link: Int  # Link that each group moves with, shape (G,); 0 for the base
    # Centre of a bounding sphere of each group and part, in the frame of the link, shape (G + C, 3), [m]
    ball_centre: Float
    ball_radius: Float  # Radius of this sphere, shape (G + C,), [m]
    pairs: Int  # Pairs of groups that must not touch one another, shape (P, 2)
    part: Int
    """Row of the bounding sphere of the first part of each group, and the number of rows, shape (G + 1,).

    Groups of more than PART spheres are divided into parts of PART neighbours, the last one of fewer. Their bounding
    spheres stand behind those of the groups. A group of fewer has none.
    """
    self_allowance: float = 0.0  # Distance that is added to the clearance of the arm from itself, [m]


@inner
def link_frames(chain: Chain, joints: Float, rotation: Float, origin: Float) -> None:
    """Fill the world frames of links 0 to J: axes as columns, (J + 1, 3, 3), and origins, (J + 1, 3), [m]."""
    for row in range(3):
        for column in range(3):
            rotation[0, row, column] = 0.0
        rotation[0, row, row] = 1.0
        origin[0, row] = 0.0
    fixed, place = chain.rotation, chain.origin
    for j in range(joints.shape[0]):
        slides = chain.sliding[j]
        cosine, sine, shift = 1.0, 0.0, 0.0
        if slides:
            shift = joints[j]
        else:
            cosine = math.cos(joints[j])
            sine = math.sin(joints[j])
        for row in range(3):
            a = rotation[j, row, 0]
            b = rotation[j, row, 1]
            c = rotation[j, row, 2]
            # A row of the frame of the joint at 0, and then turned about its z axis.
            x, y, z = rotated_back(fixed[j], (a, b, c))
            rotation[j + 1, row, 0] = cosine * x + sine * y
            rotation[j + 1, row, 1] = cosine * y - sine * x
            rotation[j + 1, row, 2] = z
            along = a * place[j, 0] + b * place[j, 1] + c * place[j, 2]
            origin[j + 1, row] = origin[j, row] + along + shift * z


@inlined
def transform(rotation: Float, origin: Float, link: int, point: Float) -> Vector:
    """Return the world position of a point of a link, [m]; the frames are those of :func:`link_frames`."""
    x, y, z = point[0], point[1], point[2]
    return (
        origin[link, 0] + rotation[link, 0, 0] * x + rotation[link, 0, 1] * y + rotation[link, 0, 2] * z,
        origin[link, 1] + rotation[link, 1, 0] * x + rotation[link, 1, 1] * y + rotation[link, 1, 2] * z,
        origin[link, 2] + rotation[link, 2, 0] * x + rotation[link, 2, 1] * y + rotation[link, 2, 2] * z,
    )


@inner
def tool_position(chain: Chain, joints: Float, rotation: Float, origin: Float) -> Vector:
    """Return the world position of the tool, [m], and fill the frames of the links."""
    link_frames(chain, joints, rotation, origin)
    return transform(rotation, origin, chain.origin.shape[0], chain.tool_origin)


@inner
def point_jacobian(
    chain: Chain, rotation: Float, origin: Float, link: int, x: float, y: float, z: float, jacobian: Float
) -> None:
    """Fill the derivative of the world position of a point (x, y, z) of a link by the joints, shape (3, J) or more."""
    for j in range(chain.origin.shape[0]):
        jacobian[0, j] = 0.0
        jacobian[1, j] = 0.0
        jacobian[2, j] = 0.0
    for j in range(link):
        u = rotation[j + 1, 0, 2]
        v = rotation[j + 1, 1, 2]
        w = rotation[j + 1, 2, 2]
        if not chain.sliding[j]:
            arm = (x - origin[j + 1, 0], y - origin[j + 1, 1], z - origin[j + 1, 2])
            u, v, w = _cross((u, v, w), arm)
        jacobian[0, j] = u
        jacobian[1, j] = v
        jacobian[2, j] = w


@kernel
def tool_jacobian(chain: Chain, rotation: Float, origin: Float, tool: Vector, jacobian: Float) -> None:
    """Fill the derivative of the tool's position and rotation vector by the joints, shape (6, J), world axes."""
    n_joints = chain.origin.shape[0]
    point_jacobian(chain, rotation, origin, n_joints, tool[0], tool[1], tool[2], jacobian)
    for j in range(n_joints):
        turns = 0.0 if chain.sliding[j] else 1.0
        for row in range(3):
            jacobian[3 + row, j] = turns * rotation[j + 1, row, 2]


@kernel
def _cross(first: Vector, second: Vector) -> Vector:
    a, b, c = first
    x, y, z = second
    return b * z - c * y, c * x - a * z, a * y - b * x


@kernel
def _add(first: Vector, second: Vector) -> Vector:
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]


@kernel
def _row(array: Float, index: int) -> Vector:
    return array[index, 0], array[index, 1], array[index, 2]


@kernel
def _to_link(fixed: Float, j: int, cosine: float, sine: float, vector: Vector) -> Vector:
    """Return a vector of the frame of link j in the frame of link j + 1."""
    x, y, z = rotated_back(fixed[j], vector)
    return cosine * x + sine * y, cosine * y - sine * x, z


@kernel
def _from_link(fixed: Float, j: int, cosine: float, sine: float, vector: Vector) -> Vector:
    """Return a vector of the frame of link j + 1 in the frame of link j."""
    x, y, z = vector
    return rotated(fixed[j], (cosine * x - sine * y, sine * x + cosine * y, z))


@kernel
def _rigid_acceleration(linear: Vector, spin: Vector, turn: Vector, point: Vector) -> Vector:
    """Return the acceleration of a point of a body with the acceleration `linear` of its origin.

    The angular velocity is `spin`, and its derivative `turn`.
    """
    centripetal = _cross(spin, _cross(spin, point))
    return _add(linear, _add(_cross(turn, point), centripetal))


@compiled
def inverse_dynamics(chain: Chain, q: Float, v: Float, a: Float, torque: Float) -> None:
    """Fill the torques or forces that move the joints as given, shape (J,), [N m] or [N].

    Recursive Newton-Euler algorithm in the frames of the links (J. Y. S. Luh, M. W. Walker and R. P. C. Paul, On-line
    computational scheme for mechanical manipulators, 1980), with gravity as an acceleration of the base, and with the
    inertia of the motors and viscous friction.
    """
    n_joints = q.shape[0]
    fixed = chain.rotation
    # For each link: force, moment about the frame's origin, origin in the frame of the link before, cosine and sine.
    work = np.empty((n_joints, 11))
    spin = (0.0, 0.0, 0.0)
    turn = (0.0, 0.0, 0.0)
    linear = (-chain.gravity[0], -chain.gravity[1], -chain.gravity[2])  # at rest on earth
    for j in range(n_joints):
        slides = chain.sliding[j]
        cosine, sine = 1.0, 0.0
        origin = _row(chain.origin, j)
        if slides:
            shift = (q[j] * fixed[j, 0, 2], q[j] * fixed[j, 1, 2], q[j] * fixed[j, 2, 2])
            origin = _add(origin, shift)
        else:
            cosine, sine = math.cos(q[j]), math.sin(q[j])
        linear = _rigid_acceleration(linear, spin, turn, origin)
        linear = _to_link(fixed, j, cosine, sine, linear)
        spin = _to_link(fixed, j, cosine, sine, spin)
        turn = _to_link(fixed, j, cosine, sine, turn)
        if slides:
            # A sliding joint adds its acceleration and that of Coriolis, 2 spin x v z.
            linear = (linear[0] + 2.0 * v[j] * spin[1], linear[1] - 2.0 * v[j] * spin[0], linear[2] + a[j])
        else:
            # The axis z turns with the body: the derivative of v z is a z + v spin x z.
            turn = (turn[0] + v[j] * spin[1], turn[1] - v[j] * spin[0], turn[2] + a[j])
            spin = (spin[0], spin[1], spin[2] + v[j])
        centre = _row(chain.centre, j)
        x, y, z = _rigid_acceleration(linear, spin, turn, centre)
        force = (chain.mass[j] * x, chain.mass[j] * y, chain.mass[j] * z)
        inertia = chain.inertia[j]
        momentum = rotated(inertia, spin)
        moment = _add(rotated(inertia, turn), _cross(spin, momentum))
        moment = _add(moment, _cross(centre, force))
        work[j, 0], work[j, 1], work[j, 2] = force
        work[j, 3], work[j, 4], work[j, 5] = moment
        work[j, 6], work[j, 7], work[j, 8] = origin
        work[j, 9], work[j, 10] = cosine, sine
    force = (0.0, 0.0, 0.0)
    moment = (0.0, 0.0, 0.0)
    for j in range(n_joints - 1, -1, -1):
        force = _add(force, (work[j, 0], work[j, 1], work[j, 2]))
        moment = _add(moment, (work[j, 3], work[j, 4], work[j, 5]))
        effort = force[2] if chain.sliding[j] else moment[2]
        torque[j] = effort + chain.armature[j] * a[j] + chain.damping[j] * v[j]
        # Force and moment that the link before must bear.
        force = _from_link(fixed, j, work[j, 9], work[j, 10], force)
        moment = _from_link(fixed, j, work[j, 9], work[j, 10], moment)
        moment = _add(moment, _cross((work[j, 6], work[j, 7], work[j, 8]), force))


@compiled
def slowdowns(
    chain: Chain, velocity_limit: Float, torque_limit: Float, q: Float, v: Float, a: Float
) -> Float:
    """Return factors by which N movements must be slower to keep the limits; less than 1 for those that may be faster.

    If all durations are multiplied by s, velocities become 1/s of what they were, and the torque of the motion becomes
    a sum of a term with 1/s^2 and one with 1/s, the viscous friction. Gravity stays. So joint j needs

        |v| / s <= share limit_v,    |m| / s^2 + |f| / s <= share limit_t - g,

    with the torques m of inertia, f of friction, and g of gravity in the direction of the motion's torque. Positions q,
    velocities v and accelerations a have the shape (N, T, J); limits are infinite for none.
    """
    number, length, joints = q.shape
    found = np.empty(number)
    rest = np.zeros(joints)
    heavy = np.empty(joints)
    whole = np.empty(joints)
    for n in range(number):
        least = 0.0
        for k in range(length):
            for j in range(joints):
                least = max(least, abs(v[n, k, j]) / (LIMIT_SHARE * velocity_limit[j]))
            if k % TORQUE_STRIDE and k < length - 1:  # torques change slowly
                continue
            inverse_dynamics(chain, q[n, k], rest, rest, heavy)
            inverse_dynamics(chain, q[n, k], v[n, k], a[n, k], whole)
            for j in range(joints):
                friction = chain.damping[j] * v[n, k, j]
                motion = whole[j] - heavy[j] - friction
                against = heavy[j] if motion + friction >= 0.0 else -heavy[j]
                room = max(LIMIT_SHARE * torque_limit[j] - against, LEAST_TORQUE_SHARE * torque_limit[j])
                if room > 1e9:  # no limit
                    continue
                friction = abs(friction)
                # The positive root of room s^2 - |f| s - |m| = 0.
                root = np.sqrt(friction * friction + 4.0 * room * abs(motion))
                least = max(least, (friction + root) / (2.0 * room))
        found[n] = least
    return found


@compiled
def _all_frames(chain: Chain, joints: Float) -> tuple[Float, Float]:
    """Return the frames of the links for N configurations, see :func:`link_poses`."""
    number, links = len(joints), len(chain.mass) + 1
    rotation = np.empty((number, links, 3, 3))
    origin = np.empty((number, links, 3))
    for n in range(number):
        link_frames(chain, joints[n], rotation[n], origin[n])
    return rotation, origin


@compiled
def motion_torques(chain: Chain, q: Float, v: Float, a: Float) -> Float:
    """Return the torques of N motions of shape (N, J) each; :func:`torques` checks its arguments, this one does not."""
    torque = np.empty_like(q)
    for n in range(q.shape[0]):
        inverse_dynamics(chain, q[n], v[n], a[n], torque[n])
    return torque


def _flat(name: str, chain: Chain, joints: Float) -> tuple[Float, tuple[int, ...]]:
    """Return checked configurations as (N, J), contiguous, and the leading axes."""
    array = finite_array(name, joints, (..., len(chain.mass)))
    return np.ascontiguousarray(array.reshape(-1, len(chain.mass))), array.shape[:-1]


def forward(chain: Chain, joints: Float) -> tuple[Float, Float]:
    """Return places of the tool, (..., 3), [m], and its axes as columns, (..., 3, 3), for joints (..., J)."""
    rotation, origin = link_poses(chain, joints)
    last = rotation[..., -1, :, :]
    place = origin[..., -1, :]
    axes = np.zeros_like(last)
    for axis in range(3):  # in the order of :func:`tool_position`, so that places are equal to the last bit
        place = place + last[..., axis] * chain.tool_origin[axis]
        axes = axes + last[..., axis, None] * chain.tool_rotation[axis]
    return place, axes


def link_poses(chain: Chain, joints: Float) -> tuple[Float, Float]:
    """Return the frames of links 0 to J: axes as columns, (..., J + 1, 3, 3), and origins (..., J + 1, 3), [m]."""
    flat, batch = _flat("joints", chain, joints)
    rotation, origin = _all_frames(chain, flat)
    return rotation.reshape(*batch, *rotation.shape[1:]), origin.reshape(*batch, *origin.shape[1:])


def torques(chain: Chain, q: Float, v: Float, a: Float) -> Float:
    """Return the torques or forces of motions by inverse dynamics, shape (..., J), [N m] or [N]."""
    flat, batch = _flat("q", chain, q)
    rates, _ = _flat("v", chain, np.broadcast_to(v, np.shape(q)))
    accelerations, _ = _flat("a", chain, np.broadcast_to(a, np.shape(q)))
    return motion_torques(chain, flat, rates, accelerations).reshape(*batch, flat.shape[1])


def sphere_centres(chain: Chain, spheres: Spheres, joints: Float) -> Float:
    """Return the world positions of all S spheres, shape (..., S, 3), [m]."""
    rotation, origin = link_poses(chain, joints)
    link = np.repeat(spheres.link, np.diff(spheres.first))
    turned = rotation[..., link, :, :] @ spheres.centre[..., None]
    return np.asarray(origin[..., link, :] + turned[..., 0])
