"""Franka Emika Panda: a smooth inverse kinematics with the hand pointing down.

Seven joints put a hand at a position in infinitely many ways. Here the hand points straight down and keeps its heading,
the elbow stays up, and joint 3 takes a fixed share of the azimuth of the hand, so that joint 1 need not turn as fast:
with the upper arm near the vertical both turn the forearm about nearly the same axis. This leaves one configuration for
each position, smooth in the whole workspace.

Derivation, with the Denavit-Hartenberg dimensions of the model file. Seen from above, with the axis of joint 1 as the
origin, let the hand be at distance h and azimuth a. Joint 3 is q3 = ROLL_SHARE * a. The wrist (where the axes of joints
5 and 6 meet) is HAND_DROP above the hand, and WRIST away from it in the horizontal direction of the forearm. Let b be
the angle, seen from above, between the forearm and the line from the origin to the wrist, and r that line's length:

    h^2 = (r + WRIST cos b)^2 + (WRIST sin b)^2.                                                   (1)

Shoulder, joint 4 and wrist form a triangle with the sides UPPER_SIDE and FORE_SIDE. Its third side has r and the height
of the wrist over the shoulder, so the law of cosines gives q4.                                    (2)
In the frame of joint 3, before its roll, q4 gives the place of the wrist: `fold` ahead and `rise` along the upper arm.
The roll moves `fold sin q3` sideways; joint 2 turns the rest until the wrist has its height.      (3)
The direction of the forearm then follows, and with it b.                                          (4)

Only b is found by iteration of (1) to (4), from b = 0: it is small, and each iteration gains one to two digits. Joint 1
turns the wrist to its azimuth, and joints 5 to 7 orient the hand. (Y. He and S. Liu, Analytical inverse kinematics for
Franka Emika Panda, ICCMA 2021, has closed forms for a given joint 7 instead of joint 3.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.arms.serial_arm import serial_arm
from viapoint.envs.common.arrays import cosine_and_sine, dot
from viapoint.envs.common.types import Array

SHOULDER, UPPER, FORE, ELBOW, WRIST = 0.333, 0.316, 0.384, 0.0825, 0.088
"""Height of the shoulder, lengths of upper arm and forearm, and offsets of the axes of elbow and wrist, [m]."""
HAND_DROP = 0.107 + 0.1034
"""Distance from the wrist down to the hand, [m]: flange and fingers."""
ROLL_SHARE = 0.3
"""Share of the hand's azimuth that joint 3 takes."""
ITERATIONS = 5
"""Iterations for the angle between forearm and wrist; each reduces its error by a factor of 10 to 100."""
UPPER_SIDE, FORE_SIDE = float(np.hypot(UPPER, ELBOW)), float(np.hypot(FORE, ELBOW))
"""Distances of joint 4 from the shoulder and from the wrist, [m]."""
ELBOW_ANGLE = float(np.arctan2(UPPER, ELBOW) + np.arctan2(FORE, ELBOW) - 2.0 * np.pi)
"""Angle of joint 4 less the angle between these two sides, [rad]."""

MIN_REACH, MAX_REACH = 0.31, 0.69
"""Least and greatest distance of the wrist from the shoulder, [m]: joint 4 within its range, the arm never straight."""
MIN_HEIGHT = 0.025
"""Least height of the hand above the table, [m]: its radius and the tracking error."""
MAX_HEIGHT = 0.73
"""Greatest height of the hand, [m]: the gripper stays clear of the forearm, which then points upwards."""
MIN_DISTANCE = 0.34
"""Least distance of the hand from the axis of joint 1, [m]: forearm and hand stay clear of the column."""
MAX_AZIMUTH = 1.4
"""Greatest azimuth of the hand to either side, [rad]."""


@dataclass(frozen=True)
class PandaInverseKinematics:
    """Inverse kinematics of the Panda; see :class:`~viapoint.envs.arms.serial_arm.InverseKinematics`."""

    def __call__(self, hand: Array) -> Array:
        """Return joint angles, shape (..., 7), [rad], for hand positions of shape (..., 3), [m]."""
        x, y = hand[..., 0], hand[..., 1]
        height = hand[..., 2] + (HAND_DROP - SHOULDER)
        square, azimuth = x * x + y * y, np.atan2(y, x)
        roll = ROLL_SHARE * azimuth
        c3, s3 = cosine_and_sine(roll)
        cos_b, sin_b = np.ones_like(x), np.zeros_like(x)
        for _ in range(ITERATIONS):
            reach = np.sqrt(np.maximum(square - (WRIST * sin_b) ** 2, 1e-4)) - WRIST * cos_b  # (1)
            between, c4, s4 = _elbow(reach * reach + height * height)  # (2)
            fold = ELBOW - ELBOW * c4 - FORE * s4
            rise = UPPER - ELBOW * s4 + FORE * c4
            lean, left = fold * c3, fold * s3
            c2, s2, ahead = _shoulder(lean, rise, height)  # (3)
            # Horizontal direction of the forearm in the frame of joint 1, in which the wrist is at (ahead, left).
            fore = c4 * s2 - s4 * c3 * c2, -s4 * s3
            scale = 1.0 / np.sqrt((fore[0] ** 2 + fore[1] ** 2) * (ahead**2 + left**2))
            cos_b = (fore[0] * ahead + fore[1] * left) * scale  # (4)
            sin_b = (fore[1] * ahead - fore[0] * left) * scale
        q2, q4 = np.atan2(s2, c2), np.acos(between) + ELBOW_ANGLE
        wrist_azimuth = azimuth - np.atan2(WRIST * sin_b, reach + WRIST * cos_b)
        q1 = wrist_azimuth - np.atan2(left, ahead)
        # Joint 6 bends the forearm's direction to the vertical. Its axis is horizontal if x5, which is normal to the
        # forearm, lies in the vertical plane through it; joint 5 turns x4 to x5, and y3 is normal to x4 and forearm.
        level = np.sqrt(fore[0] ** 2 + fore[1] ** 2)
        upwards = s4 * c3 * s2 + c4 * c2
        along, across = fore[0] / level, fore[1] / level
        x5 = upwards * along, upwards * across, -level
        x4 = c4 * c3 * c2 + s4 * s2, c4 * s3, -c4 * c3 * s2 + s4 * c2
        y3 = -s3 * c2, c3, s3 * s2
        q5 = np.atan2(dot(x5, y3), dot(x5, x4))
        q6 = np.atan2(level, upwards)
        q7 = q1 + np.atan2(fore[1], fore[0]) + np.pi / 4  # keeps the heading
        return np.stack((q1, q2, roll, q4, q5, q6, q7), axis=-1)

    def margin(self, hand: Array) -> Any:
        """Return the least distance to the bounds of the reach, shape (...,), [m].

        The bounds are a shell about the shoulder, a column and a wedge about the axis of joint 1, the table, and a
        greatest height.
        """
        x, y, height = hand[..., 0], hand[..., 1], hand[..., 2]
        column = np.sqrt(x * x + y * y + 1e-12)
        reach = np.sqrt((column - WRIST) ** 2 + (height + (HAND_DROP - SHOULDER)) ** 2)
        arc = (MAX_AZIMUTH - np.abs(np.atan2(y, x))) * column
        shell = np.minimum(reach - MIN_REACH, MAX_REACH - reach)
        level = np.minimum(height - MIN_HEIGHT, MAX_HEIGHT - height)
        return np.minimum(np.minimum(shell, arc), np.minimum(column - MIN_DISTANCE, level))


def _elbow(square: Array) -> tuple[Array, Array, Array]:
    """Return the cosine of the triangle's angle at joint 4, and cosine and sine of that joint.

    The argument is the squared distance of shoulder and wrist, [m^2].
    """
    cosine = (UPPER_SIDE**2 + FORE_SIDE**2 - square) * (0.5 / (UPPER_SIDE * FORE_SIDE))
    cosine = cosine.clip(-0.9999, 0.9999)
    sine = np.sqrt(1.0 - cosine * cosine)
    c, s = math.cos(ELBOW_ANGLE), math.sin(ELBOW_ANGLE)
    return cosine, c * cosine - s * sine, s * cosine + c * sine


def _shoulder(lean: Array, rise: Array, height: Array) -> tuple[Array, Array, Array]:
    """Return cosine and sine of joint 2 that bring the wrist to a height, and its distance ahead, [m].

    Joint 2 turns (lean, rise) into (ahead, height): height = rise cos q2 - lean sin q2.
    """
    square = lean * lean + rise * rise
    length = np.sqrt(square)
    up = length * (height / length).clip(-0.9999, 0.9999)
    ahead = np.sqrt(square - up * up)
    share = 1.0 / square
    return (up * rise + ahead * lean) * share, (ahead * rise - up * lean) * share, ahead


PANDA = serial_arm(
    "panda.xml",
    name="panda",
    joint_names=tuple(f"joint{number}" for number in range(1, 8)),
    hand_site="hand",
    ik=PandaInverseKinematics(),
    workspace=((0.36, -0.36, 0.06), (0.64, 0.36, 0.50)),
    hand_gains=(10000.0, 300.0),
)
"""Franka Emika Panda on a table, its base at the origin, x forwards and z up.

Its capsules contain Franka's collision geometry.
"""
