"""Simulation of planar movements on the arm of an adult."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.planar import ADULT
from viapoint.envs.common.types import Float
from viapoint.envs.sim.outcome import SETTLING
from viapoint.envs.sim.simulator import Simulator
from viapoint.primitives import Trajectory

TIMESTEP = 0.002
"""Time step of the physics in the arm's model file, [s]."""


class SimulatedMovements(NamedTuple):
    """Simulated movements at T instants; after its end a movement settles."""

    time: Float
    """Shape (T,), [s]; every physics step from the start on."""
    duration: Float
    """Planned durations, shape (N,), [s]."""
    planned: Float
    """Hand position of the plan, shape (N, T, 2), [m]."""
    hand: Float
    """Shape (N, T, 2), [m]."""
    joints: Float
    """Shoulder and elbow angles, shape (N, T, 2), [rad]."""
    torque: Float
    """Torque of the actuators in the step that begins at each instant, shape (N, T - 1, 2), [N m]."""

    @property
    def deviation(self) -> Float:
        """Greatest distance of the hand from the plan, shape (N,), [mm]."""
        return np.asarray(1e3 * np.linalg.norm(self.hand - self.planned, axis=-1).max(axis=-1))

    @property
    def worst(self) -> float:
        """Greatest deviation of all movements, [mm]."""
        return float(self.deviation.max())

    def velocity(self) -> Float:
        """Return the velocity of the hand by central differences, shape (N, T, 2), [m/s]."""
        return np.asarray(np.gradient(self.hand, self.time, axis=1))

    def acceleration(self) -> Float:
        """Return the acceleration of the hand by central differences, shape (N, T, 2), [m/s^2]."""
        return np.asarray(np.gradient(self.velocity(), self.time, axis=1))

    def peak_speed(self) -> Float:
        """Return the greatest speed of each movement, shape (N,), [m/s]."""
        return np.asarray(np.linalg.norm(self.velocity(), axis=-1).max(axis=-1))

    def at(self, row: int, fractions: Float) -> Float:
        """Return the hand position of one movement at fractions of its duration, shape (len(fractions), 2), [m]."""
        time = np.asarray(fractions) * self.duration[row]
        return np.stack([np.interp(time, self.time, self.hand[row, :, i]) for i in (0, 1)], axis=-1)


def simulate(movement: Trajectory) -> SimulatedMovements:
    """Simulate planar movements of batch shape () or (N,), each from rest at its start."""
    number = int(np.prod(movement.batch_shape)) if movement.batch_shape else 1
    duration = np.broadcast_to(np.asarray(movement.duration), (number,))
    time = instants(float(duration.max()))
    references = [part.reshape(number, len(time), 2) for part in movement.sample(time)]
    return track(duration, *references)


def instants(duration: float) -> Float:
    """Return the instants of the physics steps of a movement and of its settling, from 0 on, [s]."""
    return np.asarray(TIMESTEP * np.arange(int(np.ceil((duration + SETTLING) / TIMESTEP)) + 1))


def track(duration: Float, position: Float, velocity: Float, acceleration: Float) -> SimulatedMovements:
    """Make the arm follow references, shape (N, T, 2) at every physics step, from rest at the first."""
    number, count = position.shape[:2]
    simulator = Simulator(CollisionModel(ADULT, whole_arm=False), n_obstacles=0, num_envs=number, threads=1)
    sims, start = np.arange(number), np.asarray(ADULT.inverse_kinematics(position[:, 0]))
    simulator.place(sims, start, np.zeros((number, 0, 5)), np.zeros((number, 0), dtype=bool))
    controls = ADULT.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1])
    ran = simulator.batch.rollout(count - 1, controls, record=("qpos", "qvel", "actuator_force"))
    joints = np.concatenate((start[:, None], ran["qpos"]), axis=1)
    time, torque = TIMESTEP * np.arange(count), _torque(ran["qvel"], ran["actuator_force"])
    return SimulatedMovements(
        np.asarray(time), duration, position, np.asarray(ADULT.hand_position(joints)), joints, torque
    )


def _torque(rates: Float, force: Float) -> Float:
    """Return the torque that moved the arm in each step.

    The integrator applies the servo's damping at the end of a step; the recorded force is that at its beginning. A
    force at its limit does not depend on the rates.
    """
    change = np.diff(rates, axis=1, prepend=0.0)
    return np.where(
        np.abs(force) < np.array(ADULT.torque_limit), force - np.array(ADULT.damping) * change, force
    )


def joint_velocity(joints: Float, hand_velocity: Float) -> Float:
    """Return joint rates (..., 2), [rad/s], from hand velocities (..., 2), [m/s], by the inverse Jacobian."""
    both = joints[..., 0] + joints[..., 1]
    hand, fore = np.asarray(ADULT.hand_position(joints)), ADULT.lengths[1]
    first = np.stack((-hand[..., 1], hand[..., 0]), axis=-1)
    second = fore * np.stack((-np.sin(both), np.cos(both)), axis=-1)
    jacobian = np.stack((first, second), axis=-1)
    return np.asarray(np.linalg.solve(jacobian, hand_velocity[..., None])[..., 0])


def required_torque(movement: Trajectory, count: int = 401) -> Float:
    """Return the torque of shoulder and elbow that a plan requires, shape (..., count, 2), [N m].

    The inverse dynamics with viscosity are the arm's controls less those of its servo:

        torque = controls - stiffness angle - damping rate
    """
    position, velocity, acceleration = movement.sample(count)
    joints = np.asarray(ADULT.inverse_kinematics(position))
    rates = joint_velocity(joints, velocity)
    servo = np.array(ADULT.stiffness) * joints + np.array(ADULT.damping) * rates
    return np.asarray(ADULT.controls(position, velocity, acceleration) - servo)
