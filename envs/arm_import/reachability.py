"""Reachable workspace, inverse-kinematics table and feasibility of an imported arm."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from viapoint.envs.arm_import.mjcf_reader import BOUND, ParsedMjcf
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.ik_table import PostureMap, hand_pose, solve_map, solve_postures
from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.arms.serial_arm import RESERVE, SerialArm
from viapoint.envs.common.types import Bool, Box, Float
from viapoint.envs.geometry.distance import segment_distance_squared
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.spatial import SpaceSampler

SPACING, SEARCH_RADIUS = 0.05, 0.45
"""Of the places that are tried, and how far from home, [m]."""
CLOSE, TURNED, SPARE = 2e-4, 0.35, 0.05
"""How near the hand must come [m], how far it may be turned [rad], how far inside their ranges joints stay [rad]."""
ROOM = 0.01
"""Between links, and above the table, [m]."""
FIRST_OFF_TABLE = 2
"""Links of earlier joints may be near the table."""
NARROWEST = 0.3
"""Least width of the box along some axis, [m]: movements must find room in it."""


def shown(place: Float) -> str:
    """A place in words."""
    return f"({', '.join(f'{x:.3f}' for x in place)})"


def check_size(low: Float, high: Float) -> None:
    """Refuse a reach in which movements do not fit."""
    if (high - low).max() < NARROWEST or (high - low).min() < 2 * SPACING:
        raise ValueError(
            f"the hand reaches only a box of {np.round(high - low, 2)} m around its place at home, turned as there; "
            "give another home"
        )


class Body(NamedTuple):
    """A link's capsule in its joint's frame."""

    joint: int
    ends: tuple[Constants, Constants]
    radius: float


class Reachable:
    """Tries places of the hand."""

    def __init__(
        self, chain: Chain, hand_at: Constants, foreign: ParsedMjcf, bodies: list[Body], hand_radius: float
    ) -> None:
        self._chain, self._hand_at, self._foreign = chain, hand_at, foreign
        self._bodies, self._hand_radius = bodies, hand_radius
        self._pairs = [
            (i, j)
            for i, first in enumerate(bodies)
            for j, second in enumerate(bodies)
            if second.joint - first.joint >= 2
        ]
        self.middle = hand_pose(chain, hand_at, foreign.home)[0]
        """The hand's place at home, shape (3,), [m]."""
        close = self._between(foreign.home[None])[0] < ROOM
        self.touching = [pair for pair, near in zip(self._pairs, close, strict=True) if near]
        """Pairs of capsules that overlap at home already, as capsules are wider than links."""
        self._apart = [pair for pair, near in zip(self._pairs, close, strict=True) if not near]

    def box(self, workspace: Float | None) -> Box:
        """The reach: around home, or around a given workspace.

        Raises:
            ValueError: A place of the workspace is out of reach, or the box is too small to move in.
        """
        low, high = (self.middle, self.middle) if workspace is None else workspace
        beyond = np.arange(1, round(SEARCH_RADIUS / SPACING) + 1) * SPACING
        between = [
            np.linspace(a, b, int(np.ceil((b - a) / SPACING)) + 1) for a, b in zip(low, high, strict=True)
        ]
        axes = [
            np.concatenate((a - beyond[::-1], inner, b + beyond))
            for a, inner, b in zip(low, between, high, strict=True)
        ]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        good = self.good(places.reshape(-1, 3)).reshape(places.shape[:3])
        begin, end = [len(beyond)] * 3, [len(beyond) + len(inner) - 1 for inner in between]
        inside = tuple(slice(b, e + 1) for b, e in zip(begin, end, strict=True))
        if not good[inside].all():
            bad = places[inside][~good[inside]][0]
            raise ValueError(
                f"the hand does not get to {shown(bad)} m, turned as at home: {self._why_not(bad)}; give another "
                "home, origin or workspace"
            )
        begin, end = _grown(good, begin, end)
        corners = [np.array([axis[k] for axis, k in zip(axes, ks, strict=True)]) for ks in (begin, end)]
        check_size(corners[0], corners[1])
        return (tuple(map(float, corners[0])), tuple(map(float, corners[1])))

    def good(self, places: Float) -> Bool:
        """To which places the hand gets, shape (N,)."""
        return self.fits(places, solve_postures(self._chain, self._hand_at, self._foreign.home, places))

    def fits(self, places: Float, joints: Float, *, loose: float = 1.0) -> Bool:
        """Which postures put the hand at places as it should get there, shape (N,).

        Args:
            places: Shape (N, 3), [m].
            joints: Shape (N, J), [rad].
            loose: By which factor limits may be nearer than they should, 1 or more.
        """
        (off, turned), (spare, high, apart) = self._errors(places, joints), self._room(joints)
        good = (off < CLOSE) & (turned < TURNED * loose) & (spare > SPARE / loose).all(axis=-1)
        good &= (np.abs(places).max(axis=-1) < BOUND) & (places[:, 2] > self._hand_radius + ROOM / loose)
        return np.asarray(good & (high > ROOM / loose).all(axis=-1) & (apart > ROOM / loose).all(axis=-1))

    def _errors(self, places: Float, joints: Float) -> tuple[Float, Float]:
        """How far the hand is from places [m], and turned from home [rad], shape (N,) each."""
        place, turn = hand_pose(self._chain, self._hand_at, joints)
        home = hand_pose(self._chain, self._hand_at, self._foreign.home)[1]
        cosine = np.clip((np.einsum("nij,ij->n", turn, home) - 1.0) / 2.0, -1.0, 1.0)
        return np.abs(place - places).max(axis=-1), np.arccos(cosine)

    def _room(self, joints: Float) -> tuple[Float, Float, Float]:
        """How far joints are inside their ranges (N, J) [rad], links above the table and apart (N, .) [m]."""
        low, high = self._foreign.joint_range.T
        ends = self._ends(joints)
        above = [
            ends[:, i, :, 2].min(axis=-1) - self._bodies[i].radius
            for i in range(len(self._bodies))
            if self._bodies[i].joint >= FIRST_OFF_TABLE
        ]
        return (
            np.minimum(joints - low, high - joints),
            np.stack(above, axis=-1),
            self._between(joints, self._apart),
        )

    def _why_not(self, place: Float) -> str:
        """What is wrong with the posture that is found for a place that is not good."""
        if np.abs(place).max() >= BOUND:
            return f"coordinates must be less than {BOUND} m, where observations end"
        if place[2] <= self._hand_radius + ROOM:
            return f"the hand, of radius {self._hand_radius:g} m, comes closer than {1e3 * ROOM:.0f} mm to the table"
        joints = solve_postures(self._chain, self._hand_at, self._foreign.home, place[None])
        ((off,), (turned,)), (spare, above, apart) = self._errors(place[None], joints), self._room(joints)
        names = self._foreign.joints
        if off >= CLOSE or turned >= TURNED:
            return f"no posture near home gets nearer than {1e3 * off:.0f} mm and {turned:.2f} rad"
        if (spare <= SPARE).any():
            worst = int(spare[0].argmin())
            return (
                f"{names[worst]} comes to {joints[0, worst]:.2f} rad, less than {SPARE} rad inside its range"
            )
        if (above <= ROOM).any():
            off_table = [body for body in self._bodies if body.joint >= FIRST_OFF_TABLE]
            link = names[off_table[int(above[0].argmin())].joint]
            return f"the link of {link} comes closer than {1e3 * ROOM:.0f} mm to the table"
        first, second = (names[self._bodies[k].joint] for k in self._apart[int(apart[0].argmin())])
        return f"the links of {first} and {second} come closer than {1e3 * ROOM:.0f} mm to one another"

    def _ends(self, joints: Float) -> Float:
        places = tuple((body.joint, end) for body in self._bodies for end in body.ends)
        return np.asarray(self._chain.points(joints, places)).reshape(len(joints), -1, 2, 3)

    def _between(self, joints: Float, pairs: list[tuple[int, int]] | None = None) -> Float:
        """Clearance of pairs of links, shape (N, pairs), [m]."""
        ends, each = self._ends(joints), []
        for i, j in self._pairs if pairs is None else pairs:
            middle, half = ends[:, j].mean(axis=1), 0.5 * (ends[:, j, 1] - ends[:, j, 0])
            row = np.concatenate((middle, half, np.zeros((len(joints), 1))), axis=-1)[:, None]
            squared = segment_distance_squared(ends[:, i, :1], ends[:, i, 1:], row)[:, 0, 0]
            each.append(np.sqrt(squared) - self._bodies[i].radius - self._bodies[j].radius)
        return np.stack(each, axis=-1) if each else np.full((len(joints), 1), np.inf)


def _grown(good: Bool, begin: list[int], end: list[int]) -> tuple[list[int], list[int]]:
    """A box of good places, grown layer by layer, where it is narrowest first, as long as the layers are good."""
    begin, end = list(begin), list(end)
    stuck: set[tuple[int, int]] = set()
    while len(stuck) < 6:
        free = [(axis, step) for axis in range(3) for step in (-1, 1) if (axis, step) not in stuck]
        axis, step = min(free, key=lambda face: end[face[0]] - begin[face[0]])
        side = begin if step < 0 else end
        following = side[axis] + step
        layer = [slice(b, e + 1) for b, e in zip(begin, end, strict=True)]
        layer[axis] = slice(following, following + 1)
        if 0 <= following < good.shape[axis] and good[tuple(layer)].all():
            side[axis], stuck = following, set()
        else:
            stuck.add((axis, step))
    return begin, end


LOOKS = 16
"""Places along each axis where a map is looked at."""
LOOSE = 2.0
"""By which factor limits may be nearer between the nodes than at them."""
STEEPEST = 25.0
"""How far a joint may turn while the hand moves, [rad/m]: several times as far as where postures run smoothly."""


def good_map(
    chain: Chain, hand_at: Constants, home: Float, reachable: Reachable, box: Box, kept: Float
) -> PostureMap:
    """The map of a chain, where necessary in a smaller box.

    Args:
        chain: Of J hinges.
        hand_at: The hand in the last joint's frame, [m].
        home: Angles, shape (J,), [rad].
        reachable: Knows which postures are good.
        box: The reach, [m].
        kept: Two corners of what must stay inside, shape (2, 3), [m].

    Raises:
        ValueError: There is no such map.
    """
    while True:
        place = solve_map(chain, hand_at, home, box)
        bad = _bad(place, reachable)
        if not len(bad):
            return place
        box = _smaller(box, bad, kept)


def _bad(place: PostureMap, reachable: Reachable) -> Float:
    """Where a map does not put the hand as it should get there, or turns a joint too fast, shape (M, 3), [m]."""
    axes = [np.linspace(low, high, LOOKS) for low, high in zip(*place.box, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    joints = np.asarray(place(places))
    good = reachable.fits(places.reshape(-1, 3), joints.reshape(-1, joints.shape[-1]), loose=LOOSE)
    good = good.reshape(places.shape[:3])
    for axis in range(3):
        turned = np.abs(np.diff(joints, axis=axis)).max(axis=-1) / (axes[axis][1] - axes[axis][0])
        steep = np.moveaxis(turned > STEEPEST, axis, 0)
        smooth = np.moveaxis(good, axis, 0)
        smooth[:-1] &= ~steep
        smooth[1:] &= ~steep
    return np.asarray(places[~good])


def _smaller(box: Box, bad: Float, kept: Float) -> Box:
    """A box with one face moved inwards, such that as few bad places as possible are left."""
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        corners = np.array(box)
        corners[side, axis] += SPACING if side == 0 else -SPACING
        within = corners[0, axis] <= kept[0, axis] if side == 0 else corners[1, axis] >= kept[1, axis]
        if not within:
            continue
        left = int(((bad >= corners[0]) & (bad <= corners[1])).all(axis=-1).sum())
        faces.append((left, -float(corners[1, axis] - corners[0, axis]), corners))
    if not faces:
        raise ValueError(
            f"postures near {shown(bad[0])} m do not follow the hand smoothly from home; give another home or a "
            "smaller workspace"
        )
    _, _, corners = min(faces, key=lambda face: face[:2])
    check_size(corners[0], corners[1])
    return tuple(map(float, corners[0])), tuple(map(float, corners[1]))


SCENES = 64
"""That are drawn to see whether there is room."""


def check_strength(foreign: ParsedMjcf, chain: Chain, joints: Float, places: Sequence[str]) -> None:
    """Refuse an arm that cannot hold itself.

    Args:
        foreign: With its limits.
        chain: With its masses.
        joints: Some postures, shape (N, J), [rad].
        places: Words for where the hand is then, N of them.

    Raises:
        ValueError: With the joint, its limit and what it would need.
    """
    weight = np.abs(chain.torques(joints, 0.0 * joints, 0.0 * joints)[1])
    lacking = weight - RESERVE * foreign.torque_limit
    if (lacking >= 0.0).any():
        where, joint = np.unravel_index(lacking.argmax(), lacking.shape)
        raise ValueError(
            f"torque_limit of {foreign.joints[joint]} is {foreign.torque_limit[joint]:g} N m, of which {RESERVE:.0%} "
            f"are used, but to hold the arm {places[where]} against gravity takes {weight[where, joint]:.4g} N m"
        )


def postures_at_corners(arm: SerialArm) -> tuple[Float, list[str]]:
    """Postures with the hand in the corners of the workspace, shape (8, J), [rad], and words for these places."""
    corners = np.array(list(itertools.product(*zip(*arm.workspace, strict=True))))
    return np.asarray(arm.inverse_kinematics(corners)), [
        f"with its hand at {_shown((each,))} m" for each in corners
    ]


def check_room(arm: SerialArm, box: Box) -> None:
    """Refuse an arm in whose workspace no movements can be drawn.

    Args:
        arm: With its workspace.
        box: Its reach.

    Raises:
        ValueError: With the workspace, the reach around it, and what must have room.
    """
    wanted = SpaceDistribution(n_obstacles=(0, 0))
    try:
        SpaceSampler(CollisionModel(arm, whole_arm=True), wanted)(
            [np.random.default_rng(seed) for seed in range(SCENES)]
        )
    except RuntimeError:
        low, high = wanted.distance
        raise ValueError(
            f"workspace {_shown(arm.workspace)} m, within a reach of {_shown(box)} m, is too small: start and goal are "
            f"{low:g} to {high:g} m apart, and a movement through one via-point beside the straight line must stay "
            "within reach; give another workspace or home"
        ) from None


def _shown(corners: Iterable[Iterable[float]]) -> str:
    return " to ".join(f"({', '.join(f'{x:.2f}' for x in corner)})" for corner in corners)
