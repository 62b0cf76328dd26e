"""Rows 4 to 8: movements through one via-point, their passage times, and their scaling with the duration."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.optimize import bisect
from sympy import Poly
from sympy.abc import tau as tau1

from viapoint.envs.common.arrays import Float
from viapoint.primitives import Trajectory, speed_valleys
from viapoint.training.paper import Claim, claim, movements
from viapoint.training.paper.movements import TARGETS, SimulatedMovements, curved, passage_share, simulate


def passage_polynomial(via: Any, goal: Any) -> Poly:
    """Return the polynomial in tau1 of Eq. C16 for fractions; its root in (0, 1) is t1 / tf, with the start as origin.

    With E = x1 - x0, D = xf - x0, a = E.D, b = D.D, c = E.E, Eq. C16 (pi . u = 0) is, but for a factor that never
    vanishes, F(tau1) = c - 2 c tau1 - 8 a tau1^3 + 34 a tau1^4 - 36 a tau1^5 + (12 a - 20 b) tau1^6 + 40 b tau1^7
    - 27 b tau1^8 + 6 b tau1^9: the terms of degree 10 and 11 cancel.
    """
    via, goal = np.array(via), np.array(goal)
    a, b, c = via @ goal, goal @ goal, via @ via
    return Poly([6 * b, -27 * b, 40 * b, 12 * a - 20 * b, -36 * a, 34 * a, -8 * a, 0, -2 * c, c], tau1)


def roots_of(polynomial: Poly) -> list[float]:
    """Return the different roots in (0, 1), isolated in exact arithmetic. Neither end may be a root."""
    intervals = polynomial.intervals(eps=Fraction(1, 10**17), inf=0, sup=1)
    return [float((low + high) / 2) for (low, high), _ in intervals]


def closed_form(waypoints: Float, share: float, time: Float) -> Float:
    """Return the hand position, shape (T, 2), [m], by the paper's Eqs. 4, 5 and C13 to C15 without their misprints.

    `waypoints` has shape (3, 2), [m]; `share` is tau1 = t1 / tf and `time` is tau = t / tf, shape (T,).
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


ENDS = ("T1", "T4")  # Targets of the family of curved movements; Fig. 1B shows one of them.
EXAMPLE = (0.35, -0.4)  # d1 / (d1 + d2) and d3 / (d1 + d2) of Fig. 1B, towards the body
ALONGS = np.array([0.25, 0.35, 0.45, 0.55, 0.65, 0.75])  # d1 / (d1 + d2) of the family
HEIGHTS = np.array([-0.42, -0.45, -0.48, -0.51, -0.54])  # d3 / (d1 + d2), all with two peaks
N_VIAS = 300  # Number of random via-points in row 4


def passage_claims() -> list[Claim]:
    """Return the claims of row 4: the free passage time."""
    wrong, difference = _count_and_compare()
    movement = curved(*ENDS, *EXAMPLE)
    share = float(passage_share(movement))
    waypoints = movements.via_waypoints(TARGETS[ENDS[0]], TARGETS[ENDS[1]], *EXAMPLE)
    via, goal = ([Fraction(float(each)) for each in point - waypoints[0]] for point in waypoints[1:])
    (root,) = roots_of(passage_polynomial(via, goal))
    time = np.linspace(0.0, 1.0, 401)
    formula = 1e3 * np.abs(closed_form(waypoints, share, time) - movement(time)).max()
    motion = simulate(movement)
    passed = 1e3 * np.linalg.norm(motion.at(np.array([share]))[0, 0] - waypoints[1])
    (arm_share,) = _closest_approach(motion, waypoints[None, 1])
    words = {"along": EXAMPLE[0], "height": -EXAMPLE[1]}
    return [
        claim("one root", wrong, n_vias=N_VIAS),
        claim("exact root", difference),
        claim("closed form", formula, passed, motion.worst),
        claim("passage time", share, arm_share, motion.worst, expected=root, **words),
    ]


def _count_and_compare() -> tuple[int, float]:
    """Return the number of via-points without exactly one root, and the greatest difference of passage times."""
    generator = np.random.default_rng(0)
    wrong, difference = 0, 0.0
    goal = (Fraction(1), Fraction(0))
    for along, height in generator.integers((-1500, 1), (2500, 1500), (N_VIAS, 2)):
        via = (Fraction(int(along), 1000), Fraction(int(height), 1000))
        roots = roots_of(passage_polynomial(via, goal))
        wrong += len(roots) != 1
        points = np.array([[0.0, 0.0], [float(via[0]), float(via[1])], [1.0, 0.0]])
        share = float(passage_share(movements.minimum_jerk_through(points)))
        difference = max(difference, abs(share - roots[0]))
    return wrong, difference


def _closest_approach(motion: SimulatedMovements, vias: Float) -> Float:
    """Return the times at which hands are nearest to via-points (N, 2), as fractions of the durations, shape (N,)."""
    distance = np.linalg.norm(motion.hand - vias[:, None], axis=-1)
    rows = np.arange(len(vias))
    nearest = np.clip(distance.argmin(axis=1), 1, distance.shape[1] - 2)
    shift, _ = movements.vertex(*(distance[rows, nearest + k] ** 2 for k in (-1, 0, 1)))
    return np.asarray((nearest + shift) * motion.time[1] / motion.duration)


def features(along: ArrayLike, height: ArrayLike) -> tuple[pd.DataFrame, float]:
    """Compare movements of the family on the model and on the simulated arm.

    A line for each who (model or arm) and via-point holds the time from speed valley to curvature peak as a fraction of
    the duration (late), the speed in the valley relative to the peaks (depth), the curvature peak, [1/m], and the ratio
    of the speed peak on the longer side to the other (lead). The second result is the deviation of the arm, [mm].
    """
    alongs, heights = np.atleast_1d(*np.broadcast_arrays(along, height))
    movement = curved(*ENDS, alongs, heights)
    motion = simulate(movement)
    profiles = {"model": movements.model_profiles(movement), "arm": movements.arm_profiles(motion)}
    lines = []
    for who, family in profiles.items():
        for a, h, profile in zip(alongs, heights, family, strict=True):
            valley, depth = profile.valley
            bend, curvature = profile.bend
            lead = np.nan
            peaks = profile.local_maxima(profile.speed)
            if len(peaks) > 1:
                early, late = sorted(peaks[:2].tolist())
                lead = late[1] / early[1] if a < 0.5 else early[1] / late[1]
            lines.append((who, a, h, bend - valley, depth, curvature, lead))
    columns = ["who", "along", "height", "late", "depth", "curvature", "lead"]
    return pd.DataFrame(lines, columns=columns), motion.worst


def valley_claims() -> list[Claim]:
    """Return the claims of row 5: speed valley and curvature peak."""
    (even, even_worst), (skewed, skewed_worst) = features(0.5, -0.5), features(0.28125, -0.5)
    model_even, arm_even = even.late.abs()
    model_skewed, arm_skewed = skewed.late
    family, worst = features(*map(np.ravel, np.meshgrid(ALONGS, HEIGHTS)))
    late = family.late.abs().groupby(family.who).agg(lambda each: each.max(skipna=False))
    return [
        claim("even valley", model_even, arm_even, even_worst),
        claim("skewed valley", model_skewed, arm_skewed, skewed_worst),
        claim("valleys", late.model, late.arm, worst, number=len(family) // 2),
        _threshold_claim(0.5),
        _threshold_claim(0.3),
    ]


def _threshold_claim(along: float) -> Claim:
    def arm_valleys(height: float) -> int:
        (profile,) = movements.arm_profiles(simulate(curved(*ENDS, along, -height)))
        return int(np.isfinite(profile.valley[0]))

    arm = _first_height(arm_valleys, precision=5e-5)
    worst = simulate(curved(*ENDS, along, -arm)).worst
    return claim(f"threshold {along}", valley_threshold(along), arm, worst)


def valley_threshold(along: float) -> float:
    """Return the least d3 / (d1 + d2) for which the model's speed has a valley."""
    return _first_height(lambda d3: speed_valleys(curved(*ENDS, along, -d3)).time.size, precision=1e-9)


def _first_height(valleys: Callable[[float], int], precision: float) -> float:
    """Return the d3 / (d1 + d2) from which movements have valleys; they have some at .5, and none at .2."""
    return float(bisect(lambda height: valleys(height) - 0.5, 0.2, 0.5, xtol=precision))


def place_claims() -> list[Claim]:
    """Return the claims of row 6: the position of the via-point."""
    family, worst = features(*map(np.ravel, np.meshgrid([*ALONGS, 0.5], HEIGHTS)))
    lead = family[family.along != 0.5].groupby("who").lead.agg(lambda each: each.min(skipna=False))
    steps = family.groupby(["who", "along"])[["depth", "curvature"]].diff().groupby(family.who)
    deeper, bent = -steps.depth.max(), steps.curvature.min()
    return [
        claim("longer side", lead.model, lead.arm, worst, number=len(ALONGS) * len(HEIGHTS)),
        claim("deeper valley", deeper.model, deeper.arm, worst),
        claim("higher bend", bent.model, bent.arm, worst),
    ]


SHARES = np.linspace(0.1, 0.9, 17)  # d1 / (d1 + d2) on the abscissa of Fig. 10A.
HEIGHT = -0.45  # d3 / (d1 + d2) there, towards the body
LENGTHS = np.linspace(0.3, 0.55, 6)  # d3 / (d1 + d2) on the abscissa of Fig. 10C.
TYPICAL = 0.45  # d1 / (d1 + d2) there: about the paper's typical t1/(t1+t2) of .49
SLOW, FAST = 1.1, 0.85  # Durations of Fig. 11, [s].
THREE_POINTS = (0.4, -0.45)  # Via-point of Fig. 11, as parts of d1 + d2.


def arm_shares(along: ArrayLike, height: ArrayLike) -> tuple[Float, float]:
    """Return the times of closest approach to each via-point, as fractions of the duration, and the deviation [mm]."""
    motion = simulate(curved(*ENDS, along, height))
    vias = movements.via_waypoints(TARGETS[ENDS[0]], TARGETS[ENDS[1]], along, height)[:, 1]
    return _closest_approach(motion, vias), motion.worst


def isochrony_claims() -> list[Claim]:
    """Return the claims of row 7."""
    half, typical = (passage_share(curved(*ENDS, along, LENGTHS)) for along in (0.5, TYPICAL))
    arm_half, half_worst = arm_shares(0.5, -LENGTHS)
    arm_typical, typical_worst = arm_shares(TYPICAL, -LENGTHS)
    shares = passage_share(curved(*ENDS, SHARES, HEIGHT))
    arm, worst = arm_shares(SHARES, HEIGHT)
    spread = np.ptp(passage_share(curved(*ENDS, 0.2, [0.1, 0.6])))
    return [
        claim("half", np.abs(half - 0.5).max(), np.abs(arm_half - 0.5).max(), half_worst),
        claim("roughly half", np.abs(shares - 0.5).max(), np.abs(arm - 0.5).max(), worst, height=-HEIGHT),
        claim("arm and model", None, np.abs(arm - shares).max(), worst),
        claim("typical", np.ptp(typical), np.ptp(arm_typical), typical_worst, along=TYPICAL),
        claim("dependence", spread),
    ]


def scaling_claims() -> list[Claim]:
    """Return the claims of row 8."""
    movement = curved(*ENDS, *THREE_POINTS)
    apart, arm_apart, motions = slow_and_fast(movement, 401)
    ratio = movement.stretched(FAST).peak(1) / movement.stretched(SLOW).peak(1)
    slow_peak, fast_peak = (motion.speed().max() for motion in motions)
    worst = max(motion.worst for motion in motions)
    return [
        claim("same path", apart, arm_apart, worst),
        claim("peak ratio", ratio, fast_peak / slow_peak, worst, expected=SLOW / FAST),
    ]


def slow_and_fast(movement: Trajectory, count: int) -> tuple[float, float, list[SimulatedMovements]]:
    """Carry movements out in the durations of Fig. 11; return distances of model and arm paths, [mm], and motions."""
    plans = [movement.stretched(duration) for duration in (SLOW, FAST)]
    motions = [simulate(plan) for plan in plans]
    paths = [plan.sample(count, 0)[0] for plan in plans]
    arm_paths = [motion.at(np.linspace(0.0, 1.0, count)) for motion in motions]
    model, arm = (1e3 * np.linalg.norm(slow - fast, axis=-1).max() for slow, fast in (paths, arm_paths))
    return float(model), float(arm), motions
