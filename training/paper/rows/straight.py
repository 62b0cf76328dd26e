"""Rows 1 to 3: point-to-point movements, their invariance, and their joint angles and torques."""

from __future__ import annotations

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory, point_to_point
from viapoint.training.paper.claim import Claim, at_least, at_most, near
from viapoint.training.paper.movements import (
    SimulatedMovements,
    joint_motion,
    minimum_jerk_through,
    required_torque,
    simulate,
    straight,
    target,
)

DIAGONALS = (("T3", "T6"), ("T1", "T4"), ("T2", "T5"))
"""The straight movements of Figs. 3 and 4."""
DURATION = 0.8
"""Duration of the straight movements, within the paper's 0.5 to 1 s, [s]."""


def diagonals(order: int = 3) -> Trajectory:
    """Return the three straight movements of the figures as a batch."""
    ends = np.array([[target(a), target(b)] for a, b in DIAGONALS])
    return point_to_point(ends[:, 0], ends[:, 1], DURATION, order=order)


def bow(position: Float) -> Float:
    """Return the greatest distance of paths (..., T, 2) from their chord, relative to its length, shape (...,)."""
    line = position[..., -1:, :] - position[..., :1, :]
    offset = position - position[..., :1, :]
    turn = line[..., 0] * offset[..., 1] - line[..., 1] * offset[..., 0]
    return np.asarray((np.abs(turn) / (line * line).sum(axis=-1)).max(axis=-1))


def point_to_point_claims() -> list[Claim]:
    """Return the claims of row 1: straight path and bell-shaped speed."""
    movement = diagonals()
    motion = simulate(movement)
    amplitude = np.linalg.norm(
        movement(np.array([DURATION]))[:, 0] - movement(np.array([0.0]))[:, 0], axis=-1
    )
    scale = DURATION / amplitude
    factor, arm_factor = np.asarray(movement.peak(1)) * scale, motion.peak_speed() * scale
    speed = np.linalg.norm(movement.sample(801, 1)[0], axis=-1)
    skew = np.abs(speed - speed[:, ::-1]).max() / speed.max()
    inside = motion.time <= DURATION
    arm_speed = np.linalg.norm(motion.velocity(), axis=-1)[:, inside]
    arm_skew = np.abs(arm_speed - arm_speed[:, ::-1]).max() / arm_speed.max()
    worst, arm_worst = (values[np.abs(values - 1.875).argmax()] for values in (factor, arm_factor))
    return [
        Claim(
            row=1, claim="Path is straight: greatest distance from the chord / length", figure="1A, 3",
            paper="approximately straight", unit="%", model=100 * float(bow(movement.sample(401, 0)[0]).max()),
            expected=at_most(1e-9), arm=100 * float(bow(motion.hand).max()), arm_expected=at_most(0.2),
            deviation=motion.worst,
        ),
        Claim(
            row=1, claim="Peak speed C in V_max = C A/t_f", figure="1A, 3", paper="1.875; measured 1.805 ± 0.153",
            model=float(worst), expected=near(1.875, 1e-9), arm=float(arm_worst), arm_expected=near(1.875, 0.01),
            deviation=motion.worst,
        ),
        Claim(
            row=1, claim="Distance of C from the subjects' mean, in their standard deviations", figure="3",
            paper="(1.875 - 1.805)/0.153 = 0.458", model=float((worst - 1.805) / 0.153), expected=at_most(1.0),
            arm=float((arm_worst - 1.805) / 0.153), arm_expected=at_most(1.0), deviation=motion.worst,
        ),
        Claim(
            row=1, claim="Speed is bell-shaped and symmetric: difference from its mirror image / peak", figure="1A, 3",
            paper="bell-shaped, single-peaked", unit="%", model=100 * float(skew), expected=at_most(1e-9),
            arm=100 * float(arm_skew), arm_expected=at_most(2.0), deviation=motion.worst,
        ),
    ]  # fmt: skip


def invariance_claims() -> list[Claim]:
    """Return the claim of row 2: random movements are invariant to translation, rotation, size and duration."""
    generator = np.random.default_rng(0)
    model = max(_invariance(generator, 67, vias) for vias in (1, 2, 3))
    shapes, motion = placed_shapes()
    spread = max(float(np.abs(shape - shapes[0]).max()) for shape in shapes)
    return [
        Claim(
            row=2, figure="1", paper="invariant",
            claim="Translation, rotation, amplitude and time scaling of 201 random movements "
            "commute with planning: greatest difference / amplitude (arm: one shape in five places, sizes, times)",
            unit="%", model=100 * model, expected=at_most(1e-9), arm=100 * spread, arm_expected=at_most(0.5),
            deviation=motion.worst,
        )
    ]  # fmt: skip


def _invariance(generator: np.random.Generator, count: int, vias: int) -> float:
    """Return the greatest relative difference between the plan of transformed points and the transformed plan."""
    points = generator.normal(size=(count, vias + 2, 2))
    angle, scale = generator.uniform(-np.pi, np.pi, count), np.exp(generator.normal(size=count))
    shift, pace = generator.normal(size=(count, 1, 2)), np.exp(generator.normal(size=count))
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.stack((np.stack((cosine, -sine), -1), np.stack((sine, cosine), -1)), -2)
    moved = scale[:, None, None] * points @ np.swapaxes(rotation, -1, -2) + shift
    first, second = (
        minimum_jerk_through(points).sample(201, 0)[0],
        minimum_jerk_through(moved, pace).sample(201, 0)[0],
    )
    image = scale[:, None, None] * first @ np.swapaxes(rotation, -1, -2) + shift
    size = np.ptp(image, axis=(1, 2))[:, None, None]
    return float((np.abs(second - image) / size).max())


def placed_shapes() -> tuple[list[Float], SimulatedMovements]:
    """Simulate one shape in five places, directions, sizes and durations, and return the paths in one frame."""
    pairs = (("T1", "T4"), ("T4", "T1"), ("T2", "T5"), ("T6", "T3"), ("T3", "T4"))
    durations = np.array([0.8, 0.7, 1.0, 1.2, 0.6])
    ends = np.array([[target(a), target(b)] for a, b in pairs])
    line = ends[:, 1] - ends[:, 0]
    left = np.stack((-line[:, 1], line[:, 0]), axis=-1)
    via = ends[:, 0] + 0.35 * line + 0.2 * left
    motion = simulate(minimum_jerk_through(np.stack((ends[:, 0], via, ends[:, 1]), axis=1), durations))
    shapes = []
    for row in range(len(pairs)):
        offset = motion.at(row, np.linspace(0.0, 1.0, 201)) - ends[row, 0]
        axes = np.stack((line[row], left[row])) / (line[row] @ line[row])
        shapes.append(offset @ axes.T)
    return shapes, motion


def joint_claims() -> list[Claim]:
    """Return the claims of row 3: movements that are equal for the hand differ for the joints."""
    movements = [straight("T3", "T6", DURATION), straight("T2", "T5", DURATION)]
    model = [_profiles(each) for each in movements]
    motions = [simulate(each) for each in movements]
    arm = [_arm_profiles(each) for each in motions]
    hand = [float(np.abs(pair[0][0] - pair[1][0]).max()) for pair in (model, arm)]
    joints = [float(np.abs(pair[0][1] - pair[1][1]).max(axis=0).min()) for pair in (model, arm)]
    places, placed = same_movement_elsewhere()
    peak = np.abs(required_torque(places)).max(axis=1)
    arm_peak = np.abs(placed.torque).max(axis=1)
    ratios = [float((each.max(axis=0) / each.min(axis=0)).max()) for each in (peak, arm_peak)]
    worst = max(each.worst for each in motions)
    return [
        Claim(
            row=3, claim="Hand speed profiles of T3-T6 and T2-T5, each / its peak: greatest difference", figure="4",
            paper="invariant", model=hand[0], expected=at_most(1e-9), arm=hand[1], arm_expected=at_most(0.02),
            deviation=worst,
        ),
        Claim(
            row=3, claim="Joint velocity profiles of the same movements, each / its peak: greatest difference, "
            "of the joint where it is smaller", figure="4", paper="not invariant", model=joints[0],
            expected=at_least(0.1), arm=joints[1], arm_expected=at_least(0.1), deviation=worst,
        ),
        Claim(
            row=3, claim="Peak torque for one and the same hand movement in six places: greatest / least", figure="4",
            paper="very different patterns of joint torques", model=ratios[0], expected=at_least(1.5), arm=ratios[1],
            arm_expected=at_least(1.5), deviation=placed.worst,
        ),
    ]  # fmt: skip


def same_movement_elsewhere() -> tuple[Trajectory, SimulatedMovements]:
    """Simulate a reach of 20 cm to the right in 0.6 s from six places."""
    starts = np.array([[x, y] for x in (-0.3, -0.15, 0.0) for y in (0.3, 0.45)])
    movement = point_to_point(starts, starts + np.array([0.2, 0.0]), 0.6)
    return movement, simulate(movement)


def _profiles(movement: Trajectory) -> tuple[Float, Float]:
    """Return hand speed (T,) and joint velocities (T, 2) of the plan, each relative to its peak."""
    speed = np.linalg.norm(movement.sample(401, 1)[0], axis=-1)
    return _relative(speed), _relative(joint_motion(movement).velocity)


def _arm_profiles(motion: SimulatedMovements) -> tuple[Float, Float]:
    rates = np.gradient(motion.joints[0], motion.time, axis=0)
    return _relative(np.linalg.norm(motion.velocity()[0], axis=-1)), _relative(rates)


def _relative(values: Float) -> Float:
    return np.asarray(values / np.abs(values).max(axis=0))
