"""A Franka Emika Panda: the posture it takes for a place of its hand.

Seven joints put a hand anywhere in more ways than one. Here the hand points straight down and keeps its heading, the
elbow stays up, and joint 3 takes a fixed share of the turn towards the hand, so that joint 1 need not turn as fast:
with the upper arm near the vertical both turn the forearm about nearly the same axis. That leaves one posture for a
place, smooth all over the workspace, and almost a closed form of it: triangles, but for one small angle that is found
in a few steps. (For closed forms with a given joint 7 see Y. He and S. Liu, Analytical inverse kinematics for Franka
Emika Panda, ICCMA 2021.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from viapoint.envs.arms.serial_arm import serial_arm
from viapoint.envs.common.arrays import clamp, cosine_and_sine
from viapoint.primitives.array_api import Array, namespace_of

SHOULDER, UPPER, FORE, ELBOW, WRIST = 0.333, 0.316, 0.384, 0.0825, 0.088
"""Height of the shoulder, length of upper arm and forearm, and how far the axes of elbow and wrist stand off, [m]."""
DROP = 0.107 + 0.1034
"""From the wrist's last joint down to the hand, [m]."""
SHARE = 0.3
"""Of the turn towards the hand, taken by joint 3."""
STEPS = 5
"""That find the angle between forearm and wrist as seen from above: each is ten to a hundred times as exact."""
UPPER_SIDE, FORE_SIDE = float(np.hypot(UPPER, ELBOW)), float(np.hypot(FORE, ELBOW))
"""From the shoulder to joint 4, and from there to the wrist, [m]."""
OPENED = float(np.arctan2(UPPER, ELBOW) + np.arctan2(FORE, ELBOW) - 2.0 * np.pi)
"""Angle of joint 4 less that between these two, [rad]."""

CLOSEST, FARTHEST = 0.31, 0.69
"""Least and greatest distance of shoulder and wrist, [m]: joint 4 stays inside its range, the arm is never straight."""
TABLE = 0.025
"""Least height of the hand above the table, [m]: its radius, and what tracking may cost."""
ROUND = 0.34
"""Least distance of the hand from the axis of joint 1, [m]: forearm and hand stay clear of the column."""
TURN = 1.4
"""Greatest turn of the hand about that axis to either side, [rad]."""


@dataclass(frozen=True)
class PandaPosture:
    """See :class:`~viapoint.envs.arms.serial_arm.Posture`."""

    def __call__(self, hand: Array) -> Array:
        """Joint angles, shape (..., 7), [rad], for hand positions of shape (..., 3), [m]."""
        xp = namespace_of(hand)
        x, y = hand[..., 0], hand[..., 1]
        height = hand[..., 2] + (DROP - SHOULDER)
        square, azimuth = x * x + y * y, xp.atan2(y, x)
        roll = SHARE * azimuth
        c3, s3 = cosine_and_sine(roll)
        bend, side = xp.ones_like(x), xp.zeros_like(x)
        for _ in range(STEPS):
            reach = xp.sqrt(xp.maximum(square - (WRIST * side) ** 2, 1e-4)) - WRIST * bend
            between, c4, s4 = _elbow(reach * reach + height * height)
            fold = ELBOW - ELBOW * c4 - FORE * s4
            rise = UPPER - ELBOW * s4 + FORE * c4
            lean, left = fold * c3, fold * s3
            c2, s2, ahead = _shoulder(lean, rise, height)
            # The forearm's direction as seen from above, in the frame of joint 1, and the wrist's.
            fore = c4 * s2 - s4 * c3 * c2, -s4 * s3
            scale = 1.0 / xp.sqrt((fore[0] ** 2 + fore[1] ** 2) * (ahead**2 + left**2))
            bend = (fore[0] * ahead + fore[1] * left) * scale
            side = (fore[1] * ahead - fore[0] * left) * scale
        q2, q4 = xp.atan2(s2, c2), xp.acos(between) + OPENED
        wrist = azimuth - xp.atan2(WRIST * side, reach + WRIST * bend)
        q1 = wrist - xp.atan2(left, ahead)
        level = xp.sqrt(fore[0] ** 2 + fore[1] ** 2)
        down = s4 * c3 * s2 + c4 * c2
        along, across = fore[0] / level, fore[1] / level
        x5 = down * along, down * across, -level
        x4 = c4 * c3 * c2 + s4 * s2, c4 * s3, -c4 * c3 * s2 + s4 * c2
        y3 = -s3 * c2, c3, s3 * s2
        q5 = xp.atan2(_dot(x5, y3), _dot(x5, x4))
        q6 = xp.atan2(level, down)
        q7 = q1 + xp.atan2(fore[1], fore[0]) + np.pi / 4
        return xp.stack((q1, q2, roll, q4, q5, q6, q7), axis=-1)

    def margin(self, hand: Array) -> Array:
        """The least of the distances to a shell about the shoulder, a column and a wedge about the axis, the table."""
        xp = namespace_of(hand)
        x, y, height = hand[..., 0], hand[..., 1], hand[..., 2]
        column = xp.sqrt(x * x + y * y + 1e-12)
        reach = xp.sqrt((column - WRIST) ** 2 + (height + (DROP - SHOULDER)) ** 2)
        arc = (TURN - xp.abs(xp.atan2(y, x))) * column
        shell = xp.minimum(reach - CLOSEST, FARTHEST - reach)
        return xp.minimum(xp.minimum(shell, arc), xp.minimum(column - ROUND, height - TABLE))


def _elbow(square: Array) -> tuple[Array, Array, Array]:
    """Cosine of the angle between the sides that meet in joint 4, and cosine and sine of that joint's own."""
    xp = namespace_of(square)
    cosine = (UPPER_SIDE**2 + FORE_SIDE**2 - square) * (0.5 / (UPPER_SIDE * FORE_SIDE))
    cosine = clamp(cosine, -0.9999, 0.9999)
    sine = xp.sqrt(1.0 - cosine * cosine)
    c, s = math.cos(OPENED), math.sin(OPENED)
    return cosine, c * cosine - s * sine, s * cosine + c * sine


def _shoulder(lean: Array, rise: Array, height: Array) -> tuple[Array, Array, Array]:
    """Cosine and sine of joint 2's angle that brings the wrist to a height, and how far ahead it is then."""
    xp = namespace_of(lean)
    square = lean * lean + rise * rise
    length = xp.sqrt(square)
    up = length * clamp(height / length, -0.9999, 0.9999)
    ahead = xp.sqrt(square - up * up)
    share = 1.0 / square
    return (up * rise + ahead * lean) * share, (ahead * rise - up * lean) * share, ahead


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return sum(u * v for u, v in zip(a, b, strict=True))


PANDA = serial_arm(
    "panda.xml",
    name="panda",
    joint_names=tuple(f"joint{number}" for number in range(1, 8)),
    hand_site="hand",
    place=PandaPosture(),
    workspace=((0.36, -0.36, 0.06), (0.64, 0.36, 0.50)),
    hand_gains=(10000.0, 300.0),
)
"""A Franka Emika Panda on a table, its base at the origin, x forwards and z up."""
