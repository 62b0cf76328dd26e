"""Drawing scenes in space in which the straight movement hits something and another one does not.

As in the plane, a movement through a via-point is drawn first, the witness; then a family is built in the way of the
straight movement and clear of the witness, with every link; then further obstacles are put about it. A scene is a
function of a row of uniform numbers, so each environment draws from its own generator and all are computed together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.action import ActionLayout
from viapoint.envs.arms.arm import Arm
from viapoint.envs.scenes import LARGEST_HALF_AXIS, Scenes
from viapoint.envs.space_bodies import Bodies, Swept
from viapoint.envs.space_distribution import BOARDS, SpaceDistribution
from viapoint.envs.space_obstacles import NUMBERS, PARTS, Course, single, structure

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

ENDS, WITNESSES, PHASES, STRUCTURES, OTHERS = 12, 8, 16, 4, 14
"""How many pairs of ends, witnesses, structures and other obstacles are drawn at once, and at how many times a
movement is looked at."""
ATTEMPTS = (1, 2, 4, *[8] * 400)
"""How many attempts are made at once, one time after the other: few are left after the first,
but one in a hundred makes a tunnel."""
FAITHFUL = 8
"""How many times attempts keep to the family that was drawn first, so that those that seldom fit are not rarer."""
FAMILY = 6 * ENDS + 3 * WITNESSES + 1
"""Which of the uniform numbers of an attempt stands for the family."""
GIVE_WAY = 1.3
"""How far what is in the witness's way moves, relative to what it lacks in clearance."""
IN_THE_WAY = 0.004
"""How deep the straight movement cuts into what is in its way, [m]."""


class SpaceSampler:
    """Draws scenes for an arm that moves in space, each from a generator of its own."""

    def __init__(self, arm: Arm, distribution: SpaceDistribution, *, whole_arm: bool) -> None:
        self.arm = arm
        self.distribution = distribution
        self.whole_arm = whole_arm
        self._layout = ActionLayout(dimension=arm.dimension)
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
        for group, attempts in enumerate(ATTEMPTS):
            if not len(pending):
                break
            u = np.concatenate([generators[int(i)].random((attempts, self._size)) for i in pending])
            each = np.repeat(pending, attempts)
            if group < FAITHFUL:
                u[:, FAMILY] = family[each]
            found, attempt = self._attempt(u, None if ends is None else (ends[0][each], ends[1][each]))
            solved, first = np.unique(each[found], return_index=True)
            scenes.put(solved, attempt.take(first))
            pending = np.setdiff1d(pending, solved)
        if len(pending):
            between = (
                "" if ends is None else f" between start {ends[0][pending[0]]} and goal {ends[1][pending[0]]}"
            )
            raise RuntimeError(
                f"no scene with {self.distribution.n_obstacles} obstacles was found in {sum(ATTEMPTS)} "
                f"attempts{between}"
            )
        return scenes

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
        start, goal, good = self._ends(parts[0].reshape(-1, ENDS, 6), ends)
        above = (
            np.isin(self._families[self._which(parts[2][:, 1])], BOARDS)
            if self._rows
            else np.zeros(len(u), bool)
        )
        path, reached = self._witness(parts[1].reshape(-1, WITNESSES, 3), start, goal, above)
        found = good & reached
        if not self._rows:
            return found, Scenes(start, goal, np.zeros((len(u), 0, 7))).take(found)
        some = np.flatnonzero(found)
        if not len(some):
            return found, Scenes(start, goal, np.zeros((len(u), self._rows, 7))).take(found)
        start, goal, path = start[some], goal[some], path[some]
        kept, obstacles = self._furnish([part[some] for part in parts[2:]], start, goal, path)
        found[some] = kept
        return found, Scenes(start, goal, obstacles).take(kept)

    def _ends(self, u: Float, ends: tuple[Float, Float] | None) -> tuple[Float, Float, Bool]:
        """Starts and goals inside the workspace with the straight line between them inside the reach."""
        low, high = (np.array(corner) for corner in self.arm.workspace)
        start = low + (high - low) * u[..., :3]
        height, angle = self.distribution.steepness * (2.0 * u[..., 3] - 1.0), 2.0 * np.pi * u[..., 4]
        level = np.sqrt(1.0 - height**2)
        shortest, longest = self.distribution.distance
        step = np.stack((level * np.cos(angle), level * np.sin(angle), height), axis=-1)
        if ends is not None:
            start = np.where(np.isnan(ends[0])[:, None], start, ends[0][:, None])
        goal = start + (shortest + (longest - shortest) * u[..., 5:6]) * step
        inside = ((goal >= low) & (goal <= high)).all(axis=-1)
        if ends is not None:
            goal = np.where(np.isnan(ends[1])[:, None], goal, ends[1][:, None])
            inside |= np.isfinite(ends[1][:, :1])
        line = start[..., None, :] + (goal - start)[..., None, :] * np.linspace(0.0, 1.0, 5)[:, None]
        good = inside & (self.arm.reach_margin(line).min(axis=-1) > self.distribution.reach_margin)
        each, first = np.arange(len(u)), good.argmax(axis=-1)
        return start[each, first], goal[each, first], good.any(axis=-1)

    def _witness(self, u: Float, start: Float, goal: Float, above: Bool) -> tuple[Float, Bool]:
        """Hand path of a movement through one via-point inside the reach, shape (N, PHASES, 3): above, or anywhere."""
        angle = np.pi * np.where(above[:, None], 0.25 + 0.5 * u[..., 0], 1.3 * u[..., 0] - 0.15)
        size = 0.45 + 0.5 * u[..., 1]
        along = u[..., 2] - 0.5
        action = np.stack((along, size * np.cos(angle), size * np.sin(angle), np.zeros_like(along)), axis=-1)
        shape = (*action.shape[:2], 3)
        plan = self._layout.decode(
            action, np.broadcast_to(start[:, None], shape), np.broadcast_to(goal[:, None], shape)
        )
        paths = plan.trajectory()(plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, PHASES))
        good = (self.arm.reach_margin(paths) > self.distribution.reach_margin).all(axis=-1)
        first = good.argmax(axis=-1)
        return paths[np.arange(len(first)), first], good.any(axis=-1)

    def _furnish(self, u: list[Float], start: Float, goal: Float, path: Float) -> tuple[Bool, Float]:
        """Which scenes get something in the way, shape (N,), and their obstacles, shape (N, rows, 7)."""
        (least, most), number = self.distribution.n_obstacles, len(start)
        general, hardness = u[0], u[0][:, :1] ** self.distribution.ease
        swept = Swept.of(self.arm, path, whole_arm=self.whole_arm)
        built = self._built(general[:, 1], _each(u[1], STRUCTURES), hardness, (start, goal, path), swept)
        whole = self._free(swept.outer, built.reshape(number, -1, 7)).reshape(built.shape[:3]).all(axis=-1)
        fits = whole & self._blocks(start, goal, built)
        wanted = least + np.floor((most - least + 1) * general[:, 2])
        chosen = built[np.arange(number), fits.argmax(axis=-1)]
        chosen[wanted == 0.0] = 0.0
        good = fits.any(axis=-1) | (wanted == 0.0)
        good &= self._free(swept.inner, chosen).all(axis=-1)
        some, others = np.flatnonzero(good), np.zeros((number, self._rows, 7))
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
        """What the drawn families build, moved out of the witness's way, shape (N, STRUCTURES, PARTS, 7)."""
        which = self._which(family)
        rows, retreat = np.zeros((*u.shape[:2], PARTS, 7)), np.zeros((*u.shape[:2], PARTS, 3))
        for index, name in enumerate(self._families):
            some = np.flatnonzero(which == index)
            if not len(some):
                continue
            start, goal, path = (part[some] for part in course)
            here = self._course((start, goal, path), u[some, :, -1], hardness[some], swept.take(some))
            rows[some], retreat[some] = structure(
                name, self.distribution, here, u[some, :, :NUMBERS], self.arm.hand_radius
            )
        clearance = swept.outer.every_other().clearance(rows.reshape(len(u), -1, 7)).min(axis=-1)
        lacking = self.distribution.link_margin + 0.002 - clearance
        lacking = np.maximum(lacking.reshape(rows.shape[:3]), 0.0)
        board = np.isin(self._families[which], BOARDS)[:, None]
        lacking[..., :3] = np.where(
            board[..., None], lacking[..., :3].max(axis=-1, keepdims=True), lacking[..., :3]
        )
        rows[..., :3] += np.where(rows[..., -1:] > 0.0, GIVE_WAY * lacking[..., None] * retreat, 0.0)
        return rows

    def _others(
        self, u: Float, course: tuple[Float, Float, Float], hardness: Float, swept: Swept, missing: Float
    ) -> tuple[Bool, Float]:
        """Which scenes get as many further obstacles as are missing, and these, shape (N, rows, 7)."""
        here = self._course(course, u[..., -1], hardness, swept)
        rows = self._loose(u, here)
        room = self._room(swept.outer, rows)
        rows = _pushed(rows, here.place, hardness * np.maximum(room - 0.002, 0.0))
        key = np.where((room > 0.0) & _within_bounds(rows), u[..., -1], -1.0)
        order = np.argsort(-key, axis=-1, kind="stable")[:, : self._rows]
        used = np.arange(order.shape[1]) < missing[:, None]
        enough = (np.take_along_axis(key, order, axis=1) >= 0.0).sum(axis=-1) >= missing
        chosen = np.where(used[..., None], np.take_along_axis(rows, order[..., None], axis=1), 0.0)
        return enough & self._free(swept.inner, chosen).all(axis=-1), chosen

    def _which(self, u: Float) -> NDArray[np.int64]:
        """Index of the family that a uniform number stands for."""
        return np.minimum((u * len(self._families)).astype(np.int64), len(self._families) - 1)

    def _course(self, course: tuple[Float, Float, Float], u: Float, hardness: Float, swept: Swept) -> Course:
        """The movement around places that are drawn on the middle of the witness."""
        start, goal, path = course
        phase = (0.3 * PHASES + 0.4 * PHASES * u).astype(np.int64)
        each = np.arange(len(path))[:, None]
        step = path[each, phase + 1] - path[each, phase - 1]
        step[..., 2] = 0.0
        length = np.sqrt((step**2).sum(axis=-1, keepdims=True))
        heading = np.where(length > 1e-6, step / np.maximum(length, 1e-6), (1.0, 0.0, 0.0))
        place = path[each, phase]
        return Course(start[:, None], goal[:, None], place, heading, swept.top(phase, place), hardness)

    def _loose(self, u: Float, here: Course) -> Float:
        """Spheres, posts and bars, a half about the straight line, a half about the witness, shape (N, OTHERS, 7)."""
        away = self.distribution.spread * (2.0 * u[..., 3:6] - 1.0)
        about = (np.arange(OTHERS) % 2 == 0)[:, None]
        centre = np.where(about, here.on_line(u[..., -1]), here.place) + away
        centre[..., 2] = np.maximum(centre[..., 2], 0.02)
        return single(self.distribution, centre, u[..., [0, 1, 2, 4, 5, 3]])

    def _room(self, bodies: Bodies, rows: Float) -> Float:
        """How much nearer each row may come to the witness, which wants more room at its ends, shape (N, n), [m]."""
        d = self.distribution
        if not len(bodies.radii):
            return np.full(rows.shape[:2], np.inf)
        clearance = bodies.clearance(rows)
        at_ends = clearance[..., [0, -1]].min(axis=-1) - d.end_margin
        return np.asarray(np.minimum(clearance.min(axis=-1) - d.link_margin, at_ends))

    def _free(self, bodies: Bodies, rows: Float) -> Bool:
        """Which rows leave room for the witness and are within bounds, shape (N, n); what is none does."""
        return ((self._room(bodies, rows) > 0.0) & _within_bounds(rows)) | (rows[..., -1] <= 0.0)

    def _blocks(self, start: Float, goal: Float, built: Float) -> Bool:
        """Which structures the straight movement hits, shape (N, STRUCTURES)."""
        line = start[:, None] + (goal - start)[:, None] * np.linspace(0.0, 1.0, PHASES // 2)[:, None]
        bodies = Swept.of(self.arm, line, whole_arm=self.whole_arm).outer
        clearance = bodies.clearance(built.reshape(len(built), -1, 7)).min(axis=-1)
        hit = (clearance < -IN_THE_WAY).reshape(built.shape[:3]) & (built[..., -1] > 0.0)
        return np.asarray(hit.any(axis=-1))


def _within_bounds(rows: Float) -> Bool:
    """Which rows are no farther and no longer than scenes allow."""
    near = np.abs(rows[..., :3]).max(axis=-1) < 1.0
    return np.asarray(near & ((rows[..., 3:6] ** 2).sum(axis=-1) < LARGEST_HALF_AXIS**2))


def _pushed(rows: Float, place: Float, way: Float) -> Float:
    """Rows moved towards a place by less than the room there is, which cannot reach the arm; posts along the table."""
    towards = place - rows[..., :3]
    standing = (rows[..., 3:5] == 0.0).all(axis=-1) & (rows[..., 5] > 0.0)
    towards[..., 2] = np.where(standing, 0.0, towards[..., 2])
    length = np.sqrt((towards**2).sum(axis=-1))
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
