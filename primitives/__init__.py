"""Minimum-jerk movements through via-points.

Every function takes NumPy arrays or torch tensors with any leading (batch) dimensions and returns the same
kind. Units are metres and seconds.
"""

from .array_api import FREE
from .fitting import ViaPointFit, fit_via_points
from .minimum_jerk import minimum_jerk_coefficients, point_to_point, retarget, through
from .passage_times import passage_durations
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
from .trajectory import CostGradient, Extrema, Trajectory, cost_gradient, minimum_duration

__all__ = [
    "FREE",
    "CostGradient",
    "Extrema",
    "SpeedEvents",
    "Trajectory",
    "ViaPointFit",
    "cost_gradient",
    "curvature",
    "dimensionless_jerk",
    "fit_via_points",
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
