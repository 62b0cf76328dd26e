"""Rows 1 to 3, 9 and 10: movements from point to point, alternatives to minimum jerk, and movements at limits."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from viapoint import primitives
from viapoint.envs.common.arrays import Float
from viapoint.envs.plans import Motion
from viapoint.primitives import FREE, Trajectory, minimum_duration, point_to_point, through
from viapoint.training.paper import TABLE, Claim, claim, movements
from viapoint.training.paper.movements import TARGETS, SimulatedMovements, minimum_jerk_through, simulate

# Ends of the straight movements of Figs. 3 and 4, shape (3, 2, 2), [m].
DIAGONALS = np.array(
    [[TARGETS["T3"], TARGETS["T6"]], [TARGETS["T1"], TARGETS["T4"]], [TARGETS["T2"], TARGETS["T5"]]]
)
LENGTHS = np.linalg.norm(DIAGONALS[:, 1] - DIAGONALS[:, 0], axis=-1)  # Shape (3,), [m]
DURATION = 0.8  # Their duration, within the paper's 0.5 to 1 s, [s]


def diagonals(order: int = 3) -> Trajectory:
    """Return the three straight movements of the figures as a batch."""
    return point_to_point(DIAGONALS[:, 0], DIAGONALS[:, 1], DURATION, order=order)


def relative_peak(speed: Float, peak: float) -> float:
    """Return that peak speed of the three movements, in units of A / t_f, which is farthest from `peak`."""
    factor = speed * (DURATION / LENGTHS)
    return float(factor[np.abs(factor - peak).argmax()])


def bow(position: Float) -> Float:
    """Return the greatest distance of paths (..., T, 2) from their chord, [%] of its length, shape (...,)."""
    points = np.broadcast_arrays(position[..., :1, :], position, position[..., -1:, :])
    _, height = movements.construction(np.stack(points, axis=-2))
    return np.asarray(100 * height.max(axis=-1))


def point_to_point_claims() -> list[Claim]:
    """Return the claims of row 1: straight path and bell-shaped speed."""
    movement = diagonals()
    motion = simulate(movement)
    peak = relative_peak(movement.peak(1), 1.875)
    arm_peak = relative_peak(motion.speed().max(axis=1), 1.875)
    time = motion.time[motion.time <= DURATION]
    speed = primitives.speed(movement, time)
    arm_speed = motion.speed()[:, : len(time)]
    skew, arm_skew = (100 * np.abs(each - each[:, ::-1]).max() / each.max() for each in (speed, arm_speed))
    worst = motion.worst
    return [
        claim("straight", bow(movement.sample(401, 0)[0]).max(), bow(motion.hand).max(), worst),
        claim("peak", peak, arm_peak, worst),
        claim("subjects", (peak - 1.805) / 0.153, (arm_peak - 1.805) / 0.153, worst),
        claim("symmetry", skew, arm_skew, worst),
    ]


def invariance_claims() -> list[Claim]:
    """Return the claim of row 2: random movements are invariant to translation, rotation, size and duration."""
    generator = np.random.default_rng(0)
    model = max(_invariance(generator, 67, vias) for vias in (1, 2, 3))
    shapes, worst = _placed_shapes()
    return [claim("invariance", 100 * model, 100 * np.abs(shapes - shapes[0]).max(), worst)]


def _invariance(generator: np.random.Generator, count: int, vias: int) -> float:
    """Return the greatest relative difference between the plan of transformed points and the transformed plan."""
    points = generator.normal(size=(count, vias + 2, 2))
    angle = generator.uniform(-np.pi, np.pi, count)
    scale = np.exp(generator.normal(size=count))
    shift = generator.normal(size=(count, 1, 2))
    pace = np.exp(generator.normal(size=count))
    rotation = Rotation.from_euler("z", angle[:, None]).as_matrix()[:, :2, :2]

    def image(path: Float) -> Any:
        return scale[:, None, None] * path @ np.swapaxes(rotation, -1, -2) + shift

    expected = image(minimum_jerk_through(points).sample(201, 0)[0])
    found = minimum_jerk_through(image(points), pace).sample(201, 0)[0]
    return float((np.abs(found - expected) / np.ptp(expected, axis=(1, 2))[:, None, None]).max())


def _placed_shapes() -> tuple[Float, float]:
    """Simulate one shape in five places; return paths in the frame of their ends, (5, 201, 2), and deviation, [mm]."""
    pairs = (("T1", "T4"), ("T4", "T1"), ("T2", "T5"), ("T6", "T3"), ("T3", "T4"))
    waypoints = [movements.via_waypoints(TARGETS[a], TARGETS[b], 0.35, 0.2) for a, b in pairs]
    motion = simulate(minimum_jerk_through(np.stack(waypoints), np.array([0.8, 0.7, 1.0, 1.2, 0.6])))
    shapes = []
    for (start, _, goal), path in zip(waypoints, motion.at(np.linspace(0.0, 1.0, 201)), strict=True):
        line = goal - start
        axes = np.stack((line, movements.left_of(line))) / (line @ line)
        shapes.append((path - start) @ axes.T)
    return np.stack(shapes), motion.worst


def joint_claims() -> list[Claim]:
    """Return the claims of row 3: movements that are equal for the hand differ for the joints."""
    movement = diagonals()
    motion = simulate(movement)
    time = np.linspace(0.0, DURATION, 401)
    hand = _differences(primitives.speed(movement, time)).max()
    arm_hand = _differences(motion.speed()).max()
    rates = movements.joint_motion(movement).velocity
    arm_rates = motion.derivative(motion.joints)
    joints, arm_joints = (_differences(each).min() for each in (rates, arm_rates))
    places, placed = same_movement_elsewhere()
    peaks = [np.abs(torque).max(axis=1) for torque in (movements.required_torque(places), placed.torque)]
    torque, arm_torque = ((each.max(axis=0) / each.min(axis=0)).max() for each in peaks)
    worst = motion.deviation[[0, 2]].max()
    return [
        claim("hand speeds", hand, arm_hand, worst),
        claim("joint velocities", joints, arm_joints, worst),
        claim("torques", torque, arm_torque, placed.worst),
    ]


def same_movement_elsewhere() -> tuple[Trajectory, SimulatedMovements]:
    """Simulate a reach of 20 cm to the right in 0.6 s from six places."""
    starts = np.array(list(itertools.product((-0.3, -0.15, 0.0), (0.3, 0.45))))
    movement = point_to_point(starts, starts + np.array([0.2, 0.0]), 0.6)
    return movement, simulate(movement)


def _differences(profiles: Float) -> Float:
    """Return the greatest difference of the first and last of profiles (3, T, ...), each relative to its peak."""
    relative = profiles / np.abs(profiles).max(axis=1, keepdims=True)
    return np.asarray(np.abs(relative[0] - relative[2]).max(axis=0))


# Minimised quantity and peak speed in units of A / t_f, by the order of the derivative
PEAKS = {2: ("acceleration", 1.5), 3: ("jerk", 1.875), 4: ("snap", 2.1875)}
ONSET = 0.02  # Time in which the simulated arm builds up a jump of the acceleration, [s]


def joint_space(ends: Float) -> SimulatedMovements:
    """Simulate movements of minimum joint jerk between starts and goals, shape (N, 2, 2), [m]."""
    joints = movements.PLANE.joints(ends)
    time = movements.instants(DURATION)
    angles = np.asarray(point_to_point(joints[:, 0], joints[:, 1], DURATION)(time))
    position = movements.PLANE.coordinates(angles)
    velocity = np.gradient(position, time, axis=1)
    hand = Motion(position, velocity, np.gradient(velocity, time, axis=1))
    return movements.track(time, np.full(len(ends), DURATION), hand)


def alternative_claims() -> list[Claim]:
    """Return the claims of row 9."""
    peaks, onsets = [], []
    for order, (_, peak) in PEAKS.items():
        movement = diagonals(order)
        motion = simulate(movement)
        greatest = (movement.peak(1), motion.speed().max(axis=1))
        model, arm = (relative_peak(speed, peak) for speed in greatest)
        peaks.append(claim(f"peak of order {order}", model, arm, motion.worst))
        key = f"onset of order {order}"
        if key in TABLE:
            scale = DURATION**2 / LENGTHS
            first = np.linalg.norm(movement(0.0, 2), axis=-1) * scale
            mean = motion.speed()[:, round(ONSET / motion.time[1])] / ONSET * scale
            onsets.append(claim(key, first.max(), mean.max(), motion.worst, ms=1e3 * ONSET))
    return [*peaks, *onsets, *_joint_space_claims()]


def _joint_space_claims() -> list[Claim]:
    of_joints = joint_space(DIAGONALS)
    of_hand = simulate(diagonals())
    placed = joint_space(same_movement_elsewhere()[0].sample(2, 0)[0])
    bows = bow(placed.planned)
    arm_bows = bow(placed.hand)
    return [
        claim("joint jerk", bow(of_joints.planned).max(), bow(of_joints.hand).max(), of_joints.worst),
        claim("hand jerk", bow(of_hand.planned).max(), bow(of_hand.hand).max(), of_hand.worst),
        claim("bow and place", bows.max() / bows.min(), arm_bows.max() / arm_bows.min(), placed.worst),
    ]


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
        claim("tour", np.abs(slope).max() * knots[-1] / movement.cost()),
        claim("tour cost", movement.cost() / equal.cost()),
        claim("tour distance", 1e3 * planned, 1e3 * missed, motion.worst),
    ]


def swings() -> Trajectory:
    """Return a repetitive movement between T3 and T6 with free acceleration at every reversal."""
    points = DIAGONALS[0, np.arange(SWINGS + 1) % 2]
    return through(points, np.full(SWINGS, SWING), via_velocities=np.zeros((SWINGS - 1, 2)))


def _repetitive_claims() -> list[Claim]:
    # The acceleration at the start is that of least jerk, too: the jerk is zero there.
    swing = point_to_point([0.0], [1.0], 1.0, start_acceleration=[5.0], goal_acceleration=FREE)
    rest = point_to_point([0.0], [1.0], 1.0)
    hit = point_to_point([0.0], [1.0], 1.0, goal_velocity=FREE, goal_acceleration=FREE)
    motion = simulate(swings())
    middle = (motion.time >= SWING * (SWINGS // 2)) & (motion.time <= SWING * (SWINGS // 2 + 1))
    fastest = (motion.speed()[0] * (SWING / LENGTHS[0]))[middle].max()
    return [
        claim("repetitive", swing.peak(1), fastest, motion.worst),
        claim("repetitive cost", swing.cost() / rest.cost()),
        claim("hitting", hit(1.0, 1)[0]),
    ]


def torque_limited() -> Trajectory:
    """Return the movement from T3 to T6 in the shortest time within the arm's torque limits."""
    movement = movements.straight("T3", "T6", 1.0)
    return movement.stretched(brentq(lambda each: _relative_torque(movement.stretched(each)) - 1.0, 0.1, 2.0))


def _relative_torque(movement: Trajectory) -> float:
    """Return the greatest torque of either joint relative to its limit."""
    return float((np.abs(movements.required_torque(movement)) / movements.ADULT.torque_limit).max())


def _performance_limited_claims() -> list[Claim]:
    curved = movements.curved("T1", "T4", 0.35, -0.45)
    brisk = curved.stretched(minimum_duration(curved, velocity=SPEED_LIMIT))
    fastest = torque_limited()
    swift, motion, late = map(simulate, (brisk, fastest, fastest.stretched(HURRY * fastest.duration)))
    used = (np.abs(motion.torque) / movements.ADULT.torque_limit).max()
    peaks = brisk.peak(1) / SPEED_LIMIT, swift.speed().max() / SPEED_LIMIT
    return [
        claim("speed limit", *peaks, swift.worst, limit=SPEED_LIMIT, duration=float(brisk.duration)),
        claim(
            "torque limit", _relative_torque(fastest), used, motion.worst, duration=float(fastest.duration)
        ),
        claim("saturation", None, late.worst / motion.worst, late.worst, hurry=HURRY),
    ]
