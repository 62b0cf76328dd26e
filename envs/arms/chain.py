"""Records of an arm that compiled functions read: a chain of joints, and the spheres on its links."""

from __future__ import annotations

import math
from typing import NamedTuple

from viapoint.envs.common.types import Bool, Float, Int

PART = 16
"""Greatest number of spheres of a part of a group."""


class FirstTwo(NamedTuple):
    """Angles and lengths of an arm of two hinges with vertical axes."""

    upper_angle: float
    """Angle of the upper arm in the frame of the shoulder, [rad]."""
    fore_angle: float
    """Angle of the forearm in the frame of the elbow, [rad]."""
    elbow: float
    """Angle of the frame of the elbow in that of the shoulder, [rad]."""
    base: float
    """Angle of the frame of the shoulder in the world, [rad]."""
    upper: float
    """Length of the upper arm, [m]."""
    fore: float
    """Length of the forearm, [m]."""

    @classmethod
    def of(cls, origin: Float, rotation: Float, tool_origin: Float) -> FirstTwo:
        """Return the numbers of a chain; see :class:`Chain` for the arguments."""
        return cls(
            upper_angle=math.atan2(origin[1, 1], origin[1, 0]),
            fore_angle=math.atan2(tool_origin[1], tool_origin[0]),
            elbow=math.atan2(rotation[1, 1, 0], rotation[1, 0, 0]),
            base=math.atan2(rotation[0, 1, 0], rotation[0, 0, 0]),
            upper=math.hypot(origin[1, 0], origin[1, 1]),
            fore=math.hypot(tool_origin[0], tool_origin[1]),
        )


class Chain(NamedTuple):
    """Serial chain of J joints with one link each.

    Link 0 is the base, which does not move; link j moves with joints 1 to j. The frame of a link is that of its joint;
    its z axis is the axis of the joint.
    """

    origin: Float
    """Origin of the frame of each joint at 0, in the frame of the link before, shape (J, 3), [m]."""
    rotation: Float
    """Axes of this frame as columns, in the frame of the link before, shape (J, 3, 3)."""
    sliding: Bool
    """True for joints that slide along their z axis, False for hinges about it, shape (J,)."""
    tool_origin: Float
    """Origin of the tool's frame in that of the last link, shape (3,), [m]."""
    tool_rotation: Float
    """Axes of the tool's frame as columns, shape (3, 3)."""
    mass: Float
    """Mass of each moving link with all that is fixed to it, shape (J,), [kg]."""
    centre: Float
    """Centre of mass in the link's frame, shape (J, 3), [m]."""
    inertia: Float
    """Rotational inertia about the centre of mass, in the link's frame, shape (J, 3, 3), [kg m^2]."""
    armature: Float
    """Inertia of the motors seen at the joints, shape (J,), [kg m^2] or [kg]."""
    damping: Float
    """Viscous friction of the joints, shape (J,), [N m s/rad] or [N s/m]."""
    gravity: Float
    """Gravitational acceleration, shape (3,), [m/s^2]."""
    first_two: FirstTwo
    """Angles and lengths of the first two links, for the inverse kinematics of an arm in the plane."""


class Spheres(NamedTuple):
    """Spheres that cover an arm, in G groups; a group is rigid and belongs to one body of the model."""

    centre: Float
    """Centres in the frame of the link, shape (S, 3), [m]."""
    radius: Float
    """Radii, shape (S,), [m]."""
    first: Int
    """Index of the first sphere of each group, and the number of spheres, shape (G + 1,)."""
    link: Int
    """Link that each group moves with, shape (G,); 0 for the base."""
    ball_centre: Float
    """Centre of a bounding sphere of each group and part, in the frame of the link, shape (G + C, 3), [m]."""
    ball_radius: Float
    """Radius of this sphere, shape (G + C,), [m]."""
    pairs: Int
    """Pairs of groups that must not touch one another, shape (P, 2)."""
    part: Int
    """Row of the bounding sphere of the first part of each group, and the number of rows, shape (G + 1,).

    Groups of more than PART spheres are divided into parts of PART neighbours, the last one of fewer. Their bounding
    spheres stand behind those of the groups. A group of fewer has none.
    """
