"""Environments with a velocity action in every control step, for comparison with via-points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from viapoint.envs.actions.velocity import Steering
from viapoint.envs.actions.via_points import Motion, Plan
from viapoint.envs.common.arrays import norm, put, take
from viapoint.envs.common.types import Float, Int, Observation
from viapoint.envs.common.validation import checked_actions
from viapoint.envs.config import VelocityConfig
from viapoint.envs.mdp.observation import FARTHEST, ObservationLayout
from viapoint.envs.mdp.rewards import StepRewardWeights, step_rewards
from viapoint.envs.multi_step import MultiStepVectorEnv
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.episode_state import Episodes, Segment
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, REST_SPEED, SETTLING, Outcome, straight_jerk_cost
from viapoint.envs.vector_env import Decision, ReachEnv, ReachVectorEnv


@dataclass(frozen=True, kw_only=True)
class StepObservationLayout(ObservationLayout):
    """Layout of observations during a movement.

    `start` [m], `velocity` [m/s] and `acceleration` [m/s^2] of the reference that the hand follows, `time_left` [s].
    """

    speed: float
    acceleration: float
    time_limit: float

    def space(self) -> spaces.Dict:
        """Return the observation space of one environment."""
        d = self.dimension
        sides = {
            "start": (-FARTHEST, FARTHEST, d),
            "velocity": (-self.speed, self.speed, d),
            "acceleration": (-self.acceleration, self.acceleration, d),
            "time_left": (0.0, self.time_limit, 1),
        }
        boxes = {name: spaces.Box(low, high, (n,), np.float32) for name, (low, high, n) in sides.items()}
        return spaces.Dict({**super().space().spaces, **boxes})

    def moving(self, observation: Observation, scenes: Scenes, motion: Motion, time: Float) -> Observation:
        """Return an observation with the parts that change during a movement, `time` after the start, (N,), [s]."""
        parts = {
            "start": scenes.start,
            "velocity": np.clip(motion.velocity, -self.speed, self.speed),
            "acceleration": np.clip(motion.acceleration, -self.acceleration, self.acceleration),
            "time_left": np.clip(self.time_limit - time, 0.0, self.time_limit)[:, None],
        }
        return {**observation, **{name: part.astype(np.float32) for name, part in parts.items()}}


class VelocityVectorEnv(MultiStepVectorEnv):
    """Reaching around obstacles by a velocity in every control step, `num_envs` times.

    Arm, scenes, physics, success and reward are those of :class:`ReachVectorEnv`. An episode ends
    when the hand has rested at the goal for the settling time, at a contact, when the reference leaves the arm's reach,
    or, truncated, when the longest movement of the twin would be over. In the step that ends an episode the next one
    begins (same-step autoreset): its first observation is returned, the last of the old is in `info["final_obs"]`,
    its info in `info["final_info"]` and, as that of the other environments, at the top level.

    The arguments are those of :class:`ReachVectorEnv` without `n_via` and `timing`, and these.

    Args:
        control_step: Time for which an action holds, [s].
        duration_range: Shortest and longest movement of the twin, [s]; the longest and the settling time are the limit.
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.StepRewardWeights`.

    Example:
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstaclesStep-v0", num_envs=16)
        >>> observation, _ = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(0.1 * envs.action_space.sample())
        >>> reward.shape
        (16,)
    """

    config_kind = VelocityConfig
    __signature__ = VelocityConfig.signature()
    observation_layout: StepObservationLayout

    def _build(self) -> None:
        """Create the steering, the layouts and the episodes."""
        config, arm, timestep = self.config, self.arm, self._simulator.timestep
        assert isinstance(config, VelocityConfig)
        self.steering = Steering(dimension=arm.dimension, control_step=config.control_step, timestep=timestep)
        """Meaning of the components of an action."""
        limit = self.task.action.duration_range[1] + SETTLING
        self.control_steps = int(np.ceil(limit / self.steering.control_step - 1e-9))
        """Control steps of an episode at most."""
        speed, acceleration = self.steering.greatest
        twin = self.task.observation
        time_limit = self.control_steps * self.steering.control_step
        self.observation_layout = StepObservationLayout.of(
            arm, twin.n_rows, twin.shapes, speed=speed, acceleration=acceleration, time_limit=time_limit
        )
        self.action_names = self.steering.names
        self._motion = Motion.at_rest(np.zeros((self.num_envs, arm.dimension)))
        self._rest = np.zeros(self.num_envs, dtype=np.int64)
        """Last physics steps in which the hand was at rest at the goal, shape (N,)."""
        self._episodes = Episodes(
            arm, self.num_envs, timestep=timestep,
            max_steps=self.control_steps * self.steering.physics_steps,
            records={"motion": self._motion._asdict(), "rest": {"steps": self._rest}},
        )  # fmt: skip

    @property
    def last_plan(self) -> Plan | None:
        """Start and goal as a plan without via-points; None before the first reset."""
        if self.scenes is None:
            return None
        waypoints = np.stack((self.scenes.start, self.scenes.goal), axis=-2)
        return Plan(waypoints, np.full((self.num_envs, 1), self.observation_layout.time_limit))

    def execute_plan(self, plan: Plan) -> Decision:
        """Raise an error: here, an action steers the hand for one control step.

        Raises:
            TypeError: Always; the twin whose actions are whole movements carries out plans.
        """
        raise TypeError(
            "plans are carried out by the twin of this environment whose actions are whole movements"
        )

    def execute_actions(self, actions: Any) -> Decision:
        """Move for one control step in each environment, without a reset.

        `terminated` and `truncated` tell which episodes ended; these must not be continued.

        Args:
            actions: Shape (num_envs, D), in [-1, 1]; components beyond are clipped.
        """
        scenes, episodes = self._check_running(), self._episodes
        actions = checked_actions(actions, self.num_envs, self.action_names)
        before, first = self._outcome(scenes), episodes.now.steps == 0
        self._advance(self.steering.decode(actions, scenes.start, scenes.goal))
        after = self._outcome(scenes)
        self.terminated = after.is_success | after.collision | ~after.reachable | after.unstable
        over = episodes.now.steps >= self.control_steps * self.steering.physics_steps
        self.truncated = over & ~self.terminated
        weights = self.task.weights
        assert isinstance(weights, StepRewardWeights)
        terms, progress = step_rewards(
            before, after, self.terminated | over, first, scenes, self.task.action.centre_duration, weights
        )
        if self.render_mode == "human" and (self.terminated | over)[0]:  # shows whole episodes
            self.render()
        info = {**after._asdict(), **terms.as_info(), "reward_progress": progress}
        return Decision(self.observe(), terms.total() + progress, info)

    def _advance(self, velocity: Float) -> None:
        """Follow a velocity for one control step; where the references leave the reach, the arm stays."""
        assert self.scenes is not None
        motion = self.steering.follow(self._motion, velocity)
        reachable = (np.asarray(self.arm.reach_margin(motion.position)) >= 0.0).all(axis=-1)
        self._episodes.now.reachable[:] = reachable
        rows = np.flatnonzero(reachable)
        if not rows.size:
            return
        cost = self.steering.jerk_cost(self._motion, velocity)[rows]
        motion, scenes = take(motion, rows), self.scenes.take(rows)
        log = self._simulator.rollout(rows, self.arm.controls(*(part[:, :-1] for part in motion)))
        number, planned = log.joints.shape[1], motion.position[:, 1:]
        hand = np.asarray(self.arm.hand_position(log.joints))
        obstacles, present = scenes.obstacles, scenes.present
        model = self.task.collision_model
        clearance = model.least_clearance(hand, obstacles, present, log.joints)
        planned_clearance = model.least_clearance(planned, obstacles, present)
        moved = self._episodes.add(
            Segment(
                rows=rows, steps=np.full(len(rows), number), planned=planned, joints=log.joints, hand=hand,
                contact=log.contact, unstable=log.unstable, min_clearance=clearance,
                planned_clearance=planned_clearance, jerk_cost=cost,
            )
        )  # fmt: skip
        resting = moved < REST_SPEED * self._simulator.timestep
        at_goal = resting & (norm(hand - scenes.goal[:, None]) < GOAL_TOLERANCE)
        trailing = np.where(at_goal.all(axis=-1), number, np.argmin(at_goal[:, ::-1], axis=-1))
        self._rest[rows] = trailing + np.where(trailing == number, self._rest[rows], 0)
        put(self._motion, rows, Motion(*(part[:, -1] for part in motion)))

    def _outcome(self, scenes: Scenes) -> Outcome:
        """Return the metrics so far; the duration of a success is the time until the hand came to rest."""
        now, timestep, rest = self._episodes.now, self._simulator.timestep, self._rest
        success = (rest * timestep >= SETTLING - 1e-9) & now.sound
        duration = timestep * np.where(success, np.maximum(now.steps - rest, 1), np.maximum(now.steps, 1))
        cost = straight_jerk_cost(norm(scenes.goal - scenes.start), duration)
        return now.outcome(success, norm(now.hand - scenes.goal), duration, cost, timestep)

    def _start(self, rows: Int, scenes: Scenes) -> Float:
        joints = super()._start(rows, scenes)
        put(self._motion, rows, Motion.at_rest(scenes.start))
        self._rest[rows] = 0
        clearance = self.task.collision_model.least_clearance(
            scenes.start[:, None], scenes.obstacles, scenes.present
        )
        self._episodes.begin(rows, joints, scenes.start, clearance)
        return joints

    def observe(self) -> Observation:
        """Return the present observations."""
        assert self.scenes is not None
        now = self._episodes.now
        seen = self.observation_layout.observe(now.joints, now.hand, self.scenes)
        return self.observation_layout.moving(seen, self.scenes, self._motion, self._episodes.time)

    def _film(self, sim: int, scene: Scenes) -> Any:
        plan = self.last_plan
        assert plan is not None
        return self._renderer.movement(scene, plan.take([sim]), self._rollout(sim))


class VelocityEnv(ReachEnv):
    """One environment of a :class:`VelocityVectorEnv`, with the same keyword arguments.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstaclesStep-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> type(env.unwrapped).__name__
        'VelocityEnv'
    """

    batch_kind: ClassVar[type[ReachVectorEnv]] = VelocityVectorEnv
    batch: VelocityVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.steering = self.batch.steering
