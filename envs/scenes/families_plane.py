"""Scene families in the plane: upright posts and bars around the straight line from start to goal.

A family is a function of a random generator and a :class:`~viapoint.envs.scenes.layout.Room`. Its frame has its
origin at the start of the hand, and the goal on its x axis. The reference arm has a reach of 0.675 m.
"""

from __future__ import annotations

import math

import numpy as np

from viapoint.envs.scenes.layout import Furniture, Layout, Room, between, centred, mix, sign

WORKSPACE = (-0.45, 0.35, 0.15, 0.60)  # Least and greatest x, least and greatest y of starts and goals, [m]
REACH = (0.206, 0.645)  # Least and greatest distance of the straight line from the shoulder, [m]
DISTANCE = (0.25, 0.45)  # Distance of start and goal, [m]
DRAWS = 200  # Attempts at start and goal
POST_RADIUS = (0.012, 0.045)  # [m]
# Bars of clutter, [m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long
BAR_HALF_WIDTH, BAR_HALF_LENGTH = (0.006, 0.010), (0.05, 0.125)
WALL_HALF_WIDTH = (0.007, 0.011)  # Bars of structures, [m]
TILT = 0.6  # Greatest angle between a bar of clutter and the perpendicular of the straight line, [rad]
IN_THE_WAY = 0.03  # Greatest distance of the first obstacle from the straight line, [m]
# Least distance of the next two from the line, what it grows by for every two more, and its range, [m]
NEAREST, STEP, SPREAD = 0.05, 0.05, 0.08
ASIDE = 0.12  # Greatest distance of other obstacles from the forearm, where links must clear, too, [m]

Point = tuple[float, float]


def clutter(rng: np.random.Generator, room: Room) -> Layout:
    """Return posts and bars near the straight line; the first one is in the way."""
    furniture, length = _along_line(rng, room)
    count = room.count(rng)
    if not count:
        return furniture.layout()
    kinds = room.allowed("cylinder", "box")
    # Some are drawn in vain: those that touch the arm at an end are left out.
    spare, in_the_way = (count + 2, 3) if room.tall else (2, 1)
    side = sign(rng)
    for row, numbers in enumerate(rng.random((count + spare, 7)).tolist()):
        along, across, kind, size, half, tilt, share = numbers
        x = length * (0.2 + 0.6 * along)
        y = IN_THE_WAY * (2.0 * across - 1.0)
        if row >= in_the_way:
            # Near to far in turns on both sides, so that together they close more ways around.
            side = -side
            rank = (row - in_the_way) // 2
            y = side * (NEAREST + STEP * rank + SPREAD * across)
            if room.tall:
                x, y = _beside_forearm(furniture, x, share, ASIDE * side * across)
        if kinds[int(len(kinds) * kind)] == "cylinder":
            furniture.post(x, y, mix(POST_RADIUS, size))
        else:
            reach = mix(BAR_HALF_LENGTH, half)
            heading = 0.5 * math.pi + TILT * (2.0 * tilt - 1.0)
            furniture.bar(x, y, heading, (-reach, reach), mix(BAR_HALF_WIDTH, size))
    return furniture.layout(keep=count)


def gate(rng: np.random.Generator, room: Room) -> Layout:
    """Return two walls in one line, with a gap between them that the hand, or the forearm, must pass."""
    furniture, length = _along_line(rng, room)
    x, y, heading = _passage(rng, furniture, length)
    half_width, gap = _wall(rng, room)
    for side in (-0.5 * math.pi, 0.5 * math.pi):
        furniture.bar(x, y, heading + side, (gap, gap + _length(rng, room)), half_width)
    return furniture.layout()


def corridor(rng: np.random.Generator, room: Room) -> Layout:
    """Return a narrow lane between two bars, with a wall on either side of it where the hand alone must pass."""
    furniture, length = _along_line(rng, room)
    x, y, heading = _passage(rng, furniture, length)
    half = between(rng, 0.05, 0.09) if room.tall else between(rng, 0.06, 0.12)
    half_width, away = _wall(rng, room)
    place = centred(rng, 0.8) * half
    foot = x + place * math.cos(heading), y + place * math.sin(heading)
    for side in (-0.5 * math.pi, 0.5 * math.pi):
        across = heading + side
        lane = x + away * math.cos(across), y + away * math.sin(across)
        furniture.bar(*lane, heading, (-half, half), half_width)
        first = away + 2.0 * half_width
        if not room.tall:
            furniture.bar(*foot, across, (first, first + _length(rng, room)), half_width)
    return furniture.layout()


def ring(rng: np.random.Generator, room: Room) -> Layout:
    """Return posts or bars around the goal or the start, with one opening."""
    furniture, length = _along_line(rng, room)
    x = length if rng.random() < 0.5 else 0.0
    entry = centred(rng, math.pi)
    if room.tall:
        elbow = furniture.elbow(x, 0.0)
        entry = math.atan2(elbow[1], elbow[0] - x) + centred(rng, 0.3)
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
    """Return long parallel bars at an oblique angle, with a gap between them that the hand, or forearm, must pass."""
    furniture, length = _along_line(rng, room)
    x, y, heading = _passage(rng, furniture, length)
    heading += 0.5 * math.pi + sign(rng) * between(rng, 0.4, 1.0)
    half_width, gap = _wall(rng, room)
    gap += 0.01
    for side in (0.0, math.pi):
        furniture.bar(x, y, heading + side, (gap, gap + _length(rng, room)), half_width)
    if not room.tall:
        shift = sign(rng) * between(rng, 0.07, 0.12)
        x = x - shift * math.sin(heading)
        y = y + shift * math.cos(heading)
        furniture.bar(x, y, heading, (gap, gap + _length(rng, room)), half_width)
    return furniture.layout()


def cul_de_sac(rng: np.random.Generator, room: Room) -> Layout:
    """Return a pocket of bars that is open towards the start, and walls beside it that leave little room."""
    furniture, length = _along_line(rng, room)
    end = length * between(rng, 0.5, 0.75)
    heading = centred(rng, 0.3)
    half_width, gap = _wall(rng, room)
    wide, deep = between(rng, 0.045, 0.09), between(rng, 0.1, 0.2)
    across = heading + 0.5 * math.pi
    furniture.bar(end, 0.0, across, (-wide, wide), half_width)
    splay = between(rng, 0.0, 0.35)
    for side in (1.0, -1.0):
        corner = end + side * wide * math.cos(across), side * wide * math.sin(across)
        furniture.bar(*corner, heading + math.pi - side * splay, (0.0, deep), half_width)
    if room.tall:
        return furniture.layout()
    side = sign(rng)
    for direction, first in ((side, wide + 2.0 * gap), (-side, wide + 2.0 * half_width)):
        last = first + _length(rng, room)
        furniture.bar(end, 0.0, across, (direction * first, direction * last), half_width)
    return furniture.layout()


def _wall(rng: np.random.Generator, room: Room) -> tuple[float, float]:
    """Return half the width of walls, and the distance of their middles from what passes between them, [m]."""
    half_width = between(rng, *WALL_HALF_WIDTH)
    gap = between(rng, 0.010, 0.045) if room.tall else between(rng, 0.009, 0.024)
    return half_width, room.hand + half_width + gap


def _length(rng: np.random.Generator, room: Room) -> float:
    """Return the length of a wall, [m]; long ones leave no room for links."""
    return between(rng, 0.08, 0.25) if room.tall else between(rng, 0.16, 0.50)


def _passage(rng: np.random.Generator, furniture: Furniture, length: float) -> tuple[float, float, float]:
    """Return a place, and the direction in which the hand passes it, or in which the forearm lies in it at an end."""
    if not furniture.room.tall:
        return length * between(rng, 0.25, 0.75), sign(rng) * between(rng, 0.03, 0.13), centred(rng, 0.4)
    end = length if rng.random() < 0.5 else 0.0
    elbow = furniture.elbow(end, 0.0)
    x, y = elbow[0] - end, elbow[1]
    share = between(rng, 0.15, 0.6)
    return end + share * x, share * y, math.atan2(y, x) + centred(rng, 0.25)


def _along_line(rng: np.random.Generator, room: Room) -> tuple[Furniture, float]:
    """Return furniture with start and goal of the hand only, and their distance, [m]."""
    start, goal = _ends(rng, room)
    x = goal[0] - start[0]
    y = goal[1] - start[1]
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
        one = first or (between(rng, *WORKSPACE[:2]), between(rng, *WORKSPACE[2:]))
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
    x = other[0] - one[0]
    y = other[1] - one[1]
    foot = -(one[0] * x + one[1] * y) / (x * x + y * y)
    foot = min(max(foot, 0.0), 1.0)
    return math.hypot(one[0] + foot * x, one[1] + foot * y) > REACH[0]


def _beside_forearm(furniture: Furniture, x: float, share: float, aside: float) -> Point:
    """Return a point beside the forearm, or beyond the elbow, with the hand on the line."""
    elbow = furniture.elbow(x, 0.0)
    share = 1.4 * share - 0.4
    u, v = x - elbow[0], -elbow[1]
    length = math.hypot(u, v)
    return elbow[0] + share * u - aside * v / length, elbow[1] + share * v + aside * u / length
