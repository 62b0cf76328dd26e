"""Tall posts and bars, pushed up to the space that the arm of the witness sweeps.

Few obstacles make a whole-arm scene hard unless they stand close to the arm. So each candidate is drawn beside the
hand's path, outside the elbow or in the crook of the arm, and pushed along the shortest way towards the arm, to within
a gap: a translation by less than the clearance cannot reach the arm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import hand_clearance, segment_distance_squared
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.planar_draws import PHASES, FeasiblePath, Uniforms, left, turned, unit
from viapoint.envs.scenes.planar_hand import Choice, choose, in_the_way, on_path, shapes

CANDIDATES, CHOICES, BLOCKING = 56, 24, 4
"""How many obstacles are drawn at once, how many of them are looked at closely, and how many of these are in the way
if there are as many."""
POSTURES = 32
"""Of the witness, about evenly along its path."""
PHASES_OF_WAYS = np.array([0.2, 0.4, 0.6, 0.8])
"""When ways round are looked at, relative to their durations."""
BESIDE = (0.03, 0.06, 0.10)
"""How far from the witness's via-point those of neighbouring ways lie, six all round at each distance, [m]."""


class WholeArmObstacles:
    """Obstacles that every link must clear."""

    def __init__(self, arm: Arm, distribution: SceneDistribution) -> None:
        self._arm, self._distribution = arm, distribution
        self._distance = float(np.mean(distribution.distance))
        self._ways = _ways_round(ActionLayout(dimension=arm.dimension), self._distance)

    @property
    def rows(self) -> int:
        """Obstacles of a scene at most."""
        return self._distribution.n_obstacles[1]

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return 10 * CANDIDATES + CHOICES + 2 + self.rows

    def __call__(self, uniforms: Uniforms, witness: FeasiblePath) -> tuple[Float, NDArray[np.bool_]]:
        """See :class:`~viapoint.envs.scenes.planar_hand.ObstacleSampler`."""
        hardness = uniforms.take(1) ** self._distribution.ease_whole_arm
        return choose(
            uniforms, self._choice(uniforms, witness, hardness), hardness, self._distribution.n_obstacles
        )

    def beside(
        self, uniforms: Uniforms, witness: FeasiblePath, rows: Float, count: int
    ) -> tuple[Float, NDArray[np.bool_]]:
        """More obstacles, shape (N, count, 2 D + 1), to close what is still open round the given rows, (N, n, 2 D + 1).

        10 CANDIDATES + CHOICES + 1 + count uniform numbers are taken.
        """
        hardness = np.ones((len(rows), 1))
        choice = self._choice(uniforms, witness, hardness)
        still_open = ~self._ways_closed(witness, rows).any(axis=1, keepdims=True)
        choice = choice._replace(in_the_way=choice.free, closed=choice.closed & still_open)
        return choose(uniforms, choice, hardness, (count, count))

    def _choice(self, uniforms: Uniforms, witness: FeasiblePath, hardness: Float) -> Choice:
        """Candidates, those that leave room and are in the way first."""
        d, arm = self._distribution, self._arm
        links = np.asarray(
            arm.links(arm.inverse_kinematics(witness.path[:, _evenly(POSTURES)].astype(np.float32)))
        )
        rows = self._candidates(uniforms, witness, links)
        gap = d.link_margin + 0.002 + 0.08 * uniforms.take(CANDIDATES) * (1.0 - hardness)
        rows, clearance = _pushed(rows, links, arm.link_radii, gap)
        ends = np.stack((witness.start, witness.goal), axis=1)
        present = np.ones(rows.shape[:-1], dtype=bool)
        free = (clearance > d.link_margin) & (
            hand_clearance(ends, arm.hand_radius, rows, present) > d.end_margin
        )
        hit = in_the_way(witness, rows, arm.hand_radius)
        first = free & hit & ((free & hit).cumsum(axis=-1) <= BLOCKING)
        some = np.argsort(2 - free - first.astype(np.int64), axis=-1, kind="stable")[:, :CHOICES]
        rows = np.take_along_axis(rows, some[..., None], axis=1)
        free, hit = (np.take_along_axis(each, some, axis=1) for each in (free, hit))
        return Choice(rows, free, hit, self._ways_closed(witness, rows))

    def _candidates(self, uniforms: Uniforms, witness: FeasiblePath, links: Float) -> Float:
        """Posts and bars near the arm, shape (N, CANDIDATES, 5).

        In turn outside the elbow, beside the hand's path towards the straight line, in the crook of the arm, and
        anywhere beside the path.
        """
        arm, d = self._arm, self._distribution
        fraction, side = uniforms.take(CANDIDATES), uniforms.take(CANDIDATES) - 0.5
        half, radius, tilt = shapes(uniforms, d, CANDIDATES)
        foot, tangent = on_path(witness.path, fraction)
        away = left(tangent)
        axis = half[..., None] * turned(away, -tilt)
        kind = np.arange(CANDIDATES) % 4
        line = witness.start[:, None] + fraction[..., None] * (witness.goal - witness.start)[:, None]
        side = np.where(kind == 1, (away * (line - foot)).sum(axis=-1), side)
        away = np.where(side[..., None] < 0.0, -away, away)
        joint, outwards = _about_the_elbow(uniforms, links)
        foot = np.where((kind % 2 == 1)[:, None], foot, joint)
        away = np.where((kind % 2 == 1)[:, None], away, outwards)
        room = half + radius + arm.link_radii[-1] + d.link_margin + 0.01
        return np.concatenate((foot + away * room[..., None], axis, radius[..., None]), axis=-1)

    def _ways_closed(self, witness: FeasiblePath, rows: Float) -> NDArray[np.bool_]:
        """Which ways round each candidate closes to hand and forearm, shape (N, CHOICES, ways)."""
        hand = self._paths(witness).astype(np.float32)
        reached = (self._arm.reach_margin(hand) > 0.0).all(axis=-1)
        links = np.asarray(self._arm.links(self._arm.inverse_kinematics(hand))[..., -1, :, :])
        links = links.reshape(len(rows), -1, *links.shape[-2:])
        limit = (rows[..., -1:] + self._arm.link_radii[-1]).astype(np.float32) ** 2
        hit = _distance_squared(links, rows) < limit
        return np.asarray(hit.reshape(*rows.shape[:2], *hand.shape[1:3]).any(axis=-1) & reached[:, None])

    def _paths(self, witness: FeasiblePath) -> Float:
        """Positions of the hand on other ways: all over, and close to the witness, shape (N, ways, phases, D)."""
        start, goal, path = witness
        distance = np.sqrt(((goal - start) ** 2).sum(axis=-1))[:, None, None]
        along = unit(goal - start)[:, None]
        along, across = along[:, None], left(along)[:, None]
        x = self._ways[..., 0] + (distance - self._distance) * _straight(PHASES_OF_WAYS)
        far = start[:, None, None] + x[..., None] * along + self._ways[..., 1:2] * across
        angle = np.arange(6) * np.pi / 3.0
        around = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
        offset = np.concatenate(
            [distance * turned(around, np.full(6, 0.3 * i)) for i, distance in enumerate(BESIDE)]
        )
        bump = 64.0 * (PHASES_OF_WAYS * (1.0 - PHASES_OF_WAYS)) ** 3  # about what moving the via-point does
        middle = path[:, np.round(PHASES_OF_WAYS * (PHASES - 1)).astype(np.int64)]
        near = middle[:, None] + bump[:, None] * offset[:, None]
        return np.concatenate((far, near), axis=1)


def _about_the_elbow(uniforms: Uniforms, links: Float) -> tuple[Float, Float]:
    """Places on the arm when the hand is about nearest to the base, and directions away from it, (N, CANDIDATES, D).

    In turn outwards from the elbow, and from the forearm into the crook of the arm.
    """
    nearest = (links[:, :, -1, 1] ** 2).sum(axis=-1).argmin(axis=-1)[:, None]
    number = links.shape[1]
    step = np.round(nearest + 10.0 * (uniforms.take(CANDIDATES) - 0.5)).astype(np.int64)
    place, angle = 0.4 + 0.6 * uniforms.take(CANDIDATES)[..., None], 2.4 * (uniforms.take(CANDIDATES) - 0.5)
    forearm = links[np.arange(len(links))[:, None], np.clip(step, 0, number - 1), -1]
    elbow, hand = forearm[..., 0, :], forearm[..., 1, :]
    inwards = left(unit(hand - elbow))
    inwards = np.where((inwards * hand).sum(axis=-1, keepdims=True) < 0.0, inwards, -inwards)
    outside = (np.arange(CANDIDATES) % 4 == 0)[:, None]
    direction = np.where(outside, unit(elbow - 0.5 * hand), inwards)
    return np.where(outside, elbow, elbow + place * (hand - elbow)), turned(direction, angle)


def _pushed(rows: Float, links: Float, radii: tuple[float, ...], gap: Float) -> tuple[Float, Float]:
    """Obstacles moved to within a gap of the nearest link of any posture, and their clearance before, (N, C)."""
    best = np.full(rows.shape[:2], np.inf)
    nearest = np.zeros((*rows.shape[:2], *links.shape[-2:]))
    each = np.arange(len(rows))[:, None]
    for i, radius in enumerate(radii):
        squared = _distance_squared(links[:, :, i], rows)
        step = squared.argmin(axis=-1)
        least = np.sqrt(squared.min(axis=-1)) - radius - rows[..., -1]
        nearest = np.where((least < best)[..., None, None], links[each, step, i], nearest)
        best = np.minimum(best, least)
    moved = rows.copy()
    moved[..., : links.shape[-1]] += unit(_shortest(nearest, rows)) * np.maximum(best - gap, 0.0)[..., None]
    return moved, best


def _distance_squared(segments: Float, rows: Float) -> Float:
    """As `segment_distance_squared`, in single precision and a few scenes at a time: they stay in the cache."""
    rows = rows.astype(np.float32)
    pieces = [
        segment_distance_squared(segments[i : i + 8, :, 0], segments[i : i + 8, :, 1], rows[i : i + 8])
        for i in range(0, len(rows), 8)
    ]
    return np.concatenate(pieces)


def _shortest(segments: Float, rows: Float) -> Float:
    """Shortest vectors from the axes of obstacles to segments that do not cross them, shape (N, C, D), [m].

    They begin or end at an end point of the segment or the axis.
    """
    d = segments.shape[-1]
    low, high = rows[..., :d] - rows[..., d : 2 * d], rows[..., :d] + rows[..., d : 2 * d]
    first, second = segments[..., 0, :], segments[..., 1, :]
    vectors = np.stack(
        [
            first - _foot(first, low, high),
            second - _foot(second, low, high),
            _foot(low, first, second) - low,
            _foot(high, first, second) - high,
        ]
    )
    best = (vectors**2).sum(axis=-1).argmin(axis=0)
    return np.asarray(np.take_along_axis(vectors, best[None, ..., None], axis=0)[0])


def _foot(point: Float, first: Float, second: Float) -> Float:
    """The nearest point of a segment."""
    line = second - first
    square = np.maximum((line**2).sum(axis=-1), 1e-12)
    along = np.clip(((point - first) * line).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(first + along[..., None] * line)


def _straight(phases: Float) -> Float:
    """Progress of the straight minimum-jerk movement."""
    return phases**3 * (10.0 - 15.0 * phases + 6.0 * phases**2)


def _evenly(count: int) -> NDArray[np.int64]:
    """Phases of a path about evenly along it."""
    progress = _straight(np.linspace(0.0, 1.0, PHASES))
    return np.unique(
        np.round(np.interp(np.linspace(0.0, 1.0, count), progress, np.arange(PHASES))).astype(np.int64)
    )


def _ways_round(layout: ActionLayout, distance: float) -> Float:
    """Movements through one via-point along the first axis, shape (ways, phases, D), [m]."""
    along, across = (g.ravel() for g in np.meshgrid((-0.7, 0.0, 0.7), np.linspace(-1.0, 1.0, 9)))
    action = np.zeros((len(along), layout.size))
    action[:, 0], action[:, 1] = along, across
    goal = np.zeros((len(along), layout.dimension))
    goal[:, 0] = distance
    plan = layout.decode(action, np.zeros_like(goal), goal)
    return np.asarray(plan.trajectory()(plan.durations.sum(axis=-1)[:, None] * PHASES_OF_WAYS))
