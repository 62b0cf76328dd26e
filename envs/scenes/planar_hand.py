"""Posts and bars at hand level, placed about the straight line and beside the witness."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import hand_clearance, segment_distance_squared
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.planar_draws import PHASES, FeasiblePath, Uniforms, between, left, unit

CANDIDATES, WAYS = 32, 15
"""How many obstacles are drawn at once, and how many ways round are told apart."""
IN_THE_WAY = 0.004
"""How deep the straight line cuts into an obstacle that is in the way, [m]."""


class ObstacleSampler(Protocol):
    """Puts obstacles into scenes."""

    @property
    def rows(self) -> int:
        """Obstacles of a scene at most."""

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""

    def __call__(self, uniforms: Uniforms, witness: FeasiblePath) -> tuple[Float, NDArray[np.bool_]]:
        """Rows of obstacles clear of the witness, shape (N, rows, 2 D + 1), and which scenes are good."""


class HandObstacles:
    """Obstacles that the hand alone must clear."""

    def __init__(self, arm: Arm, distribution: SceneDistribution) -> None:
        self._arm, self._distribution = arm, distribution
        self._ways = _ways_round(ActionLayout(dimension=arm.dimension), float(np.mean(distribution.distance)))

    @property
    def rows(self) -> int:
        """Obstacles of a scene at most."""
        return self._distribution.n_obstacles[1]

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        return 7 * CANDIDATES + 2 + self.rows

    def __call__(self, uniforms: Uniforms, witness: FeasiblePath) -> tuple[Float, NDArray[np.bool_]]:
        """See :class:`ObstacleSampler`."""
        hardness = uniforms.take(1) ** self._distribution.ease
        rows = self._candidates(uniforms, witness, hardness)
        choice = Choice(
            rows,
            self._free(witness, rows),
            in_the_way(witness, rows, self._arm.hand_radius),
            self._ways_closed(witness, rows),
        )
        return choose(uniforms, choice, hardness, self._distribution.n_obstacles)

    def _candidates(self, uniforms: Uniforms, witness: FeasiblePath, hardness: Float) -> Float:
        """Posts and bars, shape (N, CANDIDATES, 5): a half about the straight line, a half beside the witness."""
        d, (start, goal, path) = self._distribution, witness
        along = (goal - start)[:, None] / np.sqrt(((goal - start) ** 2).sum(axis=-1))[:, None, None]
        fraction, offset = uniforms.take(CANDIDATES), 2.0 * uniforms.take(CANDIDATES) - 1.0
        half, radius, tilt = shapes(uniforms, d, CANDIDATES)
        beside = np.arange(CANDIDATES) % 2 == 1
        foot, tangent = on_path(path, fraction)
        direction = np.where(beside[:, None], tangent, along)
        normal = left(direction)
        axis = half[..., None] * (normal * np.cos(tilt)[..., None] + direction * np.sin(tilt)[..., None])
        gap = d.witness_margin + 0.002 + 0.08 * np.abs(offset) * (1.0 - hardness)
        away = np.copysign(half + radius + self._arm.hand_radius + gap, offset)
        line = start[:, None] + (goal - start)[:, None] * fraction[..., None]
        foot = np.where(beside[:, None], foot, line)
        centre = foot + normal * np.where(beside, away, d.spread * offset)[..., None]
        return np.concatenate((centre, axis, radius[..., None]), axis=-1)

    def _free(self, witness: FeasiblePath, rows: Float) -> NDArray[np.bool_]:
        """Which candidates leave room for the witness, and for the hand at its ends, shape (N, CANDIDATES)."""
        d, radius = self._distribution, self._arm.hand_radius
        present = np.ones(rows.shape[:-1], dtype=bool)
        ends = np.stack((witness.start, witness.goal), axis=1)
        free = hand_clearance(witness.path, radius, rows, present) > d.witness_margin
        return np.asarray(free & (hand_clearance(ends, radius, rows, present) > d.end_margin))

    def _ways_closed(self, witness: FeasiblePath, rows: Float) -> NDArray[np.bool_]:
        """Which ways round each candidate closes, shape (N, CANDIDATES, ways): an estimate that steers difficulty."""
        start, goal = witness.start[:, None], witness.goal[:, None]
        along, length = unit(goal - start), np.sqrt(((goal - start) ** 2).sum(axis=-1))
        across = left(along)
        centre, axis, radius = rows[..., :2] - start, rows[..., 2:4], rows[..., 4]
        fraction = np.clip((centre * along).sum(axis=-1) / length, 0.0, 1.0)
        ways = self._ways[np.round(fraction * (len(self._ways) - 1)).astype(np.int64)]
        lateral = (centre * across).sum(axis=-1)[..., None]
        reach = np.abs((axis * across).sum(axis=-1)) + radius + self._arm.hand_radius
        return np.asarray(np.abs(ways - lateral.astype(np.float32)) < reach[..., None].astype(np.float32))


class Choice(NamedTuple):
    """Candidates for the obstacles of N scenes."""

    rows: Float
    """Shape (N, C, 2 D + 1), [m]."""
    free: NDArray[np.bool_]
    """Which leave room for the witness, shape (N, C)."""
    in_the_way: NDArray[np.bool_]
    """Which the straight movement hits, shape (N, C)."""
    closed: NDArray[np.bool_]
    """Which ways round each closes, shape (N, C, ways)."""


def choose(
    uniforms: Uniforms, choice: Choice, hardness: Float, n_obstacles: tuple[int, int]
) -> tuple[Float, NDArray[np.bool_]]:
    """Obstacles among the free candidates, in random rows, the first of them in the way of the straight movement.

    One after the other is chosen; hardness moves the choice from any candidate to the one that closes most of the
    ways round that are still open.

    Args:
        uniforms: C + 1 numbers are taken, and one for each row.
        choice: To choose from.
        hardness: From 0 to 1, shape (N, 1).
        n_obstacles: Fewest and most.

    Returns:
        Shape (N, most, 2 D + 1), and which scenes are good.
    """
    rows, free, in_way, closed = choice
    fewest, most = n_obstacles
    number = rows.shape[1]
    count = fewest + np.floor((most - fewest + 1) * uniforms.take(1))
    chance = uniforms.take(number)
    shuffled = uniforms.take(most).argsort(axis=-1, kind="stable")
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
    return np.take_along_axis(chosen, shuffled[..., None], axis=1), enough


def in_the_way(witness: FeasiblePath, rows: Float, hand_radius: float) -> NDArray[np.bool_]:
    """Which obstacles the straight movement hits, shape (N, C)."""
    squared = segment_distance_squared(witness.start[:, None], witness.goal[:, None], rows)[..., 0]
    return np.asarray(np.sqrt(squared) - rows[..., -1] - hand_radius < -IN_THE_WAY)


def shapes(uniforms: Uniforms, d: SceneDistribution, count: int) -> tuple[Float, Float, Float]:
    """Half lengths [m], radii [m] and tilts [rad] of posts and bars, half of each, shape (N, count) each."""
    bar = uniforms.take(count) < 0.5
    tilt = d.bar_tilt * (2.0 * uniforms.take(count) - 1.0)
    half = np.where(bar, between(d.bar_half_length, uniforms.take(count)), 0.0)
    size = uniforms.take(count)
    return half, np.where(bar, between(d.bar_radius, size), between(d.post_radius, size)), tilt


def on_path(path: Float, fraction: Float) -> tuple[Float, Float]:
    """Places on the middle part of N paths and the directions there, shape (N, C, D) each.

    Args:
        path: Shape (N, PHASES, D), [m].
        fraction: From 0 to 1, shape (N, C).
    """
    phase = (0.15 * PHASES + 0.7 * PHASES * fraction).astype(np.int64)
    each = np.arange(len(path))[:, None]
    return path[each, phase], unit(path[each, phase + 1] - path[each, phase - 1])


def _ways_round(layout: ActionLayout, distance: float) -> NDArray[np.float32]:
    """How far movements through one via-point are from the straight line, at 21 places along it: (21, ways), [m]."""
    along, across = (g.ravel() for g in np.meshgrid((-0.7, 0.0, 0.7), np.linspace(-1.0, 1.0, WAYS)))
    action = np.zeros((len(along), layout.size))
    action[:, 0], action[:, 1] = along, across
    start = np.zeros((len(along), layout.dimension))
    goal = start.copy()
    goal[:, 0] = distance
    plan = layout.decode(action, start, goal)
    path = plan.trajectory()(plan.durations.sum(axis=-1)[:, None] * np.linspace(0.0, 1.0, 200))
    places = np.linspace(0.0, distance, 21)
    return np.stack([np.interp(places, way[:, 0], way[:, 1]) for way in path], axis=-1).astype(np.float32)
