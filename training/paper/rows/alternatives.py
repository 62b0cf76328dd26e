"""Rows 9 and 10: alternatives to minimum jerk, several via-points, and movements at the limits of the arm."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from viapoint.envs.common.types import Float
from viapoint.primitives import FREE, Trajectory, minimum_duration, point_to_point, through
from viapoint.training.paper import movements
from viapoint.training.paper.claim import Claim, at_least, at_most, near
from viapoint.training.paper.movements import ADULT, PLANE, TARGETS, SimulatedMovements, simulate
from viapoint.training.paper.rows import straight
from viapoint.training.paper.rows.straight import DIAGONALS, DURATION, LENGTHS, bow, diagonals

# Minimised quantity and peak speed in units of A / t_f, by the order of the derivative
PEAKS = {2: ("acceleration", 1.5), 3: ("jerk", 1.875), 4: ("snap", 2.1875)}
# Acceleration at the onset: statement of the paper, and ranges for model and arm, by the order
ONSETS = {2: ("not zero", near(6.0, 1e-9), near(6.0, 1.0)), 3: ("zero", at_most(1e-9), at_most(2.0))}
ONSET = 0.02  # Time in which the simulated arm builds up a jump of the acceleration, [s]


def joint_space(ends: Float) -> SimulatedMovements:
    """Simulate movements of minimum joint jerk between starts and goals, shape (N, 2, 2), [m]."""
    joints = PLANE.joints(ends)
    time = movements.instants(DURATION)
    angles = np.asarray(point_to_point(joints[:, 0], joints[:, 1], DURATION)(time))
    position = PLANE.coordinates(angles)
    velocity = np.gradient(position, time, axis=1)
    acceleration = np.gradient(velocity, time, axis=1)
    return movements.track(np.full(len(ends), DURATION), position, velocity, acceleration)


def alternative_claims() -> list[Claim]:
    """Return the claims of row 9."""
    peaks, onsets = [], []
    for order, (name, peak) in PEAKS.items():
        movement = diagonals(order)
        motion = simulate(movement)
        greatest = (movement.peak(1), motion.speed().max(axis=1))
        model, arm = (straight.relative_peak(speed, peak) for speed in greatest)
        peaks.append(
            Claim(9, f"Minimum {name}: peak speed t_f/A", "text", "jerk 1.875; measured 1.805 ± 0.153",
                  (model, near(peak, 1e-9)), (arm, near(peak, 0.02)), motion.worst)
        )  # fmt: skip
        if order in ONSETS:
            paper, expected, arm_expected = ONSETS[order]
            scale = DURATION**2 / LENGTHS
            first = np.linalg.norm(movement(0.0, 2), axis=-1) * scale
            speed = motion.speed()[:, round(ONSET / motion.time[1])]
            onsets.append(
                Claim(9, f"Minimum {name}: acceleration t_f²/A at the onset (arm: mean of {1e3 * ONSET:.0f} ms)",
                      "text", paper, (first.max(), expected), ((speed / ONSET * scale).max(), arm_expected),
                      motion.worst)
            )  # fmt: skip
    return [*peaks, *onsets, *_joint_space_claims()]


def _joint_space_claims() -> list[Claim]:
    of_joints, of_hand = joint_space(DIAGONALS), simulate(diagonals())
    placed = joint_space(straight.same_movement_elsewhere()[0].sample(2, 0)[0])
    bows, arm_bows = bow(placed.planned), bow(placed.hand)
    return [
        Claim(9, "Minimum jerk of the joints: hand path is curved: bow / length", "text",
              "incompatible with straight hand paths", (100 * bow(of_joints.planned).max(), at_least(4.0)),
              (100 * bow(of_joints.hand).max(), at_least(4.0)), of_joints.worst, "%"),
        Claim(9, "Minimum jerk of the hand: the same", "text", "straight",
              (100 * bow(of_hand.planned).max(), at_most(1e-9)), (100 * bow(of_hand.hand).max(), at_most(0.2)),
              of_hand.worst, "%"),
        Claim(9, "Minimum jerk of the joints: the bow changes with place: greatest / least for one hand movement in "
              "six places", "text", "invariances in joint coordinates only", (bows.max() / bows.min(), at_least(1.3)),
              (arm_bows.max() / arm_bows.min(), at_least(1.3)), placed.worst),
    ]  # fmt: skip


TOUR = ("T3", "T4", "T5", "T6", "T1")  # Start, three via-points and goal
SWINGS = 8  # Half cycles of the repetitive movement on the arm
SWING = 0.5  # Duration of each, [s]
SPEED_LIMIT = 0.8  # [m/s]
HURRY = 0.7  # Fraction of the shortest duration, which needs more torque than the limit


def limit_claims() -> list[Claim]:
    """Return the claims of row 10."""
    return [*_tour_claims(), *_repetitive_claims(), *_performance_limited_claims()]


def _tour_claims() -> list[Claim]:
    points = np.array([TARGETS[name] for name in TOUR])
    movement = movements.minimum_jerk_through(points, 1.6)
    knots = np.asarray(movement.knots)
    crackle = movement((knots[1:] + knots[:-1]) / 2.0, 5)  # constant within a segment
    slope = ((crackle[1:] - crackle[:-1]) * movement(knots[1:-1], 1)).sum(axis=-1)  # Eq. C10
    motion = simulate(movement)
    missed = np.linalg.norm(motion.at(knots[1:-1] / knots[-1])[0] - points[1:-1], axis=-1).max()
    planned = np.abs(movement(knots[1:-1]) - points[1:-1]).max()
    equal = through(points, np.full(len(points) - 1, 0.4))
    return [
        Claim(10, "Three via-points, free passage times: dJ/dt_k t_f/J, greatest", "App. C",
              "more via points; Eq. C10", (np.abs(slope).max() * knots[-1] / movement.cost(), at_most(1e-6))),
        Claim(10, "Its jerk cost / that with equal segment durations",
              model=(movement.cost() / equal.cost(), at_most(1.0))),
        Claim(10, "Distance from its via-points at their times, greatest", model=(1e3 * planned, at_most(1e-9)),
              arm=(1e3 * missed, at_most(1.0)), deviation=motion.worst, unit="mm"),
    ]  # fmt: skip


def _free_acceleration() -> float:
    """Return the start acceleration of minimum jerk between two reversals, in A / t_f^2; that at the end is free."""
    none, one, two = (_swing(acceleration).cost() for acceleration in (0.0, 1.0, 2.0))
    square = (two - 2.0 * one + none) / 2.0  # the cost is a parabola in the acceleration
    return float(-(one - none - square) / (2.0 * square))


def _swing(acceleration: float) -> Trajectory:
    """Return the movement by 1 in 1 s with a given acceleration at the start and a free one at its end."""
    return point_to_point([0.0], [1.0], 1.0, start_acceleration=[acceleration], goal_acceleration=FREE)


def swings() -> Trajectory:
    """Return a repetitive movement between T3 and T6 with free acceleration at every reversal."""
    points = DIAGONALS[0, np.arange(SWINGS + 1) % 2]
    return through(points, np.full(SWINGS, SWING), via_velocities=np.zeros((SWINGS - 1, 2)))


def relative_swing_speed(motion: SimulatedMovements) -> Float:
    """Return the speed of simulated swings in units of amplitude / duration of a swing, shape (T,)."""
    return np.asarray(motion.speed()[0] * (SWING / LENGTHS[0]))


def _repetitive_claims() -> list[Claim]:
    swing, rest = _swing(_free_acceleration()), point_to_point([0.0], [1.0], 1.0)
    hit = point_to_point([0.0], [1.0], 1.0, goal_velocity=FREE, goal_acceleration=FREE)
    motion = simulate(swings())
    middle = (motion.time >= SWING * (SWINGS // 2)) & (motion.time <= SWING * (SWINGS // 2 + 1))
    return [
        Claim(10, "Repetitive movement, accelerations free: peak speed t_f/A per half cycle (a sinusoid has 1.571; "
              "from rest to rest 1.875)", "text", "an excellent fit to repetitive movements",
              (swing.peak(1), near(1.5625, 1e-9)),
              (relative_swing_speed(motion)[middle].max(), near(1.5625, 0.02)), motion.worst),
        Claim(10, "Its jerk cost / that from rest to rest", "text",
              model=(swing.cost() / rest.cost(), near(1.0 / 6.0, 1e-9))),
        Claim(10, "Hitting: final velocity and acceleration free: final speed t_f/A",
              model=(hit(1.0, 1)[0], near(2.5, 1e-9))),
    ]  # fmt: skip


def torque_limited() -> Trajectory:
    """Return the movement from T3 to T6 in the shortest time within the arm's torque limits."""
    movement = movements.straight("T3", "T6", 1.0)
    return movement.stretched(brentq(lambda each: _relative_torque(movement.stretched(each)) - 1.0, 0.1, 2.0))


def _relative_torque(movement: Trajectory) -> float:
    """Return the greatest torque of either joint relative to its limit."""
    return float((np.abs(movements.required_torque(movement)) / ADULT.torque_limit).max())


def _performance_limited_claims() -> list[Claim]:
    curved = movements.curved("T1", "T4", 0.35, -0.45)
    brisk, fastest = curved.stretched(minimum_duration(curved, velocity=SPEED_LIMIT)), torque_limited()
    swift, motion, late = map(simulate, (brisk, fastest, fastest.stretched(HURRY * fastest.duration)))
    used = (np.abs(motion.torque) / ADULT.torque_limit).max()
    return [
        Claim(10, f"Curved movement in the least time at which the speed keeps {SPEED_LIMIT} m/s "
              f"({float(brisk.duration):.3f} s): peak speed / limit", "text", "performance-limited movements",
              (brisk.peak(1) / SPEED_LIMIT, near(1.0, 1e-9)), (swift.speed().max() / SPEED_LIMIT, near(1.0, 0.02)),
              swift.worst),
        Claim(10, f"T3-T6 in the least time within the torque limits ({float(fastest.duration):.3f} s): peak torque / "
              "limit", "text", "performance-limited movements", (_relative_torque(fastest), near(1.0, 1e-6)),
              (used, near(0.95, 0.05)), motion.worst),
        Claim(10, f"In {HURRY} of that time the torques saturate: deviation from the plan / that at the limit", "text",
              "planning and execution cannot be clearly separated",
              arm=(late.worst / motion.worst, at_least(2.0)), deviation=late.worst),
    ]  # fmt: skip
