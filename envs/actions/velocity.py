"""Steering: decoding of the action of a control step into the reference that the hand follows.

The action is a velocity. A critically damped filter of the second order makes a smooth reference of it: position,
velocity and acceleration are continuous, so jerk is finite and its cost can be compared with that of planned movements.

    v'' = w^2 (u - v) - 2 w v'

With u held over a control step the solution is known, so one step of N references is a few multiplications.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.actions.via_points import AXES, Motion, frame
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import is_number

STEP_TOLERANCE = 1e-6
"""Relative rounding error of numbers of single precision."""


@dataclass(frozen=True, kw_only=True)
class Steering:
    """Layout of the actions of control steps, and the filter that turns them into references.

    An action is the velocity wanted of the hand, in the frame of start and goal, as a fraction of `top_speed`. The zero
    action brings the hand to rest.
    """

    dimension: int = 2
    """Spatial dimension D."""
    control_step: float = 0.04
    """Time for which an action holds, [s]."""
    timestep: float = 0.002
    """Length of a physics step, [s]."""
    top_speed: float = 1.5
    """Velocity that an action of 1 stands for, [m/s]."""
    bandwidth: float = 25.0
    """Bandwidth w of the filter, [rad/s]: 90 % of a new velocity is reached after 0.16 s."""

    def __post_init__(self) -> None:
        """Check that the control step is a multiple of the physics step."""
        given: Any = self.control_step
        value = float(given) if is_number(given) else 0.0
        steps = value / self.timestep
        if not (
            1.0 - STEP_TOLERANCE <= steps <= 500.0 * (1.0 + STEP_TOLERANCE)
            and abs(steps - round(steps)) < STEP_TOLERANCE * steps
        ):
            raise ValueError(
                f"control_step must be 1 to 500 physics steps of {self.timestep} s, got {given!r}"
            )
        exact = round(steps) * self.timestep
        # A number of single precision stands for the multiple that it is nearest to.
        object.__setattr__(self, "control_step", value if abs(value - exact) < 1e-12 else exact)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components, in order."""
        return AXES[: self.dimension]

    @property
    def units(self) -> tuple[str, ...]:
        """Value of an action of 1 in each component."""
        return (f"{self.top_speed:g} m/s",) * self.dimension

    @property
    def physics_steps(self) -> int:
        """Physics steps S of a control step."""
        return round(self.control_step / self.timestep)

    @property
    def greatest(self) -> tuple[float, float]:
        """Bounds of the reference's speed [m/s] and acceleration [m/s^2] along any axis of the world.

        The filter's response to a short push never changes sign, so no component exceeds `top_speed`; that of its
        rate is up to w / e twice.
        """
        speed = self.top_speed * float(np.sqrt(self.dimension))
        return speed, 2.0 * speed * self.bandwidth / float(np.e)

    def decode(self, action: Float, start: Float, goal: Float) -> Float:
        """Return the velocity of an action, shape (N, D), [m/s]."""
        axes = frame(goal - start)
        return np.asarray(
            self.top_speed * sum(action[..., i : i + 1] * axis for i, axis in enumerate(axes)), dtype=float
        )

    def encode(self, velocity: Float, start: Float, goal: Float) -> Float:
        """Return the action of a velocity, the inverse of :meth:`decode`."""
        axes = frame(goal - start)
        return np.stack([(velocity * axis).sum(axis=-1) for axis in axes], axis=-1) / self.top_speed

    def follow(self, motion: Motion, wanted: Float) -> Motion:
        """Return references at the beginning of a control step and after each physics step, (N, S + 1, D) each."""
        return Motion(*(_combined(table, motion, wanted) for table in self._tables))

    def jerk_cost(self, motion: Motion, wanted: Float) -> Float:
        """Return half the integral of the squared jerk over one control step, exact, shape (N,), [m^2/s^5]."""
        jerk = _combined(self._jerk_table, motion, wanted)
        each = (jerk * jerk).sum(axis=-1)
        cost = np.zeros(len(each))
        for k, weight in enumerate(self._quadrature[1]):  # one after the other: the same bits in any batch
            cost += 0.5 * weight * each[:, k]
        return cost

    @functools.cached_property
    def _quadrature(self) -> tuple[Float, Float]:
        nodes, weights = np.polynomial.legendre.leggauss(12)
        half = 0.5 * self.control_step
        return half * (nodes + 1.0), half * weights

    @functools.cached_property
    def _tables(self) -> tuple[Float, Float, Float]:
        """Matrices from (p, v, a, u) at the beginning to position, velocity and acceleration, shape (S + 1, 4) each."""
        time = self.timestep * np.arange(self.physics_steps + 1)
        w, decay = self.bandwidth, np.exp(-self.bandwidth * time)
        one, zero = np.ones_like(time), np.zeros_like(time)
        slow, fast = (1.0 - decay) / w, (1.0 - decay * (1.0 + w * time)) / w**2
        of_velocity, of_rate = slow + w * fast, fast
        position = (one, of_velocity, of_rate, time - of_velocity)
        velocity = (zero, (1.0 + w * time) * decay, time * decay, 1.0 - (1.0 + w * time) * decay)
        rate = (zero, -(w**2) * time * decay, (1.0 - w * time) * decay, w**2 * time * decay)
        return tuple(np.stack(columns, axis=-1) for columns in (position, velocity, rate))  # type: ignore[return-value]

    @functools.cached_property
    def _jerk_table(self) -> Float:
        """Matrix from (p, v, a, u) at the beginning to the jerk at the quadrature nodes, shape (12, 4)."""
        time, w = self._quadrature[0], self.bandwidth
        decay = np.exp(-w * time)
        of_velocity = -(w**2) * (1.0 - w * time) * decay
        return np.stack((0.0 * time, of_velocity, (w * time - 2.0) * w * decay, -of_velocity), axis=-1)


def _combined(table: Float, motion: Motion, wanted: Float) -> Float:
    """Return the product of a matrix with position, velocity, acceleration and decoded velocity, (N, rows, D)."""
    parts = (*motion, wanted)
    return np.asarray(sum(table[:, k, None] * part[:, None] for k, part in enumerate(parts)))
