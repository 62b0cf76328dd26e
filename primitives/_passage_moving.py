"""The free passage time of one via-point where ends move or are open: all stationary points compared.

Without the via-point the movement would be x_free(t); with r = x1 - x_free the least cost of passing x1 at t
is, in unit total time,

    J(t) = J0 + 10 |r|^2 / (t^5 (1 - t)^q g(t)),    dJ/dt = 0  <=>
    F(t) = |r|^2 (5 (1 - t) g - q t g + t (1 - t) g') - 2 t (1 - t) g r . r' = 0,

where t^5 (1 - t)^q g is 20 times the Green's function of the boundary conditions at (t, t). There can be
several minima, so no first root is trusted: the polynomial gives every one, and the least J decides (the
earliest if equal).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._arrays import FREE
from ._connecting import connect
from ._polynomial import Floats, differentiate, evaluate, multiply, root_candidates

_GREEN: dict[tuple[bool, bool], tuple[int, tuple[float, ...]]] = {
    (False, False): (5, (1.0,)),
    (False, True): (4, (1.0, -4.0 / 9.0)),
    (True, False): (2, (1.0, -4.0 / 3.0, 1.0 / 2.0, -1.0 / 16.0)),
    (True, True): (2, (1.0, -7.0 / 9.0, 2.0 / 9.0, -1.0 / 36.0)),
}
"""(goal velocity FREE, goal acceleration FREE) -> q and the coefficients of g."""


def fractions_moving(points: Floats, ends: list[Any]) -> Floats:
    """Fractions of the duration before and after the via-point.

    Args:
        points: (N, 3, D) start, via-point, goal [m], each different from its neighbour.
        ends: start velocity and acceleration, goal velocity and acceleration in unit time: (N, D), None or
            FREE.

    Returns:
        (N, 2), each pair adds up to 1.
    """
    free = connect(np, 3, points[:, [0, 2]], np.ones(1), [ends[:2], ends[2:]])
    path = np.moveaxis(free.coefficients[:, :, 0, :], 1, -1)  # (N, D, 6)
    miss = -path
    miss[..., 0] = points[:, 1] - points[:, 0]
    exponent, factor = _GREEN[ends[2] is FREE, ends[3] is FREE]
    stationary = _stationary(miss, exponent, np.array(factor))
    u = root_candidates(stationary)
    excess = _excess(miss, exponent, np.array(factor), u)
    least = excess.min(axis=-1, keepdims=True)
    # Equal minima differ by rounding of J0 + excess; the earliest counts.
    first = np.argmax(excess <= least + 1e-12 * (least + free.cost()[:, None]), axis=-1)
    best = u[np.arange(len(u)), first]
    return np.stack([best, 1.0 - best], axis=-1)


def _stationary(miss: Floats, exponent: int, factor: Floats) -> Floats:
    """Return the coefficients of F, (N, degree + 1)."""
    both = np.array([0.0, 1.0, -1.0])  # t (1 - t)
    weight = np.convolve(np.array([5.0, -5.0 - exponent]), factor)
    bent = np.convolve(both, differentiate(factor))
    size = max(len(weight), len(bent))
    weight = np.pad(weight, (0, size - len(weight))) + np.pad(bent, (0, size - len(bent)))
    square = _over_dimensions(multiply(miss, miss))
    change = _over_dimensions(multiply(miss, differentiate(miss)))
    left, right = multiply(square, weight), multiply(change, 2.0 * np.convolve(both, factor))
    size = max(left.shape[-1], right.shape[-1])
    total = np.zeros((len(miss), size))
    total[:, : left.shape[-1]] += left
    total[:, : right.shape[-1]] -= right
    return total


def _excess(miss: Floats, exponent: int, factor: Floats, u: Floats) -> Floats:
    """Return J - J0 at the candidates (N, n), infinite at the ends."""
    square = np.zeros_like(u)
    for d in range(miss.shape[1]):
        value = evaluate(miss[:, None, d], u)
        square = square + value * value
    green = u * u * u * u * u * evaluate(factor, u)
    for _ in range(exponent):
        green = green * (1.0 - u)
    inside = (u > 0) & (u < 1) & (green > 0)
    return np.where(inside, 10.0 * square / np.where(inside, green, 1.0), np.inf)


def _over_dimensions(array: Floats) -> Floats:
    """Sum over axis 1 in its order."""
    total: Floats = array[:, 0]
    for d in range(1, array.shape[1]):
        total = total + array[:, d]
    return total
