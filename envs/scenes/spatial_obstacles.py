"""Obstacles in space that every link must clear: a structure of a family in the way, and others about it."""

from __future__ import annotations

from typing import Any

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import squared_length
from viapoint.envs.common.types import Bool, Float, Index, Int
from viapoint.envs.geometry.rows import has_shapes, row_size, widened
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.draws import (
    IN_THE_WAY,
    FeasiblePath,
    Uniforms,
    present_first,
    shuffle_rows,
    whole_between,
)
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.scene import FARTHEST_CENTRE, LARGEST_HALF_AXIS, LARGEST_HALF_LENGTH
from viapoint.envs.scenes.spatial_families import BUILDER_NUMBERS, SpatialSite, draw_obstacles
from viapoint.envs.scenes.swept_volume import LinkBodies, SweptVolume

STRUCTURES, OTHERS = 4, 14
"""Structures and other obstacles that are drawn at once."""
GENERAL = 3
"""Numbers for the hardness, the family and the count of obstacles."""
PATH_MARGIN = 0.3
"""Share of the path at either end that nothing is built at."""
GIVE_WAY = 1.3
"""Distance by which a part retreats from the arm, relative to the clearance that it lacks."""
SOME = 1e-6
"""Greatest clearance of interest where only its sign counts, [m]."""


class SpatialObstacles:
    """Sampler of obstacles in space, see :class:`~viapoint.envs.scenes.draws.ObstacleSampler`."""

    path_numbers = 3
    fixed: int | None = 1
    """The family: families that seldom fit would be rarer if each attempt drew another one."""

    def __init__(self, collision_model: CollisionModel, distribution: SpaceDistribution) -> None:
        self._collision_model, self._distribution = collision_model, distribution
        # A name that stands twice among them is one family with twice the probability.
        names, self._number = np.unique(distribution.possible, return_inverse=True)
        self._families = [scene_families(3)[name] for name in names]
        self._above = np.array([family.passes_above for family in self._families], dtype=bool)
        self._rigid = np.array([family.rigid for family in self._families], dtype=np.int64)

    @property
    def _row_size(self) -> int:
        """Number of values of an obstacle."""
        return row_size(3, self._distribution.shapes)

    def _as_rows(self, rows: Float) -> Float:
        """Return obstacles as rows of the distribution's kind."""
        return rows if rows.shape[-1] == self._row_size else widened(rows)

    @property
    def rows(self) -> int:
        """Greatest number of obstacles in a scene."""
        return self._distribution.n_obstacles[1]

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return GENERAL + (BUILDER_NUMBERS + 1) * (STRUCTURES + OTHERS) + self.rows

    def steered(self, uniforms: Uniforms, number: int) -> Bool:
        """Return which paths must pass above the line, as their family stands under the path."""
        if not self.rows:
            return np.zeros(number, dtype=bool)
        return self._above[self._which(uniforms.peek(GENERAL)[:, 1])]

    def __call__(self, uniforms: Uniforms, feasible: FeasiblePath) -> tuple[Float, Bool]:
        """Return obstacles and which scenes are good."""
        number, least_most = len(feasible.start), self._distribution.n_obstacles
        if not self.rows:
            return np.zeros((number, 0, self._row_size)), np.ones(number, dtype=bool)
        general = uniforms.take(GENERAL)
        structures = uniforms.take_table(STRUCTURES, BUILDER_NUMBERS + 1)
        others, order = uniforms.take_table(OTHERS, BUILDER_NUMBERS + 1), uniforms.take(self.rows)
        hardness = general[:, :1] ** self._distribution.hardness_exponent
        swept = SweptVolume.of(self._collision_model, feasible.path)
        built = self._build(self._which(general[:, 1]), structures, hardness, feasible, swept)
        fits = self._free(swept.outer, built)
        self._keep_blocking(fits, feasible, built)
        wanted = whole_between(least_most, general[:, 2])
        chosen = built[np.arange(number), fits.argmax(axis=-1)]
        chosen[wanted == 0.0] = 0.0
        some = np.flatnonzero(fits.any(axis=-1) | (wanted == 0.0))
        # The links near the base are rarely the nearest ones: only chosen structures are compared with them.
        some = some[self._free(swept.inner.take(some), chosen[some, None])[:, 0]]
        good, added = np.zeros(number, dtype=bool), np.zeros((number, self.rows, self._row_size))
        missing = np.maximum(wanted - (chosen[..., -1] > 0.0).sum(axis=-1), 0.0)
        added[some], good[some] = self._add(
            others[some], feasible.take(some), hardness[some], swept.take(some), missing[some]
        )
        both = present_first(np.concatenate((chosen, added), axis=1), self.rows)
        return shuffle_rows(both, order), good

    def _build(
        self, which: Int, u: Float, hardness: Float, feasible: FeasiblePath, swept: SweptVolume
    ) -> Float:
        """Return structures of the families, moved away from the arm, shape (N, STRUCTURES, n, 7)."""
        site = self._site(feasible, u[..., -1], hardness, swept)
        used = np.unique(which)
        most = max(self._families[family].n_obstacles for family in used)
        rows = np.zeros((*u.shape[:2], most, self._row_size))
        retreat = np.zeros((*u.shape[:2], most, 3))
        for family in used:
            some = which == family
            numbers = Uniforms(u[some, :, :BUILDER_NUMBERS])
            built = self._families[family].build(numbers, site.take(some))
            parts = slice(built.rows.shape[2])
            rows[some, :, parts], retreat[some, :, parts] = self._as_rows(built.rows), built.retreat
        enough = self._distribution.link_margin + 0.002
        clearance = swept.outer.every_other().clearance(rows.reshape(len(u), -1, self._row_size), enough)
        lacking = np.maximum((enough - clearance).reshape(rows.shape[:3]), 0.0)
        rigid = np.arange(most) < self._rigid[which][:, None, None]
        together = np.where(rigid, lacking, 0.0).max(axis=-1, keepdims=True)
        lacking = np.where(rigid, together, lacking)
        rows[..., :3] += np.where(rows[..., -1:] > 0.0, GIVE_WAY * lacking[..., None] * retreat, 0.0)
        return rows

    def _add(
        self, u: Float, feasible: FeasiblePath, hardness: Float, swept: SweptVolume, missing: Float
    ) -> tuple[Float, Bool]:
        """Return obstacles in random order, shape (N, rows, 7), and which scenes get as many as are missing."""
        order = np.argsort(-u[..., -1], axis=-1, kind="stable")
        # In most scenes the first candidates are enough.
        chosen, enough = self._add_some(u, order[:, : self.rows], feasible, hardness, swept.outer, missing)
        rest = np.flatnonzero(~enough)
        if len(rest):
            left = feasible.take(rest), hardness[rest], swept.outer.take(rest), missing[rest]
            chosen[rest], enough[rest] = self._add_some(u[rest], order[rest], *left)
        return chosen, enough & self._free(swept.inner, chosen[:, None])[:, 0]

    def _add_some(
        self,
        u: Float,
        order: Index,
        feasible: FeasiblePath,
        hardness: Float,
        near: LinkBodies,
        missing: Float,
    ) -> tuple[Float, Bool]:
        """Return the first candidates that leave room for the links near the hand, in the given order."""
        u = np.take_along_axis(u, order[..., None], axis=1)
        site = self._site(feasible, u[..., -1], hardness)
        rows = self._draw_others(u, site, order % 2 == 0)
        room = self._room(near, rows, np.inf)
        rows = _move_towards(rows, site.place, hardness * np.maximum(room - 0.002, 0.0))
        good = (room > 0.0) & _within_bounds(rows)
        which = np.argsort(~good, axis=-1, kind="stable")[:, : self.rows]
        used = np.arange(which.shape[1]) < missing[:, None]
        chosen = np.where(used[..., None], np.take_along_axis(rows, which[..., None], axis=1), 0.0)
        return chosen, good.sum(axis=-1) >= missing

    def _which(self, u: Float) -> Int:
        """Return the index of the family that a uniform number stands for."""
        last = len(self._number) - 1
        return np.asarray(self._number[np.minimum((u * (last + 1)).astype(np.int64), last)])

    def _site(
        self, feasible: FeasiblePath, u: Float, hardness: Float, swept: SweptVolume | None = None
    ) -> SpatialSite:
        """Return places on the middle part of the paths, at uniform numbers of shape (N, K)."""
        time, place, step = feasible.near(u, PATH_MARGIN)
        step[..., 2] = 0.0
        length = np.sqrt(squared_length(step))[..., None]
        heading = np.where(length > 1e-6, step / np.maximum(length, 1e-6), (1.0, 0.0, 0.0))
        return SpatialSite(
            feasible=feasible,
            room=self._collision_model.arm.hand_radius,
            whole_arm=self._collision_model.whole_arm,
            sizes=self._distribution,
            place=place,
            heading=heading,
            top=place[..., 2] if swept is None else swept.top(time, place),
            hardness=hardness,
        )

    def _draw_others(self, u: Float, site: SpatialSite, near_line: Bool) -> Float:
        """Return spheres, posts and bars near the straight line or near the feasible path, shape (N, n, 7)."""
        away = self._distribution.spread * (2.0 * u[..., 3:6] - 1.0)
        centre = np.where(near_line[..., None], site.on_line(u[..., -1]), site.place) + away
        centre[..., 2] = np.maximum(centre[..., 2], 0.02)
        return self._as_rows(draw_obstacles(self._distribution, centre, u[..., [0, 1, 2, 4, 5, 3]]))

    def _room(self, bodies: LinkBodies, rows: Float, most: float, **limits: Any) -> Float:
        """Return the clearance that each obstacle has to spare, shape (N, n), [m]; it must be greater at the ends."""
        return bodies.clearance(rows, most, self._margins(bodies), **limits)

    def _margins(self, bodies: LinkBodies) -> Float:
        """Return the least clearance at each time, shape (T,), [m]."""
        margin = np.full(bodies.balls.shape[-1], self._distribution.link_margin)
        margin[[0, -1]] = self._distribution.end_margin
        return margin

    def _free(self, bodies: LinkBodies, built: Float) -> Bool:
        """Return which of K structures, shape (N, K, n, 7), leave room for the links and are within bounds."""
        number, several, parts = built.shape[:3]
        free = np.asarray((_within_bounds(built) | (built[..., -1] <= 0.0)).all(axis=-1))
        if several > 1:  # most structures do not fit
            hits = bodies.hits(built.reshape(number, several * parts, self._row_size), self._margins(bodies))
            free &= ~hits.reshape(built.shape[:3]).any(axis=-1)
        some = np.flatnonzero(free.any(axis=-1))
        rows = np.where(free[some, :, None, None], built[some], 0.0)
        rows = rows.reshape(len(some), several * parts, self._row_size)
        free[some] &= self._room(bodies.take(some), rows, SOME, floor=0.0, together=parts) > 0.0
        return free

    def _keep_blocking(self, fits: Bool, feasible: FeasiblePath, built: Float) -> None:
        """Strike out the first structures that the straight movement does not hit, shape (N, STRUCTURES)."""
        rest = np.flatnonzero(fits.any(axis=-1))
        if not len(rest):
            return
        start, goal = feasible.start[rest, None], feasible.goal[rest, None]
        line = start + (goal - start) * np.linspace(0.0, 1.0, feasible.path.shape[1] // 2)[:, None]
        bodies = SweptVolume.of(self._collision_model, line).outer
        while len(rest):
            first = fits[rest].argmax(axis=-1)
            depth = bodies.clearance(
                built[rest, first], -IN_THE_WAY, floor=-IN_THE_WAY, together=built.shape[2]
            )
            missed = depth[:, 0] >= -IN_THE_WAY
            fits[rest[missed], first[missed]] = False
            more = missed & fits[rest].any(axis=-1)
            rest, bodies = rest[more], bodies.take(np.flatnonzero(more))


def _within_bounds(rows: Float) -> Bool:
    """Return which obstacles are no farther away and no longer than scenes allow."""
    x, y, z = (np.abs(rows[..., axis]) < FARTHEST_CENTRE for axis in range(3))
    longest = LARGEST_HALF_LENGTH if has_shapes(rows) else LARGEST_HALF_AXIS
    return np.asarray(x & y & z & (squared_length(rows[..., 3:6]) < longest**2))


def _move_towards(rows: Float, place: Float, distance: Float) -> Float:
    """Return obstacles moved by a distance towards a place, posts along the table.

    A translation by less than the clearance cannot reach the arm.
    """
    towards = place - rows[..., :3]
    standing = (rows[..., 3:5] == 0.0).all(axis=-1) & (rows[..., 5] > 0.0)
    towards[..., 2] = np.where(standing, 0.0, towards[..., 2])
    length = np.sqrt(squared_length(towards))
    share = np.minimum(distance, length) / np.maximum(length, 1e-9)
    return np.concatenate((rows[..., :3] + share[..., None] * towards, rows[..., 3:]), axis=-1)
