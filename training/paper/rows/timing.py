"""Rows 7 and 8: isochrony, and the scaling of a movement with its duration."""

from __future__ import annotations

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.training.paper.claim import Claim, at_most, near
from viapoint.training.paper.reference_movements import curved, passage_share, target, via_waypoints
from viapoint.training.paper.rows.curved import ENDS, closest_approach
from viapoint.training.paper.simulated import simulate

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
