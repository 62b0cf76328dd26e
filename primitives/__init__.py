"""Minimum-jerk movements through via-points: numbers in, trajectories out.

Every function takes NumPy arrays or torch tensors with any leading (batch) dimensions and returns the same kind. Units are
metres and seconds.
"""

from ._arrays import FREE
from .passage_times import passage_durations
from .reaching import minimum_jerk_coefficients, point_to_point
from .trajectory import Trajectory
from .via_points import through

__all__ = [
    "FREE",
    "Trajectory",
    "minimum_jerk_coefficients",
    "passage_durations",
    "point_to_point",
    "through",
]
