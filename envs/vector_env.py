"""Environments in which one decision is one movement."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from viapoint.envs.actions.via_points import Plan, checked_plan
from viapoint.envs.common.types import Bool, Float, Int, Observation
from viapoint.envs.common.validation import (
    as_given,
    checked_actions,
    masked_rows,
    reset_options,
    seeds_of,
    whole_number,
)
from viapoint.envs.config import EnvConfig, ViaPointConfig
from viapoint.envs.mdp.rewards import reward_terms
from viapoint.envs.rendering.renderer import RENDER_MODES, MovementRenderer
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import Execution, Executor, join_groups
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.sim.simulator import Simulator

METADATA: dict[str, Any] = {
    "render_modes": RENDER_MODES,
    "render_fps": 50,
    "autoreset_mode": AutoresetMode.SAME_STEP,
}
SINGLE_METADATA = {name: value for name, value in METADATA.items() if name != "autoreset_mode"}


class Scheduler:
    """Runner of stages on a background thread, which starts with the first job, or on the calling thread alone.

    The physics engine is C code that releases Python's global lock, so a background thread can compute references and
    outcomes in NumPy while the main thread waits for the engine. No result depends on it.
    """

    def __init__(self, threaded: bool) -> None:
        self._threaded = threaded
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, job: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run `job(*arguments)` on the background thread; jobs run one at a time in the order of submission."""
        if not self._threaded:
            return _run_now(job, *arguments)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="viapoint")
        return self._pool.submit(job, *arguments)

    def run(
        self,
        groups: Sequence[Any],
        build_references: Callable[[Any], Any],
        simulate: Callable[[Any], Any],
        measure: Callable[[Any, Any], Any],
        meanwhile: Callable[[], Any] | None = None,
    ) -> tuple[list[Any], Future[Any] | None]:
        """Run three stages over groups: `simulate` on the calling thread, the others on the background thread.

        With one group there is nothing to overlap, and all stages run on the calling thread. The independent job
        `meanwhile` may run during the physics; its future is returned with the results of the last stage.
        """
        submit = self.submit if len(groups) > 1 else _run_now
        references = [submit(build_references, group) for group in groups]
        # The physics waits for the first references only, so the independent job comes after all of them.
        following = None if meanwhile is None else self.submit(meanwhile)
        measured = [submit(measure, each.result(), simulate(each.result())) for each in references]
        return [each.result() for each in measured], following

    def close(self) -> None:
        """Stop the background thread."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _run_now(job: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Run a job on the calling thread and return its completed future."""
    done: Future[Any] = Future()
    done.set_result(job(*arguments))
    return done


class Decision(NamedTuple):
    """Results of one decision in N environments."""

    observation: Observation
    reward: Float
    info: dict[str, Any]


class ReachVectorEnv(gym.vector.VectorEnv[Any, Any, Any], EzPickle):
    """Reaching around obstacles by via-points, `num_envs` times.

    Every episode is one decision, so every step ends all episodes and starts the next ones (same-step autoreset): the
    returned observations are the first ones of the new episodes. The last observations of the old episodes are in
    `info["final_obs"]`; their info is in `info["final_info"]` and, as all episodes end together, at the top level of
    `info` too.

    Args:
        num_envs: Number of environments N.
        arm: Arm that moves, a record or its name.
        whole_arm: True if the links must clear the obstacles, too; False for the hand alone.
        n_via: Number of via-points of an action.
        n_obstacles: Number of obstacles, or the fewest and the most.
        shapes: Shapes that obstacles may have, such as `("capsule", "box")`; spheres are capsules without a length.
        timing: `optimal` passage times, or `learned` ones as part of the action.
        duration_range: Shortest and longest movement, [s].
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.mdp.rewards.RewardWeights`.
        render_mode: `human`, `rgb_array` or `rgb_array_list`.
        width: Width of a rendered frame, [pixels].
        height: Height of a rendered frame, [pixels].
        threads: Threads of the simulation; 0 for one per core. Results do not depend on it.

    Example:
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=16)
        >>> observation, _ = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(0.1 * envs.action_space.sample())
        >>> reward.shape
        (16,)
    """

    metadata = METADATA
    config_kind: ClassVar[type[EnvConfig]] = ViaPointConfig
    """Class of the keyword arguments, with their defaults."""
    __signature__ = ViaPointConfig.signature()

    def __init__(self, num_envs: int = 1, **kwargs: Any) -> None:
        self.config = config = self.config_kind.of(kwargs)
        EzPickle.__init__(self, num_envs, **as_given(kwargs))
        self.task = config.task()
        """Task of an episode: what an agent may compute with before it moves."""
        self.num_envs = whole_number("num_envs", num_envs, 1)
        threads = whole_number("threads", config.threads, 0)
        self.arm, self.action_layout = self.task.arm, self.task.action
        self.observation_layout = self.task.observation
        self._sampler = self.task.sampler()
        self._simulator = Simulator(
            self.task.collision_model,
            n_obstacles=self.observation_layout.n_rows,
            num_envs=self.num_envs,
            threads=threads,
            shapes=self.task.scenes.shapes,
        )
        self._scheduler = Scheduler(threaded=threads != 1)
        self._executor = Executor(self._simulator)
        self.generators: list[np.random.Generator] = []
        """Random generators of the environments' scenes; empty before the first reset."""
        self.scenes: Scenes | None = None
        """Scenes of the running episodes; None before the first reset."""
        self.terminated = np.ones(self.num_envs, dtype=bool)
        """True where the last step terminated the episode, shape (num_envs,)."""
        self.truncated = ~self.terminated
        """True where the last step truncated the episode, shape (num_envs,)."""
        self._last: Execution | None = None
        self.action_names = self.action_layout.names
        self.render_mode = config.render_mode
        self._renderer = MovementRenderer(
            self._simulator, self.render_mode, config.width, config.height, METADATA["render_fps"]
        )
        self._build()
        self.single_action_space = spaces.Box(-1.0, 1.0, (len(self.action_names),), np.float32)
        self.single_observation_space = self.observation_layout.space()
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _build(self) -> None:
        """Create what only a subclass has, before the spaces."""

    @property
    def model(self) -> Any:
        """MuJoCo model."""
        return self._simulator.model

    @property
    def physics_steps(self) -> int:
        """Physics steps simulated so far, all environments together."""
        return self._simulator.physics_steps

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """Last movements at every physics step, one for each environment; empty before the first."""
        return () if self._last is None else tuple(map(self._rollout, range(self.num_envs)))

    @property
    def last_plan(self) -> Plan | None:
        """Last decisions as via-points [m] and durations [s]; None before the first."""
        return None if self._last is None else self._last.plan

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: Environment i is seeded with `seed + i`, or with `seed[i]`.
            options: `start`, `goal` and `obstacles` set up a given scene, see
                :func:`~viapoint.envs.scenes.options.draw_given`; `reset_mask`, shape (num_envs,), names the
                environments to reset, all others keep their scenes.

        Raises:
            ValueError: A given scene is impossible; the environments are unchanged.
        """
        options = reset_options(options)
        rows = masked_rows(options.pop("reset_mask", None), self.num_envs, self.scenes is not None)
        generators, first_seed = self._seeded(seed, rows)
        # Nothing changes before all scenes are there: impossible ones raise an error.
        scenes = self._draw(generators, rows, options)
        self.generators = generators
        self.use_generator(generators[0], first_seed)
        if len(rows) == self.num_envs:
            self._last = None
        self._start(rows, scenes)
        return self.observe(), {}

    def use_generator(self, generator: np.random.Generator | None, seed: int | None) -> None:
        """Draw the scenes of the first environment from a generator, which was made from `seed`."""
        self._np_random, self._np_random_seed = generator, seed

    def step(self, actions: Any) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Execute one action in each environment; where an episode ends, start the next.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        rows = np.arange(self.num_envs)
        # The next scenes depend on no outcome, so they are drawn during the physics.
        decision, following = self._execute(
            self._decode(actions), lambda: self._draw(self.generators, rows, {})
        )
        assert following is not None
        self._start(rows, following.result())
        return self._as_step(decision)

    def _as_step(self, decision: Decision) -> tuple[Observation, Float, Any, Any, dict[str, Any]]:
        """Return the result of `step`: that of a decision, after which the next episodes have begun where one ended."""
        observation, reward, info = decision
        ended = self.terminated | self.truncated
        infos = dict(info)
        for name in info:
            infos[f"_{name}"] = np.ones(self.num_envs, dtype=bool)
        if ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                last[i] = {name: part[i] for name, part in observation.items()}
            final_info = {}
            for name, value in info.items():
                final_info[name] = np.where(ended, value, np.zeros_like(value))
                final_info[f"_{name}"] = ended.copy()
            infos |= {"final_obs": last, "_final_obs": ended.copy()}
            infos |= {"final_info": final_info, "_final_info": ended.copy()}
            observation = self.observe()
        return observation, reward, self.terminated.copy(), self.truncated.copy(), infos

    def state(self) -> dict[str, Any]:
        """Return scenes, random generators and counters as values and arrays for :meth:`restore`.

        Example:
            >>> import gymnasium as gym
            >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=2)
            >>> first, _ = envs.reset(seed=0)
            >>> state = envs.unwrapped.state()
            >>> _ = envs.step(envs.action_space.sample())
            >>> envs.unwrapped.restore(state)
            >>> (envs.unwrapped.observe()["goal"] == first["goal"]).all()
            np.True_
        """
        return {
            "generators": [generator.bit_generator.state for generator in self.generators],
            "scenes": self._check_running().as_options(),
            "physics_steps": self.physics_steps,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same kind and number."""
        self.reset(options=state["scenes"])
        for generator, saved in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = saved
        self._simulator.physics_steps = int(state["physics_steps"])

    def execute_actions(self, actions: Any) -> Decision:
        """Execute one movement in each environment, without a reset.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        return self._execute(self._decode(actions))[0]

    def execute_plan(self, plan: Plan) -> Decision:
        """Execute one plan in each environment, with any number of via-points, without a reset.

        Args:
            plan: Movements of all environments, from the starts to the goals.

        Raises:
            ValueError: A plan starts elsewhere.
        """
        return self._execute(checked_plan(plan, self._check_running().start))[0]

    def render(self) -> Any:
        """Render the last movement of each environment in the render mode; after a reset, the scenes."""
        if self._last is None:
            self._check_running()
        shown = 1 if self.render_mode == "human" else self.num_envs
        frames = tuple(self._render_one(sim) for sim in range(shown))
        return None if self.render_mode in (None, "human") else frames

    def close_extras(self, **kwargs: Any) -> None:
        """Stop worker threads and close the render window."""
        self._scheduler.close()
        self._renderer.close()

    def _decode(self, actions: Any) -> Plan:
        """Stage 1: return the movements that actions stand for."""
        scenes = self._check_running()
        actions = checked_actions(actions, self.num_envs, self.action_names)
        return self.action_layout.decode(actions, scenes.start, scenes.goal)

    def _execute(
        self, plan: Plan, meanwhile: Callable[[], Scenes] | None = None
    ) -> tuple[Decision, Future[Scenes] | None]:
        """Stages 2 to 7: scale time, build references, simulate, measure, score and observe.

        The job `meanwhile` runs during the physics; its future is returned.
        """
        stages, scenes = self._executor, self._check_running()
        scaled = stages.scale_time(scenes, plan)
        groups, following = self._scheduler.run(
            scaled.groups(), stages.build_references, stages.simulate, stages.measure, meanwhile
        )
        self._last = execution = join_groups(scenes, plan, groups)
        self.scenes = None
        terms = reward_terms(execution.outcome, self.action_layout.centre_duration, self.task.weights)
        reward, info = terms.total(), {**execution.outcome._asdict(), **terms.as_info()}
        hand = np.asarray(self.arm.hand_position(execution.joints))
        observation = self.observation_layout.observe(execution.joints, hand, execution.scenes)
        if self.render_mode == "human":
            self.render()
        return Decision(observation, reward, info), following

    def _render_one(self, sim: int) -> Any:
        if self.render_mode is None:
            gym.logger.warn(
                f"render() does nothing without a render_mode; choose one of {', '.join(RENDER_MODES)}"
            )
            return None
        if self._last is None or (self.scenes is not None and self.num_envs == 1):
            assert self.scenes is not None
            return self._renderer.still(self.scenes.take([sim]))
        scenes, plan = self._last.scenes.take([sim]), self._last.plan.take([sim])
        return self._renderer.movement(scenes, plan, self._rollout(sim))

    def _rollout(self, sim: int) -> Rollout:
        """Return the movement of one environment at every physics step."""
        scene, planned, joints, contact = self._recorded(sim)
        hand = np.asarray(self.arm.hand_position(joints))
        time = np.asarray(np.arange(1, len(joints) + 1) * self._simulator.timestep)
        clearance = self._clearance(scene, hand, joints, time)
        return Rollout(time, planned, joints, hand, contact, clearance)

    def _recorded(self, sim: int) -> tuple[Any, Float, Float, Bool]:
        """Return the scene of one environment, and planned positions, joint angles and contacts of its movement."""
        assert self._last is not None
        return self._last.scenes.take([sim]), *self._executor.recorded(self._last, sim)

    def _clearance(self, scene: Any, hand: Float, joints: Float, time: Float) -> Float:
        """Return the clearance in one scene at each time, shape (T,), [m]."""
        obstacles, present = (np.repeat(part, len(time), axis=0) for part in (scene.obstacles, scene.present))
        return self.task.collision_model.least_clearance(hand[:, None], obstacles, present, joints[:, None])

    def _check_running(self) -> Scenes:
        if self.scenes is None:
            raise gym.error.ResetNeeded("the episodes are over or have not begun: call reset() before step()")
        return self.scenes

    def _seeded(
        self, seed: int | Sequence[int | None] | None, rows: Int
    ) -> tuple[list[np.random.Generator], int | None]:
        """Return the generators of the next episodes, new where a seed is given, and the seed of the first."""
        seeds, first_seed = seeds_of(seed, self.num_envs), self._np_random_seed
        generators: list[Any] = list(self.generators) or [None] * self.num_envs
        generators[0] = self._np_random
        for i in rows:
            if generators[i] is None or seeds[i] is not None:
                generators[i], used = seeding.np_random(seeds[i])
                first_seed = used if i == 0 else first_seed
        return generators, first_seed

    def _draw(self, generators: list[np.random.Generator], rows: Int, options: Mapping[str, Any]) -> Scenes:
        """Sample or set up scenes for some environments; if one is refused, the generators are unchanged."""
        if not options:
            return self._sampler([generators[i] for i in rows])
        tried = [copy.deepcopy(generators[i]) for i in rows]
        scenes = draw_given(options, self._sampler, tried, self.observation_layout.n_rows)
        for i, generator in zip(rows, tried, strict=True):
            generators[i] = generator
        return scenes

    def _start(self, rows: Int, scenes: Scenes) -> Float:
        """Start episodes with the arms at rest at the start and the obstacles in place; return the joint angles."""
        if self.scenes is None or len(rows) == self.num_envs:
            self.scenes = scenes
        else:
            self.scenes = type(scenes)(*(field.copy() for field in self.scenes))
            self.scenes.put(rows, scenes)
        joints = np.asarray(self.arm.inverse_kinematics(scenes.start))
        self._simulator.place(rows, joints, scenes.obstacles, scenes.present)
        return joints

    def observe(self) -> Observation:
        """Return the present observations."""
        assert self.scenes is not None
        joints = np.asarray(self.arm.inverse_kinematics(self.scenes.start))
        return self.observation_layout.observe(joints, self.scenes.start, self.scenes)


class ReachEnv(gym.Env[Any, Any], EzPickle):
    """One environment of a :class:`ReachVectorEnv`, with the same keyword arguments.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> type(env.unwrapped).__name__
        'ReachEnv'
    """

    metadata = SINGLE_METADATA
    batch_kind: ClassVar[type[ReachVectorEnv]] = ReachVectorEnv
    """Vector environment class that this environment wraps."""

    def __init__(self, *, threads: int = 1, **kwargs: Any) -> None:
        EzPickle.__init__(self, threads=threads, **as_given(kwargs))
        self.batch = self.batch_kind(1, threads=threads, **kwargs)
        """Vector environment with one environment."""
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.render_mode = self.batch.render_mode
        self.task = self.batch.task
        self.action_layout = self.batch.action_layout
        self.observation_layout = self.batch.observation_layout
        self._over = True

    @property
    def last_rollout(self) -> Rollout | None:
        """Last movement at every physics step; None before the first."""
        rollouts = self.batch.last_rollout
        return rollouts[0] if rollouts else None

    @property
    def last_plan(self) -> Plan | None:
        """Last decision as via-points (K + 2, D) [m] and durations (K + 1,) [s]; None before the first."""
        plan = self.batch.last_plan
        return None if plan is None else plan.take(0)

    @property
    def model(self) -> Any:
        """MuJoCo model."""
        return self.batch.model

    @property
    def physics_steps(self) -> int:
        """Physics steps simulated so far."""
        return self.batch.physics_steps

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; see :meth:`ReachVectorEnv.reset`."""
        self.batch.use_generator(self._np_random, self._np_random_seed)
        observation, info = self.batch.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.batch.np_random, self.batch.np_random_seed
        self._over = False
        if self.render_mode == "human":
            self.batch.render()
        return {name: part[0] for name, part in observation.items()}, info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one action, see :meth:`ReachVectorEnv.step`; where it is a movement, it ends the episode.

        Args:
            action: Shape (m,), in [-1, 1]; components beyond are clipped.
        """
        if self._over:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        observation, reward, info = self.batch.execute_actions([action])
        terminated, truncated = bool(self.batch.terminated[0]), bool(self.batch.truncated[0])
        self._over = terminated or truncated
        seen = {name: part[0] for name, part in observation.items()}
        values = {name: value[0].item() for name, value in info.items()}
        return seen, float(reward[0]), terminated, truncated, values

    def render(self) -> Any:
        """Render the last movement in the render mode; after a reset, the scene."""
        frames = self.batch.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Stop worker threads and close the render window."""
        self.batch.close()
