"""Where an arm gets with its hand turned as at home: the largest box that a search finds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.chain import Chain, Constants
from viapoint.envs.arms.foreign import Foreign
from viapoint.envs.arms.given import BOUND
from viapoint.envs.arms.posture_map import Box, hand_pose, solve_postures
from viapoint.envs.clearance import segment_distance_squared

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

SPACING, FAR = 0.05, 0.45
"""Of the places that are tried, and how far from home, [m]."""
CLOSE, TURNED, SPARE = 2e-4, 0.35, 0.05
"""How near the hand must come [m], how far it may be turned [rad], how far inside their ranges joints stay [rad]."""
ROOM = 0.01
"""Between links, and above the table, [m]."""
FIRST_OFF_TABLE = 2
"""Links of earlier joints may be near the table."""
NARROWEST = 0.3
"""Least width of the box along some axis, [m]: movements must find room in it."""


class Body(NamedTuple):
    """A link's capsule in its joint's frame."""

    joint: int
    ends: tuple[Constants, Constants]
    radius: float


class Reachable:
    """Tries places of the hand."""

    def __init__(
        self, chain: Chain, hand_at: Constants, foreign: Foreign, bodies: list[Body], hand_radius: float
    ) -> None:
        self._chain, self._hand_at, self._foreign = chain, hand_at, foreign
        self._bodies, self._hand_radius = bodies, hand_radius
        self._pairs = [
            (i, j)
            for i, first in enumerate(bodies)
            for j, second in enumerate(bodies)
            if second.joint - first.joint >= 2
        ]
        close = self._between(foreign.home[None])[0] < ROOM
        self.touching = [pair for pair, near in zip(self._pairs, close, strict=True) if near]
        """Pairs of capsules that overlap at home already, as capsules are wider than links."""
        self._apart = [pair for pair, near in zip(self._pairs, close, strict=True) if not near]

    def box(self, workspace: Float | None) -> Box:
        """The reach: around home, or around a given workspace.

        Raises:
            ValueError: A place of the workspace is out of reach, or the box is too small to move in.
        """
        middle = hand_pose(self._chain, self._hand_at, self._foreign.home)[0]
        low, high = (middle, middle) if workspace is None else workspace
        around = np.arange(-FAR, FAR + 1e-9, SPACING)
        axes = [
            np.concatenate((near + around[around < 0.0], np.arange(near, far + FAR + 1e-9, SPACING)))
            for near, far in zip(low, high, strict=True)
        ]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        good = self.good(places.reshape(-1, 3)).reshape(places.shape[:3])
        begin, end = (
            [int(np.searchsorted(axis, value - 1e-9)) for axis, value in zip(axes, corner, strict=True)]
            for corner in (low, high)
        )
        inside = tuple(slice(b, e + 1) for b, e in zip(begin, end, strict=True))
        if not good[inside].all():
            bad = places[inside][~good[inside]][0]
            raise ValueError(
                f"the hand does not get to ({', '.join(f'{x:.3f}' for x in bad)}) m, turned as at home, with every "
                "joint inside its range and clear of arm and table; give another home, origin or workspace"
            )
        begin, end = _grown(good, begin, end)
        corners = [np.array([axis[k] for axis, k in zip(axes, ks, strict=True)]) for ks in (begin, end)]
        if (corners[1] - corners[0]).max() < NARROWEST or (corners[1] - corners[0]).min() < 2 * SPACING:
            raise ValueError(
                f"the hand reaches only a box of {np.round(corners[1] - corners[0], 2)} m around its place at home, "
                "turned as there; give another home"
            )
        return (tuple(map(float, corners[0])), tuple(map(float, corners[1])))

    def good(self, places: Float) -> Bool:
        """To which places the hand gets, shape (N,)."""
        foreign = self._foreign
        joints = solve_postures(self._chain, self._hand_at, foreign.home, places)
        place, turn = hand_pose(self._chain, self._hand_at, joints)
        home = hand_pose(self._chain, self._hand_at, foreign.home)[1]
        cosine = np.clip((np.einsum("nij,ij->n", turn, home) - 1.0) / 2.0, -1.0, 1.0)
        low, high = foreign.joint_range.T
        good = (np.abs(place - places).max(axis=-1) < CLOSE) & (np.arccos(cosine) < TURNED)
        good &= ((joints > low + SPARE) & (joints < high - SPARE)).all(axis=-1)
        good &= (np.abs(places).max(axis=-1) < BOUND) & (places[:, 2] > self._hand_radius + ROOM)
        return np.asarray(good & self._clear(joints))

    def _clear(self, joints: Float) -> Bool:
        """Which postures leave links and table apart."""
        ends = self._ends(joints)
        high = np.stack(
            [
                ends[:, i, :, 2].min(axis=-1) - body.radius
                for i, body in enumerate(self._bodies)
                if body.joint >= FIRST_OFF_TABLE
            ],
            axis=-1,
        )
        distances = self._between(joints, self._apart)
        return np.asarray((high > ROOM).all(axis=-1) & (distances > ROOM).all(axis=-1))

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
