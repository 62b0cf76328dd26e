"""Row 11: the primer's quintic from any boundary values, and the movement that changes on the way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory, minimum_jerk_coefficients, retarget
from viapoint.training.paper.claim import Claim, at_most
from viapoint.training.paper.reference_movements import straight, target
from viapoint.training.paper.simulated import Performed, follow, instants

SWITCH = 0.3
"""When the target jumps, [s]."""
ARRIVAL = 1.0
"""When the new target is reached, instead of after 0.8 s, [s]."""


class Jump(NamedTuple):
    """A movement from T1 to T4 whose target jumps to T5 on the way."""

    old: Trajectory
    new: Trajectory
    """From the switch on; its own clock starts at 0."""

    def at(self, time: Float) -> tuple[Float, ...]:
        """Position, velocity and acceleration, shape (T, 2) each."""
        early, late = self.old.sample(time), self.new.sample(np.maximum(time - SWITCH, 0.0))
        before = (time < SWITCH)[:, None]
        return tuple(np.where(before, a, b) for a, b in zip(early, late, strict=True))


def jump() -> Jump:
    """Planned with the online version."""
    old = straight("T1", "T4", 0.8)
    return Jump(old, retarget(old, SWITCH, target("T5"), ARRIVAL))


def perform_jump(movement: Jump) -> Performed:
    """Carried out by the simulated arm."""
    references = (part[None] for part in movement.at(instants(ARRIVAL)))
    return follow(np.array([ARRIVAL]), *references)


def online_claims(seed: int = 0) -> list[Claim]:
    """Row 11."""
    movement = jump()
    state = movement.old.sample(np.array([SWITCH]))
    fresh = _solved(state, target("T5"), ARRIVAL - SWITCH)
    apart = np.abs(fresh - movement.new.sample(201, 0)[0]).max()
    begun = movement.new.sample(np.array([0.0]))
    jumps = [float(np.abs(a - b).max() / np.abs(a).max()) for a, b in zip(state, begun, strict=True)]
    done = perform_jump(movement)
    missed = float(np.linalg.norm(done.hand[0, -1] - target("T5")))
    return [
        Claim(
            row=11, claim="Quintic from 1,000 random boundary values, T from 1 ms to 1000 s: greatest relative error "
            "at the ends", figure="primer", paper="Eqs. 16 to 24", model=_boundary_error(seed), promise=at_most(1e-12),
        ),
        Claim(
            row=11, claim="Replanned 200 times on the way, target unchanged: distance from the one plan",
            figure="primer", paper="Eqs. 25 to 27", unit="mm", model=1e3 * _replanned(200), promise=at_most(1e-9),
        ),
        Claim(
            row=11, claim="Target and arrival change on the way: jump of position, velocity, acceleration, relative",
            figure="primer", paper="smooth", model=max(jumps), promise=at_most(1e-12),
        ),
        Claim(
            row=11, claim="The same against a fresh solution from that state (arm: distance from the new target at the "
            "end)", figure="primer", paper="the same", unit="mm", model=1e3 * float(apart), promise=at_most(1e-9),
            arm=1e3 * missed, arm_promise=at_most(1.0), deviation=done.worst,
        ),
    ]  # fmt: skip


def _solved(state: tuple[Float, ...], goal: Float, duration: float) -> Float:
    """Positions at 201 instants from a state to rest at a goal: the primer's six equations, solved as they stand."""
    powers = np.arange(6)
    u = np.linspace(0.0, 1.0, 201)[:, None] ** powers  # in unit time
    matrix = np.zeros((6, 6))
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = 1.0, 1.0, 2.0
    matrix[3:] = np.ones(6), powers, powers * (powers - 1)
    given = [state[0][0], state[1][0] * duration, state[2][0] * duration**2, goal, 0.0 * goal, 0.0 * goal]
    return np.asarray(u @ np.linalg.solve(matrix, np.array(given)))


def _boundary_error(seed: int) -> float:
    """Errors of x, x' T and x'' T^2 at both ends, relative to the largest of the boundary values in these units."""
    generator = np.random.default_rng(seed)
    duration = 10.0 ** generator.uniform(-3.0, 3.0, 1000)
    values = generator.normal(size=(6, 1000))  # x0, V0, A0, xT, VT, AT in unit time
    scale = np.stack((np.ones_like(duration), 1.0 / duration, 1.0 / duration**2))
    given = values * np.concatenate((scale, scale))
    x0, dx0, ddx0, xT, dxT, ddxT = given
    coefficients = minimum_jerk_coefficients(x0, dx0, ddx0, xT, dxT, ddxT, duration)
    end = duration[:, None] ** np.arange(6)
    powers = np.arange(6)
    reached = [
        coefficients[:, 0],
        coefficients[:, 1],
        2.0 * coefficients[:, 2],
        (coefficients * end).sum(axis=-1),
        (coefficients * end * powers).sum(axis=-1) / duration,
        (coefficients * end * powers * (powers - 1)).sum(axis=-1) / duration**2,
    ]
    error = np.abs(np.stack(reached) - given) / np.concatenate((scale, scale))
    return float((error / np.abs(values).max(axis=0)).max())


def _replanned(times: int) -> float:
    """Greatest distance between one plan and the same one replanned again and again, [m]."""
    whole = straight("T1", "T4", 0.8)
    plan, begun, apart = whole, 0.0, 0.0
    for now in np.linspace(0.0, 0.75, times + 1)[1:]:
        plan, begun = retarget(plan, now - begun, target("T4"), 0.8 - begun), now
        ahead = np.linspace(now, 0.8, 11)
        apart = max(apart, float(np.abs(plan(ahead - now) - whole(ahead)).max()))
    return apart
