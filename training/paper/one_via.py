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
from viapoint.training.paper import movements
from viapoint.training.paper.claim import Claim, at_least, at_most, near
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
    return [
        Claim(4, f"Eq. C16 has one root in (0, 1): vias with another count, of {N_VIAS} (exact arithmetic)", "App. C",
              "only one acceptable root", (wrong, near(0.0, 0.0))),
        Claim(4, "Passage time from the exact root against the library's, the same vias: greatest difference",
              "App. C", model=(difference, at_most(1e-12))),
        Claim(4, "Eqs. 4 and 5, misprints put right, give the same movement (arm: distance from the via-point at t1)",
              "1B", "Eqs. 4, 5, C12 to C15", (formula, at_most(1e-9)), (passed, at_most(1.0)), motion.worst, "mm"),
        Claim(4, f"t1/t_f of the movement of Fig. 1B, d1/(d1+d2) = {EXAMPLE[0]}, d3/(d1+d2) = {-EXAMPLE[1]} (arm: when "
              "nearest to the via-point)", "1B", "free, from Eq. C16",
              (share, near(root, 1e-12)), (arm_share, near(share, 0.01)), motion.worst),
    ]  # fmt: skip


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
        Claim(5, "d1 = d2: time from the speed valley to the curvature peak / t_f", "1B", "at the same time",
              (model_even, at_most(1e-6)), (arm_even, at_most(0.01)), even_worst),
        Claim(5, "d1 = .28125, d3 = .5 of d1+d2: the same; it is not zero, the paper's statement holds nearly", "1B",
              "at the same time", (model_skewed, near(0.01073, 2e-5)), (arm_skewed, near(0.01073, 0.01)),
              skewed_worst),
        Claim(5, f"The same, greatest of {len(family) // 2} movements, d1/(d1+d2) .25 to .75, d3/(d1+d2) .42 to .54",
              "5-7", "at the same time", (late.model, at_most(0.03)), (late.arm, at_most(0.04)), worst),
        _threshold_claim(0.5, "; exact: 9/32 = .28125", 9.0 / 32.0, 1e-6),
        _threshold_claim(0.3, "", 0.38115, 1e-4),
    ]  # fmt: skip


def _threshold_claim(along: float, exact: str, expected: float, tolerance: float) -> Claim:
    def arm_valleys(height: float) -> int:
        (profile,) = movements.arm_profiles(simulate(curved(*ENDS, along, -height)))
        return int(np.isfinite(profile.valley[0]))

    arm = _first_height(arm_valleys, precision=5e-5)
    return Claim(
        5, f"Not every curved movement has a valley: for d1/(d1+d2) = {along} only if d3/(d1+d2) exceeds", "1B",
        f"two peaks and a valley{exact}", (valley_threshold(along), near(expected, tolerance)),
        (arm, near(expected, 0.01)), simulate(curved(*ENDS, along, -arm)).worst,
    )  # fmt: skip


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
        Claim(6, "Longer side has the higher speed peak: ratio of the peaks, least of "
              f"{len(ALONGS) * len(HEIGHTS)} vias", "6", "higher",
              (lead.model, at_least(1.0)), (lead.arm, at_least(1.0)), worst),
        Claim(6, "Larger d3, deeper valley: valley / peaks falls by at least, per step of .03 in d3/(d1+d2)", "5",
              "deeper", (deeper.model, at_least(0.001)), (deeper.arm, at_least(0.001)), worst),
        Claim(6, "Larger d3, higher curvature peak: it rises by at least, per step of .03 in d3/(d1+d2)", "5",
              "higher", (bent.model, at_least(0.1)), (bent.arm, at_least(0.1)), worst, "1/m"),
    ]  # fmt: skip


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
    text = "d3/(d1+d2) from .3 to .55"
    return [
        Claim(7, f"d1 = d2: t1/(t1+t2) is .5 for every d3: greatest difference, {text}", "10C", ".5",
              (np.abs(half - 0.5).max(), at_most(1e-12)), (np.abs(arm_half - 0.5).max(), at_most(0.01)), half_worst),
        Claim(7, f"t1/(t1+t2) is roughly .5 for d1/(d1+d2) from .1 to .9, d3/(d1+d2) = {-HEIGHT}: greatest difference "
              "from .5", "10A", "roughly .5; model and subjects differ by -.004 ± .02",
              (np.abs(shares - 0.5).max(), at_most(0.1)), (np.abs(arm - 0.5).max(), at_most(0.11)), worst),
        Claim(7, "Simulated arm against the model over the same via-points: greatest difference of t1/(t1+t2)", "10B",
              "-.004 ± .02", arm=(np.abs(arm - shares).max(), at_most(0.02)), deviation=worst),
        Claim(7, f"d1/(d1+d2) = {TYPICAL}, the paper's typical case: t1/(t1+t2) depends on d3 too little to see: its "
              f"change, {text}", "10C", "independent of d3; measured scatter .017", (np.ptp(typical), at_most(0.017)),
              (np.ptp(arm_typical), at_most(0.017)), typical_worst),
        Claim(7, "d1/(d1+d2) = .2: the independence of d3 is only approximate: t1/(t1+t2) changes by, d3/(d1+d2) from "
              ".1 to .6", "10C", "independent of d3", (spread, near(0.109, 0.001))),
    ]  # fmt: skip


def scaling_claims() -> list[Claim]:
    """Return the claims of row 8."""
    movement = curved(*ENDS, *THREE_POINTS)
    apart, arm_apart, motions = slow_and_fast(movement, 401)
    ratio = movement.stretched(FAST).peak(1) / movement.stretched(SLOW).peak(1)
    slow_peak, fast_peak = (motion.speed().max() for motion in motions)
    worst = max(motion.worst for motion in motions)
    return [
        Claim(8, "The same three points in 1.1 s and .85 s: greatest distance of the paths", "11", "the same path",
              (apart, at_most(1e-9)), (arm_apart, at_most(1.0)), worst, "mm"),
        Claim(8, "Their speeds scale with the durations: ratio of the peaks", "11", "1.1/.85 = 1.294",
              (ratio, near(SLOW / FAST, 1e-9)), (fast_peak / slow_peak, near(SLOW / FAST, 0.01)), worst),
    ]  # fmt: skip


def slow_and_fast(movement: Trajectory, count: int) -> tuple[float, float, list[SimulatedMovements]]:
    """Carry movements out in the durations of Fig. 11; return distances of model and arm paths, [mm], and motions."""
    plans = [movement.stretched(duration) for duration in (SLOW, FAST)]
    motions = [simulate(plan) for plan in plans]
    paths = [plan.sample(count, 0)[0] for plan in plans]
    arm_paths = [motion.at(np.linspace(0.0, 1.0, count)) for motion in motions]
    model, arm = (1e3 * np.linalg.norm(slow - fast, axis=-1).max() for slow, fast in (paths, arm_paths))
    return float(model), float(arm), motions
