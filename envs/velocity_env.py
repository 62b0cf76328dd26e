"""The same tasks with an action in every control step: what one would use instead of via-points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from viapoint.envs.actions.velocity import Motion, Steering
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.arms import ADULT, Arm
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.common.validation import as_given, checked_actions, refuse_unknown
from viapoint.envs.mdp.observation import FARTHEST, ObservationLayout
from viapoint.envs.mdp.rewards import StepRewardWeights, step_rewards
from viapoint.envs.multi_step import ManyStepEnv, ManyStepVectorEnv
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import SETTLING, Rollout
from viapoint.envs.sim.simulator import SimulationLog
from viapoint.envs.sim.velocity_episodes import StepEpisodes
from viapoint.envs.vector_env import Decision, ReachVectorEnv


@dataclass(frozen=True, kw_only=True)
class StepObservationLayout(ObservationLayout):
    """The parts of a whole movement's observation, and what changes on the way.

    `start` [m], `velocity` [m/s] and `acceleration` [m/s^2] of the reference that the hand follows, `time_left` [s].
    """

    speed: float
    acceleration: float
    time_limit: float

    def space(self) -> spaces.Dict:
        """The observation space of one environment."""
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
        """An observation with what changes on the way, `time` after the start, shape (N,), [s]."""
        parts = {
            "start": scenes.start,
            "velocity": np.clip(motion.velocity, -self.speed, self.speed),
            "acceleration": np.clip(motion.acceleration, -self.acceleration, self.acceleration),
            "time_left": np.clip(self.time_limit - time, 0.0, self.time_limit)[:, None],
        }
        return {**observation, **{name: part.astype(np.float32) for name, part in parts.items()}}


class StepReachVectorEnv(ManyStepVectorEnv):
    """Reaching around obstacles by a velocity in every control step, `num_envs` times.

    Arm, scenes, physics, success and reward are those of :class:`ReachVectorEnv`. An episode ends
    when the hand has rested at the goal for the settling time, at a contact, when the reference leaves the arm's reach,
    or, truncated, when the longest movement of the twin would be over. In the step that ends an episode the next one
    begins (same-step autoreset): its first observation is returned, the last of the old is in `info["final_obs"]`,
    its info in `info["final_info"]` and, as that of the other environments, at the top level.

    Args:
        num_envs: Number of environments N.
        arm: The arm that moves, a record or the name of one.
        whole_arm: Whether the links must clear the obstacles, too, or the hand alone.
        n_obstacles: An exact number, or the fewest and the most.
        control_step: Time for which an action holds, [s].
        duration_range: Shortest and longest movement of the twin, [s]; the longest and the settling time are the limit.
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.StepRewardWeights`.
        render_mode: `human`, `rgb_array` or `rgb_array_list`.
        width: Of a rendered frame, [pixels].
        height: Of a rendered frame, [pixels].
        threads: Of the simulation; 0 is one for each core. Results do not depend on it.
    """

    weights_kind = StepRewardWeights
    observation_layout: StepObservationLayout

    def __init__(
        self,
        num_envs: int = 1,
        *,
        arm: Arm | str = ADULT,
        whole_arm: bool = False,
        n_obstacles: int | tuple[int, int] = (1, 5),
        control_step: float = 0.04,
        duration_range: tuple[float, float] = (0.6, 1.2),
        reward_weights: StepRewardWeights | Mapping[str, float] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        threads: int = 0,
        **unknown: Any,
    ) -> None:
        refuse_unknown(unknown, type(self).__init__.__annotations__)
        kwargs: dict[str, Any] = {
            "arm": arm, "whole_arm": whole_arm, "n_obstacles": n_obstacles, "duration_range": duration_range,
            "render_mode": render_mode, "width": width, "height": height, "threads": threads,
        }  # fmt: skip
        weights = self.weights_kind.of(reward_weights)
        if not isinstance(weights, StepRewardWeights):
            raise ValueError(f"reward_weights must be StepRewardWeights or a mapping, got {weights!r}")
        super().__init__(num_envs, reward_weights=weights, **kwargs)
        kwargs = {"control_step": control_step, "reward_weights": reward_weights, **kwargs}
        EzPickle.__init__(self, num_envs, **as_given(kwargs))
        arm, timestep = self.arm, self._simulator.timestep
        self.steering = Steering(dimension=arm.dimension, control_step=control_step, timestep=timestep)
        """What the components of an action mean."""
        limit = self.task.action.duration_range[1] + SETTLING
        self.control_steps = int(np.ceil(limit / self.steering.control_step - 1e-9))
        """Of an episode at most."""
        speed, acceleration = self.steering.greatest
        twin = self.observation_layout
        self.observation_layout = StepObservationLayout(
            dimension=twin.dimension, joint_range=twin.joint_range, n_rows=twin.n_rows, speed=speed,
            acceleration=acceleration, time_limit=self.control_steps * self.steering.control_step,
        )  # fmt: skip
        self.single_action_space = spaces.Box(-1.0, 1.0, (arm.dimension,), np.float32)
        self.single_observation_space = self.observation_layout.space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        most = self.control_steps * self.steering.physics_steps
        self._weights = weights
        self._episodes = StepEpisodes(self.task.collision_model, self.num_envs, timestep=timestep, most=most)

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """The running movements so far at every physics step; empty before the first reset."""
        if self.scenes is None:
            return ()
        return tuple(self._episodes.rollout(row, self.scenes.take([row])) for row in range(self.num_envs))

    @property
    def last_plan(self) -> Plan | None:
        """Start and goal as a plan without via-points; None before the first reset."""
        if self.scenes is None:
            return None
        waypoints = np.stack((self.scenes.start, self.scenes.goal), axis=-2)
        return Plan(waypoints, np.full((self.num_envs, 1), self.observation_layout.time_limit))

    def execute_plan(self, plan: Plan) -> Decision:
        """Refuse plans: here the hand is steered in every control step.

        Raises:
            TypeError: Always; the twin whose actions are whole movements carries them out.
        """
        raise TypeError(
            "plans are carried out by the twin of this environment whose actions are whole movements"
        )

    def execute_actions(self, actions: Any) -> Decision:
        """Move for one control step in each environment, without a reset.

        `terminated` and `truncated` tell which episodes ended; these must not be moved on.

        Args:
            actions: Shape (num_envs, D), in [-1, 1]; components beyond are clipped.
        """
        self._check_running()
        assert self.scenes is not None
        actions = checked_actions(actions, self.num_envs, self.steering.names)
        scenes, episodes = self.scenes, self._episodes
        before, begun = episodes.outcome(scenes), episodes.running.steps == 0
        self._advance(self.steering.decode(actions, scenes.start, scenes.goal))
        after = episodes.outcome(scenes)
        self.terminated = after.is_success | after.collision | ~after.reachable | after.unstable
        over = episodes.running.steps >= self.control_steps * self.steering.physics_steps
        self.truncated = over & ~self.terminated
        terms, progress = step_rewards(
            before, after, self.terminated | over, begun, scenes, self.task.action.centre_duration, self._weights
        )  # fmt: skip
        if (
            self.render_mode == "human" and (self.terminated | over)[0]
        ):  # a movement is played when it is over
            self.render()
        info = {**after._asdict(), **terms.as_info(), "reward_progress": progress}
        return Decision(self._observe_start(), terms.total() + progress, info)

    def episodes_state(self) -> dict[str, Any]:
        """Where the running episodes are, beside their scenes, as arrays for :meth:`restore_episodes`."""
        return {**self._episodes.state(), "physics": self._simulator.batch.state.copy()}

    def restore_episodes(self, state: Mapping[str, Any]) -> None:
        """Go on where :meth:`episodes_state` was taken, after a reset to the same scenes."""
        self._episodes.restore(state)
        self._simulator.batch.state[:] = state["physics"]

    def _advance(self, wanted: Float) -> None:
        """One control step at the wanted velocities; where its reference leaves the reach, the arm stays."""
        assert self.scenes is not None
        motion = self.steering.follow(self._episodes.motion, wanted)
        cost = self.steering.jerk_cost(self._episodes.motion, wanted)
        reachable = (np.asarray(self.arm.reach_margin(motion.position)) >= 0.0).all(axis=-1)
        self._episodes.running.reachable[:] = reachable
        rows = np.flatnonzero(reachable)
        if rows.size:
            some = Motion(*(part[rows] for part in motion))
            controls = self.arm.controls(*(part[:, :-1] for part in some))
            record: SimulationLog = self._simulator.rollout(rows, controls)
            self._episodes.add(rows, self.scenes.take(rows), some, cost[rows], record)

    def _start(self, rows: NDArray[np.int64], scenes: Scenes) -> None:
        super()._start(rows, scenes)
        self._episodes.begin(rows, scenes, np.asarray(self.arm.inverse_kinematics(scenes.start)))

    def _observe_start(self) -> Observation:
        """What is seen now."""
        assert self.scenes is not None
        now = self._episodes.running
        seen = self.observation_layout.observe(now.joints, now.hand, self.scenes)
        time = np.asarray(now.steps * self._simulator.timestep)
        return self.observation_layout.moving(seen, self.scenes, self._episodes.motion, time)

    def _render_one(self, sim: int) -> Any:
        if self.render_mode is None or self.scenes is None or not self._episodes.running.steps[sim]:
            return super()._render_one(sim)
        scene, plan = self.scenes.take([sim]), self.last_plan
        assert plan is not None
        return self._renderer.movement(sim, scene, plan.take([sim]), self._episodes.rollout(sim, scene))


class StepReachEnv(ManyStepEnv):
    """A batch of one of :class:`StepReachVectorEnv`, with the same keyword arguments."""

    batch_kind: ClassVar[type[ReachVectorEnv]] = StepReachVectorEnv
    batch: StepReachVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.steering = self.batch.steering
