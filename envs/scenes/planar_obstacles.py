"""Posts and bars in the plane.

Where the hand alone must clear, candidates are drawn about the straight line and beside the feasible path. Few of these
make a scene hard where every link must clear. Candidates are then drawn beside the hand's path, outside the elbow or in
the crook of the arm, and moved towards the nearest link until a gap is left: a translation by less than the clearance
cannot reach the arm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Int, Single
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance, segment_distance_squared
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.draws import (
    IN_THE_WAY,
    FeasiblePath,
    Uniforms,
    between,
    left,
    rotate,
    shuffle_rows,
    unit,
    whole_between,
)
from viapoint.envs.scenes.planar_families import FAMILY_ROWS, PATH_MARGIN, Builder, PlanarSite

CANDIDATES = 32
"""Obstacles that are drawn at once where the hand alone must clear."""
DETOURS_ACROSS, DETOUR_PLACES = 15, 21
"""Lateral positions of the via-points of detours, and places along the line at which detours are stored."""
ARM_CANDIDATES, CHOICES, BLOCKING = 56, 24, 4
"""Obstacles that are drawn at once where links count, those of them that are compared with detours, and how many of
these are in the way if there are as many."""
POSTURES = 32
"""Postures along the feasible path, spaced about evenly."""
ARM_DETOURS_ACROSS = 9
"""Lateral positions of the via-points of detours where links count."""
DETOUR_PHASES = np.array([0.2, 0.4, 0.6, 0.8])
"""Times at which detours of the arm are compared with obstacles, relative to their durations."""
NEAR_DETOURS = (0.03, 0.06, 0.10)
"""Distances between the via-points of the feasible path and of detours near it, six around it at each, [m]."""
AT_ONCE = 8
"""Scenes whose distances are computed at once: their arrays stay in the processor's cache."""
BUILDER_NUMBERS = 14
"""Uniform numbers of each scene that a family may take."""


class PlanarObstacles:
    """Base of the samplers in the plane, see :class:`~viapoint.envs.scenes.draws.ObstacleSampler`."""

    fixed: int | None = None

    def __init__(self, collision_model: CollisionModel, distribution: SceneDistribution) -> None:
        self._arm, self._whole_arm = collision_model.arm, collision_model.whole_arm
        self._distribution = distribution
        self._distance = float(np.mean(distribution.distance))
        self.path_numbers = 3 if self._whole_arm else 2

    @property
    def rows(self) -> int:
        """Greatest number of obstacles in a scene."""
        return self._distribution.n_obstacles[1]

    def steered(self, uniforms: Uniforms, number: int) -> Bool:
        """Return which paths must leave room towards the base: all, where links count."""
        return np.full(number, self._whole_arm)

    def _clears(self, points: Float, rows: Float, margin: float) -> Bool:
        """Return which obstacles leave a margin around the hand at some points, shape (N, C)."""
        return np.asarray(hand_clearance(points, self._arm.hand_radius, rows, rows[..., -1] > 0.0) > margin)

    def _clears_path(self, feasible: FeasiblePath, rows: Float) -> Bool:
        """Return which obstacles leave room for the hand on its path, with start and goal, shape (N, C)."""
        d = self._distribution
        return self._clears(feasible.path, rows, d.path_margin) & self._clears(
            feasible.ends, rows, d.end_margin
        )


class HandObstacles(PlanarObstacles):
    """Obstacles that the hand alone must clear."""

    def __init__(self, collision_model: CollisionModel, distribution: SceneDistribution) -> None:
        super().__init__(collision_model, distribution)
        paths = detour_paths(self._distance, DETOURS_ACROSS, np.linspace(0.0, 1.0, 200))
        places = np.linspace(0.0, self._distance, DETOUR_PLACES)
        lateral = [np.interp(places, path[:, 0], path[:, 1]) for path in paths]
        self._detours: Single = np.stack(lateral, axis=-1).astype(np.float32)
        """Distance of each detour from the straight line, shape (DETOUR_PLACES, detours), [m]."""

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return 7 * CANDIDATES + 2 + self.rows

    def __call__(self, uniforms: Uniforms, feasible: FeasiblePath) -> tuple[Float, Bool]:
        """Return obstacles and which scenes are good."""
        hardness = uniforms.take(1) ** self._distribution.hardness_exponent
        rows = self._candidates(uniforms, feasible, hardness)
        candidates = Candidates(
            rows,
            self._clears_path(feasible, rows),
            in_the_way(feasible, rows, self._arm.hand_radius),
            self._closed_detours(feasible, rows),
        )
        return choose(uniforms, candidates, hardness, self._distribution.n_obstacles)

    def _candidates(self, uniforms: Uniforms, feasible: FeasiblePath, hardness: Float) -> Float:
        """Return posts and bars, shape (N, CANDIDATES, 5): half about the line, half beside the feasible path."""
        d, (start, goal, _) = self._distribution, feasible
        along = (goal - start)[:, None] / norm(goal - start)[:, None, None]
        fraction, offset = uniforms.take(CANDIDATES), 2.0 * uniforms.take(CANDIDATES) - 1.0
        half, radius, tilt = draw_shapes(uniforms, d, CANDIDATES)
        beside = np.arange(CANDIDATES) % 2 == 1
        _, foot, step = feasible.near(fraction, PATH_MARGIN)
        direction = np.where(beside[:, None], unit(step), along)
        normal = left(direction)
        axis = half[..., None] * rotate(normal, -tilt)
        gap = d.path_margin + 0.002 + 0.08 * np.abs(offset) * (1.0 - hardness)
        away = np.copysign(half + radius + self._arm.hand_radius + gap, offset)
        line = start[:, None] + (goal - start)[:, None] * fraction[..., None]
        foot = np.where(beside[:, None], foot, line)
        centre = foot + normal * np.where(beside, away, d.spread * offset)[..., None]
        return np.concatenate((centre, axis, radius[..., None]), axis=-1)

    def _closed_detours(self, feasible: FeasiblePath, rows: Float) -> Bool:
        """Return which detours each candidate closes, shape (N, CANDIDATES, detours).

        This is an estimate at one place along the line, which steers difficulty only.
        """
        start, goal = feasible.start[:, None], feasible.goal[:, None]
        along, length = unit(goal - start), norm(goal - start)
        across = left(along)
        centre, axis, radius = rows[..., :2] - start, rows[..., 2:4], rows[..., 4]
        fraction = np.clip((centre * along).sum(axis=-1) / length, 0.0, 1.0)
        detours = self._detours[np.round(fraction * (len(self._detours) - 1)).astype(np.int64)]
        lateral = (centre * across).sum(axis=-1)[..., None]
        reach = np.abs((axis * across).sum(axis=-1)) + radius + self._arm.hand_radius
        return np.asarray(np.abs(detours - lateral.astype(np.float32)) < reach[..., None].astype(np.float32))


class Candidates(NamedTuple):
    """Candidates for the obstacles of N scenes."""

    rows: Float
    """Shape (N, C, 2 D + 1), [m]."""
    free: Bool
    """Candidates that leave room for the feasible path, shape (N, C)."""
    in_the_way: Bool
    """Candidates that the straight movement hits, shape (N, C)."""
    closed: Bool
    """Detours that each candidate closes, shape (N, C, detours)."""


def choose(
    uniforms: Uniforms, candidates: Candidates, hardness: Float, n_obstacles: tuple[int, int]
) -> tuple[Float, Bool]:
    """Choose obstacles among the free candidates; the first chosen one is in the way of the straight movement.

    The choice is greedy. Hardness moves it from a random candidate to the one that closes most of the detours that are
    still open.

    Args:
        uniforms: C + 1 numbers are taken, and one for each row.
        candidates: Obstacles to choose from.
        hardness: From 0 to 1, shape (N, 1).
        n_obstacles: Fewest and most.

    Returns:
        Obstacles in random rows, shape (N, most, 2 D + 1), [m], and which scenes are good, shape (N,).
    """
    rows, free, in_way, closed = candidates
    most, number = n_obstacles[1], rows.shape[1]
    count = whole_between(n_obstacles, uniforms.take(1))
    chance, order = uniforms.take(number), uniforms.take(most)
    in_way = free & in_way
    enough = (free.sum(axis=-1) >= count[:, 0]) & (in_way.any(axis=-1) | (count[:, 0] == 0))
    still_open = np.ones((len(rows), 1, closed.shape[-1]), dtype=bool)
    eligible, each = in_way, np.arange(len(rows))
    chosen = np.zeros((len(rows), most, rows.shape[-1]))
    for row in range(most):
        gain = (closed & still_open).sum(axis=-1) / np.maximum(still_open.sum(axis=-1), 1)
        key = np.where(eligible, 2.0 * hardness * gain + (1.0 - hardness) * chance, -1.0)
        best = key.argmax(axis=-1)
        chosen[:, row] = np.where(row < count, rows[each, best], 0.0)
        still_open &= ~closed[each, best][:, None]
        free = free & (np.arange(number) != best[:, None])
        eligible = free
    return shuffle_rows(chosen, order), enough


def in_the_way(feasible: FeasiblePath, rows: Float, hand_radius: float) -> Bool:
    """Return which obstacles the straight movement hits, shape (N, C)."""
    squared = segment_distance_squared(feasible.start[:, None], feasible.goal[:, None], rows)[..., 0]
    return np.asarray(np.sqrt(squared) - rows[..., -1] - hand_radius < -IN_THE_WAY)


def draw_shapes(uniforms: Uniforms, d: SceneDistribution, count: int) -> tuple[Float, Float, Float]:
    """Sample half lengths [m], radii [m] and tilts [rad] of posts and bars, half of each, shape (N, count) each."""
    bar = uniforms.take(count) < 0.5
    tilt = d.bar_tilt * (2.0 * uniforms.take(count) - 1.0)
    half = np.where(bar, between(d.bar_half_length, uniforms.take(count)), 0.0)
    size = uniforms.take(count)
    return half, np.where(bar, between(d.bar_radius, size), between(d.post_radius, size)), tilt


def detour_paths(distance: float, n_across: int, phases: Float) -> Float:
    """Return paths around the straight line through a grid of via-points, from the origin along the first axis.

    Args:
        distance: Between start and goal, [m].
        n_across: Lateral positions of via-points; there are three positions along the line.
        phases: Times relative to the duration, shape (T,).

    Returns:
        Shape (3 n_across, T, 2), [m].
    """
    along, across = (g.ravel() for g in np.meshgrid((-0.7, 0.0, 0.7), np.linspace(-1.0, 1.0, n_across)))
    layout = ActionLayout(dimension=2)
    action = np.zeros((len(along), layout.size))
    action[:, 0], action[:, 1] = along, across
    goal = np.zeros((len(along), 2))
    goal[:, 0] = distance
    plan = layout.decode(action, np.zeros_like(goal), goal)
    return np.asarray(plan.trajectory()(plan.durations.sum(axis=-1)[:, None] * phases))


class WholeArmObstacles(PlanarObstacles):
    """Obstacles that every link must clear."""

    def __init__(self, collision_model: CollisionModel, distribution: SceneDistribution) -> None:
        super().__init__(collision_model, distribution)
        self._detours = detour_paths(self._distance, ARM_DETOURS_ACROSS, DETOUR_PHASES)

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return 10 * ARM_CANDIDATES + CHOICES + 2 + self.rows

    def __call__(self, uniforms: Uniforms, feasible: FeasiblePath) -> tuple[Float, Bool]:
        """Return obstacles and which scenes are good."""
        hardness = uniforms.take(1) ** self._distribution.hardness_exponent_whole_arm
        candidates = self._select(uniforms, feasible, hardness)
        return choose(uniforms, candidates, hardness, self._distribution.n_obstacles)

    def add(self, uniforms: Uniforms, feasible: FeasiblePath, rows: Float, count: int) -> tuple[Float, Bool]:
        """Return obstacles that close detours which given obstacles leave open.

        Args:
            uniforms: 10 ARM_CANDIDATES + CHOICES + 1 + count numbers are taken.
            feasible: Paths to leave room for.
            rows: Given obstacles, shape (N, n, 5), [m].
            count: Obstacles to add.

        Returns:
            Obstacles, shape (N, count, 5), [m], and which scenes are good, shape (N,).
        """
        hardness = np.ones((len(rows), 1))
        candidates = self._select(uniforms, feasible, hardness)
        still_open = ~self._closed_detours(feasible, rows).any(axis=1, keepdims=True)
        candidates = candidates._replace(in_the_way=candidates.free, closed=candidates.closed & still_open)
        return choose(uniforms, candidates, hardness, (count, count))

    def _select(self, uniforms: Uniforms, feasible: FeasiblePath, hardness: Float) -> Candidates:
        """Return candidates; those that leave room and are in the way come first."""
        d, arm = self._distribution, self._arm
        path = feasible.path[:, _evenly(feasible.path.shape[1])].astype(np.float32)
        links = np.asarray(arm.links(arm.inverse_kinematics(path)))
        rows = self._candidates(uniforms, feasible, links)
        gap = d.link_margin + 0.002 + 0.08 * uniforms.take(ARM_CANDIDATES) * (1.0 - hardness)
        rows, clearance = _move_to_gap(rows, links, arm.link_radii, gap)
        free = (clearance > d.link_margin) & self._clears(feasible.ends, rows, d.end_margin)
        hit = in_the_way(feasible, rows, arm.hand_radius)
        first = free & hit & ((free & hit).cumsum(axis=-1) <= BLOCKING)
        some = np.argsort(2 - free - first.astype(np.int64), axis=-1, kind="stable")[:, :CHOICES]
        rows = np.take_along_axis(rows, some[..., None], axis=1)
        free, hit = (np.take_along_axis(each, some, axis=1) for each in (free, hit))
        return Candidates(rows, free, hit, self._closed_detours(feasible, rows))

    def _candidates(self, uniforms: Uniforms, feasible: FeasiblePath, links: Float) -> Float:
        """Return posts and bars near the arm, shape (N, ARM_CANDIDATES, 5).

        Four kinds take turns: outside the elbow, beside the hand's path towards the straight line, in the crook of the
        arm, and on a random side of the path.
        """
        arm, d = self._arm, self._distribution
        fraction, side = uniforms.take(ARM_CANDIDATES), uniforms.take(ARM_CANDIDATES) - 0.5
        half, radius, tilt = draw_shapes(uniforms, d, ARM_CANDIDATES)
        _, foot, step = feasible.near(fraction, PATH_MARGIN)
        away = left(unit(step))
        axis = half[..., None] * rotate(away, -tilt)
        kind = np.arange(ARM_CANDIDATES) % 4
        line = feasible.start[:, None] + fraction[..., None] * (feasible.goal - feasible.start)[:, None]
        side = np.where(kind == 1, (away * (line - foot)).sum(axis=-1), side)
        away = np.where(side[..., None] < 0.0, -away, away)
        joint, outwards = _near_elbow(uniforms, links)
        foot = np.where((kind % 2 == 1)[:, None], foot, joint)
        away = np.where((kind % 2 == 1)[:, None], away, outwards)
        room = half + radius + arm.link_radii[-1] + d.link_margin + 0.01
        return np.concatenate((foot + away * room[..., None], axis, radius[..., None]), axis=-1)

    def _closed_detours(self, feasible: FeasiblePath, rows: Float) -> Bool:
        """Return which detours each candidate closes to hand and forearm, shape (N, CHOICES, detours)."""
        hand = self._detours_of(feasible).astype(np.float32)
        reached = (self._arm.reach_margin(hand) > 0.0).all(axis=-1)
        links = np.asarray(self._arm.links(self._arm.inverse_kinematics(hand))[..., -1, :, :])
        links = links.reshape(len(rows), -1, *links.shape[-2:])
        limit = (rows[..., -1:] + self._arm.link_radii[-1]).astype(np.float32) ** 2
        hit = _distance_squared(links, rows) < limit
        return np.asarray(hit.reshape(*rows.shape[:2], *hand.shape[1:3]).any(axis=-1) & reached[:, None])

    def _detours_of(self, feasible: FeasiblePath) -> Float:
        """Return detours of all scenes and detours near the feasible paths, shape (N, detours, phases, D), [m]."""
        start, goal, path = feasible
        distance = norm(goal - start)[:, None, None]
        along = unit(goal - start)[:, None]
        along, across = along[:, None], left(along)[:, None]
        x = self._detours[..., 0] + (distance - self._distance) * _minimum_jerk(DETOUR_PHASES)
        far = start[:, None, None] + x[..., None] * along + self._detours[..., 1:2] * across
        angle = np.arange(6) * np.pi / 3.0
        around = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
        offset = np.concatenate(
            [distance * rotate(around, np.full(6, 0.3 * i)) for i, distance in enumerate(NEAR_DETOURS)]
        )
        # A smooth bump, 0 at the ends and 1 in the middle, approximates the effect of moving the via-point.
        bump = 64.0 * (DETOUR_PHASES * (1.0 - DETOUR_PHASES)) ** 3
        middle = path[:, np.round(DETOUR_PHASES * (path.shape[1] - 1)).astype(np.int64)]
        near = middle[:, None] + bump[:, None] * offset[:, None]
        return np.concatenate((far, near), axis=1)


class FamilyObstacles(WholeArmObstacles):
    """Obstacles of one family; where links count, obstacles close to the arm fill the rows that are left."""

    def __init__(
        self, collision_model: CollisionModel, distribution: SceneDistribution, build: Builder
    ) -> None:
        super().__init__(collision_model, distribution)
        self._build = build

    @property
    def rows(self) -> int:
        """Greatest number of obstacles in a scene."""
        return min(FAMILY_ROWS, super().rows)

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return BUILDER_NUMBERS + 10 * ARM_CANDIDATES + CHOICES + 1 + 2 * self.rows

    def __call__(self, uniforms: Uniforms, feasible: FeasiblePath) -> tuple[Float, Bool]:
        """Return obstacles and which scenes are good."""
        arm, order = self._arm, uniforms.take(self.rows)
        links = np.asarray(arm.links(arm.inverse_kinematics(feasible.path)))
        site = PlanarSite(
            feasible=feasible,
            room=arm.link_radii[-1] if self._whole_arm else arm.hand_radius,
            whole_arm=self._whole_arm,
            elbow=links[..., -1, 0, :],
        )
        built = self._build(uniforms, site)
        rows = np.zeros((len(built), self.rows, built.shape[-1]))
        count = built.shape[1]
        rows[:, :count] = built
        free = self._clears_path(feasible, rows)
        if self._whole_arm:
            clearance = arm_clearance(links, arm.link_radii, rows, rows[..., -1] > 0.0)
            free &= clearance > self._distribution.link_margin
        good = np.asarray(free.all(axis=-1))
        if self._whole_arm and count < self.rows:
            rows[:, count:], enough = self.add(uniforms, feasible, built, self.rows - count)
            good &= enough
        hit = in_the_way(feasible, rows, arm.hand_radius) & (rows[..., -1] > 0.0)
        return shuffle_rows(rows, order), good & hit.any(axis=-1)


def _near_elbow(uniforms: Uniforms, links: Float) -> tuple[Float, Float]:
    """Return points on the arm when the hand is about nearest to the base, and directions away from the arm.

    Two kinds take turns: outwards from the elbow, and from the forearm into the crook of the arm.

    Returns:
        Points [m] and unit vectors, shape (N, ARM_CANDIDATES, D) each.
    """
    nearest = (links[:, :, -1, 1] ** 2).sum(axis=-1).argmin(axis=-1)[:, None]
    number = links.shape[1]
    step = np.round(nearest + 10.0 * (uniforms.take(ARM_CANDIDATES) - 0.5)).astype(np.int64)
    place = 0.4 + 0.6 * uniforms.take(ARM_CANDIDATES)[..., None]
    angle = 2.4 * (uniforms.take(ARM_CANDIDATES) - 0.5)
    forearm = links[np.arange(len(links))[:, None], np.clip(step, 0, number - 1), -1]
    elbow, hand = forearm[..., 0, :], forearm[..., 1, :]
    inwards = left(unit(hand - elbow))
    inwards = np.where((inwards * hand).sum(axis=-1, keepdims=True) < 0.0, inwards, -inwards)
    outside = (np.arange(ARM_CANDIDATES) % 4 == 0)[:, None]
    direction = np.where(outside, unit(elbow - 0.5 * hand), inwards)
    return np.where(outside, elbow, elbow + place * (hand - elbow)), rotate(direction, angle)


def _move_to_gap(rows: Float, links: Float, radii: tuple[float, ...], gap: Float) -> tuple[Float, Float]:
    """Move obstacles towards the nearest link of any posture until a gap is left.

    Args:
        rows: Obstacles, shape (N, C, 5), [m].
        links: End points of the links' axes, shape (N, postures, L, 2, D), [m].
        radii: Of the L links, [m].
        gap: Shape (N, C), [m].

    Returns:
        Moved obstacles, and their clearance before, shape (N, C), [m].
    """
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


def _distance_squared(segments: Float, rows: Float) -> Single:
    """Return `segment_distance_squared` in single precision, computed for a few scenes at a time."""
    rows = rows.astype(np.float32)
    parts = [slice(i, i + AT_ONCE) for i in range(0, len(rows), AT_ONCE)]
    return np.concatenate(
        [segment_distance_squared(segments[i, :, 0], segments[i, :, 1], rows[i]) for i in parts]
    )


def _shortest(segments: Float, rows: Float) -> Float:
    """Return shortest vectors from the axes of obstacles to segments that do not cross them, shape (N, C, D), [m].

    In the plane, a shortest vector begins or ends at an end point of the segment or of the axis.
    """
    # Not nearest_on_segments of the geometry: it differs in the last digit, and scenes of a seed would change.
    d = segments.shape[-1]
    low, high = rows[..., :d] - rows[..., d : 2 * d], rows[..., :d] + rows[..., d : 2 * d]
    first, second = segments[..., 0, :], segments[..., 1, :]
    vectors = np.stack(
        [
            first - _nearest_on(low, high, first),
            second - _nearest_on(low, high, second),
            _nearest_on(first, second, low) - low,
            _nearest_on(first, second, high) - high,
        ]
    )
    best = (vectors**2).sum(axis=-1).argmin(axis=0)
    return np.asarray(np.take_along_axis(vectors, best[None, ..., None], axis=0)[0])


def _nearest_on(first: Float, second: Float, point: Float) -> Float:
    """Return the point of a segment that is nearest to a point."""
    line = second - first
    square = np.maximum((line**2).sum(axis=-1), 1e-12)
    along = np.clip(((point - first) * line).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(first + along[..., None] * line)


def _evenly(times: int) -> Int:
    """Return indices of a path's times that are spaced about evenly along it: movements are slow at their ends."""
    progress = _minimum_jerk(np.linspace(0.0, 1.0, times))
    evenly = np.interp(np.linspace(0.0, 1.0, POSTURES), progress, np.arange(times))
    return np.unique(np.round(evenly).astype(np.int64))


def _minimum_jerk(phases: Float) -> Float:
    """Return the progress of the straight minimum-jerk movement, from 0 to 1."""
    return phases**3 * (10.0 - 15.0 * phases + 6.0 * phases**2)
