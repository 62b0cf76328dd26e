"""Velocity and torque limits of movements of the joints."""

from __future__ import annotations

import numpy as np

from viapoint.envs.arms.chain import Chain
from viapoint.envs.arms.kinematics import inverse_dynamics
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.compiled import compiled

LIMIT_SHARE = 0.97
"""Share of the velocity and torque limits that plans may use; feedback uses the rest."""
LEAST_TORQUE_SHARE = 0.01
"""Least share of a joint's torque limit that counts as available for motion, however heavy the arm is."""
TORQUE_STRIDE = 2
"""Torques are looked at in every second configuration: they change slowly."""


@compiled
def slowdown(
    chain: Chain,
    velocity_limit: Float,
    torque_limit: Float,
    position: Float,
    velocity: Float,
    acceleration: Float,
) -> float:
    """Return the factor by which a movement must be slower to keep the limits; less than 1 if it may be faster.

    If all durations are multiplied by s, velocities become 1/s of what they were, and the torque of the motion becomes
    a sum of a term with 1/s^2 and one with 1/s, the viscous friction. Gravity stays. So joint j needs

        |v| / s <= share limit_v,    |m| / s^2 + |f| / s <= share limit_t - g,

    with the torques m of inertia, f of friction, and g of gravity in the direction of the motion's torque.

    Args:
        chain: Chain of the arm.
        velocity_limit: Velocity limits, shape (J,), [rad/s]; infinite for none.
        torque_limit: Torque limits, shape (J,), [N m]; infinite for none.
        position: Joint positions at T instants, shape (T, J), [rad].
        velocity: Joint rates, shape (T, J), [rad/s].
        acceleration: Joint accelerations, shape (T, J), [rad/s^2].
    """
    joints = position.shape[1]
    least = 0.0
    rest = np.zeros(joints)
    heavy = np.empty(joints)
    whole = np.empty(joints)
    for k in range(len(position)):
        for j in range(joints):
            least = max(least, abs(velocity[k, j]) / (LIMIT_SHARE * velocity_limit[j]))
        if k % TORQUE_STRIDE:
            continue
        inverse_dynamics(chain, position[k], rest, rest, heavy)
        inverse_dynamics(chain, position[k], velocity[k], acceleration[k], whole)
        for j in range(joints):
            friction = chain.damping[j] * velocity[k, j]
            motion = whole[j] - heavy[j] - friction
            against = heavy[j] if motion + friction >= 0.0 else -heavy[j]
            room = max(LIMIT_SHARE * torque_limit[j] - against, LEAST_TORQUE_SHARE * torque_limit[j])
            if room > 1e9:
                continue
            friction = abs(friction)
            # The positive root of room s^2 - |f| s - |m| = 0.
            root = np.sqrt(friction * friction + 4.0 * room * abs(motion))
            least = max(least, (friction + root) / (2.0 * room))
    return least


@compiled
def slowdowns(
    chain: Chain,
    velocity_limit: Float,
    torque_limit: Float,
    position: Float,
    velocity: Float,
    acceleration: Float,
) -> Float:
    """Return :func:`slowdown` of N movements, with arrays of shape (N, T, J)."""
    found = np.empty(len(position))
    for row in range(len(position)):
        found[row] = slowdown(
            chain, velocity_limit, torque_limit, position[row], velocity[row], acceleration[row]
        )
    return found
