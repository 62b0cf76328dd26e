"""Movements of the paper between its targets, their profiles, and their simulation on the arm of an adult."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from viapoint.envs import Box, arm_of
from viapoint.envs.arms.kinematics import torques
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import no_obstacles
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import Motion
from viapoint.envs.simulator import Simulator
from viapoint.envs.spaces import HandPlane
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
ADULT = arm_of("planar")
"""Arm of an adult."""
PLANE = HandPlane(ADULT)
"""Plane of its hand."""


def straight(first: str, last: str, duration: float = 0.8, *, order: int = 3) -> Trajectory:
    """Return the straight movement between two targets (Eq. 2); order 2, 3, 4 minimises acceleration, jerk, snap."""
    return point_to_point(TARGETS[first], TARGETS[last], duration, order=order)


def left_of(line: Float) -> Float:
    """Return a vector of the plane, shape (2,), turned to the left by a right angle."""
    return np.array([-line[1], line[0]])


def via_waypoints(start: Any, goal: Any, along: ArrayLike, height: ArrayLike) -> Float:
    """Return start, via-point and goal by the construction of Fig. 1B.

    Args:
        start: Shape (2,), [m].
        goal: Shape (2,), [m].
        along: d1 / (d1 + d2), shape (...,): where the perpendicular through the via-point meets the line.
        height: d3 / (d1 + d2), shape (...,); positive is to the left of the movement.

    Returns:
        Shape (..., 3, 2), [m].
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


LEAST_APART = 0.3
"""Least distance of the targets of a movement, [m]."""


class RowOfLights(NamedTuple):
    """Movement between two targets, and the row of lights across its middle."""

    first: str
    last: str
    """Names of the targets."""
    start: Float
    """Shape (2,), [m]."""
    goal: Float
    """Shape (2,), [m]."""
    lights: Box


def rows_of_lights(
    length: float = 0.25, radius: float = 0.008, half_height: float = 0.04
) -> list[RowOfLights]:
    """Return the obstacle paradigm of Flash & Hogan 1985, one for each two targets that are far apart.

    Args:
        length: Length of the row, [m]; the paper's rows were up to 25 cm long.
        radius: Half width of the row, [m].
        half_height: Half height of the obstacle that stands for it, [m].

    Example:
        >>> from viapoint.training.paper.movements import rows_of_lights
        >>> rows = rows_of_lights()
        >>> len(rows), rows[0].first, rows[0].last
        (14, 'T1', 'T3')
    """
    found = []
    for first, start in TARGETS.items():
        for last, goal in TARGETS.items():
            line = goal - start
            if np.hypot(*line) < LEAST_APART:
                continue
            across = 0.5 * (np.arctan2(line[1], line[0]) + 0.5 * np.pi)
            lights = Box(
                size=(0.5 * length, radius, half_height),
                position=(*(0.5 * (start + goal)), 0.0),
                quaternion=(np.cos(across), 0.0, 0.0, np.sin(across)),
            )
            found.append(RowOfLights(first, last, start.copy(), goal.copy(), lights))
    return found


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

    def joint_rates(self) -> Float:
        """Return the velocities of the joints by central differences, shape (N, T, 2), [rad/s]."""
        return np.asarray(np.gradient(self.joints, self.time, axis=1))

    def peak_speed(self) -> Float:
        """Return the greatest speed of each movement, shape (N,), [m/s]."""
        return np.asarray(np.linalg.norm(self.velocity(), axis=-1).max(axis=-1))

    def at(self, row: int, fractions: Float) -> Float:
        """Return the hand position of one movement at fractions of its duration, shape (len(fractions), 2), [m]."""
        time = np.asarray(fractions) * self.duration[row]
        return np.stack([np.interp(time, self.time, self.hand[row, :, i]) for i in (0, 1)], axis=-1)


def simulate(movement: Trajectory) -> SimulatedMovements:
    """Simulate planar movements of batch shape () or (N,), each from rest at its start."""
    duration = np.atleast_1d(movement.duration)
    time = instants(float(duration.max()))
    references = [part.reshape(len(duration), len(time), 2) for part in movement.sample(time)]
    return track(duration, *references)


def instants(duration: float) -> Float:
    """Return the instants of the physics steps of a movement and of its settling, from 0 on, [s]."""
    return np.asarray(TIMESTEP * np.arange(int(np.ceil((duration + SETTLING) / TIMESTEP)) + 1))


def track(duration: Float, position: Float, velocity: Float, acceleration: Float) -> SimulatedMovements:
    """Make the arm follow references, shape (N, T, 2) at every physics step, from rest at the first."""
    number, count = position.shape[:2]
    simulator = Simulator(ADULT, n_obstacles=0, num_envs=number)
    planned = PLANE.joint_motion(Motion(position, velocity, acceleration))
    start = planned.position[:, 0]
    simulator.place(np.arange(number), start, no_obstacles(number))
    controls = ADULT.controls(*planned)[:, :-1]
    ran = simulator.batch.rollout(count - 1, controls, record=("qpos", "qvel", "actuator_force"))
    joints = np.concatenate((start[:, None], ran["qpos"]), axis=1)
    # The integrator applies the servo's damping at the end of a step; the recorded force is that at its beginning.
    # A force at its limit does not depend on the rates.
    force = ran["actuator_force"]
    damped = force - ADULT.damping * np.diff(ran["qvel"], axis=1, prepend=0.0)
    torque = np.where(np.abs(force) < ADULT.torque_limit, damped, force)
    time = np.asarray(TIMESTEP * np.arange(count))
    return SimulatedMovements(time, duration, position, PLANE.coordinates(joints), joints, torque)


def joint_motion(movement: Trajectory, count: int = 401) -> Motion:
    """Return angles, rates and accelerations of shoulder and elbow in a plan, shape (..., count, 2)."""
    return PLANE.joint_motion(Motion(*movement.sample(count)))


def required_torque(movement: Trajectory) -> Float:
    """Return the torque of shoulder and elbow that a plan requires, with viscosity, shape (..., 401, 2), [N m]."""
    return torques(ADULT.chain, *joint_motion(movement))


EDGE = 0.08
"""Fraction of the duration left out at both ends, where the curvature of a movement from rest has no bound.

It grows as t^-2, so the curvature peak is the greatest local maximum inside.
"""
SAMPLES = 2001


class Profile(NamedTuple):
    """Speed and curvature of one movement at T instants."""

    time: Float
    """Instants as fractions of the duration, shape (T,)."""
    speed: Float
    """[m/s]"""
    curvature: Float
    """Unsigned, [1/m]."""
    position: Float
    """Shape (T, 2), [m]."""

    @classmethod
    def of(cls, time: Float, position: Float, velocity: Float, acceleration: Float) -> Profile:
        """Return the profile of hand position, velocity and acceleration, shape (T, 2), at fractions of the duration.

        kappa = |x' y'' - y' x''| / |v|^3
        """
        speed = np.linalg.norm(velocity, axis=-1)
        turn = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
        safe = np.maximum(speed, 1e-9)
        return cls(time, speed, np.abs(turn) / (safe * safe * safe), position)

    @property
    def valley(self) -> float:
        """Time of the least speed between two peaks, as a fraction of the duration; NaN without a valley."""
        places = _peaks(self.time, -self.speed)
        return places[0][0] if places else np.nan

    @property
    def valley_depth(self) -> float:
        """Speed in the valley relative to the mean of the two highest peaks; 1 without a valley."""
        valleys, peaks = _peaks(self.time, -self.speed), self.peaks
        return -valleys[0][1] / float(np.mean(peaks[:2, 1])) if valleys and len(peaks) > 1 else 1.0

    @property
    def peaks(self) -> Float:
        """Time and height of the local maxima of the speed, the highest first, shape (n, 2)."""
        return np.array(_peaks(self.time, self.speed)).reshape(-1, 2)

    @property
    def bend(self) -> tuple[float, float]:
        """Time and height [1/m] of the greatest local maximum of the curvature; NaN without one."""
        places = _peaks(self.time, self.curvature)
        return places[0] if places else (np.nan, np.nan)

    def place(self, time: float) -> Float:
        """Return the hand position at a fraction of the duration, shape (2,), [m]."""
        return np.array([np.interp(time, self.time, self.position[:, i]) for i in (0, 1)])


def model_profiles(movement: Trajectory) -> list[Profile]:
    """Return the profiles of movements of the model, of batch shape () or (N,)."""
    time = np.linspace(0.0, 1.0, SAMPLES)
    parts = [part.reshape(-1, SAMPLES, 2) for part in movement.sample(SAMPLES)]
    return [Profile.of(time, *row) for row in zip(*parts, strict=True)]


def arm_profiles(motion: SimulatedMovements) -> list[Profile]:
    """Return the profiles of movements of the simulated arm."""
    profiles = []
    for duration, *row in zip(
        motion.duration, motion.hand, motion.velocity(), motion.acceleration(), strict=True
    ):
        within = motion.time <= duration + 1e-9
        profiles.append(Profile.of(motion.time[within] / duration, *(part[within] for part in row)))
    return profiles


def first_place(holds: Callable[[Any], bool], low: Any, high: Any, halvings: int) -> Any:
    """Return where in an interval a condition begins to hold, by bisection; it holds at `high`, not at `low`."""
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return (low + high) / 2


def vertex(before: float, here: float, after: float) -> tuple[float, float]:
    """Return the vertex of the parabola through three equidistant samples: offset from the middle one, and height."""
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return shift, here - 0.25 * (before - after) * shift


def _peaks(time: Float, value: Float) -> list[tuple[float, float]]:
    """Return time and height of local maxima away from the ends, the highest first, by parabolas through samples."""
    inner = (time > EDGE) & (time < 1.0 - EDGE)
    index = np.flatnonzero(inner[1:-1] & (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])) + 1
    found = []
    for i in index:
        shift, height = vertex(*value[i - 1 : i + 2])
        found.append((float(time[i] + shift * (time[i + 1] - time[i])), float(height)))
    return sorted(found, key=lambda each: -each[1])
