"""Where the links of an arm in space come nearest to the obstacles: searched for coarsely, then looked at closely.

The nearest pair of link and obstacle is searched for in the middle of each stretch, with all links, in single precision
and in pieces that fit a cache. Where it is close, the pair is looked at more often than the path has instants, its
link's places interpolated between the stretches' middles: links run smoothly, so a cubic errs by less than a tenth of
a millimetre.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.clearance import FAR, segment_distance_squared

Float = NDArray[np.float32]
Index = NDArray[np.int64]

CLOSE = 0.1
"""Clearance from which on a coarse look is enough, [m]: no feature tells more."""
PIECE = 8192
"""Instants that are dealt with together."""
POINT = 1e-4
"""The hand is a link of that length, as a link must have one, [m]."""
STEP = 1e-3
"""Of the difference quotient that tells where an obstacle pushes, [m]."""
FINER = 4
"""How much closer together the close looks are than the instants of a path."""
NODES = 4
"""Of the interpolation."""


class Approaches(NamedTuple):
    """Nearest approaches of H movements in each of B scenes, one in each of S stretches."""

    clearance: Float
    """Lowest in the stretch, shape (B, H, S), [m]."""
    gradient: Float
    """Of the clearance, by the hand's place; zero where it is no less than asked for, shape (B, H, S, 3)."""


class Obstacles(NamedTuple):
    """Obstacles of B scenes, those that are present first, and how many these are."""

    rows: Float
    """Shape (B, n, 7), [m]."""
    number: Index
    """Shape (B,)."""
    velocity: Float
    """Shape (B, n, 3), [m/s]."""

    @classmethod
    def packed(cls, rows: Float, present: NDArray[np.bool_], velocity: Float | None = None) -> Obstacles:
        """From rows in any order; without velocities they stand."""
        order = np.argsort(~present, axis=-1, kind="stable")[..., None]
        speed = np.zeros_like(rows[..., :3]) if velocity is None else velocity
        ordered = (np.take_along_axis(part, order, axis=1) for part in (rows, speed))
        return cls(next(ordered), present.sum(axis=-1), next(ordered))


class Pairs(NamedTuple):
    """M links, each with the obstacle that is nearest to it, in the middle of a stretch of a movement."""

    where: tuple[Index, Index, Index]
    """Scene, movement and stretch."""
    link: Index
    """Shape (M,); the last one is the hand."""
    obstacle: Float
    """Shape (M, 1, 7), [m]."""
    radius: Float
    """Of both together, shape (M, 1), [m]."""
    drift: Float
    """How far the obstacle moves during the movement, shape (M, 1, 1, 3), [m]."""


def approaches(
    arm: Arm,
    hand: Float,
    obstacles: Obstacles,
    stretches: int,
    within: float,
    duration: Float | None = None,
) -> Approaches:
    """The nearest approach in each stretch.

    Args:
        arm: Whose links must clear.
        hand: Paths, shape (B, H, T, 3), [m].
        obstacles: Of the B scenes.
        stretches: S, of T / S instants each.
        within: Clearance below which the gradient is wanted, [m]; minus infinity for none.
        duration: Of the movements, shape (B, H), [s]; where no obstacle moves it need not be known.
    """
    duration = np.zeros(hand.shape[:2], np.float32) if duration is None else duration
    shape = (*hand.shape[:2], stretches)
    found = Approaches(np.full(shape, FAR, np.float32), np.zeros((*shape, 3), np.float32))
    order = np.argsort(-obstacles.number, kind="stable")
    piece = max(1, PIECE // (hand.shape[1] * stretches))
    for first in range(0, int((obstacles.number > 0).sum()), piece):
        some = order[first : first + piece]
        most = obstacles.number[some[0]]
        rows, velocity = obstacles.rows[some, :most], obstacles.velocity[some, :most]
        present = np.arange(most) < obstacles.number[some, None]
        drift = velocity[:, None] * duration[some][:, :, None, None]
        search = _Search(arm, hand[some], rows, present, drift, stretches)
        found.clearance[some], found.gradient[some] = search.result(within)
    return found


class _Search:
    """A few scenes with about equally many obstacles."""

    def __init__(
        self, arm: Arm, hand: Float, rows: Float, present: Any, drift: Float, stretches: int
    ) -> None:
        """With how far each obstacle moves during each movement, shape (B, H, n, 3), [m]."""
        self._arm, self._hand, self._rows, self._present = arm, hand, rows, present
        self._drift = drift if drift.any() else None
        self._radii = np.array((*arm.link_radii, arm.hand_radius), dtype=np.float32)
        self._looks = hand.shape[2] // stretches
        self._links = _links(arm, hand[:, :, self._looks // 2 :: self._looks])

    def result(self, within: float) -> Approaches:
        """See :func:`approaches`."""
        least, pairs = self._coarsely()
        gradient = np.zeros((*least.shape, 3), np.float32)
        if len(pairs.link):
            least[pairs.where], look = self._closely(pairs)
            near = np.flatnonzero(least[pairs.where] < within)
            if len(near):
                some = Pairs(*(_taken(part, near) for part in pairs))
                gradient[some.where] = self._gradient(some, look[near])
        return Approaches(least, gradient)

    def _coarsely(self) -> tuple[Float, Pairs]:
        """Clearance in the middle of each stretch, and the nearest pairs where it is small."""
        links, shape = self._links, self._links.shape[:3]
        flat = links.reshape(shape[0], -1, *links.shape[3:])
        by_link, by_obstacle = [], np.full((*self._rows.shape[:2], flat.shape[1]), FAR, np.float32)
        gone = np.where(self._present, self._rows[..., -1], -2.0 * FAR)[..., None]
        drift = None
        if self._drift is not None:
            middles = _middles(shape[2], self._looks)[:, None]
            drift = (self._drift.swapaxes(1, 2)[..., None, :] * middles).reshape(*by_obstacle.shape, 3)
        for index, radius in enumerate(self._radii):
            squared = segment_distance_squared(flat[:, :, index, 0], flat[:, :, index, 1], self._rows, drift)
            clearance = np.sqrt(squared) - (gone + radius)
            by_link.append(clearance.min(axis=1))
            np.minimum(by_obstacle, clearance, out=by_obstacle)
        least = np.minimum(by_obstacle.min(axis=1), FAR)
        scene, instant = np.nonzero(least < CLOSE)
        link = np.stack([each[scene, instant] for each in by_link]).argmin(axis=0)
        which = by_obstacle[scene, :, instant].argmin(axis=-1)
        obstacle, (movement, stretch) = self._rows[scene, which], np.divmod(instant, shape[2])
        radius = obstacle[:, -1:] + self._radii[link, None]
        moved = np.zeros((len(scene), 3), np.float32)
        if self._drift is not None:
            moved = self._drift[scene, movement, which]
        pairs = Pairs((scene, movement, stretch), link, obstacle[:, None], radius, moved[:, None, None])
        return least.reshape(shape), pairs

    def _closely(self, pairs: Pairs) -> tuple[Float, Index]:
        """Lowest clearance of each pair in its stretch, and at which look it is about lowest, shape (M,) each."""
        scene, movement, stretch = pairs.where
        first, weights, instants = _interpolation(self._links.shape[2], self._looks)
        nodes = first[stretch, None] + np.arange(NODES)
        ends = self._links[scene[:, None], movement[:, None], nodes, pairs.link[:, None]]
        ends = (weights[stretch] @ ends.reshape(len(ends), NODES, 6)).reshape(len(ends), -1, 2, 3)
        drift = pairs.drift * instants[stretch, None, :, None]
        squared = segment_distance_squared(ends[:, :, 0], ends[:, :, 1], pairs.obstacle, drift)[:, 0]
        clearance, each = np.sqrt(squared) - pairs.radius, np.arange(len(ends))
        at = clearance[:, 1:-1].argmin(axis=-1)
        before, middle, after = (clearance[each, at + i] for i in range(3))
        slope, curvature = 0.5 * (after - before), after - 2.0 * middle + before
        between = curvature > np.abs(slope)
        drop = 0.5 * slope * slope / np.where(between, curvature, 1.0)
        look = np.maximum(stretch * self._looks + (at + FINER // 2) // FINER - 1, 0)
        return np.where(between, middle - drop, middle), look

    def _gradient(self, pairs: Pairs, look: Index) -> Float:
        """Of each pair's clearance at a look, by the hand's place, shape (M, 3)."""
        scene, movement, _ = pairs.where
        moves = np.concatenate((np.zeros((1, 3)), STEP * np.eye(3))).astype(np.float32)
        links = _links(self._arm, self._hand[scene, movement, look] + moves[:, None])
        ends = links[:, np.arange(len(look)), pairs.link].swapaxes(0, 1)
        drift = pairs.drift * ((look + 1.0) / self._hand.shape[2]).astype(np.float32)[:, None, None, None]
        squared = segment_distance_squared(ends[:, :, 0], ends[:, :, 1], pairs.obstacle, drift)[:, 0]
        distance = np.sqrt(squared)
        return np.asarray((distance[:, 1:] - distance[:, :1]) / np.float32(STEP))


def _links(arm: Arm, hand: Float) -> Float:
    """End points of the links' axes, the hand the last of them, shape (..., L + 1, 2, 3), [m]."""
    links, place = np.asarray(arm.links(arm.posture(hand))), np.moveaxis(hand, -1, 0)
    parts = np.empty(
        (links.shape[-3] + 1, 2, 3, *hand.shape[:-1]), dtype=np.float32
    )  # components apart in memory
    parts[:-1] = np.moveaxis(links, (-3, -2, -1), (0, 1, 2))
    parts[-1] = place
    parts[-1, 1, 2] += POINT
    return np.moveaxis(parts, (0, 1, 2), (-3, -2, -1))


@functools.cache
def _interpolation(stretches: int, looks: int) -> tuple[Index, Float, Float]:
    """From values in the middles of stretches to those at close looks from each one's beginning to its end.

    Returns:
        The first of the middles that each stretch is computed from, shape (S,), and their weights by Lagrange's
        formula, shape (S, FINER looks + 1, NODES), and which part of the movement is over at each look.
    """
    stretch = np.arange(stretches)
    first = np.clip(stretch - 1, 0, stretches - NODES)
    close = np.arange(-FINER, FINER * (looks - 1) + 1) / FINER
    times = np.clip(looks * stretch[:, None] + close, 0, looks * stretches - 1)
    middles = (looks * (first[:, None] + np.arange(NODES)) + looks // 2)[:, None]
    others = np.array([[j for j in range(NODES) if j != i] for i in range(NODES)])
    apart = middles[..., None] - middles[..., others]
    weights = ((times[..., None, None] - middles[..., others]) / apart).prod(axis=-1)
    return first, weights.astype(np.float32), ((times + 1.0) / (looks * stretches)).astype(np.float32)


def _middles(stretches: int, looks: int) -> Float:
    """Which part of a movement is over in the middle of each stretch, shape (S,)."""
    return ((looks * np.arange(stretches) + looks // 2 + 1.0) / (looks * stretches)).astype(np.float32)


def _taken(part: Any, rows: Index) -> Any:
    return tuple(each[rows] for each in part) if isinstance(part, tuple) else part[rows]
