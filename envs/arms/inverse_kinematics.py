"""Inverse kinematics: damped least squares for any chain, and a closed form for two hinges with vertical axes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.kinematics import Chain, link_frames, tool_jacobian, transform
from viapoint.envs.common.arrays import Bool, Float, frame_matrices
from viapoint.envs.common.validation import finite_array, unit_quaternion, whole_number
from viapoint.envs.geometry.compiled import compiled, kernel, rotated

ITERATIONS = 80  # Greatest number of iterations from one seed
# Greatest distance from the target, [m], and greatest angle, [rad], of a solution
PLACE_TOLERANCE, ANGLE_TOLERANCE = 1e-6, 1e-5
LONGEST_STEP = 0.5  # Greatest error that one iteration corrects, [m] and [rad] together
DAMPING = 1e-2  # Damping for errors of 1; it falls with the error, so that the last iterations converge fast
STALLED = 1e-9  # Greatest step of the joints that ends the iterations, [rad]
SAME = 1e-3  # Greatest difference of joints in solutions that count as the same, [rad]
PATIENCE = 4  # Factor on the number of seeds where the first ones find nothing
# Way of a joint beyond its range that counts as rounding, [rad] or [m]: limits in files may have five digits
RANGE_TOLERANCE = 1e-5
TURN = 2.0 * np.pi  # Full turn, [rad]
REACHED = 1e-9  # Greatest distance of the hand from a target in the plane, [m]


@compiled
def solve_symmetric(matrix: Float, vector: Float, number: int) -> None:
    """Replace a vector by the solution of a symmetric positive definite system, in place (Cholesky)."""
    for j in range(number):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = np.sqrt(matrix[j, j])
        for i in range(j + 1, number):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]
    for i in range(number):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(number - 1, -1, -1):
        for k in range(i + 1, number):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]


@compiled
def descend(
    chain: Chain, joint_range: Float, position: Float, axes: Float, oriented: bool, joints: Float
) -> float:
    """Move joints towards a target by damped least squares, and return the remaining error, 0 if it is reached.

    The step is J^T (J J^T + d^2 I)^-1 e for the error e of place and orientation, cut off at the limits of the joints
    (Y. Nakamura and H. Hanafusa, Inverse kinematic solutions with singularity robustness, 1986). Axes, shape (3, 3),
    matter only if `oriented`.
    """
    last = len(chain.mass)
    rows = 6 if oriented else 3
    rotation, origin = np.empty((last + 1, 3, 3)), np.empty((last + 1, 3))
    jacobian = np.empty((6, last))
    error = np.zeros(6)
    square = np.empty((6, 6))
    away = 1e9
    for _ in range(ITERATIONS):
        link_frames(chain, joints, rotation, origin)
        here = transform(rotation, origin, last, chain.tool_origin)
        for a in range(3):
            error[a] = position[a] - here[a]
            error[3 + a] = 0.0
        trace = -1.0
        if oriented:
            for column in range(3):
                turn = chain.tool_rotation
                axis = turn[0, column], turn[1, column], turn[2, column]
                x, y, z = rotated(rotation[last], axis)
                u = axes[0, column]
                v = axes[1, column]
                w = axes[2, column]
                trace += x * u + y * v + z * w
                error[3] += 0.5 * (y * w - z * v)
                error[4] += 0.5 * (z * u - x * w)
                error[5] += 0.5 * (x * v - y * u)
        place = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
        sine = np.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
        angle = np.arctan2(sine, 0.5 * trace) if oriented else 0.0
        away = place + angle
        if place < PLACE_TOLERANCE and angle < ANGLE_TOLERANCE:
            return 0.0
        if oriented and sine > 1e-9:
            for a in range(3):
                error[3 + a] *= angle / sine
        elif oriented and angle > 1.0:
            error[3] = 0.5  # half a turn: any axis will do
        scale = min(LONGEST_STEP / away, 1.0)  # the Jacobian holds for small steps
        tool_jacobian(chain, rotation, origin, here, jacobian)
        damping = (DAMPING * min(away, 1.0)) ** 2 + 1e-12
        for i in range(rows):
            error[i] *= scale
            for k in range(i + 1):
                total = 0.0
                for j in range(last):
                    total += jacobian[i, j] * jacobian[k, j]
                square[i, k] = total + (damping if i == k else 0.0)
        solve_symmetric(square, error, rows)
        moved = 0.0
        for j in range(last):
            step = 0.0
            for i in range(rows):
                step += jacobian[i, j] * error[i]
            before = joints[j]
            joints[j] = min(max(before + step, joint_range[j, 0]), joint_range[j, 1])
            moved = max(moved, abs(joints[j] - before))
        if moved < STALLED:  # at the limits, or at a singularity
            break
    return away


@compiled
def solve_planar(chain: Chain, joint_range: Float, x: float, y: float, joints: Float) -> bool:
    """Find the joints of two hinges with vertical axes whose tool is at (x, y), [m], with the elbow on its side.

    Out of reach, the elbow is as straight or as bent as it can be, and the result is False.
    """
    first, second, turn, base, upper, fore = chain.first_two
    u = x - chain.origin[0, 0]
    v = y - chain.origin[0, 1]
    # Law of cosines for the angle between the links.
    cosine = (u * u + v * v - upper * upper - fore * fore) / (2.0 * upper * fore)
    bend = np.arccos(min(max(cosine, -1.0), 1.0))
    offset = turn + second - first
    if joint_range[1, 0] + joint_range[1, 1] + 2.0 * offset < 0.0:
        bend = -bend
    joints[1] = min(max(bend - offset, joint_range[1, 0]), joint_range[1, 1])
    bend = joints[1] + offset
    # Angle from the upper arm to the tool, seen from the shoulder.
    along = upper + fore * np.cos(bend)
    across = fore * np.sin(bend)
    angle = np.arctan2(v, u) - np.arctan2(across, along) - base - first
    middle = 0.5 * (joint_range[0, 0] + joint_range[0, 1])
    joints[0] = angle - 2.0 * np.pi * np.round((angle - middle) / (2.0 * np.pi))
    away = abs(np.sqrt(along * along + across * across) - np.sqrt(u * u + v * v))
    return bool(away < REACHED and joint_range[0, 0] <= joints[0] <= joint_range[0, 1])


@compiled
def planar_limits(chain: Chain, joint_range: Float) -> Float:
    """Return numbers by which :func:`in_planar_reach` knows the limits of an arm in the plane, shape (6,).

    Least and greatest cosine of the angle between the links, the side of the elbow, cosine and sine of the direction of
    the upper arm in the middle of the shoulder's range, and the cosine of half this range.
    """
    first, second, turn, base, _, _ = chain.first_two
    offset = turn + second - first
    low = joint_range[1, 0] + offset
    high = joint_range[1, 1] + offset
    side = 1.0 if low + high >= 0.0 else -1.0
    nearest = max(min(side * low, side * high), 0.0)
    farthest = min(max(side * low, side * high), np.pi)
    middle = base + first + 0.5 * (joint_range[0, 0] + joint_range[0, 1])
    half = min(0.5 * (joint_range[0, 1] - joint_range[0, 0]), np.pi)
    return np.array([np.cos(farthest), np.cos(nearest), side, np.cos(middle), np.sin(middle), np.cos(half)])


@kernel
def in_planar_reach(chain: Chain, limits: Float, x: float, y: float) -> bool:
    """Return True where :func:`solve_planar` finds joints; without angles it takes a twentieth of the time."""
    _, _, _, _, upper, fore = chain.first_two
    u = x - chain.origin[0, 0]
    v = y - chain.origin[0, 1]
    square = u * u + v * v
    cosine = (square - upper * upper - fore * fore) / (2.0 * upper * fore)
    if cosine < limits[0] or cosine > limits[1]:
        return False
    along = upper + fore * cosine
    across = limits[2] * fore * math.sqrt(max(1.0 - cosine * cosine, 0.0))
    # Direction of the upper arm, times the squared distance.
    p = u * along + v * across
    q = v * along - u * across
    return bool(p * limits[3] + q * limits[4] >= limits[5] * square)


@compiled
def planar_solutions(chain: Chain, joint_range: Float, places: Float) -> tuple[Float, Bool]:
    """Return the joints for places of the hand in the plane, (N, 2), [m], and True where it gets there, (N,)."""
    joints = np.empty_like(places)
    found = np.empty(len(places), np.bool_)
    for i in range(len(places)):
        found[i] = solve_planar(chain, joint_range, places[i, 0], places[i, 1], joints[i])
    return joints, found


@compiled
def planar_motion(
    chain: Chain, joint_range: Float, position: Float, velocity: Float, acceleration: Float
) -> tuple[Float, Float, Float]:
    """Return joints, rates and accelerations for N states of the hand in the plane, shape (N, 2) each.

    With unit vectors u along the links and n across them, the velocity is l1 a1' n1 + l2 a2' n2 for the angles a of the
    links in the world, and n1 . u2 = sin(a2 - a1), so its components along u2 and u1 give the rates. Accelerations
    follow alike after the centripetal terms are taken away.
    """
    first, second, turn, base, upper, fore = chain.first_two
    joints = np.empty_like(position)
    rates = np.empty_like(position)
    changes = np.empty_like(position)
    for i in range(len(position)):
        solve_planar(chain, joint_range, position[i, 0], position[i, 1], joints[i])
        one = base + joints[i, 0] + first
        other = base + joints[i, 0] + turn + joints[i, 1] + second
        c1 = np.cos(one)
        s1 = np.sin(one)
        c2 = np.cos(other)
        s2 = np.sin(other)
        sine = c1 * s2 - s1 * c2
        sine = sine if abs(sine) > 1e-9 else 1e-9
        x, y = velocity[i, 0], velocity[i, 1]
        rate_1 = (x * c2 + y * s2) / (upper * sine)
        rate_2 = -(x * c1 + y * s1) / (fore * sine)
        x = acceleration[i, 0] + upper * rate_1 * rate_1 * c1 + fore * rate_2 * rate_2 * c2
        y = acceleration[i, 1] + upper * rate_1 * rate_1 * s1 + fore * rate_2 * rate_2 * s2
        change_1 = (x * c2 + y * s2) / (upper * sine)
        change_2 = -(x * c1 + y * s1) / (fore * sine)
        rates[i, 0], rates[i, 1] = rate_1, rate_2 - rate_1
        changes[i, 0], changes[i, 1] = change_1, change_2 - change_1
    return joints, rates, changes


def planar_joints(arm: Arm, places: Any) -> Float:
    """Return joint positions of an arm in the plane, shape (..., 2), for places of the hand of shape (..., 2), [m].

    Out of reach, the elbow is as straight or as bent as it can be.
    """
    places = np.asarray(places, dtype=np.float64)
    joints, _ = planar_solutions(arm.chain, arm.joint_range, places.reshape(-1, 2))
    return joints.reshape(places.shape)


def unwound(arm: Arm, joints: Float, near: Float) -> Float:
    """Return joint positions, shape (..., J), with hinges at the equivalent within range that is nearest to `near`."""
    low, high = arm.joint_range.T
    least = np.ceil((joints - high - RANGE_TOLERANCE) / TURN)
    most = np.floor((joints - low + RANGE_TOLERANCE) / TURN)
    turns = np.clip(np.round((joints - near) / TURN), least, most)
    return np.where(arm.chain.sliding, joints, joints - TURN * turns)


def nearest_goals(arm: Arm, goals: Float, start: Float) -> Float:
    """Return goals in joint positions, shape (..., J), with continuous joints at the equivalent nearest to a start."""
    endless = np.isin(arm.joint_names, arm.continuous)
    return np.where(endless, unwound(arm, goals, start), goals)


def _solutions(arm: Arm, position: Float, axes: Float | None, begin: Float, near: Float) -> list[Float]:
    """Return different configurations with the tool at a target, found from those to begin with, (N, J)."""
    found: list[Float] = []
    target = np.eye(3) if axes is None else axes
    for joints in begin.copy():
        error = descend(arm.chain, arm.joint_range, position, target, axes is not None, joints)
        joints = unwound(arm, joints, near)
        if error == 0.0 and all(np.abs(joints - other).max() > SAME for other in found):
            found.append(joints)
    return found


class UnreachableError(ValueError):
    """Error of a pose that no joint positions were found for."""


def inverse_kinematics(
    arm: Arm, position: Any, quaternion: Any = None, *, seed: Any = None, n_seeds: int = 64
) -> Float:
    """Return different joint positions that put the tool at a pose, the nearest to the first seed first, (S, J).

    Hinges that may turn all around are at the equivalent that is nearest to the seed.

    Args:
        arm: Arm.
        position: Place of the tool, shape (3,), [m].
        quaternion: Orientation (w, x, y, z) of the tool, shape (4,); None for any.
        seed: Joint positions to begin with, shape (J,); home by default.
        n_seeds: Number of seeds; as many again, four times, where these find nothing.

    Raises:
        UnreachableError: No solution was found; the message tells the nearest distance.
        ValueError: An argument has another shape or is not finite.
        TypeError: It is no arm.

    Example:
        >>> from viapoint.envs.arms.inverse_kinematics import inverse_kinematics
        >>> from viapoint.envs.arms.registry import arm_of
        >>> arm = arm_of("panda")
        >>> found = inverse_kinematics(arm, (0.5, 0.2, 0.4), (0.0, 1.0, 0.0, 0.0))
        >>> arm.hand(found[0]).round(4).tolist()
        [0.5, 0.2, 0.4]
    """
    if not isinstance(arm, Arm):
        raise TypeError(f"arm must be an Arm, as arm_of and load_arm return it, got {arm!r:.60}")
    position = finite_array("position", position, (3,))
    axes = None if quaternion is None else frame_matrices(unit_quaternion("quaternion", quaternion))
    number = whole_number("n_seeds", n_seeds, 1)
    first = arm.home if seed is None else finite_array("seed", seed, arm.home.shape)
    rng = np.random.default_rng(0)
    low, high = arm.joint_range.T
    begin = np.concatenate((first[None], rng.uniform(low, high, (number - 1, len(low)))))
    # Nothing reaches farther than all links in one line.
    chain = arm.chain
    lengths = np.linalg.norm((*chain.origin[1:], chain.tool_origin), axis=1)
    slides = np.abs(arm.joint_range).max(axis=1)[chain.sliding]
    far = np.linalg.norm(position - chain.origin[0]) > lengths.sum() + slides.sum() + PLACE_TOLERANCE
    found = [] if far else _solutions(arm, position, axes, begin, first)
    if not found and not far:  # some poses near the joint limits are reached from few places
        begin = rng.uniform(low, high, (PATIENCE * number, len(low)))
        found = _solutions(arm, position, axes, begin, first)
    if not found:
        away = min(descend(chain, arm.joint_range, position, np.eye(3), False, each) for each in begin)
        pose = "position" if quaternion is None else "pose"
        nearest = f"the nearest place found is {1e3 * away:.1f} mm away"
        if quaternion is not None and away == 0.0:
            nearest = "its position can be, but not with this orientation"
        raise UnreachableError(f"the {pose} {position.tolist()} m cannot be reached: {nearest}")
    found.sort(key=lambda each: float(np.abs(each - first).max()))
    return np.array(found)
