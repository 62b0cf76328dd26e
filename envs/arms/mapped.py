"""The map of an arm's postures in as much of its reach as it is good in everywhere, not at its nodes alone."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.chain import Chain, Constants
from viapoint.envs.arms.posture_map import Box, PostureMap, solve_map
from viapoint.envs.arms.reachable import SPACING, Reachable, check_size, shown

Float = NDArray[np.float64]

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
