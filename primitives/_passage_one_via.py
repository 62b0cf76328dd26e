"""Free passage time of one via-point: a root of a polynomial, for rest-to-rest movements and for moving or free ends.

Rest to rest it is the only root in (0, 1). Substituting the movement into pi . v(t1) = 0 (Flash & Hogan
1985, Eq. C16) gives with t = t1 / duration, E = x1 - x0, D = xf - x0 and

    a = E.D,   b = D.D,   c = E.E,   s = 1 - 2t,   q = 10 t^3 - 15 t^4 + 6 t^5,   w = t^3 (2 - t)

the polynomial of degree 9

    F(t) = (E - D q).(E s + D w) = c s + a w - q (a s + b w) = 0.                                   (1)

Its root in (0, 1) is simple and the global minimum of the jerk cost. It lies below 1/2 exactly if x1 is
nearer to x0 than to xf. Only a/b and c/b matter, in any dimension of space.

With moving or free ends it is the best of all stationary points. Without the via-point the movement would
be x_free(t). With r = x1 - x_free the least cost of passing x1 at t is, in unit total time,

    J(t) = J0 + 10 |r|^2 / (t^p (1 - t)^q g(t)),                                                    (2)

    F(t) = |r|^2 (p (1 - t) g - q t g + t (1 - t) g') - 2 t (1 - t) g r . r',   p = 5,              (3)

where t^p (1 - t)^q g is 20 times the Green's function of the boundary conditions at (t, t), and dJ/dt = 0 is
F(t) = 0. There can be several minima, so all roots of the polynomial F are compared by J; among equal ones
the earliest counts.

The coefficients of F lose the digits of a root close to an end. For such movements the problem is expanded
around either end, roots are sought on every scale of time, and Newton steps use Eq. 3 instead of coefficients.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial import Polynomial

from ._polynomial import differentiate, evaluate, multiply, root_candidates
from .array_api import FREE, Array, Floats, Namespace, change_given, like, ordered_sum, to_numpy
from .trajectory import connect

Number: TypeAlias = Any  # A NumPy scalar, or an array with one entry per movement; both give the same bits

# Least fraction of a via-point apart from its neighbour; a higher power of it must not underflow
SHORTEST = 1e-40

# Newton steps; the start is within 34 % of the root everywhere, and after five the error is 2e-16 (measured).
_STEPS = 5
# Least divisor, where numerators are 0 as well.
_TINY = np.finfo(np.float64).tiny
# Distance of the via-point from an end, relative to the movement's extent, that clips the gradient.
_FLOOR = 1e-5

# (goal velocity FREE, goal acceleration FREE) -> q and the coefficients of g
_GREEN: dict[tuple[bool, bool], tuple[int, tuple[float, ...]]] = {
    (False, False): (5, (1.0,)),
    (False, True): (4, (1.0, -4.0 / 9.0)),
    (True, False): (2, (1.0, -4.0 / 3.0, 1.0 / 2.0, -1.0 / 16.0)),
    (True, True): (2, (1.0, -7.0 / 9.0, 2.0 / 9.0, -1.0 / 36.0)),
}

# Estimated relative error of the shorter fraction above which a movement is expanded around both ends.
_DOUBT = 1e-13
# Relative difference above which that result replaces the first.
_TOLERANCE = 1e-13
# Size of F at an end relative to its coefficients, below which a root close to it may be missed.
_NEAR = 1e-6
# Number of time scales, from the whole movement down to the least root.
_SCALES = 6
# Newton steps from the roots of the polynomial.
_POLISHING_STEPS = 8
# Relative size of the last step that identifies a root; other points must not win as an earlier equal.
_CONVERGED_STEP = 1e-9
# Greatest unit time of the roots taken from each end; roots found twice do no harm.
_OVERLAP = 0.75


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
    # A batch of one would spend its time in the overhead of arrays: scalars give the same bits.
    t = nearer_fraction(a, b, c) if len(points) > 1 else nearer_fraction(a[0], b[0], c[0])
    t = np.maximum(t, SHORTEST * near.any(axis=0))
    fractions = np.empty((len(points), 2))
    fractions[:, 0], fractions[:, 1] = np.where(is_late, (1.0 - t, t), (t, 1.0 - t))
    return fractions


def nearer_fraction(a: Number, b: Number, c: Number) -> Number:
    """Return the root of F (Eq. 1) in [0, 1/2], for E from the nearer end, so that a <= b / 2.

    Newton steps from the root of c = 4 a z + 10 b z^2, z = t^3, which are the lowest terms of F for small t.
    The term 8 c brings the start to 1/2 for distant via-points.
    """
    total = np.sqrt(4.0 * a * a + 5.0 * b * c) + 2.0 * abs(a)
    # The form of the quadratic formula without cancellation, for either sign of a.
    top = np.where(a >= 0, c, total)[()]
    bottom = np.where(a >= 0, 2.0 * total, 10.0 * b)[()] + 8.0 * top
    t = np.minimum(np.cbrt(top / np.maximum(bottom, _TINY)), 0.5)
    for _ in range(_STEPS):
        value, slope, _ = _residual(t, a, b, c)
        t = np.minimum(np.maximum(t - value / np.minimum(slope, -_TINY), 0.5 * t), 0.5)
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
    numbers = to_numpy(fractions).astype(np.float64)
    is_late = numbers[..., 1] < numbers[..., 0]
    whole = waypoints[..., 2, :] - waypoints[..., 0, :]
    near = waypoints[..., 1:, :] - waypoints[..., :-1, :]
    near = (near * like(xp, np.stack([~is_late, is_late], axis=-1)[..., None], near)).sum(-2)
    e, d = (np.moveaxis(to_numpy(part), -1, 0) for part in (near, whole))
    a = ordered_sum(e * d)
    b = ordered_sum(d * d)
    c = ordered_sum(e * e)
    _, slope, (s, q, w) = _residual(numbers.min(axis=-1), a, b, c)
    extent = b + c
    floor = _FLOOR ** (5.0 / 3.0) * extent + (extent <= 0)  # |dF/dt| falls like |E|^(5/3)
    sign = np.where(is_late, -1.0, 1.0) / np.maximum(-slope, floor)
    # The derivatives of the first fraction by a, b and c
    by_a, by_b, by_c = (like(xp, sign * rate, near)[..., None] for rate in (w - q * s, -q * w, s))
    # Only the gradient of by_a a + by_b b + by_c c counts: its value is subtracted again.
    change = (near * (by_a * whole + by_c * near) + by_b * (whole * whole)).sum(-1)
    change = change - change.detach()
    return fractions + xp.stack([change, -change], axis=-1)


@dataclass(frozen=True)
class _Expansion:
    """Problem of N movements in the time u from one of the ends.

    Attributes:
        miss: (N, D, 6) coefficients of r in u.
        powers: p and q.
        factor: coefficients of g in u.
        slack: (N,) tolerance of the waypoints, see `_knot_solver`.
    """

    miss: Floats
    powers: tuple[int, int]
    factor: Floats
    slack: Floats

    def weights(self) -> tuple[Floats, Floats]:
        """Return the coefficients of p (1 - u) g - q u g + u (1 - u) g' and of 2 u (1 - u) g, as in Eq. 3."""
        p, q = self.powers
        factor: Any = Polynomial(self.factor)
        both: Any = Polynomial([0.0, 1.0, -1.0])  # u (1 - u)
        weight = Polynomial([float(p), float(-p - q)]) * factor + both * factor.deriv()
        return weight.coef, 2.0 * (both * factor).coef

    def stationary(self) -> Floats:
        """Return the coefficients of F (Eq. 3), (N, degree + 1)."""
        weight, both = self.weights()
        square = ordered_sum(multiply(self.miss, self.miss), 1)
        change = ordered_sum(multiply(self.miss, differentiate(self.miss)), 1)
        return multiply(square, weight) - multiply(change, both)

    def excess(self, u: Floats) -> Floats:
        """Return J - J0 (Eq. 2) at the candidates (N, n), infinite at the ends.

        The tolerance of the waypoint counts only very close to an end.
        """
        p, q = self.powers
        miss = evaluate(self.miss[:, :, None], u[:, None])
        green = u
        for factor in (*[u] * (p - 1), evaluate(self.factor, u), *[1.0 - u] * q):
            green = green * factor
        inside = (u > 0) & (u < 1) & (green > 0)
        green = np.where(inside, green + 20.0 * self.slack[:, None], 1.0)
        return np.where(inside, 10.0 * ordered_sum(miss * miss, 1) / green, np.inf)

    def polished(self, u: Floats) -> tuple[Floats, Any]:
        """Return candidates (N, n) after Newton steps on Eq. 3, and True for those that converged to roots."""
        weight, both = self.weights()
        first = differentiate(self.miss)
        paths = [part[:, :, None] for part in (self.miss, first, differentiate(first))]
        step = u
        for _ in range(_POLISHING_STEPS):
            r, dr, ddr = (evaluate(path, u[:, None]) for path in paths)
            square = ordered_sum(r * r, 1)
            change = ordered_sum(r * dr, 1)
            w, b = evaluate(weight, u), evaluate(both, u)
            value = square * w - b * change
            slope = square * evaluate(differentiate(weight), u) - b * ordered_sum(dr * dr + r * ddr, 1)
            slope = slope + change * (2.0 * w - evaluate(differentiate(both), u))
            step = value / np.where(slope == 0, 1.0, slope)
            u = np.where(np.abs(step) < 0.1 * u, u - step, u)
        return u, np.abs(step) < _CONVERGED_STEP * u

    def near_roots(self) -> tuple[Floats, Floats]:
        """Return candidates (N, n), and the excess there, infinite but at roots in the nearer part of the movement."""
        u, is_root = self.polished(_candidates_on_every_scale(self.stationary()))
        return u, np.where((is_root | (u <= SHORTEST)) & (u <= _OVERLAP), self.excess(u), np.inf)


def fractions_moving(points: Floats, ends: list[Any], slack: Floats) -> Floats:
    """Return the fractions (N, 2) of the duration before and after the via-points of points (N, 3, D), all different.

    The ends are start velocity and acceleration, goal velocity and acceleration in unit time: (N, D), None or FREE.
    Each pair adds up to 1; the smaller one has full relative accuracy.
    """
    expansion, cost = _expand(points, ends, slack, from_goal=False)
    stationary = expansion.stationary()
    u = root_candidates(stationary)
    fractions = _earliest(np.stack([u, 1.0 - u], axis=-1), expansion.excess(u), cost)
    best = fractions[:, 0]
    # Rounding of the coefficients of F may spoil the root, or hide one near an end.
    slope = np.abs(evaluate(differentiate(stationary), best)) * np.minimum(best, 1.0 - best)
    noise = np.finfo(np.float64).eps * evaluate(np.abs(stationary), best) + np.abs(evaluate(stationary, best))
    at_ends = np.minimum(np.abs(stationary[:, 0]), np.abs(evaluate(stationary, np.ones_like(best))))
    hidden = ~(at_ends > _NEAR * np.abs(stationary).sum(axis=-1))
    hard = np.flatnonzero(~(noise < _DOUBT * slope) | hidden)
    if hard.size:
        chosen = change_given(operator.itemgetter(hard), ends)
        found = _from_both_ends(points[hard], chosen, slack[hard], cost[hard])
        wrong = (np.abs(found - fractions[hard]) > _TOLERANCE * found).any(axis=-1)
        fractions[hard[wrong]] = found[wrong]
    return fractions


def _candidates_on_every_scale(polynomial: Floats) -> Floats:
    """Return points of (0, 1], (N, n), that include all real roots there, however small they are."""
    powers = np.arange(polynomial.shape[-1])
    size = np.abs(polynomial)
    with np.errstate(all="ignore"):
        # Half of this bounds all roots from below (Fujiwara 1916, for 1 / u); the least is not much larger.
        least = 1.0 / ((size[:, 1:] / size[:, :1]) ** (1.0 / powers[1:])).max(axis=-1)
    least = np.clip(np.nan_to_num(8.0 * least), SHORTEST, 1.0)
    scales = least[:, None] ** np.linspace(0.0, 1.0, _SCALES)
    u = scales[..., None] * root_candidates(polynomial[:, None] * scales[..., None] ** powers)
    candidates: Floats = np.maximum(u.reshape(len(polynomial), -1), SHORTEST)
    return candidates


def _from_both_ends(points: Floats, ends: list[Any], slack: Floats, cost: Floats) -> Floats:
    """Return the fractions (N, 2) from the roots in expansions around both ends."""
    before, excess_before = _expand(points, ends, slack, from_goal=False)[0].near_roots()
    after, excess_after = _expand(points, ends, slack, from_goal=True)[0].near_roots()
    early = np.stack([before, 1.0 - before], axis=-1)
    late = np.stack([1.0 - after, after], axis=-1)
    excess = np.concatenate([excess_before, excess_after], axis=1)
    return _earliest(np.concatenate([early, late], axis=1), excess, cost)


def _expand(points: Floats, ends: list[Any], slack: Floats, *, from_goal: bool) -> tuple[_Expansion, Floats]:
    """Return the problem in the time from one end, and (N,) the cost without the via-point.

    Seen from the goal, time runs backwards: velocities change sign, accelerations do not.
    """
    q, factor = _GREEN[ends[2] is FREE, ends[3] is FREE]
    powers, g = (5, q), np.array(factor)
    first, via, last = (points[:, k] for k in range(3))
    states = [ends[:2], ends[2:]]
    if from_goal:
        powers = (q, 5)
        g = Polynomial(g)(Polynomial([1.0, -1.0])).coef
        first, last = last, first
        backwards = change_given(operator.neg, ends)
        states = [[backwards[2], ends[3]], [backwards[0], ends[1]]]
    free = connect(np, 3, np.stack([first, last], axis=1), np.ones(1), states)
    miss = -np.moveaxis(free.coefficients[:, :, 0, :], 1, -1)  # (N, D, 6)
    miss[..., 0] = via - first
    return _Expansion(miss, powers, g, slack), free.cost()


def _earliest(fractions: Floats, excess: Floats, cost: Floats) -> Floats:
    """Return the fractions (N, 2), of candidates (N, n, 2), of least excess; of equals up to rounding the earliest."""
    least = excess.min(axis=-1, keepdims=True)
    is_least = excess <= least + 1e-12 * (least + cost[:, None])
    first = np.argmin(np.where(is_least, fractions[..., 0], np.inf), axis=-1)
    best: Floats = fractions[np.arange(len(fractions)), first]
    return best
