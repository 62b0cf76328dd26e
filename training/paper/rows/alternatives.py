"""Rows 9 and 10: alternatives to minimum jerk, several via-points, and movements at the limits of the arm."""

from __future__ import annotations

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.primitives import FREE, Trajectory, minimum_duration, point_to_point, through
from viapoint.training.paper.claim import Claim, ExpectedRange, at_least, at_most, near
from viapoint.training.paper.movements import (
    ADULT,
    PLANE,
    SimulatedMovements,
    curved,
    instants,
    minimum_jerk_through,
    required_torque,
    simulate,
    straight,
    target,
    track,
)
from viapoint.training.paper.rows.straight import DIAGONALS, DURATION, bow, diagonals, same_movement_elsewhere

PEAKS = {2: ("acceleration", 1.5), 3: ("jerk", 1.875), 4: ("snap", 2.1875)}
"""Minimised quantity and peak speed in units of A / t_f, by the order of the derivative."""
ONSET = 0.02
"""Time in which the simulated arm builds up a jump of the acceleration, [s]."""


def joint_space(ends: Float) -> SimulatedMovements:
    """Simulate movements of minimum joint jerk between starts and goals, shape (N, 2, 2), [m]."""
    joints = PLANE.joints(ends)
    time = instants(DURATION)
    angles = np.asarray(point_to_point(joints[:, 0], joints[:, 1], DURATION)(time))
    position = PLANE.coordinates(angles)
    velocity = np.gradient(position, time, axis=1)
    acceleration = np.gradient(velocity, time, axis=1)
    return track(np.full(len(ends), DURATION), position, velocity, acceleration)


def diagonal_ends() -> Float:
    """Return the ends of the straight movements of Figs. 3 and 4, shape (3, 2, 2), [m]."""
    return np.array([[target(a), target(b)] for a, b in DIAGONALS])


def _amplitudes() -> Float:
    return np.array([np.linalg.norm(target(b) - target(a)) for a, b in DIAGONALS])


def alternative_claims() -> list[Claim]:
    """Return the claims of row 9."""
    return [*(_peak_claim(order) for order in PEAKS), *_onset_claims(), *_joint_space_claims()]


def _peak_claim(order: int) -> Claim:
    name, peak = PEAKS[order]
    scale = DURATION / _amplitudes()
    movement = diagonals(order)
    motion = simulate(movement)
    model, arm = np.asarray(movement.peak(1)) * scale, motion.peak_speed() * scale
    return Claim(
        row=9, claim=f"Minimum {name}: peak speed t_f/A", figure="text", paper="jerk 1.875; measured 1.805 ± 0.153",
        model=float(model[np.abs(model - peak).argmax()]), expected=near(peak, 1e-9),
        arm=float(arm[np.abs(arm - peak).argmax()]), arm_expected=near(peak, 0.02), deviation=motion.worst,
    )  # fmt: skip


def _onset_claims() -> list[Claim]:
    """Return the claims about the acceleration at the onset."""
    claims = []
    scale = DURATION**2 / _amplitudes()
    for order, expected, arm_expected in (
        (2, near(6.0, 1e-9), near(6.0, 1.0)),
        (3, at_most(1e-9), at_most(2.0)),
    ):
        movement = diagonals(order)
        motion = simulate(movement)
        first = np.linalg.norm(movement(np.array([0.0]), 2)[:, 0], axis=-1) * scale
        early = motion.time <= ONSET
        speed = np.linalg.norm(motion.velocity()[:, early][:, -1], axis=-1)
        text = (
            f"Minimum {PEAKS[order][0]}: acceleration t_f²/A at the onset (arm: mean of {1e3 * ONSET:.0f} ms)"
        )
        claims.append(
            Claim(
                row=9, claim=text, figure="text", paper="not zero" if order == 2 else "zero", model=float(first.max()),
                expected=expected, arm=float((speed / ONSET * scale).max()), arm_expected=arm_expected,
                deviation=motion.worst,
            )
        )  # fmt: skip
    return claims


def _joint_space_claims() -> list[Claim]:
    planned = joint_space(diagonal_ends())
    elsewhere = np.asarray(same_movement_elsewhere()[0].sample(2, 0)[0])
    placed = joint_space(elsewhere)
    straight = simulate(diagonals())
    rows: list[tuple[str, SimulatedMovements, ExpectedRange, ExpectedRange]] = [
        ("Minimum jerk of the joints: hand path is curved: bow / length", planned, at_least(4.0), at_least(4.0)),
        ("Minimum jerk of the hand: the same", straight, at_most(1e-9), at_most(0.2)),
    ]  # fmt: skip
    claims = [
        Claim(
            row=9, claim=text, figure="text", paper="incompatible with straight hand paths" if i == 0 else "straight",
            unit="%", model=100 * float(bow(motion.planned).max()), expected=expected,
            arm=100 * float(bow(motion.hand).max()), arm_expected=arm_expected, deviation=motion.worst,
        )
        for i, (text, motion, expected, arm_expected) in enumerate(rows)
    ]  # fmt: skip
    bows = [bow(each) for each in (placed.planned, placed.hand)]
    return [
        *claims,
        Claim(
            row=9, claim="Minimum jerk of the joints: the bow changes with place: greatest / least for one "
            "hand movement in six places", figure="text", paper="invariances in joint coordinates only",
            model=float(bows[0].max() / bows[0].min()), expected=at_least(1.3),
            arm=float(bows[1].max() / bows[1].min()), arm_expected=at_least(1.3), deviation=placed.worst,
        ),
    ]  # fmt: skip


TOUR = ("T3", "T4", "T5", "T6", "T1")
"""Start, three via-points and goal."""
SWINGS = 8
"""Half cycles of the repetitive movement on the arm."""
SWING = 0.5
"""Duration of each, [s]."""
SPEED_LIMIT = 0.8
"""[m/s]"""
HURRY = 0.7
"""Fraction of the shortest duration, which needs more torque than the limit."""


def limit_claims() -> list[Claim]:
    """Return the claims of row 10."""
    return [*_tour_claims(), *_repetitive_claims(), *_speed_claims(), *_torque_claims()]


def _tour_claims() -> list[Claim]:
    points = np.array([target(name) for name in TOUR])
    movement = minimum_jerk_through(points, 1.6)
    knots = np.asarray(movement.knots)
    middles = (knots[1:] + knots[:-1]) / 2.0
    crackle = np.asarray(movement(middles, 5))  # constant within a segment
    slope = ((crackle[1:] - crackle[:-1]) * np.asarray(movement(knots[1:-1], 1))).sum(axis=-1)  # Eq. C10
    motion = simulate(movement)
    missed = [np.linalg.norm(motion.at(0, knots[1:-1] / knots[-1]) - points[1:-1], axis=-1).max()]
    planned = float(np.abs(np.asarray(movement(knots[1:-1])) - points[1:-1]).max())
    equal = through(points, np.full(len(points) - 1, 0.4))
    return [
        Claim(
            row=10, claim="Three via-points, free passage times: dJ/dt_k t_f/J, greatest", figure="App. C",
            paper="more via points; Eq. C10", expected=at_most(1e-6),
            model=float(np.abs(slope).max() * knots[-1] / movement.cost()),
        ),
        Claim(
            row=10, claim="Its jerk cost / that with equal segment durations", figure="-", expected=at_most(1.0),
            model=float(movement.cost() / equal.cost()),
        ),
        Claim(
            row=10, claim="Distance from its via-points at their times, greatest", figure="-", unit="mm",
            model=1e3 * planned, expected=at_most(1e-9), arm=1e3 * float(missed[0]), arm_expected=at_most(1.0),
            deviation=motion.worst,
        ),
    ]  # fmt: skip


def free_acceleration() -> float:
    """Return the start acceleration of minimum jerk between two reversals, in A / t_f^2; that at the end is free."""
    costs = [
        float(point_to_point([0.0], [1.0], 1.0, start_acceleration=[a], goal_acceleration=FREE).cost())
        for a in (0.0, 1.0, 2.0)
    ]
    square = (costs[2] - 2.0 * costs[1] + costs[0]) / 2.0  # the cost is a parabola in the acceleration
    return -(costs[1] - costs[0] - square) / (2.0 * square)


def swings() -> Trajectory:
    """Return a repetitive movement between T3 and T6 with free acceleration at every reversal."""
    ends = np.array([target("T3"), target("T6")])
    points = ends[np.arange(SWINGS + 1) % 2]
    return through(points, np.full(SWINGS, SWING), via_velocities=np.zeros((SWINGS - 1, 2)))


def _repetitive_claims() -> list[Claim]:
    swing = point_to_point(
        [0.0], [1.0], 1.0, start_acceleration=[free_acceleration()], goal_acceleration=FREE
    )
    rest = point_to_point([0.0], [1.0], 1.0)
    hit = point_to_point([0.0], [1.0], 1.0, goal_velocity=FREE, goal_acceleration=FREE)
    motion = simulate(swings())
    middle = (motion.time >= SWING * (SWINGS // 2)) & (motion.time <= SWING * (SWINGS // 2 + 1))
    amplitude = float(np.linalg.norm(target("T6") - target("T3")))
    arm = float(np.linalg.norm(motion.velocity()[0, middle], axis=-1).max()) * SWING / amplitude
    return [
        Claim(
            row=10, claim="Repetitive movement, accelerations free: peak speed t_f/A per half cycle (a sinusoid has "
            "1.571; from rest to rest 1.875)", figure="text", paper="an excellent fit to repetitive movements",
            model=float(swing.peak(1)), expected=near(1.5625, 1e-9), arm=arm, arm_expected=near(1.5625, 0.02),
            deviation=motion.worst,
        ),
        Claim(
            row=10, claim="Its jerk cost / that from rest to rest", figure="text",
            model=float(swing.cost() / rest.cost()), expected=near(1.0 / 6.0, 1e-9),
        ),
        Claim(
            row=10, claim="Hitting: final velocity and acceleration free: final speed t_f/A", figure="-",
            model=float(hit(1.0, 1)[0]), expected=near(2.5, 1e-9),
        ),
    ]  # fmt: skip


def _speed_claims() -> list[Claim]:
    movement = curved("T1", "T4", 0.35, -0.45)
    fastest = movement.stretched(minimum_duration(movement, velocity=SPEED_LIMIT))
    motion = simulate(fastest)
    return [
        Claim(
            row=10, claim=f"Curved movement in the least time at which the speed keeps {SPEED_LIMIT} m/s "
            f"({float(fastest.duration):.3f} s): peak speed / limit", figure="text",
            paper="performance-limited movements", model=float(fastest.peak(1)) / SPEED_LIMIT, expected=near(1.0, 1e-9),
            arm=float(motion.peak_speed()[0]) / SPEED_LIMIT, arm_expected=near(1.0, 0.02), deviation=motion.worst,
        )
    ]  # fmt: skip


def torque_limited() -> Trajectory:
    """Return the movement from T3 to T6 in the shortest time within the arm's torque limits."""
    movement = straight("T3", "T6", 1.0)
    low, high = 0.1, 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _relative_torque(movement.stretched(middle)) <= 1.0 else (middle, high)
    return movement.stretched(high)


def _relative_torque(movement: Trajectory) -> float:
    """Return the greatest torque of either joint relative to its limit."""
    return float((np.abs(required_torque(movement)) / ADULT.torque_limit).max())


def _torque_claims() -> list[Claim]:
    fastest = torque_limited()
    motion, late = simulate(fastest), simulate(fastest.stretched(HURRY * fastest.duration))
    used = float((np.abs(motion.torque) / ADULT.torque_limit).max())
    return [
        Claim(
            row=10, claim=f"T3-T6 in the least time within the torque limits ({float(fastest.duration):.3f} s): peak "
            "torque / limit", figure="text", paper="performance-limited movements", model=_relative_torque(fastest),
            expected=near(1.0, 1e-6), arm=used, arm_expected=near(0.95, 0.05), deviation=motion.worst,
        ),
        Claim(
            row=10, claim=f"In {HURRY} of that time the torques saturate: deviation from the plan / that at the limit",
            figure="text", paper="planning and execution cannot be clearly separated", model=None,
            arm=late.worst / motion.worst, arm_expected=at_least(2.0), deviation=late.worst,
        ),
    ]  # fmt: skip
