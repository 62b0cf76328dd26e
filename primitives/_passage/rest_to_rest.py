"""Free passage time of one via-point, rest to rest: the only root of a polynomial in (0, 1).

Substituting the movement into pi . v(t1) = 0 (Flash & Hogan 1985, Eq. C16) gives with t = t1 / duration,
E = x1 - x0, D = xf - x0 and

    a = E.D,   b = D.D,   c = E.E,   s = 1 - 2t,   q = 10 t^3 - 15 t^4 + 6 t^5,   w = t^3 (2 - t)

the polynomial of degree 9

    F(t) = (E - D q).(E s + D w) = c s + a w - q (a s + b w) = 0.                                   (1)

Its root in (0, 1) is simple and the global minimum of the jerk cost. It lies below 1/2 exactly if x1 is
nearer to x0 than to xf. Only a/b and c/b matter, in any dimension of space.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..array_api import Array, Namespace, like, ordered_sum, to_numpy

Number: TypeAlias = Any  # A float, or an array with one entry per movement; both give the same bits

# Least fraction of a via-point apart from its neighbour; a higher power of it must not underflow
SHORTEST = 1e-40

# Newton steps; the start is within 34 % of the root everywhere, and after five the error is 2e-16 (measured).
_STEPS = 5
# Distance of the via-point from an end, relative to the movement's extent, that clips the gradient.
_FLOOR = 1e-5


class Functions(NamedTuple):
    """Elementary functions of arrays or of floats."""

    where: Callable[[Any, Any, Any], Any]
    sqrt: Callable[[Any], Any]
    cube_root: Callable[[Any], Any]
    minimum: Callable[[Any, Any], Any]
    maximum: Callable[[Any, Any], Any]


_ARRAYS = Functions(np.where, np.sqrt, np.cbrt, np.minimum, np.maximum)
_FLOATS = Functions(
    lambda condition, yes, no: yes if condition else no,
    math.sqrt,
    lambda x: float(np.cbrt(x)),  # not math.cbrt, which may round differently from NumPy's loops over arrays
    min,
    max,
)


def fractions_at_rest(points: Any) -> Any:
    """Return the fractions (N, 2) of the duration around the via-points of points (N, 3, D) of a size of about 1.

    Each pair adds up to 1; the smaller one has full relative accuracy. A via-point on the start or goal has fraction 0.
    """
    places = np.ascontiguousarray(points.transpose(1, 2, 0))
    legs = places[1:] - places[:-1]
    whole = places[2] - places[0]
    first, second = ordered_sum(legs.swapaxes(0, 1) ** 2)
    is_late = second < first
    near = np.where(is_late, legs[1], legs[0])
    a = ordered_sum(near * whole)
    b = ordered_sum(whole * whole)
    c = np.minimum(first, second)
    # A batch of one would spend its time in the overhead of array operations: Python floats give the same bits.
    arguments = (a, b, c) if len(points) > 1 else (a.item(), b.item(), c.item(), _FLOATS)
    t = nearer_fraction(*arguments)
    t = np.maximum(t, SHORTEST * near.any(axis=0))
    fractions = np.empty((len(points), 2))
    fractions[:, 0], fractions[:, 1] = np.where(is_late, (1.0 - t, t), (t, 1.0 - t))
    return fractions


def nearer_fraction(a: Number, b: Number, c: Number, f: Functions = _ARRAYS) -> Number:
    """Return the root of F (Eq. 1) in [0, 1/2], for E from the nearer end, so that a <= b / 2.

    Newton steps from the root of c = 4 a z + 10 b z^2, z = t^3, which are the lowest terms of F for small t.
    The term 8 c brings the start to 1/2 for distant via-points.
    """
    total = f.sqrt(4.0 * a * a + 5.0 * b * c) + 2.0 * abs(a)
    # The form of the quadratic formula without cancellation, for either sign of a.
    top = f.where(a >= 0, c, total)
    bottom = f.where(a >= 0, 2.0 * total, 10.0 * b) + 8.0 * top
    t = f.cube_root(top / f.where(bottom > 0, bottom, 1.0))
    t = f.minimum(f.maximum(t, 0.0), 0.5)
    for _ in range(_STEPS):
        value, slope, _ = _residual(t, a, b, c)
        t = f.minimum(f.maximum(t - value / f.where(slope < 0, slope, -1.0), 0.5 * t), 0.5)
    return t


def _residual(t: Number, a: Number, b: Number, c: Number) -> tuple[Number, Number, tuple[Number, ...]]:
    """Return F of Eq. 1, dF/dt, and s, q and w."""
    square = t * t
    cube = square * t
    s = 1.0 - 2.0 * t
    q = cube * (10.0 + t * (6.0 * t - 15.0))
    w = cube * (2.0 - t)
    dw = square * (6.0 - 4.0 * t)
    dq = 30.0 * square * ((1.0 - t) * (1.0 - t))
    m = a * s + b * w
    return c * s + a * w - q * m, a * dw - 2.0 * c - dq * m - q * (b * dw - 2.0 * a), (s, q, w)


def attach_root_gradient(fractions: Array, waypoints: Array, xp: Namespace) -> Array:
    """Return differentiable fractions, by the implicit function theorem dt/dp = -(dF/dp) / (dF/dt).

    The gradient grows without bound, like |E|^(-2/3), as the via-point approaches an end. It is clipped there,
    and stays finite when all points coincide.
    """
    rates, is_late = _root_rates(
        to_numpy(waypoints).astype(np.float64), to_numpy(fractions).astype(np.float64)
    )
    whole = waypoints[..., 2, :] - waypoints[..., 0, :]
    near = waypoints[..., 1:, :] - waypoints[..., :-1, :]
    near = (near * like(xp, np.stack([~is_late, is_late], axis=-1)[..., None], near)).sum(-2)
    by_a, by_b, by_c = (like(xp, rate, near)[..., None] for rate in rates)
    # Only the gradient of by_a a + by_b b + by_c c counts: its value is subtracted again.
    change = (near * (by_a * whole + by_c * near) + by_b * (whole * whole)).sum(-1)
    change = change - change.detach()
    return fractions + xp.stack([change, -change], axis=-1)


def _root_rates(points: Any, fractions: Any) -> tuple[tuple[Any, Any, Any], Any]:
    """Return d(first fraction) / d(a, b, c), each (...,), and True where the via-point is nearer to the goal."""
    start, via, goal = (np.moveaxis(points[..., k, :], -1, 0) for k in range(3))
    is_late = fractions[..., 1] < fractions[..., 0]
    t = fractions.min(axis=-1)
    near = np.where(is_late, goal - via, via - start)
    whole = goal - start
    a = ordered_sum(near * whole)
    b = ordered_sum(whole * whole)
    c = ordered_sum(near * near)
    _, slope, (s, q, w) = _residual(t, a, b, c)
    extent = b + c
    floor = _FLOOR ** (5.0 / 3.0) * extent + (extent <= 0)  # |dF/dt| falls like |E|^(5/3)
    sign = np.where(is_late, -1.0, 1.0) / np.maximum(-slope, floor)
    return (sign * (w - q * s), -sign * q * w, sign * s), is_late
