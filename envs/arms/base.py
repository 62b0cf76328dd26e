"""What the environment needs to know of an arm."""

from __future__ import annotations

from typing import Protocol

import mujoco

from viapoint.primitives.array_api import Array


class Arm(Protocol):
    """An arm: its size, its reach, its two kinematic directions and its inverse side.

    The kinematic functions are batched over leading dimensions and accept NumPy arrays and torch tensors.
    Positions are in the frame of the arm's base, which is the world's.
    """

    @property
    def name(self) -> str:
        """A short name, unlike every other arm's."""

    @property
    def dimension(self) -> int:
        """Spatial dimension D of the hand's movement: 2 or 3."""

    @property
    def hand_radius(self) -> float:
        """Radius of the sphere that is the hand, [m]."""

    @property
    def link_radii(self) -> tuple[float, ...]:
        """Radii of the L link capsules, [m]."""

    @property
    def joint_range(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each of the J joints, [rad]."""

    @property
    def velocity_limit(self) -> tuple[float, ...]:
        """Of the joints, [rad/s]; empty where there is none."""

    @property
    def workspace(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Two opposite corners of the box in which movements start and end, [m]."""

    @property
    def traced(self) -> tuple[str, ...]:
        """Sites of the model that the physics records: the hand, then both ends of each link; none where that is slow.

        Where there are none, positions are computed from the joints.
        """

    def compile(self, n_obstacles: int, whole_arm: bool) -> mujoco.MjModel:
        """The MuJoCo model of the arm with `n_obstacles` movable capsules.

        `whole_arm`: every link collides with the obstacles, not the hand alone.
        """

    def hand_position(self, joints: Array) -> Array:
        """Hand position, shape (..., D), [m], at `joints`, shape (..., J), [rad]."""

    def links(self, joints: Array) -> Array:
        """End points of the links' axes, shape (..., L, 2, D), [m], at `joints`, shape (..., J), [rad]."""

    def inverse_kinematics(self, hand: Array) -> Array:
        """Joint angles, shape (..., J), [rad], that put the hand at `hand`, shape (..., D), [m]."""

    def reach_margin(self, hand: Array) -> Array:
        """How far inside its reach the hand is, shape (...,), [m]; negative where no posture gets there."""

    def required_time_scale(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """By which factor a movement must be slowed down for the arm's limits, shape (...,); 1 where it need not.

        The movement is given at some times, shape (..., T, D) each; they need not be evenly spaced.
        """

    def controls(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Actuator controls, shape (..., T, U), that make the hand follow references, shape (..., T, D) each.

        The references are those of T consecutive physics steps.
        """
