"""Speed and curvature profiles of the model and of the simulated arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory
from viapoint.training.paper.simulated import SimulatedMovements

EDGE = 0.08
"""Fraction of the duration left out at both ends, where the curvature of a movement from rest has no bound.

It grows as t^-2, so the curvature peak is the greatest local maximum inside.
"""
SAMPLES = 2001


class Profile(NamedTuple):
    """Speed and curvature of one movement at T instants."""

    time: Float
    """Instants as fractions of the duration, shape (T,)."""
    speed: Float
    """[m/s]"""
    curvature: Float
    """Unsigned, [1/m]."""
    position: Float
    """Shape (T, 2), [m]."""

    @classmethod
    def of(cls, time: Float, position: Float, velocity: Float, acceleration: Float) -> Profile:
        """Return the profile of hand position, velocity and acceleration, shape (T, 2), at fractions of the duration.

        kappa = |x' y'' - y' x''| / |v|^3
        """
        speed = np.linalg.norm(velocity, axis=-1)
        turn = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
        safe = np.maximum(speed, 1e-9)
        return cls(time, speed, np.abs(turn) / (safe * safe * safe), position)

    @property
    def valley(self) -> float:
        """Time of the least speed between two peaks, as a fraction of the duration; NaN without a valley."""
        places = _peaks(self.time, -self.speed)
        return places[0][0] if places else np.nan

    @property
    def valley_depth(self) -> float:
        """Speed in the valley relative to the mean of the two highest peaks; 1 without a valley."""
        valleys, peaks = _peaks(self.time, -self.speed), self.peaks
        return -valleys[0][1] / float(np.mean(peaks[:2, 1])) if valleys and len(peaks) > 1 else 1.0

    @property
    def peaks(self) -> Float:
        """Time and height of the local maxima of the speed, the highest first, shape (n, 2)."""
        return np.array(_peaks(self.time, self.speed)).reshape(-1, 2)

    @property
    def bend(self) -> tuple[float, float]:
        """Time and height [1/m] of the greatest local maximum of the curvature; NaN without one."""
        places = _peaks(self.time, self.curvature)
        return places[0] if places else (np.nan, np.nan)

    def place(self, time: float) -> Float:
        """Return the hand position at a fraction of the duration, shape (2,), [m]."""
        return np.array([np.interp(time, self.time, self.position[:, i]) for i in (0, 1)])


def model_profile(movement: Trajectory) -> Profile:
    """Return the profile of a single movement of the model."""
    position, velocity, acceleration = movement.sample(SAMPLES)
    return Profile.of(np.linspace(0.0, 1.0, SAMPLES), position, velocity, acceleration)


def arm_profile(motion: SimulatedMovements, row: int = 0) -> Profile:
    """Return the profile of one movement of the simulated arm."""
    within = motion.time <= motion.duration[row] + 1e-9
    fields = (part[row, within] for part in (motion.hand, motion.velocity(), motion.acceleration()))
    return Profile.of(motion.time[within] / motion.duration[row], *fields)


def vertex(before: float, here: float, after: float) -> tuple[float, float]:
    """Return the vertex of the parabola through three equidistant samples: offset from the middle one, and height."""
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return shift, here - 0.25 * (before - after) * shift


def _peaks(time: Float, value: Float) -> list[tuple[float, float]]:
    """Return time and height of local maxima away from the ends, the highest first, by parabolas through samples."""
    inner = (time > EDGE) & (time < 1.0 - EDGE)
    index = np.flatnonzero(inner[1:-1] & (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])) + 1
    found = []
    for i in index:
        shift, height = vertex(*value[i - 1 : i + 2])
        found.append((float(time[i] + shift * (time[i + 1] - time[i])), float(height)))
    return sorted(found, key=lambda each: -each[1])
