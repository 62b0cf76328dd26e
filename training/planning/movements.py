"""Minimum-jerk movements through via-points as products of tables, for checks of many candidates.

A movement through K via-points is linear in its via-points, its goal, and its initial velocity and acceleration, if the
passage times are fixed. So movements with one of a table of passage times need no linear system:

    x(t) = x_0 + sum_i B_mi(t) w_i,   J = sum_ij C_mij w_i . w_j,

with the offsets w of via-points and goal from the start, and the initial velocity times the duration and acceleration
times its square. The passage times m are those of the least cost J in the table.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import (
    in_planar_reach,
    planar_limits,
    solve_planar,
    solve_symmetric,
)
from viapoint.envs.arms.kinematics import Chain, Spheres
from viapoint.envs.arms.spheres import grouped
from viapoint.envs.common.arrays import Float, Int
from viapoint.envs.geometry.clearance import (
    WINDOW,
    Placed,
    fastest,
    memory,
    obstacle_clearance,
    place,
    self_clearance,
    travel,
)
from viapoint.envs.geometry.compiled import compiled, inlined, inner, kernel
from viapoint.envs.geometry.obstacles import Obstacles, bounding_boxes
from viapoint.envs.plans import SHORTEST_DURATION
from viapoint.envs.scenes.scene import CHORD

INSTANTS = 64  # Instants of a movement that are checked; a power of two
# Instants of a movement that is checked once more before it is executed; a power of two
FINE_INSTANTS = 256
NOWHERE = 1e9  # Clearance that nothing limits, [m]
OUTSIDE = -2.0  # Clearance of movements that leave the reach or the joint ranges, [m]
# Step between the passage times whose cost is computed first, with one via-point; those beside the best follow
STRIDE = 4
# Vertical distance from obstacles beyond which spheres of an arm in the plane do not matter, [m]
NEAR = 0.05
# Angle that a straight elbow turns when the hand is 0.3 mm from its place, the usual error of tracking, [rad]
ELBOW_ROOM = 0.04

# Jerk cost of a quintic segment in unit time, as a quadratic form of position, velocity and acceleration at its ends
JERK_SQUARE = np.array(
    [
        [720.0, 360.0, 60.0, -720.0, 360.0, -60.0],
        [360.0, 192.0, 36.0, -360.0, 168.0, -24.0],
        [60.0, 36.0, 9.0, -60.0, 24.0, -3.0],
        [-720.0, -360.0, -60.0, 720.0, -360.0, 60.0],
        [360.0, 168.0, 24.0, -360.0, 192.0, -36.0],
        [-60.0, -24.0, -3.0, 60.0, -36.0, 9.0],
    ]
)
# Nodes and weights of Gauss-Legendre quadrature in [-1, 1]
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(3)


class MovementTable(NamedTuple):
    """Movements through K via-points in unit time at N instants, with M sets of passage times."""

    durations: Float  # Durations of the segments, shape (M, K + 1)
    basis: Float  # Influence of each offset on the position at each instant, shape (M, N, K + 3)
    rate: Float  # Influence of each offset on the velocity at each instant, shape (M, N, K + 3)
    bend: Float  # Influence of each offset on the acceleration at each instant, shape (M, N, K + 3)
    # Matrices of the jerk cost, half the integral of the squared jerk, shape (M, K + 3, K + 3)
    cost: Float
    order: Int  # Instants in an order that looks everywhere soon, shape (N,)


class Setting(NamedTuple):
    """Arm and space of movements, as compiled functions take them."""

    chain: Chain
    spheres: Spheres  # Spheres that can touch the obstacles at all
    joint_range: Float  # Shape (J, 2), [rad]
    of_hand: bool  # True if movements are of the hand in the plane, False if they are of the joints
    # Reach of the joints, see :func:`~viapoint.envs.geometry.clearance.travel`, shape (J,), [m]
    reach: Float
    hand_alone: bool  # True if the only sphere is the one around the hand of an arm in the plane
    n_pieces: int = 1  # Scenes of obstacles for each problem, one after the other in time, each for CHORD


class Movement(NamedTuple):
    """One movement, as compiled functions take it."""

    table: MovementTable
    times: int  # Index of the passage times
    start: Float  # Shape (D,)
    offsets: Float  # Offsets w, shape (K + 3, D)
    duration: float  # Duration during which obstacles move, [s]


class Memory(NamedTuple):
    """Memory of compiled functions, which they use again and again."""

    position: Float  # Position of a movement, shape (D,)
    joints: Float  # Joints at an instant, shape (J,)
    path: Float  # Joints at each instant, or positions if the hand is alone, shape (N, J)
    bound: Float  # Lower bounds of the clearance at each instant, shape (N,), [m]
    placed: Placed  # Places of the arm's parts
    limits: Float  # Limits of an arm in the plane, see `planar_limits`


@compiled
def memory_of(setting: Setting, table: MovementTable, dimension: int) -> Memory:
    """Return memory for movements in a space of D dimensions."""
    instants, joints = len(table.order), len(setting.joint_range)
    return Memory(
        np.empty(dimension),
        np.empty(joints),
        np.empty((instants, joints)),
        np.empty(instants),
        memory(setting.chain, setting.spheres),
        planar_limits(setting.chain, setting.joint_range),
    )


def arm_setting(
    arm: Arm, of_hand: bool, obstacles: Obstacles, *, room: float = 0.0, near: float = np.inf
) -> Setting:
    """Return arm and space for compiled functions.

    Movements keep a distance `room` from the joint ranges, [rad]. In the plane, spheres that no obstacle comes nearer
    to than `near`, [m], are left out.
    """
    wanted = (True,) * len(arm.spheres.link)
    if of_hand and np.isfinite(near) and not len(arm.spheres.pairs):
        centre, half = bounding_boxes(obstacles)
        tall = (np.abs(obstacles.rotation[..., 2, :]) * half).sum(axis=-1)
        tall = np.where(obstacles.velocity[..., 2] == 0.0, tall, np.inf)
        present = obstacles.present
        low = (centre[..., 2] - tall).min(where=present, initial=1e9) - near
        high = (centre[..., 2] + tall).max(where=present, initial=-1e9) + near
        bottom, top = _heights(arm)
        wanted = tuple((top > low) & (bottom < high))
    return _setting(arm, of_hand, wanted, room)


@functools.lru_cache(maxsize=64)
def _heights(arm: Arm) -> Float:
    """Return the least and greatest heights of the groups of spheres of an arm in the plane, shape (2, G), [m]."""
    spheres = arm.spheres
    level = np.concatenate(([0.0], np.cumsum(arm.chain.origin[:, 2])))
    found = np.empty((2, len(spheres.link)))
    for group, link in enumerate(spheres.link):
        some = slice(spheres.first[group], spheres.first[group + 1])
        place = level[link] + spheres.centre[some, 2]
        found[:, group] = (place - spheres.radius[some]).min(), (place + spheres.radius[some]).max()
    return found


@functools.lru_cache(maxsize=256)
def _setting(arm: Arm, of_hand: bool, wanted: tuple[bool, ...], room: float) -> Setting:
    """Return an arm with some groups of spheres, the last one if none is wanted: no table is empty."""
    spheres = arm.spheres
    if not all(wanted):
        kept = np.flatnonzero(wanted) if any(wanted) else np.array([len(wanted) - 1])
        centres = np.split(spheres.centre, spheres.first[1:-1])
        radii = np.split(spheres.radius, spheres.first[1:-1])
        links = spheres.link[kept].tolist()
        spheres = grouped([centres[group] for group in kept], [radii[group] for group in kept], links, ())
    alone = of_hand and len(spheres.radius) == 1 and np.allclose(spheres.centre[0], arm.chain.tool_origin)
    ranges = arm.joint_range + room * np.array([1.0, -1.0])
    return Setting(arm.chain, spheres, ranges, of_hand, arm.reach, bool(alone))


@functools.cache
def movement_table(n_via: int, number_of_instants: int = INSTANTS) -> MovementTable:
    """Return the table of movements through some via-points; more than three are passed at even times."""
    times: Float = np.arange(1, n_via + 1)[None] / (n_via + 1)
    if n_via == 1:
        times = np.linspace(0.1, 0.9, 161)[:, None]
    elif n_via == 2:
        first, second = np.meshgrid(np.linspace(0.1, 0.7, 16), np.linspace(0.3, 0.9, 16), indexing="ij")
        times = np.stack((first, second), axis=-1)[second - first > 0.14]
    elif n_via == 3:
        times = np.array(list(itertools.combinations(np.linspace(0.1, 0.9, 13), 3)))
    return table_with(np.diff(times, prepend=0.0, append=1.0), number_of_instants)


def fine_table(n_via: int) -> MovementTable:
    """Return the same table at many instants, for the last check of a movement."""
    return movement_table(n_via, FINE_INSTANTS)


def table_with(durations: Float, number_of_instants: int = INSTANTS) -> MovementTable:
    """Return the table of movements whose segments take some durations in unit time, shape (M, K + 1)."""
    durations = np.ascontiguousarray(durations, dtype=np.float64)
    order = _everywhere_soon(number_of_instants)
    return MovementTable(durations, *_unit_movements(durations, number_of_instants), order)


@functools.cache
def _everywhere_soon(number: int) -> Int:
    """Return the numbers below a power of two in the order of their reversed bits."""
    order = np.zeros(1, np.int64)
    while len(order) < number:
        order = np.concatenate((2 * order, 2 * order + 1))
    return order


@compiled
def _unit_movements(durations: Float, number_of_instants: int) -> tuple[Float, Float, Float, Float]:
    """Return `basis`, `rate`, `bend` and `cost` of a table, see :class:`MovementTable`.

    It is the movement of :func:`viapoint.primitives.through` for each unit offset, unit velocity and unit acceleration.
    That function needs 0.4 ms for one table; this one is 50 times as fast. Without it, decisions of a search take a
    quarter longer in the plane, and twice as long where each candidate has passage times of its own.
    """
    number, segments = durations.shape
    columns = segments + 2
    basis = np.empty((number, number_of_instants, columns))
    rate, bend = np.empty_like(basis), np.empty_like(basis)
    cost = np.zeros((number, columns, columns))
    jerk = np.empty(columns)
    coefficients = np.empty((segments, 6, columns))
    for m in range(number):
        _coefficients(durations[m], coefficients)
        segment, begin = 0, 0.0
        for k in range(number_of_instants):
            time = k / (number_of_instants - 1)
            while segment < segments - 1 and time >= begin + durations[m, segment]:
                begin += durations[m, segment]
                segment += 1
            t = time - begin
            for i in range(columns):
                a, b, c, d, e, f = coefficients[segment, :, i]
                basis[m, k, i] = a + t * (b + t * (c + t * (d + t * (e + t * f))))
                rate[m, k, i] = b + t * (2.0 * c + t * (3.0 * d + t * (4.0 * e + t * 5.0 * f)))
                bend[m, k, i] = 2.0 * c + t * (6.0 * d + t * (12.0 * e + t * 20.0 * f))
        # The square of the jerk has degree four in each segment: three Gauss-Legendre nodes are exact.
        for segment in range(segments):
            half = 0.5 * durations[m, segment]
            for node in range(3):
                t = half * (1.0 + NODES[node])
                for i in range(columns):
                    d, e, f = coefficients[segment, 3:, i]
                    jerk[i] = 6.0 * d + t * (24.0 * e + t * 60.0 * f)
                for i in range(columns):
                    for j in range(columns):
                        cost[m, i, j] += 0.5 * half * NODE_WEIGHTS[node] * jerk[i] * jerk[j]
    return basis, rate, bend, cost


@compiled
def _coefficients(durations: Float, coefficients: Float) -> None:
    """Fill in the polynomials of the segments of each unit movement, shape (segments, 6, columns).

    Velocity v and acceleration a at the via-points are those of the least jerk cost: jerk and snap are continuous.
    """
    segments = len(durations)
    columns = segments + 2
    # Position, velocity and acceleration of one knot after another; the latter two are unknown at via-points.
    knots = np.zeros((columns, 3 * (segments + 1)))
    for column in range(segments):
        knots[column, 3 * (column + 1)] = 1.0
    knots[segments, 1] = 1.0
    knots[segments + 1, 2] = 1.0
    number = 2 * (segments - 1)
    unknown = np.empty(number, np.int64)
    for i in range(number):
        unknown[i] = 3 * (i // 2) + 4 + i % 2
    square = _jerk_square(durations)
    matrix = np.empty((number, number))
    motion = np.zeros((columns, number))
    for i in range(number):
        for j in range(number):
            matrix[i, j] = square[unknown[i], unknown[j]]
        for column in range(columns):
            for given in range(knots.shape[1]):
                motion[column, i] -= square[unknown[i], given] * knots[column, given]
    for column in range(columns):
        solve_symmetric(matrix.copy(), motion[column], number)
        for i in range(number):
            knots[column, unknown[i]] = motion[column, i]
    for segment in range(segments):
        t = durations[segment]
        for column in range(columns):
            x, v, a, end, rate, bend = knots[column, 3 * segment : 3 * segment + 6]
            way = end - x
            coefficients[segment, 0, column] = x
            coefficients[segment, 1, column] = v
            coefficients[segment, 2, column] = 0.5 * a
            third = 20.0 * way - (8.0 * rate + 12.0 * v) * t - (3.0 * a - bend) * t**2
            fourth = -30.0 * way + (14.0 * rate + 16.0 * v) * t + (3.0 * a - 2.0 * bend) * t**2
            fifth = 12.0 * way - 6.0 * (rate + v) * t - (a - bend) * t**2
            coefficients[segment, 3, column] = 0.5 * third / t**3
            coefficients[segment, 4, column] = 0.5 * fourth / t**4
            coefficients[segment, 5, column] = 0.5 * fifth / t**5


@compiled
def _jerk_square(durations: Float) -> Float:
    """Return the matrix of the jerk cost by x, v and a of all knots, shape (3 (segments + 1), 3 (segments + 1))."""
    size = 3 * (len(durations) + 1)
    square = np.zeros((size, size))
    power = np.empty(5)
    for segment in range(len(durations)):
        for exponent in range(5):
            power[exponent] = durations[segment] ** (exponent - 5)
        for i in range(6):
            for j in range(6):
                square[3 * segment + i, 3 * segment + j] += JERK_SQUARE[i, j] * power[i % 3 + j % 3]
    return square


@inner
def best_times(table: MovementTable, offsets: Float, gram: Float) -> tuple[int, float]:
    """Return the passage times of the least jerk cost, as an index of the table, and this cost in unit time.

    The memory `gram` has the shape (K + 3, K + 3).
    """
    products(offsets, gram)
    least, found = 1e300, 0
    stride = STRIDE if len(offsets) == 4 and len(table.cost) > STRIDE else 1
    for m in range(0, len(table.cost), stride):
        cost = jerk_cost(table, m, gram)
        if cost < least:
            least, found = cost, m
    coarse = found
    for m in range(max(coarse - stride + 1, 0), min(coarse + stride, len(table.cost))):
        cost = jerk_cost(table, m, gram)
        if cost < least:
            least, found = cost, m
    return found, least


@kernel
def products(offsets: Float, gram: Float) -> None:
    """Fill in the scalar products of offsets below and on the diagonal; those of two different ones count twice."""
    columns, dimension = offsets.shape
    for i in range(columns):
        for j in range(i + 1):
            total = 0.0
            for d in range(dimension):
                total += offsets[i, d] * offsets[j, d]
            gram[i, j] = total if i == j else 2.0 * total


@inner
def jerk_cost(table: MovementTable, times: int, gram: Float) -> float:
    """Return the jerk cost of a movement in unit time from the scalar products of its offsets."""
    cost = 0.0
    for i in range(len(gram)):
        for j in range(i + 1):
            cost += table.cost[times, i, j] * gram[i, j]
    return cost


@inlined
def position_at(movement: Movement, instant: int, out: Float) -> None:
    """Fill in the position of a movement at an instant, shape (D,)."""
    basis, offsets = movement.table.basis, movement.offsets
    for d in range(offsets.shape[1]):
        value = movement.start[d]
        for i in range(offsets.shape[0]):
            value += basis[movement.times, instant, i] * offsets[i, d]
        out[d] = value


@inlined
def joints_at(setting: Setting, movement: Movement, instant: int, position: Float, joints: Float) -> bool:
    """Fill in position, shape (D,), and joints, shape (J,), at an instant; return True within reach and ranges."""
    position_at(movement, instant, position)
    if setting.of_hand:
        return bool(solve_planar(setting.chain, setting.joint_range, position[0], position[1], joints))
    for j in range(len(joints)):
        joints[j] = position[j]
        if joints[j] < setting.joint_range[j, 0] or joints[j] > setting.joint_range[j, 1]:
            return False
    return True


@inlined
def place_hand(position: Float, placed: Placed) -> None:
    """Place the only sphere, that around the hand of an arm in the plane."""
    placed.ball[0, 0], placed.ball[0, 1], placed.ball[0, 2] = position[0], position[1], 0.0
    for axis in range(3):
        placed.centre[0, axis] = placed.ball[0, axis]
    placed.known[0] = True


@inner
def least_clearance(
    setting: Setting,
    movement: Movement,
    obstacles: Obstacles,
    scene: int,
    least: float,
    floor: float,
    until: float,
    memory: Memory,
) -> float:
    """Return the least clearance of a movement, at most `least`, [m]; OUTSIDE where it leaves reach or joint ranges.

    The search stops at the first clearance below `floor`. In the plane, instants are skipped whose neighbours have so
    much clearance that they cannot have less than the least so far. (Arms in space move too far between two instants.)

    Obstacles are those of the problem `scene`. Clearances above `least` are of no interest, below `floor` the exact
    value does not matter, [m], and after the time `until` nothing does, [s].
    """
    alone, last = setting.hand_alone, len(movement.table.order) - 1
    path, bound, placed = memory.path, memory.bound, memory.placed
    first, speed = scene * setting.n_pieces, 0.0
    for piece in range(setting.n_pieces):
        speed = max(speed, fastest(obstacles, first + piece))
    drift = speed * movement.duration / last
    for k in range(last + 1):
        instant = movement.table.order[k]
        here = path[instant]
        if alone:
            position_at(movement, instant, here)
            if not in_planar_reach(setting.chain, memory.limits, here[0], here[1]):
                return OUTSIDE
        elif not joints_at(setting, movement, instant, memory.position, here):
            return OUTSIDE
        time = movement.duration * instant / last
        if time > until:  # obstacles may change course until then, joint ranges do not
            bound[instant] = -NOWHERE
            continue
        apart = -NOWHERE
        if setting.of_hand:
            apart = _bound_of_neighbours(setting, path, bound, instant, last, drift)
        if apart < least:
            if alone:
                place_hand(here, placed)
            else:
                place(setting.chain, setting.spheres, here, placed)
            window = WINDOW if setting.of_hand else 0.0
            piece = first + min(int(time / CHORD), setting.n_pieces - 1)
            apart = obstacle_clearance(setting.spheres, placed, obstacles, piece, time, least + window, floor)
            least = min(least, apart)
            if least < floor:
                return least
            apart = self_clearance(setting.spheres, placed, apart, floor)
            least = min(least, apart)
            if least < floor:
                return least
        bound[instant] = apart
    return least


@inner
def _bound_of_neighbours(
    setting: Setting, path: Float, bound: Float, instant: int, last: int, drift: float
) -> float:
    """Return the least clearance that an instant can have, by those of two neighbours and the way from there, [m].

    The neighbours come just before in the order of reversed bits. `drift` is the greatest way of an obstacle between
    two instants, [m].
    """
    least = -NOWHERE
    distance = instant & -instant if instant else last + 1
    here = path[instant]
    for neighbour in (instant - distance, instant + distance):
        if 0 <= neighbour <= last:
            there = path[neighbour]
            if setting.hand_alone:
                way = math.sqrt((there[0] - here[0]) ** 2 + (there[1] - here[1]) ** 2)
            else:
                # Two parts of the arm may approach one another.
                way = 2.0 * travel(setting.reach, there, here)
            least = max(least, bound[neighbour] - way - drift * distance)
    return least


@inner
def shortest_duration(table: MovementTable, times: int, offsets: Float, rate_limit: Float) -> float:
    """Return the shortest duration of a movement of joints from rest that keeps velocity limits, shape (D,), [s]."""
    most = 0.0
    for instant in range(1, len(table.order) - 1):
        for d in range(offsets.shape[1]):
            rate = 0.0
            for i in range(len(offsets)):
                rate += table.rate[times, instant, i] * offsets[i, d]
            most = max(most, abs(rate) / rate_limit[d])
    return max(most, SHORTEST_DURATION)
