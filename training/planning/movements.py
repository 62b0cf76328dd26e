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
from typing import NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.chain import Chain, Spheres
from viapoint.envs.arms.inverse_kinematics import solve_planar
from viapoint.envs.common.types import Float, Int
from viapoint.envs.geometry.clearance import Placed, obstacle_clearance, place, self_clearance
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.kernels import kernel
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.plans import SHORTEST_DURATION

INSTANTS = 64
"""Instants of a movement that are checked; a power of two."""
FINE_INSTANTS = 256
"""Instants of a movement that is checked once more before it is executed; a power of two."""
OUTSIDE = -2.0
"""Clearance of movements that leave the reach or the joint ranges, [m]."""
TABLES: dict[int, list[tuple[float, ...]]] = {
    0: [()],
    1: [(float(t),) for t in np.linspace(0.1, 0.9, 161)],
    2: [
        (float(a), float(b))
        for a, b in itertools.product(np.linspace(0.1, 0.7, 16), np.linspace(0.3, 0.9, 16))
        if b - a > 0.14
    ],
    3: list(itertools.combinations([float(t) for t in np.linspace(0.1, 0.9, 13)], 3)),
}
"""Passage times in unit time by the number of via-points; more via-points are passed at even times."""
STRIDE = 4
"""Step between the passage times whose cost is computed first, with one via-point; those beside the best follow."""


class MovementTable(NamedTuple):
    """Movements through K via-points in unit time at N instants, with M sets of passage times."""

    durations: Float
    """Durations of the segments, shape (M, K + 1)."""
    basis: Float
    """Influence of each offset on the position at each instant, shape (M, N, K + 3)."""
    rate: Float
    """Influence of each offset on the velocity at each instant, shape (M, N, K + 3)."""
    bend: Float
    """Influence of each offset on the acceleration at each instant, shape (M, N, K + 3)."""
    cost: Float
    """Matrices of the jerk cost, half the integral of the squared jerk, shape (M, K + 3, K + 3)."""
    order: Int
    """Instants in an order that looks everywhere soon, shape (N,)."""


class Setting(NamedTuple):
    """Arm and space of movements, as compiled functions take them."""

    chain: Chain
    spheres: Spheres
    """Spheres that can touch the obstacles at all."""
    joint_range: Float
    """Shape (J, 2), [rad]."""
    of_hand: bool
    """True if movements are of the hand in the plane, False if they are of the joints."""
    reach: Float
    """Reach of the joints, see :func:`~viapoint.envs.geometry.clearance.travel`, shape (J,), [m]."""
    hand_alone: bool
    """True if the only sphere is the one around the hand of an arm in the plane."""


@functools.cache
def movement_table(n_via: int) -> MovementTable:
    """Return the table of movements through some via-points."""
    sets = TABLES.get(n_via, [tuple(np.arange(1, n_via + 1) / (n_via + 1))])
    return table_with(np.array([np.diff((0.0, *times, 1.0)) for times in sets]))


def table_with(durations: Float, number_of_instants: int = INSTANTS) -> MovementTable:
    """Return the table of movements whose segments take some durations in unit time, shape (M, K + 1)."""
    n_via = durations.shape[1] - 1
    number, columns = len(durations), n_via + 3
    # One movement in one dimension for each column: a unit offset, or a unit of initial velocity or acceleration.
    waypoints = np.zeros((number, columns, n_via + 2, 1))
    velocity, acceleration = np.zeros((2, number, columns, 1))
    for column in range(n_via + 1):
        waypoints[:, column, column + 1] = 1.0
    velocity[:, n_via + 1] = 1.0
    acceleration[:, n_via + 2] = 1.0
    each = np.repeat(durations[:, None], columns, axis=1)
    movements = primitives.through(waypoints, each, start_velocity=velocity, start_acceleration=acceleration)
    instants = np.linspace(0.0, 1.0, number_of_instants)
    basis, rate, bend = (
        np.ascontiguousarray(part[..., 0].transpose(0, 2, 1)) for part in movements.sample(instants)
    )
    # The square of the jerk has degree four in each segment: three Gauss-Legendre nodes are exact.
    nodes, weights = np.polynomial.legendre.leggauss(3)
    begin = np.cumsum(durations, axis=-1) - durations
    times = begin[..., None] + 0.5 * durations[..., None] * (1.0 + nodes)
    jerk = movements(np.repeat(times.reshape(number, 1, -1), columns, axis=1), 3)[..., 0]
    share = (0.5 * durations[..., None] * weights).reshape(number, -1)
    cost = 0.5 * np.einsum("mit,mjt,mt->mij", jerk, jerk, share)
    bits = number_of_instants.bit_length() - 1
    order = np.array([int(f"{k:0{bits}b}"[::-1], 2) for k in range(number_of_instants)])
    return MovementTable(durations, basis, rate, bend, cost, order)


@kernel
def best_times(table: MovementTable, offsets: Float, gram: Float) -> tuple[int, float]:
    """Return the passage times of the least jerk cost, as an index of the table, and this cost in unit time.

    Args:
        table: Table of movements.
        offsets: Offsets w, shape (K + 3, D).
        gram: Memory, shape (K + 3, K + 3).
    """
    columns, dimension = offsets.shape
    for i in range(columns):
        for j in range(i + 1):
            total = 0.0
            for d in range(dimension):
                total += offsets[i, d] * offsets[j, d]
            gram[i, j] = total if i == j else 2.0 * total
    least, found = 1e300, 0
    stride = STRIDE if columns == 4 and len(table.cost) > STRIDE else 1
    for m in range(0, len(table.cost), stride):
        cost = _cost(table, m, gram)
        if cost < least:
            least, found = cost, m
    coarse = found
    for m in range(max(coarse - stride + 1, 0), min(coarse + stride, len(table.cost))):
        cost = _cost(table, m, gram)
        if cost < least:
            least, found = cost, m
    return found, least


@kernel
def _cost(table: MovementTable, times: int, gram: Float) -> float:
    """Return the jerk cost of a movement in unit time from the scalar products of its offsets."""
    cost = 0.0
    for i in range(len(gram)):
        for j in range(i + 1):
            cost += table.cost[times, i, j] * gram[i, j]
    return cost


@kernel
def position_at(
    table: MovementTable, times: int, instant: int, start: Float, offsets: Float, out: Float
) -> None:
    """Fill in the position of a movement at an instant, shape (D,)."""
    for d in range(offsets.shape[1]):
        value = start[d]
        for i in range(offsets.shape[0]):
            value += table.basis[times, instant, i] * offsets[i, d]
        out[d] = value


@kernel
def joints_at(
    setting: Setting,
    table: MovementTable,
    times: int,
    instant: int,
    start: Float,
    offsets: Float,
    position: Float,
    joints: Float,
) -> bool:
    """Fill in position and joints at an instant of a movement, and return True within reach and joint ranges.

    The arguments are those of :func:`place_arm`.
    """
    position_at(table, times, instant, start, offsets, position)
    if setting.of_hand:
        return bool(solve_planar(setting.chain, setting.joint_range, position[0], position[1], joints))
    for j in range(len(joints)):
        joints[j] = position[j]
        if joints[j] < setting.joint_range[j, 0] or joints[j] > setting.joint_range[j, 1]:
            return False
    return True


@kernel
def place_arm(
    setting: Setting,
    table: MovementTable,
    times: int,
    instant: int,
    start: Float,
    offsets: Float,
    position: Float,
    joints: Float,
    placed: Placed,
) -> bool:
    """Place the arm at an instant of a movement, and return True within reach and joint ranges.

    `position`, shape (D,), `joints`, shape (J,), and `placed` are memory; the other arguments are those of
    :func:`least_clearance`.
    """
    if not joints_at(setting, table, times, instant, start, offsets, position, joints):
        return False
    if setting.hand_alone:
        placed.ball[0, 0] = position[0]
        placed.ball[0, 1] = position[1]
        placed.ball[0, 2] = 0.0
        for axis in range(3):
            placed.centre[0, axis] = placed.ball[0, axis]
        placed.known[0] = True
    else:
        place(setting.chain, setting.spheres, joints, placed)
    return True


@kernel
def least_clearance(
    setting: Setting,
    table: MovementTable,
    times: int,
    start: Float,
    offsets: Float,
    duration: float,
    obstacles: Obstacles,
    scene: int,
    least: float,
    floor: float,
    until: float,
    place_of_hand: Float,
    joints: Float,
    placed: Placed,
) -> float:
    """Return the least clearance of a movement, at most `least`, [m]; OUTSIDE where it leaves reach or joint ranges.

    The search stops at the first clearance below `floor`.

    Args:
        setting: Arm and space.
        table: Table of movements.
        times: Index of the passage times.
        start: Start, shape (D,).
        offsets: Offsets w, shape (K + 3, D).
        duration: Duration, [s], during which obstacles move.
        obstacles: Obstacles of some scenes.
        scene: Index of the scene.
        least: Greatest clearance of interest, [m].
        floor: Clearance below which the exact value does not matter, [m].
        until: Time after which clearance does not matter, [s].
        place_of_hand: Memory, shape (D,).
        joints: Memory, shape (J,).
        placed: Memory of the clearance functions.
    """
    for k in range(len(table.order)):
        instant = table.order[k]
        time = duration * instant / (len(table.order) - 1)
        if time > until:  # obstacles may change course until then, joint ranges do not
            if not joints_at(setting, table, times, instant, start, offsets, place_of_hand, joints):
                return OUTSIDE
            continue
        if not place_arm(setting, table, times, instant, start, offsets, place_of_hand, joints, placed):
            return OUTSIDE
        least = obstacle_clearance(setting.spheres, placed, obstacles, scene, time, least, floor)
        if least < floor:
            return least
        least = self_clearance(setting.spheres, placed, least, floor)
        if least < floor:
            return least
    return least


@compiled
def table_costs(table: MovementTable, offsets: Float) -> tuple[Int, Float]:
    """Return passage times and jerk costs in unit time of H movements, shape (H,) each, see :func:`best_times`.

    Args:
        table: Table of movements.
        offsets: Offsets w, shape (H, K + 3, D).
    """
    number, columns = offsets.shape[:2]
    gram = np.empty((columns, columns))
    times, cost = np.empty(number, np.int64), np.empty(number)
    for i in range(number):
        times[i], cost[i] = best_times(table, offsets[i], gram)
    return times, cost


@compiled
def shortest_durations(table: MovementTable, times: Int, offsets: Float, rate_limit: Float) -> Float:
    """Return the shortest durations of H movements of joints that keep velocity limits, shape (H,), [s].

    Args:
        table: Table of movements.
        times: Indices of the passage times, shape (H,).
        offsets: Offsets w of movements from rest, shape (H, K + 3, D).
        rate_limit: Velocity limits, shape (D,).
    """
    found = np.empty(len(offsets))
    for h in range(len(offsets)):
        most = 0.0
        for instant in range(1, len(table.order) - 1):
            for d in range(offsets.shape[2]):
                rate = 0.0
                for i in range(offsets.shape[1]):
                    rate += table.rate[times[h], instant, i] * offsets[h, i, d]
                most = max(most, abs(rate) / rate_limit[d])
        found[h] = max(most, SHORTEST_DURATION)
    return found
