"""Interface of arms, and the collision model that environments, scenes and planners check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np

from viapoint.envs.common.types import Array, Bool, Box, Float
from viapoint.envs.geometry.distance import MAX_CLEARANCE, arm_clearance, hand_clearance
from viapoint.envs.geometry.narrow_phase import ends_of, nearest_approach


class Arm(Protocol):
    """Arm: its size and reach, forward and inverse kinematics, and the controls that track a movement.

    The functions are batched over leading dimensions, and compute in the precision of their arguments. Joint angles
    have shape (..., J), [rad]; hand positions have shape (..., D), [m], in the frame of the arm's base, which is the
    world. Movements are positions, velocities, [m/s], and accelerations, [m/s^2], of the hand at T times, shape
    (..., T, D).

    Example:
        >>> import numpy as np
        >>> from viapoint.envs.arms import PANDA
        >>> joints = PANDA.inverse_kinematics(np.array([0.5, 0.1, 0.3]))
        >>> PANDA.hand_position(joints).round(4).tolist()
        [0.5, 0.1, 0.3]
        >>> round(float(PANDA.reach_margin(np.array([0.5, 0.1, 0.3]))), 3)
        0.148
    """

    @property
    def name(self) -> str:
        """Short name, different from that of every other arm."""

    @property
    def dimension(self) -> int:
        """Spatial dimension D of the hand's movement: 2 or 3."""

    @property
    def hand_radius(self) -> float:
        """Radius of the sphere that is the hand, [m]."""

    @property
    def link_radii(self) -> tuple[float, ...]:
        """Radii of the L capsules and spheres of the links, [m]; the last one ends in the hand."""

    @property
    def link_joints(self) -> tuple[int, ...]:
        """Index of the joint that each of the L capsules moves with, in increasing order."""

    @property
    def joint_range(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each of the J joints, [rad].

        :func:`~viapoint.envs.sim.outcome.within_joint_range` checks executed movements.
        """

    @property
    def velocity_limit(self) -> tuple[float, ...]:
        """Velocity limits of the joints, [rad/s]; empty if there are none.

        Time scaling keeps them: :mod:`viapoint.envs.sim.time_scaling`.
        """

    @property
    def workspace(self) -> Box:
        """Two opposite corners of the box in which movements start and end, [m]."""

    @property
    def traced(self) -> tuple[str, ...]:
        """Names of the sites that the simulation records: the hand, then both ends of each capsule.

        Without names, positions are computed from the joints; for few links that is faster.
        """

    def compile(self, n_obstacles: int, whole_arm: bool, meshes: Sequence[str] = ()) -> mujoco.MjModel:
        """Return the MuJoCo model of the arm with movable obstacles.

        Args:
            n_obstacles: Number of movable capsules.
            whole_arm: True if every link collides with the obstacles, False for the hand alone.
            meshes: Names of registered meshes that obstacles may be.
        """

    def hand_position(self, joints: Array) -> Array:
        """Return the hand's position by forward kinematics, shape (..., D), [m]."""

    def links(self, joints: Array) -> Array:
        """Return both ends of the axis of each capsule, equal for spheres, shape (..., L, 2, D), [m]."""

    def self_clearance(self, joints: Array) -> Array:
        """Return the least clearance of the arm from itself and the table, shape (...,), [m]; at most MAX_CLEARANCE.

        It is negative exactly where the simulated arm is in contact without obstacles. Links that may touch one another
        do not count.
        """

    def inverse_kinematics(self, hand: Array) -> Array:
        """Return the joint angles that put the hand at a position, shape (..., J), [rad].

        Each position has one configuration, which depends on it smoothly. Positions out of reach give angles of a
        position nearby, not an error; check :meth:`reach_margin`.
        """

    def reach_margin(self, hand: Array) -> Any:
        """Return the distance of a hand position inside the reach, shape (...,), [m]; negative out of reach."""

    def required_time_scale(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the factor by which a movement's duration must grow to keep the arm's limits, shape (...,), 1 or more.

        The times need not be evenly spaced.
        """

    def controls(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the actuator controls that make the hand follow references, shape (..., T, U).

        The times are consecutive physics steps.
        """


@dataclass(frozen=True)
class CollisionModel:
    """Bodies of an arm that must not touch obstacles: the hand alone, or every link as well.

    Obstacles are rows (centre D, half-axis D, radius), [m], or rows with shapes, see
    :mod:`viapoint.envs.geometry.rows`. Every clearance is in [m], negative for penetration and at
    most :data:`~viapoint.envs.geometry.distance.MAX_CLEARANCE`.
    """

    arm: Arm
    """Arm that moves."""
    whole_arm: bool
    """True if the links must clear the obstacles, too; False for the hand alone."""

    def least_clearance(
        self,
        hand: Float,
        obstacles: Float,
        present: Bool,
        joints: Float | None = None,
        floor: float = -np.inf,
    ) -> Float:
        """Return the least clearance over time and obstacles, shape (N,).

        Args:
            hand: Hand positions, shape (N, T, D), [m].
            obstacles: Obstacles at rest, shape (N, n, 2 D + 1), [m].
            present: True for rows that are obstacles, shape (N, n).
            joints: Joint angles, shape (N, T, J), [rad]; by default those of the inverse kinematics.
            floor: Value below which the result need not be exact, [m].
        """
        if not obstacles.shape[1]:
            return np.full(len(hand), MAX_CLEARANCE)
        links = self._links(hand, joints)
        if links is not None and self.arm.traced:
            return nearest_approach(ends_of(links), self.arm.link_radii, obstacles, present, floor=floor)
        each = self._clearance(hand, self.arm.hand_radius, links, obstacles, present)
        return np.asarray(each.min(axis=-1))

    def clearance_profile(
        self, hand: Float, obstacles: Float, present: Bool, joints: Float | None = None
    ) -> Float:
        """Return the clearance from each obstacle, which may move, at each time, shape (N, T, n).

        The arguments are those of :meth:`least_clearance`, but obstacles have a time axis: shape (N, T, n, 2 D + 1).
        """
        number, times, most = obstacles.shape[:3]
        if not obstacles.size or not present.any():
            return np.full((number, times, most), MAX_CLEARANCE)
        links, radius = self._links(hand, joints), self.arm.hand_radius
        if links is not None:
            # The last link of a traced arm ends in the hand.
            radius = self.arm.link_radii[-1] if self.arm.traced else radius
            links = links.reshape(-1, 1, *links.shape[2:])
        rows, shown = obstacles.reshape(-1, *obstacles.shape[2:]), np.repeat(present, times, axis=0)
        profile = self._clearance(hand.reshape(-1, 1, hand.shape[-1]), radius, links, rows, shown)
        return profile.reshape(number, times, most)

    def _links(self, hand: Float, joints: Float | None) -> Float | None:
        if not self.whole_arm:
            return None
        return np.asarray(self.arm.links(self.arm.inverse_kinematics(hand) if joints is None else joints))

    def _clearance(
        self, hand: Float, radius: float, links: Float | None, obstacles: Float, present: Bool
    ) -> Float:
        """Return the least clearance over time from each obstacle, shape (N, n)."""
        least = np.asarray(hand_clearance(hand, radius, obstacles, present))
        if links is None:
            return least
        return np.asarray(np.minimum(least, arm_clearance(links, self.arm.link_radii, obstacles, present)))
