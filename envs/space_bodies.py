"""The space that an arm sweeps, as scenes are drawn around it: quick, and no more exact than that needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.clearance import segment_distance_squared
from viapoint.envs.nearness import Single, ball_bounds

Float = NDArray[np.float64]
Index = NDArray[np.int64]

OUTER = 5
"""Links next to the hand: what is drawn near it concerns them first, and only what is chosen concerns the others."""
LENGTH = 1e-4
"""A hand alone is a link of that length, as a link must have one, [m]."""
ABOVE = 0.06
"""How far sideways what is above the hand may be, [m]."""
ROUNDING = 1e-4
"""More than what rounding adds to a distance, [m]."""


class Bodies(NamedTuple):
    """Some links of an arm at T times of N movements."""

    ends: Single
    """Of their axes, shape (N, T, B, 2, 3), [m]."""
    radii: tuple[float, ...]
    """Of the B links, [m]."""

    def clearance(self, rows: Float, most: float, margin: Float | float = 0.0) -> Float:
        """Least clearance from each of n obstacles over time, less a margin, shape (N, n), [m]; no more than `most`.

        A link is at least as far away as the ball around it. Only balls that come near enough to matter are looked
        into, so a smaller `most` is quicker.

        Args:
            rows: Obstacles, shape (N, n, 7), [m]; those without a radius are none, and as far away as `most`.
            most: Greatest number that matters, [m].
            margin: To subtract at each time, shape (T,), or at all of them, [m].
        """
        least, present = np.full(rows.shape[:2], most), rows[..., -1] > 0.0
        if not len(self.radii) or not present.any():
            return least
        margins = np.broadcast_to(margin, self.ends.shape[1:2]).repeat(len(self.radii))
        bound = ball_bounds(*self._balls(margins), rows)
        nearest = bound.argmin(axis=-1)
        lowest = np.take_along_axis(bound, nearest[..., None], axis=-1)[..., 0]
        scene, row = np.nonzero(present & (lowest < most + rows[..., -1]))
        first = nearest[scene, row]
        self._look(least, rows, (scene, row), first, margins)
        nearer = bound[scene, row] < (least + rows[..., -1])[scene, row, None]
        nearer[np.arange(len(first)), first] = False
        which, ball = np.nonzero(nearer)
        self._look(least, rows, (scene[which], row[which]), ball, margins)
        return least

    def every_other(self) -> Bodies:
        """The same at every other time."""
        return Bodies(self.ends[:, ::2], self.radii)

    def _balls(self, margins: Float) -> tuple[Single, Single]:
        """Around the links at all times: centres, shape (N, 3, T B), and radii with a margin, shape (T B,), [m]."""
        first, second = self.ends[..., 0, :], self.ends[..., 1, :]
        link, centre = second - first, np.moveaxis(np.float32(0.5) * (first + second), -1, 1)
        half = 0.5 * np.sqrt((link * link).sum(axis=-1).max(axis=(0, 1)))
        around = np.tile(half + np.array(self.radii) + ROUNDING, self.ends.shape[1]) + margins
        return centre.reshape(len(centre), 3, -1), around.astype(np.float32)

    def _look(
        self, least: Float, rows: Float, which: tuple[Index, Index], ball: Index, margins: Float
    ) -> None:
        """Lessen what some obstacles, one after the other, have to the links in balls."""
        obstacles, body = rows[which], ball % len(self.radii)
        ends = self.ends[which[0], ball // len(self.radii), body][:, :, None]
        squared = segment_distance_squared(ends[:, 0], ends[:, 1], obstacles[:, None].astype(np.float32))
        distance = np.sqrt(squared[:, 0, 0]) - np.array(self.radii, np.float32)[body]
        np.minimum.at(least, which, distance.astype(np.float64) - obstacles[:, -1] - margins[ball])


class Swept(NamedTuple):
    """Where an arm is on N movements, the links near its hand and the others."""

    outer: Bodies
    inner: Bodies

    @classmethod
    def of(cls, arm: Arm, hand: Float, *, whole_arm: bool) -> Swept:
        """Of an arm, or its hand alone, whose hand takes paths of shape (N, T, 3), [m]."""
        if whole_arm:
            links = np.asarray(arm.links(arm.posture(hand))).astype(np.float32)
            radii = arm.link_radii
        else:
            links = np.stack((hand, hand + np.array([0.0, 0.0, LENGTH])), axis=-2)[:, :, None].astype(
                np.float32
            )
            radii = (arm.hand_radius,)
        first = max(len(radii) - OUTER, 0)
        return cls(Bodies(links[:, :, first:], radii[first:]), Bodies(links[:, :, :first], radii[:first]))

    def top(self, phase: NDArray[np.int64], place: Float) -> Float:
        """Height of what of the links near the hand stands above it, at K times of each movement.

        Args:
            phase: Index of the times, shape (N, K).
            place: The hand then, shape (N, K, 3), [m].

        Returns:
            Shape (N, K), [m].
        """
        ends = self.outer.ends[np.arange(len(phase))[:, None], phase]
        apart = np.sqrt(((ends[..., :2] - place[:, :, None, None, :2]) ** 2).sum(axis=-1))
        high = ends[..., 2] + np.array(self.outer.radii, np.float32)[:, None]
        return np.asarray(np.where(apart < ABOVE, high, place[:, :, None, None, 2]).max(axis=(-2, -1)))

    def take(self, rows: NDArray[np.int64]) -> Swept:
        """The movements at `rows`."""
        return Swept(*(Bodies(bodies.ends[rows], bodies.radii) for bodies in self))
