"""Starts and goals of drawn scenes: compiled attempts at free configurations that one would reach for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.core.arms.chain import Chain, Spheres
from viapoint.envs.core.arms.inverse_kinematics import solve_planar, solve_pose, solve_position
from viapoint.envs.core.arms.kinematics import tool_position
from viapoint.envs.core.geometry.clearance import Placed, memory, obstacle_clearance, place, self_clearance
from viapoint.envs.core.geometry.compiled import compiled
from viapoint.envs.core.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.core.scenes.layout import PLACE, ROW
from viapoint.envs.core.scenes.scene import row_clearance

PAIRS, TRIES = 4, 3
"""Pairs of start and goal for a layout, and attempts at each end."""
HOME, REACHING = 0.4, 0.8
"""Shares of starts at home or near it; of these and starts in places of goals. Other starts are free configurations."""
FREE_GOALS = 0.1
"""Share of goals that are free configurations, where the layout has places."""
EXCHANGED = 0.25
"""Share of pairs whose start and goal are exchanged, where the layout has no places of starts."""
JITTER = 0.3
"""Greatest deviation from home of half of the starts there, [rad]."""
LIMIT_MARGIN = 0.02
"""Least distance of ends from the joint limits, [rad]."""
SELF_MARGIN = 0.005
"""Least clearance of the arm from itself at ends, [m]."""
INSTANTS = 32
"""Instants at which the straight movement is looked at."""
ROLL = 0.3
"""Greatest deviation of the tool's roll about its axis from quarter turns, [rad]."""


class Mover(NamedTuple):
    """Arm and the space in which it moves, as compiled functions read them."""

    chain: Chain
    spheres: Spheres
    joint_range: Float
    """Shape (J, 2), [rad] or [m]."""
    velocity_limit: Float
    """Shape (J,), [rad/s] or [m/s]."""
    home: Float
    """Shape (J,), [rad] or [m]."""
    plane: bool
    """True for an arm of two joints in the plane."""
    of_hand: bool
    """True if movements are planned in hand space, False for joint space."""
    margin: float
    """Least clearance of ends from obstacles, [m]."""
    least_way: float
    """Least length of the way from start to goal in joint space, [rad]."""


class Attempts(NamedTuple):
    """One attempt at each of N scenes: layouts as padded tables, and random numbers."""

    rows: Float
    """Obstacles, shape (N, W, ROW)."""
    count: Int
    """Numbers of obstacles, shape (N,); -1 for scenes whose obstacles are given."""
    keep: Int
    """Numbers of obstacles that are kept, or 0, shape (N,)."""
    places: Float
    """Places of starts, then those of goals, shape (N, 2, P, PLACE)."""
    n_places: Int
    """Numbers of both, shape (N, 2)."""
    fixed: Bool
    """True for starts and goals that are given, shape (N, 2)."""
    numbers: Float
    """Uniform random numbers, shape (N, PAIRS, 2, :func:`numbers_of_end`)."""

    @classmethod
    def empty(cls, number: int, most_rows: int, most_places: int, joints: int) -> Attempts:
        """Return tables without numbers in them."""
        return cls(
            np.zeros((number, most_rows, ROW)),
            np.zeros(number, np.int64),
            np.zeros(number, np.int64),
            np.zeros((number, 2, most_places, PLACE)),
            np.zeros((number, 2), np.int64),
            np.zeros((number, 2), np.bool_),
            np.zeros((number, PAIRS, 2, numbers_of_end(joints))),
        )


def numbers_of_end(joints: int) -> int:
    """Return how many random numbers the attempts at an end take: two, and for each try a place and a seed."""
    return 2 + TRIES * (8 + joints)


@compiled
def draw_ends(mover: Mover, attempts: Attempts, ends: Float, obstacles: Obstacles) -> Bool:
    """Draw starts and goals of N scenes, and return True for scenes that were found, shape (N,).

    Args:
        mover: Arm.
        attempts: Attempts at the scenes.
        ends: Starts and goals, shape (N, 2, J), which are changed where they are not fixed.
        obstacles: Obstacles of N scenes, W of each, which are changed where they are not given.
    """
    placed = memory(mover.chain, mover.spheres)
    found = np.zeros(len(ends), np.bool_)
    for scene in range(len(ends)):
        drawn = attempts.count[scene] >= 0
        # Places in the plane are points: another attempt would be the same one.
        for pair in range(1 if mover.plane else PAIRS):
            if drawn:
                unpack_rows(attempts.rows[scene], attempts.count[scene], obstacles, scene)
            if _draw_pair(mover, attempts, ends, obstacles, scene, pair, placed):
                found[scene] = True
                break
    return found


@compiled
def unpack_rows(rows: Float, count: int, obstacles: Obstacles, scene: int) -> None:
    """Put the rows of a layout into a scene; the rows behind them become absent."""
    for row in range(obstacles.kind.shape[1]):
        obstacles.kind[scene, row] = ABSENT
        if row < count:
            obstacles.kind[scene, row] = int(rows[row, 0])
            for axis in range(3):
                obstacles.centre[scene, row, axis] = rows[row, 1 + axis]
                obstacles.size[scene, row, axis] = rows[row, 13 + axis]
                for other in range(3):
                    obstacles.rotation[scene, row, axis, other] = rows[row, 4 + 3 * axis + other]


@compiled
def _draw_pair(
    mover: Mover, attempts: Attempts, ends: Float, obstacles: Obstacles, scene: int, pair: int, placed: Placed
) -> bool:
    """Draw a start and a goal, and return True if they and the straight movement between them are as they must be."""
    loose = attempts.keep[scene] > 0
    # The goal first: it is harder to find.
    for end in (1, 0):
        if attempts.fixed[scene, end]:
            continue
        if not _draw_end(mover, attempts, ends, obstacles, scene, pair, end, placed):
            return False
    start, goal = ends[scene, 0], ends[scene, 1]
    exchange = not attempts.fixed[scene].any() and attempts.n_places[scene, 0] == 0
    if exchange and attempts.numbers[scene, pair, 0, 1] < EXCHANGED:
        for joint in range(len(start)):
            start[joint], goal[joint] = goal[joint], start[joint]
    fixed = attempts.fixed[scene].all()
    if not fixed and np.sqrt(((goal - start) ** 2).sum()) < mover.least_way:
        return False
    if loose and not _keep_free(mover, start, goal, attempts.keep[scene], obstacles, scene, placed):
        return False
    for end in (0, 1):
        # Obstacles that are drawn around given ends may touch them.
        if attempts.fixed[scene, end] and not is_free(mover, ends[scene, end], obstacles, scene, placed):
            return False
    blocked = straight_blocked(mover, start, goal, obstacles, scene, placed)
    if blocked == 0:
        # Given obstacles need not be in the way.
        return attempts.count[scene] <= 0
    return blocked == 1 or fixed


@compiled
def _draw_end(
    mover: Mover,
    attempts: Attempts,
    ends: Float,
    obstacles: Obstacles,
    scene: int,
    pair: int,
    end: int,
    placed: Placed,
) -> bool:
    """Draw a start (end 0) or a goal (end 1), and return True if it is free."""
    numbers = attempts.numbers[scene, pair, end]
    joints = ends[scene, end]
    list_of_places, n_places = attempts.places[scene, end], attempts.n_places[scene, end]
    home, reaching = 0.0, 1.0 - FREE_GOALS
    if end == 0 and n_places == 0 and not mover.plane:
        list_of_places, n_places = attempts.places[scene, 1], attempts.n_places[scene, 1]
        home, reaching = HOME, REACHING
    if mover.plane:
        reaching = 1.0
    size = len(joints)
    for k in range(1 if mover.plane else TRIES):
        first = 2 + k * (8 + size)
        seed = numbers[first + 8 : first + 8 + size]
        if numbers[0] < home:
            deviation = JITTER if numbers[first] < 0.5 else 0.0
            for joint in range(size):
                joints[joint] = mover.home[joint] + deviation * (2.0 * seed[joint] - 1.0)
        else:
            for joint in range(size):
                low, high = mover.joint_range[joint, 0], mover.joint_range[joint, 1]
                joints[joint] = low + (high - low) * seed[joint]
            if n_places > 0 and numbers[0] < reaching:
                which = int(numbers[first] * n_places)
                if not _reach(mover, list_of_places[which], numbers[first + 1 : first + 8], joints, placed):
                    continue
        if not within_limits(mover, joints, LIMIT_MARGIN):
            continue
        place(mover.chain, mover.spheres, joints, placed)
        if self_clearance(mover.spheres, placed, SELF_MARGIN, SELF_MARGIN) < SELF_MARGIN:
            continue
        if attempts.keep[scene] > 0 or is_clear(mover, obstacles, scene, placed):
            return True
    return False


@compiled
def _reach(mover: Mover, there: Float, numbers: Float, joints: Float, placed: Placed) -> bool:
    """Solve for joint positions with the tool in a place, from a seed, and return True if it gets there."""
    across = there[6] * (2.0 * numbers[0] - 1.0), there[7] * (2.0 * numbers[1] - 1.0)
    position = np.empty(3)
    position[0] = there[0] + there[9] * across[0] - there[10] * across[1]
    position[1] = there[1] + there[10] * across[0] + there[9] * across[1]
    position[2] = there[2] + there[8] * (2.0 * numbers[2] - 1.0)
    if mover.plane:
        return bool(solve_planar(mover.chain, mover.joint_range, position[0], position[1], joints))
    if len(joints) < 6:
        return bool(solve_position(mover.chain, mover.joint_range, position, joints, placed.rotation, placed.origin))
    rotation = _tool_axes(there[3:6], there[11], numbers[3:7])
    return bool(solve_pose(mover.chain, mover.joint_range, position, rotation, joints, placed.rotation, placed.origin))


@compiled
def _tool_axes(approach: Float, cone: float, numbers: Float) -> Float:
    """Return random axes of the tool, as columns, with the z axis in a cone around the approach."""
    length = np.sqrt((approach * approach).sum())
    if length == 0.0:
        axis, cone = np.array([1.0, 0.0, 0.0]), np.pi
    else:
        axis = approach / length
    # A uniform direction in the cone, in a frame whose third axis is the approach.
    frame = _frame(axis)
    cosine = 1.0 - (1.0 - np.cos(cone)) * numbers[0]
    sine = np.sqrt(max(1.0 - cosine * cosine, 0.0))
    angle = 2.0 * np.pi * numbers[1]
    local = np.array([sine * np.cos(angle), sine * np.sin(angle), cosine])
    tool = _frame(frame @ local)
    roll = 0.5 * np.pi * np.floor(4.0 * numbers[2]) + ROLL * (2.0 * numbers[3] - 1.0)
    c, s = np.cos(roll), np.sin(roll)
    axes = np.empty((3, 3))
    axes[:, 0] = c * tool[:, 0] + s * tool[:, 1]
    axes[:, 1] = c * tool[:, 1] - s * tool[:, 0]
    axes[:, 2] = tool[:, 2]
    return axes


@compiled
def _frame(axis: Float) -> Float:
    """Return axes, as columns, with a given third one; the first is horizontal."""
    frame = np.zeros((3, 3))
    level = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1])
    if level < 1e-6:
        frame[0, 0] = 1.0
    else:
        frame[0, 0], frame[1, 0] = -axis[1] / level, axis[0] / level
    frame[:, 2] = axis
    frame[:, 1] = np.cross(frame[:, 2], frame[:, 0])
    return frame


@compiled
def within_limits(mover: Mover, joints: Float, margin: float) -> bool:
    """Return True if all joints are within their ranges by a margin."""
    for joint in range(len(joints)):
        low, high = mover.joint_range[joint, 0], mover.joint_range[joint, 1]
        if not low + margin <= joints[joint] <= high - margin:
            return False
    return True


@compiled
def is_clear(mover: Mover, obstacles: Obstacles, scene: int, placed: Placed) -> bool:
    """Return True if a placed arm has the margin of ends to the obstacles at time 0."""
    margin = mover.margin
    return obstacle_clearance(mover.spheres, placed, obstacles, scene, 0.0, margin, margin) >= margin


@compiled
def is_free(mover: Mover, joints: Float, obstacles: Obstacles, scene: int, placed: Placed) -> bool:
    """Return True if an arm has the margin of ends to the obstacles at time 0."""
    place(mover.chain, mover.spheres, joints, placed)
    return is_clear(mover, obstacles, scene, placed)


@compiled
def _keep_free(
    mover: Mover, start: Float, goal: Float, keep: int, obstacles: Obstacles, scene: int, placed: Placed
) -> bool:
    """Keep the first obstacles that leave both ends free, and return True if there are enough."""
    rows = obstacles.kind.shape[1]
    touching = np.zeros(rows, np.bool_)
    for end in (start, goal):
        place(mover.chain, mover.spheres, end, placed)
        for row in range(rows):
            least = row_clearance(mover.spheres, placed, obstacles, scene, row, 0.0, mover.margin)
            touching[row] = touching[row] or least < mover.margin
    count = 0
    for row in range(rows):
        if obstacles.kind[scene, row] == ABSENT or touching[row] or count == keep:
            obstacles.kind[scene, row] = ABSENT
            continue
        if row > count:
            obstacles.kind[scene, count] = obstacles.kind[scene, row]
            obstacles.centre[scene, count] = obstacles.centre[scene, row]
            obstacles.rotation[scene, count] = obstacles.rotation[scene, row]
            obstacles.size[scene, count] = obstacles.size[scene, row]
            obstacles.kind[scene, row] = ABSENT
        count += 1
    return count == keep


@compiled
def _bit_reversed(number: int) -> float:
    """Return the k-th point of the sequence 1/2, 1/4, 3/4, 1/8, 5/8, ..."""
    point, step = 0.0, 0.5
    while number:
        point += step * (number & 1)
        number >>= 1
        step *= 0.5
    return point


@compiled
def straight_blocked(
    mover: Mover, start: Float, goal: Float, obstacles: Obstacles, scene: int, placed: Placed
) -> int:
    """Return 1 if the straight movement touches an obstacle, 0 if it is free, -1 if it leaves the arm's reach.

    The movement is looked at in bit-reversed order, so that it is halved again and again.
    """
    joints = np.empty(len(start))
    first = np.zeros(3)
    last = np.zeros(3)
    if mover.of_hand:
        first[:] = tool_position(mover.chain, start, placed.rotation, placed.origin)
        last[:] = tool_position(mover.chain, goal, placed.rotation, placed.origin)
        for k in range(1, INSTANTS):
            share = k / INSTANTS
            x, y = first[0] + share * (last[0] - first[0]), first[1] + share * (last[1] - first[1])
            if not solve_planar(mover.chain, mover.joint_range, x, y, joints):
                return -1
    for k in range(1, INSTANTS):
        share = _bit_reversed(k)
        if mover.of_hand:
            x, y = first[0] + share * (last[0] - first[0]), first[1] + share * (last[1] - first[1])
            solve_planar(mover.chain, mover.joint_range, x, y, joints)
        else:
            for joint in range(len(joints)):
                joints[joint] = start[joint] + share * (goal[joint] - start[joint])
        place(mover.chain, mover.spheres, joints, placed)
        if obstacle_clearance(mover.spheres, placed, obstacles, scene, 0.0, 0.0, 0.0) < 0.0:
            return 1
    return 0
