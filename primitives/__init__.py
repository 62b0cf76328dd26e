"""Minimum-jerk movements through via-points: numbers in, trajectories out.

Every function takes NumPy arrays or torch tensors with any leading (batch) dimensions and returns the same
kind. Units are metres and seconds.
"""

from ._arrays import FREE
from ._extremes import Extrema
from .gradients import CostGradient, cost_gradient
from .limits import minimum_duration
from .online import retarget
from .passage_times import passage_durations
from .reaching import minimum_jerk_coefficients, point_to_point
from .smoothness import (
    SpeedEvents,
    curvature,
    dimensionless_jerk,
    log_dimensionless_jerk,
    spectral_arc_length,
    speed,
    speed_peaks,
    speed_valleys,
)
from .trajectory import Trajectory
from .via_points import through

__all__ = [
    "FREE",
    "CostGradient",
    "Extrema",
    "SpeedEvents",
    "Trajectory",
    "cost_gradient",
    "curvature",
    "dimensionless_jerk",
    "log_dimensionless_jerk",
    "minimum_duration",
    "minimum_jerk_coefficients",
    "passage_durations",
    "point_to_point",
    "retarget",
    "spectral_arc_length",
    "speed",
    "speed_peaks",
    "speed_valleys",
    "through",
]
