"""Values of many piecewise polynomials at many times: the part that limits the speed.

All segments go into one small matrix product per trajectory: column (k, s) of the basis is u_s^k where
segment s is the current one and zero elsewhere. NumPy's stacked product treats every trajectory by itself
with the same inner sizes, so a batch gives bit for bit what each item gives alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ._arrays import Array, Namespace, blocks, constant
from ._hermite import derivative_factors

_BLOCK_BYTES = 600_000
"""Size of the basis of one block of trajectories: it stays in a core's second-level cache while it is
used."""


def power_basis(time: Array, starts: Array, rates: Array, degree: int, xp: Namespace) -> Array:
    """Return the columns of the basis, transposed.

    Args:
        time: (..., T) [s], within the movement.
        starts: (..., S) start time of each segment [s].
        rates: (..., S) reciprocal durations [1/s].
        degree: highest power, at least 1.
        xp: namespace.

    Returns:
        (..., (degree + 1) S, T); row k S + s is u_s^k where segment s is current, else 0.
    """
    power = (time[..., None, :] - starts[..., None]) * rates[..., None]
    current = xp.ones_like(power)
    if starts.shape[-1] > 1:
        current = xp.astype(_current_segment(time, starts, xp), starts.dtype)
        power = power * current
    rows, local = [current, power], power
    while len(rows) <= degree:
        power = power * local
        rows.append(power)
    return xp.concat(rows, axis=-2)


def _power_basis_into(basis: Any, time: Any, starts: Any, rates: Any) -> Any:
    """Do the same for NumPy in a buffer (..., degree + 1, S, T): here most of the time is spent."""
    segments = starts.shape[-1]
    current, local = basis[..., 0, :, :], basis[..., 1, :, :]
    if segments == 1:
        current[...] = 1.0
        np.multiply(time[..., None, :] - starts[..., None], rates[..., None], out=local)
    else:
        current[...] = _current_segment(time, starts, np)
        # A product with a single 1 among zeros picks start and rate of the current segment exactly.
        picked = np.matmul(np.stack([starts, rates], axis=-2), current)
        np.multiply(((time - picked[..., 0, :]) * picked[..., 1, :])[..., None, :], current, out=local)
    for k in range(2, basis.shape[-3]):
        np.multiply(basis[..., k - 1, :, :], local, out=basis[..., k, :, :])
    return basis.reshape(*basis.shape[:-3], -1, basis.shape[-1])


def _current_segment(time: Array, starts: Array, xp: Namespace) -> Array:
    """(..., S, T): True where start_s <= time < start_(s+1), S >= 2; the last segment has no end."""
    reached = time[..., None, :] >= starts[..., 1:, None]
    parts = [~reached[..., :1, :], reached[..., -1:, :]]
    if reached.shape[-2] > 1:
        parts.insert(1, reached[..., :-1, :] & ~reached[..., 1:, :])
    return xp.concat(parts, axis=-2)


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
    powers, segments, dimension = coefficients.shape[-3:]
    weights = []
    for nu in orders:
        weight = derivative_coefficients(coefficients, rates, nu)
        weights.append(xp.reshape(weight, (*weight.shape[:-3], (powers - nu) * segments, dimension)))
    degree = max(1, powers - 1 - min(orders))
    if xp is not np:
        return _products(power_basis(time, starts, rates, degree, xp), weights, out, xp)
    if out is None:
        batch = np.broadcast_shapes(coefficients.shape[:-3], time.shape[:-1])
        out = [np.empty((*batch, time.shape[-1], dimension), coefficients.dtype) for _ in orders]
    buffer = None
    for where, own in _blocks(coefficients, starts, time):
        at, begin, rate = time[own[0]], starts[own[1]], rates[own[1]]
        shape = np.broadcast_shapes(at.shape[:-1], begin.shape[:-1])
        if buffer is None or buffer.shape[:-3] != shape:  # one buffer for all blocks but a shorter last one
            buffer = np.empty((*shape, degree + 1, segments, time.shape[-1]), dtype=starts.dtype)
        basis = _power_basis_into(buffer, at, begin, rate)
        _products(basis, [weight[where] for weight in weights], [array[where] for array in out], np)
    return list(out)


def _products(basis: Array, weights: list[Array], out: Sequence[Array] | None, xp: Namespace) -> list[Array]:
    """Multiply the basis with the coefficients of each derivative; it uses the first rows of the basis."""
    results = []
    for place, weight in enumerate(weights):
        columns = basis[..., : weight.shape[-2], :].mT
        if out is None:
            results.append(xp.matmul(columns, weight))
        elif xp is np:
            results.append(np.matmul(columns, weight, out=out[place]))
        else:
            out[place][...] = xp.matmul(columns, weight)
            results.append(out[place])
    return results


def _blocks(coefficients: Any, starts: Any, time: Any) -> Iterator[tuple[Any, tuple[Any, Any]]]:
    """Index of each block of the batch, and of the same block in `time` and `starts` (or all, if shared)."""
    count, own = len(coefficients), [array.ndim == 2 and len(array) > 1 for array in (time, starts)]
    plain = coefficients.ndim == 4 and all(array.ndim <= 2 for array in (time, starts))
    fitting = all(len(array) in (1, count) for array in (time, starts) if array.ndim == 2)
    if not plain or not fitting or not any(own):
        yield ..., (..., ...)
        return
    size = max(1, _BLOCK_BYTES // (coefficients[0, ..., 0].size * time.shape[-1] * coefficients.itemsize))
    for where in blocks(count, size):
        yield where, (where if own[0] else ..., where if own[1] else ...)
