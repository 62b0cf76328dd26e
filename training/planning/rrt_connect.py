"""Clear paths of straight pieces in joint space, compiled.

RRT-Connect (J. J. Kuffner and S. M. LaValle, RRT-Connect: An efficient approach to single-query path planning, ICRA
2000) grows a tree from the start and one from the goal until they meet. Then shortcuts make the path shorter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.inverse_kinematics import descend
from viapoint.envs.arms.kinematics import tool_position
from viapoint.envs.common.arrays import Float, Int, norm
from viapoint.envs.geometry.clearance import Placed, memory, obstacle_clearance, place, self_clearance
from viapoint.envs.geometry.compiled import clock, compiled, inlined, inner, kernel, rotated
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.training.planning.movements import Setting

SPACING = 0.03  # Greatest way of a part of the arm by one joint between two checks along a line, [m]
STEP = 1.0  # Longest step of a tree, [rad]
# Share of targets at which the tool of some node is shifted, by FAR at most along each axis, [m]. Out of a narrow shelf
# an arm pulls its hand back along a line, which random targets in joint space seldom hit.
SHIFTED, FAR = 0.05, 0.3
METRE = 4.0  # Angle that counts as much as a metre of a sliding joint, [rad]
MOST_NODES, MOST_SAMPLES = 20_000, 300_000  # Greatest numbers of nodes of a tree and of its targets
SHORTCUTS = 200  # Number of shortcuts that are tried
LESS = 0.95  # Length of a shortcut that is worth a check, as a share of the way that it replaces
VIA_COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # Numbers of points of a path that are tried as via-points


class Check(NamedTuple):
    """Arm, obstacles, margin and memory of a check of configurations."""

    setting: Setting  # Arm, and ranges of its joints
    obstacles: Obstacles  # Obstacles of one scene, at rest
    margin: float  # Least clearance that is kept, [m]
    here: Float  # Memory for a configuration, shape (J,)
    placed: Placed  # Memory for the places of the arm's parts


@compiled
def check_of(setting: Setting, obstacles: Obstacles, margin: float) -> Check:
    """Return a check with its memory."""
    here = np.empty(len(setting.joint_range))
    return Check(setting, obstacles, margin, here, memory(setting.chain, setting.spheres))


@compiled
def clear_path(
    setting: Setting,
    ends: Float,
    obstacles: Obstacles,
    margin: float,
    rng: np.random.Generator,
    patience: float,
) -> Float:
    """Return the corners of a clear path with start and goal, shape (P, J); none, shape (0, J), if none is found.

    Args:
        setting: Arm, and ranges of its joints.
        ends: Start and goal, both clear, shape (2, J).
        obstacles: Obstacles of one scene, at rest.
        margin: Least clearance of the path, [m].
        rng: Random generator.
        patience: Time limit, [s].
    """
    until = clock() + patience
    low, high = setting.joint_range[:, 0], setting.joint_range[:, 1]
    check = check_of(setting, obstacles, margin)
    joints = len(low)
    target = np.empty(joints)
    # Both trees: their nodes, the node from which each was reached, and how many there are.
    node = np.empty((2, MOST_NODES, joints))
    parent = np.empty((2, MOST_NODES), np.int64)
    count = np.ones(2, np.int64)
    node[:, 0] = ends
    parent[:, 0] = -1
    for _ in range(MOST_SAMPLES):
        if count.max() == MOST_NODES or clock() > until:
            break
        one = int(count[0] > count[1])  # the smaller tree grows
        other = 1 - one
        if rng.uniform(0.0, 1.0) < SHIFTED:
            _shift(setting, node[one, int(rng.uniform(0.0, count[one]))], rng, target, check.placed)
        else:
            for j in range(joints):
                target[j] = rng.uniform(low[j], high[j])
        if _grow(check, node[one], parent[one], count, one, target) < 0.0:
            continue
        reached = node[one, count[one] - 1]
        left = 1.0
        while left > 0.0 and count[other] < MOST_NODES:
            left = _grow(check, node[other], parent[other], count, other, reached)
        if left == 0.0:
            path = np.empty((count[0] + count[1] + SHORTCUTS, joints))
            length = _join(node, parent, count, path)
            length = _shorten(check, path, length, rng, np.empty((2, joints)))
            return path[:length]
    return np.empty((0, joints))


@compiled
def _shift(setting: Setting, node: Float, rng: np.random.Generator, target: Float, placed: Placed) -> None:
    """Fill in a target with the tool of a node shifted at random, and turned as before if joints suffice for that."""
    chain = setting.chain
    turn = chain.tool_rotation
    joints = len(node)
    place = np.empty(3)
    axes = np.empty((3, 3))
    here = tool_position(chain, node, placed.rotation, placed.origin)
    for i in range(3):
        place[i] = here[i] + rng.uniform(-FAR, FAR)
        axis = turn[0, i], turn[1, i], turn[2, i]
        axes[0, i], axes[1, i], axes[2, i] = rotated(placed.rotation[joints], axis)
    _copy(node, target)
    descend(chain, setting.joint_range, place, axes, joints >= 6, target)


@inner
def _grow(check: Check, node: Float, parent: Int, count: Int, tree: int, target: Float) -> float:
    """Add a node to a tree, one step from its nearest node to a target; return the way that is left, -1 in contact."""
    sliding, new = check.setting.chain.sliding, count[tree]
    nearest, least = 0, np.inf
    for each in range(new):
        square = 0.0
        for j in range(len(target)):
            difference = node[each, j] - target[j]
            if sliding[j]:
                difference *= METRE
            square += difference * difference
        if square < least:
            nearest, least = each, square
    way = math.sqrt(least)
    share = min(1.0, STEP / max(way, 1e-9))
    for j in range(len(target)):
        node[new, j] = node[nearest, j] + share * (target[j] - node[nearest, j])
    if not _line_is_clear(check, node[nearest], node[new]):
        return -1.0
    parent[new] = nearest
    count[tree] += 1
    return max(way - STEP, 0.0)


@inner
def keeps_margin(check: Check, joints: Float) -> bool:
    """Return True if a configuration keeps the margin from the obstacles, and from itself."""
    spheres, placed, margin = check.setting.spheres, check.placed, check.margin
    place(check.setting.chain, spheres, joints, placed)
    if obstacle_clearance(spheres, placed, check.obstacles, 0, 0.0, margin, margin) < margin:
        return False
    return self_clearance(spheres, placed, margin, margin) >= margin


@inner
def _line_is_clear(check: Check, first: Float, last: Float) -> bool:
    """Return True if the arm keeps the margin on the straight way from one configuration, which is clear, to another.

    The end is looked at first, then the middle, the quarters, and so on.
    """
    way, here = 0.0, check.here
    for j in range(len(here)):
        way = max(way, check.setting.reach[j] * abs(last[j] - first[j]))
    count = 1
    while count * SPACING < way:
        count *= 2
    begin = count
    stride = count
    while begin:
        for k in range(begin, count + 1, stride):
            for j in range(len(here)):
                here[j] = first[j] + k / count * (last[j] - first[j])
            if not keeps_margin(check, here):
                return False
        stride = begin
        begin //= 2
    return True


@inlined
def _distance(first: Float, second: Float) -> float:
    """Return the distance of two configurations, shape (J,), [rad]."""
    square = 0.0
    for j in range(len(first)):
        square += (first[j] - second[j]) ** 2
    return math.sqrt(square)


@kernel
def _copy(source: Float, target: Float) -> None:
    """Copy a configuration."""
    for j in range(len(source)):
        target[j] = source[j]


@inner
def _join(node: Float, parent: Int, count: Int, path: Float) -> int:
    """Fill in the path from root to root through the last nodes of both trees, which are equal; return its length."""
    length = 0
    each = count[0] - 1
    while each >= 0:
        length += 1
        each = parent[0, each]
    each = count[0] - 1
    for corner in range(length - 1, -1, -1):
        _copy(node[0, each], path[corner])
        each = parent[0, each]
    each = parent[1, count[1] - 1]
    while each >= 0:
        _copy(node[1, each], path[length])
        length += 1
        each = parent[1, each]
    return length


@inner
def _shorten(check: Check, path: Float, length: int, rng: np.random.Generator, points: Float) -> int:
    """Put clear straight lines in place of ways around, and return the new number of corners of a path.

    First the lines go from one random point of the path to another, for which `points` is memory, shape (2, J), and
    then from corner to corner.
    """
    for _ in range(SHORTCUTS):
        # Points of the path, as numbers of a corner and shares of the way to the next.
        one = rng.uniform(0.0, length - 1.0)
        other = rng.uniform(0.0, length - 1.0)
        first, last = int(min(one, other)), int(max(one, other))
        if first == last:
            continue
        for j in range(path.shape[1]):
            for point, corner, share in (
                (0, first, min(one, other) - first),
                (1, last, max(one, other) - last),
            ):
                points[point, j] = path[corner, j] + share * (path[corner + 1, j] - path[corner, j])
        begin, end = points[0], points[1]
        way = _distance(begin, path[first + 1]) + _distance(path[last], end)
        for corner in range(first + 1, last):
            way += _distance(path[corner], path[corner + 1])
        if _distance(begin, end) > LESS * way:
            continue
        if _line_is_clear(check, begin, end):
            length = _move(path, length, last + 1, first + 3)
            _copy(begin, path[first + 1])
            _copy(end, path[first + 2])
    corner = 0
    while corner + 2 < length:
        last = length - 1
        while last > corner + 1 and not _line_is_clear(check, path[corner], path[last]):
            last -= 1
        length = _move(path, length, last, corner + 1)
        corner += 1
    return length


@inlined
def _move(path: Float, length: int, begin: int, target: int) -> int:
    """Move the corners of a path from `begin` on to another row, and return the new number of corners."""
    way = target - begin
    for i in range(length - begin):
        corner = length - 1 - i if way > 0 else begin + i
        _copy(path[corner], path[corner + way])
    return length + way


def points_on(path: Float, count: int) -> Float:
    """Return start, `count` points and goal of a path of straight pieces.

    The points are the corners if there are as many, otherwise they are evenly spaced along the path. If there are more
    points than corners, each corner replaces the nearest point.
    """
    if count == len(path) - 2:
        return path
    along = np.concatenate(([0.0], np.cumsum(norm(np.diff(path, axis=0)))))
    places = along[-1] * np.arange(1, count + 1) / (count + 1)
    if count > len(path) - 2:
        for corner in along[1:-1]:
            places[np.abs(places - corner).argmin()] = corner
    places = np.concatenate(([0.0], np.sort(places), along[-1:]))
    return np.stack([np.interp(places, along, path[:, i]) for i in range(path.shape[1])], axis=-1)
