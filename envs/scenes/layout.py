"""Layouts: obstacles of a drawn scene as plain numbers, and the places where one would reach among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from viapoint.envs.geometry.obstacles import BOX, CAPSULE, CYLINDER, HALF_SPACE, SPHERE

ROW = 16  # Numbers of an obstacle in a layout: kind, centre, rotation matrix row by row, sizes
PLACE = 12
"""Numbers of a place in a layout: position, approach, half sizes, cosine and sine of the yaw, angle of the cone."""
MOST_PLACES = 8  # Greatest number of places of starts, or of goals, of a layout
TALL = 0.1  # Half height above which obstacles in the plane are in the way of the links, [m]

Vector = tuple[float, float, float]
NOWHERE = (0.0, 0.0, 0.0)


def most_rows(most: int) -> int:
    """Return how many obstacles a layout may have of which at most so many are kept."""
    return 2 * most + 3


class Room(NamedTuple):
    """Conditions that a layout must meet.

    Families use the sizes of a reference arm, with its base at the origin; :class:`Furniture` converts them.

    Example:
        >>> from viapoint.envs import Room
        >>> Room(kinds=("sphere", "box"), fewest=1, most=4).most
        4
    """

    kinds: tuple[str, ...]
    """Names of the kinds that obstacles may have."""
    fewest: int
    """Least number of obstacles of families that can have any number."""
    most: int
    """Greatest number of obstacles."""
    scale: float = 1.0
    """Reach of the arm relative to that of the reference arm."""
    foot: Vector = (0.0, 0.0, 0.0)
    """Place of the base, [m]."""
    turn: tuple[float, float] = (-math.pi, math.pi)
    """Bearings at which furniture may stand around the base, [rad]."""
    height: float = 0.0
    """Half height of obstacles in the plane, [m]."""
    hand: float = 0.0
    """Radius of the part of the arm that must pass between obstacles in the plane, [m] of the reference arm."""
    links: tuple[float, float] = (0.0, 0.0)
    """Lengths of upper arm and forearm in the plane, the first negative if the elbow is on the left, [m] of the
    reference arm."""
    start: tuple[float, float] | None = None
    """Given start of the hand in the plane, [m] of the reference arm."""
    goal: tuple[float, float] | None = None
    """Given goal of the hand in the plane, [m] of the reference arm."""

    @property
    def tall(self) -> bool:
        """True if the links of an arm in the plane must clear the obstacles, too."""
        return self.height > TALL

    def count(self, rng: np.random.Generator) -> int:
        """Return a random number of obstacles."""
        return self.fewest + int((self.most - self.fewest + 1) * rng.random())

    def allowed(self, *kinds: str) -> list[str]:
        """Return those of some kinds that obstacles may have.

        Raises:
            ValueError: Obstacles may have none of them.
        """
        allowed = [kind for kind in kinds if kind in self.kinds]
        if not allowed:
            raise ValueError(
                f"to draw this family of scenes, shapes must have one of {', '.join(kinds)}, got "
                f"{', '.join(self.kinds)}; obstacles that reset is given may have any of them"
            )
        return allowed


class Layout(NamedTuple):
    """Obstacles and places of a scene; :class:`Furniture` builds it."""

    rows: list[float]  # ROW numbers for each obstacle
    goals: list[float]  # PLACE numbers for each place of goals; without any, goals are free configurations
    # PLACE numbers for each place of starts; without any, starts are home, in a place of goals, or free
    starts: list[float]
    keep: int = 0  # Number of obstacles that are kept, the first with free ends; 0 if they belong together


class Place(NamedTuple):
    """Place where one would reach.

    Example:
        >>> from viapoint.envs import Place
        >>> Place((0.5, 0.0, 0.3), approach=(0.0, 0.0, -1.0)).half  # from above, at this very point
        (0.0, 0.0, 0.0)
    """

    position: Vector
    """Middle of the box in which positions of the tool are drawn, [m]."""
    approach: Vector = (0.0, 0.0, 0.0)
    """Direction of the tool's z axis, or zeros for any orientation."""
    half: Vector = (0.0, 0.0, 0.0)
    """Half sizes of the box, [m]."""
    cone: float = 0.0
    """Greatest angle between the tool's z axis and the approach, [rad]."""


class Furniture:
    """Builder of obstacles and places in an upright frame, which may stand anywhere around the arm.

    All arguments are in this frame, and in metres of the reference arm. Arguments are trusted.

    Args:
        room: Conditions of the layout.
        x: Origin of the frame, seen from the base, [m].
        y: Origin of the frame, [m].
        yaw: Angle from the x axis of the base to that of the frame, [rad].

    Example:
        >>> from viapoint.envs import Furniture, Room
        >>> table = Furniture(Room(kinds=("box",), fewest=1, most=4), x=0.5)
    """

    def __init__(self, room: Room, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> None:
        self.room = room
        self._rows: list[float] = []
        self._goals: list[float] = []
        self._starts: list[float] = []
        self._x = x
        self._y = y
        self._yaw = yaw
        self._cosine = math.cos(yaw)
        self._sine = math.sin(yaw)

    @property
    def left(self) -> int:
        """Number of obstacles that may still be added."""
        return self.room.most - len(self._rows) // ROW

    def elbow(self, x: float, y: float) -> tuple[float, float]:
        """Return the elbow of an arm in the plane with its hand at a place, in the frame, [m]."""
        upper, fore = self.room.links
        x, y = self._turned(x, y)
        x, y = self._x + x, self._y + y
        # Law of cosines for the angle between upper arm and hand, seen from the shoulder.
        away = math.hypot(x, y)
        cosine = (away * away + upper * upper - fore * fore) / (2.0 * away * abs(upper))
        angle = math.atan2(y, x) - math.copysign(math.acos(min(max(cosine, -1.0), 1.0)), upper)
        x, y = abs(upper) * math.cos(angle) - self._x, abs(upper) * math.sin(angle) - self._y
        return self._cosine * x + self._sine * y, self._cosine * y - self._sine * x

    def box(self, centre: Vector, half: Vector, yaw: float = 0.0) -> None:
        """Add a box that is turned about the vertical axis."""
        self._upright(BOX, centre, half, self._yaw + yaw)

    def cylinder(self, centre: Vector, radius: float, half_length: float) -> None:
        """Add an upright cylinder."""
        self._upright(CYLINDER, centre, (radius, half_length, 0.0), self._yaw)

    def sphere(self, centre: Vector, radius: float) -> None:
        """Add a sphere."""
        self._upright(SPHERE, centre, (radius, 0.0, 0.0), self._yaw)

    def capsule(
        self, centre: Vector, radius: float, half_length: float, heading: float, rise: float = 0.0
    ) -> None:
        """Add a capsule whose axis has a heading and rises by an angle from the horizontal."""
        c = math.cos(self._yaw + heading)
        s = math.sin(self._yaw + heading)
        u, v = math.cos(rise), math.sin(rise)
        # Columns: horizontal axis across, the third axis times it, and the axis of the capsule.
        rotation = (-s, -v * c, u * c, c, -v * s, u * s, 0.0, u, v)
        self._add(CAPSULE, centre, rotation, (radius, half_length, 0.0))

    def floor(self, height: float) -> None:
        """Add a half-space below a height, where the kind is allowed and a row is left."""
        if "half_space" in self.room.kinds and self.left > 0:
            self._upright(HALF_SPACE, (0.0, 0.0, height), (0.0, 0.0, 0.0), self._yaw)

    def post(self, x: float, y: float, radius: float) -> None:
        """Add a post in the plane."""
        self.cylinder((x, y, 0.0), radius, self.room.height / self.room.scale)

    def bar(self, x: float, y: float, heading: float, ends: tuple[float, float], half_width: float) -> None:
        """Add a bar in the plane between two distances from a point in a direction; they may be negative."""
        middle = 0.5 * (ends[0] + ends[1])
        centre = (x + middle * math.cos(heading), y + middle * math.sin(heading), 0.0)
        half = (0.5 * abs(ends[1] - ends[0]), half_width, self.room.height / self.room.scale)
        self.box(centre, half, heading)

    def goal(
        self, position: Vector, half: Vector = NOWHERE, approach: Vector = NOWHERE, cone: float = 0.0
    ) -> None:
        """Add a place of goals, see :class:`Place`."""
        self._place(self._goals, position, half, approach, cone)

    def start(
        self, position: Vector, half: Vector = NOWHERE, approach: Vector = NOWHERE, cone: float = 0.0
    ) -> None:
        """Add a place of starts, see :class:`Place`."""
        self._place(self._starts, position, half, approach, cone)

    def layout(self, keep: int = 0) -> Layout:
        """Return what was added."""
        return Layout(self._rows, self._goals, self._starts, keep)

    def _upright(self, kind: int, centre: Vector, size: Vector, yaw: float) -> None:
        """Add an obstacle that is turned about the vertical axis only."""
        c, s = math.cos(yaw), math.sin(yaw)
        self._add(kind, centre, (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0), size)

    def _add(self, kind: int, centre: Vector, rotation: Sequence[float], size: Vector) -> None:
        scale = self.room.scale
        self._rows.append(kind)
        self._rows += self._world(centre)
        self._rows += rotation
        self._rows += (scale * size[0], scale * size[1], scale * size[2])

    def _place(
        self, places: list[float], position: Vector, half: Vector, approach: Vector, cone: float
    ) -> None:
        scale = self.room.scale
        places += self._world(position)
        places += self._turned(approach[0], approach[1])
        places.append(approach[2])
        places += (scale * half[0], scale * half[1], scale * half[2], self._cosine, self._sine, cone)

    def _turned(self, x: float, y: float) -> tuple[float, float]:
        """Return a horizontal vector of the frame in the world."""
        return self._cosine * x - self._sine * y, self._sine * x + self._cosine * y

    def _world(self, point: Vector) -> Vector:
        """Return a point of the frame in the world, [m]."""
        x, y = self._turned(point[0], point[1])
        scale, foot = self.room.scale, self.room.foot
        return (foot[0] + scale * (self._x + x), foot[1] + scale * (self._y + y), foot[2] + scale * point[2])


def mix(limits: tuple[float, float], share: float) -> float:
    """Return the number at a share of the way from a lower limit to an upper one."""
    return limits[0] + (limits[1] - limits[0]) * share


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a random number between two limits; faster than the generator's own method."""
    return low + (high - low) * rng.random()


def centred(rng: np.random.Generator, most: float) -> float:
    """Return a random number between -most and most."""
    return most * (2.0 * rng.random() - 1.0)


def sign(rng: np.random.Generator) -> float:
    """Return 1 or -1 at random."""
    return 1.0 if rng.random() < 0.5 else -1.0
