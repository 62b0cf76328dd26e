"""The environment: one decision, one movement, many at once."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import ActionLayout, Plan, Timing, checked_plan
from viapoint.envs.arms import ADULT, Arm, arm_of
from viapoint.envs.common.background_worker import BackgroundWorker
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.common.validation import (
    as_given,
    checked_actions,
    fewest_and_most,
    masked_rows,
    refuse_unknown,
    reset_options,
    seeds_of,
    whole_number,
)
from viapoint.envs.mdp.rewards import RewardWeights, reward_terms
from viapoint.envs.mdp.task import Task, distribution_of
from viapoint.envs.rendering.renderer import MovementRenderer, check_render_mode
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import Executor, PendingExecution, Rollout
from viapoint.envs.sim.outcome import Outcome
from viapoint.envs.sim.simulator import Simulator

Weights = RewardWeights | Mapping[str, float] | None

METADATA: dict[str, Any] = {
    "render_modes": ["human", "rgb_array", "rgb_array_list"],
    "render_fps": 50,
    "autoreset_mode": AutoresetMode.SAME_STEP,
}


class Decision(NamedTuple):
    """What one decision of N environments led to."""

    observation: Observation
    reward: Float
    info: dict[str, Any]


class ReachVectorEnv(gym.vector.VectorEnv[Any, Any, Any], EzPickle):
    """Reaching around obstacles by via-points, `num_envs` times.

    Every episode is one decision, so every step ends all episodes and starts the next ones (same-step autoreset): the
    returned observations are the new episodes' first ones, the last ones of the old are in `info["final_obs"]`, their
    info in `info["final_info"]` and, as all end together, at the top level of `info` too.

    Args:
        num_envs: Number of environments N.
        arm: The arm that moves, a record or the name of one.
        whole_arm: Whether the links must clear the obstacles, too, or the hand alone.
        n_via: Number of via-points of an action.
        n_obstacles: An exact number, or the fewest and the most.
        timing: `optimal` passage times, or `learned` ones as part of the action.
        duration_range: Shortest and longest movement, [s].
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.RewardWeights`.
        render_mode: `human`, `rgb_array` or `rgb_array_list`.
        width: Of a rendered frame, [pixels].
        height: Of a rendered frame, [pixels].
        threads: Of the simulation; 0 is one for each core. Results do not depend on it.
    """

    metadata = METADATA
    weights_kind: ClassVar[type[RewardWeights]] = RewardWeights
    """What weighs the terms of the reward."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        arm: Arm | str = ADULT,
        whole_arm: bool = False,
        n_via: int = 1,
        n_obstacles: int | tuple[int, int] = (1, 5),
        timing: Timing = "optimal",
        duration_range: tuple[float, float] = (0.6, 1.2),
        reward_weights: Weights = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        threads: int = 0,
        **unknown: Any,
    ) -> None:
        refuse_unknown(unknown, type(self).__init__.__annotations__)
        EzPickle.__init__(self, num_envs, **as_given({
            "arm": arm, "whole_arm": whole_arm, "n_via": n_via, "n_obstacles": n_obstacles, "timing": timing,
            "duration_range": duration_range, "reward_weights": reward_weights, "render_mode": render_mode,
            "width": width, "height": height, "threads": threads,
        }))  # fmt: skip
        arm = arm_of(arm)
        if not isinstance(whole_arm, bool | np.bool_):
            raise TypeError(f"whole_arm must be True or False, got {whole_arm!r}")
        self.num_envs = whole_number("num_envs", num_envs, 1)
        threads = whole_number("threads", threads, 0)
        self.task = Task(
            arm=arm,
            whole_arm=bool(whole_arm),
            action=ActionLayout(
                dimension=arm.dimension, n_via=n_via, timing=timing, duration_range=duration_range
            ),
            weights=self.weights_kind.of(reward_weights),
            scenes=distribution_of(arm)(n_obstacles=fewest_and_most(n_obstacles)),
        )
        """What an agent may compute with before it has moved."""
        self.arm, self.action_layout, self.observation_layout = arm, self.task.action, self.task.observation
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.action_layout.size,), np.float32)
        self.single_observation_space = self.observation_layout.space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._sampler = self.task.sampler()
        self._simulator = Simulator(
            self.task.collision_model,
            n_obstacles=self.observation_layout.n_rows,
            num_envs=self.num_envs,
            threads=threads,
        )
        self._beside = BackgroundWorker(threaded=threads != 1)
        self._executor = Executor(self._simulator, self._beside)
        self._generators: list[np.random.Generator] = []
        self.scenes: Scenes | None = None
        """The scenes of the running episodes; None before the first reset."""
        self._last: tuple[Scenes, Plan, Outcome] | None = None
        self.render_mode = check_render_mode(render_mode, METADATA["render_modes"])
        self._renderer = MovementRenderer(self._simulator, render_mode, width, height, METADATA["render_fps"])

    @property
    def model(self) -> Any:
        """The MuJoCo model."""
        return self._simulator.model

    @property
    def physics_steps(self) -> int:
        """Physics steps simulated so far, all environments together."""
        return self._simulator.physics_steps

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """The last movements at every physics step, one for each environment; empty before the first."""
        if self._last is None:
            return ()
        return tuple(self._executor.rollout(sim, self._last[0]) for sim in range(self.num_envs))

    @property
    def last_plan(self) -> Plan | None:
        """The last decision as via-points [m] and durations [s]; None before the first."""
        return None if self._last is None else self._last[1]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: Environment i is seeded with `seed + i`, or with `seed[i]`.
            options: `start`, `goal` and `obstacles` set up a given scene, see
                :func:`~viapoint.envs.scenes.options.given_scenes`; `reset_mask`, shape (num_envs,), names the
                environments to reset, all others keep their scenes.

        Raises:
            ValueError: A given scene is impossible; nothing has changed then.
        """
        options = reset_options(options)
        rows = masked_rows(options.pop("reset_mask", None), self.num_envs, self.scenes is not None)
        seeded, first_seed = self._seeded(seed, rows)
        scenes = self._draw(seeded, rows, options)
        self._generators, self._np_random, self._np_random_seed = seeded, seeded[0], first_seed
        self._last = self._last if len(rows) < self.num_envs else None
        self._start(rows, scenes)
        return self._observe_start(), {}

    def step(self, actions: Any) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Carry out one movement in each environment and start the next episodes.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        rows, everyone = np.arange(self.num_envs), np.ones(self.num_envs, dtype=bool)
        prepared = self._prepare(self._decoded(actions))
        # The next scenes are drawn beside the physics, which waits for nothing but the first references.
        following = self._beside.submit(self._draw, self._generators, rows, {})
        observation, reward, info = self._conclude(prepared)
        final = np.empty(self.num_envs, dtype=object)
        final[:] = [{name: part[i] for name, part in observation.items()} for i in range(self.num_envs)]
        masked = {**info, **{f"_{name}": everyone.copy() for name in info}}
        infos = {
            **masked,
            "final_obs": final,
            "_final_obs": everyone.copy(),
            "final_info": {name: value.copy() for name, value in masked.items()},
            "_final_info": everyone.copy(),
        }
        self._start(rows, following.result())
        return self._observe_start(), reward, everyone, ~everyone, infos

    def execute_actions(self, actions: Any) -> Decision:
        """Carry out one movement in each environment: the flow from action to reward, without a reset.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        return self._conclude(self._prepare(self._decoded(actions)))

    def execute_plan(self, plan: Plan) -> Decision:
        """Carry out one plan in each environment, with any number of via-points, without a reset.

        Args:
            plan: Of num_envs movements, from the starts to the goals; one that starts elsewhere is refused.
        """
        return self._conclude(self._prepare(checked_plan(plan, self._check_running().start)))

    def render(self) -> Any:
        """The last movement of each environment as the render mode says; after a reset, the scenes."""
        if self._last is None:
            self._check_running()
        shown = 1 if self.render_mode == "human" else self.num_envs
        frames = tuple(self._render_one(sim) for sim in range(shown))
        return None if self.render_mode in (None, "human") else frames

    def close_extras(self, **kwargs: Any) -> None:
        """Let threads and windows go."""
        self._beside.close()
        self._renderer.close()

    def _render_one(self, sim: int) -> Any:
        if self.render_mode is None:
            modes = ", ".join(METADATA["render_modes"])
            gym.logger.warn(f"render() does nothing without a render_mode; choose one of {modes}")
            return None
        if self._last is None or (self.scenes is not None and self.num_envs == 1):
            assert self.scenes is not None
            return self._renderer.still(sim, self.scenes.take([sim]))
        scenes, plan, _ = self._last
        rollout = self._executor.rollout(sim, scenes)
        return self._renderer.movement(sim, scenes.take([sim]), plan.take([sim]), rollout)

    def _decoded(self, actions: Any) -> Plan:
        scenes = self._check_running()
        actions = checked_actions(actions, self.num_envs, self.action_layout.names)
        return self.action_layout.decode(actions, scenes.start, scenes.goal)

    def _prepare(self, plan: Plan) -> PendingExecution:
        assert self.scenes is not None
        return self._executor.prepare(plan, self.scenes)

    def _conclude(self, prepared: PendingExecution) -> Decision:
        outcome, scenes = self._executor.execute(prepared), prepared.scenes
        terms = reward_terms(outcome, self.action_layout.centre_duration, self.task.weights)
        joints = self._executor.final_joints
        observation = self.observation_layout.observe(
            joints, np.asarray(self.arm.hand_position(joints)), scenes
        )
        self._last, self.scenes = (scenes, prepared.plan, outcome), None
        if self.render_mode == "human":
            self.render()
        return Decision(observation, terms.total(), {**outcome._asdict(), **terms.as_info()})

    def _check_running(self) -> Scenes:
        if self.scenes is None:
            raise gym.error.ResetNeeded("the episodes are over or have not begun: call reset() before step()")
        return self.scenes

    def _seeded(
        self, seed: int | Sequence[int | None] | None, rows: NDArray[np.int64]
    ) -> tuple[list[np.random.Generator], int | None]:
        """Generators for the next episodes, new where a seed is given, and the seed of the first, `np_random`."""
        seeds, first_seed = seeds_of(seed, self.num_envs), self._np_random_seed
        generators: list[Any] = list(self._generators) or [None] * self.num_envs
        generators[0] = self._np_random
        for i in rows:
            if generators[i] is None or seeds[i] is not None:
                generators[i], used = seeding.np_random(seeds[i])
                first_seed = used if i == 0 else first_seed
        return generators, first_seed

    def _draw(
        self, generators: list[np.random.Generator], rows: NDArray[np.int64], options: Mapping[str, Any]
    ) -> Scenes:
        """Scenes for some environments, sampled or given; where one is refused, the generators are as they were."""
        if not options:
            return self._sampler([generators[i] for i in rows])
        tried = [copy.deepcopy(generators[i]) for i in rows]
        scenes = draw_given(options, self._sampler, tried, self.observation_layout.n_rows)
        for i, generator in zip(rows, tried, strict=True):
            generators[i] = generator
        return scenes

    def _start(self, rows: NDArray[np.int64], scenes: Scenes) -> None:
        """Begin episodes: the arms at rest at the start, the obstacles in place."""
        if self.scenes is None or len(rows) == self.num_envs:
            self.scenes = scenes
        else:
            self.scenes = Scenes(*(field.copy() for field in self.scenes))
            self.scenes.put(rows, scenes)
        joints = np.asarray(self.arm.inverse_kinematics(scenes.start))
        self._simulator.place(rows, joints, scenes.obstacles, scenes.present)

    def _observe_start(self) -> Observation:
        assert self.scenes is not None
        joints = np.asarray(self.arm.inverse_kinematics(self.scenes.start))
        return self.observation_layout.observe(joints, self.scenes.start, self.scenes)
