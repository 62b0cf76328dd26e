"""Scenes of named families, harder than those of the training distribution and never part of it.

Each family is a builder: it lays obstacles about a witness, and the same checks as everywhere decide whether the
witness keeps clear of them. Where links count, too, the rows that are left are filled with obstacles close to the arm.
How hard a scene is, is measured (see :mod:`viapoint.training.planners.difficulty`), not built.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.planar_arm import CANDIDATES, CHOICES, WholeArmObstacles
from viapoint.envs.scenes.planar_draws import PHASES, FeasiblePath, Uniforms, between, left, turned, unit
from viapoint.envs.scenes.planar_hand import in_the_way, on_path

ROWS = 5
"""Obstacles of a scene at most."""
ATTEMPTS = 2000
NUMBERS = 14
"""Uniform numbers that a builder may take."""
BAR_RADIUS = (0.007, 0.011)
"""[m]"""


@dataclass(frozen=True, kw_only=True)
class Site:
    """Where a builder builds."""

    witness: FeasiblePath
    room: float
    """Radius of what must pass: of the hand, or of the last link, [m]."""
    elbow: Float
    """Where the last link begins along the witness, shape (N, PHASES, D), [m]."""
    whole_arm: bool


Builder = Callable[[Uniforms, Site], Float]
"""Obstacles for each witness, shape (N, n, 2 D + 1) with n of 5 at most, [m]; absent rows are zero."""


def gate(uniforms: Uniforms, site: Site) -> Float:
    """Two walls in one line, and between them a gap that the hand must pass."""
    place, tangent = _on_path(site, 0.2 + 0.6 * uniforms.take(1))
    along = turned(left(tangent), _centred(uniforms, 0.4))
    radius = between(BAR_RADIUS, uniforms.take(1)[:, 0])
    gap = site.room + between((0.009, 0.022), uniforms.take(1)[:, 0])
    halves = between((0.14, 0.28), uniforms.take(2))
    return _rows(
        _bar(place + along * (gap + radius + half)[:, None] * side, along, half, radius)
        for side, half in ((1.0, halves[:, 0]), (-1.0, halves[:, 1]))
    )


def corridor(uniforms: Uniforms, site: Site) -> Float:
    """A narrow lane between two long bars, with walls beside it."""
    if site.whole_arm:
        return _lane_of_the_forearm(uniforms, site)
    path = site.witness.path
    middle, reach = between((0.4, 0.6), uniforms.take(1)), between((0.1, 0.2), uniforms.take(1))
    first, centre, last = (_at(path, middle + step * reach) for step in (-1.0, 0.0, 1.0))
    along, centre = unit(last - first), 0.25 * (first + last) + 0.5 * centre
    half = 0.5 * np.sqrt(((last - first) ** 2).sum(axis=-1))
    across, radius = left(along), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    away = site.room + between((0.012, 0.03), uniforms.take(1)[:, 0]) + radius
    walls, place = between((0.08, 0.2), uniforms.take(2)), _centred(uniforms, 0.8) * half
    rows = []
    for side, wall in ((1.0, walls[:, 0]), (-1.0, walls[:, 1])):
        rows.append(_bar(centre + side * across * away[:, None], along, half, radius))
        foot = centre + along * place[:, None] + side * across * (away + 2.0 * radius + wall)[:, None]
        rows.append(_bar(foot, across, wall, radius))
    return _rows(rows)


def _lane_of_the_forearm(uniforms: Uniforms, site: Site) -> Float:
    """A lane that ends at goal or start and holds the forearm there: links pass no lane across them."""
    start, goal, _ = site.witness
    at_goal = uniforms.take(1) < 0.5
    end = np.where(at_goal, goal, start)
    along = turned(
        unit(np.where(at_goal, site.elbow[:, -1], site.elbow[:, 0]) - end), _centred(uniforms, 0.25)
    )
    length, radius = between((0.1, 0.18), uniforms.take(1)[:, 0]), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    gaps = site.room + radius[:, None] + between((0.01, 0.045), uniforms.take(2))
    centre = end + along * (0.5 * length - 0.03)[:, None]
    return _rows(
        _bar(centre + side * left(along) * gap[:, None], along, 0.5 * length, radius)
        for side, gap in ((1.0, gaps[:, 0]), (-1.0, gaps[:, 1]))
    )


def ring(uniforms: Uniforms, site: Site) -> Float:
    """Posts around the goal or the start, or bars, with one opening; the bars with a porch beside it."""
    start, goal, path = site.witness
    at_goal = uniforms.take(1) < 0.5
    centre = np.where(at_goal, goal, start)
    distance = between((0.06, 0.085), uniforms.take(1)[:, 0]) + 0.015 * site.whole_arm
    if site.whole_arm:
        towards = np.where(at_goal, site.elbow[:, -1], site.elbow[:, 0])
    else:
        towards = np.where(at_goal, path[:, -PHASES // 4], path[:, PHASES // 4])
    entry = turned(unit(towards - centre), _centred(uniforms, 0.3))
    posts, radius = uniforms.take(1) < 0.4, between(BAR_RADIUS, uniforms.take(1)[:, 0])
    size, porch = (
        between((0.042, 0.050), uniforms.take(1)[:, 0]),
        between((0.03, 0.06), uniforms.take(1)[:, 0]),
    )
    gap = site.room + between((0.004, 0.012), uniforms.take(1)[:, 0]) * (1.0 + 3.0 * site.whole_arm)
    opening = 2.0 * np.arcsin((gap + radius) / (1.2 * distance))
    sides = 3 if site.whole_arm else 4
    step = (2.0 * np.pi - opening) / sides
    bars = [
        _bar(centre + out * distance[:, None], left(out), distance * np.tan(0.5 * step), radius)
        for out in (turned(entry, 0.5 * opening + (k + 0.5) * step) for k in range(sides))
    ]
    if site.whole_arm:
        return _rows(bars)
    away = _side(goal + start - 2.0 * centre, entry)
    corner = centre + turned(entry, 0.5 * opening * away) * (distance / np.cos(0.5 * step))[:, None]
    bars.append(_bar(corner + entry * porch[:, None], entry, porch, radius))
    # The posts stand so close that the hand fits between no other two of them.
    far = between((0.045, 0.055), uniforms.take(1)[:, 0]) + size
    first = np.arcsin(np.minimum((gap + size) / far, 1.0))
    step = (2.0 * np.pi - 2.0 * first) / 4.0
    round_ones = [
        _bar(centre + turned(entry, first + k * step) * far[:, None], entry, 0.0 * size, size)
        for k in range(5)
    ]
    return np.where(posts[..., None], _rows(round_ones), _rows(bars))


def oblique_bar(uniforms: Uniforms, site: Site) -> Float:
    """Long bars at an oblique angle across the way, their ends close to others beyond the only way past."""
    start, goal, _ = site.witness
    place, _ = _on_path(site, between((0.25, 0.75), uniforms.take(1)))
    inside = left(unit(goal - start))
    inside = inside * _side(start - place, goal - start)[:, None]
    slant = np.copysign(between((0.5, 1.05), uniforms.take(1)[:, 0]), _centred(uniforms, 1.0))
    direction = turned(inside, slant)
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


def cul_de_sac(uniforms: Uniforms, site: Site) -> Float:
    """A pocket of bars open towards the start, and walls beside it that leave little room."""
    start, goal, _ = site.witness
    line = goal - start
    along = turned(unit(line), _centred(uniforms, 0.3))
    across, radius = left(along), between(BAR_RADIUS, uniforms.take(1)[:, 0])
    wide, deep = between((0.045, 0.09), uniforms.take(1)[:, 0]), between((0.05, 0.1), uniforms.take(1)[:, 0])
    end = start + line * between((0.5, 0.75), uniforms.take(1))
    splay, beyond = between((0.0, 0.35), uniforms.take(1)[:, 0]), between((0.08, 0.2), uniforms.take(2))
    place, _ = _on_path(site, between((0.35, 0.65), uniforms.take(1)))
    side = np.where(((place - end) * across).sum(axis=-1) < 0.0, -1.0, 1.0)
    rows = [_bar(end, across, wide, radius)]
    for s in (1.0, -1.0):
        out = turned(-along, -s * splay)
        rows.append(_bar(end + across * (s * wide)[:, None] + out * deep[:, None], out, deep, radius))
    gap = site.room + radius + between((0.01, 0.026), uniforms.take(1)[:, 0])
    outside = across * side[:, None]
    if not site.whole_arm:
        rows.append(_bar(place + outside * (gap + beyond[:, 0])[:, None], outside, beyond[:, 0], radius))
    rows.append(
        _bar(end - outside * (wide + 2.0 * radius + beyond[:, 1])[:, None], outside, beyond[:, 1], radius)
    )
    return _rows(rows)


FAMILIES: dict[str, Builder] = {
    "gate": gate,
    "corridor": corridor,
    "ring": ring,
    "oblique bar": oblique_bar,
    "cul-de-sac": cul_de_sac,
}
"""Every family, by name."""


class FamilyObstacles:
    """Obstacles of one family, clear of a witness; a :class:`~viapoint.envs.scenes.planar_hand.ObstacleSampler`."""

    rows, size = ROWS, NUMBERS + 10 * CANDIDATES + CHOICES + 1 + 2 * ROWS

    def __init__(
        self, collision_model: CollisionModel, distribution: SceneDistribution, build: Builder
    ) -> None:
        self._arm, self._whole_arm = collision_model.arm, collision_model.whole_arm
        self._distribution, self._build = distribution, build
        self._close = WholeArmObstacles(self._arm, distribution)

    def __call__(self, uniforms: Uniforms, witness: FeasiblePath) -> tuple[Float, NDArray[np.bool_]]:
        """See :class:`~viapoint.envs.scenes.planar_hand.ObstacleSampler`."""
        arm, shuffled = self._arm, uniforms.take(ROWS).argsort(axis=-1, kind="stable")
        site = Site(
            witness=witness,
            room=arm.link_radii[-1] if self._whole_arm else arm.hand_radius,
            elbow=np.asarray(arm.links(arm.inverse_kinematics(witness.path)))[..., -1, 0, :],
            whole_arm=self._whole_arm,
        )
        rows = np.zeros((len(witness.start), ROWS, 2 * arm.dimension + 1))
        built = self._build(uniforms, site)
        rows[:, : built.shape[1]] = built
        good = self._clear(witness, rows)
        if self._whole_arm and built.shape[1] < ROWS:
            more, enough = self._close.beside(uniforms, witness, built, ROWS - built.shape[1])
            rows[:, built.shape[1] :], good = more, good & enough
        hit = in_the_way(witness, rows, arm.hand_radius) & (rows[..., -1] > 0.0)
        return np.take_along_axis(rows, shuffled[..., None], axis=1), good & hit.any(axis=-1)

    def _clear(self, witness: FeasiblePath, rows: Float) -> NDArray[np.bool_]:
        """Whether witness and ends keep their margins, shape (N,)."""
        d, arm, present = self._distribution, self._arm, rows[..., -1] > 0.0
        ends = np.stack((witness.start, witness.goal), axis=1)
        clear = hand_clearance(witness.path, arm.hand_radius, rows, present) > d.witness_margin
        clear &= hand_clearance(ends, arm.hand_radius, rows, present) > d.end_margin
        if self._whole_arm:
            links = arm.links(arm.inverse_kinematics(witness.path))
            clear &= arm_clearance(links, arm.link_radii, rows, present) > d.link_margin
        return np.asarray(clear.all(axis=-1))


def _on_path(site: Site, fraction: Float) -> tuple[Float, Float]:
    place, tangent = on_path(site.witness.path, fraction)
    return place[:, 0], tangent[:, 0]


def _at(path: Float, fraction: Float) -> Float:
    """Places on paths, shape (N, D)."""
    phase = np.round(fraction[:, 0] * (PHASES - 1)).astype(np.int64)
    return path[np.arange(len(path)), phase]


def _side(vector: Float, direction: Float) -> Float:
    """1 where a vector points to the left of a direction, -1 where to its right, shape (N,)."""
    return np.where((vector * left(direction)).sum(axis=-1) < 0.0, -1.0, 1.0)


def _centred(uniforms: Uniforms, most: float) -> Float:
    """A number between -most and most, shape (N,)."""
    return most * (2.0 * uniforms.take(1)[:, 0] - 1.0)


def _bar(centre: Float, direction: Float, half: Float, radius: Float) -> Float:
    return np.concatenate((centre, direction * half[:, None], radius[:, None]), axis=-1)


def _rows(rows: object) -> Float:
    return np.stack(list(rows), axis=1)  # type: ignore[call-overload]
