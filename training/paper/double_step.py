"""Rows 11 and 13: targets that jump; two superposed movements, or one revised plan.

Flash & Henis (1991, *Arm trajectory modifications during planar reaching movements*, J. Cogn. Neurosci. 3(3), 220-230)
described hand paths towards a target that jumps as a sum: the first movement goes on as planned, and from the moment
of revision s on a second one, from the first target A to the second B, is added. Both have minimum jerk:

    x(t) = x0 + (A - x0) q(t / T) + (B - A) q((t - s) / R),   q(u) = 10 u^3 - 15 u^4 + 6 u^5 in [0, 1], constant beyond

The new plan is the one movement of minimum jerk from the state at s to B. Both have the same state at s and are at
rest at B at s + R. If s + R = T both are one quintic with the same six boundary values, so they are the same. If
s + R > T, subtract the second movement from both: what remains of the sum reaches A at T and waits there, what
remains of the plan takes the time there is. So the two differ along the first movement alone, by what neither size nor
direction of the jump changes; and as the plan is the minimum, this difference is all that the sum costs more.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from scipy.integrate import fixed_quad
from scipy.interpolate import BPoly

from viapoint.envs.common.arrays import Float
from viapoint.envs.plans import Motion
from viapoint.primitives import Trajectory, minimum_jerk_coefficients, point_to_point, retarget
from viapoint.training.paper import Claim, claim
from viapoint.training.paper.movements import TARGETS, SimulatedMovements, instants, straight, track

STEP_DURATION = 0.7  # Duration of the first movement and of the second one, [s]
MOMENTS = (0.05, 0.1, 0.2, 0.3)  # Moments of revision, [s]
NAMES = ("T1", "T4", "T5")  # Start, first and second target
SWITCH, WHOLE_DURATION = 0.3, 0.8  # Revision and duration of the first movement in row 11, [s]


class DoubleStep(NamedTuple):
    """Movement to a target that jumps, as a sum and as a revised plan."""

    first: Trajectory
    second: Trajectory  # Movement that is added at the revision, on its own clock
    replanned: Trajectory  # Plan from the revision on, on its own clock
    moment: float  # Moment of revision, [s]

    @property
    def arrival(self) -> float:
        """Arrival at the second target, [s]."""
        return self.moment + float(self.second.duration)

    def superposed(self, time: Float, nu: int = 0) -> Float:
        """Return the sum of both movements, derivative of order `nu`, shape (T, 2)."""
        corner = self.second(0.0) if nu == 0 else 0.0  # the first target, where the second movement waits
        return np.asarray(self.first(time, nu) + self.second(time - self.moment, nu) - corner)

    def planned(self, time: Float, nu: int = 0) -> Float:
        """Return the plan with its revision, derivative of order `nu`, shape (T, 2)."""
        later = (time >= self.moment)[:, None]
        return np.asarray(np.where(later, self.replanned(time - self.moment, nu), self.first(time, nu)))

    def cost(self, way: str) -> float:
        """Return half the integral of squared jerk after the revision, [m^2/s^5]; `way` is superposed or planned."""

        def density(time: Float) -> Float:
            return np.asarray(0.5 * (getattr(self, way)(time, 3) ** 2).sum(axis=-1))

        knots = sorted({self.moment, float(self.first.duration), self.arrival})
        # Exact: squared jerk has degree 4 between knots.
        return float(sum(fixed_quad(density, *ends)[0] for ends in pairwise(knots)))


def double_step(
    moment: float, *, goal: Any = None, duration: float = STEP_DURATION, remaining: float = STEP_DURATION
) -> DoubleStep:
    """Return a movement from T1 towards T4 whose target jumps to T5, or to another goal, shape (2,), [m].

    The first movement takes `duration`, the second one `remaining`, not less than is left of the first, [s].
    """
    start, corner, last = NAMES
    goal = TARGETS[last] if goal is None else goal
    first = straight(start, corner, duration)
    second = point_to_point(TARGETS[corner], goal, remaining)
    return DoubleStep(first, second, retarget(first, moment, goal, moment + remaining), moment)


def simulate_double(movement: DoubleStep) -> SimulatedMovements:
    """Simulate the sum and the plan, in this order, on the arm."""
    time = instants(movement.arrival)
    both = (movement.superposed, movement.planned)
    parts = [np.stack([way(time, nu) for way in both]) for nu in (0, 1, 2)]
    return track(time, np.full(2, movement.arrival), Motion(*parts))


def peak_speed(movement: DoubleStep, way: str) -> float:
    """Return the greatest speed, [m/s]."""
    time = np.linspace(0.0, movement.arrival, 20_001)
    return float(np.linalg.norm(getattr(movement, way)(time, 1), axis=-1).max())


def greatest_distance(movement: DoubleStep) -> float:
    """Return the greatest distance between the sum and the plan at one time, [m]."""
    time = np.linspace(movement.moment, movement.arrival, 2_001)
    return float(np.linalg.norm(movement.superposed(time) - movement.planned(time), axis=-1).max())


def excess_cost(movement: DoubleStep) -> float:
    """Return the jerk cost of the sum beyond that of the plan, [m^2/s^5], in closed form; see the module.

    It is the cost of the rest of the first movement, less that of a movement from its state in all the time there is.
    """
    target = TARGETS[NAMES[1]]
    rest = retarget(movement.first, movement.moment, target, movement.first.duration)
    slow = retarget(movement.first, movement.moment, target, movement.arrival)
    return float(rest.cost() - slow.cost())


def double_step_claims() -> list[Claim]:
    """Return the claims of row 13: sum and plan compared."""
    every = [double_step(moment) for moment in MOMENTS]
    same = double_step(0.3, remaining=STEP_DURATION - 0.3)
    alike = simulate_double(same)
    claims = [
        claim("continuity", max(_jump(each) for each in every)),
        claim("arrival", 1e3 * greatest_distance(same), _hands_apart(alike), alike.worst),
        claim("any target", _spread()),
    ]
    for each in every:
        claims += _claims_at(each)
    return claims


def _claims_at(movement: DoubleStep) -> list[Claim]:
    """Return the claims of one moment of revision; the second movement takes as long as the first."""
    ms = 1e3 * movement.moment
    planned = movement.cost("planned")
    expected = 1.0 + excess_cost(movement) / planned
    distance = 1e3 * greatest_distance(movement)
    to_T2 = 1e3 * greatest_distance(double_step(movement.moment, goal=TARGETS["T2"]))
    found = peak_speed(movement, "superposed") / peak_speed(movement, "planned")
    motion = simulate_double(movement)
    arm = motion.speed().max(axis=1)
    return [
        claim("cost of the sum", movement.cost("superposed") / planned, ms=ms, expected=expected),
        claim("peak of the sum", found, arm[0] / arm[1], motion.worst, ms=ms),
        claim("distance of the sum", distance, _hands_apart(motion), motion.worst, ms=ms, expected=to_T2),
    ]


def _hands_apart(motion: SimulatedMovements) -> float:
    """Return the greatest distance between the hands of two movements, [mm]."""
    return float(1e3 * np.linalg.norm(motion.hand[0] - motion.hand[1], axis=-1).max())


def _jump(movement: DoubleStep) -> float:
    """Return the greatest jump of position, velocity and acceleration at the revision, relative to their peaks."""
    now = np.array([movement.moment])
    time = np.linspace(0.0, movement.arrival, 501)
    jumps = []
    for nu in range(3):
        before = movement.first(now, nu)
        scale = np.abs(movement.first(time, nu)).max()
        for after in (movement.superposed(now, nu), movement.planned(now, nu)):
            jumps.append(float(np.abs(after - before).max() / scale))
    return max(jumps)


def _spread() -> float:
    """Return the greatest relative deviation of the excess from its closed form over random second targets."""
    jumps = np.random.default_rng(0).uniform(-0.4, 0.4, (100, 2))
    found = []
    for jump in jumps:
        movement = double_step(0.2, goal=TARGETS[NAMES[1]] + jump)
        found.append(movement.cost("superposed") - movement.cost("planned"))
    return float(np.abs(np.array(found) / excess_cost(double_step(0.2)) - 1.0).max())


def replanning_claims() -> list[Claim]:
    """Return the claims of row 11: the quintic of the primer, and replanning."""
    movement = double_step(SWITCH, duration=WHOLE_DURATION)
    state = [part[0] for part in movement.first.sample(np.array([SWITCH]))]
    fresh = BPoly.from_derivatives([0.0, STEP_DURATION], [state, [TARGETS["T5"], np.zeros(2), np.zeros(2)]])
    time = np.linspace(0.0, STEP_DURATION, 201)
    apart = 1e3 * np.abs(fresh(time) - movement.replanned(time)).max()
    motion = simulate_double(movement)
    missed = 1e3 * np.linalg.norm(motion.hand[1, -1] - TARGETS["T5"])
    return [
        claim("boundary values", _boundary_error()),
        claim("replanned", 1e3 * _replanned(200)),
        claim("smooth", _jump(movement)),
        claim("fresh solution", apart, missed, motion.deviation[1]),
    ]


def _boundary_error() -> float:
    """Return the greatest error of x, x' T and x'' T^2 at both ends, relative to the largest boundary value."""
    generator = np.random.default_rng(0)
    duration = 10.0 ** generator.uniform(-3.0, 3.0, 1000)
    values = generator.normal(size=(6, 1000))  # x0, V0, A0, xT, VT, AT in unit time
    scale = np.tile([duration**0, 1.0 / duration, 1.0 / duration**2], (2, 1))
    x0, dx0, ddx0, xT, dxT, ddxT = values * scale
    coefficients = minimum_jerk_coefficients(x0, dx0, ddx0, xT, dxT, ddxT, duration)
    unit = coefficients.T * duration ** np.arange(6)[:, None]
    reached = [polyval(end, polyder(unit, nu)) for end in (0.0, 1.0) for nu in range(3)]
    return float((np.abs(reached - values) / np.abs(values).max(axis=0)).max())


def _replanned(times: int) -> float:
    """Return the greatest distance between a plan and the same plan after many replannings, [m]."""
    whole = straight("T1", "T4", 0.8)
    plan, begun, apart = whole, 0.0, 0.0
    for now in np.linspace(0.0, 0.75, times + 1)[1:]:
        plan = retarget(plan, now - begun, TARGETS["T4"], 0.8 - begun)
        begun = now
        ahead = np.linspace(now, 0.8, 11)
        apart = max(apart, float(np.abs(plan(ahead - now) - whole(ahead)).max()))
    return apart
