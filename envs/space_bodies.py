"""The space that an arm sweeps, as scenes are drawn around it: quick, and no more exact than that needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs._arrays import squared_length
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

    def clearance(
        self,
        rows: Float,
        most: float,
        margin: Float | float = 0.0,
        *,
        floor: float = -np.inf,
        together: int = 1,
    ) -> Float:
        """Least clearance over time from each of n obstacles, or from those that belong together, less a margin.

        A link is at least as far away as the ball around it. Only balls that come near enough to matter are looked
        into, so narrow bounds are quick.

        Args:
            rows: Obstacles, shape (N, n, 7), [m]; those without a radius are none, and as far away as `most`.
            most: Greatest number that matters, [m].
            margin: To subtract at each time, shape (T,), or at all of them, [m].
            floor: Below it one number is as good as another, [m].
            together: How many rows belong together.

        Returns:
            Shape (N, n / together), [m]; no more than `most`.
        """
        least, radii = np.full((len(rows), rows.shape[1] // together), most), rows[..., -1]
        if not len(self.radii) or not (radii > 0.0).any():
            return least
        margins = np.broadcast_to(margin, self.ends.shape[1:2]).repeat(len(self.radii))
        bound = ball_bounds(*self._balls(margins), rows)
        bound -= np.where(radii > 0.0, radii, -np.inf).astype(np.float32)[..., None]
        places = bound.shape[-1]
        bound = bound.reshape(*least.shape, together * places)
        nearest = bound.argmin(axis=-1)
        scene, one = np.nonzero(np.take_along_axis(bound, nearest[..., None], axis=-1)[..., 0] < most)

        def look(scene: Index, one: Index, ball: Index) -> None:
            row, ball = together * one + ball // places, ball % places
            clearance = self._between(rows[scene, row], scene, ball) - margins[ball]
            np.minimum.at(least, (scene, one), clearance)

        look(scene, one, nearest[scene, one])
        open_ = least[scene, one] >= floor
        scene, one = scene[open_], one[open_]
        nearer = bound[scene, one] < least[scene, one, None].astype(np.float32)
        nearer[np.arange(len(one)), nearest[scene, one]] = False
        which, ball = np.nonzero(nearer)
        look(scene[which], one[which], ball)
        return least

    def every_other(self) -> Bodies:
        """The same at every other time."""
        return Bodies(self.ends[:, ::2], self.radii)

    def _balls(self, margins: Float) -> tuple[Single, Single]:
        """Around the links at all times: centres, shape (N, 3, T B), and radii with a margin, shape (T B,), [m]."""
        first, second = self.ends[..., 0, :], self.ends[..., 1, :]
        link, centre = second - first, np.moveaxis(np.float32(0.5) * (first + second), -1, 1)
        half = 0.5 * np.sqrt(squared_length(link).max(axis=(0, 1)))
        around = np.tile(half + np.array(self.radii) + ROUNDING, self.ends.shape[1]) + margins
        return centre.reshape(len(centre), 3, -1), around.astype(np.float32)

    def _between(self, obstacles: Float, scene: Index, ball: Index) -> Float:
        """Clearance of obstacles, shape (M, 7), each from one link at one time, shape (M,), [m]."""
        body = ball % len(self.radii)
        ends = self.ends[scene, ball // len(self.radii), body][:, :, None]
        squared = segment_distance_squared(ends[:, 0], ends[:, 1], obstacles[:, None].astype(np.float32))
        distance = np.sqrt(squared[:, 0, 0]) - np.array(self.radii, np.float32)[body]
        return np.asarray(distance.astype(np.float64) - obstacles[:, -1])


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
        apart = np.sqrt(squared_length(ends[..., :2] - place[:, :, None, None, :2]))
        high = ends[..., 2] + np.array(self.outer.radii, np.float32)[:, None]
        return np.asarray(np.where(apart < ABOVE, high, place[:, :, None, None, 2]).max(axis=(-2, -1)))

    def take(self, rows: NDArray[np.int64]) -> Swept:
        """The movements at `rows`."""
        return Swept(*(Bodies(bodies.ends[rows], bodies.radii) for bodies in self))
