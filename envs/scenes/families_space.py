"""Scene families in space: furniture around an arm, and the places where one would reach.

A family is a function of a random generator and a :class:`~viapoint.envs.scenes.layout.Room`. The frame of its
furniture has its origin under the middle of the front, which faces the arm, and its x axis points away from the arm.
Sizes are for an arm with a reach of 0.855 m and its shoulder 0.333 m above its base, such as the Panda.
"""

from __future__ import annotations

import math

import numpy as np

from viapoint.envs.scenes.layout import Furniture, Layout, Room, Vector, between, centred, sign

THICKNESS = 0.015  # Half thickness of boards and walls, [m]
FORWARDS, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)  # Approaches of the tool
CONE = 0.4  # Greatest angle between the tool and a horizontal approach, [rad]
HAND_ROOM = 0.07  # Least distance of the tool from boards and walls beside it, [m]
THING_RADIUS, THING_HALF_HEIGHT = (0.02, 0.05), (0.04, 0.12)  # Sizes of things that stand in furniture, [m]


def shelf(rng: np.random.Generator, room: Room) -> Layout:
    """Return a shelf of up to four compartments, closed or with posts, with things in it."""
    furniture = _in_front(rng, room, 0.35, 0.65)
    half_depth = between(rng, 0.12, 0.30)
    half_width = between(rng, 0.25, 0.55)
    compartments = min(1 + int(4 * rng.random()), room.most - 3)  # a board more, and two walls
    gap, lowest = between(rng, 0.22, 0.42), between(rng, -0.30, 0.45)
    for board in range(compartments + 1):
        height = lowest + board * gap
        furniture.box((half_depth, 0.0, height), (half_depth, half_width, THICKNESS))
    half_height = 0.5 * compartments * gap
    middle = lowest + half_height
    if rng.random() < 0.6 or furniture.left < 4:  # posts need four rows
        _walls(furniture, half_depth, half_width, middle, half_height)
        if rng.random() < 0.5 and furniture.left:
            furniture.box((2.0 * half_depth, 0.0, middle), (THICKNESS, half_width, half_height))
    else:
        for x in (0.0, 2.0 * half_depth):
            for y in (-half_width, half_width):
                furniture.box((x, y, middle), (THICKNESS, THICKNESS, half_height + 0.2))
    for compartment in range(compartments):
        height = lowest + compartment * gap
        _things(rng, furniture, int(3 * rng.random()), height, 2.0 * half_depth, half_width)
        reach = min(half_depth, 0.17)  # deep shelves are reached into from the front
        position = (reach, 0.0, height + 0.5 * gap)
        half = (reach, 0.85 * half_width, 0.5 * gap - HAND_ROOM)
        furniture.goal(position, half, FORWARDS, CONE)
    if rng.random() < 0.5:
        furniture.floor(min(lowest - 0.1, 0.0))  # below the lowest board
    return furniture.layout()


def table(rng: np.random.Generator, room: Room) -> Layout:
    """Return a table with things on it; one reaches over it and under it."""
    furniture = _in_front(rng, room, 0.30, 0.50)
    height = between(rng, 0.05, 0.50)
    half_depth = between(rng, 0.2, 0.5)
    half_width = between(rng, 0.4, 0.8)
    furniture.box((half_depth, 0.0, height), (half_depth, half_width, THICKNESS))
    if furniture.left > 6:  # four legs, the floor and things
        for x in (0.03, 2.0 * half_depth - 0.03):
            for y in (0.03 - half_width, half_width - 0.03):
                furniture.box((x, y, height - 0.35), (0.025, 0.025, 0.35))
        furniture.floor(min(height - 0.7, 0.0))
    _things(rng, furniture, 1 + int(6 * rng.random()), height, 2.0 * half_depth, half_width)
    across = 0.6 * half_width
    furniture.goal((0.15, 0.0, height + 0.18), (0.2, across, 0.11), FORWARDS, CONE)
    furniture.goal((0.15, 0.0, height + 0.15), (0.15, across, 0.11), DOWN, 0.2)
    furniture.goal((0.10, 0.0, height - 0.20), (0.15, across, 0.12), FORWARDS, CONE)
    return furniture.layout()


def bin_(rng: np.random.Generator, room: Room) -> Layout:
    """Return an open box with things in it; one reaches into it from above, or waits above it."""
    furniture = _in_front(rng, room, 0.25, 0.45)
    half_depth = between(rng, 0.14, 0.30)
    half_width = between(rng, 0.14, 0.35)
    half_height = between(rng, 0.06, 0.16)
    lowest = between(rng, 0.0, 0.35) if rng.random() < 0.6 else between(rng, -0.3, 0.0)
    middle = lowest + half_height
    furniture.box((half_depth, 0.0, lowest), (half_depth, half_width, THICKNESS))
    _walls(furniture, half_depth, half_width, middle, half_height)
    for x in (0.0, 2.0 * half_depth):
        furniture.box((x, 0.0, middle), (THICKNESS, half_width, half_height))
    if furniture.left > 2:
        furniture.floor(min(lowest - THICKNESS, 0.0))
    _things(rng, furniture, int(3 * rng.random()), lowest, 2.0 * half_depth, half_width)
    inside = (0.7 * half_depth - 0.02, 0.7 * half_width - 0.02, 0.4 * half_height)
    furniture.goal((half_depth, 0.0, middle), inside, DOWN, 0.25)
    furniture.start((half_depth, 0.0, middle), inside, DOWN, 0.25)
    above = (half_depth, 0.0, lowest + 2.0 * half_height + 0.2)
    furniture.start(above, (half_depth, 2.0 * half_width, 0.12), DOWN, 0.4)
    return furniture.layout()


def cage(rng: np.random.Generator, room: Room) -> Layout:
    """Return a box that is open towards the arm but for bars; one reaches between them."""
    furniture = _in_front(rng, room, 0.30, 0.50, twist=0.3)
    half_depth = between(rng, 0.2, 0.38)
    half_width = between(rng, 0.25, 0.42)
    half_height = between(rng, 0.25, 0.42)
    middle = between(rng, 0.30, 0.65)
    lowest, highest = middle - half_height, middle + half_height
    furniture.box((half_depth, 0.0, lowest), (half_depth, half_width, THICKNESS))
    _walls(furniture, half_depth, half_width, middle, half_height)
    furniture.box((2.0 * half_depth, 0.0, middle), (THICKNESS, half_width, half_height))
    if rng.random() < 0.8 and furniture.left > 1:
        furniture.box((half_depth, 0.0, highest), (half_depth, half_width, THICKNESS))
    for _ in range(min(1 + int(3 * rng.random()), furniture.left)):
        height = middle + between(rng, -0.8, 0.6) * half_height
        furniture.box((0.0, 0.0, height), (THICKNESS, half_width, THICKNESS))
    _things(rng, furniture, 1, lowest, 2.0 * half_depth, half_width)
    half = (0.45 * half_depth, 0.6 * half_width, half_height - 0.1)
    furniture.goal((0.65 * half_depth, 0.0, middle), half, FORWARDS, CONE)
    return furniture.layout()


def wall_window(rng: np.random.Generator, room: Room) -> Layout:
    """Return a wall with a window through which one reaches."""
    furniture = _in_front(rng, room, 0.35, 0.55, twist=0.3)
    half_width = between(rng, 0.14, 0.22)
    half_height = between(rng, 0.13, 0.20)
    y, z = centred(rng, 0.15), between(rng, 0.3, 0.6)
    far = between(rng, 0.2, 0.4)
    for side in (-1.0, 1.0):
        panel = (0.0, y + side * (half_width + far), z)
        furniture.box(panel, (THICKNESS, far, half_height + 2.0 * far))
        board = (0.0, y, z + side * (half_height + far))
        furniture.box(board, (THICKNESS, half_width, far))
    half = (0.1, 0.8 * half_width, 0.8 * half_height)
    furniture.goal((0.14, y, z), half, FORWARDS, CONE)
    return furniture.layout()


def gate(rng: np.random.Generator, room: Room) -> Layout:
    """Return two posts with a lintel on them; one reaches between the posts, or stands beside them."""
    furniture = _in_front(rng, room, 0.35, 0.60)
    half_width = between(rng, 0.14, 0.24)
    height = between(rng, 0.35, 0.85)
    radius = between(rng, 0.02, 0.05)
    round_posts = "cylinder" in room.kinds and rng.random() < 0.5
    for y in (-half_width - radius, half_width + radius):
        if round_posts:
            furniture.cylinder((0.0, y, 0.5 * height), radius, 0.5 * height)
        else:
            furniture.box((0.0, y, 0.5 * height), (radius, radius, 0.5 * height))
    furniture.box((0.0, 0.0, height + radius), (radius, half_width + 2.0 * radius, radius))
    if furniture.left > 1:
        furniture.floor(0.0)
    half = (0.12, 0.8 * half_width, 0.5 * height - HAND_ROOM)
    furniture.goal((0.14, 0.0, 0.5 * height), half, FORWARDS, CONE)
    beside = sign(rng) * (half_width + 0.3)
    furniture.start((0.1, beside, 0.4), (0.15, 0.15, 0.25), FORWARDS, 0.8)
    furniture.start((0.1, 0.0, height + 0.25), (0.15, 0.2, 0.1), FORWARDS, 0.8)
    return furniture.layout()


def tunnel(rng: np.random.Generator, room: Room) -> Layout:
    """Return a passage between two walls under a roof; one reaches into it."""
    furniture = _in_front(rng, room, 0.30, 0.55)
    half_depth = between(rng, 0.12, 0.28)
    half_width = between(rng, 0.13, 0.22)
    half_height = between(rng, 0.12, 0.20)
    middle = between(rng, 0.20, 0.60)
    _walls(furniture, half_depth, half_width, middle, half_height)
    for height in (middle - half_height, middle + half_height):
        furniture.box((half_depth, 0.0, height), (half_depth, half_width, THICKNESS))
    if rng.random() < 0.5:
        furniture.floor(0.0)
    half = (half_depth, 0.8 * half_width - 0.02, half_height - HAND_ROOM)  # the hand fits
    furniture.goal((half_depth, 0.0, middle), half, FORWARDS, 0.3)
    return furniture.layout()


def clutter(rng: np.random.Generator, room: Room) -> Layout:
    """Return separate obstacles of all kinds all around the arm, which moves freely among them."""
    furniture = Furniture(room)
    count = room.count(rng)
    if not count:
        return furniture.layout()
    kinds = room.allowed("sphere", "capsule", "cylinder", "box")
    for _ in range(count + 2 + count // 2):
        bearing = between(rng, *room.turn)
        distance = between(rng, 0.25, 0.75)
        height = between(rng, 0.05, 0.85)
        centre = (distance * math.cos(bearing), distance * math.sin(bearing), height)
        _separate(rng, furniture, kinds[int(len(kinds) * rng.random())], centre)
    if "half_space" in room.kinds and count < room.most and rng.random() < 0.5:
        furniture.floor(0.0)
        count += 1
    return furniture.layout(keep=count)


def _in_front(rng: np.random.Generator, room: Room, near: float, far: float, twist: float = 0.5) -> Furniture:
    """Return furniture without parts whose front is somewhere around the arm, at a distance from it."""
    bearing = between(rng, *room.turn)
    distance = between(rng, near, far)
    x = distance * math.cos(bearing)
    y = distance * math.sin(bearing)
    return Furniture(room, x, y, bearing + centred(rng, twist))


def _walls(
    furniture: Furniture, half_depth: float, half_width: float, middle: float, half_height: float
) -> None:
    """Add a wall on the left and one on the right."""
    for y in (-half_width, half_width):
        furniture.box((half_depth, y, middle), (half_depth, THICKNESS, half_height))


def _things(
    rng: np.random.Generator, furniture: Furniture, count: int, board: float, depth: float, half_width: float
) -> None:
    """Add things that stand on a board, as many as there are rows left for."""
    kinds = [kind for kind in ("cylinder", "box") if kind in furniture.room.kinds]
    for _ in range(min(count, furniture.left)):
        half_height = between(rng, *THING_HALF_HEIGHT)
        radius = between(rng, *THING_RADIUS)
        x = depth * between(rng, 0.1, 0.9)
        y = centred(rng, 0.85 * half_width)
        centre = (x, y, board + THICKNESS + half_height)
        if kinds[int(len(kinds) * rng.random())] == "cylinder":
            furniture.cylinder(centre, radius, half_height)
        else:
            furniture.box(centre, (radius, between(rng, *THING_RADIUS), half_height), centred(rng, 1.6))


def _separate(rng: np.random.Generator, furniture: Furniture, kind: str, centre: Vector) -> None:
    """Add an obstacle of a kind."""
    if kind == "sphere":
        furniture.sphere(centre, between(rng, 0.03, 0.10))
    elif kind == "capsule":
        rise = math.asin(centred(rng, 1.0))
        heading = centred(rng, math.pi)
        furniture.capsule(centre, between(rng, 0.015, 0.05), between(rng, 0.06, 0.25), heading, rise)
    elif kind == "cylinder":
        furniture.cylinder(centre, between(rng, 0.02, 0.08), between(rng, 0.05, 0.30))
    else:
        half = (between(rng, 0.02, 0.12), between(rng, 0.02, 0.12), between(rng, 0.02, 0.20))
        furniture.box(centre, half, centred(rng, math.pi))
