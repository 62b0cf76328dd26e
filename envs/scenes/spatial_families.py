"""Families of scenes in space: spheres, posts, bars and boxes, and structures of these.

A family is built at K candidate places of N scenes at once. Each part has a direction of retreat: the sampler moves a
part that is too close to the arm on the feasible path along it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.draws import Site, Uniforms, between, box_rows, left, rotate, unit

BUILDER_NUMBERS = 6
"""Uniform numbers that make one structure or one obstacle."""
THICKNESS = 0.008
"""Half thickness of panels and bars, [m]."""
TABLE = (0.12, 0.25)
"""Half lengths of the sides of tables, [m]."""
THING_WIDTH, THING_HEIGHT = (0.015, 0.04), (0.02, 0.07)
"""Half widths and half heights of things on a table, [m]."""
DESK, STICK_OUT = (0.06, 0.12), 0.04
"""Half depth of desks away from the hand, and the most by which things under them stick out, [m]."""
UNDER, APART = (0.5, 1.0), (0.35, 0.8)
"""Height of things under a desk, relative to the room there; distance of things from its middle, in half widths."""
BIN, RIM = (0.13, 0.20), (0.02, 0.10)
"""Half width of bins and cages inside, and height of the rims of bins above the hand, [m]; a gripper fits in."""
DEEP = (0.10, 0.18)
"""Height of the rails of cages above the hand in them, [m]."""
GAP = (0.07, 0.16)
"""Distance from the middle of a gap in a wall to each side, [m]; the gripper is 0.21 m wide."""
PANEL = (0.10, 0.20)
"""Half length of walls on either side of a gap, and of the top boards of cupboards, [m]."""
DEPTH = (0.04, 0.10)
"""Half depth of cupboards along the path, [m]; paths rise and fall, so few are above a deep board everywhere."""
ABOVE = (0.02, 0.15)
"""Height of walls and cupboards above the hand, [m]."""
DOWN = (0.0, 0.0, -1.0)


@dataclass(frozen=True, kw_only=True)
class SpatialSizes:
    """Sizes of obstacles in space."""

    sphere_radius: tuple[float, float] = (0.02, 0.05)
    """[m]"""
    post_radius: tuple[float, float] = (0.012, 0.03)
    """[m]"""
    pillar_radius: tuple[float, float] = (0.025, 0.05)
    """[m]"""
    bar_radius: tuple[float, float] = (0.008, 0.015)
    """[m]"""
    bar_half_length: tuple[float, float] = (0.06, 0.18)
    """[m]"""
    board_half_length: tuple[float, float] = (0.10, 0.25)
    """Half length of a shelf's bars, [m]."""
    board_spacing: float = 0.04
    """Distance between a shelf's bars, [m]: no part of the arm fits in between."""
    beam_half_length: tuple[float, float] = (0.08, 0.15)
    """[m]"""
    beam_overlap: float = 0.08
    """Length by which a beam reaches from above the hand towards the arm's base, [m]."""
    gate_half_width: tuple[float, float] = (0.06, 0.14)
    """Distance between the middle of a gate and each post before it retreats, [m]; the gripper is 0.21 m wide."""
    tunnel_length: float = 0.1
    """Distance between the gates of a tunnel, [m]."""
    link_margin: float = 0.006
    """Least clearance of the arm on the feasible path, at the times at which it is computed, [m]."""


@dataclass(frozen=True, kw_only=True)
class SpatialSite(Site):
    """Places on the feasible paths of N scenes, K of each scene."""

    sizes: SpatialSizes
    place: Float
    """Places on the paths, shape (N, K, 3), [m]."""
    heading: Float
    """Horizontal direction of the path there, unit vectors, shape (N, K, 3)."""
    top: Float
    """Height of the links above the hand there, shape (N, K), [m]."""
    hardness: Float
    """Hardness from 0 to 1, shape (N, 1)."""

    def on_line(self, fraction: Float) -> Float:
        """Return points on the straight line, shape (N, K, 3), [m]."""
        start, goal = self.start[:, None], self.goal[:, None]
        return np.asarray(start + (goal - start) * fraction[..., None])

    def take(self, rows: Any) -> SpatialSite:
        """Return the scenes at `rows`, an index, slice or mask."""
        parts = {name: getattr(self, name)[rows] for name in ("place", "heading", "top", "hardness")}
        feasible = self.feasible.take(rows)
        return SpatialSite(
            feasible=feasible, room=self.room, whole_arm=self.whole_arm, sizes=self.sizes, **parts
        )


class Structures(NamedTuple):
    """Structures at K places of N scenes."""

    rows: Float
    """Rows of either kind, shape (N, K, n, .), [m], see :mod:`viapoint.envs.geometry.rows`."""
    retreat: Float
    """Unit vectors along which parts retreat from the arm, shape (N, K, n, 3)."""


class _Box(NamedTuple):
    """Upright boxes at K places of N scenes."""

    centre: Float
    """Shape (N, K, 3), [m]."""
    heading: Float
    """Horizontal vectors along their first axes, shape (N, K, 3)."""
    half: tuple[Float | float, ...]
    """Half lengths along the heading, to its left and upwards, shape (N, K) each, [m]."""


Builder = Callable[[Uniforms, SpatialSite], Structures]


def clutter(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a sphere, a post or a bar near the straight line."""
    u = uniforms.take(BUILDER_NUMBERS)
    rows = draw_obstacles(site.sizes, site.on_line(0.25 + 0.5 * u[..., 0]) + 0.06 * (u[..., 3:6] - 0.5), u)
    return from_path(rows[:, :, None], site)


def pillar(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a thick post on the table."""
    u = uniforms.take(BUILDER_NUMBERS)
    foot = site.on_line(0.3 + 0.4 * u[..., 0])
    side = 0.06 * (u[..., 2] - 0.5)
    top = foot[..., 2] + 0.15 * u[..., 3]
    rows = _post(
        foot + left(site.heading) * side[..., None], top, between(site.sizes.pillar_radius, u[..., 1])
    )
    return from_path(rows[:, :, None], site)


def shelf(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a board of three bars side by side under the path, roughly across it."""
    return _together(_board(uniforms.take(BUILDER_NUMBERS), site))


def gate(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return two posts, on either side of the path, and a sill under it."""
    return _together(_posts_and_sill(uniforms.take(BUILDER_NUMBERS), site))


def slot(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a shelf with a beam over the arm."""
    u = uniforms.take(BUILDER_NUMBERS)
    return _together(_board(u, site), _beam(u, site))


def window(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a gate with a beam over the arm."""
    u = uniforms.take(BUILDER_NUMBERS)
    return _together(_posts_and_sill(u, site), _beam(u, site))


def tunnel(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return two windows, one behind the other, with one sill and one beam."""
    u = uniforms.take(BUILDER_NUMBERS)
    front = _posts_and_sill(u, site)
    rows, retreat = (part[:, :, :2].copy() for part in front)
    rows[..., :3] += site.sizes.tunnel_length * site.heading[:, :, None]
    return _together(front, _beam(u, site), Structures(rows, retreat))


def table(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a table under the path with three boxes on it, of which one is right under the hand."""
    u = uniforms.take(BUILDER_NUMBERS)
    heading = rotate(site.heading, 2.0 * np.pi * u[..., 1])
    size = between(TABLE, np.stack((u[..., 2], u[..., 3]), axis=-1))
    first = between(THING_HEIGHT, u[..., 5])
    surface = site.place[..., 2] - _depth(u, site) - 2.0 * first
    middle = site.place + 0.1 * (u[..., 4:5] - 0.5) * left(heading)
    parts = [_Box(_at_height(middle, surface - THICKNESS), heading, (size[..., 0], size[..., 1], THICKNESS))]
    for thing in range(3):
        v = _more(u, thing)
        far = 0.8 * size * (2.0 * v[..., :2] - 1.0)
        away = far[..., :1] * heading + far[..., 1:] * left(heading)
        place, half = (middle + away, between(THING_HEIGHT, v[..., 2])) if thing else (site.place, first)
        wide = between(THING_WIDTH, v[..., 3:5])
        parts.append(_Box(_at_height(place, surface + half), heading, (wide[..., 0], wide[..., 1], half)))
    return _structures(parts, [DOWN] * 4)


def desk(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a table beside start or goal, higher than the hand, with two boxes on it and two that stick out under it.

    The table stands between start and goal; the movement passes above it.
    """
    u = uniforms.take(BUILDER_NUMBERS)
    end, line = _end(u, site), (site.goal - site.start)[:, None]
    towards = np.where(u[..., 5:] < 0.5, line, -line)
    towards[..., 2] = 0.0
    out = rotate(unit(towards), 0.8 * (u[..., 0] - 0.5))
    surface, gap = end[..., 2] + between(ABOVE, u[..., 1]), between(BIN, u[..., 2])
    deep, wide = between(DESK, u[..., 3]), between(TABLE, u[..., 4])
    middle = end + (gap + deep)[..., None] * out
    parts = [_Box(_at_height(middle, surface - THICKNESS), out, (deep, wide, THICKNESS))]
    for thing in range(4):
        v = _more(u, thing)
        size = between(THING_WIDTH, v[..., 3:5])
        along = ((-1) ** thing * wide * between(APART, v[..., 1]))[..., None] * left(out)
        if thing < 2:
            half = between(THING_HEIGHT, v[..., 2])
            place = middle + (0.8 * deep * (2.0 * v[..., 0] - 1.0))[..., None] * out + along
            parts.append(_Box(_at_height(place, surface + half), out, (size[..., 0], size[..., 1], half)))
        else:
            half = 0.5 * between(UNDER, v[..., 2]) * (surface - 2.0 * THICKNESS)
            place = end + (gap - STICK_OUT * v[..., 0] + size[..., 0])[..., None] * out + along
            parts.append(_Box(_at_height(place, half), out, (size[..., 0], size[..., 1], half)))
    return _structures(parts, [out] * 5)


def bin_(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return an open box around start or goal: a floor and four walls, which retreat downwards."""
    u = uniforms.take(BUILDER_NUMBERS)
    end, heading = _end(u, site), rotate(site.heading, 0.5 * np.pi * u[..., 1])
    low, rim = end[..., 2] - _depth(u, site), end[..., 2] + between(RIM, u[..., 2])
    size = between(BIN, u[..., 3:5])
    parts = [_Box(_at_height(end, low - THICKNESS), heading, (size[..., 0], size[..., 1], THICKNESS))]
    for sign in (-1.0, 1.0):
        for axis, wide, along in ((heading, 0, 1), (left(heading), 1, 0)):
            wall = end + sign * (size[..., wide, None] + THICKNESS) * axis
            half = (THICKNESS, size[..., along] + THICKNESS * (1.0 + along), 0.5 * (rim - low))
            parts.append(_Box(_at_height(wall, 0.5 * (rim + low)), axis, half))
    return _structures(parts, [DOWN] * 5)


def notch(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a wall across the path with a gap that is open above: two panels and a sill."""
    return _wall(uniforms.take(BUILDER_NUMBERS), site)


def wall_window(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a wall across the path with a window: two panels, a sill, and a lintel over the arm."""
    u = uniforms.take(BUILDER_NUMBERS)
    out, half = _outwards(site), between(PANEL, u[..., 5])
    middle = site.place + (half - 0.08)[..., None] * out
    top = site.top + site.sizes.link_margin + THICKNESS
    lintel = _Box(_at_height(middle, top), out, (half, THICKNESS, THICKNESS))
    return _together(_wall(u, site), _structures([lintel], [(0.0, 0.0, 1.0)]))


def cupboard(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a board under the path, and beside the path a side of a cupboard with the board on its top."""
    u = uniforms.take(BUILDER_NUMBERS)
    side = _outwards(site)
    gap, deep = between(GAP, u[..., 2] * (1.0 - site.hardness)), between(PANEL, u[..., 3])
    low, top = site.place[..., 2] - _depth(u, site), site.place[..., 2] + 0.5 * between(ABOVE, u[..., 4])
    long, panel = between(DEPTH, u[..., 5]), site.place + (gap + THICKNESS)[..., None] * side
    parts = [
        _Box(_at_height(panel, 0.5 * (low + top)), side, (THICKNESS, long, 0.5 * (top - low))),
        _Box(_at_height(panel + deep[..., None] * side, top + THICKNESS), side, (deep, long, THICKNESS)),
        _Box(_at_height(site.place, low - THICKNESS), side, (gap + THICKNESS, long, THICKNESS)),
    ]
    return _structures(parts, [side, side, DOWN])


def cage(uniforms: Uniforms, site: SpatialSite) -> Structures:
    """Return a cage of bars around start or goal, open above: four posts and four rails, which retreat downwards."""
    u = uniforms.take(BUILDER_NUMBERS)
    end, heading = _end(u, site), rotate(site.heading, 0.5 * np.pi * u[..., 1])
    rim, size = end[..., 2] + between(DEEP, u[..., 2]), between(BIN, u[..., 3:5])
    parts, sides = [], (heading, left(heading))
    for first in (-1.0, 1.0):
        for second in (-1.0, 1.0):
            corner = end + first * size[..., :1] * sides[0] + second * size[..., 1:] * sides[1]
            parts.append(_Box(_at_height(corner, 0.5 * rim), heading, (THICKNESS, THICKNESS, 0.5 * rim)))
        for axis, wide, along in ((sides[0], 0, 1), (sides[1], 1, 0)):
            rail = _at_height(end + first * size[..., wide, None] * axis, rim + THICKNESS)
            parts.append(_Box(rail, axis, (THICKNESS, size[..., along], THICKNESS)))
    return _structures(parts, [DOWN] * 8)


def from_path(rows: Float, site: SpatialSite) -> Structures:
    """Return obstacles, shape (N, K, n, 7), whose upper ends retreat from the place on the path."""
    away = rows[..., :3] + rows[..., 3:6] - site.place[:, :, None]
    return Structures(rows, away / np.maximum(norm(away)[..., None], 1e-6))


def draw_obstacles(sizes: SpatialSizes, centre: Float, u: Float) -> Float:
    """Return a sphere, a post or a bar at each centre.

    Args:
        sizes: Of the obstacles.
        centre: Shape (N, K, 3), [m].
        u: Uniform numbers, shape (N, K, 6).

    Returns:
        Shape (N, K, 7), [m].
    """
    # The kind is a hash of the first number, which also places the obstacle along the line.
    kind, size, turn, tilt = u[..., 0] * 97.0 % 1.0, u[..., 1], 2.0 * np.pi * u[..., 2], u[..., 3] - 0.5
    half = between(sizes.bar_half_length, u[..., 4])
    level = np.stack((np.cos(turn), np.sin(turn), 2.0 * tilt), axis=-1)
    axis = half[..., None] * level / norm(level)[..., None]
    bar = _row(centre, axis, between(sizes.bar_radius, size))
    sphere = _row(centre, np.zeros_like(centre), between(sizes.sphere_radius, size))
    post = _post(centre, centre[..., 2] + 0.1 * u[..., 5], between(sizes.post_radius, size))
    return np.where((kind < 0.35)[..., None], sphere, np.where((kind < 0.65)[..., None], post, bar))


def _board(u: Float, site: SpatialSite) -> Structures:
    """Return three bars side by side under the path, roughly across it; they retreat downwards."""
    radius = between(site.sizes.bar_radius, u[..., 1])
    half = between(site.sizes.board_half_length, u[..., 2])
    across = rotate(left(site.heading), 1.2 * (0.5 - u[..., 3]))
    middle = site.place + 0.04 * (u[..., 4:5] - 0.5) * site.heading
    middle = _at_height(middle, middle[..., 2] - _depth(u, site) - radius)
    bars = [
        _row(middle - side * site.sizes.board_spacing * left(across), half[..., None] * across, radius)
        for side in (-1.0, 0.0, 1.0)
    ]
    rows = np.stack(bars, axis=-2)
    return Structures(rows, np.broadcast_to((0.0, 0.0, -1.0), rows[..., :3].shape))


def _posts_and_sill(u: Float, site: SpatialSite) -> Structures:
    """Return two posts, which retreat sideways, and a sill under the path, which retreats downwards."""
    d, across = site.sizes, left(site.heading)
    radius, sill = between(d.post_radius, u[..., 1]), between(d.bar_radius, u[..., 2])
    width = between(d.gate_half_width, u[..., 3] * (1.0 - site.hardness))
    middle = site.place + (0.04 * (u[..., 4] - 0.5))[..., None] * across
    top = site.place[..., 2] + 0.12 * u[..., 5]
    posts = [_post(middle + (side * width)[..., None] * across, top, radius) for side in (-1.0, 1.0)]
    low = _at_height(middle, site.place[..., 2] - _depth(u, site) - sill)
    rows = np.stack((*posts, _row(low, width[..., None] * across, sill)), axis=-2)
    down = np.broadcast_to((0.0, 0.0, -1.0), across.shape)
    return Structures(rows, np.stack((-across, across, down), axis=-2))


def _beam(u: Float, site: SpatialSite) -> Structures:
    """Return a bar over the links above the hand, across the path, from near the arm's base outwards."""
    d = site.sizes
    radius, half = between(d.bar_radius, u[..., 5]), between(d.beam_half_length, u[..., 2])
    out = _outwards(site)
    middle = site.place + (half - d.beam_overlap)[..., None] * out
    row = _row(_at_height(middle, site.top + d.link_margin + radius), half[..., None] * out, radius)
    return Structures(row[:, :, None], np.broadcast_to((0.0, 0.0, 1.0), (*row.shape[:2], 1, 3)))


def _outwards(site: SpatialSite) -> Float:
    """Return horizontal unit vectors across the path, away from the arm's base, shape (N, K, 3)."""
    out = left(site.heading)
    return np.where((out * site.place).sum(axis=-1, keepdims=True) < 0.0, -out, out)


def _depth(u: Float, site: SpatialSite) -> Float:
    """Return the depth of a board's or sill's upper side below the hand, shape (N, K), [m]."""
    return np.asarray(site.room + site.sizes.link_margin + 0.005 + 0.06 * u[..., 0] * (1.0 - site.hardness))


def _together(*parts: Structures) -> Structures:
    """Return several parts as one structure."""
    return Structures(*(np.concatenate(part, axis=2) for part in zip(*parts, strict=True)))


def _at_height(place: Float, height: Float) -> Float:
    """Return places moved to heights, [m]."""
    return np.concatenate((place[..., :2], height[..., None]), axis=-1)


def _post(centre: Float, top: Float, radius: Float) -> Float:
    """Return posts that stand on the table."""
    top = np.maximum(top, radius + 0.02)
    middle = _at_height(centre, 0.5 * (top + radius))
    return _row(middle, _at_height(np.zeros_like(centre), 0.5 * (top - radius)), radius)


def _row(centre: Float, axis: Float, radius: Float) -> Float:
    """Return obstacles, shape (..., 7)."""
    return np.concatenate((centre, axis, radius[..., None]), axis=-1)


def _more(u: Float, which: int) -> Float:
    """Return further numbers in [0, 1), which are hashes of uniform numbers: five for each `which`."""
    return np.asarray((u[..., 1:] * (97.0 + 14.0 * which) + u[..., :1] * (31.0 + 6.0 * which)) % 1.0)


def _wall(u: Float, site: SpatialSite) -> Structures:
    """Return two panels beside a gap, which retreat sideways, and a sill, which retreats downwards."""
    across = left(site.heading)
    width = between(GAP, u[..., 3] * (1.0 - site.hardness))
    middle = site.place + (0.04 * (u[..., 4] - 0.5))[..., None] * across
    top, sill = site.place[..., 2] + between(ABOVE, u[..., 5]), site.place[..., 2] - _depth(u, site)
    parts = []
    for sign, number in ((-1.0, u[..., 1]), (1.0, u[..., 2])):
        half = between(PANEL, number)
        panel = middle + (sign * (width + half))[..., None] * across
        parts.append(_Box(_at_height(panel, 0.5 * top), across, (half, THICKNESS, 0.5 * top)))
    parts.append(_Box(_at_height(middle, 0.5 * sill), across, (width, THICKNESS, 0.5 * sill)))
    return _structures(parts, [-across, across, DOWN])


def _end(u: Float, site: SpatialSite) -> Float:
    """Return start or goal of each scene at each place, shape (N, K, 3), [m]."""
    start, goal = (np.broadcast_to(end[:, None], site.place.shape) for end in (site.start, site.goal))
    return np.where(u[..., 5:] < 0.5, start, goal)


def _structures(parts: list[_Box], retreats: list[Float | tuple[float, ...]]) -> Structures:
    """Return upright boxes, with half lengths of at least 5 mm, and the directions of their retreat."""
    shape = (*parts[0].centre.shape[:2], len(parts))
    centre, heading, half = np.empty((*shape, 3)), np.empty((*shape, 3)), np.empty((*shape, 3))
    retreat = np.empty((*shape, 3))
    for i, part in enumerate(parts):
        centre[:, :, i], heading[:, :, i], retreat[:, :, i] = part.centre, part.heading, retreats[i]
        for axis in range(3):
            half[:, :, i, axis] = part.half[axis]
    return Structures(box_rows(centre, heading, np.maximum(half, 0.005)), retreat)
