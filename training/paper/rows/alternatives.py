"""Row 9: alternatives to minimum jerk of the hand: acceleration, snap, or jerk of the joints."""

from __future__ import annotations

import numpy as np

from viapoint.envs.arms.planar import ADULT
from viapoint.envs.common.types import Float
from viapoint.primitives import point_to_point
from viapoint.training.paper.claim import Claim, ExpectedRange, at_least, at_most, near
from viapoint.training.paper.reference_movements import target
from viapoint.training.paper.rows.straight import DIAGONALS, DURATION, bow, diagonals, same_movement_elsewhere
from viapoint.training.paper.simulated import SimulatedMovements, instants, simulate, track

PEAKS = {2: ("acceleration", 1.5), 3: ("jerk", 1.875), 4: ("snap", 2.1875)}
"""Minimised quantity and peak speed in units of A / t_f, by the order of the derivative."""
ONSET = 0.02
"""Time in which the simulated arm builds up a jump of the acceleration, [s]."""


def joint_space(ends: Float) -> SimulatedMovements:
    """Simulate movements of minimum joint jerk between starts and goals, shape (N, 2, 2), [m]."""
    joints = np.asarray(ADULT.inverse_kinematics(ends))
    time = instants(DURATION)
    angles = np.asarray(point_to_point(joints[:, 0], joints[:, 1], DURATION)(time))
    position = np.asarray(ADULT.hand_position(angles))
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
