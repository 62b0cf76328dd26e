"""The space that an arm sweeps, as scenes are drawn around it: quick, and no more exact than that needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.clearance import segment_distance_squared

Float = NDArray[np.float64]

CHUNK = 32
"""Scenes that are looked at together: few enough for the cache."""
OUTER = 5
"""Links next to the hand: what is drawn near it concerns them first, and only what is chosen concerns the others."""
LENGTH = 1e-4
"""A hand alone is a link of that length, as a link must have one, [m]."""
ABOVE = 0.06
"""How far sideways what is above the hand may be, [m]."""


class Bodies(NamedTuple):
    """Some links of an arm at T times of N movements."""

    ends: NDArray[np.float32]
    """Of their axes, shape (N, T, B, 2, 3), [m]."""
    radii: tuple[float, ...]
    """Of the B links, [m]."""

    def clearance(self, rows: Float) -> Float:
        """From each of n obstacles at each time, shape (N, n, T), [m]."""
        obstacles = rows.astype(np.float32)
        least = np.empty((len(rows), rows.shape[1], self.ends.shape[1]))
        for first in range(0, len(rows), CHUNK):
            some = slice(first, first + CHUNK)
            each = [
                np.sqrt(
                    segment_distance_squared(
                        self.ends[some, :, body, 0], self.ends[some, :, body, 1], obstacles[some]
                    )
                )
                - np.float32(radius)
                for body, radius in enumerate(self.radii)
            ]
            least[some] = np.minimum.reduce(each)
        return np.asarray(least - rows[..., None, -1])

    def every_other(self) -> Bodies:
        """The same at every other time."""
        return Bodies(self.ends[:, ::2], self.radii)


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
