"""Spaces in which movements are planned: the plane of the hand, and the joints."""

from __future__ import annotations

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import (
    RANGE_TOLERANCE,
    planar_joints,
    planar_motion,
    planar_solutions,
)
from viapoint.envs.common.arrays import Bool, Float
from viapoint.envs.common.validation import one_of
from viapoint.envs.plans import Motion, SpaceName

REACH_TOLERANCE = 1e-6  # Greatest distance of the hand from a reference within reach, [m]


class Space:
    """Space in which a movement is a minimum-jerk trajectory: by default that of the joints; coordinates (..., D)."""

    name: SpaceName = "joints"
    of_hand = False  # True for the plane of the hand

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.dimension = 2 if self.of_hand else len(arm.joint_names)  # Number of coordinates D

    def coordinates(self, joints: Float) -> Float:
        """Return joint positions as they are."""
        return joints

    def joints(self, coordinates: Float) -> Float:
        """Return joint positions as they are."""
        return coordinates

    def joint_motion(self, motion: Motion) -> Motion:
        """Return the references as they are."""
        return motion

    def inside(self, coordinates: Float) -> Bool:
        """Return True where all joints are within their ranges."""
        low, high = self.arm.joint_range.T
        within = (coordinates >= low - RANGE_TOLERANCE) & (coordinates <= high + RANGE_TOLERANCE)
        return np.asarray(within.all(axis=-1))


class HandPlane(Space):
    """Horizontal plane of the hand of an arm of two hinges with vertical axes; coordinates are x and y."""

    name: SpaceName = "hand"
    of_hand = True

    def coordinates(self, joints: Float) -> Float:
        """Return the hand's x and y, [m]."""
        return np.asarray(self.arm.hand(joints)[..., :2])

    def joints(self, coordinates: Float) -> Float:
        """Return joint positions; out of reach, the elbow is as straight or as bent as it can be."""
        return np.asarray(planar_joints(self.arm, coordinates))

    def joint_motion(self, motion: Motion) -> Motion:
        """Return the motion of the joints that moves the hand."""
        flat = [np.ascontiguousarray(part.reshape(-1, 2)) for part in motion]
        found = planar_motion(self.arm.chain, self.arm.joint_range, *flat)
        return Motion(*(part.reshape(motion.position.shape) for part in found))

    def inside(self, coordinates: Float) -> Bool:
        """Return True where the hand reaches the coordinates with joints within their ranges."""
        chain = self.arm.chain
        limits = self.arm.joint_range + REACH_TOLERANCE * np.array([-1.0, 1.0])
        flat = np.ascontiguousarray(coordinates.reshape(-1, 2))
        _, found = planar_solutions(chain, limits, flat)
        return found.reshape(coordinates.shape[:-1])


def space_of(arm: Arm, name: SpaceName) -> Space:
    """Return the space of a name for an arm.

    Raises:
        ValueError: The arm has no such space.
    """
    spaces = ("hand", "joints") if arm.space == "hand" else ("joints",)
    return HandPlane(arm) if one_of("space of this arm", name, spaces) == "hand" else Space(arm)
