"""Refinement of via-points by the gradient of clearance and jerk, compiled.

The via-points of a movement are moved by damped least squares (K. Levenberg 1944, D. W. Marquardt 1963). The residuals
are, at some instants, what is missing to a wanted clearance, for the deepest sphere of each body and obstacle and of
each pair of bodies, and what is missing to a margin from the joint limits. To the sum of their squares comes the jerk
cost, which is a quadratic form of the via-points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.inverse_kinematics import solve_symmetric
from viapoint.envs.arms.kinematics import point_jacobian
from viapoint.envs.common.arrays import Float, Int
from viapoint.envs.geometry.clearance import (
    WINDOW,
    Placed,
    bounds_memory,
    fastest,
    group_clearance,
    memory,
    movement_clearance,
    nearest_spheres,
    place,
    point_distance_and_normal,
)
from viapoint.envs.geometry.compiled import clock, compiled, inlined, inner, kernel
from viapoint.envs.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.outcome import straight_jerk_cost
from viapoint.training.planning.movements import (
    OUTSIDE,
    Movement,
    MovementTable,
    Setting,
    best_times,
    joints_at,
    least_clearance,
    memory_of,
)

CONTACT_WEIGHT = 400.0  # Weight of the square of a missing distance, [1/m^2] and [1/rad^2]
# Wanted clearance of the arm from itself, [m]; some bodies are never much farther from one another
OWN_CLEARANCE = 0.01
RANGE_MARGIN = 0.01  # Wanted distance of joints from their limits, [rad]
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-4, 1e3  # Damping at first, and its bounds
# Instants near the ends in which a movement from rest or to rest goes less than a hundredth of its way
SLOW = 4
# Least clearance at the instants that are looked at with which a refinement may end early, [m] and [rad]
FREE = 0.005
# Factors on the damping after a step that was better, and after one that was not
EASIER, HARDER = 0.3, 5.0
FLAT = 0.02  # Share of CONTACT_WEIGHT that damps directions in which nothing is known
# Longest step of a coordinate in joint space, [rad], and in hand space, [m]
LONGEST_STEP = 0.6, 0.15
# Way of a straight movement whose jerk cost is the unit for shorter ones, too, in joint space, [rad], and in hand
# space, [m].
SHORT = 2.0, 0.2
SINGULAR = 1e-3  # Least determinant of the arm's Jacobian in the plane that is believed, [m^2]


class Aim(NamedTuple):
    """Aim of a refinement."""

    clearance: float  # Wanted clearance from obstacles, [m]
    jerk: float  # Weight of the jerk cost in units of `unit`
    gain: float  # Relative gain of the objective below which a free movement is good enough


ITERATIONS = 20  # Greatest number of iterations of a refinement
STRIDE = 2  # Step between the instants that are looked at
# Aim of the refinement of a seed: it has little weight of jerk, and ends as soon as the movement is free.
SEED = Aim(clearance=0.04, jerk=0.1, gain=1.0)
# Aim of a second refinement of movements that are nearly free: in a narrow passage, a wide clearance on one side is
# paid for with contact on the other.
NARROW = Aim(clearance=0.008, jerk=0.02, gain=1.0)
NEARLY = -0.03  # Least clearance of movements that are nearly free, [m]
# Aim of the first attempt to polish a free movement. The weight of jerk falls until the movement stays free and becomes
# smoother, and then grows until it does not.
POLISH = Aim(clearance=0.02, jerk=1.0, gain=0.01)
ATTEMPTS, HEAVIER, LIGHTER = 8, 2.0, 0.3
LITTLE = 0.97  # Least factor on the jerk cost by an attempt after which another one is worth its time
# Clearance beyond the margin that is asked for: distances of point clouds that are cut off there are rounded, [m]
ROUNDING = 1e-6
SMOOTH = 1.1  # Relative jerk cost with which a movement that was polished is polished no more


class Found(NamedTuple):
    """Movements that were found from S seeds."""

    vias: Float  # Via-points as offsets from the start, shape (S, K, D)
    times: Int  # Indices of passage times in the table, shape (S,)
    cost: Float  # Jerk cost in unit time, shape (S,); infinite for movements that are not free
    # Least clearance at many instants, shape (S,), [m]; -1 for movements in contact. It is less than the margin for
    # movements in narrow passages, which are not polished and do not count as free.
    clearance: Float


class _Work(NamedTuple):
    """Arm, obstacles and memory of a refinement in a space of D dimensions, with J joints and K via-points."""

    setting: Setting
    obstacles: Obstacles
    position: Float
    joints: Float
    placed: Placed
    pull: Float  # Derivative of a residual by the joints, shape (J,)
    row: Float  # Derivative of a residual by the coordinates, shape (D,)
    jacobian: Float
    square: Float  # Sum of the products of rows at one instant, shape (D, D)
    force: Float  # Sum of residual times row at one instant, shape (D,)
    gram: Float
    # Place of the ball of each group at the last look for obstacles, its clearance, and the time, shape (G, 5)
    seen: Float
    speed: float  # Greatest speed of an obstacle, [m/s]


@compiled
def _work(setting: Setting, columns: int, dimension: int, obstacles: Obstacles) -> _Work:
    """Return memory for a refinement."""
    joints = len(setting.joint_range)
    return _Work(
        setting,
        obstacles,
        np.empty(dimension),
        np.empty(joints),
        memory(setting.chain, setting.spheres),
        np.empty(joints),
        np.empty(dimension),
        np.empty((3, joints)),
        np.empty((dimension, dimension)),
        np.empty(dimension),
        np.empty((columns, columns)),
        np.empty((len(setting.spheres.link), 5)),
        fastest(obstacles, 0),
    )


@inner
def _add_residual(missing: float, work: _Work) -> None:
    """Add a residual, whose derivative by the joints is in `work.pull`, to those of an instant."""
    row, dimension = work.row, len(work.row)
    if work.setting.of_hand:
        # Joints q and hand x of the plane: dq = J^-1 dx, so the derivative by x is J^-T times that by q.
        chain, placed = work.setting.chain, work.placed
        point_jacobian(
            chain, placed.rotation, placed.origin, 2, work.position[0], work.position[1], 0.0, work.jacobian
        )
        a, b = work.jacobian[0, 0], work.jacobian[0, 1]
        c, d = work.jacobian[1, 0], work.jacobian[1, 1]
        determinant = a * d - b * c
        if abs(determinant) < SINGULAR:
            determinant = SINGULAR if determinant >= 0.0 else -SINGULAR
        row[0] = (d * work.pull[0] - c * work.pull[1]) / determinant
        row[1] = (a * work.pull[1] - b * work.pull[0]) / determinant
    else:
        for j in range(dimension):
            row[j] = work.pull[j]
    for i in range(dimension):
        if row[i] != 0.0:
            work.force[i] += CONTACT_WEIGHT * missing * row[i]
            for j in range(i + 1):
                work.square[i, j] += CONTACT_WEIGHT * row[i] * row[j]


@inner
def _pull(work: _Work, sphere: int, link: int, x: float, y: float, z: float, sign: float) -> None:
    """Add to `work.pull` the derivative of the way of a sphere in a direction (x, y, z) by the joints, times a sign."""
    placed, sliding = work.placed, work.setting.chain.sliding
    u = placed.centre[sphere, 0]
    v = placed.centre[sphere, 1]
    w = placed.centre[sphere, 2]
    for j in range(link):
        a = placed.rotation[j + 1, 0, 2]
        b = placed.rotation[j + 1, 1, 2]
        c = placed.rotation[j + 1, 2, 2]
        if sliding[j]:
            way = a * x + b * y + c * z
        else:
            p = u - placed.origin[j + 1, 0]
            q = v - placed.origin[j + 1, 1]
            r = w - placed.origin[j + 1, 2]
            way = x * (b * r - c * q) + y * (c * p - a * r) + z * (a * q - b * p)
        work.pull[j] += sign * way


@inlined
def _add_obstacles(time: float, wanted: float, work: _Work) -> tuple[float, float]:
    """Add the residuals of the placed arm from the obstacles; return their sum of squares, and the least clearance."""
    spheres, obstacles, placed = work.setting.spheres, work.obstacles, work.placed
    total, nearest = 0.0, wanted
    for group in range(len(spheres.link)):
        if spheres.link[group] == 0:
            continue
        u = placed.ball[group, 0]
        v = placed.ball[group, 1]
        w = placed.ball[group, 2]
        size = spheres.ball_radius[group]
        # After a far look, no obstacle matters to a group before its ball has come as much nearer.
        seen = work.seen[group]
        way = math.sqrt((u - seen[0]) ** 2 + (v - seen[1]) ** 2 + (w - seen[2]) ** 2)
        if seen[3] - way - work.speed * abs(time - seen[4]) >= wanted:
            continue
        far = wanted + WINDOW
        seen[0], seen[1], seen[2], seen[3], seen[4] = u, v, w, far, time
        for row in range(obstacles.kind.shape[1]):
            if obstacles.kind[0, row] == ABSENT:
                continue
            limit = far + size
            apart = point_distance_and_normal(obstacles, 0, row, u, v, w, time, limit)[0] - size
            seen[3] = min(seen[3], apart)
            if apart >= wanted:
                continue
            least, sphere, (x, y, z) = group_clearance(
                spheres, placed, group, obstacles, 0, row, time, wanted, -1e9
            )
            if sphere < 0:
                continue
            work.pull[:] = 0.0
            _pull(work, sphere, spheres.link[group], x, y, z, -1.0)
            nearest = min(nearest, least)
            missing = wanted - least
            total += missing * missing
            _add_residual(missing, work)
    return total, nearest


@inlined
def _add_own(wanted: float, work: _Work) -> tuple[float, float]:
    """Add the residuals of the placed arm from itself; return their sum of squares, and the least clearance."""
    spheres, placed, total, nearest = work.setting.spheres, work.placed, 0.0, wanted
    wanted += spheres.self_allowance
    for pair in range(len(spheres.pairs)):
        least, one, other = nearest_spheres(spheres, placed, pair, wanted, -1e9)
        if one < 0:
            continue
        x = placed.centre[one, 0] - placed.centre[other, 0]
        y = placed.centre[one, 1] - placed.centre[other, 1]
        z = placed.centre[one, 2] - placed.centre[other, 2]
        length = math.sqrt(x * x + y * y + z * z) + 1e-9
        x, y, z = x / length, y / length, z / length
        work.pull[:] = 0.0
        _pull(work, one, spheres.link[spheres.pairs[pair, 0]], x, y, z, -1.0)
        _pull(work, other, spheres.link[spheres.pairs[pair, 1]], x, y, z, 1.0)
        nearest = min(nearest, least - spheres.self_allowance)
        missing = wanted - least
        total += missing * missing
        _add_residual(missing, work)
    return total, nearest


@inlined
def _add_ranges(reached: bool, work: _Work) -> tuple[float, float]:
    """Add what is missing to the margin from the joint limits; return the sum of squares, and the least distance."""
    total, nearest, joints, limits = 0.0, RANGE_MARGIN, work.joints, work.setting.joint_range
    for j in range(len(joints)):
        low = limits[j, 0] + RANGE_MARGIN - joints[j]
        high = joints[j] - limits[j, 1] + RANGE_MARGIN
        missing = max(low, high)
        if missing > 0.0 and (reached or j == 0):
            work.pull[:] = 0.0
            work.pull[j] = -1.0 if low > high else 1.0
            total += missing * missing
            nearest = min(nearest, RANGE_MARGIN - missing)
            _add_residual(missing, work)
    if not reached:
        # The hand is beyond the reach: a pull towards where the straight or bent arm has it.
        chain, placed = work.setting.chain, work.placed
        x = y = 0.0
        last = len(joints)
        for a in range(3):
            x += placed.rotation[last, 0, a] * chain.tool_origin[a]
            y += placed.rotation[last, 1, a] * chain.tool_origin[a]
        x = work.position[0] - placed.origin[last, 0] - x
        y = work.position[1] - placed.origin[last, 1] - y
        missing = math.sqrt(x * x + y * y) + 1e-9
        x, y = x / missing, y / missing
        missing += RANGE_MARGIN
        total += missing * missing
        work.force[0] += CONTACT_WEIGHT * missing * x
        work.force[1] += CONTACT_WEIGHT * missing * y
        work.square[0, 0] += CONTACT_WEIGHT * x * x
        work.square[1, 0] += CONTACT_WEIGHT * x * y
        work.square[1, 1] += CONTACT_WEIGHT * y * y
        nearest = -missing
    return total, nearest


@kernel
def _assemble(
    movement: Movement, aim: Aim, unit: float, limit: float, hessian: Float, gradient: Float, work: _Work
) -> tuple[float, float]:
    """Fill in matrix and gradient of the objective; return the objective, and the least clearance, [m] or [rad].

    It ends as soon as the objective is `limit` or more, which is then returned.
    """
    setting, table, times, offsets = work.setting, movement.table, movement.times, movement.offsets
    columns, dimension = offsets.shape
    vias = columns - 3
    weight = aim.jerk * 2.0 / (STRIDE * unit)
    hessian[:] = 0.0
    gradient[:] = 0.0
    objective = 0.0
    for a in range(columns):
        for b in range(columns):
            factor = weight * table.cost[times, a, b]
            for d in range(dimension):
                objective += factor * offsets[a, d] * offsets[b, d]
                if a < vias:
                    gradient[a * dimension + d] += factor * offsets[b, d]
                    if b < vias:
                        hessian[a * dimension + d, b * dimension + d] += factor
    contact, nearest, last = 0.0, 1.0, len(table.order) - 1
    resting = True
    for d in range(dimension):
        resting = resting and offsets[vias + 1, d] == 0.0 and offsets[vias + 2, d] == 0.0
    begin = STRIDE // 2 + (SLOW if resting else 0)
    work.seen[:] = -1e9
    for k in range(begin, last + 1 - SLOW, STRIDE):
        reached = joints_at(setting, movement, k, work.position, work.joints)
        place(setting.chain, setting.spheres, work.joints, work.placed)
        work.square[:] = 0.0
        work.force[:] = 0.0
        time = movement.duration * k / last
        from_obstacles, first = _add_obstacles(time, aim.clearance, work)
        from_itself, second = 0.0, OWN_CLEARANCE
        if (k - begin) % (4 * STRIDE) == 0:  # bodies of the arm are less often near one another
            from_itself, second = _add_own(OWN_CLEARANCE, work)
        from_ranges, third = _add_ranges(reached or not setting.of_hand, work)
        missing = from_obstacles + from_itself + from_ranges
        if missing == 0.0:
            continue
        contact += missing
        if objective + CONTACT_WEIGHT * contact >= limit:
            return limit, nearest
        # Some bodies are always near one another: only their contact counts.
        nearest = min(nearest, first, third)
        if second < 0.0:
            nearest = min(nearest, second)
        for a in range(vias):
            share = table.basis[times, k, a]
            for i in range(dimension):
                gradient[a * dimension + i] += share * work.force[i]
            for b in range(a + 1):
                factor = share * table.basis[times, k, b]
                for i in range(dimension):
                    for j in range(dimension):
                        value = work.square[i, j] if i >= j else work.square[j, i]
                        hessian[a * dimension + i, b * dimension + j] += factor * value
    return objective + CONTACT_WEIGHT * contact, nearest


@inlined
def _expected_gain(hessian: Float, gradient: Float, step: Float, factor: float) -> float:
    """Return by how much a step lowers the objective if its model is right; matrix and gradient are half of its own."""
    gain = 0.0
    for i in range(len(step)):
        curvature = hessian[i, i] * step[i]
        for j in range(i):
            curvature += 2.0 * hessian[i, j] * step[j]
        gain -= factor * step[i] * (2.0 * gradient[i] + factor * curvature)
    return gain


@kernel
def _copy(source: Float, target: Float) -> None:
    """Copy rows; for assignments of arrays Numba would compile messages about shapes, which takes seconds."""
    for row in range(len(source)):
        for column in range(source.shape[1]):
            target[row, column] = source[row, column]


@compiled
def _refine(movement: Movement, bounds: Float, aim: Aim, unit: float, work: _Work) -> int:
    """Move the via-points of a movement, the first rows of its offsets, and return the index of its passage times."""
    setting = work.setting
    table, _, start, offsets, duration = movement
    columns, dimension = offsets.shape
    vias = columns - 3
    size = vias * dimension
    hessian = np.empty((size, size))
    other_hessian = np.empty((size, size))
    gradient, other_gradient = np.empty(size), np.empty(size)
    system = np.empty((size, size))
    step = np.empty(size)
    trial = offsets.copy()
    longest = LONGEST_STEP[1] if setting.of_hand else LONGEST_STEP[0]
    times, _ = best_times(table, offsets, work.gram)
    movement = Movement(table, times, start, offsets, duration)
    objective, nearest = _assemble(movement, aim, unit, np.inf, hessian, gradient, work)
    damping = DAMPING
    for _ in range(ITERATIONS):
        largest = 0.0
        for i in range(size):
            step[i] = -gradient[i]
            for j in range(i + 1):
                system[i, j] = hessian[i, j]
            system[i, i] += damping * (FLAT * CONTACT_WEIGHT + hessian[i, i])
        for i in range(size):
            a, d = i // dimension, i % dimension
            outward = bounds[0, a, d] if gradient[i] > 0.0 else bounds[1, a, d]
            if offsets[a, d] == outward:  # the others do not count on what a bound forbids
                step[i] = 0.0
                for j in range(size):
                    system[max(i, j), min(i, j)] = 1.0 if i == j else 0.0
        solve_symmetric(system, step, size)
        for i in range(size):
            largest = max(largest, abs(step[i]))
        factor = min(1.0, longest / max(largest, 1e-12))
        if nearest >= FREE and _expected_gain(hessian, gradient, step, factor) < aim.gain * objective:
            break
        for a in range(vias):
            for d in range(dimension):
                wanted = offsets[a, d] + factor * step[a * dimension + d]
                if not setting.of_hand:
                    low = setting.joint_range[d, 0] - start[d]
                    high = setting.joint_range[d, 1] - start[d]
                    wanted = min(max(wanted, low), high)
                trial[a, d] = min(max(wanted, bounds[0, a, d]), bounds[1, a, d])
        other, _ = best_times(table, trial, work.gram)
        movement = Movement(table, other, start, trial, duration)
        value, apart = _assemble(movement, aim, unit, objective, other_hessian, other_gradient, work)
        if value < objective:
            nearest = apart
            done = objective - value < aim.gain * objective and nearest >= FREE
            _copy(trial[:vias], offsets)
            hessian, other_hessian = other_hessian, hessian
            gradient, other_gradient = other_gradient, gradient
            times, objective = other, value
            damping = max(EASIER * damping, LEAST_DAMPING)
            if done:
                break
        else:
            damping = HARDER * damping
            if damping > MOST_DAMPING:
                break
    return int(times)


def unit_of_jerk(way: Float, of_hand: bool) -> float:
    """Return the unit of jerk costs in unit time: the cost of a straight movement, if it is not too short."""
    length = max(float(np.linalg.norm(way)), SHORT[of_hand])
    return float(straight_jerk_cost(length, 1.0))


@compiled
def refine_seeds(
    setting: Setting,
    table: MovementTable,
    fine: MovementTable,
    start: Float,
    fixed: Float,
    seeds: Float,
    bounds: Float,
    duration: float,
    obstacles: Obstacles,
    margin: float,
    unit: float,
    smooth: float,
    known: float,
    enough: int,
    patience: float,
) -> tuple[int, Found]:
    """Refine movements from seeds one after the other, and return how many were tried, and what was found.

    Args:
        setting: Arm and space.
        table: Table of movements.
        fine: Table with more instants, for the last check.
        start: Start, shape (D,).
        fixed: Offsets of the goal, initial velocity and acceleration, shape (3, D).
        seeds: Via-points as offsets from the start, shape (S, K, D).
        bounds: Least and greatest offsets of the via-points beside joint limits, shape (2, K, D).
        duration: Duration during which obstacles move, [s].
        obstacles: Obstacles of one scene.
        margin: Least clearance of movements that count as free, [m].
        unit: Unit of jerk costs in unit time.
        smooth: Jerk cost in this unit with which a movement that was polished once is smooth enough.
        known: Jerk cost of the best known movement, in unit time. A movement that costs as much after it was polished
            once hardly ever becomes better, and is polished no more.
        enough: Number of free movements after which to stop.
        patience: Time after which no further refinement begins, [s]; with up to three via-points each takes less than a
            millisecond.
    """
    end = clock() + patience
    number, vias, dimension = seeds.shape
    work = _work(setting, vias + 3, dimension, obstacles)
    found = Found(seeds.copy(), np.zeros(number, np.int64), np.full(number, np.inf), np.full(number, -1.0))
    # The refined movement, and the polished ones, each of which is smoother than the one before.
    offsets = np.empty((ATTEMPTS + 1, vias + 3, dimension))
    for stage in range(ATTEMPTS + 1):
        _copy(fixed, offsets[stage, vias:])
    times = np.empty(ATTEMPTS + 1, np.int64)
    trial = np.empty((vias + 3, dimension))
    free, tried = 0, 0
    for each in range(number):
        if each and clock() > end:
            break
        tried += 1
        _copy(seeds[each], offsets[0])
        for aim in (SEED, NARROW):
            movement = Movement(table, 0, start, offsets[0], duration)
            times[0] = _refine(movement, bounds, aim, unit, work)
            movement = Movement(table, times[0], start, offsets[0], duration)
            apart = _clearance(setting, movement, obstacles, margin, NEARLY)
            if not NEARLY < apart < margin or clock() > end:
                break
        if apart < 0.0:
            # The seed itself may have been free, in a passage that the refinement has left.
            _copy(seeds[each], trial[:vias])
            _copy(fixed, trial[vias:])
            first, _ = best_times(table, trial, work.gram)
            movement = Movement(table, first, start, trial, duration)
            if is_free(setting, movement, obstacles, margin):
                apart, times[0] = margin, first
                _copy(trial, offsets[0])
        _copy(offsets[0, :vias], found.vias[each])
        found.times[each] = times[0]
        if apart < margin:
            if apart >= 0.0:
                movement = Movement(fine, times[0], start, offsets[0], duration)
                exact = exact_clearance(setting, movement, obstacles, margin)
                found.clearance[each] = min(exact, apart)
            continue
        stage, weight = 0, POLISH.jerk
        _, cost = best_times(table, offsets[0], work.gram)
        for _ in range(ATTEMPTS):
            if clock() > end:
                break
            _copy(offsets[stage], trial)
            movement = Movement(table, 0, start, trial, duration)
            aim = Aim(POLISH.clearance, weight, POLISH.gain)
            other = _refine(movement, bounds, aim, unit, work)
            _, less = best_times(table, trial, work.gram)
            movement = Movement(table, other, start, trial, duration)
            if less >= cost or not is_free(setting, movement, obstacles, margin):
                if stage:
                    break
                weight *= LIGHTER
                continue
            little = less > LITTLE * cost
            stage += 1
            _copy(trial, offsets[stage])
            times[stage], cost = other, less
            weight *= HEAVIER
            if little or cost < smooth * unit or cost >= known:
                break
        while stage >= 0:
            movement = Movement(fine, times[stage], start, offsets[stage], duration)
            clearance = exact_clearance(setting, movement, obstacles, margin)
            if clearance >= margin:
                break
            stage -= 1
        if stage < 0:
            continue
        _copy(offsets[stage, :vias], found.vias[each])
        found.times[each] = times[stage]
        found.clearance[each] = clearance
        _, found.cost[each] = best_times(table, offsets[stage], work.gram)
        free += 1
        if free >= enough:
            break
    return tried, found


@inlined
def _clearance(
    setting: Setting, movement: Movement, obstacles: Obstacles, margin: float, floor: float
) -> float:
    """Return the least clearance of a movement at the instants of a table, [m]; exact from `floor` to `margin`."""
    memory = memory_of(setting, movement.table, len(movement.start))
    return least_clearance(setting, movement, obstacles, 0, margin + ROUNDING, floor, 1e9, memory)


@compiled
def is_free(setting: Setting, movement: Movement, obstacles: Obstacles, margin: float) -> bool:
    """Return True if a movement keeps a margin at the instants of a table; it stops at the first that does not."""
    return bool(_clearance(setting, movement, obstacles, margin, margin) >= margin)


@compiled
def exact_clearance(setting: Setting, movement: Movement, obstacles: Obstacles, margin: float) -> float:
    """Return the least clearance of a movement at all times, at most 1, [m]; OUTSIDE out of reach.

    Between two instants of the table, the joints are taken to move straight. There the clearance may be less by
    ROUGHLY, but not less than the margin if the result is not, see
    :func:`~viapoint.envs.geometry.clearance.movement_clearance`.
    """
    number = len(movement.table.order)
    position = np.empty(len(movement.start))
    path = np.empty((number, len(setting.joint_range)))
    for k in range(number):
        if not joints_at(setting, movement, k, position, path[k]):
            return OUTSIDE
    placed = memory(setting.chain, setting.spheres)
    step = movement.duration / (number - 1)
    apart, own = movement_clearance(
        setting.chain, setting.spheres, setting.reach, path, obstacles, 0, 0.0, step, placed,
        bounds_memory(setting.chain, setting.spheres, True), margin,
    )  # fmt: skip
    return min(apart, own)
