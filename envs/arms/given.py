"""What is said of an arm of one's own beside its file, and whether it can be meant."""

from __future__ import annotations

import os
from collections.abc import Iterable
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

FLATTEST = 1e-3
"""Least width of a workspace, in which places are drawn, [m]."""
BOUND = 0.95
"""Greatest coordinate of a place of the hand, [m]: observations end at 1."""


def path_of(value: Any) -> Path:
    """Of the arm's file."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise TypeError(f"path must be the name of an MJCF file, got {value!r}")
    path = Path(value)
    if not path.is_file():
        raise ValueError(f"there is no file {os.fspath(value)!r}")
    return path


def name_of(value: Any) -> str:
    """Of the arm, by which files of runs and models know it."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"name must be a string of a character or more, got {value!r}")
    return value


def names_of(joints: Any) -> tuple[str, ...]:
    """Of the joints."""
    names = tuple(joints) if isinstance(joints, Iterable) and not isinstance(joints, str) else ()
    if not names or not all(isinstance(each, str) for each in names):
        raise ValueError(f"joints must be names, in order from the base to the hand, got {joints!r}")
    if len(set(names)) < len(names):
        raise ValueError(f"joints must be named once each, got {joints!r}")
    return names


def one_for_each(name: str, values: Any, joints: tuple[str, ...]) -> Float:
    """A number for each joint; one that is given stands for all."""
    numbers = _numbers(values)
    if numbers is None or numbers.shape not in ((), (1,), (len(joints),)):
        raise ValueError(f"{name} must be {len(joints)} numbers, one for each joint, got {values!r}")
    return np.array(np.broadcast_to(numbers, (len(joints),)))


def ranges_of(values: Any, joints: tuple[str, ...]) -> Float:
    """Lowest and highest angle of each joint, shape (J, 2), [rad]."""
    ranges = _numbers(values)
    good = ranges is not None and ranges.shape == (len(joints), 2) and bool(np.isfinite(ranges).all())
    if ranges is None or not good or not (ranges[:, 0] < ranges[:, 1]).all():
        raise ValueError(
            f"joint_range must be {len(joints)} pairs of finite numbers in increasing order, got {values!r}"
        )
    return ranges


def point_of(name: str, values: Any) -> Float:
    """A place, shape (3,), [m]."""
    point = _numbers(values)
    if point is None or point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} must be three finite numbers, x, y and z in m, got {values!r}")
    return point


def box_of(values: Any) -> Float:
    """Lowest and highest corner of a box of which two opposite corners are given, shape (2, 3), [m]."""
    corners = _numbers(values)
    if corners is None or corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise ValueError(
            f"workspace must be two opposite corners, each of three finite numbers in m, got {values!r}"
        )
    far = corners[(np.abs(corners) >= BOUND).any(axis=-1)]
    if len(far):
        raise ValueError(
            f"the hand does not get to ({', '.join(f'{x:.4g}' for x in far[0])}) m: coordinates must be less than "
            f"{BOUND} m, where observations end; give another workspace or origin"
        )
    if (np.abs(corners[1] - corners[0]) < FLATTEST).any():
        raise ValueError(
            f"workspace must be a box that is {1e3 * FLATTEST:g} mm wide or more in x, y and z, got {values!r}"
        )
    return np.sort(corners, axis=0)


def radius_of(value: Any) -> float:
    """Of the hand, [m]."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0.0 < float(value) < BOUND):
        raise ValueError(f"hand_radius must be a positive number of m, less than {BOUND}, got {value!r}")
    return float(value)


def _numbers(values: Any) -> Float | None:
    """Real numbers as an array; None where they are something else."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # rows of different lengths, say
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiu" else None
