"""Motion plans: movements of an arm among obstacles, with what was checked of them, for controllers and for MuJoCo."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.kinematics import torques
from viapoint.envs.common.arrays import Float
from viapoint.envs.common.validation import number_of_at_least
from viapoint.envs.episodes import Episodes
from viapoint.envs.geometry.obstacles import Obstacles, mesh_names, no_obstacles, pack, unpack
from viapoint.envs.geometry.shapes import (
    IN_TABLES,
    PLAIN_KINDS,
    ConvexMesh,
    PointCloud,
    Shape,
    Sphere,
    register_mesh,
    registered_name,
)
from viapoint.envs.outcome import Outcome
from viapoint.envs.plans import Motion, Plan, SpaceName
from viapoint.envs.scenes.scene import resting
from viapoint.envs.spaces import Space, space_of
from viapoint.envs.task import MOST_OBSTACLES, Task

HIGHEST_RATE = 1e6  # Instants per second of a movement of the joints are fewer, [Hz]


class Limits(NamedTuple):
    """Greatest shares of the limits of the joints that a movement uses; more than 1 is beyond a limit."""

    velocity: float
    torque: float


class JointMotion(NamedTuple):
    """Movement of the joints at N instants: times, shape (N,), [s]; the others have the shape (N, J).

    Positions are in [rad] or [m], velocities and accelerations per second; torques or forces by inverse dynamics are in
    [N m] or [N].
    """

    time: Float
    position: Float
    velocity: Float
    acceleration: Float
    torque: Float


class UnsafePlanError(ValueError):
    """Error of a plan that touches something, or breaks a limit, and was to be executed or exported.

    Example:
        >>> from viapoint.envs import Box
        >>> from viapoint.training import UnsafePlanError, plan_motion
        >>> wall = Box((0.01, 0.5, 0.04), position=(0.0, 0.4, 0.0))
        >>> plan = plan_motion("planar", (-0.2, 0.3), (0.2, 0.3), [wall], time_limit=0.0)
        >>> try:
        ...     plan.joints()
        ... except UnsafePlanError:
        ...     print(plan.success, plan.clearance < 0.0)
        False True
    """


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionPlan:
    """Movement of an arm from a start to a goal, and what is known of it.

    Example:
        >>> from viapoint.envs import Box, arm_of
        >>> from viapoint.training.planning.plan_motion import plan_motion
        >>> arm = arm_of("panda")
        >>> goal = arm.home + [0.8, 0.5, 0.0, 0.6, 0.0, 0.3, 0.0]
        >>> plan = plan_motion(arm, arm.home, goal, [Box((0.1, 0.1, 0.3), position=(0.5, 0.15, 0.3))])
        >>> plan.success, plan.waypoints.shape
        (True, (4, 7))
        >>> motion = plan.joints(rate=1000)  # at 1 kHz, for a controller
        >>> motion.position.shape == motion.torque.shape == (len(motion.time), 7)
        True
    """

    arm: Arm
    space: SpaceName
    """Space of the coordinates."""
    waypoints: Float
    """Start, via-points and goal, shape (K + 2, D), [rad] of joints or [m] of the hand; (0, D) for a problem of a batch
    that was refused, for which there is no movement."""
    durations: Float
    """Durations of the segments, shape (K + 1,), [s]."""
    velocity: Float
    """Initial velocity, shape (D,)."""
    acceleration: Float
    """Initial acceleration, shape (D,)."""
    obstacles: Obstacles
    """Obstacles of the scene, as one scene of packed arrays."""
    success: bool
    """True if the movement touches nothing and keeps all limits."""
    clearance: float
    """Least clearance from obstacles and of the arm from itself, [m]; at most 1, negative in contact, and -2 for a
    movement that leaves the joint limits or the reach. A margin holds for obstacles alone."""
    limits: Limits
    """Shares of the velocity and torque limits."""
    jerk: float
    """Jerk cost relative to that of the straight movement of the same duration; 1 where nothing moves, and NaN for a
    movement that begins in motion and ends where it began."""
    source: str
    """Origin of the via-points: `straight`, `straight, refined`, `given`, `random`, `path`, `ompl`, or another planner;
    `refused` where there is no movement."""
    reason: str = ""
    """Reason why there is no success; empty for success."""
    seeds: int = 0
    """Number of seeds that were refined."""
    milliseconds: float = 0.0
    """Time that planning took, [ms]."""

    def __repr__(self) -> str:
        """Return what matters."""
        if not len(self.waypoints):
            return f"MotionPlan({self.arm.name!r}, refused: {self.reason})"
        state = "success" if self.success else f"no success: {self.reason}"
        return (
            f"MotionPlan({self.arm.name!r}, {state}, n_via={len(self.durations) - 1}, duration={self.duration:.3f} s, "
            f"clearance={1e3 * self.clearance:.1f} mm, jerk={self.jerk:.2f}, source={self.source!r}, "
            f"seeds={self.seeds}, milliseconds={self.milliseconds:.1f})"
        )

    @property
    def duration(self) -> float:
        """Total duration, [s]."""
        return float(self.durations.sum())

    @property
    def plan(self) -> Plan:
        """The movement alone, as environments take it; UnsafePlanError if there is none."""
        self.refuse_unsafe(force=True)
        return Plan(self.waypoints, self.durations, self.velocity, self.acceleration)

    def trajectory(self) -> primitives.Trajectory:
        """Return the minimum-jerk movement through the waypoints, in coordinates of the space."""
        return self.plan.trajectory()

    def joints(self, rate: float = 1000.0, *, force: bool = False) -> JointMotion:
        """Return the movement of the joints at a rate, from the start to the goal.

        Args:
            rate: Instants per second, from 0.001 to less than 1e6, [Hz]; the last interval may be shorter.
            force: True for plans without success, too, which raise UnsafePlanError otherwise.
        """
        self.refuse_unsafe(force)
        number_of_at_least("rate", rate, 1e-3, HIGHEST_RATE)
        last = int((self.duration - 2e-9) * rate)  # times of files are whole nanoseconds, and increase
        time = np.append(np.arange(last + 1) / rate, self.duration)
        motion = joint_motion(space_of(self.arm, self.space), *self.trajectory().sample(time))
        return JointMotion(time, *motion, torques(self.arm.chain, *motion))

    def execute(self, *, force: bool = False) -> Outcome:
        """Execute the movement in MuJoCo among its obstacles, and return the metrics, shape (1,) each.

        Plans without success raise UnsafePlanError unless `force` is True.
        """
        self.refuse_unsafe(force)
        outcome, _ = execute_plans([self])
        return outcome

    def refuse_unsafe(self, force: bool) -> None:
        """Raise UnsafePlanError where there is no movement, and for a plan without success unless `force` is True."""
        if not len(self.waypoints):
            raise UnsafePlanError(f"there is no movement: {self.reason}")
        if not self.success and not force:
            raise UnsafePlanError(f"the plan is not safe: {self.reason}; force=True takes it nevertheless")


def joint_motion(space: Space, position: Float, velocity: Float, acceleration: Float) -> Motion:
    """Return the motion of the joints, shape (N, J) each, from coordinates and their derivatives, shape (N, D) each."""
    motion = space.joint_motion(Motion(position[None], velocity[None], acceleration[None]))
    return Motion(*(np.ascontiguousarray(part[0]) for part in motion))


def execute_plans(plans: Sequence[MotionPlan]) -> tuple[Outcome, Episodes]:
    """Execute plans of one arm in MuJoCo, each among its obstacles; return metrics, shape (N,), and the simulations.

    All plans must have equally many via-points; plans without success are executed, too. Beyond a limit of the arm,
    plans from rest are slowed down, and plans that begin in motion, which cannot be, have no success.
    """
    parts = zip(*(each.plan for each in plans), strict=True)
    plan = Plan(*map(np.stack, parts))
    first, number = plans[0], len(plans)
    solids = [_solids(plan.obstacles) for plan in plans]
    rows = max(each.kind.shape[1] for each in solids)
    meshes = sorted({name for each in solids for name in mesh_names(each.meshes)})
    episodes = _episodes(first.arm, first.space, len(first.durations) - 1, rows, number, tuple(meshes))
    begin = Motion(plan.waypoints[:, 0], plan.velocity, plan.acceleration)
    space = episodes.task.space
    start, goal = (np.ascontiguousarray(space.joints(plan.waypoints[:, end])) for end in (0, -1))
    obstacles = no_obstacles(number, rows)
    for i, each in enumerate(solids):
        obstacles = obstacles.put([i], each.with_rows(rows))
    episodes.start(np.arange(number), resting(start, goal, obstacles))
    episodes.simulator.batch.bind("qvel")[:] = space.joint_motion(begin).velocity
    decision = episodes.execute(plan)
    outcome = Outcome(**{name: decision.info[name] for name in Outcome._fields})
    moving = plan.velocity.any(axis=-1) | plan.acceleration.any(axis=-1)
    beyond = np.array([each.limits for each in plans]).max(axis=1) > 1.0
    return outcome._replace(is_success=outcome.is_success & ~(moving & beyond)), episodes


def _solids(obstacles: Obstacles) -> Obstacles:
    """Return the obstacles of one scene as MuJoCo takes them: clouds as spheres, meshes with a registered name."""
    if not np.isin(obstacles.kind, IN_TABLES).any() and obstacles.kind.shape[1] <= MOST_OBSTACLES:
        return obstacles
    found = list[Shape]()
    for shape in unpack(obstacles, 0):
        if isinstance(shape, PointCloud):
            for point in shape.points @ shape.rotation.T + shape.position:
                found.append(Sphere(shape.radius, position=point, velocity=shape.velocity))
            continue
        if isinstance(shape, ConvexMesh) and not registered_name(shape.vertices):
            content = hashlib.sha256(np.unique(shape.vertices, axis=0).tobytes()).hexdigest()
            register_mesh(f"mesh_{content[:12]}", shape.vertices)
        found.append(shape)
    if len(found) > MOST_OBSTACLES:
        raise ValueError(
            f"a plan is executed among at most {MOST_OBSTACLES} obstacles, where each point of a cloud is one, got "
            f"{len(found)}; PointCloud.covering makes a cloud with fewer points"
        )
    return pack([found])


@functools.lru_cache(maxsize=4)
def _episodes(
    arm: Arm, space: SpaceName, n_via: int, rows: int, number: int, meshes: tuple[str, ...]
) -> Episodes:
    """Return simulations of an arm among up to some obstacles, which may be some registered meshes."""
    shapes = (*PLAIN_KINDS, *meshes)
    task = Task.of(arm=arm, space=space, n_via=n_via, n_obstacles=(0, rows), shapes=shapes)
    return Episodes(task, number, prolong=False)
