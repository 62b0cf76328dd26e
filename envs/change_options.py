"""What will become of scenes, as `reset(options=...)` gives it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.courses import MOST_JUMPS
from viapoint.envs.scene_options import GIVEN, numbers, refuse_unknown_options

Float = NDArray[np.float64]

CHANGES = ("jumps", "courses")
"""What options may give beside a scene."""


def given_changes(
    options: Mapping[str, Any], number: int, dimension: int, n_rows: int
) -> tuple[Float | None, Float | None]:
    """Jumps and courses of N scenes, shape (N, MOST_JUMPS, D + 1) and (N, n, 2 D + 1); None where not given.

    Args:
        options: May hold `jumps`, rows (time, target D), and `courses`, rows (velocity D, time, velocity D), one
            for each obstacle that is given; of one scene, which all share, or of each, shape (N, ., .).
        number: Of scenes, N.
        dimension: D.
        n_rows: Obstacles of a scene at most, n.

    Raises:
        ValueError: An array is not finite or has another shape, a course belongs to no obstacle, or a name is unknown.
    """
    refuse_unknown_options(options, (*GIVEN, *CHANGES))
    jumps, courses = None, None
    if "jumps" in options:
        jumps = _packed(_padded("jumps", options["jumps"], (number, MOST_JUMPS, dimension + 1)))
    if "courses" in options:
        if "obstacles" not in options:
            raise ValueError("options['courses'] are those of options['obstacles'], which must be given, too")
        courses = _padded("courses", options["courses"], (number, n_rows, 2 * dimension + 1))
    elif "obstacles" in options:
        courses = np.zeros((number, n_rows, 2 * dimension + 1))
    return jumps, courses


def check_owners(courses: Float, present: NDArray[np.bool_]) -> None:
    """Refuse courses of obstacles that there are not."""
    lost = (courses != 0.0).any(axis=-1) & ~present
    if lost.any():
        scene, row = np.argwhere(lost)[0]
        raise ValueError(
            f"scene {scene}: course {row} belongs to no obstacle; there are {present[scene].sum()}"
        )


def _packed(rows: Float) -> Float:
    """Rows of zeros, which are none, behind the others."""
    order = np.argsort((rows == 0.0).all(axis=-1), axis=-1, kind="stable")
    return np.take_along_axis(rows, order[..., None], axis=1)


def _padded(name: str, value: Any, shape: tuple[int, int, int]) -> Float:
    """Rows of one scene or of each, with rows of zeros behind them."""
    number, most, size = shape
    given = numbers(name, value)
    given = given.reshape((0, size)) if given.size == 0 else given
    fits = given.ndim in (2, 3) and given.shape[-1] == size and given.shape[-2] <= most
    if not fits or (given.ndim == 3 and len(given) not in (1, number)):
        raise ValueError(
            f"options[{name!r}] must have shape (n, {size}) or ({number}, n, {size}) with n at most {most}, "
            f"got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise ValueError(f"options[{name!r}] must be finite, got {given[~np.isfinite(given)][0]}")
    rows = np.zeros(shape)
    rows[:, : given.shape[-2]] = given
    return rows
