"""Changes of drawn scenes: jumps of the target, and obstacles that move with at most one turn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.core.arms.chain import Spheres
from viapoint.envs.core.arms.inverse_kinematics import solve_planar
from viapoint.envs.core.arms.kinematics import tool_position
from viapoint.envs.core.geometry.clearance import Placed, memory, place, self_clearance
from viapoint.envs.core.geometry.compiled import compiled
from viapoint.envs.core.geometry.obstacles import ABSENT, HALF_SPACE, Obstacles
from viapoint.envs.core.plans import SHORTEST_DURATION
from viapoint.envs.core.scenes.ends import SELF_MARGIN, LIMIT_MARGIN, Mover, within_limits
from viapoint.envs.core.scenes.scene import MOST_JUMPS, NEVER, Scenes, row_clearance

CANDIDATES = 8
"""Candidates for a jump, or for the course of an obstacle."""
FIRST_JUMP, NEXT_JUMP = (0.1, 0.7), (0.4, 0.9)
"""Time of the first jump, and from a jump to the next, relative to the centre duration."""
JUMP_IN_HAND, JUMP_IN_JOINTS = (0.10, 0.30), (0.25, 0.75)
"""Distance from a target to the next in hand space, [m], and in joint space, [rad]."""
SPEED = (0.05, 0.30)
"""Speed of obstacles, [m/s]."""
STEEPNESS = 0.5
"""Greatest height that an obstacle in space gains, relative to its way."""
TURNING, TURN = 0.5, (0.2, 0.7)
"""Share of obstacles that turn, and the time of the turn, relative to the centre duration."""
MEETING = (0.25, 0.6)
"""Time at which an obstacle is where it was drawn, relative to the centre duration."""
MARGIN = 0.015
"""Least clearance of the start at first and of the goal while movements may end, [m]."""
FARTHEST = 1.5
"""Greatest coordinate of an obstacle that moves while movements may end, [m]."""
BEGINNING, ENDING = 3, 10
"""Times at which the clearance of the start and that of the goal are computed."""


class Changes(NamedTuple):
    """Distribution of changes."""

    fewest_jumps: int
    """Least number of jumps of the target."""
    most_jumps: int
    """Greatest number of jumps of the target."""
    moving: bool
    """True if obstacles move."""
    shortest: float
    """Shortest duration of movements, [s], in joint space relative to the shortest possible."""
    centre: float
    """Centre duration."""
    longest: float
    """Longest duration."""


class Turns(NamedTuple):
    """Changes of course of obstacles, see :class:`~viapoint.envs.core.scenes.scene.Scenes`."""

    time: Float
    """Shape (N, n), [s]."""
    velocity: Float
    """Shape (N, n, 3), [m/s]."""


def numbers_of_jumps(joints: int) -> int:
    """Return how many random numbers the jumps of a scene take."""
    return 1 + MOST_JUMPS * (1 + CANDIDATES * (1 + joints))


NUMBERS_OF_COURSE = 9
"""Random numbers that a candidate for the course of an obstacle takes."""


@compiled
def draw_courses(
    mover: Mover,
    changes: Changes,
    scenes: Int,
    ends: Float,
    obstacles: Obstacles,
    turns: Turns,
    numbers: Float,
) -> None:
    """Let the obstacles of some scenes move; an obstacle stands still if no course fits.

    Args:
        mover: Arm.
        changes: Distribution of changes.
        scenes: Indices of the scenes, shape (K,).
        ends: Starts and goals of N scenes, shape (N, 2, J).
        obstacles: Obstacles of N scenes, n each, whose centres and velocities are changed.
        turns: Changes of course, which are changed.
        numbers: Uniform random numbers, shape (K, n, CANDIDATES, NUMBERS_OF_COURSE).
    """
    at_start, at_goal = memory(mover.chain, mover.spheres), memory(mover.chain, mover.spheres)
    for k in range(len(scenes)):
        scene = scenes[k]
        unit = time_unit(mover, ends[scene, 0], ends[scene, 1])
        place(mover.chain, mover.spheres, ends[scene, 0], at_start)
        place(mover.chain, mover.spheres, ends[scene, 1], at_goal)
        for row in range(obstacles.kind.shape[1]):
            kind = obstacles.kind[scene, row]
            if kind == ABSENT or kind == HALF_SPACE:
                continue
            met = obstacles.centre[scene, row].copy()
            for candidate in range(CANDIDATES):
                _set_course(mover, unit * changes.centre, met, obstacles, turns, scene, row, numbers[k, row, candidate])
                if _course_fits(mover, changes, unit, obstacles, turns, scene, row, at_start, at_goal):
                    break
            else:
                obstacles.centre[scene, row] = met
                obstacles.velocity[scene, row] = 0.0
                turns.time[scene, row] = NEVER
                turns.velocity[scene, row] = 0.0


@compiled
def _set_course(
    mover: Mover,
    duration: float,
    met: Float,
    obstacles: Obstacles,
    turns: Turns,
    scene: int,
    row: int,
    u: Float,
) -> None:
    """Give an obstacle a random course that leads through a place during a movement of some duration."""
    first = _velocity(mover, u[0:3])
    second = _velocity(mover, u[3:6])
    turn = duration * (TURN[0] + (TURN[1] - TURN[0]) * u[7])
    meeting = duration * (MEETING[0] + (MEETING[1] - MEETING[0]) * u[8])
    if u[6] >= TURNING:
        turn = NEVER
        second = first
    obstacles.centre[scene, row] = met - first * min(meeting, turn) - second * max(meeting - turn, 0.0)
    obstacles.velocity[scene, row] = first
    turns.time[scene, row] = turn
    turns.velocity[scene, row] = second


@compiled
def _velocity(mover: Mover, u: Float) -> Float:
    """Return a random velocity, horizontal in the plane, [m/s]."""
    speed, angle = SPEED[0] + (SPEED[1] - SPEED[0]) * u[0], 2.0 * np.pi * u[1]
    height = 0.0 if mover.plane else STEEPNESS * (2.0 * u[2] - 1.0)
    level = np.sqrt(1.0 - height * height)
    return speed * np.array([level * np.cos(angle), level * np.sin(angle), height])


@compiled
def _course_fits(
    mover: Mover,
    changes: Changes,
    unit: float,
    obstacles: Obstacles,
    turns: Turns,
    scene: int,
    row: int,
    at_start: Placed,
    at_goal: Placed,
) -> bool:
    """Return True if an obstacle leaves the start free at first, and the goal at first and while movements may end."""
    spheres = mover.spheres
    for k in range(BEGINNING):
        time = 0.2 * unit * changes.centre * k / (BEGINNING - 1)
        if clearance_at(spheres, at_start, obstacles, turns, scene, row, time) < MARGIN:
            return False
    if clearance_at(spheres, at_goal, obstacles, turns, scene, row, 0.0) < MARGIN:
        return False
    begin, end = changes.shortest, 1.2 * changes.longest
    for k in range(ENDING):
        time = unit * (begin + (end - begin) * k / (ENDING - 1))
        if clearance_at(spheres, at_goal, obstacles, turns, scene, row, time) < MARGIN:
            return False
    return bool(np.abs(obstacles.centre[scene, row]).max() < FARTHEST)


@compiled
def clearance_at(
    spheres: Spheres, placed: Placed, obstacles: Obstacles, turns: Turns, scene: int, row: int, time: float
) -> float:
    """Return the clearance of a placed arm from an obstacle at some time, exact above MARGIN, [m]."""
    after = max(time - turns.time[scene, row], 0.0)
    if after == 0.0:
        return row_clearance(spheres, placed, obstacles, scene, row, time, MARGIN)
    # The place after the turn is that of the first course, moved by what the turn changes.
    centre = obstacles.centre[scene, row].copy()
    obstacles.centre[scene, row] += after * (turns.velocity[scene, row] - obstacles.velocity[scene, row])
    least = row_clearance(spheres, placed, obstacles, scene, row, time, MARGIN)
    obstacles.centre[scene, row] = centre
    return least


@compiled
def draw_jumps(
    mover: Mover,
    changes: Changes,
    scenes: Int,
    ends: Float,
    obstacles: Obstacles,
    turns: Turns,
    jumps: Float,
    numbers: Float,
) -> Bool:
    """Draw the jumps of the target of some scenes, and return True for scenes in which all of them fit, shape (K,).

    Args:
        mover: Arm.
        changes: Distribution of changes.
        scenes: Indices of the scenes, shape (K,).
        ends: Starts and goals of N scenes, shape (N, 2, J).
        obstacles: Obstacles of N scenes.
        turns: Changes of course.
        jumps: Jumps of N scenes, shape (N, MOST_JUMPS, J + 1), which are changed.
        numbers: Uniform random numbers, shape (K, :func:`numbers_of_jumps`).
    """
    placed = memory(mover.chain, mover.spheres)
    joints = ends.shape[2]
    each = 1 + CANDIDATES * (1 + joints)
    good = np.ones(len(scenes), np.bool_)
    for k in range(len(scenes)):
        scene, u = scenes[k], numbers[k]
        jumps[scene] = 0.0
        count = changes.fewest_jumps + int((changes.most_jumps - changes.fewest_jumps + 1) * u[0])
        target = ends[scene, 1].copy()
        duration = changes.centre * time_unit(mover, ends[scene, 0], target)
        time = 0.0
        for jump in range(count):
            first = 1 + jump * each
            low, high = NEXT_JUMP if jump else FIRST_JUMP
            time += duration * (low + (high - low) * u[first])
            fits = False
            for candidate in range(CANDIDATES):
                begin = first + 1 + candidate * (1 + joints)
                after = _next_target(mover, ends[scene, 0], target, u[begin : begin + 1 + joints], placed)
                fits = _target_fits(mover, after, obstacles, turns, scene, time, placed)
                if fits:
                    jumps[scene, jump, 0] = time
                    jumps[scene, jump, 1:] = after
                    target = after
                    break
            if not fits:
                good[k] = False
                break
    return good


@compiled
def _next_target(mover: Mover, start: Float, target: Float, u: Float, placed: Placed) -> Float:
    """Return joint positions at a random distance from a target; far outside the limits if the hand cannot go there."""
    after = np.empty(len(target))
    if not mover.of_hand:
        direction = 2.0 * u[1:] - 1.0
        low, high = JUMP_IN_JOINTS
        length = low + (high - low) * u[0]
        return target + direction * (length / max(np.sqrt((direction * direction).sum()), 1e-6))
    hand = np.array(tool_position(mover.chain, target, placed.rotation, placed.origin))
    begin = np.array(tool_position(mover.chain, start, placed.rotation, placed.origin))
    length, angle = JUMP_IN_HAND[0] + (JUMP_IN_HAND[1] - JUMP_IN_HAND[0]) * u[0], 2.0 * np.pi * u[1]
    x, y = hand[0] + length * np.cos(angle), hand[1] + length * np.sin(angle)
    # The hand is between start and target, so the way from there to the new target is between these lines.
    for k in range(1, 8):
        for origin in (begin, hand):
            across = origin[0] + k / 8 * (x - origin[0]), origin[1] + k / 8 * (y - origin[1])
            if not solve_planar(mover.chain, mover.joint_range, across[0], across[1], after):
                after[:] = NEVER
                return after
    if not solve_planar(mover.chain, mover.joint_range, x, y, after):
        after[:] = NEVER
    return after


@compiled
def _target_fits(
    mover: Mover, target: Float, obstacles: Obstacles, turns: Turns, scene: int, time: float, placed: Placed
) -> bool:
    """Return True if a target is within the limits and free when it appears."""
    if not within_limits(mover, target, LIMIT_MARGIN):
        return False
    place(mover.chain, mover.spheres, target, placed)
    if self_clearance(mover.spheres, placed, SELF_MARGIN, SELF_MARGIN) < SELF_MARGIN:
        return False
    for row in range(obstacles.kind.shape[1]):
        if clearance_at(mover.spheres, placed, obstacles, turns, scene, row, time) < MARGIN:
            return False
    return True


@compiled
def time_unit(mover: Mover, start: Float, goal: Float) -> float:
    """Return the unit of durations, [s]: in joint space the shortest duration that the velocity limits allow."""
    if mover.of_hand:
        return 1.0
    unit = SHORTEST_DURATION
    for joint in range(len(start)):
        # The greatest rate of a minimum-jerk movement is 15/8 of the mean one.
        unit = max(unit, 1.875 * abs(goal[joint] - start[joint]) / mover.velocity_limit[joint])
    return unit
