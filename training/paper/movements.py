"""Movements of the paper between its targets, their profiles, and their simulation on the arm of an adult."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike
from scipy.signal import find_peaks

from viapoint.envs import Box, Task
from viapoint.envs.arms.kinematics import torques
from viapoint.envs.common.arrays import Float
from viapoint.envs.plans import Motion
from viapoint.primitives import Trajectory, passage_durations, point_to_point, through

TARGETS = {
    "T1": np.array([-0.32, 0.42]),
    "T2": np.array([-0.22, 0.27]),
    "T3": np.array([-0.02, 0.27]),
    "T4": np.array([0.08, 0.42]),
    "T5": np.array([-0.02, 0.57]),
    "T6": np.array([-0.22, 0.57]),
}
"""The six targets of Flash & Hogan 1985, Fig. 2, [m], shoulder at the origin.

The figure gives no coordinates. Its movements T1-T4, T2-T5 and T3-T6 (Figs. 1, 3 and 4) are the three diagonals of a
hexagon here, 40, 36 and 36 cm long, in front of the right shoulder and within the reach of the arm.
"""
ADULT = Task.of().arm  # Arm of an adult
PLANE = Task.of().space  # Plane of its hand


def straight(first: str, last: str, duration: float, *, order: int = 3) -> Trajectory:
    """Return the straight movement between two targets (Eq. 2); order 2, 3, 4 minimises acceleration, jerk, snap."""
    return point_to_point(TARGETS[first], TARGETS[last], duration, order=order)


def left_of(line: Float) -> Float:
    """Return a vector of the plane, shape (2,), turned to the left by a right angle."""
    return np.array([-line[1], line[0]])


def via_waypoints(start: Any, goal: Any, along: ArrayLike, height: ArrayLike) -> Float:
    """Return start, via-point and goal by the construction of Fig. 1B, shape (..., 3, 2), [m].

    The perpendicular through the via-point meets the line at `along` = d1 / (d1 + d2), shape (...,); `height` is
    d3 / (d1 + d2), positive to the left of the movement.
    """
    line = np.subtract(goal, start)
    along, height = np.broadcast_arrays(along, height)
    via = np.asarray(start) + along[..., None] * line + height[..., None] * left_of(line)
    return np.stack(np.broadcast_arrays(start, via, goal), axis=-2)


def construction(waypoints: Float) -> tuple[Float, Float]:
    """Return d1 / (d1 + d2) and unsigned d3 / (d1 + d2) of waypoints (..., 3, 2), the inverse of `via_waypoints`."""
    line = waypoints[..., 2, :] - waypoints[..., 0, :]
    offset = waypoints[..., 1, :] - waypoints[..., 0, :]
    square = (line * line).sum(axis=-1)
    turn = line[..., 0] * offset[..., 1] - line[..., 1] * offset[..., 0]
    return (line * offset).sum(axis=-1) / square, np.abs(turn) / square


def minimum_jerk_through(waypoints: ArrayLike, duration: Any = 1.0) -> Trajectory:
    """Return the movement through (..., K + 2, 2) waypoints [m] with free passage times (Eqs. 4, 5 and C16)."""
    return through(waypoints, passage_durations(waypoints, duration))


def curved(first: str, last: str, along: ArrayLike, height: ArrayLike, duration: Any = 1.0) -> Trajectory:
    """Return the movement between two targets through a via-point, see :func:`via_waypoints`."""
    return minimum_jerk_through(via_waypoints(TARGETS[first], TARGETS[last], along, height), duration)


def passage_share(movement: Trajectory) -> Float:
    """Return t1 / (t1 + t2) of movements through one via-point, shape (...,)."""
    return np.asarray(movement.knots[..., 1] / movement.knots[..., 2])


LEAST_APART = 0.3  # Least distance of the targets of a movement, [m]


def rows_of_lights(
    length: float = 0.25, radius: float = 0.008, shift: Any = (0.0, 0.0), half_height: float = 0.04
) -> list[tuple[str, str, Box]]:
    """Return the obstacle paradigm of Flash & Hogan 1985: pairs of targets far apart, and a row of lights between.

    `radius` is half the width of the row, and `shift` the offset of its middle along and across the line, [m].
    """
    found = []
    for (first, start), (last, goal) in itertools.permutations(TARGETS.items(), 2):
        line = goal - start
        distance = np.hypot(*line)
        if distance < LEAST_APART:
            continue
        along = line / distance
        middle = 0.5 * (start + goal) + (shift[0] * along + shift[1] * left_of(along))
        half = 0.5 * (np.arctan2(line[1], line[0]) + 0.5 * np.pi)
        turn = (np.cos(half), 0.0, 0.0, np.sin(half))
        lights = Box((0.5 * length, radius, half_height), position=(*middle, 0.0), quaternion=turn)
        found.append((first, last, lights))
    return found


SETTLING = 0.1  # Time after the end of a movement that is simulated, too, [s]


class SimulatedMovements(NamedTuple):
    """Simulated movements at T instants; after its end a movement settles."""

    time: Float  # Shape (T,), [s]; every physics step from the start on
    duration: Float  # Planned durations, shape (N,), [s]
    planned: Float  # Hand position of the plan, shape (N, T, 2), [m]
    hand: Float  # Shape (N, T, 2), [m]
    joints: Float  # Shoulder and elbow angles, shape (N, T, 2), [rad]
    torque: Float  # Torque of the step after each instant, shape (N, T - 1, 2), [N m]

    @property
    def deviation(self) -> Float:
        """Greatest distance of the hand from the plan, shape (N,), [mm]."""
        return np.asarray(1e3 * np.linalg.norm(self.hand - self.planned, axis=-1).max(axis=-1))

    @property
    def worst(self) -> float:
        """Greatest deviation of all movements, [mm]."""
        return float(self.deviation.max())

    def derivative(self, values: Float) -> Float:
        """Return the derivative of values, shape (N, T, ...), with respect to time by central differences."""
        return np.asarray(np.gradient(values, self.time, axis=1))

    def speed(self) -> Float:
        """Return the speed of the hand, shape (N, T), [m/s]."""
        return np.asarray(np.linalg.norm(self.derivative(self.hand), axis=-1))

    def at(self, fractions: Float) -> Float:
        """Return the hand positions at F fractions of the durations, shape (N, F, 2), [m]."""
        rows = zip(self.duration, self.hand, strict=True)
        return np.stack([along_path(fractions * duration, self.time, hand) for duration, hand in rows])


def along_path(time: Any, times: Float, positions: Float) -> Float:
    """Return positions, shape (T, 2) at increasing times, interpolated at some times, shape (..., 2)."""
    return np.stack([np.interp(time, times, axis) for axis in positions.T], axis=-1)


def simulate(movement: Trajectory) -> SimulatedMovements:
    """Simulate planar movements of batch shape () or (N,), each from rest at its start."""
    duration = np.atleast_1d(movement.duration)
    time = instants(float(duration.max()))
    parts = [part.reshape(len(duration), len(time), 2) for part in movement.sample(time)]
    return track(time, duration, Motion(*parts))


def instants(duration: float) -> Float:
    """Return the instants of the physics steps of a movement and of its settling, from 0 on, [s]."""
    return np.asarray(ADULT.timestep * np.arange(int(np.ceil((duration + SETTLING) / ADULT.timestep)) + 1))


def track(time: Float, duration: Float, hand: Motion) -> SimulatedMovements:
    """Make the arm follow references, shape (N, T, 2) at every physics step, from rest at the first."""
    planned = PLANE.joint_motion(hand)
    start = planned.position[:, 0]
    batch = Batch(ADULT.compile(n_obstacles=0), len(start), 1)
    batch.bind("qpos")[:] = start
    controls = ADULT.controls(*planned)[:, :-1]
    ran = batch.rollout(len(time) - 1, controls, record=("qpos", "qvel", "actuator_force"))
    joints = np.concatenate((start[:, None], ran["qpos"]), axis=1)
    # The integrator applies the servo's damping at the end of a step; the recorded force is that at its beginning.
    # A force at its limit does not depend on the rates.
    force = ran["actuator_force"]
    damped = force - ADULT.damping * np.diff(ran["qvel"], axis=1, prepend=0.0)
    torque = np.where(np.abs(force) < ADULT.torque_limit, damped, force)
    return SimulatedMovements(time, duration, hand.position, PLANE.coordinates(joints), joints, torque)


def joint_motion(movement: Trajectory) -> Motion:
    """Return angles, rates and accelerations of shoulder and elbow in a plan, shape (..., 401, 2)."""
    return PLANE.joint_motion(Motion(*movement.sample(401)))


def required_torque(movement: Trajectory) -> Float:
    """Return the torque of shoulder and elbow that a plan requires, with viscosity, shape (..., 401, 2), [N m]."""
    return torques(ADULT.chain, *joint_motion(movement))


EDGE = 0.08
"""Fraction of the duration left out at both ends, where the curvature of a movement from rest has no bound.

It grows as t^-2, so the curvature peak is the greatest local maximum inside.
"""
SAMPLES = 2001


class Profile(NamedTuple):
    """States of the hand in one movement at T instants."""

    time: Float  # Instants as fractions of the duration, shape (T,)
    position: Float  # Shape (T, 2), [m]
    velocity: Float  # Shape (T, 2), [m/s]
    acceleration: Float  # Shape (T, 2), [m/s^2]

    @property
    def speed(self) -> Float:
        """Speed, shape (T,), [m/s]."""
        return np.asarray(np.linalg.norm(self.velocity, axis=-1))

    @property
    def curvature(self) -> Float:
        """Unsigned curvature |x' y'' - y' x''| / |v|^3, shape (T,), [1/m]; NaN near the ends, where it has no bound."""
        turn = np.abs(np.linalg.det(np.stack((self.velocity, self.acceleration), axis=-2)))
        return np.where(self.inner, turn / np.maximum(self.speed, 1e-9) ** 3, np.nan)

    @property
    def inner(self) -> Any:
        """True for instants away from both ends, shape (T,)."""
        return (self.time > EDGE) & (self.time < 1.0 - EDGE)

    def local_maxima(self, values: Float) -> Float:
        """Return time and height of local maxima away from the ends, the highest first, shape (n, 2)."""
        index, _ = find_peaks(values)
        index = index[self.inner[index]]
        shift, height = vertex(values[index - 1], values[index], values[index + 1])
        found = np.stack((self.time[index] + shift * self.time[1], height), axis=-1)
        return found[np.argsort(-height, kind="stable")]

    @property
    def valley(self) -> tuple[float, float]:
        """Time of the least speed between two peaks, and that speed / the mean of the highest peaks; else NaN and 1."""
        valleys = self.local_maxima(-self.speed)
        peaks = self.local_maxima(self.speed)
        if not len(valleys):
            return np.nan, 1.0
        depth = -valleys[0, 1] / peaks[:2, 1].mean() if len(peaks) > 1 else 1.0
        return float(valleys[0, 0]), float(depth)

    @property
    def bend(self) -> tuple[float, float]:
        """Time and height [1/m] of the greatest local maximum of the curvature; NaN without one."""
        bends = self.local_maxima(self.curvature)
        return tuple(bends[0].tolist()) if len(bends) else (np.nan, np.nan)

    def place(self, time: float) -> Float:
        """Return the hand position at a fraction of the duration, shape (2,), [m]."""
        return along_path(time, self.time, self.position)


def model_profiles(movement: Trajectory) -> list[Profile]:
    """Return the profiles of movements of the model, of batch shape () or (N,)."""
    time = np.linspace(0.0, 1.0, SAMPLES)
    parts = [part.reshape(-1, SAMPLES, 2) for part in movement.sample(SAMPLES)]
    return [Profile(time, *row) for row in zip(*parts, strict=True)]


def arm_profiles(motion: SimulatedMovements) -> list[Profile]:
    """Return the profiles of movements of the simulated arm."""
    velocity = motion.derivative(motion.hand)
    states = zip(motion.duration, motion.hand, velocity, motion.derivative(velocity), strict=True)
    profiles = []
    for duration, *state in states:
        within = motion.time <= duration + 1e-9
        profiles.append(Profile(motion.time[within] / duration, *(part[within] for part in state)))
    return profiles


def vertex(before: Any, here: Any, after: Any) -> tuple[Any, Any]:
    """Return the vertex of the parabola through three equidistant samples: offset from the middle one, and height."""
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return shift, here - 0.25 * (before - after) * shift
