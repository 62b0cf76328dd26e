"""The same movements on the simulated arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.planar import ADULT, PlanarArm
from viapoint.envs.common.types import Float
from viapoint.envs.sim.executor import SETTLING
from viapoint.envs.sim.simulator import Simulator
from viapoint.primitives import Trajectory

TIMESTEP = 0.002
"""Of the physics, as the arm's model file sets it, [s]."""


class Performed(NamedTuple):
    """N movements at T instants, carried out by the arm in MuJoCo; after its end a movement settles."""

    time: Float
    """Shape (T,), [s]; every physics step from the start on."""
    duration: Float
    """Planned, shape (N,), [s]."""
    planned: Float
    """Hand position of the plan, shape (N, T, 2), [m]."""
    hand: Float
    """Shape (N, T, 2), [m]."""
    joints: Float
    """Shoulder and elbow angles, shape (N, T, 2), [rad]."""
    torque: Float
    """Of the actuators in the step that begins there, shape (N, T - 1, 2), [N m]."""

    @property
    def deviation(self) -> Float:
        """Greatest distance of the hand from the plan, shape (N,), [mm]."""
        return np.asarray(1e3 * np.linalg.norm(self.hand - self.planned, axis=-1).max(axis=-1))

    @property
    def worst(self) -> float:
        """The greatest of these distances, [mm]."""
        return float(self.deviation.max())

    def velocity(self) -> Float:
        """Of the hand, central differences, shape (N, T, 2), [m/s]."""
        return np.asarray(np.gradient(self.hand, self.time, axis=1))

    def acceleration(self) -> Float:
        """Of the hand, central differences, shape (N, T, 2), [m/s^2]."""
        return np.asarray(np.gradient(self.velocity(), self.time, axis=1))

    def peak_speed(self) -> Float:
        """Shape (N,), [m/s]."""
        return np.asarray(np.linalg.norm(self.velocity(), axis=-1).max(axis=-1))

    def at(self, row: int, fractions: Float) -> Float:
        """Hand position of one movement at fractions of its duration, shape (len(fractions), 2), [m]."""
        time = np.asarray(fractions) * self.duration[row]
        return np.stack([np.interp(time, self.time, self.hand[row, :, i]) for i in (0, 1)], axis=-1)


def perform(movement: Trajectory, arm: PlanarArm = ADULT) -> Performed:
    """Carry out planar movements, of batch shape () or (N,), each from rest at its start."""
    number = int(np.prod(movement.batch_shape)) if movement.batch_shape else 1
    duration = np.broadcast_to(np.asarray(movement.duration), (number,))
    time = instants(float(duration.max()))
    references = [part.reshape(number, len(time), 2) for part in movement.sample(time)]
    return follow(duration, *references, arm=arm)


def instants(duration: float) -> Float:
    """Physics steps of a movement and the time it takes to settle, from 0 on, [s]."""
    return np.asarray(TIMESTEP * np.arange(int(np.ceil((duration + SETTLING) / TIMESTEP)) + 1))


def follow(
    duration: Float, position: Float, velocity: Float, acceleration: Float, *, arm: PlanarArm = ADULT
) -> Performed:
    """Make the arm follow references, shape (N, T, 2) at every physics step, from rest at the first."""
    number, count = position.shape[:2]
    simulator = Simulator(CollisionModel(arm, whole_arm=False), n_obstacles=0, num_envs=number, threads=1)
    sims, start = np.arange(number), np.asarray(arm.inverse_kinematics(position[:, 0]))
    simulator.place(sims, start, np.zeros((number, 0, 5)), np.zeros((number, 0), dtype=bool))
    controls = arm.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1])
    ran = simulator.batch.rollout(count - 1, controls, record=("qpos", "qvel", "actuator_force"))
    joints = np.concatenate((start[:, None], ran["qpos"]), axis=1)
    time, torque = TIMESTEP * np.arange(count), _torque(arm, ran["qvel"], ran["actuator_force"])
    return Performed(
        np.asarray(time), duration, position, np.asarray(arm.hand_position(joints)), joints, torque
    )


def _torque(arm: PlanarArm, rates: Float, force: Float) -> Float:
    """The torque that moved the arm in each step.

    The integrator takes the servo's damping at the end of a step, the recorded force at its beginning. A force at
    its limit does not depend on the rates.
    """
    change = np.diff(rates, axis=1, prepend=0.0)
    return np.where(np.abs(force) < np.array(arm.torque_limit), force - np.array(arm.damping) * change, force)


def joint_velocity(arm: PlanarArm, joints: Float, hand_velocity: Float) -> Float:
    """Joint rates (..., 2), [rad/s], that give the hand a velocity (..., 2), [m/s]: the inverse Jacobian."""
    both = joints[..., 0] + joints[..., 1]
    hand, fore = np.asarray(arm.hand_position(joints)), arm.lengths[1]
    first = np.stack((-hand[..., 1], hand[..., 0]), axis=-1)
    second = fore * np.stack((-np.sin(both), np.cos(both)), axis=-1)
    jacobian = np.stack((first, second), axis=-1)
    return np.asarray(np.linalg.solve(jacobian, hand_velocity[..., None])[..., 0])


def required_torque(arm: PlanarArm, movement: Trajectory, count: int = 401) -> Float:
    """Shoulder and elbow torque (..., count, 2), [N m], that the plan takes: inverse dynamics with viscosity.

    It is what is left of the controls once the servo's part, stiffness x angle + damping x rate, is taken away.
    """
    position, velocity, acceleration = movement.sample(count)
    joints = np.asarray(arm.inverse_kinematics(position))
    rates = joint_velocity(arm, joints, velocity)
    servo = np.array(arm.stiffness) * joints + np.array(arm.damping) * rates
    return np.asarray(arm.controls(position, velocity, acceleration) - servo)
