"""Scene families in the plane: upright posts and bars around the straight line from start to goal.

A family is a function of a random generator and a :class:`~viapoint.envs.core.scenes.layout.Room`. Its frame has its
origin at the start of the hand, and the goal on its x axis. The reference arm has a reach of 0.675 m.
"""

from __future__ import annotations

import math

import numpy as np

from viapoint.envs.core.scenes.layout import Furniture, Layout, Room, between, centred, sign

WORKSPACE = (-0.45, 0.35, 0.15, 0.60)
"""Least and greatest x, least and greatest y of starts and goals, [m]."""
REACH = (0.206, 0.645)
"""Least and greatest distance of the straight line from the shoulder, [m]."""
DISTANCE = (0.25, 0.45)
"""Distance of start and goal, [m]."""
DRAWS = 200
"""Attempts at start and goal."""
POST_RADIUS = (0.012, 0.045)
"""[m]"""
BAR_HALF_WIDTH, BAR_HALF_LENGTH = (0.006, 0.010), (0.05, 0.125)
"""Bars of clutter, [m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long."""
WALL_HALF_WIDTH = (0.007, 0.011)
"""Bars of structures, [m]."""
TILT = 0.6
"""Greatest angle between a bar of clutter and the perpendicular of the straight line, [rad]."""
NEAR, SPREAD = 0.10, 0.26
"""Greatest distances of obstacles from the straight line, for half of them and for the others, [m]."""

Point = tuple[float, float]


def clutter(rng: np.random.Generator, room: Room) -> Layout:
    """Return posts and bars near the straight line; the first one is in the way."""
    furniture, length = _along_line(rng, room)
    count = room.count(rng)
    if not count:
        return furniture.layout()
    kinds = room.allowed("cylinder", "box")
    # Some are drawn in vain: those that touch the arm at an end are left out.
    for row in range(2 * count + 1):
        x = length * between(rng, 0.2, 0.8)
        y = centred(rng, NEAR if row % 2 else SPREAD) if row else centred(rng, 0.03)
        if row and room.tall:
            x, y = _between_base_and(rng, furniture, x, y)
        if kinds[int(len(kinds) * rng.random())] == "cylinder":
            furniture.post(x, y, between(rng, *POST_RADIUS))
        else:
            half = between(rng, *BAR_HALF_LENGTH)
            heading = 0.5 * math.pi + centred(rng, TILT)
            furniture.bar(x, y, heading, (-half, half), between(rng, *BAR_HALF_WIDTH))
    return furniture.layout(keep=count)


def gate(rng: np.random.Generator, room: Room) -> Layout:
    """Return two walls in one line, with a gap between them beside the straight line."""
    furniture, length = _along_line(rng, room)
    x, y = _beside_line(rng, length)
    heading = 0.5 * math.pi + centred(rng, 0.4)
    half_width = between(rng, *WALL_HALF_WIDTH)
    gap = room.hand + half_width + between(rng, 0.009, 0.022)
    for direction in (heading, heading + math.pi):
        furniture.bar(x, y, direction, (gap, gap + between(rng, 0.28, 0.56)), half_width)
    return furniture.layout()


def corridor(rng: np.random.Generator, room: Room) -> Layout:
    """Return a narrow lane between two bars beside the straight line, and a wall on either side of it."""
    furniture, length = _along_line(rng, room)
    x, y = _beside_line(rng, length)
    heading, half = centred(rng, 0.3), between(rng, 0.06, 0.12)
    half_width = between(rng, *WALL_HALF_WIDTH)
    away = room.hand + half_width + between(rng, 0.012, 0.03)
    place = centred(rng, 0.8) * half
    foot = x + place * math.cos(heading), y + place * math.sin(heading)
    for side in (1.0, -1.0):
        across = heading + side * 0.5 * math.pi
        lane = x + away * math.cos(across), y + away * math.sin(across)
        furniture.bar(*lane, heading, (-half, half), half_width)
        first = away + 2.0 * half_width
        furniture.bar(*foot, across, (first, first + between(rng, 0.16, 0.4)), half_width)
    return furniture.layout()


def ring(rng: np.random.Generator, room: Room) -> Layout:
    """Return posts or bars around the goal or the start, with one opening."""
    furniture, length = _along_line(rng, room)
    x = length if rng.random() < 0.5 else 0.0
    if room.tall:
        base = furniture.base
        entry = math.atan2(base[1], base[0] - x) + centred(rng, 0.7)
    else:
        entry = centred(rng, math.pi)
    gap = room.hand + between(rng, 0.004, 0.012) * (4.0 if room.tall else 1.0)
    if rng.random() < 0.4 and "cylinder" in room.kinds:
        # The hand does not fit between neighbouring posts, but between the first and the last one.
        radius = between(rng, 0.042, 0.050)
        distance = radius + between(rng, 0.045, 0.055)
        opening = 2.0 * math.asin(min((gap + radius) / distance, 1.0))
        step = (2.0 * math.pi - opening) / 4.0
        for k in range(5):
            angle = entry + 0.5 * opening + k * step
            furniture.post(x + distance * math.cos(angle), distance * math.sin(angle), radius)
        return furniture.layout()
    half_width = between(rng, *WALL_HALF_WIDTH)
    distance = between(rng, 0.06, 0.085) + (0.015 if room.tall else 0.0)
    opening = 2.0 * math.asin(min((gap + half_width) / (1.2 * distance), 1.0))
    sides = 3 if room.tall else 4
    step = (2.0 * math.pi - opening) / sides
    half = distance * math.tan(0.5 * step)
    for k in range(sides):
        angle = entry + 0.5 * opening + (k + 0.5) * step
        middle = x + distance * math.cos(angle), distance * math.sin(angle)
        furniture.bar(*middle, angle + 0.5 * math.pi, (-half, half), half_width)
    return furniture.layout()


def oblique_bar(rng: np.random.Generator, room: Room) -> Layout:
    """Return long parallel bars at an oblique angle across the straight line, with a gap between them."""
    furniture, length = _along_line(rng, room)
    x, y = _beside_line(rng, length)
    half_width = between(rng, *WALL_HALF_WIDTH)
    side = -math.copysign(1.0, y)
    heading = side * 0.5 * math.pi + sign(rng) * between(rng, 0.5, 1.05)
    first = room.hand + half_width + between(rng, 0.009, 0.024)
    furniture.bar(x, y, heading, (first, first + between(rng, 0.26, 0.5)), half_width)
    last = room.hand + half_width + between(rng, 0.009, 0.024)
    furniture.bar(x, y, heading, (-last, -last - between(rng, 0.26, 0.5)), half_width)
    shift = sign(rng) * between(rng, 0.07, 0.12)
    x, y = x - shift * math.sin(heading), y + shift * math.cos(heading)
    if not room.tall:
        furniture.bar(x, y, heading, (first, first + between(rng, 0.26, 0.5)), half_width)
    return furniture.layout()


def cul_de_sac(rng: np.random.Generator, room: Room) -> Layout:
    """Return a pocket of bars that is open towards the start, and walls beside it that leave little room."""
    furniture, length = _along_line(rng, room)
    end = length * between(rng, 0.5, 0.75)
    heading, half_width = centred(rng, 0.3), between(rng, *WALL_HALF_WIDTH)
    wide, deep = between(rng, 0.045, 0.09), between(rng, 0.1, 0.2)
    across = heading + 0.5 * math.pi
    furniture.bar(end, 0.0, across, (-wide, wide), half_width)
    splay = between(rng, 0.0, 0.35)
    for side in (1.0, -1.0):
        corner = end + side * wide * math.cos(across), side * wide * math.sin(across)
        furniture.bar(*corner, heading + math.pi - side * splay, (0.0, deep), half_width)
    side = sign(rng)
    gap = 2.0 * room.hand + 2.0 * half_width + between(rng, 0.02, 0.05)
    furniture.bar(end, 0.0, across, (side * (wide + gap), side * (wide + gap + 0.3)), half_width)
    first = wide + 2.0 * half_width
    furniture.bar(end, 0.0, across, (-side * first, -side * (first + between(rng, 0.16, 0.4))), half_width)
    return furniture.layout()


def _along_line(rng: np.random.Generator, room: Room) -> tuple[Furniture, float]:
    """Return furniture with start and goal of the hand only, and their distance, [m]."""
    start, goal = _ends(rng, room)
    x, y = goal[0] - start[0], goal[1] - start[1]
    length = math.hypot(x, y)
    furniture = Furniture(room, start[0], start[1], math.atan2(y, x))
    furniture.start((0.0, 0.0, 0.0))
    furniture.goal((length, 0.0, 0.0))
    return furniture, length


def _ends(rng: np.random.Generator, room: Room) -> tuple[Point, Point]:
    """Return start and goal of the hand, such that the straight line between them is within reach."""
    if room.start is not None and room.goal is not None:
        return room.start, room.goal
    first = room.start if room.start is not None else room.goal
    for _ in range(DRAWS):
        if first is None:
            one = between(rng, *WORKSPACE[:2]), between(rng, *WORKSPACE[2:])
        else:
            one = first
        distance, angle = between(rng, *DISTANCE), centred(rng, math.pi)
        other = one[0] + distance * math.cos(angle), one[1] + distance * math.sin(angle)
        if _within_reach(one, other):
            break
    return (other, one) if room.goal is not None else (one, other)


def _within_reach(one: Point, other: Point) -> bool:
    """Return True if the second point is in the workspace, and the line between both within reach."""
    low_x, high_x, low_y, high_y = WORKSPACE
    if not (low_x < other[0] < high_x and low_y < other[1] < high_y):
        return False
    if math.hypot(*one) > REACH[1] or math.hypot(*other) > REACH[1]:
        return False
    x, y = other[0] - one[0], other[1] - one[1]
    foot = -(one[0] * x + one[1] * y) / (x * x + y * y)
    foot = min(max(foot, 0.0), 1.0)
    return math.hypot(one[0] + foot * x, one[1] + foot * y) > REACH[0]


def _beside_line(rng: np.random.Generator, length: float) -> Point:
    """Return a point that the hand must pass, beside the straight line."""
    return length * between(rng, 0.25, 0.75), sign(rng) * between(rng, 0.03, 0.13)


def _between_base_and(rng: np.random.Generator, furniture: Furniture, x: float, y: float) -> Point:
    """Return a point on the ray from the base to a point, where links pass, too."""
    share = between(rng, 0.3, 1.25)
    base = furniture.base
    return base[0] + share * (x - base[0]), base[1] + share * (y - base[1])
