"""Free passage time of one via-point with moving or free ends: the best of all stationary points.

Without the via-point the movement would be x_free(t). With r = x1 - x_free the least cost of passing x1 at t
is, in unit total time,

    J(t) = J0 + 10 |r|^2 / (t^p (1 - t)^q g(t)),                                                    (1)

    F(t) = |r|^2 (p (1 - t) g - q t g + t (1 - t) g') - 2 t (1 - t) g r . r',   p = 5,              (2)

where t^p (1 - t)^q g is 20 times the Green's function of the boundary conditions at (t, t), and dJ/dt = 0 is
F(t) = 0. There can be several minima, so all roots of the polynomial F are compared by J; among equal ones
the earliest counts.

The coefficients of F lose the digits of a root close to an end. For such movements the problem is expanded
around either end, roots are sought on every scale of time, and Newton steps use Eq. 2 instead of coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._boundary import chosen_items
from .._polynomial import add, differentiate, evaluate, multiply, root_candidates
from ..array_api import FREE, Floats, ordered_sum
from ..trajectory import connect
from .rest_to_rest import SHORTEST

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
_STEPS = 8
# Relative size of the last step that identifies a root; other points must not win as an earlier equal.
_CONVERGED_STEP = 1e-9
# Greatest unit time of the roots taken from each end; roots found twice do no harm.
_OVERLAP = 0.75


@dataclass(frozen=True)
class _Expansion:
    """Problem of N movements in the time u from one of the ends.

    Attributes:
        miss: (N, D, 6) coefficients of r in u.
        powers: p and q.
        factor: coefficients of g in u.
        slack: (N,) tolerance of the waypoints, see `_weighted_solver`.
    """

    miss: Floats
    powers: tuple[int, int]
    factor: Floats
    slack: Floats

    def weights(self) -> tuple[Floats, Floats]:
        """Return the coefficients of p (1 - u) g - q u g + u (1 - u) g' and of 2 u (1 - u) g, as in Eq. 2."""
        p, q = self.powers
        both = np.array([0.0, 1.0, -1.0])  # u (1 - u)
        weight = np.convolve(np.array([float(p), float(-p - q)]), self.factor)
        return add(weight, np.convolve(both, differentiate(self.factor))), 2.0 * np.convolve(
            both, self.factor
        )

    def stationary(self) -> Floats:
        """Return the coefficients of F (Eq. 2), (N, degree + 1)."""
        weight, both = self.weights()
        square = ordered_sum(multiply(self.miss, self.miss), 1)
        change = ordered_sum(multiply(self.miss, differentiate(self.miss)), 1)
        return add(multiply(square, weight), -multiply(change, both))

    def excess(self, u: Floats) -> Floats:
        """Return J - J0 (Eq. 1) at the candidates (N, n), infinite at the ends.

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
        """Return candidates (N, n) after Newton steps on Eq. 2, and True for those that converged to roots."""
        weight, both = self.weights()
        first = differentiate(self.miss)
        paths = [part[:, :, None] for part in (self.miss, first, differentiate(first))]
        step = u
        for _ in range(_STEPS):
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
        """Return the roots in the nearer part of the movement, (N, n) ascending, and the excess there."""
        u, is_root = self.polished(_candidates_on_every_scale(self.stationary()))
        excess = np.where((is_root | (u <= SHORTEST)) & (u <= _OVERLAP), self.excess(u), np.inf)
        order = np.argsort(u, axis=-1, kind="stable")
        return np.take_along_axis(u, order, axis=-1), np.take_along_axis(excess, order, axis=-1)


def fractions_moving(points: Floats, ends: list[Any], slack: Floats) -> Floats:
    """Return the fractions (N, 2) of the duration before and after the via-points of points (N, 3, D), all different.

    The ends are start velocity and acceleration, goal velocity and acceleration in unit time: (N, D), None or FREE.
    Each pair adds up to 1; the smaller one has full relative accuracy.
    """
    expansion, cost = _expand(points, ends, slack, from_goal=False)
    stationary = expansion.stationary()
    u = root_candidates(stationary)
    best = _earliest(u, expansion.excess(u), cost)
    fractions = np.stack([best, 1.0 - best], axis=-1)
    hard = np.flatnonzero(_inaccurate(stationary, best))
    if hard.size:
        chosen = [chosen_items(value, hard) for value in ends]
        found = _from_both_ends(points[hard], chosen, slack[hard], cost[hard])
        wrong = (np.abs(found - fractions[hard]) > _TOLERANCE * found).any(axis=-1)
        fractions[hard[wrong]] = found[wrong]
    return fractions


def _inaccurate(stationary: Floats, u: Floats) -> Any:
    """Return True where rounding of the coefficients of F may spoil the root u (N,), or hide one near an end."""
    slope = np.abs(evaluate(differentiate(stationary), u)) * np.minimum(u, 1.0 - u)
    noise = np.finfo(np.float64).eps * evaluate(np.abs(stationary), u) + np.abs(evaluate(stationary, u))
    at_ends = np.minimum(np.abs(stationary[:, 0]), np.abs(evaluate(stationary, np.ones_like(u))))
    return ~(noise < _DOUBT * slope) | ~(at_ends > _NEAR * np.abs(stationary).sum(axis=-1))


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
    (before, early), (after, late) = (
        _expand(points, ends, slack, from_goal=from_goal)[0].near_roots() for from_goal in (False, True)
    )
    after, late = after[:, ::-1], late[:, ::-1]  # in the order of time
    fractions = np.concatenate(
        [np.stack([before, 1.0 - before], axis=-1), np.stack([1.0 - after, after], axis=-1)], axis=1
    )
    return _earliest(fractions, np.concatenate([early, late], axis=1), cost)


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
        g = np.polynomial.Polynomial(g)(np.polynomial.Polynomial([1.0, -1.0])).coef
        first, last = last, first
        states = [[-v if isinstance(v, np.ndarray) else v, a] for v, a in reversed(states)]
    free = connect(np, 3, np.stack([first, last], axis=1), np.ones(1), states)
    miss = -np.moveaxis(free.coefficients[:, :, 0, :], 1, -1)  # (N, D, 6)
    miss[..., 0] = via - first
    return _Expansion(miss, powers, g, slack), free.cost()


def _earliest(choices: Floats, excess: Floats, cost: Floats) -> Floats:
    """Return the choice (N, n, ...) of least excess, the first among those equal up to rounding."""
    least = excess.min(axis=-1, keepdims=True)
    first = np.argmax(excess <= least + 1e-12 * (least + cost[:, None]), axis=-1)
    best: Floats = choices[np.arange(len(choices)), first]
    return best
