"""Boundary values and waypoints: the argument checks that all movements share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._hermite_tables import ORDERS
from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    as_floats,
    is_given,
    leading_shape,
    require,
    to_numpy,
)

Ends = dict[str, Boundary]  # The four boundary values by name, in the order of END_NAMES

# Distance of waypoints that count as equal, in units of the rounding of their greatest coordinate.
_EQUAL = 64.0

END_NAMES = ("start_velocity", "start_acceleration", "goal_velocity", "goal_acceleration")


def read_arguments(
    ends: tuple[Boundary, Boundary, Boundary, Boundary],
    optional: Mapping[str, Any] | None = None,
    /,
    **required: Any,
) -> tuple[Namespace, list[Any], Ends]:
    """Convert the arguments of a movement to one library and dtype, see `as_floats`.

    `ends` are the values of END_NAMES. They are returned by name, after the namespace and the other arrays.
    """
    named = dict(zip(END_NAMES, ends, strict=True))
    xp, arrays = as_floats({**(optional or {}), **named}, **required)
    return xp, arrays[:-4], dict(zip(END_NAMES, arrays[-4:], strict=True))


def check_order(order: int, start_acceleration: Boundary, goal_acceleration: Boundary) -> None:
    """Raise ValueError for an unknown order, or for order 2 with boundary accelerations."""
    if not isinstance(order, int | np.integer) or order not in ORDERS:
        raise ValueError(f"order must be 2 (acceleration), 3 (jerk) or 4 (snap), got {order!r}")
    given = {"start_acceleration": start_acceleration, "goal_acceleration": goal_acceleration}
    for name, value in given.items():
        if order == 2 and is_given(value):
            raise ValueError(f"{name} cannot be given for order 2: least acceleration leaves it open")


def end_shapes(ends: Mapping[str, Boundary], dimension: int) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of the given boundary values; raise ValueError if a last axis is not D."""
    shapes = {}
    for name, value in ends.items():
        if value is not None and value is not FREE:
            shapes[name] = leading_shape(name, value, dimension)
    return shapes


def waypoint_shapes(waypoints: Array, ends: Ends) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of waypoints and of boundary values, or raise ValueError."""
    shape = leading_shape("waypoints", waypoints, None, None)
    if waypoints.shape[-2] < 2:
        raise ValueError("waypoints must hold start and goal, got one point")
    return {"waypoints": shape, **end_shapes(ends, waypoints.shape[-1])}


def check_durations(name: str, durations: Array, waypoints: Array, ends: Ends) -> None:
    """Raise ValueError for durations (..., S) below 0, and for 0 between waypoints (..., S + 1, D) that differ.

    All durations of a movement may be 0 only if its ends are at rest.
    """
    if (durations > 0).all():
        return
    require(durations >= 0, name, durations, "must not be negative")
    points, numbers = to_numpy(waypoints), to_numpy(durations)
    positive = np.broadcast_to(numbers > 0, (*points.shape[:-2], numbers.shape[-1]))
    rounding = _EQUAL * np.finfo(points.dtype).eps * np.abs(points).max(axis=(-2, -1), initial=0.0)
    equal = np.abs(np.diff(points, axis=-2)).max(axis=-1) <= rounding[..., None]
    require(positive | equal, name, 1.0 * positive, "may be 0 only between equal waypoints")
    moves = np.zeros(positive.shape[:-1], dtype=bool)
    for value in ends.values():
        if is_given(value):
            moves = moves | (to_numpy(value) != 0).any(axis=-1)
    require(positive.any(axis=-1) | ~moves, name, 1.0 * moves, "must not be 0 for a movement whose ends move")


def knot_states(order: int, ends: Ends, vias: int = 0) -> list[list[Any]]:
    """Return the m - 1 derivatives at every knot: given at the ends, FREE at via-points.

    Order 4 (snap) has the jerk zero at both ends.
    """
    values = list(ends.values())
    states = [[*values[:2], None][: order - 1]]
    for _ in range(vias):
        states.append([FREE] * (order - 1))
    return [*states, [*values[2:], None][: order - 1]]


def unit_time_ends(ends: Sequence[Boundary], duration: Array) -> list[Any]:
    """Return the values of END_NAMES in unit time, V = v T and A = a T^2; None and FREE stay."""
    time = duration[..., None]
    powers = time, time * time, time, time * time
    return [value * power if is_given(value) else value for value, power in zip(ends, powers, strict=True)]
