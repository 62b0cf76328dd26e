"""Row 13: the target jumps on the way; two movements superposed, or one plan revised.

Flash & Henis (1991, *Arm trajectory modifications during planar reaching movements*, J. Cogn. Neurosci. 3(3), 220-230)
described hand paths towards a target that jumps as a sum: the first movement goes on as planned, and from the moment
of revision s on a second one, from the first target A to the second B, is added. Both are of least jerk:

    x(t) = x0 + (A - x0) q(t / T) + (B - A) q((t - s) / R),   q(u) = 10 u^3 - 15 u^4 + 6 u^5 in [0, 1], constant beyond

The online plan is the one movement of least jerk from the state at s to B. Both have the same state at s and are at
rest at B at s + R. If s + R = T both are one quintic with the same six boundary values, so they are the same. If
s + R > T, subtract the second movement from both: what remains of the sum reaches A at T and waits there, what
remains of the plan takes the time there is. So the two differ along the first movement alone, by what neither size nor
direction of the jump changes; and as the plan is the minimum, this difference is all that the sum costs more.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory, point_to_point, retarget
from viapoint.training.paper.claim import Claim, Promise, at_least, at_most, near
from viapoint.training.paper.reference_movements import straight, target
from viapoint.training.paper.simulated import Performed, follow, instants

DURATION = 0.7
"""Of the first movement, and of the second one, [s]."""
MOMENTS = (0.05, 0.1, 0.2, 0.3)
"""When the plan is revised, [s]."""
NAMES = ("T1", "T4", "T5")
"""Start, first and second target."""


class DoubleStep(NamedTuple):
    """A movement whose target jumps on the way, both ways."""

    first: Trajectory
    second: Trajectory
    """What is added at the revision; on its own clock."""
    online: Trajectory
    """The plan from the revision on; on its own clock."""
    moment: float
    """Of the revision, [s]."""

    @property
    def arrival(self) -> float:
        """At the second target, [s]."""
        return self.moment + float(self.second.duration)

    def superposed(self, time: Float, nu: int = 0) -> Float:
        """The sum of two movements, its derivative of order `nu`, shape (T, 2)."""
        later = self.second(time - self.moment, nu) * (time >= self.moment)[:, None]
        return np.asarray(self.first(time, nu) + later - (self._corner(time) if nu == 0 else 0.0))

    def planned(self, time: Float, nu: int = 0) -> Float:
        """The plan and its revision, likewise."""
        later = (time >= self.moment)[:, None]
        return np.asarray(np.where(later, self.online(time - self.moment, nu), self.first(time, nu)))

    def cost(self, way: str) -> float:
        """Half the integral of the squared jerk from the revision on, `way` being superposed or planned, [m^2/s^5]."""
        knots = sorted({self.moment, float(self.first.duration), self.arrival})
        nodes, weights = np.polynomial.legendre.leggauss(
            5
        )  # exact: between knots squared jerk is of degree 4
        total = 0.0
        for low, high in pairwise(knots):
            jerk = getattr(self, way)(low + (high - low) * (nodes + 1.0) / 2.0, 3)
            total += (high - low) / 4.0 * float(weights @ (jerk**2).sum(axis=-1))
        return total

    @property
    def ratio(self) -> float:
        """Jerk cost of the sum relative to that of the plan."""
        return self.cost("superposed") / self.cost("planned")

    def _corner(self, time: Float) -> Float:
        """The first target, where the second movement starts, from the revision on."""
        return np.asarray(self.second(0.0) * (time >= self.moment)[:, None])


def double_step(
    moment: float, *, goal: Float | None = None, duration: float = DURATION, remaining: float = DURATION
) -> DoubleStep:
    """From T1 towards T4, then to T5.

    Args:
        moment: Of the revision, [s].
        goal: The second target if it is not T5, shape (2,), [m].
        duration: Of the first movement, [s].
        remaining: Of the second movement, which ends at moment + remaining >= duration, [s].
    """
    start, corner, last = NAMES
    goal = target(last) if goal is None else goal
    first = straight(start, corner, duration)
    second = point_to_point(target(corner), goal, remaining)
    return DoubleStep(first, second, retarget(first, moment, goal, moment + remaining), moment)


def perform_double(movement: DoubleStep) -> Performed:
    """Carried out by the simulated arm: the sum and the plan, in this order."""
    time = instants(movement.arrival)
    both = (movement.superposed, movement.planned)
    references = (np.stack([way(time, nu) for way in both]) for nu in (0, 1, 2))
    return follow(np.full(2, movement.arrival), *references)


def peak_speed(movement: DoubleStep, way: str) -> float:
    """[m/s]."""
    time = np.linspace(0.0, movement.arrival, 20_001)
    return float(np.linalg.norm(getattr(movement, way)(time, 1), axis=-1).max())


def apart(movement: DoubleStep) -> float:
    """Greatest distance between the sum and the plan at one time, [m]."""
    time = np.linspace(movement.moment, movement.arrival, 2_001)
    return float(np.linalg.norm(movement.superposed(time) - movement.planned(time), axis=-1).max())


def excess(distance: float, moment: float, duration: float, remaining: float) -> float:
    """How much more jerk the sum costs, in closed form, [m^2/s^5]; see the head of this file.

    Half the integral of the squared jerk of what is left of the first movement, less that of the quintic from its
    state that takes the whole remaining time.
    """
    u = moment / duration
    left = (1.0 - u) * duration
    state = np.array(
        [10 * u**3 - 15 * u**4 + 6 * u**5, 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u)]
    )
    state *= distance / duration ** np.arange(3)
    return _rest_cost(distance, state, left) - _rest_cost(distance, state, remaining)


def double_step_claims(seed: int = 0) -> list[Claim]:
    """Row 13."""
    every = [double_step(moment) for moment in MOMENTS]
    same = double_step(0.3, remaining=DURATION - 0.3)
    alike = perform_double(same)
    claims = [
        _claim("Both continue position, velocity and acceleration at the revision: greatest jump, relative to the "
               "peak of each", max(_jump(each) for each in every), at_most(1e-12)),
        _claim("Arrival as planned at first (revised at 300 ms, due at 700 ms): distance between sum and plan",
               1e3 * apart(same), at_most(1e-9), unit="mm",
               done=(_hands_apart(alike), at_most(1e-6)), worst=alike.worst),
        _claim("Revised at 200 ms towards 100 second targets: what the sum costs beyond the plan, relative spread",
               _spread(seed), at_most(1e-9)),
    ]  # fmt: skip
    for moment, each in zip(MOMENTS, every, strict=True):
        claims += _claims_at(moment, each)
    return claims


def _claims_at(moment: float, movement: DoubleStep) -> list[Claim]:
    """Jerk, peak speeds and distance for one moment of revision; the second movement takes as long as the first."""
    when = f"Revised at {1e3 * moment:.0f} ms"
    distance = float(np.linalg.norm(target(NAMES[1]) - target(NAMES[0])))
    more = excess(distance, moment, DURATION, DURATION)
    expected = 1.0 + more / movement.cost("planned")
    found = peak_speed(movement, "superposed") / peak_speed(movement, "planned")
    done = perform_double(movement)
    arm = done.peak_speed()
    return [
        _claim(f"{when}: jerk cost of the sum / of the plan, from there on", movement.ratio, near(expected, 1e-9)),
        _claim(f"{when}: peak speed of the sum / of the plan", found, at_least(1.0 - 1e-12), worst=done.worst,
               done=(float(arm[0] / arm[1]), near(found, 0.01))),
        _claim(f"{when}: greatest distance between sum and plan, the same for a jump to T2", 1e3 * apart(movement),
               near(1e3 * apart(double_step(moment, goal=target("T2"))), 1e-9), unit="mm", worst=done.worst,
               done=(_hands_apart(done), near(1e3 * apart(movement), 1.0))),
    ]  # fmt: skip


def _claim(
    text: str,
    model: float,
    promise: Promise,
    *,
    unit: str = "",
    done: tuple[float, Promise] | None = None,
    worst: float | None = None,
) -> Claim:
    arm, arm_promise = done or (None, None)
    return Claim(
        row=13, claim=text, unit=unit, model=model, promise=promise, arm=arm, arm_promise=arm_promise, deviation=worst
    )  # fmt: skip


def _hands_apart(done: Performed) -> float:
    """Greatest distance between the hands of two movements, [mm]."""
    return float(1e3 * np.linalg.norm(done.hand[0] - done.hand[1], axis=-1).max())


def _jump(movement: DoubleStep) -> float:
    """Of position, velocity and acceleration at the revision, relative to the greatest of each."""
    now, time = np.array([movement.moment]), np.linspace(0.0, movement.arrival, 501)
    jumps = []
    for nu in range(3):
        scale = float(np.abs(movement.first(time, nu)).max())
        jumps += [
            float(np.abs(getattr(movement, way)(now, nu) - movement.first(now, nu)).max()) / scale
            for way in ("superposed", "planned")
        ]
    return max(jumps)


def _spread(seed: int) -> float:
    """Greatest deviation of the excess from its closed form over random second targets, relative."""
    generator, moment = np.random.default_rng(seed), 0.2
    distance = float(np.linalg.norm(target(NAMES[1]) - target(NAMES[0])))
    expected = excess(distance, moment, DURATION, DURATION)
    goals = target(NAMES[1]) + generator.uniform(-0.4, 0.4, (100, 2))
    movements = [double_step(moment, goal=goal) for goal in goals]
    found = np.array([each.cost("superposed") - each.cost("planned") for each in movements])
    return float(np.abs(found / expected - 1.0).max())


def _rest_cost(distance: float, state: Float, time: float) -> float:
    """Half the integral of the squared jerk of the quintic from a state to rest at `distance` in `time`."""
    position, velocity, acceleration = state * time ** np.arange(3)
    d = distance - position - velocity - acceleration / 2.0
    e, f = -velocity - acceleration, -acceleration
    a, b, c = 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2
    square = 36 * a * a + 144 * a * b + 192 * b * b + 240 * a * c + 720 * b * c + 720 * c * c
    return float(square / (2.0 * time**5))
