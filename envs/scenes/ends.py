"""Starts and goals of drawn scenes: compiled attempts at free configurations that one would reach for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.inverse_kinematics import descend, solve_planar
from viapoint.envs.arms.kinematics import Chain, Spheres, tool_position, transform
from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import Placed, obstacle_clearance, place, self_clearance
from viapoint.envs.geometry.compiled import inlined, inner, kernel, rotated
from viapoint.envs.geometry.obstacles import ABSENT
from viapoint.envs.scenes.scene import NEVER, Scenes, way_since_start

PAIRS, TRIES = 3, 6  # Pairs of start and goal for a layout, and attempts at each end
# Share of starts at home or near it, and of these and starts in places of goals; others are free ones
HOME, REACHING = 0.4, 0.8
FREE_GOALS = 0.1  # Share of goals that are free configurations, where the layout has places
EXCHANGED = 0.25  # Share of pairs whose ends are exchanged, where the layout has no places of starts
JITTER = 0.3  # Greatest deviation from home of half of the starts there, [rad]
# Least clearance of the arm from itself at ends, [m], and the share of that at home that it is at most
SELF_MARGIN, HOME_SHARE = 0.005, 0.5
INSTANTS = 32  # Parts of the straight movement between which it is looked at
ROLL = 0.3  # Greatest deviation of the tool's roll about its axis from quarter turns, [rad]
SEED_SPREAD = 0.3  # Spread of seeds of inverse kinematics around home, as a share of the ranges
BLOCKED, FREE, OUT_OF_REACH = 1, 0, -1  # Outcome of a straight movement


class Setting(NamedTuple):
    """Arm, the space in which it moves, and what scenes must be like, as compiled functions read them."""

    chain: Chain
    spheres: Spheres
    joint_range: Float  # Ranges of the joints, shape (J, 2), [rad] or [m]
    inner_range: Float  # Ranges of the joints at ends, shape (J, 2), [rad] or [m]
    home: Float  # Shape (J,), [rad] or [m]
    farthest: float  # Greatest coordinate of obstacles, [m]
    bearing: float  # Bearing of the tool at home, seen from the axis of the first joint, [rad]
    plane: bool  # True for an arm of two joints in the plane
    of_hand: bool  # True if movements are planned in hand space, False for joint space
    margin: float  # Least clearance of ends from obstacles, [m]
    self_margin: float  # Least clearance of ends from the arm itself, [m]
    least_way: float  # Least length of the way from start to goal in joint space, [rad]
    n_jumps: tuple[int, int]  # Fewest and most jumps of the target
    reaching: bool  # True if obstacles that move are on reaches of their own
    # Shortest and longest duration of movements, relative to that of the zero action
    relative_durations: tuple[float, float]


class Draft(NamedTuple):
    """N scenes that are being drawn: one attempt at each, with a layout as padded tables, and memory."""

    setting: Setting
    scenes: Scenes  # Scenes with W obstacles each, which compiled functions change in place
    rows: Float  # Obstacles of the layouts, shape (N, W, ROW)
    n_rows: Int  # Numbers of obstacles, shape (N,); -1 for scenes whose obstacles are given
    keep: Int  # Numbers of obstacles that are kept, or 0, shape (N,)
    places: Float  # Places of starts, then those of goals, shape (N, 2, P, PLACE)
    n_places: Int  # Numbers of both, shape (N, 2)
    fixed: Bool  # True for starts and goals that are given, shape (N, 2)
    numbers: Float  # Uniform random numbers, shape (N, PAIRS, 2, :func:`numbers_of_end`)
    joints: Float  # Shape (J,)
    position: Float  # Shape (3,)
    axes: Float  # Shape (3, 3)
    placed: Placed
    at_start: Placed
    at_goal: Placed


def numbers_of_end(joints: int) -> int:
    """Return how many random numbers the attempts at an end take: two, and for each try a place and a seed."""
    return 2 + TRIES * (8 + joints)


# Functions with one caller are compiled within it: handing over a draft costs seconds of compilation.
@kernel
def draw_ends(draft: Draft, which: Int, found: Bool) -> None:
    """Draw starts, goals and obstacles of the scenes at K indices; set `found`, (K,), for those that were found."""
    for k in range(len(which)):
        scene = which[k]
        # Places in the plane are points: another attempt would be the same one.
        once = draft.setting.plane or (draft.fixed[scene, 0] and draft.fixed[scene, 1])
        for pair in range(1 if once else PAIRS):
            if draft.n_rows[scene] >= 0:
                _unpack_rows(draft, scene)
            if _draw_pair(draft, scene, pair):
                found[k] = True
                break


@inlined
def _unpack_rows(draft: Draft, scene: int) -> None:
    """Put the obstacles of a layout into a scene, at rest; the rows behind them become absent."""
    obstacles, rows = draft.scenes.obstacles, draft.rows[scene]  # pairs before may have left some out
    for row in range(obstacles.kind.shape[1]):
        draft.scenes.turn_time[scene, row] = NEVER
        obstacles.kind[scene, row] = ABSENT
        if row < draft.n_rows[scene]:
            obstacles.kind[scene, row] = int(rows[row, 0])
        draft.scenes.turn_velocity[scene, row] = 0.0
        draft.scenes.reach[scene, row] = 0.0
        obstacles.velocity[scene, row] = 0.0
        for axis in range(3):
            obstacles.centre[scene, row, axis] = rows[row, 1 + axis]
            obstacles.size[scene, row, axis] = rows[row, 13 + axis]
            for column in range(3):
                obstacles.rotation[scene, row, axis, column] = rows[row, 4 + 3 * axis + column]


@inlined
def _draw_pair(draft: Draft, scene: int, pair: int) -> bool:
    """Draw a start and a goal, and return True if they and the straight movement between them are as they must be."""
    start_given, goal_given = draft.fixed[scene]
    # The goal first: it is harder to find.
    for end in (1, 0):
        if not draft.fixed[scene, end] and not _draw_end(draft, scene, pair, end):
            return False
    start, goal = draft.scenes.start[scene], draft.scenes.goal[scene]
    exchange = not start_given and not goal_given and draft.n_places[scene, 0] == 0
    if exchange and draft.numbers[scene, pair, 0, 1] < EXCHANGED:
        for joint in range(len(start)):
            start[joint], goal[joint] = goal[joint], start[joint]
    way = 0.0
    for joint in range(len(start)):
        way += (goal[joint] - start[joint]) ** 2
    both_given = start_given and goal_given
    if not both_given and np.sqrt(way) < draft.setting.least_way:
        return False
    drawn = draft.n_rows[scene] >= 0
    if drawn and (start_given or goal_given or draft.keep[scene]) and not _make_room(draft, scene):
        return False
    what = straight_movement(draft, scene)
    if what == FREE:
        # Given obstacles need not be in the way.
        return bool(draft.n_rows[scene] <= 0)
    return what == BLOCKED or both_given


@inlined
def _draw_end(draft: Draft, scene: int, pair: int, end: int) -> bool:
    """Draw a start (end 0) or a goal (end 1), and return True if it is free."""
    setting = draft.setting
    joints = draft.scenes.goal[scene] if end else draft.scenes.start[scene]
    numbers = draft.numbers[scene, pair, end]
    size = len(joints)
    listed = end
    home, reaching = 0.0, 1.0 if setting.plane else 1.0 - FREE_GOALS
    if end == 0 and draft.n_places[scene, 0] == 0 and not setting.plane:
        listed = 1
        home, reaching = HOME, REACHING
    n_places = draft.n_places[scene, listed]
    for k in range(1 if setting.plane else TRIES):
        first = 2 + k * (8 + size)
        for joint in range(size):
            low, high = setting.inner_range[joint]
            seed = numbers[first + 8 + joint]
            joints[joint] = low + (high - low) * seed
            if numbers[0] < home:
                deviation = JITTER if numbers[first] < 0.5 else 0.0
                joints[joint] = setting.home[joint] + deviation * (2.0 * seed - 1.0)
        if n_places > 0 and home <= numbers[0] < reaching:
            there = draft.places[scene, listed, int(numbers[first] * n_places)]
            if not _reach(draft, scene, there, numbers[first + 1 : first + 8], joints):
                continue
        if not is_end(draft, joints):
            continue
        if draft.keep[scene] > 0:  # obstacles in the way are left out
            return True
        placed, margin = draft.placed, setting.margin
        obstacles = draft.scenes.obstacles
        if obstacle_clearance(setting.spheres, placed, obstacles, scene, 0.0, margin, margin) >= margin:
            return True
    return False


@inner
def is_end(draft: Draft, joints: Float) -> bool:
    """Return True if joints are within their inner ranges, and the arm, which is placed, is free of itself."""
    setting, placed = draft.setting, draft.placed
    for joint in range(len(joints)):
        low, high = setting.inner_range[joint]
        if not low <= joints[joint] <= high:
            return False
    place(setting.chain, setting.spheres, joints, placed)
    margin = setting.self_margin
    return bool(self_clearance(setting.spheres, placed, margin, margin) >= margin)


@inner
def is_row_clear(
    draft: Draft, placed: Placed, scene: int, row: int, time: float, margin: float, link: int
) -> bool:
    """Return True if links from `link` on of a placed arm have a margin to one obstacle at some time, [m]."""
    scenes, obstacles = draft.scenes, draft.scenes.obstacles
    x = obstacles.centre[scene, row, 0]
    y = obstacles.centre[scene, row, 1]
    z = obstacles.centre[scene, row, 2]
    # After the turn, the place is that of the first course, moved by the difference of the courses.
    after = max(time - scenes.turn_time[scene, row], 0.0)
    moved = way_since_start(scenes.reach[scene, row], time)
    for axis in range(3):
        change = scenes.turn_velocity[scene, row, axis] - obstacles.velocity[scene, row, axis]
        obstacles.centre[scene, row, axis] += after * change + moved * scenes.reach[scene, row, 2 + axis]
    spheres = draft.setting.spheres
    least = obstacle_clearance(spheres, placed, obstacles, scene, time, margin, margin, row, link)
    obstacles.centre[scene, row, 0] = x
    obstacles.centre[scene, row, 1] = y
    obstacles.centre[scene, row, 2] = z
    return bool(least >= margin)


@inlined
def _make_room(draft: Draft, scene: int) -> bool:
    """Leave out obstacles that touch an end, and those that are too many; return True if the others are enough.

    If the obstacles of the layout belong together, none may touch an end.
    """
    setting = draft.setting
    obstacles = draft.scenes.obstacles
    keep = draft.keep[scene]
    place(setting.chain, setting.spheres, draft.scenes.start[scene], draft.at_start)
    place(setting.chain, setting.spheres, draft.scenes.goal[scene], draft.at_goal)
    count = 0
    for row in range(obstacles.kind.shape[1]):
        if obstacles.kind[scene, row] == ABSENT:
            continue
        if keep > 0 and count == keep:
            obstacles.kind[scene, row] = ABSENT
            continue
        free = is_row_clear(draft, draft.at_start, scene, row, 0.0, setting.margin, 1)
        free = free and is_row_clear(draft, draft.at_goal, scene, row, 0.0, setting.margin, 1)
        if not free and keep == 0:
            return False
        kind = obstacles.kind[scene, row]
        obstacles.kind[scene, row] = ABSENT
        if free:  # it moves to the first row that is left
            obstacles.kind[scene, count] = kind
            for axis in range(3):
                obstacles.centre[scene, count, axis] = obstacles.centre[scene, row, axis]
                obstacles.size[scene, count, axis] = obstacles.size[scene, row, axis]
                for column in range(3):
                    turn = obstacles.rotation[scene, row, axis, column]
                    obstacles.rotation[scene, count, axis, column] = turn
            count += 1
    return bool(keep == 0 or count == keep)


@inlined
def straight_movement(draft: Draft, scene: int) -> int:
    """Return what becomes of the straight movement: FREE, BLOCKED by an obstacle, or OUT_OF_REACH."""
    setting = draft.setting
    start = draft.scenes.start[scene]
    goal = draft.scenes.goal[scene]
    placed, joints = draft.placed, draft.joints
    x, y, u, v = 0.0, 0.0, 0.0, 0.0
    if setting.of_hand:
        x, y, _ = tool_position(setting.chain, start, placed.rotation, placed.origin)
        u, v, _ = tool_position(setting.chain, goal, placed.rotation, placed.origin)
    blocked = False
    for k in range(1, INSTANTS):
        share = _bit_reversed(k)
        if setting.of_hand:
            here = x + share * (u - x), y + share * (v - y)
            if not solve_planar(setting.chain, setting.joint_range, here[0], here[1], joints):
                return OUT_OF_REACH
        else:
            for joint in range(len(joints)):
                joints[joint] = start[joint] + share * (goal[joint] - start[joint])
        if not blocked:
            place(setting.chain, setting.spheres, joints, placed)
            least = obstacle_clearance(setting.spheres, placed, draft.scenes.obstacles, scene, 0.0, 0.0, 0.0)
            blocked = least < 0.0
        if blocked and not setting.of_hand:  # the hand may still leave the reach
            break
    return BLOCKED if blocked else FREE


@kernel
def _bit_reversed(number: int) -> float:
    """Return the k-th point of the sequence 1/2, 1/4, 3/4, 1/8, 5/8, ..., which soon finds what is in the way."""
    point, step = 0.0, 0.5
    while number:
        point += step * (number & 1)
        number >>= 1
        step *= 0.5
    return point


@inlined
def _reach(draft: Draft, scene: int, there: Float, numbers: Float, joints: Float) -> bool:
    """Solve for joint positions with the tool in a place, and return True if it gets there."""
    setting = draft.setting
    across = there[6] * (2.0 * numbers[0] - 1.0), there[7] * (2.0 * numbers[1] - 1.0)
    position, axes = draft.position, draft.axes
    position[0] = there[0] + there[9] * across[0] - there[10] * across[1]
    position[1] = there[1] + there[10] * across[0] + there[9] * across[1]
    position[2] = there[2] + there[8] * (2.0 * numbers[2] - 1.0)
    chain, limits = setting.chain, setting.inner_range
    if setting.plane:
        return bool(solve_planar(chain, limits, position[0], position[1], joints))
    _seed(setting, position, joints)
    if len(joints) < 6:
        return bool(descend(chain, limits, position, axes, False, joints) == 0.0)
    _tool_axes(there[3:6], there[11], numbers[3:7], axes)
    if draft.keep[scene] == 0 and not _is_hand_clear(draft, scene, position, axes):
        return False
    return bool(descend(chain, limits, position, axes, True, joints) == 0.0)


@inner
def _seed(setting: Setting, position: Float, joints: Float) -> None:
    """Change joints between their limits into some near home, with the first one turned towards a position.

    From there inverse kinematics finds more solutions, and fewer contorted ones.
    """
    origin = setting.chain.origin[0]
    for joint in range(len(joints)):
        low, high = setting.inner_range[joint]
        joints[joint] = setting.home[joint] + SEED_SPREAD * (joints[joint] - 0.5 * (low + high))
        if joint == 0 and not setting.chain.sliding[0]:
            joints[0] += np.arctan2(position[1] - origin[1], position[0] - origin[0]) - setting.bearing
        joints[joint] = min(max(joints[joint], low), high)


@inlined
def _is_hand_clear(draft: Draft, scene: int, position: Float, axes: Float) -> bool:
    """Return True if the last link is free with the tool at a pose, which is known without inverse kinematics."""
    chain, spheres, placed = draft.setting.chain, draft.setting.spheres, draft.placed
    last = len(chain.mass)
    for row in range(3):
        for column in range(3):
            turn = 0.0
            for k in range(3):
                turn += axes[row, k] * chain.tool_rotation[column, k]
            placed.rotation[last, row, column] = turn
        placed.origin[last, row] = position[row]
        for k in range(3):
            placed.origin[last, row] -= placed.rotation[last, row, k] * chain.tool_origin[k]
    for group in range(len(spheres.link)):
        if spheres.link[group] == last:
            placed.known[group] = False
            ball = transform(placed.rotation, placed.origin, last, spheres.ball_centre[group])
            placed.ball[group, 0], placed.ball[group, 1], placed.ball[group, 2] = ball
    clear = True
    for row in range(draft.scenes.obstacles.kind.shape[1]):
        clear = clear and is_row_clear(draft, placed, scene, row, 0.0, draft.setting.margin, last)
    return clear


@kernel
def _tool_axes(approach: Float, cone: float, numbers: Float, axes: Float) -> None:
    """Fill in random axes of the tool, as columns, with the z axis in a cone around the approach."""
    x, y, z = approach
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        x, length, cone = 1.0, 1.0, np.pi
    _fill_frame(x / length, y / length, z / length, axes)
    # A uniform direction in the cone around the third axis.
    cosine = 1.0 - (1.0 - np.cos(cone)) * numbers[0]
    sine = np.sqrt(max(1.0 - cosine * cosine, 0.0))
    angle = 2.0 * np.pi * numbers[1]
    u = sine * np.cos(angle)
    v = sine * np.sin(angle)
    x, y, z = rotated(axes, (u, v, cosine))
    _fill_frame(x, y, z, axes)
    roll = 0.5 * np.pi * np.floor(4.0 * numbers[2]) + ROLL * (2.0 * numbers[3] - 1.0)
    c, s = np.cos(roll), np.sin(roll)
    for row in range(3):
        first, second = axes[row, 0], axes[row, 1]
        axes[row, 0] = c * first + s * second
        axes[row, 1] = c * second - s * first


@kernel
def _fill_frame(x: float, y: float, z: float, axes: Float) -> None:
    """Fill in axes, as columns, of which the third is a unit vector, and the first is horizontal."""
    level = np.sqrt(x * x + y * y)
    u, v = 1.0, 0.0
    if level > 1e-6:
        u, v = -y / level, x / level
    axes[0, 0], axes[1, 0], axes[2, 0] = u, v, 0.0
    axes[0, 1], axes[1, 1], axes[2, 1] = -z * v, z * u, x * v - y * u
    axes[0, 2], axes[1, 2], axes[2, 2] = x, y, z
