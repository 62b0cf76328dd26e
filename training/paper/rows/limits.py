"""Row 10: several via-points, ends that are not at rest, and movements at the limit of what the arm can do."""

from __future__ import annotations

import numpy as np

from viapoint.envs.arms.planar import ADULT
from viapoint.primitives import FREE, Trajectory, minimum_duration, point_to_point, through
from viapoint.training.paper.claim import Claim, at_least, at_most, near
from viapoint.training.paper.reference_movements import curved, smoothest, straight, target
from viapoint.training.paper.simulated import perform, required_torque

TOUR = ("T3", "T4", "T5", "T6", "T1")
"""Start, three via-points and goal."""
SWINGS = 8
"""Half cycles of the repetitive movement on the arm."""
SWING = 0.5
"""Duration of each, [s]."""
SPEED_LIMIT = 0.8
"""[m/s]"""
HURRY = 0.7
"""Part of the shortest duration that asks for more torque than there is."""


def limit_claims() -> list[Claim]:
    """Row 10."""
    return [*_tour_claims(), *_repetitive_claims(), *_speed_claims(), *_torque_claims()]


def _tour_claims() -> list[Claim]:
    points = np.array([target(name) for name in TOUR])
    movement = smoothest(points, 1.6)
    knots = np.asarray(movement.knots)
    middles = (knots[1:] + knots[:-1]) / 2.0
    crackle = np.asarray(movement(middles, 5))  # constant within a segment
    slope = ((crackle[1:] - crackle[:-1]) * np.asarray(movement(knots[1:-1], 1))).sum(axis=-1)  # Eq. C10
    done = perform(movement)
    missed = [np.linalg.norm(done.at(0, knots[1:-1] / knots[-1]) - points[1:-1], axis=-1).max()]
    planned = float(np.abs(np.asarray(movement(knots[1:-1])) - points[1:-1]).max())
    equal = through(points, np.full(len(points) - 1, 0.4))
    return [
        Claim(
            row=10, claim="Three via-points, free passage times: dJ/dt_k t_f/J, greatest", figure="App. C",
            paper="more via points; Eq. C10", promise=at_most(1e-6),
            model=float(np.abs(slope).max() * knots[-1] / movement.cost()),
        ),
        Claim(
            row=10, claim="Its jerk cost / that with equal segment durations", figure="-", promise=at_most(1.0),
            model=float(movement.cost() / equal.cost()),
        ),
        Claim(
            row=10, claim="Distance from its via-points at their times, greatest", figure="-", unit="mm",
            model=1e3 * planned, promise=at_most(1e-9), arm=1e3 * float(missed[0]), arm_promise=at_most(1.0),
            deviation=done.worst,
        ),
    ]  # fmt: skip


def free_acceleration() -> float:
    """Start acceleration of least jerk between two reversals, in A / t_f^2, the end's being free as well."""
    costs = [
        float(point_to_point([0.0], [1.0], 1.0, start_acceleration=[a], goal_acceleration=FREE).cost())
        for a in (0.0, 1.0, 2.0)
    ]
    square = (costs[2] - 2.0 * costs[1] + costs[0]) / 2.0  # the cost is a parabola in the acceleration
    return -(costs[1] - costs[0] - square) / (2.0 * square)


def swings() -> Trajectory:
    """To and fro between T3 and T6, from rest to rest, free acceleration at every reversal."""
    ends = np.array([target("T3"), target("T6")])
    points = ends[np.arange(SWINGS + 1) % 2]
    return through(points, np.full(SWINGS, SWING), via_velocities=np.zeros((SWINGS - 1, 2)))


def _repetitive_claims() -> list[Claim]:
    swing = point_to_point(
        [0.0], [1.0], 1.0, start_acceleration=[free_acceleration()], goal_acceleration=FREE
    )
    rest = point_to_point([0.0], [1.0], 1.0)
    hit = point_to_point([0.0], [1.0], 1.0, goal_velocity=FREE, goal_acceleration=FREE)
    done = perform(swings())
    middle = (done.time >= SWING * (SWINGS // 2)) & (done.time <= SWING * (SWINGS // 2 + 1))
    amplitude = float(np.linalg.norm(target("T6") - target("T3")))
    arm = float(np.linalg.norm(done.velocity()[0, middle], axis=-1).max()) * SWING / amplitude
    return [
        Claim(
            row=10, claim="Repetitive movement, accelerations free: peak speed t_f/A per half cycle (a sinusoid has "
            "1.571; from rest to rest 1.875)", figure="text", paper="an excellent fit to repetitive movements",
            model=float(swing.peak(1)), promise=near(1.5625, 1e-9), arm=arm, arm_promise=near(1.5625, 0.02),
            deviation=done.worst,
        ),
        Claim(
            row=10, claim="Its jerk cost / that from rest to rest", figure="text",
            model=float(swing.cost() / rest.cost()), promise=near(1.0 / 6.0, 1e-9),
        ),
        Claim(
            row=10, claim="Hitting: final velocity and acceleration free: final speed t_f/A", figure="-",
            model=float(hit(1.0, 1)[0]), promise=near(2.5, 1e-9),
        ),
    ]  # fmt: skip


def _speed_claims() -> list[Claim]:
    movement = curved("T1", "T4", 0.35, -0.45)
    fastest = movement.stretched(minimum_duration(movement, velocity=SPEED_LIMIT))
    done = perform(fastest)
    return [
        Claim(
            row=10, claim=f"Curved movement in the least time at which the speed keeps {SPEED_LIMIT} m/s "
            f"({float(fastest.duration):.3f} s): peak speed / limit", figure="text",
            paper="performance-limited movements", model=float(fastest.peak(1)) / SPEED_LIMIT, promise=near(1.0, 1e-9),
            arm=float(done.peak_speed()[0]) / SPEED_LIMIT, arm_promise=near(1.0, 0.02), deviation=done.worst,
        )
    ]  # fmt: skip


def torque_limited() -> Trajectory:
    """The movement from T3 to T6 in the shortest time that the arm's torques allow."""
    movement = straight("T3", "T6", 1.0)
    low, high = 0.1, 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _effort(movement.stretched(middle)) <= 1.0 else (middle, high)
    return movement.stretched(high)


def _effort(movement: Trajectory) -> float:
    """Greatest torque of either joint relative to its limit."""
    return float((np.abs(required_torque(ADULT, movement)) / np.array(ADULT.torque_limit)).max())


def _torque_claims() -> list[Claim]:
    fastest = torque_limited()
    done, late = perform(fastest), perform(fastest.stretched(HURRY * fastest.duration))
    used = float((np.abs(done.torque) / np.array(ADULT.torque_limit)).max())
    return [
        Claim(
            row=10, claim=f"T3-T6 in the least time within the torque limits ({float(fastest.duration):.3f} s): peak "
            "torque / limit", figure="text", paper="performance-limited movements", model=_effort(fastest),
            promise=near(1.0, 1e-6), arm=used, arm_promise=near(0.95, 0.05), deviation=done.worst,
        ),
        Claim(
            row=10, claim=f"In {HURRY} of that time the torques saturate: deviation from the plan / that at the limit",
            figure="text", paper="planning and execution cannot be clearly separated", model=None,
            arm=late.worst / done.worst, arm_promise=at_least(2.0), deviation=late.worst,
        ),
    ]  # fmt: skip
