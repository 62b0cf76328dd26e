"""Steering: actions of control steps, and the references that follow them.

The action is a velocity. A critically damped filter of the second order makes a smooth reference of it: position,
velocity and acceleration are continuous, so jerk is finite and its cost can be compared with that of planned movements.

    v'' = w^2 (u - v) - 2 w v'

With u held over a control step the solution is known, so one step of N references is a few multiplications.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from viapoint.envs.common.arrays import Float
from viapoint.envs.plans import Motion, SpaceName, turned

QUADRATURE = 12  # Gauss-Legendre nodes for the jerk cost of a control step


@dataclass(frozen=True, kw_only=True)
class Steering:
    """Layout of the actions of control steps, and the filter that turns them into references.

    An action is the wanted velocity as a fraction of `top_speed`: of the hand along and across the line from start to
    goal, or of the joints. The zero action brings the arm to rest.
    """

    space: SpaceName
    names: tuple[str, ...]  # Names of the components, in order
    top_speed: tuple[float, ...]  # Velocity that an action of 1 stands for, [m/s] or [rad/s]
    bandwidth: float  # Bandwidth w of the filter, [rad/s]
    physics_steps: int  # Physics steps S of a control step
    timestep: float  # Length of a physics step, [s]

    @property
    def greatest_acceleration(self) -> float:
        """Bound of the acceleration of a component, [m/s^2] or [rad/s^2].

        The filter's response to a short push never changes sign, so no component exceeds its top speed; that of its
        rate is up to w / e twice.
        """
        return float(2.0 * np.sqrt(2.0) * max(self.top_speed) * self.bandwidth / np.e)

    def decode(self, action: Float, start: Float, goal: Float) -> Float:
        """Return the velocity of an action, shape (N, D), [m/s] or [rad/s]."""
        wanted = action * np.array(self.top_speed)
        return turned(wanted, goal - start) if self.space == "hand" else wanted

    def follow(self, motion: Motion, wanted: Float, number: int) -> Motion:
        """Return references now and after each of T physics steps, shape (N, T + 1, D) each."""
        tables = self._tables(number)
        return Motion(*(_combined(table, motion, wanted) for table in tables))

    def jerk_cost(self, motion: Motion, wanted: Float) -> Float:
        """Return half the integral of the squared jerk over one control step, exact, shape (N,)."""
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        half = 0.5 * (self.physics_steps * self.timestep)
        time = half * (nodes + 1.0)
        w, decay = self.bandwidth, np.exp(-self.bandwidth * time)
        of_velocity = -(w**2) * (1.0 - w * time) * decay
        of_acceleration = (w * time - 2.0) * w * decay
        table = np.stack((0.0 * time, of_velocity, of_acceleration, -of_velocity), axis=-1)
        jerk = _combined(table, motion, wanted)
        each = (jerk * jerk).sum(axis=-1)
        cost = np.zeros(len(each))
        for k, weight in enumerate(half * weights):  # one after the other: the same bits in any batch
            cost += 0.5 * weight * each[:, k]
        return cost

    @functools.cache  # noqa: B019 - records of tasks live as long as the process
    def _tables(self, number: int) -> tuple[Float, Float, Float]:
        """Matrices from (p, v, a, u) at the beginning to position, velocity and acceleration, (T + 1, 4) each."""
        time = self.timestep * np.arange(number + 1)
        w, decay = self.bandwidth, np.exp(-self.bandwidth * time)
        one, zero = np.ones_like(time), np.zeros_like(time)
        fast = (1.0 - decay * (1.0 + w * time)) / w**2
        slow = (1.0 - decay) / w + w * fast
        position = (one, slow, fast, time - slow)
        velocity = (zero, (1.0 + w * time) * decay, time * decay, 1.0 - (1.0 + w * time) * decay)
        rate = (zero, -(w**2) * time * decay, (1.0 - w * time) * decay, w**2 * time * decay)
        return np.stack(position, axis=-1), np.stack(velocity, axis=-1), np.stack(rate, axis=-1)


def _combined(table: Float, motion: Motion, wanted: Float) -> Float:
    """Return the product of a matrix with position, velocity, acceleration and wanted velocity, (N, rows, D)."""
    total = table[:, 0, None] * motion.position[:, None]
    for k, part in enumerate((motion.velocity, motion.acceleration, wanted)):
        total = total + table[:, k + 1, None] * part[:, None]
    return np.asarray(total)
