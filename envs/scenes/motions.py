"""Changes of drawn scenes: jumps of the target, and courses of obstacles.

A course has a constant velocity and at most one turn, or it is a minimum-jerk reach, as that of another hand.
"""

from __future__ import annotations

import numpy as np

from viapoint.envs.arms.inverse_kinematics import solve_planar
from viapoint.envs.arms.kinematics import tool_position
from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import place
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import ABSENT, HALF_SPACE
from viapoint.envs.scenes.ends import Draft, is_end, is_row_clear
from viapoint.envs.scenes.layout import mix
from viapoint.envs.scenes.scene import FASTEST, MINIMUM_JERK_PEAK, MOST_JUMPS, NEVER, reached

CANDIDATES = 8  # Candidates for a jump, or for the course of an obstacle
COURSE_NUMBERS = 9  # Random numbers of a candidate for the course of an obstacle
# Time of the first jump, and from a jump to the next, relative to the centre duration
FIRST_JUMP, NEXT_JUMP = (0.1, 0.7), (0.4, 0.9)
# Distance from a target to the next in hand space, [m], and in joint space, [rad]
JUMP_OF_HAND, JUMP_OF_JOINTS = (0.10, 0.30), (0.25, 0.75)
SPEED = (0.05, 0.30)  # Speed of obstacles, [m/s]
STEEPNESS = 0.5  # Greatest height that an obstacle in space gains, relative to its way
TURNING, TURN = 0.5, (0.2, 0.7)  # Share of obstacles that turn, and the relative time of the turn
# Duration of a reach of an obstacle, [s], its least and greatest length, [m], and its greatest peak speed, [m/s]
REACH_TIME, REACH_LENGTH, REACH_SPEED = (0.6, 1.2), (0.15, 0.45), 0.9 * FASTEST
MET_AT = (0.35, 0.65)  # Share of the duration of a reach after which an obstacle is where it was drawn
MEETING = (0.25, 0.6)  # Time at which an obstacle is where it was drawn, relative to the centre duration
# Least clearance of the start at first, of the goal while movements may end, and of targets that appear, [m]
MARGIN = 0.015
NEAR = 0.75  # Greatest coordinate of a moving obstacle at the beginning, as a share of that of obstacles
BEGINNING, BEGINNING_TIMES = 0.2, 3
"""Time that the start stays free, relative to the centre duration, and number of times at which this is checked."""
# Time until which the goal stays free, relative to the longest duration, and number of times
ENDING, ENDING_TIMES = 1.2, 10
PASSED = 8  # Parts of the way to a new target between which it is looked at


_mixed = compiled(mix)


def numbers_of_jumps(joints: int) -> int:
    """Return how many random numbers the jumps of a scene take."""
    return 1 + MOST_JUMPS * (1 + CANDIDATES * (1 + joints))


@compiled
def draw_courses(draft: Draft, which: Int, durations: Float, numbers: Float) -> None:
    """Set the obstacles of the scenes at indices (K,) in motion, but half-spaces, and those of which no course fits.

    `durations` are those of the straight movements, shape (K,), [s]; `numbers` are uniform random numbers, shape
    (K, W, CANDIDATES, COURSE_NUMBERS).
    """
    setting, scenes, obstacles = draft.setting, draft.scenes, draft.scenes.obstacles
    for k in range(len(which)):
        scene = which[k]
        place(setting.chain, setting.spheres, scenes.start[scene], draft.at_start)
        place(setting.chain, setting.spheres, scenes.goal[scene], draft.at_goal)
        for row in range(obstacles.kind.shape[1]):
            if obstacles.kind[scene, row] in (ABSENT, HALF_SPACE):
                continue
            met = obstacles.centre[scene, row].copy()
            fits = False
            for candidate in range(CANDIDATES):
                _set_course(draft, scene, row, met, durations[k], numbers[k, row, candidate])
                fits = _course_fits(draft, durations[k], scene, row)
                if fits:
                    break
            if not fits:
                _set_course(draft, scene, row, met, 0.0, np.zeros(COURSE_NUMBERS))  # it rests


@compiled
def _set_course(draft: Draft, scene: int, row: int, met: Float, duration: float, u: Float) -> None:
    """Give an obstacle a random course through a place during a movement of some duration; it rests if that is 0."""
    first, second = np.zeros(3), np.zeros(3)
    turn, meeting = NEVER, duration * _mixed(MEETING, u[8])
    draft.scenes.reach[scene, row] = 0.0
    height = 0.0 if draft.setting.plane else STEEPNESS
    if duration > 0.0 and draft.setting.reaching:
        time = _mixed(REACH_TIME, u[3])
        begin = meeting - time * _mixed(MET_AT, u[4])
        longest = min(REACH_LENGTH[1], REACH_SPEED * time / MINIMUM_JERK_PEAK)
        _fill_vector(_mixed((REACH_LENGTH[0], longest), u[0]), u[1], height * (2.0 * u[2] - 1.0), first)
        made = reached(begin, time, meeting) - reached(begin, time, 0.0)
        draft.scenes.reach[scene, row, 0] = begin
        draft.scenes.reach[scene, row, 1] = time
        for axis in range(3):
            draft.scenes.reach[scene, row, 2 + axis] = first[axis]
            draft.scenes.obstacles.centre[scene, row, axis] = met[axis] - made * first[axis]
        return
    if duration > 0.0:
        _fill_vector(_mixed(SPEED, u[0]), u[1], height * (2.0 * u[2] - 1.0), first)
        if u[6] < TURNING:
            turn = duration * _mixed(TURN, u[7])
            _fill_vector(_mixed(SPEED, u[3]), u[4], height * (2.0 * u[5] - 1.0), second)
    for axis in range(3):
        way = first[axis] * min(meeting, turn) + second[axis] * max(meeting - turn, 0.0)
        draft.scenes.obstacles.centre[scene, row, axis] = met[axis] - way
        draft.scenes.obstacles.velocity[scene, row, axis] = first[axis]
        draft.scenes.turn_velocity[scene, row, axis] = second[axis]
    draft.scenes.turn_time[scene, row] = turn


@compiled
def _fill_vector(length: float, heading: float, rise: float, vector: Float) -> None:
    """Fill in a vector of some length, shape (3,), from its heading in turns and the sine of its rise."""
    angle = 2.0 * np.pi * heading
    level = np.sqrt(1.0 - rise * rise)  # cosine of the angle to the horizontal
    vector[0] = length * level * np.cos(angle)
    vector[1] = length * level * np.sin(angle)
    vector[2] = length * rise


@compiled
def _course_fits(draft: Draft, duration: float, scene: int, row: int) -> bool:
    """Return True if an obstacle leaves the start free at first, and the goal at first and while movements may end."""
    shortest, longest = draft.setting.relative_durations
    x, y, z = draft.scenes.obstacles.centre[scene, row]
    if max(abs(x), abs(y), abs(z)) > NEAR * draft.setting.farthest:
        return False
    for k in range(BEGINNING_TIMES):
        time = duration * BEGINNING * k / (BEGINNING_TIMES - 1)
        if not is_row_clear(draft, draft.at_start, scene, row, time, MARGIN, 1):
            return False
    for k in range(-1, ENDING_TIMES):
        share = k / (ENDING_TIMES - 1)
        time = duration * _mixed((shortest, ENDING * longest), share) if k >= 0 else 0.0
        if not is_row_clear(draft, draft.at_goal, scene, row, time, MARGIN, 1):
            return False
    return True


@compiled
def draw_jumps(draft: Draft, which: Int, durations: Float, numbers: Float) -> Bool:
    """Draw the jumps of the target of the scenes at indices (K,), and return True where all of them fit, shape (K,).

    `durations` are those of the straight movements, shape (K,), [s]; `numbers` are uniform random numbers, shape
    (K, :func:`numbers_of_jumps`).
    """
    joints = draft.scenes.start.shape[1]
    fewest, most = draft.setting.n_jumps
    each = 1 + CANDIDATES * (1 + joints)
    good = np.ones(len(which), np.bool_)
    before, target = np.empty(joints), np.empty(joints)
    for k in range(len(which)):
        scene, u = which[k], numbers[k]
        count = fewest + int((most - fewest + 1) * u[0])
        start = draft.scenes.start[scene]
        before[:] = draft.scenes.goal[scene]
        draft.scenes.jumps[scene] = 0.0
        time = 0.0
        for jump in range(count):
            first = 1 + jump * each
            time += durations[k] * _mixed(NEXT_JUMP if jump else FIRST_JUMP, u[first])
            fits = False
            for candidate in range(CANDIDATES):
                begin = first + 1 + candidate * (1 + joints)
                fits = _jump(draft, start, before, u[begin : begin + 1 + joints], target)
                fits = fits and is_end(draft, target)
                for row in range(draft.scenes.obstacles.kind.shape[1]):
                    # The target must be free when it appears.
                    fits = fits and is_row_clear(draft, draft.placed, scene, row, time, MARGIN, 1)
                if fits:
                    break
            if not fits:
                good[k] = False
                break
            draft.scenes.jumps[scene, jump, 0] = time
            for joint in range(joints):
                before[joint] = target[joint]
                draft.scenes.jumps[scene, jump, 1 + joint] = target[joint]
    return good


@compiled
def _jump(draft: Draft, start: Float, before: Float, u: Float, target: Float) -> bool:
    """Fill in a target at a random distance from the one before, and return True if the hand has a way to it."""
    setting, placed = draft.setting, draft.placed
    if not setting.of_hand:
        length = 0.0
        for joint in range(len(target)):
            target[joint] = 2.0 * u[1 + joint] - 1.0
            length += target[joint] ** 2
        scale = _mixed(JUMP_OF_JOINTS, u[0]) / max(np.sqrt(length), 1e-6)
        for joint in range(len(target)):
            target[joint] = before[joint] + scale * target[joint]
        return True
    x, y, _ = tool_position(setting.chain, before, placed.rotation, placed.origin)
    a, b, _ = tool_position(setting.chain, start, placed.rotation, placed.origin)
    length = _mixed(JUMP_OF_HAND, u[0])
    angle = 2.0 * np.pi * u[1]
    to_x = x + length * np.cos(angle)
    to_y = y + length * np.sin(angle)
    # The hand is between the start and the target before: its way is between the ways from there.
    for k in range(PASSED + 1):
        share = k / PASSED
        for p, q in ((a, b), (x, y)):
            there = p + share * (to_x - p), q + share * (to_y - q)
            if not solve_planar(setting.chain, setting.inner_range, there[0], there[1], target):
                return False
    return True
