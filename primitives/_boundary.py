"""From points, durations and boundary values to a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._hermite_tables import ORDERS, coefficient_table
from ._knot_solver import States, solve_states
from .array_api import (
    FREE,
    Array,
    Boundary,
    Namespace,
    broadcast_to,
    constant,
    is_whole,
    like,
    own,
    refuse_free,
    to_numpy,
    unit_factors,
)
from .trajectory import Trajectory


def boundary_values(
    start_velocity: Boundary,
    start_acceleration: Boundary,
    goal_velocity: Boundary,
    goal_acceleration: Boundary,
) -> dict[str, Boundary]:
    """Return the boundary arguments by name; FREE is refused where a movement cannot leave it open."""
    refuse_free(start_velocity=start_velocity, start_acceleration=start_acceleration)
    return {
        "start_velocity": start_velocity,
        "start_acceleration": start_acceleration,
        "goal_velocity": goal_velocity,
        "goal_acceleration": goal_acceleration,
    }


def check_order(order: int, start_acceleration: Boundary = None, goal_acceleration: Boundary = None) -> None:
    """Raise ValueError for an order that does not exist, or one that has no boundary accelerations."""
    if not is_whole(order) or order not in ORDERS:
        raise ValueError(f"order must be 2 (acceleration), 3 (jerk) or 4 (snap), got {order!r}")
    if order == 2:
        for name, value in (
            ("start_acceleration", start_acceleration),
            ("goal_acceleration", goal_acceleration),
        ):
            if value is not None and value is not FREE:
                raise ValueError(f"{name} cannot be given for order 2: least acceleration leaves it open")


def check_boundary_shapes(boundary: dict[str, Boundary], dimension: int) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of the given boundary values; ValueError where the last axis is not D."""
    shapes = {}
    for name, value in boundary.items():
        if value is None or value is FREE:
            continue
        if value.ndim < 1 or value.shape[-1] != dimension:
            raise ValueError(f"{name} must have shape (..., {dimension}), got shape {tuple(value.shape)}")
        shapes[name] = tuple(value.shape[:-1])
    return shapes


def end_states(order: int, velocity: Boundary, acceleration: Boundary) -> list[Any]:
    """Return the m - 1 derivatives at one end; jerk (order 4) is zero there."""
    return [velocity, acceleration, None][: order - 1]


def connect(xp: Namespace, order: int, waypoints: Array, durations: Array, states: States) -> Trajectory:
    """Return the least-cost trajectory through all waypoints at fixed times.

    Args:
        xp: namespace.
        order: m.
        waypoints: (..., S + 1, D) with the full batch shape [m].
        durations: (..., S), positive, or 0 between equal waypoints; may be shared by the batch [s].
        states: per knot, its derivatives (FREE where the cost decides).
    """
    durations = own(durations)
    if (durations <= 0).any():
        return _connect_without_empty(xp, order, waypoints, durations, states)
    return Trajectory.from_segments(_paced(xp, order, waypoints, durations, states), durations, xp)


_SHORT, _LONG = 1e-3, 1e3
"""Durations [s] between which no power of them over- or underflows, in single precision either."""


def _paced(xp: Namespace, order: int, waypoints: Array, durations: Array, states: States) -> Array:
    """Return the coefficients, computed at a pace at which nothing over- or underflows."""
    sizes = to_numpy(durations)
    if sizes.size and not (sizes.min() >= _SHORT and sizes.max() <= _LONG):
        durations, states = _at_unit_pace(xp, durations, states)
    return _coefficients(xp, order, waypoints, durations, states)


def _at_unit_pace(xp: Namespace, durations: Array, states: States) -> tuple[Array, States]:
    """Return durations of about 1 and the states to match: by powers of two, which change no digit."""
    pace = unit_factors(xp, durations)
    scaled: States = []
    for state in states:
        row, power = [], xp.ones_like(pace)
        for value in state:
            power = power / pace
            row.append(value if value is None or value is FREE else value * power)
        scaled.append(row)
    return durations * pace, scaled


def _coefficients(xp: Namespace, order: int, waypoints: Array, durations: Array, states: States) -> Array:
    segments = waypoints.shape[-2] - 1
    steps = waypoints[..., 1:, :] - waypoints[..., :-1, :]
    pieces = [steps[..., s, :] for s in range(segments)]
    if xp is np and durations.size == segments and durations.dtype == np.float64:
        lengths = durations.reshape(-1).tolist()  # Python floats: the same bits, without an array's overhead
    else:
        lengths = [durations[..., s : s + 1] for s in range(segments)]
    states = solve_states(order, lengths, pieces, states)
    rest = 0.0 * pieces[0]
    # Rows of s = (x0, V0_1, ..., D, V1_1, ...), see _hermite, segment by segment.
    rows = [waypoints[..., s, :] for s in range(segments)]
    rows += _scaled_states(states[:-1], lengths, rest, order)
    rows += pieces
    rows += _scaled_states(states[1:], lengths, rest, order)
    shape = rest.shape
    data = xp.stack([broadcast_to(xp, row, shape) for row in rows], axis=-2)
    batch = data.shape[:-2]
    data = xp.reshape(data, (*batch, 2 * order, segments * data.shape[-1]))
    coefficients = xp.matmul(constant(coefficient_table(order), data), data)
    return xp.reshape(coefficients, (*batch, 2 * order, segments, shape[-1]))


def _scaled_states(states: States, lengths: Sequence[Any], rest: Array, order: int) -> list[Array]:
    """V_i = h^i x^(i) for i = 1 ... m - 1, all segments of one i together."""
    rows = []
    powers: Sequence[Any] = lengths
    for i in range(order - 1):
        for state, power in zip(states, powers, strict=True):
            rows.append(rest if state[i] is None else power * state[i])
        powers = [power * length for power, length in zip(powers, lengths, strict=True)]
    return rows


def _connect_without_empty(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States
) -> Trajectory:
    """Do the same where some durations are 0: those via-points are dropped, item by item."""
    *batch, knots, dimension = waypoints.shape
    count = int(np.prod(batch, dtype=int))
    durations = broadcast_to(xp, durations, (*batch, knots - 1))
    if not count:
        nothing = like(xp, np.zeros((*batch, 2 * order, knots - 1, dimension)), waypoints)
        return Trajectory.from_segments(nothing, durations, xp, some_empty=True)
    flat_points = xp.reshape(waypoints, (count, knots, dimension))
    flat_durations = xp.reshape(durations, (count, knots - 1))
    empty = to_numpy(flat_durations) <= 0
    parts, members = [], []
    for pattern in np.unique(empty, axis=0):
        where = np.flatnonzero((empty == pattern).all(axis=1))
        index = where if xp is np else xp.asarray(where, device=waypoints.device)
        chosen = [_take(state, index, tuple(batch), xp) for state in states]
        parts.append(_connect_pattern(xp, order, flat_points[index], flat_durations[index], chosen, pattern))
        members.append(where)
    back = np.argsort(np.concatenate(members))
    joined = xp.concat(parts, axis=0)[back if xp is np else xp.asarray(back, device=waypoints.device)]
    joined = xp.reshape(joined, (*batch, *joined.shape[1:]))
    return Trajectory.from_segments(joined, durations, xp, some_empty=True)


def _take(state: list[Any], index: Any, batch: tuple[int, ...], xp: Namespace) -> list[Any]:
    taken = []
    for value in state:
        if value is not None and value is not FREE:
            full = broadcast_to(xp, value, (*batch, value.shape[-1]))
            value = xp.reshape(full, (-1, value.shape[-1]))[index]
        taken.append(value)
    return taken


def _connect_pattern(
    xp: Namespace, order: int, waypoints: Array, durations: Array, states: States, empty: Any
) -> Array:
    """Coefficients where the same segments are empty in every item; an empty one is a constant."""
    full = np.flatnonzero(~empty).tolist()
    # Keep the start, the end of every full segment; merged knots share one state, the goal's at the end.
    kept = [0, *(s + 1 for s in full)]
    chosen = [states[0], *(states[k] for k in kept[1:-1]), states[-1]]
    points = xp.stack([waypoints[..., k, :] for k in kept[:-1]] + [waypoints[..., -1, :]], axis=-2)
    lengths = xp.stack([durations[..., s] for s in full], axis=-1)
    solved = _paced(xp, order, points, lengths, chosen)
    zeros = like(xp, np.zeros((2 * order - 1, 1, 1)), solved)
    columns = []
    for s, is_empty in enumerate(empty):
        if is_empty:
            first = waypoints[..., s : s + 1, :][..., None, :, :]
            columns.append(xp.concat([first, zeros + 0.0 * first], axis=-3))
        else:
            place = full.index(s)
            columns.append(solved[..., :, place : place + 1, :])
    return xp.concat(columns, axis=-2)
