"""Environments in which targets jump and obstacles move, and plans are revised during the movement."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from viapoint.envs.actions.replanning import MovingPlan, NominalPlan, ReplanningDecoder
from viapoint.envs.actions.via_points import Plan, checked_plan
from viapoint.envs.common.arrays import norm, put, take
from viapoint.envs.common.types import Bool, Float, Int, Observation
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE, checked_actions
from viapoint.envs.config import ReplanningConfig
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.mdp.observation import ReplanningObservationLayout
from viapoint.envs.mdp.rewards import replanning_rewards
from viapoint.envs.multi_step import MultiStepVectorEnv
from viapoint.envs.rendering.renderer import History
from viapoint.envs.scenes.dynamic_scene import ChangingScenes, problems_of_changes
from viapoint.envs.scenes.motion import ChangeDistribution, ChangeSampler
from viapoint.envs.scenes.options import CHANGES, given_changes
from viapoint.envs.scenes.scene import refuse
from viapoint.envs.sim.episode_state import Episodes
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, REST_SPEED, SETTLING, Outcome, straight_jerk_cost
from viapoint.envs.sim.replan_triggers import Event, ReplanTriggers
from viapoint.envs.sim.replanning_executor import Decisions, ReplanningExecutor
from viapoint.envs.vector_env import Decision, ReachEnv, ReachVectorEnv


class PlanStart(NamedTuple):
    """Beginnings of the N plans under way."""

    step: Int
    """Physics step of the episode at which the plan began, shape (N,)."""
    begun: Bool
    """True if there is a plan, shape (N,)."""


class ReplanningVectorEnv(MultiStepVectorEnv):
    """Reaching with replanning: targets jump, obstacles move, and plans are revised, `num_envs` times.

    Arm, physics and success are those of :class:`ReachVectorEnv`. An episode is several decisions;
    each starts from the present command, ends with an event of `decide_at`, and takes
    `info["elapsed"]` seconds. In the step that ends an episode the next one begins (same-step autoreset): its first
    observation is returned, the last of the old is in `info["final_obs"]`, its info in `info["final_info"]` and, as
    that of the other environments, at the top level.

    The arguments are those of :class:`ReachVectorEnv`, of which `timing` must be `optimal`, and these.

    Args:
        moving_obstacles: True if the obstacles move.
        n_jumps: Number of jumps of the target, or the fewest and the most.
        decide_at: Events that end a decision: some of `horizon`, `target`, `course`, `clearance`.
        horizon: Time after which a decision ends, [s].
        margin: Predicted clearance below which a decision ends, [m].
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.ReplanningRewardWeights`.

    Example:
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarMovingObstacles-v0", num_envs=16)
        >>> observation, _ = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(0.1 * envs.action_space.sample())
        >>> reward.shape
        (16,)
    """

    config_kind = ReplanningConfig
    __signature__ = ReplanningConfig.signature()
    scenes: ChangingScenes | None  # type: ignore[assignment]
    observation_layout: ReplanningObservationLayout

    def _build(self) -> None:
        """Create the layouts, the sampler of changes, the stages and the episodes."""
        config, task, timestep = self.config, self.task, self._simulator.timestep
        assert isinstance(config, ReplanningConfig)
        action, base, model = task.action, task.observation, task.collision_model
        shortest, longest = action.duration_range
        n_jumps: Any = config.n_jumps
        self.changes = ChangeDistribution(n_jumps=n_jumps, moving=bool(config.moving_obstacles))
        """Distribution of the changes of scenes."""
        self.decoder = ReplanningDecoder(action)
        """Meaning of the components of an action during a movement."""
        self._ends = ReplanTriggers(
            model, timestep=timestep, triggers=config.decide_at, horizon=config.horizon, margin=config.margin,
            time_limit=(2 + self.changes.n_jumps[1]) * longest + SETTLING,
        )  # fmt: skip
        self.time_limit = float(self._ends.limit * timestep)
        """Time limit of an episode, [s]."""
        self.observation_layout = ReplanningObservationLayout.of(
            task.arm, base.n_rows, base.shapes, n_via=action.n_via, time_limit=self.time_limit
        )
        self._change_sampler = ChangeSampler(
            model, self.changes, durations=(shortest, action.centre_duration, longest)
        )
        self._stages = ReplanningExecutor(self._simulator)
        n, d = self.num_envs, task.arm.dimension
        self._plan = MovingPlan(
            np.zeros((n, action.n_via + 2, d)), np.ones((n, action.n_via + 1)), *np.zeros((2, n, d))
        )
        self._plan_start = PlanStart(np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool))
        self._history: list[History] = [[] for _ in range(n)]
        self._episodes = Episodes(
            task.arm, n, timestep=timestep, max_steps=self._ends.limit + 1,
            records={"plan": self._plan._asdict(), "start": self._plan_start._asdict()},
        )  # fmt: skip

    @property
    def last_plan(self) -> Plan | None:
        """Plans under way as via-points [m] and durations [s]; None before the first decision."""
        if self.scenes is None or not self._plan_start.begun.any():
            return None
        return Plan(*(part.copy() for part in self._plan.plan))

    @property
    def last_plans(self) -> tuple[History, ...]:
        """All plans of the running episodes with the times at which they began, [s]."""
        return tuple(list(history) for history in self._history)

    @property
    def default(self) -> NominalPlan:
        """Plans that a zero action leads to, and the present commands."""
        self._check_running()
        assert self.scenes is not None
        start, episodes = self._plan_start, self._episodes
        plan_time = np.asarray((episodes.now.steps - start.step) * self._simulator.timestep)
        goal = self.scenes.goals(episodes.time)
        return self.decoder.default(self._plan, plan_time, start.begun, self.scenes.start, goal)

    def execute_actions(self, actions: Any) -> Decision:
        """Make one decision in each environment and execute it until it ends, without a reset.

        `terminated` tells which episodes ended; these must not be continued.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        self._check_running()
        actions = checked_actions(actions, self.num_envs, self.action_names)
        plan, kept = self.decoder.revise(self.default, self._plan, actions)
        return self._execute_decision(plan, ~kept)

    def execute_plan(self, plan: Plan) -> Decision:
        """Replace every plan by this one, which begins at the commanded hand position, without a reset.

        Args:
            plan: Movements of all environments with as many via-points as those of an action.
        """
        state, shape = self.default.state, self._plan.waypoints.shape
        plan = checked_plan(plan, state.position)
        if plan.waypoints.shape != shape:
            raise ValueError(f"plan must have waypoints of shape {shape}, got {plan.waypoints.shape}")
        waypoints = np.concatenate((state.position[:, None], plan.waypoints[:, 1:]), axis=1)
        moving = MovingPlan(waypoints, plan.durations.copy(), state.velocity, state.acceleration)
        return self._execute_decision(moving, np.ones(self.num_envs, dtype=bool))

    def move_goals(self, goals: Float) -> Observation:
        """Move the targets of the running episodes, which jump no more, and return the new observations.

        The next decision revises the plans without a jump of position, velocity or acceleration.

        Args:
            goals: New targets, shape (num_envs, D), [m], within the arm's reach.
        """
        self._check_running()
        assert self.scenes is not None
        self.scenes = self.scenes._replace(goal=goals.copy(), jumps=np.zeros_like(self.scenes.jumps))
        return self.observe()

    def state(self) -> dict[str, Any]:
        """Return the state of the environments; see :meth:`ReachVectorEnv.state`."""
        state = super().state()
        every = [each for history in self._history for each in history]
        episodes = state["episodes"]
        episodes["history_number"] = np.array([len(history) for history in self._history])
        episodes["history_time"] = np.array([time for time, _ in every])
        for k, (name, part) in enumerate(self._plan._asdict().items()):
            none = np.empty((0, *part.shape[1:]))
            episodes[f"history_{name}"] = np.concatenate([none, *(plan[k] for _, plan in every)])
        return state

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same kind and number."""
        super().restore(state)
        episodes = state["episodes"]
        plans = MovingPlan(*(np.asarray(episodes[f"history_{name}"]) for name in MovingPlan._fields))
        first = 0
        for row, number in enumerate(episodes["history_number"]):
            self._history[row] = [
                (float(episodes["history_time"][k]), take(plans, [k])) for k in range(first, first + number)
            ]
            first += number

    def _execute_decision(self, plan: MovingPlan, revised: Bool) -> Decision:
        """Run the stages after decoding: scale time, build references, simulate, measure, score and observe."""
        assert self.scenes is not None
        scenes, episodes, now, start = self.scenes, self._episodes, self._episodes.now, self._plan_start
        steps, first = now.steps.copy(), ~start.begun
        before = self._outcome(scenes, np.zeros(self.num_envs, dtype=bool))
        self._adopt(plan, revised)
        ends = self._ends(self._plan, start.step, steps, scenes)
        duration = np.where(now.reachable, ends.step - steps, 0)
        decisions = Decisions(
            np.arange(self.num_envs), self._plan, steps - start.step, steps, duration, scenes
        )
        stages = self._stages
        segments, _ = self._scheduler.run(
            decisions.groups(), stages.build_references, stages.simulate, stages.measure
        )
        for segment in segments:
            episodes.add(segment)
        event = np.where(now.collision, Event.CONTACT, ends.event)
        event = np.where(now.unstable, Event.UNSTABLE, np.where(now.reachable, event, Event.REACH))
        final = ends.final & (event == Event.ARRIVAL)
        after = self._outcome(scenes, final)
        self.terminated = (
            final | (event == Event.TIME_LIMIT) | (event >= Event.REACH) | (event == Event.CONTACT)
        )
        elapsed = np.asarray((now.steps - steps) * self._simulator.timestep)
        terms = replanning_rewards(
            before, after, elapsed, self.terminated, first, scenes, self.action_layout.centre_duration,
            self.task.weights,
        )  # fmt: skip
        times = {"elapsed": elapsed, "time": episodes.time, "event": event}
        if self.render_mode == "human" and self.terminated[0]:  # shows whole episodes
            self.render()
        return Decision(self.observe(), terms.total(), {**after._asdict(), **terms.as_info(), **times})

    def _adopt(self, plan: MovingPlan, revised: Bool) -> None:
        """Begin new plans where they were revised, as slow as the arm needs them."""
        rows, now = np.flatnonzero(revised), self._episodes.now
        if not rows.size:
            return
        plan, (stretch, within) = self._stages.scale_time(take(plan, rows))
        now.reachable[rows] &= within
        now.stretch[rows] = np.maximum(now.stretch[rows], stretch)
        put(self._plan, rows, plan)
        self._plan_start.step[rows], self._plan_start.begun[rows] = now.steps[rows], True
        times = self._episodes.time
        for row in rows:
            self._history[row].append((float(times[row]), take(self._plan, [row])))

    def _outcome(self, scenes: ChangingScenes, final: Bool) -> Outcome:
        """Return the metrics so far, where `final` is True for hands that have arrived at their last goal."""
        episodes, now, start = self._episodes, self._episodes.now, self._plan_start
        goal_error = norm(now.hand - scenes.goals(episodes.time))
        arrived = final & (goal_error < GOAL_TOLERANCE) & (now.last_speed < REST_SPEED)
        ends = start.step * self._simulator.timestep + self._plan.duration
        duration = np.where(start.begun, np.minimum(episodes.time, ends), 0.0)
        length = np.maximum(scenes.straight_length(episodes.time), MIN_GOAL_DISTANCE)
        cost = straight_jerk_cost(length, np.maximum(duration, self._simulator.timestep))
        return now.outcome(arrived & now.sound, goal_error, duration, cost, self._simulator.timestep)

    def _clearance(self, scene: Any, hand: Float, joints: Float, time: Float) -> Float:
        profile = self.task.collision_model.clearance_profile(
            hand[None], scene.places(time[None]), scene.present, joints[None]
        )
        return np.asarray(profile[0].min(axis=-1, initial=MAX_CLEARANCE))

    def _draw(  # type: ignore[override]
        self, generators: list[np.random.Generator], rows: Int, options: Mapping[str, Any]
    ) -> ChangingScenes:
        """Sample or set up scenes and their changes; if one is refused, the generators are unchanged."""
        tried = [copy.deepcopy(generator) for generator in generators] if options else generators
        scene = {name: value for name, value in options.items() if name not in CHANGES}
        layout = self.task.observation
        jumps, courses = given_changes(options, len(rows), layout.dimension, layout.n_rows)
        draw = super()._draw
        scenes = draw(tried, rows, scene)
        again = None if options else lambda some: draw(tried, rows[some], {})
        try:
            changing = self._change_sampler([tried[i] for i in rows], scenes, jumps, courses, again=again)
        except RuntimeError as error:
            raise ValueError(f"{error}; give the jumps, too") from None
        if jumps is not None or courses is not None:
            refuse(problems_of_changes(changing, self.task.collision_model, time_limit=self.time_limit))
        for i in rows:
            generators[i] = tried[i]
        return changing

    def _start(self, rows: Int, scenes: ChangingScenes) -> Float:  # type: ignore[override]
        """Start episodes with the arms at rest at the start and the obstacles where their courses begin."""
        joints = super()._start(rows, scenes)  # type: ignore[arg-type]
        places = scenes.places(np.zeros((len(rows), 1)))
        clearance = self.task.collision_model.clearance_profile(scenes.start[:, None], places, scenes.present)
        self._episodes.begin(rows, joints, scenes.start, clearance.min(axis=(1, 2), initial=MAX_CLEARANCE))
        number, zero = self._plan.waypoints.shape[1], np.zeros_like(scenes.start)
        rest = np.repeat(scenes.start[:, None], number, axis=1)
        put(self._plan, rows, MovingPlan(rest, np.ones((len(rows), number - 1)), zero, zero))
        self._plan_start.step[rows], self._plan_start.begun[rows] = 0, False
        for row in rows:
            self._history[row] = []
        return joints

    def observe(self) -> Observation:
        """Return the present observations."""
        assert self.scenes is not None
        episodes = self._episodes
        return self.observation_layout.observe_replanning(
            episodes.now.joints, self.scenes, self.default, episodes.time
        )

    def _film(self, sim: int, scene: ChangingScenes) -> Any:
        return self._renderer.episode(scene, self._history[sim], self._rollout(sim))


class ReplanningEnv(ReachEnv):
    """One environment of a :class:`ReplanningVectorEnv`, with the same keyword arguments.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarMovingObstacles-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> type(env.unwrapped).__name__
        'ReplanningEnv'
    """

    batch_kind: ClassVar[type[ReachVectorEnv]] = ReplanningVectorEnv
    batch: ReplanningVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.decoder = self.batch.decoder

    @property
    def last_plans(self) -> History:
        """All plans of the episode with the times at which they began, [s]."""
        return self.batch.last_plans[0]
