"""Signed distances of points from packed obstacles, and clearance of configurations and movements of an arm.

The arm is a set of spheres, see :class:`~viapoint.envs.arms.kinematics.Spheres`. Its clearance from an obstacle is the
least signed distance of a sphere's centre, minus the radius of the sphere. Broad phase: a bounding ball of each group
of spheres comes first, and the spheres of a group are only placed where its ball is near enough to matter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.kinematics import PART, Chain, Spheres, link_frames, transform
from viapoint.envs.common.arrays import Bool, Float
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.compiled import Vector, compiled, inlined, inner, kernel, rotated, rotated_back
from viapoint.envs.geometry.obstacles import ABSENT, Obstacles
from viapoint.envs.geometry.shapes import Distance, Shape, as_obstacles, local_distance

FAR = 1.0  # Greatest clearance that is reported, [m]; farther obstacles do not matter
# Way beyond the least clearance so far up to which a movement looks for more, to skip configurations, [m]
WINDOW = 0.1
# Errors of the clearance between two configurations of a movement: where it is close to a floor, and elsewhere, [m]
RESOLUTION, ROUGHLY = 1e-4, 1e-3
COARSE = 16  # Configurations from one to the next that a first, coarse look at a movement takes


class Placed(NamedTuple):
    """World places of an arm's parts in one configuration; memory that compiled functions use again and again."""

    rotation: Float  # Axes of the links' frames, shape (J + 1, 3, 3)
    origin: Float  # Origins of the links' frames, shape (J + 1, 3), [m]
    # Centres of the bounding balls of groups, and of the parts of known groups, shape (G + C, 3), [m]
    ball: Float
    centre: Float  # Centres of the spheres of known groups, shape (S, 3), [m]
    known: Bool  # True for groups whose spheres are placed, shape (G,)


class Bounds(NamedTuple):
    """Memory of :func:`movement_clearance`.

    It is not a part of :class:`Placed`: compiled functions that pass a record on take longer the more arrays it has.
    """

    # Lower bounds of the clearance of groups from obstacles, and then of pairs of groups, shape (G + P,), [m]
    apart: Float
    way: Float  # Bounds of the way of the spheres of links 0 to J since another configuration, shape (J + 1,), [m]
    bend: Float  # Bounds of how much longer than its chord this way is, shape (J + 1,), [m]
    group_way: Float  # Bounds of the way of the spheres of groups, shape (G,), [m]
    rotation: Float  # Axes of the links' frames in the configuration before, shape (J + 1, 3, 3)
    ball: Float  # Centres of the bounding balls in the configuration before, shape (G, 3), [m]
    between: Float  # Joints between two configurations, shape (J,); empty if nothing counts there


@inlined
def point_distance_and_normal(
    obstacles: Obstacles, scene: int, row: int, x: float, y: float, z: float, time: float, limit: float
) -> Distance:
    """Return the signed distance of a point from an obstacle, [m], and its gradient, the outward normal.

    The obstacle has moved for `time` since it was at its centre; absent ones are far away. Beyond `limit`, [m], any
    number between it and the distance may be returned. The compiler leaves out a gradient that nothing uses.
    """
    centre, velocity, size = obstacles.centre, obstacles.velocity, obstacles.size
    dx = x - centre[scene, row, 0] - time * velocity[scene, row, 0]
    dy = y - centre[scene, row, 1] - time * velocity[scene, row, 1]
    dz = z - centre[scene, row, 2] - time * velocity[scene, row, 2]
    axes = obstacles.rotation[scene, row]
    here = rotated_back(axes, (dx, dy, dz))
    sizes = size[scene, row, 0], size[scene, row, 1], size[scene, row, 2]
    kind, meshes, clouds = obstacles.kind[scene, row], obstacles.meshes, obstacles.clouds
    distance, nx, ny, nz = local_distance(kind, sizes, meshes, clouds, here, limit)
    nx, ny, nz = rotated(axes, (nx, ny, nz))
    return distance, nx, ny, nz


@compiled
def point_clearances(obstacles: Obstacles, points: Float) -> Float:
    """Return the signed distance of a point, one of (N, 3), from the nearest obstacle of each scene, at most 1 m."""
    found = np.ones(len(obstacles.kind))
    for scene in range(len(found)):
        x, y, z = points[scene]
        for row in range(obstacles.kind.shape[1]):
            if obstacles.kind[scene, row] != ABSENT:
                apart = point_distance_and_normal(obstacles, scene, row, x, y, z, 0.0, 1.0)[0]
                found[scene] = min(found[scene], apart)
    return found


def signed_distances(obstacles: Iterable[Shape | Mapping[str, Any]], points: Any, radius: Any = 0.0) -> Float:
    """Return the signed distances of points, or spheres, from n obstacles at time 0, shape (..., n), [m].

    Args:
        obstacles: n shapes or dictionaries.
        points: Shape (..., 3), [m].
        radius: Radius of the spheres, which broadcasts with the leading axes, [m].

    Example:
        >>> from viapoint.envs.geometry.clearance import signed_distances
        >>> from viapoint.envs.geometry.shapes import Box, Sphere
        >>> scene = [Box((0.4, 0.6, 0.02), position=(0.5, 0.0, 0.2)), Sphere(0.05, position=(0.5, 0.2, 0.27))]
        >>> signed_distances(scene, [0.5, 0.0, 0.27], radius=0.03).round(3).tolist()
        [0.02, 0.12]
    """
    points = finite_array("points", points, (..., 3))
    shapes = as_obstacles(obstacles)
    if not shapes:
        return np.zeros((*points.shape[:-1], 0))
    return np.stack([shape.distance(points, radius) for shape in shapes], axis=-1)


@compiled
def memory(chain: Chain, spheres: Spheres) -> Placed:
    """Return memory for the places of an arm."""
    joints = len(chain.mass)
    groups = len(spheres.link)
    return Placed(
        np.empty((joints + 1, 3, 3)),
        np.empty((joints + 1, 3)),
        np.empty((len(spheres.ball_radius), 3)),
        np.empty((len(spheres.radius), 3)),
        np.empty(groups, np.bool_),
    )


@compiled
def bounds_memory(chain: Chain, spheres: Spheres, between: bool) -> Bounds:
    """Return memory for the clearance of movements, also `between` their configurations or at these alone."""
    joints = len(chain.mass)
    groups = len(spheres.link)
    return Bounds(
        np.empty(groups + len(spheres.pairs)),
        np.empty(joints + 1),
        np.empty(joints + 1),
        np.empty(groups),
        np.empty((joints + 1, 3, 3)),
        np.empty((groups, 3)),
        np.empty(joints if between else 0),
    )


@inlined
def place(chain: Chain, spheres: Spheres, joints: Float, placed: Placed) -> None:
    """Place links and bounding balls for joint positions of shape (J,)."""
    link_frames(chain, joints, placed.rotation, placed.origin)
    for group in range(len(spheres.link)):
        _place_point(placed, spheres.link[group], spheres.ball_centre, group, placed.ball)
        placed.known[group] = False


@inlined
def _place_point(placed: Placed, link: int, points: Float, row: int, places: Float) -> None:
    """Place one of the points of a table that are fixed to links."""
    here = transform(placed.rotation, placed.origin, link, points[row])
    places[row, 0], places[row, 1], places[row, 2] = here


@inlined
def place_group(spheres: Spheres, group: int, placed: Placed) -> None:
    """Place the spheres of a group, if they are not known yet."""
    if not placed.known[group]:
        placed.known[group] = True
        for sphere in range(spheres.first[group], spheres.first[group + 1]):
            _place_point(placed, spheres.link[group], spheres.centre, sphere, placed.centre)
        for part in range(spheres.part[group], spheres.part[group + 1]):
            _place_point(placed, spheres.link[group], spheres.ball_centre, part, placed.ball)


@inlined
def group_clearance(
    spheres: Spheres,
    placed: Placed,
    group: int,
    obstacles: Obstacles,
    scene: int,
    row: int,
    time: float,
    least: float,
    floor: float,
) -> tuple[float, int, Vector]:
    """Return the clearance of a group of spheres from an obstacle, at most `least`, [m], and the sphere that has it.

    The third result is the normal of the obstacle there. The sphere is -1 if none is nearer than `least`. The arguments
    are those of :func:`obstacle_clearance`.
    """
    nearest = -1
    normal = 0.0, 0.0, 0.0
    ball = spheres.first[group] - 1  # stands for the bounding ball of the group, which comes first
    for sphere in range(ball, spheres.first[group + 1]):
        if sphere == ball:
            radius = spheres.ball_radius[group]
            x = placed.ball[group, 0]
            y = placed.ball[group, 1]
            z = placed.ball[group, 2]
        else:
            radius = spheres.radius[sphere]
            x = placed.centre[sphere, 0]
            y = placed.centre[sphere, 1]
            z = placed.centre[sphere, 2]
        limit = least + radius
        distance, a, b, c = point_distance_and_normal(obstacles, scene, row, x, y, z, time, limit)
        distance -= radius
        if sphere == ball:
            if distance >= least:
                break
            place_group(spheres, group, placed)
        elif distance < least:
            least = distance
            nearest = sphere
            normal = a, b, c
            if least < floor:
                break
    return least, nearest, normal


@inner
def obstacle_clearance(
    spheres: Spheres,
    placed: Placed,
    obstacles: Obstacles,
    scene: int,
    time: float,
    least: float,
    floor: float,
    only: int = -1,
    link: int = 1,
) -> float:
    """Return the clearance of a placed arm from the obstacles of a scene at a time, at most `least`, [m].

    The search stops at the first clearance below `floor`: the exact value below it does not matter. Of the obstacles,
    one may be the `only` one that counts, and links from `link` on: the base does not, as it may stand on an obstacle.
    """
    first = max(only, 0)
    last = obstacles.kind.shape[1] if only < 0 else only + 1
    for group in range(len(spheres.link)):
        if spheres.link[group] < link:
            continue
        for row in range(first, last):
            if obstacles.kind[scene, row] == ABSENT:
                continue
            least, _, _ = group_clearance(spheres, placed, group, obstacles, scene, row, time, least, floor)
            if least < floor:
                return least
    return least


@inlined
def nearest_spheres(
    spheres: Spheres, placed: Placed, pair: int, least: float, floor: float
) -> tuple[float, int, int]:
    """Return the clearance of a pair of groups, at most `least`, [m], and the spheres that have it, -1 for none."""
    first, second = spheres.pairs[pair, 0], spheres.pairs[pair, 1]
    # Most pairs are apart, which takes less time to see than a call.
    sizes = spheres.ball_radius[first] + spheres.ball_radius[second] - spheres.self_allowance
    if _are_apart(placed.ball, first, placed.ball, second, sizes + least):
        return least, -1, -1
    within, stop = least - spheres.self_allowance, floor - spheres.self_allowance
    apart, one, other = _nearest_spheres(spheres, placed, first, second, within, stop)
    return apart + spheres.self_allowance if one >= 0 else least, one, other


@inner
def _nearest_spheres(
    spheres: Spheres, placed: Placed, first: int, second: int, least: float, floor: float
) -> tuple[float, int, int]:
    """Return the same for two groups whose bounding balls are near; most pairs of their parts are apart."""
    nearest, partner = -1, -1
    balls = spheres.ball_radius
    place_group(spheres, first, placed)
    place_group(spheres, second, placed)
    for start in range(spheres.first[first], spheres.first[first + 1], PART):
        part = _part(spheres, first, start)
        if _are_apart(placed.ball, part, placed.ball, second, balls[part] + balls[second] + least):
            continue
        for other_start in range(spheres.first[second], spheres.first[second + 1], PART):
            other_part = _part(spheres, second, other_start)
            sizes = balls[part] + balls[other_part]
            if other_part != second and _are_apart(placed.ball, part, placed.ball, other_part, sizes + least):
                continue
            for one in range(start, min(start + PART, spheres.first[first + 1])):
                size = spheres.radius[one]
                # The ball of the second part excludes most spheres of the first.
                if _are_apart(placed.centre, one, placed.ball, other_part, size + balls[other_part] + least):
                    continue
                for other in range(other_start, min(other_start + PART, spheres.first[second + 1])):
                    sizes = size + spheres.radius[other]
                    if not _are_apart(placed.centre, one, placed.centre, other, sizes + least):
                        least = math.sqrt(_square(placed.centre, one, placed.centre, other)) - sizes
                        nearest, partner = one, other
                        if least < floor:
                            return least, nearest, partner
    return least, nearest, partner


@inlined
def _part(spheres: Spheres, group: int, sphere: int) -> int:
    """Return the bounding ball of the part of a group that begins with a sphere."""
    if spheres.part[group] == spheres.part[group + 1]:
        return group
    return int(spheres.part[group] + (sphere - spheres.first[group]) // PART)


@inner
def self_clearance(spheres: Spheres, placed: Placed, least: float, floor: float) -> float:
    """Return the clearance of a placed arm from itself, at most `least`, [m]; see :func:`obstacle_clearance`."""
    for pair in range(len(spheres.pairs)):
        least, _, _ = nearest_spheres(spheres, placed, pair, least, floor)
        if least < floor:
            return least
    return least


@inlined
def _square(first: Float, i: int, second: Float, j: int) -> float:
    """Return the squared distance of two points of tables, [m^2]."""
    x = first[i, 0] - second[j, 0]
    y = first[i, 1] - second[j, 1]
    z = first[i, 2] - second[j, 2]
    return float(x * x + y * y + z * z)


@inlined
def _are_apart(first: Float, i: int, second: Float, j: int, distance: float) -> bool:
    """Return True if two points of tables are a distance apart or more, [m], as always if it is negative."""
    return distance <= 0.0 or _square(first, i, second, j) >= distance * distance


@kernel
def travel(reach: Float, first: Float, second: Float) -> float:
    """Return a bound of the way of any sphere between two configurations of shape (J,), [m].

    `reach` is the greatest distance of a sphere's centre from the axis of each joint, 1 for sliding joints.
    """
    total = 0.0
    for joint in range(len(reach)):
        total += reach[joint] * abs(second[joint] - first[joint])
    return total


@inner
def fastest(obstacles: Obstacles, scene: int) -> float:
    """Return the greatest speed of an obstacle of a scene, [m/s]."""
    square = 0.0
    for row in range(obstacles.kind.shape[1]):
        if obstacles.kind[scene, row] != ABSENT:
            x, y, z = obstacles.velocity[scene, row]
            square = max(square, x * x + y * y + z * z)
    return float(np.sqrt(square))


@kernel
def movement_clearance(
    chain: Chain,
    spheres: Spheres,
    reach: Float,
    path: Float,
    obstacles: Obstacles,
    scene: int,
    begin: float,
    step: float,
    placed: Placed,
    bounds: Bounds,
    floor: float,
) -> tuple[float, float]:
    """Return the least clearance of T configurations from obstacles and from the arm itself, at most FAR each, [m].

    The values are exact, but most configurations of the path, shape (T, J), are skipped: after a clearance c of some
    spheres, none of them is nearer than the least so far before they, and the obstacles, have moved by the difference.
    The path begins at the time `begin` and takes `step` from one configuration to the next, [s].

    With memory for joints between two configurations, the lesser value also counts between the configurations, where
    joints and obstacles move straight. It may be too great by ROUGHLY, but not so that it is `floor` or more in place
    of less than that by RESOLUTION or more.
    """
    least, least_self = FAR, FAR
    between = bounds.between
    drift = step * fastest(obstacles, scene)  # the way of obstacles in one step
    # A coarse look comes first: with a small clearance from the start, the second one skips most configurations.
    for stride in (COARSE, 1):
        bounds.apart[:] = -FAR  # so low that they tell nothing
        last = -1  # the configuration whose places are kept
        for k in range(0, len(path), stride):
            _set_ways(reach, path[max(k - stride, 0)], path[k], spheres, bounds)
            is_placed = False
            looks_between = len(between) > 0 and stride == 1 and k > 0
            if looks_between and _matters(spheres, bounds, drift, least):
                if last != k - 1:
                    place(chain, spheres, path[k - 1], placed)
                    _keep_places(placed, bounds)
                place(chain, spheres, path[k], placed)
                _shorten_ways(spheres, placed, bounds)
                _keep_places(placed, bounds)
                is_placed, last = True, k
            for check in range(len(bounds.apart)):
                bounds.apart[check] -= _way(spheres, bounds, check, stride * drift)
            for check in range(len(bounds.apart)):
                of_pair = check >= len(spheres.link)
                bound = bounds.apart[check]
                if bound >= (least_self if of_pair else least) or not (of_pair or spheres.link[check]):
                    continue
                if not is_placed:
                    place(chain, spheres, path[k], placed)
                    is_placed = True
                # First the configuration itself, and then what may be nearer on the way from the one before.
                time = begin + k * step
                way = share = 0.0
                while share < 1.0:
                    if way > 0.0:
                        _place_between(chain, spheres, path, k, share, between, placed)
                        is_placed = False
                        time = begin + (k - 1 + share) * step
                    most = (least_self if of_pair else least) + WINDOW
                    apart = _nearest(spheres, placed, check, obstacles, scene, time, most)
                    if of_pair:
                        least_self = min(least_self, apart)
                    else:
                        least = min(least, apart)
                    low = min(least, least_self)
                    if way > 0.0:
                        share += _until_next(apart, way, low, floor)
                        continue
                    bounds.apart[check] = apart
                    way = _way(spheres, bounds, check, drift)
                    if not looks_between or way == 0.0 or 0.5 * (bound + apart) >= _certain(low, floor):
                        break
                    share = _until_next(bound + way, way, low, floor)
    return least, least_self


@inlined
def _nearest(
    spheres: Spheres, placed: Placed, check: int, obstacles: Obstacles, scene: int, time: float, most: float
) -> float:
    """Return the clearance of a group from all obstacles, or that of a pair of groups, at most `most`, [m]."""
    groups = len(spheres.link)
    if check >= groups:
        return nearest_spheres(spheres, placed, check - groups, most, -FAR)[0]
    for row in range(obstacles.kind.shape[1]):
        if obstacles.kind[scene, row] != ABSENT:
            most, _, _ = group_clearance(spheres, placed, check, obstacles, scene, row, time, most, -FAR)
            if most < -FAR:
                break
    return most


@inlined
def _certain(low: float, floor: float) -> float:
    """Return the clearance that must be certain between two configurations where the least so far is `low`, [m]."""
    return max(low - ROUGHLY, floor - RESOLUTION) if low >= floor else low - ROUGHLY


@inlined
def _until_next(apart: float, way: float, low: float, floor: float) -> float:
    """Return the share of an interval after which to look again, where it begins with some clearance, [m].

    At the next look the clearance is counted, so it is not less than the least. With both ends known, and a bound of
    the way in the whole interval, nothing between them is nearer than what must be certain.
    """
    return (apart + low - 2.0 * _certain(low, floor)) / way


@inner
def _place_between(
    chain: Chain, spheres: Spheres, path: Float, k: int, share: float, joints: Float, placed: Placed
) -> None:
    """Place the arm at a share of the way from the configuration before to configuration k."""
    for joint in range(len(joints)):
        joints[joint] = path[k - 1, joint] + share * (path[k, joint] - path[k - 1, joint])
    place(chain, spheres, joints, placed)


@inlined
def _way(spheres: Spheres, bounds: Bounds, check: int, drift: float) -> float:
    """Return how much a group and the obstacles, or a pair of groups, may have come nearer to one another, [m].

    Obstacles move by `drift`. A pair moves by the joints between both alone, and not by more than both have moved.
    """
    groups = len(spheres.link)
    if check < groups:
        return float(bounds.group_way[check] + drift)
    one = spheres.pairs[check - groups, 0]
    other = spheres.pairs[check - groups, 1]
    between = abs(bounds.way[spheres.link[other]] - bounds.way[spheres.link[one]])
    return float(min(between, bounds.group_way[one] + bounds.group_way[other]))


@inlined
def _set_ways(reach: Float, first: Float, second: Float, spheres: Spheres, bounds: Bounds) -> None:
    """Set bounds of the ways of links and groups between two configurations, with straight movements of the joints."""
    way, bend = bounds.way, bounds.bend
    way[0] = 0.0
    bend[0] = 0.0
    turned = 0.0
    for joint in range(len(reach)):
        turn = abs(second[joint] - first[joint])
        way[joint + 1] = way[joint] + reach[joint] * turn
        # Half of a bound of the second derivative of the way, in which each pair of joints counts twice.
        bend[joint + 1] = bend[joint] + 0.5 * reach[joint] * turn * (turn + 2.0 * turned)
        turned += turn
    for group in range(len(bounds.group_way)):
        bounds.group_way[group] = way[spheres.link[group]]


@inlined
def _matters(spheres: Spheres, bounds: Bounds, drift: float, least: float) -> bool:
    """Return True if the ways of the groups must be known better, because one may now be nearer than the least."""
    for group in range(len(spheres.link)):
        if spheres.link[group] > 0 and bounds.apart[group] - bounds.group_way[group] - drift < least:
            return True
    return False


@inlined
def _keep_places(placed: Placed, bounds: Bounds) -> None:
    """Keep the places of links and balls as those of the configuration before."""
    for link in range(len(bounds.way)):
        for row in range(3):
            for column in range(3):
                bounds.rotation[link, row, column] = placed.rotation[link, row, column]
    for group in range(len(bounds.ball)):
        for axis in range(3):
            bounds.ball[group, axis] = placed.ball[group, axis]


@inlined
def _shorten_ways(spheres: Spheres, placed: Placed, bounds: Bounds) -> None:
    """Lower the bounds of the ways of groups to what follows from where they are now and were before.

    No sphere of a group has a longer chord than that of the group's ball and of a point at its edge. The chord is the
    mean of the velocity, from which the velocity differs by half of its greatest derivative at most.
    """
    for group in range(len(bounds.ball)):
        link = spheres.link[group]
        turn = 0.0
        for row in range(3):
            for column in range(3):
                change = placed.rotation[link, row, column] - bounds.rotation[link, row, column]
                turn += 0.5 * change * change
        chord = math.sqrt(_square(placed.ball, group, bounds.ball, group))
        bound = chord + spheres.ball_radius[group] * math.sqrt(turn) + bounds.bend[link]
        bounds.group_way[group] = min(bounds.group_way[group], bound)


@compiled
def row_clearances(
    chain: Chain, spheres: Spheres, joints: Float, obstacles: Obstacles, most: float
) -> tuple[Float, Float]:
    """Return the clearances of N arms from n obstacles at time 0, shape (N, n), and from themselves, shape (N,), [m].

    They are at most `most`.
    """
    placed = memory(chain, spheres)
    number, rows = obstacles.kind.shape
    found, own = np.empty((number, rows)), np.empty(number)
    for scene in range(number):
        place(chain, spheres, joints[scene], placed)
        own[scene] = self_clearance(spheres, placed, most, -FAR)
        for row in range(rows):
            found[scene, row] = obstacle_clearance(spheres, placed, obstacles, scene, 0.0, most, -FAR, row)
    return found, own
