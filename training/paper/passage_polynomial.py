"""Passage time t1 as a root of Eq. C16 in exact arithmetic, and the paper's solution in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np
from numpy.polynomial.polynomial import polyder, polydiv, polyval
from numpy.typing import NDArray

from viapoint.envs.common.types import Float

Polynomial = list[Fraction]


def passage_polynomial(via: Sequence[Fraction], goal: Sequence[Fraction]) -> Polynomial:
    """Return the coefficients of 1, tau1, ..., tau1^9 of Eq. C16; its root in (0, 1) is t1 / tf, the start the origin.

    With E = x1 - x0, D = xf - x0, a = E.D, b = D.D, c = E.E, Eq. C16 (pi . u = 0) is, but for a factor that never
    vanishes, F(tau1) = c - 2 c tau1 - 8 a tau1^3 + 34 a tau1^4 - 36 a tau1^5 + (12 a - 20 b) tau1^6 + 40 b tau1^7
    - 27 b tau1^8 + 6 b tau1^9: the terms of degree 10 and 11 cancel.
    """
    a = sum((e * d for e, d in zip(via, goal, strict=True)), Fraction(0))
    b = sum((d * d for d in goal), Fraction(0))
    c = sum((e * e for e in via), Fraction(0))
    return [c, -2 * c, Fraction(0), -8 * a, 34 * a, -36 * a, 12 * a - 20 * b, 40 * b, -27 * b, 6 * b]


def count_roots(polynomial: Polynomial) -> int:
    """Return the number of different roots in (0, 1) by Sturm's theorem, exactly. Neither end may be a root."""
    chain = [np.array(polynomial), polyder(np.array(polynomial))]
    while len(chain[-1]) > 1:
        _, rest = polydiv(chain[-2], chain[-1])
        if not rest.any():
            break
        chain.append(-rest / abs(rest[-1]))  # scaled, which keeps signs and short numbers
    return _sign_changes(chain, Fraction(0)) - _sign_changes(chain, Fraction(1))


def root_of(polynomial: Polynomial) -> float:
    """Return the root in (0, 1) by exact bisection; the polynomial is positive at 0 and negative at 1."""
    low, high = Fraction(0), Fraction(1)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if polyval(middle, polynomial) > 0 else (low, middle)
    return float((low + high) / 2)


def closed_form(waypoints: Float, share: float, time: Float) -> Float:
    """Return the hand position by the paper's Eqs. 4, 5 and C13 to C15 with their misprints corrected.

    Args:
        waypoints: Start, via-point and goal, shape (3, 2), [m].
        share: tau1 = t1 / tf.
        time: tau = t / tf, shape (T,).

    Returns:
        Shape (T, 2), [m].
    """
    x0, x1, xf = waypoints
    t, s = time[:, None], share
    p = s * (1.0 - s)
    pi = ((xf - x0) * (120 * s**5 - 300 * s**4 + 200 * s**3) - 20 * (x1 - x0)) / p**5  # Eq. C15, times tf^5
    c1 = (  # Eq. C14, times tf^5
        (xf - x0) * (300 * s**5 - 1200 * s**4 + 1600 * s**3)
        + s**2 * (-720 * xf + 120 * x1 + 600 * x0)
        + (x0 - x1) * (300 * s - 200)
    ) / (s**2 * (1.0 - s) ** 5)
    bracket = s**4 * (15 * t**4 - 30 * t**3) + s**3 * (80 * t**3 - 30 * t**4) - 60 * t**3 * s**2
    bracket = bracket + 30 * t**4 * s - 6 * t**5
    before = (pi * bracket + c1 * (15 * t**4 - 10 * t**3 - 6 * t**5)) / 720 + x0  # Eq. 4
    return np.asarray(before + pi * np.maximum(t - s, 0.0) ** 5 / 120)  # Eq. 5


def _sign_changes(chain: list[NDArray[np.object_]], place: Fraction) -> int:
    """Return the number of sign changes along a chain of polynomials at a place."""
    signs = [value > 0 for value in (polyval(place, each) for each in chain) if value]
    return sum(first != second for first, second in pairwise(signs))
