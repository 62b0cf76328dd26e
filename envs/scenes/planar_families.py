"""Families of hard scenes in the plane, which are never part of the training distribution.

Each function lays obstacles beside a feasible path; scenes in which they leave no room for it are rejected later (see
:class:`~viapoint.envs.scenes.planar_obstacles.FamilyObstacles`). The difficulty of a scene is measured afterwards (see
`benchmarks/scene_sets/difficulty.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.draws import Site, Uniforms, between, left, rotate, unit

PATH_MARGIN = 0.15
"""Share of the path at either end that obstacles are not built beside."""
FAMILY_ROWS = 5
"""Greatest number of obstacles in a scene of a family."""
BAR_RADIUS = (0.007, 0.011)
"""[m]"""


@dataclass(frozen=True, kw_only=True)
class PlanarSite(Site):
    """Feasible paths of N scenes in the plane."""

    elbow: Float
    """Start of the last link along the path, shape (N, T, D), [m]."""


Builder = Callable[[Uniforms, PlanarSite], Float]
"""Obstacles for each path, shape (N, n, 5), [m]; absent rows are zero."""


def gate(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return two walls in one line with a gap between them that the hand must pass."""
    place, tangent = _on_path(site, 0.2 + 0.6 * uniforms.take(1))
    along = rotate(left(tangent), _centred(uniforms, 0.4))
    radius = between(BAR_RADIUS, uniforms.take(1)[:, 0])
    gap = site.room + between((0.009, 0.022), uniforms.take(1)[:, 0])
    halves = between((0.14, 0.28), uniforms.take(2))
    return _rows(
        _bar(place + along * (gap + radius + half)[:, None] * side, along, half, radius)
        for side, half in ((1.0, halves[:, 0]), (-1.0, halves[:, 1]))
    )


def corridor(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return a narrow lane between two long bars, with walls beside it."""
    if site.whole_arm:
        return _forearm_lane(uniforms, site)
    middle, reach = between((0.4, 0.6), uniforms.take(1)), between((0.1, 0.2), uniforms.take(1))
    first, centre, last = (_at(site.path, middle + step * reach) for step in (-1.0, 0.0, 1.0))
    along, centre = unit(last - first), 0.25 * (first + last) + 0.5 * centre
    half = 0.5 * norm(last - first)
    across, radius = left(along), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    away = site.room + between((0.012, 0.03), uniforms.take(1)[:, 0]) + radius
    walls, place = between((0.08, 0.2), uniforms.take(2)), _centred(uniforms, 0.8) * half
    rows = []
    for side, wall in ((1.0, walls[:, 0]), (-1.0, walls[:, 1])):
        rows.append(_bar(centre + side * across * away[:, None], along, half, radius))
        foot = centre + along * place[:, None] + side * across * (away + 2.0 * radius + wall)[:, None]
        rows.append(_bar(foot, across, wall, radius))
    return _rows(rows)


def _forearm_lane(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return a lane for the forearm that ends at goal or start: links cannot pass a lane across them."""
    start, goal = site.start, site.goal
    at_goal = uniforms.take(1) < 0.5
    end = np.where(at_goal, goal, start)
    along = rotate(
        unit(np.where(at_goal, site.elbow[:, -1], site.elbow[:, 0]) - end), _centred(uniforms, 0.25)
    )
    length, radius = between((0.1, 0.18), uniforms.take(1)[:, 0]), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    gaps = site.room + radius[:, None] + between((0.01, 0.045), uniforms.take(2))
    centre = end + along * (0.5 * length - 0.03)[:, None]
    return _rows(
        _bar(centre + side * left(along) * gap[:, None], along, 0.5 * length, radius)
        for side, gap in ((1.0, gaps[:, 0]), (-1.0, gaps[:, 1]))
    )


def ring(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return posts or bars around the goal or the start with one opening; bars have a porch beside it."""
    start, goal, path = site.feasible
    at_goal = uniforms.take(1) < 0.5
    centre = np.where(at_goal, goal, start)
    distance = between((0.06, 0.085), uniforms.take(1)[:, 0]) + 0.015 * site.whole_arm
    if site.whole_arm:
        towards = np.where(at_goal, site.elbow[:, -1], site.elbow[:, 0])
    else:
        towards = np.where(at_goal, path[:, -(path.shape[1] // 4)], path[:, path.shape[1] // 4])
    entry = rotate(unit(towards - centre), _centred(uniforms, 0.3))
    is_post, radius = uniforms.take(1) < 0.4, between(BAR_RADIUS, uniforms.take(1)[:, 0])
    size = between((0.042, 0.050), uniforms.take(1)[:, 0])
    porch = between((0.03, 0.06), uniforms.take(1)[:, 0])
    gap = site.room + between((0.004, 0.012), uniforms.take(1)[:, 0]) * (1.0 + 3.0 * site.whole_arm)
    opening = 2.0 * np.arcsin((gap + radius) / (1.2 * distance))
    sides = 3 if site.whole_arm else 4
    step = (2.0 * np.pi - opening) / sides
    bars = [
        _bar(centre + out * distance[:, None], left(out), distance * np.tan(0.5 * step), radius)
        for out in (rotate(entry, 0.5 * opening + (k + 0.5) * step) for k in range(sides))
    ]
    if site.whole_arm:
        return _rows(bars)
    away = _side(goal + start - 2.0 * centre, entry)
    corner = centre + rotate(entry, 0.5 * opening * away) * (distance / np.cos(0.5 * step))[:, None]
    bars.append(_bar(corner + entry * porch[:, None], entry, porch, radius))
    # The posts stand so close that the hand fits between no other two of them.
    far = between((0.045, 0.055), uniforms.take(1)[:, 0]) + size
    first = np.arcsin(np.minimum((gap + size) / far, 1.0))
    step = (2.0 * np.pi - 2.0 * first) / 4.0
    posts_around = [
        _bar(centre + rotate(entry, first + k * step) * far[:, None], entry, 0.0 * size, size)
        for k in range(5)
    ]
    return np.where(is_post[..., None], _rows(posts_around), _rows(bars))


def oblique_bar(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return long bars at an oblique angle across the path; they overlap but for the gap that the path takes."""
    start, goal = site.start, site.goal
    place, _ = _on_path(site, between((0.25, 0.75), uniforms.take(1)))
    inside = left(unit(goal - start))
    inside = inside * _side(start - place, goal - start)[:, None]
    slant = np.copysign(between((0.5, 1.05), uniforms.take(1)[:, 0]), _centred(uniforms, 1.0))
    direction = rotate(inside, slant)
    radius, halves = between(BAR_RADIUS, uniforms.take(1)[:, 0]), between((0.13, 0.25), uniforms.take(3))
    gaps = site.room + radius[:, None] + between((0.009, 0.024), uniforms.take(2))
    near = place + inside * gaps[:, :1] + direction * halves[:, :1]
    beyond = place - inside * gaps[:, 1:] - direction * halves[:, 1:2]
    shift = np.copysign(between((0.07, 0.12), uniforms.take(1)), uniforms.take(1) - 0.5)
    third = place + inside * gaps[:, :1] + direction * halves[:, 2:] + left(direction) * shift
    rows = [
        _bar(centre, direction, half, radius)
        for centre, half in zip((near, beyond, third), halves.T, strict=True)
    ]
    return _rows(rows[::2] if site.whole_arm else rows)


def cul_de_sac(uniforms: Uniforms, site: PlanarSite) -> Float:
    """Return a pocket of bars open towards the start, and walls beside it that leave little room."""
    start, goal = site.start, site.goal
    line = goal - start
    along = rotate(unit(line), _centred(uniforms, 0.3))
    across, radius = left(along), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    wide, deep = between((0.045, 0.09), uniforms.take(1)[:, 0]), between((0.05, 0.1), uniforms.take(1)[:, 0])
    end = start + line * between((0.5, 0.75), uniforms.take(1))
    splay, beyond = between((0.0, 0.35), uniforms.take(1)[:, 0]), between((0.08, 0.2), uniforms.take(2))
    place, _ = _on_path(site, between((0.35, 0.65), uniforms.take(1)))
    side = np.where(((place - end) * across).sum(axis=-1) < 0.0, -1.0, 1.0)
    rows = [_bar(end, across, wide, radius)]
    for s in (1.0, -1.0):
        out = rotate(-along, -s * splay)
        rows.append(_bar(end + across * (s * wide)[:, None] + out * deep[:, None], out, deep, radius))
    gap = site.room + radius + between((0.01, 0.026), uniforms.take(1)[:, 0])
    outside = across * side[:, None]
    if not site.whole_arm:
        rows.append(_bar(place + outside * (gap + beyond[:, 0])[:, None], outside, beyond[:, 0], radius))
    rows.append(
        _bar(end - outside * (wide + 2.0 * radius + beyond[:, 1])[:, None], outside, beyond[:, 1], radius)
    )
    return _rows(rows)


def _on_path(site: PlanarSite, fraction: Float) -> tuple[Float, Float]:
    """Return points on the middle part of the paths [m] and the directions there, shape (N, D) each."""
    _, place, step = site.feasible.near(fraction, PATH_MARGIN)
    return place[:, 0], unit(step)[:, 0]


def _at(path: Float, fraction: Float) -> Float:
    """Return points on paths, shape (N, D), [m]."""
    time = np.round(fraction[:, 0] * (path.shape[1] - 1)).astype(np.int64)
    return np.asarray(path[np.arange(len(path)), time])


def _side(vector: Float, direction: Float) -> Float:
    """Return 1 where a vector points to the left of a direction, -1 where to its right, shape (N,)."""
    return np.where((vector * left(direction)).sum(axis=-1) < 0.0, -1.0, 1.0)


def _centred(uniforms: Uniforms, most: float) -> Float:
    """Return a uniform number between -most and most, shape (N,)."""
    return most * (2.0 * uniforms.take(1)[:, 0] - 1.0)


def _bar(centre: Float, direction: Float, half: Float, radius: Float) -> Float:
    """Return one obstacle of each scene, shape (N, 5)."""
    return np.concatenate((centre, direction * half[:, None], radius[:, None]), axis=-1)


def _rows(rows: Iterable[Float]) -> Float:
    """Return obstacles of shape (N, 5) together, shape (N, n, 5)."""
    return np.stack(list(rows), axis=1)


PLANAR_BUILDERS: dict[str, Builder] = {
    "gate": gate,
    "corridor": corridor,
    "ring": ring,
    "oblique bar": oblique_bar,
    "cul-de-sac": cul_de_sac,
}
"""Built-in families, by name."""
