"""Tasks in which something happens on the way, and plans are revised."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.utils import EzPickle
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from viapoint.envs.actions.replanning import MovingPlan, NominalPlan, Reviser
from viapoint.envs.actions.via_points import Plan, Timing, checked_plan
from viapoint.envs.arms import ADULT, Arm
from viapoint.envs.common.types import Bool, Observation
from viapoint.envs.common.validation import as_given, checked_actions, fewest_and_most, refuse_unknown
from viapoint.envs.mdp.observation import OnlineObservationLayout
from viapoint.envs.mdp.rewards import OnlineRewardWeights, online_rewards
from viapoint.envs.multi_step import ManyStepEnv, ManyStepVectorEnv
from viapoint.envs.rendering.renderer import EpisodeRenderer, History
from viapoint.envs.scenes.dynamic_scene import ChangingScenes, problems_of_changes
from viapoint.envs.scenes.motion import ChangeDistribution, ChangeSampler
from viapoint.envs.scenes.options import CHANGES, check_owners, given_changes
from viapoint.envs.sim.executor import SETTLING, Rollout
from viapoint.envs.sim.replan_triggers import TRIGGERS, DecisionEnds, Event, Trigger
from viapoint.envs.sim.replanning_episodes import OnlineEpisodes
from viapoint.envs.sim.replanning_executor import OnlineExecutor
from viapoint.envs.vector_env import METADATA, Decision, ReachVectorEnv


class OnlineReachVectorEnv(ManyStepVectorEnv):
    """Reaching for targets that jump among obstacles that move, by plans that are revised on the way, many at once.

    Arm, physics and success are those of :class:`ReachVectorEnv`. An episode is several decisions;
    each starts from what is commanded at present, ends when something happens (`decide_at`), and takes
    `info["elapsed"]` seconds. In the step that ends an episode the next one begins (same-step autoreset): its first
    observation is returned, the last of the old is in `info["final_obs"]`, its info in `info["final_info"]` and, as
    that of the other environments, at the top level.

    Args:
        num_envs: Number of environments N.
        arm: The arm that moves, a record or the name of one.
        whole_arm: Whether the links must clear the obstacles, too, or the hand alone.
        n_via: Number of via-points of an action.
        n_obstacles: An exact number, or the fewest and the most.
        moving_obstacles: Whether they move.
        n_jumps: Of the target: an exact number, or the fewest and the most.
        decide_at: What ends a decision on the way: some of `horizon`, `target`, `course`, `clearance`.
        horizon: After which a decision ends, [s].
        margin: Predicted clearance below which a decision ends, [m].
        timing: `optimal` passage times; there are no others here.
        duration_range: Shortest and longest movement, [s].
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.OnlineRewardWeights`.
        render_mode: `human`, `rgb_array` or `rgb_array_list`.
        width: Of a rendered frame, [pixels].
        height: Of a rendered frame, [pixels].
        threads: Of the simulation; 0 is one for each core. Results do not depend on it.
    """

    weights_kind = OnlineRewardWeights
    scenes: ChangingScenes | None  # type: ignore[assignment]
    observation_layout: OnlineObservationLayout

    def __init__(
        self,
        num_envs: int = 1,
        *,
        arm: Arm | str = ADULT,
        whole_arm: bool = False,
        n_via: int = 1,
        n_obstacles: int | tuple[int, int] = 0,
        moving_obstacles: bool = False,
        n_jumps: int | tuple[int, int] = 0,
        decide_at: Sequence[Trigger] = TRIGGERS,
        horizon: float = 0.3,
        margin: float = 0.02,
        timing: Timing = "optimal",
        duration_range: tuple[float, float] = (0.6, 1.2),
        reward_weights: OnlineRewardWeights | Mapping[str, float] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        threads: int = 0,
        **unknown: Any,
    ) -> None:
        refuse_unknown(unknown, type(self).__init__.__annotations__)
        kwargs: dict[str, Any] = {
            "arm": arm, "whole_arm": whole_arm, "n_via": n_via, "n_obstacles": n_obstacles, "timing": timing,
            "duration_range": duration_range, "render_mode": render_mode, "width": width, "height": height,
            "threads": threads,
        }  # fmt: skip
        super().__init__(num_envs, reward_weights=reward_weights, **kwargs)
        kwargs |= {
            "moving_obstacles": moving_obstacles, "n_jumps": n_jumps, "decide_at": decide_at, "horizon": horizon,
            "margin": margin, "reward_weights": reward_weights,
        }  # fmt: skip
        EzPickle.__init__(self, num_envs, **as_given(kwargs))
        if timing != "optimal":
            raise ValueError(f"timing must be optimal where plans are revised, got {timing!r}")
        if not isinstance(moving_obstacles, bool | np.bool_):
            raise TypeError(f"moving_obstacles must be True or False, got {moving_obstacles!r}")
        self.changes = ChangeDistribution(
            n_jumps=fewest_and_most(n_jumps, "n_jumps"), moving=bool(moving_obstacles)
        )
        """What becomes of scenes."""
        self.reviser = Reviser(self.action_layout)
        """What the components of an action mean on the way."""
        limit = (2 + self.changes.n_jumps[1]) * self.action_layout.duration_range[1] + SETTLING
        self._ends = DecisionEnds(
            self.task.collision_model, timestep=self._simulator.timestep, triggers=decide_at,
            horizon=horizon, margin=margin, time_limit=limit,
        )  # fmt: skip
        self.time_limit = float(self._ends.limit * self._simulator.timestep)
        """Of an episode, [s]."""
        self._renderer: EpisodeRenderer = EpisodeRenderer(
            self._simulator, self.render_mode, width, height, METADATA["render_fps"]
        )
        self._build()

    def _build(self) -> None:
        """Make what follows from the arguments: the observation, and what draws and carries out episodes."""
        base, action, collision_model = self.observation_layout, self.action_layout, self.task.collision_model
        self.observation_layout = OnlineObservationLayout(
            dimension=base.dimension, joint_range=base.joint_range, n_rows=base.n_rows, n_via=action.n_via,
            time_limit=self.time_limit,
        )  # fmt: skip
        self.single_observation_space = self.observation_layout.space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        shortest, longest = action.duration_range
        self._change_sampler = ChangeSampler(
            collision_model, self.changes, durations=(shortest, action.centre_duration, longest)
        )
        self._online = OnlineExecutor(self._simulator, self._beside)
        self._episodes = OnlineEpisodes(
            collision_model, self.num_envs, n_via=action.n_via, timestep=self._simulator.timestep,
            most=self._ends.limit + 1,
        )  # fmt: skip

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """The running episodes so far at every physics step; empty before the first reset."""
        if self.scenes is None:
            return ()
        return tuple(self._episodes.rollout(row, self.scenes.take([row])) for row in range(self.num_envs))

    @property
    def last_plan(self) -> Plan | None:
        """The plans under way as via-points [m] and durations [s]; None before the first decision."""
        if self.scenes is None or not self._episodes.running.begun.any():
            return None
        return Plan(*(part.copy() for part in self._episodes.plan.plan))

    @property
    def last_plans(self) -> tuple[History, ...]:
        """Every plan of the running episodes and when it began, [s]."""
        return tuple(list(history) for history in self._episodes.history)

    @property
    def default(self) -> NominalPlan:
        """What a zero action leads to, and what is commanded at present."""
        self._check_running()
        assert self.scenes is not None
        now = self._episodes
        goal = self.scenes.goals(now.time)
        return self.reviser.default(now.plan, now.plan_time, now.running.begun, self.scenes.start, goal)

    def execute_actions(self, actions: Any) -> Decision:
        """Make one decision in each environment and carry it out until it ends, without a reset.

        `terminated` tells which episodes ended; these must not be moved on.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        self._check_running()
        actions = checked_actions(actions, self.num_envs, self.action_layout.names)
        plan, kept = self.reviser.revise(self.default, self._episodes.plan, actions)
        return self._carry_out(plan, ~kept)

    def execute_plan(self, plan: Plan) -> Decision:
        """Revise every plan to this one, which begins where the hands are commanded to be, without a reset.

        Args:
            plan: Of num_envs movements with as many via-points as those of an action.
        """
        state, shape = self.default.state, self._episodes.plan.waypoints.shape
        plan = checked_plan(plan, state.position)
        if plan.waypoints.shape != shape:
            raise ValueError(f"plan must have waypoints of shape {shape}, got {plan.waypoints.shape}")
        waypoints = np.concatenate((state.position[:, None], plan.waypoints[:, 1:]), axis=1)
        moving = MovingPlan(waypoints, plan.durations.copy(), state.velocity, state.acceleration)
        return self._carry_out(moving, np.ones(self.num_envs, dtype=bool))

    def _carry_out(self, plan: MovingPlan, revised: Bool) -> Decision:
        assert self.scenes is not None
        scenes, episodes, now = self.scenes, self._episodes, self._episodes.running
        nowhere = np.zeros(self.num_envs, dtype=bool)
        before, begun, steps = episodes.outcome(scenes, nowhere), now.begun.copy(), now.steps.copy()
        self._take_up(plan, revised)
        ends = self._ends(episodes.plan, now.began, steps, scenes)
        until = np.where(now.reachable, ends.step, steps)
        for carried in self._online(episodes.plan, now.began, steps, until, scenes):
            episodes.add(scenes.take(carried.rows), carried)
        event = np.where(now.first_contact >= 0, Event.CONTACT, ends.event)
        event = np.where(now.unstable, Event.UNSTABLE, np.where(now.reachable, event, Event.REACH))
        final = ends.final & (event == Event.ARRIVAL)
        after = episodes.outcome(scenes, final)
        self.terminated = (
            final | (event == Event.TIME_LIMIT) | (event >= Event.REACH) | (event == Event.CONTACT)
        )
        elapsed = np.asarray((now.steps - steps) * self._simulator.timestep)
        terms = online_rewards(
            before, after, elapsed, self.terminated, ~begun, scenes, self.action_layout.centre_duration,
            self.task.weights,
        )  # fmt: skip
        info = {
            **after._asdict(),
            **terms.as_info(),
            "elapsed": elapsed,
            "time": episodes.time,
            "event": event,
        }
        if self.render_mode == "human" and self.terminated[0]:  # an episode is played when it is over
            self.render()
        return Decision(self._observe_start(), terms.total(), info)

    def _take_up(self, plan: MovingPlan, revised: Bool) -> None:
        """Begin new plans where some were made, as slow as the arm needs them, unless they leave its reach."""
        rows, stretch = np.flatnonzero(revised), np.ones(self.num_envs)
        if not rows.size:
            return
        some, stretch[rows], within = self._online.paced(plan.take(rows))
        plan.put(rows, some)
        self._episodes.running.reachable[rows] &= within & self._online.reachable(some)
        self._episodes.revise(plan, revised, stretch)

    def episodes_state(self) -> dict[str, Any]:
        """Where the running episodes are, beside their scenes, as arrays for :meth:`restore_episodes`."""
        return {**self._episodes.state(), "physics": self._simulator.batch.state.copy()}

    def restore_episodes(self, state: Mapping[str, Any]) -> None:
        """Go on where :meth:`episodes_state` was taken, after a reset to the same scenes."""
        self._episodes.restore(state)
        self._simulator.batch.state[:] = state["physics"]

    def _draw(  # type: ignore[override]
        self, generators: list[np.random.Generator], rows: NDArray[np.int64], options: Mapping[str, Any]
    ) -> ChangingScenes:
        """Scenes and what will become of them; where they are refused, the generators are as they were."""
        tried = [copy.deepcopy(generator) for generator in generators] if options else generators
        scene = {name: value for name, value in options.items() if name not in CHANGES}
        layout = self.task.observation
        jumps, courses = given_changes(options, len(rows), layout.dimension, layout.n_rows)
        draw = super()._draw
        scenes = draw(tried, rows, scene)
        if courses is not None:
            check_owners(courses, scenes.present)
        again = None if options else lambda some: draw(tried, rows[some], {})
        try:
            changing = self._change_sampler([tried[i] for i in rows], scenes, jumps, courses, again=again)
        except RuntimeError as error:
            raise ValueError(f"{error}; give the jumps, too") from None
        if jumps is not None or courses is not None:
            self._check_changes(changing)
        for i in rows:
            generators[i] = tried[i]
        return changing

    def _check_changes(self, scenes: ChangingScenes) -> None:
        for wrong, reason in problems_of_changes(
            scenes, self.task.collision_model, time_limit=self.time_limit
        ):
            if wrong.any():
                raise ValueError(f"scene {int(wrong.argmax())}: {reason(int(wrong.argmax()))}")

    def _start(self, rows: NDArray[np.int64], scenes: ChangingScenes) -> None:  # type: ignore[override]
        """Begin episodes: the arms at rest at the start, the obstacles where their courses begin."""
        if self.scenes is None or len(rows) == self.num_envs:
            self.scenes = scenes
        else:
            self.scenes = ChangingScenes(*(field.copy() for field in self.scenes))
            self.scenes.put(rows, scenes)
        joints = np.asarray(self.arm.inverse_kinematics(scenes.start))
        self._simulator.place(rows, joints, scenes.obstacles, scenes.present)
        self._episodes.begin(rows, scenes, joints)

    def _observe_start(self) -> Observation:
        """What is seen now."""
        assert self.scenes is not None
        episodes = self._episodes
        return self.observation_layout.online(
            episodes.running.joints, self.scenes, self.default, episodes.time
        )

    def _render_one(self, sim: int) -> Any:
        if self.render_mode is None or self.scenes is None or not self._episodes.running.steps[sim]:
            return super()._render_one(sim)
        scene = self.scenes.take([sim])
        return self._renderer.episode(
            sim, scene, self._episodes.history[sim], self._episodes.rollout(sim, scene)
        )


class OnlineReachEnv(ManyStepEnv):
    """A batch of one of :class:`OnlineReachVectorEnv`, with the same keyword arguments."""

    batch_kind: ClassVar[type[ReachVectorEnv]] = OnlineReachVectorEnv
    batch: OnlineReachVectorEnv

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.reviser = self.batch.reviser

    @property
    def last_plans(self) -> History:
        """Every plan of the episode and when it began, [s]."""
        return self.batch.last_plans[0]
