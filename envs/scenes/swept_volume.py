"""Swept volume of an arm, in single precision: clearance of obstacles that are drawn around it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Bool, Float, Index, Int, Single
from viapoint.envs.geometry.broad_phase import HalfLinks, ball_bounds, lift_quadratic
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.geometry.narrow_phase import branch_and_bound
from viapoint.envs.geometry.rows import has_shapes, pair_distance

OUTER = 3
"""Joints next to the hand, whose links obstacles near its path touch first; only chosen obstacles are compared with
others."""
LENGTH = 1e-4
"""Length of the link that stands for a hand alone, [m]: a link must have a length."""
ABOVE = 0.06
"""Greatest horizontal distance of links that count as above the hand, [m]."""
HIT_STEP, HIT_DEPTH = 3, 1e-3
"""Steps between the times at which ends of links are looked at, and depth above the rounding errors, [m]."""
SIZE_ROUNDING = 1e-4
"""Upper bound of the rounding error of a distance, [m]."""


class LinkBodies(NamedTuple):
    """B links of an arm at T times of N movements."""

    ends: Single
    """End points of the links' axes, components apart in memory, shape (2, 3, N, B, T), [m]."""
    balls: Single
    """Centres of balls around the links, lifted by :func:`lift_quadratic`, shape (N, 5, B, T)."""
    around: Single
    """Radii of the balls, shape (B,), [m]."""
    radii: Single
    """Radii of the links, shape (B,), [m]."""

    @classmethod
    def of(cls, ends: Single, radii: tuple[float, ...]) -> LinkBodies:
        """Return links of end points, shape (2, 3, N, B, T), [m], and radii, [m]."""
        links, size = np.ascontiguousarray(ends), np.array(radii, np.float32)
        balls = lift_quadratic(np.moveaxis(np.float32(0.5) * (links[0] + links[1]), 0, 1))
        half = 0.5 * np.sqrt(np.add.reduce(np.square(links[1] - links[0])).max(axis=(0, 2), initial=0.0))
        return cls(links, balls, half + size + np.float32(SIZE_ROUNDING), size)

    def clearance(
        self,
        rows: Float,
        most: float,
        margin: Float | float = 0.0,
        *,
        floor: float = -np.inf,
        together: int = 1,
    ) -> Float:
        """Return the least clearance over time from each obstacle, or group of obstacles, less a margin.

        Broad phase: the ball around a link bounds its clearance from below. Narrow phase: exact distances by
        :func:`~viapoint.envs.geometry.narrow_phase.branch_and_bound`.

        Args:
            rows: Obstacles of either kind, shape (N, n, .), [m]; absent ones, without a radius, are as far as `most`.
            most: Upper limit of the result, [m]; a low one saves time.
            margin: Margin at each time, shape (T,), or at all times, [m].
            floor: Value below which the result need not be exact, [m].
            together: Rows of a group.

        Returns:
            Shape (N, n / together), [m]; no more than `most`.
        """
        shape, places = (len(rows), rows.shape[1] // together), math.prod(self.balls.shape[2:])
        least = np.full(math.prod(shape), most)
        if not places or not (rows[..., -1] > 0.0).any():
            return least.reshape(shape)
        margins = np.zeros(self.balls.shape[2:]) + margin
        around = (self.around[:, None] + margins).astype(np.float32).reshape(-1)
        size = (self.radii[:, None] + margins).astype(np.float32).reshape(-1)
        links = HalfLinks(self._half_axes(), size) if has_shapes(rows) else None
        bound = ball_bounds(self.balls.reshape(len(rows), 5, -1), around, rows, links).reshape(len(least), -1)

        def exact(one: Index, ball: Index) -> Float:
            row, ball = np.divmod(one * bound.shape[-1] + ball, places)
            return np.asarray(self._between(rows, row, ball) - margins.reshape(-1)[ball])

        branch_and_bound(bound, least, exact, floor)
        return least.reshape(shape)

    def hits(self, rows: Float, margin: Float) -> Bool:
        """Return which obstacles certainly come closer than a margin to a link, shape (N, n).

        A test without exact distances: spheres around one end of each link are compared, at some of the times.

        Args:
            rows: Capsules and boxes, shape (N, n, .), [m]; the bounds of other shapes are not close enough.
            margin: Margin at each time, shape (T,), [m].
        """
        places = np.moveaxis(self.ends[1, ..., ::HIT_STEP], 0, 1)
        around = (self.radii[:, None] + margin[::HIT_STEP]).astype(np.float32).reshape(-1)
        bounds = ball_bounds(lift_quadratic(places).reshape(len(rows), 5, -1), around, rows)
        return np.asarray((bounds < -HIT_DEPTH).any(axis=-1))

    def every_other(self) -> LinkBodies:
        """Return the links at every other time."""
        return self._replace(ends=self.ends[..., ::2], balls=self.balls[..., ::2])

    def take(self, movements: Int) -> LinkBodies:
        """Return some of the movements."""
        return self._replace(ends=self.ends[:, :, movements], balls=self.balls[movements])

    def _half_axes(self) -> Single:
        """Return halves of the links' axes, shape (N, 3, B * T), [m]."""
        half = np.float32(0.5) * (self.ends[1] - self.ends[0])
        return np.asarray(np.moveaxis(half, 1, 0).reshape(half.shape[1], 3, -1))

    def _between(self, rows: Float, row: Index, ball: Index) -> Float:
        """Return clearances, shape (M,), [m], of pairs of an obstacle and a link at one time."""
        links, times = self.balls.shape[2:]
        ends = self.ends.reshape(6, -1).take(row // rows.shape[1] * (links * times) + ball, axis=1)
        obstacles = rows.reshape(-1, rows.shape[-1]).take(row, axis=0)
        if has_shapes(rows):
            return np.asarray(pair_distance(obstacles, ends[:3].T, ends[3:].T) - self.radii[ball // times])
        # Components apart in memory, which are mostly read one after the other.
        first, second = ends[:3].T[:, None], ends[3:].T[:, None]
        squared = segment_distance_squared(first, second, obstacles.astype(np.float32, order="F")[:, None])
        distance = np.sqrt(squared[:, 0, 0]) - self.radii[ball // times]
        return np.asarray(distance.astype(np.float64) - obstacles[:, -1])


class SweptVolume(NamedTuple):
    """Links of an arm on N movements: those near its hand (outer) and the others (inner)."""

    outer: LinkBodies
    inner: LinkBodies

    @classmethod
    def of(cls, collision_model: CollisionModel, hand: Float) -> SweptVolume:
        """Return the swept volume of an arm, or of its hand alone, on paths of the hand, shape (N, T, 3), [m]."""
        arm = collision_model.arm
        if collision_model.whole_arm:
            links, radii = np.asarray(arm.links(arm.inverse_kinematics(hand))), arm.link_radii
            first = sum(joint <= arm.link_joints[-1] - OUTER for joint in arm.link_joints)
        else:
            links = np.stack((hand, hand + np.array([0.0, 0.0, LENGTH])), axis=-2)[:, :, None]
            radii, first = (arm.hand_radius,), 0
        ends = links.astype(np.float32).transpose(3, 4, 0, 2, 1)
        return cls(
            *(LinkBodies.of(ends[..., some, :], radii[some]) for some in (slice(first, None), slice(first)))
        )

    def top(self, phase: Int, place: Float) -> Float:
        """Return the height of the links above the hand at `place` at the times of index `phase`, shape (N, K), [m]."""
        there = self.outer.ends[:, :, np.arange(len(phase))[:, None], :, phase]
        x, y, z = (place[:, :, i, None, None] for i in range(3))
        apart = np.sqrt(np.square(there[..., 0, :] - x) + np.square(there[..., 1, :] - y))
        high = there[..., 2, :] + self.outer.radii
        return np.asarray(np.where(apart < ABOVE, high, z).max(axis=(-2, -1)))

    def take(self, movements: Int) -> SweptVolume:
        """Return some of the movements."""
        return SweptVolume(*(bodies.take(movements) for bodies in self))
