"""Covering of an arm's collision geoms by spheres, and the pairs of bodies that must not touch one another."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.kinematics import PART, Chain, Spheres
from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import memory, nearest_spheres, place
from viapoint.envs.geometry.compiled import compiled

LARGEST_EXCESS = 0.005  # Greatest distance by which a sphere may stick out of a capsule, [m]
SHRUNK = 0.5  # Factor on this distance for bodies whose spheres overlap at home although their geoms do not
SHRINKING = 6  # Greatest number of times that it is applied
FINEST = 0.002  # Distance above which it is applied for bodies that have room between them elsewhere, [m]
ROUNDS = 2000  # Iterations for bounding balls

Capsule = tuple[Float, float]  # Ends of the axis, shape (2, 3), equal for a sphere, and radius, [m]


class LeftOut(NamedTuple):
    """Pair of bodies that are not compared."""

    first: str
    second: str
    reason: str


def cover(
    chain: Chain,
    capsules: dict[str, list[Capsule]],
    links: dict[str, int],
    views: Float,
    exclude: Mapping[frozenset[str], str],
    room: Callable[[str, str, Float], bool] | None = None,
) -> tuple[tuple[str, ...], Spheres, list[LeftOut], float]:
    """Return groups of spheres that contain all capsules: names of bodies, spheres, pairs left out, and excess, [m].

    Capsules of each body are in the frame of its link. Pairs in `exclude`, with a reason, may pass through one another.
    Others get smaller spheres if they overlap in the first of the configurations `views`, shape (N, J), which is home,
    or in another one although there is `room` between them.

    Raises:
        ValueError: Spheres of bodies that are apart at home overlap there, however small they are.
    """
    names = tuple(capsules)
    pairs, left_out = _pairs(names, links, exclude)
    excess = dict.fromkeys(names, LARGEST_EXCESS)
    for _ in range(SHRINKING):
        centres, radii, beyond = [], [], 0.0
        for name in names:
            covers = [_along(*capsule, excess[name]) for capsule in capsules[name]]
            centres.append(np.concatenate([points for points, _ in covers]))
            radii.append(np.concatenate([np.full(len(points), radius) for points, radius in covers]))
            for (_, inner), (_, outer) in zip(capsules[name], covers, strict=True):
                beyond = max(beyond, outer - inner)
        spheres = grouped(centres, radii, [links[name] for name in names], pairs)
        overlap: Any = overlapping(chain, spheres, views)
        close = spheres.pairs[overlap[0]]
        coarse = {names[group] for group in close.flat}
        for view, row in np.argwhere(overlap)[len(close) :]:
            pair = [names[group] for group in spheres.pairs[row]]
            wide = {name for name in pair if excess[name] > FINEST}
            if wide - coarse and room is not None and room(pair[0], pair[1], views[view]):
                coarse |= wide
        if not coarse:
            return names, spheres, left_out, beyond
        for name in coarse:
            excess[name] *= SHRUNK  # smaller spheres, and more of them
    if not len(close):
        return names, spheres, left_out, beyond
    first, second = close[0]
    raise ValueError(
        f"the bodies {names[first]!r} and {names[second]!r} are so close at home that spheres on them overlap: give "
        "another home"
    )


def _pairs(
    names: Sequence[str], links: dict[str, int], exclude: Mapping[frozenset[str], str]
) -> tuple[list[tuple[int, int]], list[LeftOut]]:
    """Return the pairs of groups that are compared, and those of different links that are not."""
    pairs, left_out = [], []
    for (i, first), (j, second) in itertools.combinations(enumerate(names), 2):
        pair = frozenset((first, second))
        if links[first] == links[second]:  # rigid to one another
            continue
        if pair in exclude:
            left_out.append(LeftOut(first, second, exclude[pair]))
        else:
            pairs.append((i, j))
    return pairs, left_out


def grouped(
    centres: Sequence[Float], radii: Sequence[Float], links: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> Spheres:
    """Return spheres from centres (n, 3) and radii (n,) of each group, [m], the links of groups, and pairs of them."""
    sorted_centres, sorted_radii = [], []
    balls, part_balls = [], []
    part = [len(links)]
    for centre, radius in zip(centres, radii, strict=True):
        order = _neighbours(centre, np.arange(len(centre)))
        centre, radius = centre[order], radius[order]
        balls.append(_bounding_ball(centre.mean(axis=0), centre, radius))
        if len(centre) > PART:
            for begin in range(0, len(centre), PART):
                some = slice(begin, begin + PART)
                part_balls.append(_bounding_ball(centre[some].mean(axis=0), centre[some], radius[some]))
        sorted_centres.append(centre)
        sorted_radii.append(radius)
        part.append(len(links) + len(part_balls))
    around = np.array(balls + part_balls)
    return Spheres(
        centre=np.concatenate(sorted_centres),
        radius=np.concatenate(sorted_radii),
        first=np.cumsum([0, *map(len, radii)]),
        link=np.array(links, dtype=np.int64),
        ball_centre=np.array(around[:, :3], order="C"),
        ball_radius=np.array(around[:, 3], order="C"),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        part=np.array(part),
    )


def _neighbours(centre: Float, some: Int) -> Int:
    """Return indices of centres, shape (n, 3), [m], in an order in which each PART of them are neighbours."""
    if len(some) <= PART:
        return some
    away = centre[some] - centre[some].mean(axis=0)
    longest = np.linalg.svd(away, full_matrices=False)[2][0]
    along = some[np.argsort(away @ longest, kind="stable")]
    middle = PART * ((len(along) + PART) // (2 * PART))
    return np.concatenate((_neighbours(centre, along[:middle]), _neighbours(centre, along[middle:])))


def _along(ends: Float, radius: float, excess: float) -> tuple[Float, float]:
    """Return the centres, shape (n, 3), and the radius of spheres that contain a capsule, [m].

    Spheres of radius R that are s apart contain the cylinder of radius r between them if R^2 >= r^2 + s^2 / 4.
    """
    length = float(np.linalg.norm(ends[1] - ends[0]))
    spacing = 2.0 * np.sqrt((radius + excess) ** 2 - radius**2)
    number = int(np.ceil(length / spacing))
    share = np.linspace(0.0, 1.0, number + 1)[:, None]
    larger = np.sqrt(radius**2 + 0.25 * (length / max(number, 1)) ** 2)
    return ends[0] + share * (ends[1] - ends[0]), float(larger)


@compiled
def _bounding_ball(start: Float, centre: Float, radius: Float) -> Float:
    """Return centre and radius of a ball around spheres that is hardly larger than the smallest one, shape (4,), [m].

    In each round the centre, at first `start`, moves towards the farthest sphere, by less and less (M. Badoiu and K. L.
    Clarkson, Smaller core-sets for balls, 2003).
    """
    ball = np.append(start, 0.0)
    for k in range(ROUNDS + 1):
        farthest, reach = 0, 0.0
        for i in range(len(centre)):
            x = centre[i, 0] - ball[0]
            y = centre[i, 1] - ball[1]
            z = centre[i, 2] - ball[2]
            far = np.sqrt(x * x + y * y + z * z) + radius[i]
            if far > reach:
                farthest, reach = i, far
        ball[3] = reach
        if k < ROUNDS:
            for axis in range(3):
                ball[axis] += (centre[farthest, axis] - ball[axis]) / (k + 2.0)
    return ball


@compiled
def overlapping(chain: Chain, spheres: Spheres, joints: Float) -> Bool:
    """Return True where pairs of groups overlap in N configurations, shape (N, P)."""
    found = np.empty((len(joints), len(spheres.pairs)), np.bool_)
    placed = memory(chain, spheres)
    for n in range(len(joints)):
        place(chain, spheres, joints[n], placed)
        for pair in range(len(spheres.pairs)):
            least, _, _ = nearest_spheres(spheres, placed, pair, 0.0, 0.0)
            found[n, pair] = least < 0.0
    return found
