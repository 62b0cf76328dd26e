"""Rows 4 to 8: movements through one via-point, their passage times, and their scaling with the duration."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polydiv, polyval
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.primitives import speed_valleys
from viapoint.training.paper.claim import Claim, ExpectedRange, at_least, at_most, near
from viapoint.training.paper.movements import (
    Profile,
    SimulatedMovements,
    arm_profile,
    curved,
    minimum_jerk_through,
    model_profile,
    passage_share,
    simulate,
    target,
    vertex,
    via_waypoints,
)

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


ENDS = ("T1", "T4")
"""Targets of the family of curved movements; Fig. 1B shows one of them."""
EXAMPLE = (0.35, -0.4)
"""d1 / (d1 + d2) and d3 / (d1 + d2) of the movement of Fig. 1B, towards the body."""
ALONGS = np.array([0.25, 0.35, 0.45, 0.55, 0.65, 0.75])
"""d1 / (d1 + d2) of the family."""
HEIGHTS = np.array([-0.42, -0.45, -0.48, -0.51, -0.54])
"""d3 / (d1 + d2) of the family: high enough for two speed peaks everywhere, and within the reach."""
N_VIAS = 300
"""Number of random via-points in row 4."""


def passage_claims() -> list[Claim]:
    """Return the claims of row 4: the free passage time."""
    wrong, difference = _count_and_compare()
    waypoints = via_waypoints(target(ENDS[0]), target(ENDS[1]), *EXAMPLE)
    movement = minimum_jerk_through(waypoints)
    share = float(passage_share(movement))
    time = np.linspace(0.0, 1.0, 401)
    formula = 1e3 * float(np.abs(closed_form(waypoints, share, time) - movement(time)).max())
    via, goal = ([Fraction(float(each)) for each in point - waypoints[0]] for point in waypoints[1:])
    motion = simulate(movement)
    arm_share = closest_approach(motion, waypoints[1])
    passed = 1e3 * float(np.linalg.norm(motion.at(0, np.array([share]))[0] - waypoints[1]))
    return [
        Claim(
            row=4, claim=f"Eq. C16 has one root in (0, 1): vias with another count, of {N_VIAS} (exact arithmetic)",
            figure="App. C", paper="only one acceptable root", model=float(wrong), expected=near(0.0, 0.0),
        ),
        Claim(
            row=4, claim="Passage time from the exact root against the library's, the same vias: greatest difference",
            figure="App. C", model=difference, expected=at_most(1e-12),
        ),
        Claim(
            row=4, claim="Eqs. 4 and 5, misprints put right, give the same movement (arm: distance from the via-point "
            "at t1)", figure="1B", paper="Eqs. 4, 5, C12 to C15", unit="mm", model=formula, expected=at_most(1e-9),
            arm=passed, arm_expected=at_most(1.0), deviation=motion.worst,
        ),
        Claim(
            row=4, claim=f"t1/t_f of the movement of Fig. 1B, d1/(d1+d2) = {EXAMPLE[0]}, d3/(d1+d2) = "
            f"{-EXAMPLE[1]} (arm: when nearest to the via-point)", figure="1B", paper="free, from Eq. C16",
            model=share, expected=near(root_of(passage_polynomial(via, goal)), 1e-12), arm=arm_share,
            arm_expected=near(share, 0.01), deviation=motion.worst,
        ),
    ]  # fmt: skip


def _count_and_compare() -> tuple[int, float]:
    """Return the number of via-points without exactly one root, and the greatest difference of passage times."""
    generator = np.random.default_rng(0)
    wrong, difference = 0, 0.0
    goal = (Fraction(1), Fraction(0))
    for along, height in generator.integers((-1500, 1), (2500, 1500), (N_VIAS, 2)):
        via = (Fraction(int(along), 1000), Fraction(int(height), 1000))
        polynomial = passage_polynomial(via, goal)
        wrong += count_roots(polynomial) != 1
        points = np.array([[0.0, 0.0], [float(via[0]), float(via[1])], [1.0, 0.0]])
        share = float(passage_share(minimum_jerk_through(points)))
        difference = max(difference, abs(share - root_of(polynomial)))
    return wrong, difference


def closest_approach(motion: SimulatedMovements, via: Float, row: int = 0) -> float:
    """Return the time at which the simulated hand is nearest to the via-point, as a fraction of the duration."""
    distance = np.linalg.norm(motion.hand[row] - via, axis=-1)
    i = int(np.clip(distance.argmin(), 1, len(distance) - 2))
    shift, _ = vertex(*distance[i - 1 : i + 2] ** 2)
    return float((motion.time[i] + shift * (motion.time[1] - motion.time[0])) / motion.duration[row])


class ModelAndArm(NamedTuple):
    """Curved movement on the model and on the simulated arm."""

    shown: tuple[Profile, Profile]
    """Profiles of model and arm."""
    worst: float
    """Deviation of the arm from the plan, [mm]."""


def both(along: float, height: float) -> ModelAndArm:
    """Return the movement of the family through a via-point."""
    movement = curved(*ENDS, along, height)
    motion = simulate(movement)
    return ModelAndArm((model_profile(movement), arm_profile(motion)), motion.worst)


def valley_claims() -> list[Claim]:
    """Return the claims of row 5: speed valley and curvature peak."""
    even, skewed = both(0.5, -0.5), both(0.28125, -0.5)
    offset = [each.bend[0] - each.valley for each in skewed.shown]
    family = [both(along, height) for along in ALONGS for height in HEIGHTS]
    near_by = [max(abs(each.shown[i].bend[0] - each.shown[i].valley) for each in family) for i in (0, 1)]
    worst = max(each.worst for each in family)
    return [
        Claim(
            row=5, claim="d1 = d2: time from the speed valley to the curvature peak / t_f", figure="1B",
            paper="at the same time", model=abs(even.shown[0].bend[0] - even.shown[0].valley), expected=at_most(1e-6),
            arm=abs(even.shown[1].bend[0] - even.shown[1].valley), arm_expected=at_most(0.01), deviation=even.worst,
        ),
        Claim(
            row=5, claim="d1 = .28125, d3 = .5 of d1+d2: the same; it is not zero, the paper's statement holds nearly",
            figure="1B", paper="at the same time", model=offset[0], expected=near(0.01073, 2e-5), arm=offset[1],
            arm_expected=near(0.01073, 0.01), deviation=skewed.worst,
        ),
        Claim(
            row=5, claim=f"The same, greatest of {len(family)} movements, d1/(d1+d2) .25 to .75, d3/(d1+d2) .42 to .54",
            figure="5-7", paper="at the same time", model=near_by[0], expected=at_most(0.03), arm=near_by[1],
            arm_expected=at_most(0.04), deviation=worst,
        ),
        _threshold_claim(0.5, "exact: 9/32 = .28125", near(9.0 / 32.0, 1e-6)),
        _threshold_claim(0.3, "-", near(0.38115, 1e-4)),
    ]  # fmt: skip


def _threshold_claim(along: float, exact: str, expected: ExpectedRange) -> Claim:
    model = valley_threshold(functools.partial(model_has_valley, along))

    def arm_has_valley(height: float) -> bool:
        return bool(np.isfinite(arm_profile(simulate(curved(*ENDS, along, -height))).valley))

    arm = valley_threshold(arm_has_valley, halvings=12)
    return Claim(
        row=5, claim=f"Not every curved movement has a valley: for d1/(d1+d2) = {along} only if d3/(d1+d2) exceeds",
        figure="1B", paper=f"two peaks and a valley; {exact}".removesuffix("; -"), model=model, expected=expected,
        arm=arm, arm_expected=near((expected.low + expected.high) / 2.0, 0.01),
        deviation=simulate(curved(*ENDS, along, -arm)).worst,
    )  # fmt: skip


def model_has_valley(along: float, height: float) -> bool:
    """Return whether the model's speed has a valley, exactly."""
    return bool(speed_valleys(curved(*ENDS, along, -height)).time.size)


def valley_threshold(has_valley: Callable[[float], bool], halvings: int = 30) -> float:
    """Return the least d3 / (d1 + d2) with a speed valley, by bisection."""
    low, high = 0.2, 0.5
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if has_valley(middle) else (middle, high)
    return 0.5 * (low + high)


def place_claims() -> list[Claim]:
    """Return the claims of row 6: the position of the via-point."""
    family = {(along, height): both(along, height) for along in (*ALONGS, 0.5) for height in HEIGHTS.tolist()}
    worst = max(each.worst for each in family.values())
    higher = [
        min(_longer_side_lead(family[a, h].shown[i], a) for a in ALONGS for h in HEIGHTS.tolist())
        for i in (0, 1)
    ]
    deeper, bent = (
        [min(_least_step(family, a, i, quantity) for a in (*ALONGS, 0.5)) for i in (0, 1)]
        for quantity in (lambda each: -each.valley_depth, lambda each: each.bend[1])
    )
    text = f"least of {len(ALONGS) * len(HEIGHTS)} vias"
    return [
        Claim(
            row=6, claim=f"Longer side has the higher speed peak: ratio of the peaks, {text}", figure="6",
            paper="higher", model=higher[0], expected=at_least(1.0), arm=higher[1], arm_expected=at_least(1.0),
            deviation=worst,
        ),
        Claim(
            row=6, claim="Larger d3, deeper valley: valley / peaks falls by at least, per step of .03 in d3/(d1+d2)",
            figure="5", paper="deeper", model=deeper[0], expected=at_least(0.001), arm=deeper[1],
            arm_expected=at_least(0.001), deviation=worst,
        ),
        Claim(
            row=6, claim="Larger d3, higher curvature peak: it rises by at least, per step of .03 in d3/(d1+d2)",
            figure="5", paper="higher", unit="1/m", model=bent[0], expected=at_least(0.1), arm=bent[1],
            arm_expected=at_least(0.1), deviation=worst,
        ),
    ]  # fmt: skip


def _longer_side_lead(profile: Profile, along: float) -> float:
    """Return the ratio of the speed peak on the longer side to the other one; NaN without two peaks."""
    peaks = profile.peaks
    if len(peaks) < 2:
        return np.nan
    early, late = peaks[:2][np.argsort(peaks[:2, 0]), 1]
    return float(late / early if along < 0.5 else early / late)


def _least_step(
    family: dict[tuple[float, float], ModelAndArm],
    along: float,
    which: int,
    quantity: Callable[[Profile], float],
) -> float:
    """Return the least rise of a quantity from one height to the next, on the model (0) or the arm (1)."""
    values = [quantity(family[along, height].shown[which]) for height in HEIGHTS.tolist()]
    return float(np.diff(values).min())


SHARES = np.linspace(0.1, 0.9, 17)
"""d1 / (d1 + d2) on the abscissa of Fig. 10A."""
HEIGHT = -0.45
"""d3 / (d1 + d2) there, towards the body."""
LENGTHS = np.linspace(0.3, 0.55, 6)
"""d3 / (d1 + d2) on the abscissa of Fig. 10C."""
TYPICAL = 0.45
"""d1 / (d1 + d2) there: about the paper's typical t1/(t1+t2) of .49."""
SLOW, FAST = 1.1, 0.85
"""Durations of Fig. 11, [s]."""
THREE_POINTS = (0.4, -0.45)
"""Via-point of Fig. 11, as parts of d1 + d2."""


def arm_shares(alongs: Float, heights: Float) -> tuple[Float, float]:
    """Return the times of closest approach to each via-point, as fractions of the duration, and the deviation [mm]."""
    alongs, heights = np.broadcast_arrays(alongs, heights)
    motion = simulate(curved(*ENDS, alongs, heights))
    vias = via_waypoints(target(ENDS[0]), target(ENDS[1]), alongs, heights)[:, 1]
    shares = [closest_approach(motion, via, row) for row, via in enumerate(vias)]
    return np.array(shares), motion.worst


def isochrony_claims() -> list[Claim]:
    """Return the claims of row 7."""
    half = passage_share(curved(*ENDS, 0.5, LENGTHS))
    arm_half, half_worst = arm_shares(np.array(0.5), -LENGTHS)
    shares, (arm, worst) = passage_share(curved(*ENDS, SHARES, HEIGHT)), arm_shares(SHARES, np.array(HEIGHT))
    spread = np.ptp(passage_share(curved(*ENDS, 0.2, np.array([0.1, 0.6]))))
    typical = passage_share(curved(*ENDS, TYPICAL, LENGTHS))
    arm_typical, typical_worst = arm_shares(np.array(TYPICAL), -LENGTHS)
    text = "d3/(d1+d2) from .3 to .55"
    return [
        Claim(
            row=7, claim=f"d1 = d2: t1/(t1+t2) is .5 for every d3: greatest difference, {text}", figure="10C",
            paper=".5", model=float(np.abs(half - 0.5).max()), expected=at_most(1e-12),
            arm=float(np.abs(arm_half - 0.5).max()), arm_expected=at_most(0.01), deviation=half_worst,
        ),
        Claim(
            row=7, claim=f"t1/(t1+t2) is roughly .5 for d1/(d1+d2) from .1 to .9, d3/(d1+d2) = {-HEIGHT}: greatest "
            "difference from .5", figure="10A", paper="roughly .5; model and subjects differ by -.004 ± .02",
            model=float(np.abs(shares - 0.5).max()), expected=at_most(0.1), arm=float(np.abs(arm - 0.5).max()),
            arm_expected=at_most(0.11), deviation=worst,
        ),
        Claim(
            row=7, claim="Simulated arm against the model over the same via-points: greatest difference of t1/(t1+t2)",
            figure="10B", paper="-.004 ± .02", model=None, arm=float(np.abs(arm - shares).max()),
            arm_expected=at_most(0.02), deviation=worst,
        ),
        Claim(
            row=7, claim=f"d1/(d1+d2) = {TYPICAL}, the paper's typical case: t1/(t1+t2) depends on d3 too little to "
            f"see: its change, {text}", figure="10C", paper="independent of d3; measured scatter .017",
            model=float(np.ptp(typical)), expected=at_most(0.017), arm=float(np.ptp(arm_typical)),
            arm_expected=at_most(0.017), deviation=typical_worst,
        ),
        Claim(
            row=7, claim="d1/(d1+d2) = .2: the independence of d3 is only approximate: t1/(t1+t2) changes by, "
            "d3/(d1+d2) from .1 to .6", figure="10C", paper="independent of d3", model=float(spread),
            expected=near(0.109, 0.001),
        ),
    ]  # fmt: skip


def scaling_claims() -> list[Claim]:
    """Return the claims of row 8."""
    movement = curved(*ENDS, *THREE_POINTS, np.array([SLOW, FAST]))
    motion = simulate(movement)
    fractions = np.linspace(0.0, 1.0, 401)
    paths = movement.sample(401, 0)[0]
    arm_paths = np.stack([motion.at(row, fractions) for row in (0, 1)])
    difference, arm_difference = (
        float(np.linalg.norm(each[0] - each[1], axis=-1).max()) for each in (paths, arm_paths)
    )
    speeds, arm_speeds = np.asarray(movement.peak(1)), motion.peak_speed()
    return [
        Claim(
            row=8, claim="The same three points in 1.1 s and .85 s: greatest distance of the paths", figure="11",
            paper="the same path", unit="mm", model=1e3 * difference, expected=at_most(1e-9), arm=1e3 * arm_difference,
            arm_expected=at_most(1.0), deviation=motion.worst,
        ),
        Claim(
            row=8, claim="Their speeds scale with the durations: ratio of the peaks", figure="11",
            paper="1.1/.85 = 1.294", model=float(speeds[1] / speeds[0]), expected=near(SLOW / FAST, 1e-9),
            arm=float(arm_speeds[1] / arm_speeds[0]), arm_expected=near(SLOW / FAST, 0.01), deviation=motion.worst,
        ),
    ]  # fmt: skip
