"""Drawing scenes in space in which the straight movement hits something and another one does not.

As in the plane, a movement through a via-point is drawn first, the witness; then a family is built in the way of the
straight movement and clear of the witness, with every link; then further obstacles are put about it. A scene is a
function of a row of uniform numbers, so each environment draws from its own generator and all are computed together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import squared_length
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.scenes.config import BOARDS, FAMILIES, SpaceDistribution
from viapoint.envs.scenes.scene import LARGEST_HALF_AXIS, Scenes
from viapoint.envs.scenes.spatial_draws import ENDS, GROUPS, PHASES, WITNESSES, Numbers, draw_ends, draw_path
from viapoint.envs.scenes.spatial_structures import NUMBERS, PARTS, Course, single, structure
from viapoint.envs.scenes.swept_volume import Bodies, Swept

STRUCTURES, OTHERS = 4, 14
"""How many structures and other obstacles are drawn at once."""
TOGETHER = 640
"""Attempts that are looked at together: only the first good one of a scene counts, so not all at once."""
FAITHFUL = sum(GROUPS[:8])
"""How many attempts keep to the family that was drawn first, so that those that seldom fit are not rarer."""
FAMILY = 6 * ENDS + 3 * WITNESSES + 1
"""Which of the uniform numbers of an attempt stands for the family."""
GIVE_WAY = 1.3
"""How far what is in the witness's way moves, relative to what it lacks in clearance."""
SOME = 1e-6
"""Room that is asked whether there is any, not how much, [m]."""
IN_THE_WAY = 0.004
"""How deep the straight movement cuts into what is in its way, [m]."""


class SpaceSampler:
    """Draws scenes for an arm that moves in space, each from a generator of its own."""

    def __init__(self, collision_model: CollisionModel, distribution: SpaceDistribution) -> None:
        self.collision_model, self.arm, self.distribution = collision_model, collision_model.arm, distribution
        self._rows = distribution.n_obstacles[1]
        self._families = np.array(distribution.possible)

    def __call__(
        self, generators: Sequence[np.random.Generator], ends: tuple[Float, Float] | None = None
    ) -> Scenes:
        """One scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, 3) each, NaN where they are to be drawn, [m].

        Raises:
            RuntimeError: No scene was found in many attempts, as with given ends in a corner of the reach.
        """
        number = len(generators)
        scenes = Scenes(np.zeros((number, 3)), np.zeros((number, 3)), np.zeros((number, self._rows, 7)))
        pending, family = np.arange(number), np.array([each.random() for each in generators])
        numbers = Numbers(generators, self._size)
        while len(pending) and numbers.made < sum(GROUPS):
            faithful = max(FAITHFUL - numbers.made, 0)
            u = numbers.draw(pending)
            u[:, :faithful, FAMILY] = family[pending, None]
            first = self._draw(u, pending, ends, scenes)
            numbers.put_back(pending, first)
            pending = pending[first < 0]
        if len(pending):
            where = (
                f" in the workspace {self.arm.workspace} m of {self.arm.name}; an arm of your own may need a larger "
                "one, or fewer obstacles (n_obstacles)"
                if ends is None
                else f" between start {ends[0][pending[0]]} and goal {ends[1][pending[0]]}"
            )
            raise RuntimeError(
                f"no scene with {self.distribution.n_obstacles} obstacles was found in {sum(GROUPS)} "
                f"attempts{where}"
            )
        return scenes

    def _draw(self, u: Float, pending: Int, ends: tuple[Float, Float] | None, scenes: Scenes) -> Int:
        """Put the scene of the first good attempt of each; which that was, shape (P,), -1 for none.

        Args:
            u: Uniform numbers, shape (P, attempts, .).
            pending: Where the scenes belong, shape (P,).
            ends: See :meth:`__call__`.
            scenes: To put them.
        """
        left, begin, good = np.arange(len(pending)), 0, np.full(len(pending), -1)
        while begin < u.shape[1] and len(left):
            several = max(TOGETHER // len(left), 1)
            some = u[left, begin : begin + several]
            each = np.repeat(left, some.shape[1])
            where = pending[each]
            given = None if ends is None else (ends[0][where], ends[1][where])
            found, attempt = self._attempt(some.reshape(-1, self._size), given)
            solved, first = np.unique(each[found], return_index=True)
            scenes.put(pending[solved], attempt.take(first))
            good[solved] = begin + np.flatnonzero(found)[first] % some.shape[1]
            left, begin = np.flatnonzero(good < 0), begin + several
        return good

    @property
    def _size(self) -> int:
        """Uniform numbers of one attempt."""
        return 6 * ENDS + 3 * WITNESSES + 3 + (NUMBERS + 1) * (STRUCTURES + OTHERS) + self._rows

    def _attempt(self, u: Float, ends: tuple[Float, Float] | None) -> tuple[Bool, Scenes]:
        """Which attempts are good, shape (N,), and the scenes of those."""
        parts = np.split(
            u,
            np.cumsum([6 * ENDS, 3 * WITNESSES, 3, (NUMBERS + 1) * STRUCTURES, (NUMBERS + 1) * OTHERS]),
            axis=1,
        )
        start, goal, found = draw_ends(parts[0].reshape(-1, ENDS, 6), self.arm, self.distribution, ends)
        some = np.flatnonzero(found)
        if not len(some):
            return found, Scenes(start, goal, np.zeros((len(u), self._rows, 7))).take(found)
        above = (
            np.isin(self._families[self._which(parts[2][some, 1])], BOARDS)
            if self._rows
            else np.zeros(len(some), bool)
        )
        witnesses = parts[1][some].reshape(-1, WITNESSES, 3)
        margin = self.distribution.reach_margin
        path, reached = draw_path(witnesses, self.arm, (start[some], goal[some]), margin, above)
        found[some] = reached
        some, path = some[reached], path[reached]
        start, goal = start[some], goal[some]
        obstacles = np.zeros((len(some), self._rows, 7))
        if self._rows and len(some):
            kept, obstacles = self._furnish([part[some] for part in parts[2:]], start, goal, path)
            found[some] = kept
            start, goal, obstacles = start[kept], goal[kept], obstacles[kept]
        return found, Scenes(start, goal, obstacles)

    def _furnish(self, u: list[Float], start: Float, goal: Float, path: Float) -> tuple[Bool, Float]:
        """Which scenes get something in the way, shape (N,), and their obstacles, shape (N, rows, 7)."""
        (least, most), number = self.distribution.n_obstacles, len(start)
        general, hardness = u[0], u[0][:, :1] ** self.distribution.ease
        swept = Swept.of(self.collision_model, path)
        built = self._built(general[:, 1], _each(u[1], STRUCTURES), hardness, (start, goal, path), swept)
        fits = self._free(swept.outer, built)
        self._keep_blocking(fits, start, goal, built)
        wanted = least + np.floor((most - least + 1) * general[:, 2])
        chosen = built[np.arange(number), fits.argmax(axis=-1)]
        chosen[wanted == 0.0] = 0.0
        good = fits.any(axis=-1) | (wanted == 0.0)
        some = np.flatnonzero(good)
        some = some[self._free(swept.inner.take(some), chosen[some, None])[:, 0]]
        good, others = np.isin(np.arange(number), some), np.zeros((number, self._rows, 7))
        missing = np.maximum(wanted - (chosen[..., -1] > 0.0).sum(axis=-1), 0.0)
        enough, others[some] = self._others(
            _each(u[2], OTHERS)[some],
            (start[some], goal[some], path[some]),
            hardness[some],
            swept.take(some),
            missing[some],
        )
        good[some] = enough
        return good, _shuffled(np.concatenate((chosen, others), axis=1), u[3])

    def _built(
        self, family: Float, u: Float, hardness: Float, course: tuple[Float, Float, Float], swept: Swept
    ) -> Float:
        """What the drawn families build, moved out of the witness's way, shape (N, STRUCTURES, up to PARTS, 7)."""
        names = self._families[self._which(family)]
        rows, retreat = np.zeros((*u.shape[:2], PARTS, 7)), np.zeros((*u.shape[:2], PARTS, 3))
        here = self._course(course, u[..., -1], hardness, swept)
        most = max(FAMILIES[name] for name in set(names))
        for name in np.unique(names):
            some = names == name
            rows[some], retreat[some] = structure(
                name,
                self.distribution,
                here.take(some),
                u[some, :, :NUMBERS],
                self.arm.hand_radius,
            )
        rows, retreat = rows[:, :, :most], retreat[:, :, :most]
        enough = self.distribution.link_margin + 0.002
        clearance = swept.outer.every_other().clearance(rows.reshape(len(u), -1, 7), enough)
        lacking = np.maximum((enough - clearance).reshape(rows.shape[:3]), 0.0)
        board = np.isin(names, BOARDS)[:, None]
        lacking[..., :3] = np.where(
            board[..., None], lacking[..., :3].max(axis=-1, keepdims=True), lacking[..., :3]
        )
        rows[..., :3] += np.where(rows[..., -1:] > 0.0, GIVE_WAY * lacking[..., None] * retreat, 0.0)
        return rows

    def _others(
        self, u: Float, course: tuple[Float, Float, Float], hardness: Float, swept: Swept, missing: Float
    ) -> tuple[Bool, Float]:
        """Which scenes get as many further obstacles as are missing, and these, shape (N, rows, 7)."""
        order = np.argsort(-u[..., -1], axis=-1, kind="stable")
        # Mostly there are enough among the first ones.
        enough, chosen = self._others_of(u, order[:, : self._rows], course, hardness, swept, missing)
        left = np.flatnonzero(~enough)
        if len(left):
            start, goal, path = (part[left] for part in course)
            enough[left], chosen[left] = self._others_of(
                u[left], order[left], (start, goal, path), hardness[left], swept.take(left), missing[left]
            )
        return enough & self._free(swept.inner, chosen[:, None])[:, 0], chosen

    def _others_of(
        self,
        u: Float,
        order: Int,
        course: tuple[Float, Float, Float],
        hardness: Float,
        swept: Swept,
        missing: Float,
    ) -> tuple[Bool, Float]:
        """The same of some of them, in their order, and as the links near the hand allow."""
        u = np.take_along_axis(u, order[..., None], axis=1)
        here = self._course(course, u[..., -1], hardness)
        rows = self._loose(u, here, order % 2 == 0)
        room = self._room(swept.outer, rows, np.inf)
        rows = _pushed(rows, here.place, hardness * np.maximum(room - 0.002, 0.0))
        good = (room > 0.0) & _within_bounds(rows)
        which = np.argsort(~good, axis=-1, kind="stable")[:, : self._rows]
        used = np.arange(which.shape[1]) < missing[:, None]
        chosen = np.where(used[..., None], np.take_along_axis(rows, which[..., None], axis=1), 0.0)
        return good.sum(axis=-1) >= missing, chosen

    def _which(self, u: Float) -> NDArray[np.int64]:
        """Index of the family that a uniform number stands for."""
        return np.minimum((u * len(self._families)).astype(np.int64), len(self._families) - 1)

    def _course(
        self, course: tuple[Float, Float, Float], u: Float, hardness: Float, swept: Swept | None = None
    ) -> Course:
        """The movement around places that are drawn on the middle of the witness."""
        start, goal, path = course
        phase = (0.3 * PHASES + 0.4 * PHASES * u).astype(np.int64)
        each = np.arange(len(path))[:, None]
        step = path[each, phase + 1] - path[each, phase - 1]
        step[..., 2] = 0.0
        length = np.sqrt(squared_length(step))[..., None]
        heading = np.where(length > 1e-6, step / np.maximum(length, 1e-6), (1.0, 0.0, 0.0))
        place = path[each, phase]
        top = place[..., 2] if swept is None else swept.top(phase, place)
        return Course(start[:, None], goal[:, None], place, heading, top, hardness)

    def _loose(self, u: Float, here: Course, about: Bool) -> Float:
        """Spheres, posts and bars, some about the straight line, the others about the witness, shape (N, n, 7)."""
        away = self.distribution.spread * (2.0 * u[..., 3:6] - 1.0)
        centre = np.where(about[..., None], here.on_line(u[..., -1]), here.place) + away
        centre[..., 2] = np.maximum(centre[..., 2], 0.02)
        return single(self.distribution, centre, u[..., [0, 1, 2, 4, 5, 3]])

    def _room(self, bodies: Bodies, rows: Float, most: float, **how: Any) -> Float:
        """How much nearer each row may come to the witness, which wants more room at its ends, shape (N, n), [m]."""
        margin = np.full(PHASES, self.distribution.link_margin)
        margin[[0, -1]] = self.distribution.end_margin
        return bodies.clearance(rows, most, margin, **how)

    def _free(self, bodies: Bodies, built: Float) -> Bool:
        """Which of K structures leave room for the witness and are within bounds, shape (N, K), given (N, K, ., 7)."""
        number, several, parts = built.shape[:3]
        inside: Any = (_within_bounds(built) | (built[..., -1] <= 0.0)).all(axis=-1)
        rows = np.where(inside[..., None, None], built, 0.0).reshape(number, several * parts, 7)
        return np.asarray(inside & (self._room(bodies, rows, SOME, floor=0.0, together=parts) > 0.0))

    def _keep_blocking(self, fits: Bool, start: Float, goal: Float, built: Float) -> None:
        """Strike out the first structures that the straight movement does not hit, shape (N, STRUCTURES)."""
        left = np.flatnonzero(fits.any(axis=-1))
        if not len(left):
            return
        line = start[left, None] + (goal - start)[left, None] * np.linspace(0.0, 1.0, PHASES // 2)[:, None]
        bodies = Swept.of(self.collision_model, line).outer
        while len(left):
            first = fits[left].argmax(axis=-1)
            depth = bodies.clearance(
                built[left, first], -IN_THE_WAY, floor=-IN_THE_WAY, together=built.shape[2]
            )
            missed = depth[:, 0] >= -IN_THE_WAY
            fits[left[missed], first[missed]] = False
            more = missed & fits[left].any(axis=-1)
            left, bodies = left[more], bodies.take(np.flatnonzero(more))


def _within_bounds(rows: Float) -> Bool:
    """Which rows are no farther and no longer than scenes allow."""
    x, y, z = (np.abs(rows[..., axis]) < 1.0 for axis in range(3))
    return np.asarray(x & y & z & (squared_length(rows[..., 3:6]) < LARGEST_HALF_AXIS**2))


def _pushed(rows: Float, place: Float, way: Float) -> Float:
    """Rows moved towards a place by less than the room there is, which cannot reach the arm; posts along the table."""
    towards = place - rows[..., :3]
    standing = (rows[..., 3:5] == 0.0).all(axis=-1) & (rows[..., 5] > 0.0)
    towards[..., 2] = np.where(standing, 0.0, towards[..., 2])
    length = np.sqrt(squared_length(towards))
    share = np.minimum(way, length) / np.maximum(length, 1e-9)
    return np.concatenate((rows[..., :3] + share[..., None] * towards, rows[..., 3:]), axis=-1)


def _each(u: Float, number: int) -> Float:
    """The numbers of `number` things."""
    return u.reshape(len(u), number, NUMBERS + 1)


def _shuffled(rows: Float, chance: Float) -> Float:
    """As many rows as there are chances, those that are obstacles, in random order."""
    count = chance.shape[1]
    first = np.argsort(rows[..., -1] <= 0.0, axis=-1, kind="stable")[:, :count]
    packed = np.take_along_axis(rows, first[..., None], axis=1)
    return np.take_along_axis(packed, np.argsort(chance, axis=-1, kind="stable")[..., None], axis=1)
