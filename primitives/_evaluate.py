"""Evaluation of many piecewise polynomials at many times: the part that limits the speed.

All segments go into one small matrix product per trajectory,

    x^(nu)(t) = sum_(k, s) B_(k, s)(t) c^(nu)_(k, s),   B_(k, s)(t) = u_s^k if segment s is current, else 0.  (1)

NumPy's stacked product computes every trajectory by itself with the same inner sizes, so an item of a batch
gives the same bits as alone.

The basis is implemented twice: for any library, and for NumPy in the layout that it fills fastest. Without the second
one 4,096 movements with 200 samples each take 13 % (K = 1) to 26 % (K = 3) longer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._hermite_tables import derivative_factors
from .array_api import Array, Namespace, like

# Size of the basis of one block of trajectories, which stays in a core's second-level cache.
_BLOCK_BYTES = 1_200_000
# Number of times below which linear algebra libraries have special cases that depend on the row distance.
_FEW = 8


def _power_basis(time: Array, starts: Array, rates: Array, degree: int, xp: Namespace) -> Array:
    """Return the transposed basis of Eq. 1, (..., (degree + 1) S, T); see `evaluate` for the arguments.

    Row k S + s is u_s^k where segment s is current, else 0.
    """
    local = (time[..., None, :] - starts[..., None]) * rates[..., None]
    current = xp.ones_like(local)
    if starts.shape[-1] > 1:
        current = xp.astype(_current_segment(time, starts, xp), starts.dtype)
        local = local * current
    rows = [current, local]
    while len(rows) <= degree:
        rows.append(rows[-1] * local)
    return xp.concat(rows, axis=-2)


def _numpy_basis(time: Any, starts: Any, rates: Any, degree: int) -> Any:
    """Return the same as `_power_basis`, computed in an array (degree + 1, S, ..., T).

    With the batch axes inside, every step runs over contiguous memory, and the rows of one trajectory are
    still evenly spaced, as a matrix product needs them.
    """
    batch = np.broadcast_shapes(time.shape[:-1], starts.shape[:-1])
    basis = np.empty((degree + 1, starts.shape[-1], *batch, time.shape[-1]), starts.dtype)
    current, local = basis[0], basis[1]
    if len(current) == 1:
        current[...] = 1.0
        factor = np.multiply(time - starts, rates, out=local[0])
    else:
        current[...] = np.moveaxis(_current_segment(time, starts, np), -2, 0)
        # A product with a single 1 among zeros picks start and rate of the current segment exactly.
        chosen = np.moveaxis(current, 0, -2)
        factor = time - np.matmul(starts[..., None, :], chosen)[..., 0, :]
        factor *= np.matmul(rates[..., None, :], chosen)[..., 0, :]
        np.multiply(factor, current, out=local)
    for k in range(2, len(basis)):
        np.multiply(basis[k - 1], factor, out=basis[k])
    rows = np.moveaxis(basis.reshape(len(basis) * len(current), *current.shape[1:]), 0, -2)
    # At one to three times some products depend on the memory layout: copy to the layout of a batch of one.
    return rows if rows.shape[-1] >= _FEW else np.ascontiguousarray(rows)


def _current_segment(time: Array, starts: Array, xp: Namespace) -> Array:
    """Return (..., S, T), True where start_s <= time < start_(s+1), S >= 2; the last segment has no end."""
    reached = time[..., None, :] >= starts[..., 1:, None]
    edge = xp.ones_like(reached[..., :1, :])
    reached = xp.concat([edge, reached, ~edge], axis=-2)
    return reached[..., :-1, :] & ~reached[..., 1:, :]


def derivative_coefficients(xp: Namespace, coefficients: Array, rates: Array, nu: int) -> Array:
    """Return the coefficients (..., 2m - nu, S, D) of the nu-th derivative in seconds, in unit time.

    Beyond the degree it is the constant zero, (..., 1, S, D).
    """
    if nu == 0:
        return coefficients
    if nu >= coefficients.shape[-3]:
        return 0.0 * coefficients[..., :1, :, :]
    table = derivative_factors(coefficients.shape[-3] // 2, nu)
    scale: Array = math.prod([rates] * (nu - 1), start=rates)
    factors = like(xp, table, coefficients) * scale[..., None, :]
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
    """Return derivatives `orders` at `time`, each (..., T, D), written to `out` if that is given.

    All but the orders have leading shapes that broadcast: coefficients (..., 2m, S, D), starts and rates (..., S), time
    (..., T).
    """
    powers, segments, dimension = coefficients.shape[-3:]
    weights = []
    for nu in orders:
        weight = derivative_coefficients(xp, coefficients, rates, nu)
        weights.append(weight.reshape(*weight.shape[:-3], (powers - nu) * segments, dimension))
    degree = max(1, powers - 1 - min(orders))
    if xp is not np:
        basis = _power_basis(time, starts, rates, degree, xp)
        results = [xp.matmul(basis[..., : weight.shape[-2], :].mT, weight) for weight in weights]
        if out is None:
            return results
        for buffer, result in zip(out, results, strict=True):
            buffer[...] = result
        return list(out)
    if out is None:
        batch = np.broadcast(coefficients[..., 0, 0, :1], time[..., :1]).shape[:-1]
        out = [np.empty((*batch, time.shape[-1], dimension), coefficients.dtype) for _ in orders]
    for where, where_time, where_starts in _blocks(coefficients, starts, time):
        basis = _numpy_basis(time[where_time], starts[where_starts], rates[where_starts], degree)
        for weight, result in zip(weights, out, strict=True):
            np.matmul(basis[..., : weight.shape[-2], :].mT, weight[where], out=result[where])
    return list(out)


def _blocks(coefficients: Any, starts: Any, time: Any) -> list[tuple[Any, Any, Any]]:
    """Return indices of each block of the batch, and of the block in `time` and in `starts` (all, if shared)."""
    batch, shared = coefficients.shape[:-3], ((), (1,))
    own_time = time.shape[:-1] not in shared
    own_starts = starts.shape[:-1] not in shared
    fitting = time.shape[:-1] in (*shared, batch) and starts.shape[:-1] in (*shared, batch)
    if len(batch) != 1 or not fitting or not (own_time or own_starts):
        return [(..., ..., ...)]
    each = math.prod(coefficients.shape[1:3]) * time.shape[-1] * coefficients.itemsize
    size = max(1, _BLOCK_BYTES // max(1, each))
    slices = (slice(first, first + size) for first in range(0, batch[0], size))
    return [(rows, rows if own_time else ..., rows if own_starts else ...) for rows in slices]
