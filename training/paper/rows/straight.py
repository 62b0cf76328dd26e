"""Rows 1 to 3: point-to-point movements, their invariance, and their joint angles and torques."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from viapoint import primitives
from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory, point_to_point
from viapoint.training.paper import movements
from viapoint.training.paper.claim import Claim, at_least, at_most, near
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
    """Return the greatest distance of paths (..., T, 2) from their chord, relative to its length, shape (...,)."""
    points = np.broadcast_arrays(position[..., :1, :], position, position[..., -1:, :])
    _, height = movements.construction(np.stack(points, axis=-2))
    return np.asarray(height.max(axis=-1))


def point_to_point_claims() -> list[Claim]:
    """Return the claims of row 1: straight path and bell-shaped speed."""
    movement = diagonals()
    motion = simulate(movement)
    peak, arm_peak = relative_peak(movement.peak(1), 1.875), relative_peak(motion.speed().max(axis=1), 1.875)
    time = motion.time[motion.time <= DURATION]
    speed, arm_speed = primitives.speed(movement, time), motion.speed()[:, : len(time)]
    skew, arm_skew = (100 * np.abs(each - each[:, ::-1]).max() / each.max() for each in (speed, arm_speed))
    worst = motion.worst
    return [
        Claim(1, "Path is straight: greatest distance from the chord / length", "1A, 3", "approximately straight",
              (100 * bow(movement.sample(401, 0)[0]).max(), at_most(1e-9)),
              (100 * bow(motion.hand).max(), at_most(0.2)), worst, unit="%"),
        Claim(1, "Peak speed C in V_max = C A/t_f", "1A, 3", "1.875; measured 1.805 ± 0.153",
              (peak, near(1.875, 1e-9)), (arm_peak, near(1.875, 0.01)), worst),
        Claim(1, "Distance of C from the subjects' mean, in their standard deviations", "3",
              "(1.875 - 1.805)/0.153 = 0.458", ((peak - 1.805) / 0.153, at_most(1.0)),
              ((arm_peak - 1.805) / 0.153, at_most(1.0)), worst),
        Claim(1, "Speed is bell-shaped and symmetric: difference from its mirror image / peak", "1A, 3",
              "bell-shaped, single-peaked", (skew, at_most(1e-9)), (arm_skew, at_most(2.0)), worst, unit="%"),
    ]  # fmt: skip


def invariance_claims() -> list[Claim]:
    """Return the claim of row 2: random movements are invariant to translation, rotation, size and duration."""
    generator = np.random.default_rng(0)
    model = max(_invariance(generator, 67, vias) for vias in (1, 2, 3))
    shapes, worst = _placed_shapes()
    return [
        Claim(2, "Translation, rotation, amplitude and time scaling of 201 random movements commute with planning: "
              "greatest difference / amplitude (arm: one shape in five places, sizes, times)", "1", "invariant",
              (100 * model, at_most(1e-9)), (100 * np.abs(shapes - shapes[0]).max(), at_most(0.5)), worst, unit="%"),
    ]  # fmt: skip


def _invariance(generator: np.random.Generator, count: int, vias: int) -> float:
    """Return the greatest relative difference between the plan of transformed points and the transformed plan."""
    points = generator.normal(size=(count, vias + 2, 2))
    angle, scale = generator.uniform(-np.pi, np.pi, count), np.exp(generator.normal(size=count))
    shift, pace = generator.normal(size=(count, 1, 2)), np.exp(generator.normal(size=count))
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
    hand, arm_hand = (
        _differences(speed).max() for speed in (primitives.speed(movement, time), motion.speed())
    )
    rates, arm_rates = movements.joint_motion(movement).velocity, motion.derivative(motion.joints)
    joints, arm_joints = (_differences(each).min() for each in (rates, arm_rates))
    places, placed = same_movement_elsewhere()
    peaks = [np.abs(torque).max(axis=1) for torque in (movements.required_torque(places), placed.torque)]
    torque, arm_torque = ((each.max(axis=0) / each.min(axis=0)).max() for each in peaks)
    worst = motion.deviation[[0, 2]].max()
    return [
        Claim(3, "Hand speed profiles of T3-T6 and T2-T5, each / its peak: greatest difference", "4", "invariant",
              (hand, at_most(1e-9)), (arm_hand, at_most(0.02)), worst),
        Claim(3, "Joint velocity profiles of the same movements, each / its peak: greatest difference, of the joint "
              "where it is smaller", "4", "not invariant",
              (joints, at_least(0.1)), (arm_joints, at_least(0.1)), worst),
        Claim(3, "Peak torque for one and the same hand movement in six places: greatest / least", "4",
              "very different patterns of joint torques",
              (torque, at_least(1.5)), (arm_torque, at_least(1.5)), placed.worst),
    ]  # fmt: skip


def same_movement_elsewhere() -> tuple[Trajectory, SimulatedMovements]:
    """Simulate a reach of 20 cm to the right in 0.6 s from six places."""
    starts = np.array([[x, y] for x in (-0.3, -0.15, 0.0) for y in (0.3, 0.45)])
    movement = point_to_point(starts, starts + np.array([0.2, 0.0]), 0.6)
    return movement, simulate(movement)


def _differences(profiles: Float) -> Float:
    """Return the greatest difference of the first and last of profiles (3, T, ...), each relative to its peak."""
    relative = profiles / np.abs(profiles).max(axis=1, keepdims=True)
    return np.asarray(np.abs(relative[0] - relative[2]).max(axis=0))
