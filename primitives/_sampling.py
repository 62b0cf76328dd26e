"""Values of many piecewise polynomials at many times: the part that limits the speed.

All segments go into one small matrix product per trajectory: column (k, s) of the basis is u_s^k where
segment s is the current one and zero elsewhere. NumPy's stacked product treats every trajectory by itself
with the same inner sizes, so a batch gives bit for bit what each item gives alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._arrays import Array, Namespace, blocks, constant
from ._hermite import derivative_factors

_BLOCK_BYTES = 400_000
"""Size of the basis of one block of trajectories: it stays in a core's second-level cache while it is
used."""


def power_basis(time: Array, starts: Array, rates: Array, degree: int, xp: Namespace) -> Array:
    """Columns of the basis, transposed.

    Args:
        time: (..., T) [s], within the movement.
        starts: (..., S) start time of each segment [s].
        rates: (..., S) reciprocal durations [1/s].
        degree: highest power.
        xp: namespace.

    Returns:
        (..., (degree + 1) S, T); row k S + s is u_s^k where segment s is current, else 0.
    """
    time = time[..., None, :]
    segments = starts.shape[-1]
    if segments == 1:
        power = (time - starts[..., None]) * rates[..., None]
        rows = [xp.ones_like(power), power]
    else:
        current = _current_segment(time, starts, xp)
        power = (time - starts[..., None]) * rates[..., None] * current
        rows = [current, power]
    local = power
    for _ in range(degree - 1):
        power = power * local
        rows.append(power)
    return xp.concat(rows[: degree + 1], axis=-2)


def _current_segment(time: Array, starts: Array, xp: Namespace) -> Array:
    """(..., S, T): 1 where start_s <= time < start_(s+1), else 0; the last segment has no end."""
    reached = xp.astype(time >= starts[..., 1:, None], starts.dtype)
    if reached.shape[-2] == 1:
        return xp.concat([1.0 - reached, reached], axis=-2)
    return xp.concat(
        [1.0 - reached[..., :1, :], reached[..., :-1, :] - reached[..., 1:, :], reached[..., -1:, :]], axis=-2
    )


def derivative_coefficients(coefficients: Array, rates: Array, nu: int) -> Array:
    """Return the coefficients (..., 2m - nu, S, D) of the nu-th derivative in seconds, in unit time."""
    if nu == 0:
        return coefficients
    order = coefficients.shape[-3] // 2
    scale = rates
    for _ in range(nu - 1):
        scale = scale * rates
    factors = constant(derivative_factors(order, nu), coefficients) * scale[..., None, :]
    return coefficients[..., nu:, :, :] * factors[..., None]


def evaluate(
    coefficients: Array,
    starts: Array,
    rates: Array,
    time: Array,
    orders: Sequence[int],
    out: Sequence[Array] | None,
    xp: Namespace,
) -> list[Array]:
    """Return derivatives `orders` at `time`, each (..., T, D), in `out` where it is given.

    Args:
        coefficients: (..., 2m, S, D).
        starts: (..., S) with a batch shape that broadcasts against the coefficients' [s].
        rates: (..., S), likewise [1/s].
        time: (..., T), likewise.
        orders: derivative orders, each below 2m.
        out: buffers, one per order, of the full result shape.
        xp: namespace.
    """
    plain = coefficients.ndim == 4 and time.ndim <= 2 and starts.ndim + time.ndim > 2
    if xp is np and plain and all(len(a) in (1, len(coefficients)) for a in (starts, time) if a.ndim == 2):
        return _evaluate_in_blocks(coefficients, starts, rates, time, orders, out)
    return _evaluate(coefficients, starts, rates, time, orders, out, xp)


def _evaluate_in_blocks(
    coefficients: Any, starts: Any, rates: Any, time: Any, orders: Sequence[int], out: Sequence[Any] | None
) -> list[Array]:
    count = coefficients.shape[0]
    size = max(1, _BLOCK_BYTES // (coefficients.itemsize * time.shape[-1] * coefficients[0, ..., 0].size))
    if out is None:
        shape = (count, time.shape[-1], coefficients.shape[-1])
        out = [np.empty(shape, coefficients.dtype) for _ in orders]

    def part(array: Any, where: slice) -> Any:
        return array[where] if array.ndim > 1 and array.shape[0] > 1 else array

    for where in blocks(count, size):
        piece = coefficients[where], part(starts, where), part(rates, where), part(time, where)
        _evaluate(*piece, orders, [buffer[where] for buffer in out], np)
    return list(out)


def _evaluate(
    coefficients: Array,
    starts: Array,
    rates: Array,
    time: Array,
    orders: Sequence[int],
    out: Sequence[Array] | None,
    xp: Namespace,
) -> list[Array]:
    powers, segments, dimension = coefficients.shape[-3:]
    basis = power_basis(time, starts, rates, powers - 1 - min(orders), xp)
    results = []
    for place, nu in enumerate(orders):
        size = (powers - nu) * segments
        weights = derivative_coefficients(coefficients, rates, nu)
        weights = xp.reshape(weights, (*weights.shape[:-3], size, dimension))
        columns = basis[..., :size, :].mT
        if out is None:
            results.append(xp.matmul(columns, weights))
        elif xp is np:
            results.append(np.matmul(columns, weights, out=out[place]))
        else:
            out[place][...] = xp.matmul(columns, weights)
            results.append(out[place])
    return results
