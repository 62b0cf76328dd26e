"""The environment: reaching around obstacles, N times and once."""

from __future__ import annotations

import copy
import inspect
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from viapoint.envs.arms.inverse_kinematics import nearest_goals
from viapoint.envs.common.arrays import Bool, Float, Int, Observation, as_dict, from_dict
from viapoint.envs.common.validation import did_you_mean, finite_array, masked_rows, seeds_of, whole_number
from viapoint.envs.episodes import Decision, Episodes, History
from viapoint.envs.geometry.obstacles import geom_meshes
from viapoint.envs.outcome import Rollout
from viapoint.envs.plans import Plan
from viapoint.envs.renderer import RENDER_MODES, EpisodeRenderer
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.scenes.scene import Scenes, check_end
from viapoint.envs.task import Task

SINGLE_METADATA: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 50}
LEAST_SHARE = 4  # Fewest environments for which a thread is worth its while

OF_STATES = ("space_name", "n_via", "timing", "decide_at", "n_obstacles", "shapes")
"""Fields of a task in which environments must agree to continue from the state of one another."""


class ReachVectorEnv(gym.vector.VectorEnv[Any, Any, Any], EzPickle):
    """Reaching around obstacles by via-points, `num_envs` times.

    When an episode ends, the next one begins as `autoreset_mode` says. With same-step autoreset, the default, the
    returned observation is the first one of the new episode; the last one of the old is in `info["final_obs"]`, and its
    info in `info["final_info"]` and, as that of the other environments, at the top level of `info`.

    Args:
        num_envs: Number of environments N.
        arm: Arm that moves, a record or its name.
        space: Space in which movements are planned: `hand` or `joints`; by default that of the arm.
        n_via: Number of via-points of an action.
        timing: `optimal` passage times, or `learned` ones as part of the action.
        duration_range: Shortest and longest movement: in hand space [s], in joint space multiples of the shortest
            movement that the velocity limits allow.
        via_range: Factor on the largest offsets of via-points from the straight line.
        n_obstacles: Number of obstacles, or the fewest and the most; families that are furniture may have fewer.
        shapes: Shapes that obstacles may have; by default cylinders and boxes in the plane, all but meshes and point
            clouds in space.
        families: Names of scene families that are drawn; by default those of training. A repeated name is drawn more
            often.
        whole_arm: True if obstacles in the plane are so tall that the links must clear them, too.
        moving_obstacles: True if the obstacles move.
        courses: Courses of these: `turns`, constant velocities that change at most once, or `reaches`, each a
            minimum-jerk reach of its own, like that of another hand.
        n_jumps: Number of jumps of the target, or the fewest and the most.
        decide_at: `end`, one decision for a movement; `steps`, a velocity in every control step; or events that end a
            decision before the goal, some of `horizon`, `target`, `course`, `clearance`, `sight`.
        horizon: Time after which a decision ends, [s].
        margin: Predicted clearance below which a decision ends, [m].
        control_step: Time for which an action holds with `decide_at="steps"`, [s].
        reward_weights: Some or all of the weights of :class:`~viapoint.envs.rewards.RewardWeights`.
        sensor: Sensor whose readings are observed in place of the obstacles: `rays`, `camera`, `hand_rays`,
            `hand_camera`, a :class:`~viapoint.envs.sensors.Sensor` or a mapping of its fields.
        autoreset_mode: `SameStep`, `NextStep` or `Disabled`.
        render_mode: `human`, `rgb_array` or `rgb_array_list`.
        width: Width of a rendered frame, [pixels].
        height: Height of a rendered frame, [pixels].
        threads: Threads of the simulation; 0 for one per core. Results do not depend on it.
        max_episode_steps: Number of decisions after which an episode is truncated; None for no such limit. Gymnasium
            passes that of a registered id.

    Example:
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=16)
        >>> observation, _ = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(0.1 * envs.action_space.sample())
        >>> reward.shape
        (16,)
    """

    metadata = {**SINGLE_METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        threads: int = 0,
        max_episode_steps: int | None = None,
        **task: Any,
    ) -> None:
        for name, value in task.items():
            if isinstance(value, Mapping | list):  # the caller may change it later
                task[name] = copy.copy(value)
        pictures = {"render_mode": render_mode, "width": width, "height": height}
        ends = {"autoreset_mode": autoreset_mode, "max_episode_steps": max_episode_steps}
        EzPickle.__init__(self, num_envs, threads=threads, **pictures, **ends, **task)
        known = inspect.signature(Task.of).parameters
        for name in task:
            if name not in known:
                told = f"{name!r}; arguments are {', '.join(known)}{did_you_mean(name, known)}"
                raise TypeError(f"{type(self).__name__} got an unexpected keyword argument {told}")
        self.task = Task.of(**task)
        """Task of an episode: what an agent may compute with before it moves."""
        self.num_envs = whole_number("num_envs", num_envs, 1)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode must be one of {modes}, got {autoreset_mode!r}") from None
        self.metadata = {**SINGLE_METADATA, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self._limit = math.inf
        if max_episode_steps is not None:
            self._limit = whole_number("max_episode_steps", max_episode_steps, 1)
        n_threads = whole_number("threads", threads, 0) or os.cpu_count() or 1
        n_threads = max(min(n_threads, self.num_envs // LEAST_SHARE), 1)
        self._shares = np.array_split(np.arange(self.num_envs), n_threads)
        self._episodes = [Episodes(self.task, len(share)) for share in self._shares]
        # Running episodes of each environment, and their row
        self._rows = [(each, row) for each in self._episodes for row in range(len(each.begun))]
        look = render_mode, width, height, SINGLE_METADATA["render_fps"]
        self._renderers = [EpisodeRenderer(each, row, *look) for each, row in self._rows]
        self._pool: ThreadPoolExecutor | None = None
        self._process = os.getpid()  # of the pool, whose threads do not survive a fork
        self.generators: list[np.random.Generator] = []
        """Random generators of the environments' scenes; empty before the first reset."""
        self._running = False
        self._over = np.zeros(self.num_envs, bool)
        self._decisions = np.zeros(self.num_envs, np.int64)  # of the running episodes
        self.terminated = np.zeros(self.num_envs, bool)
        """True where the last step terminated the episode, shape (num_envs,)."""
        self.truncated = np.zeros(self.num_envs, bool)
        """True where the last step truncated the episode, shape (num_envs,)."""
        self.action_names = self.task.action_names
        self.single_action_space = spaces.Box(-1.0, 1.0, (len(self.action_names),), np.float32)
        self.single_observation_space = self.task.observation.space()
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    # What happened

    @property
    def model(self) -> Any:
        """MuJoCo model."""
        return self._episodes[0].simulator.model

    @property
    def physics_steps(self) -> int:
        """Physics steps simulated so far, all environments together."""
        return sum(each.simulator.physics_steps for each in self._episodes)

    @property
    def scenes(self) -> Scenes | None:
        """Scenes of the running episodes; None before the first reset."""
        if not self._running:
            return None
        return Scenes.together([each.scenes for each in self._episodes])

    @property
    def last_rollout(self) -> tuple[Rollout, ...]:
        """Last movements at every physics step, one for each environment; empty before the first reset."""
        if not self._running:
            return ()
        return tuple(each.recorded(row).rollout for each, row in self._rows)

    @property
    def last_plan(self) -> Plan | None:
        """Last decisions as via-points and durations; None before the first, and where the arm is steered."""
        plans = [each.last_plan for each in self._episodes if each.last_plan is not None]
        if len(plans) < len(self._episodes):
            return None
        return Plan(*map(_together, zip(*plans, strict=True)))

    @property
    def last_plans(self) -> tuple[History, ...]:
        """All plans of the running episodes with the times at which they began, [s]."""
        return tuple(list(each.history[row]) for each, row in self._rows)

    # Episodes

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: Environment i is seeded with `seed + i`, or with `seed[i]`.
            options: `start`, `goal` and `obstacles` set up a given scene, see
                `viapoint.envs.scenes.options.draw_given`; `reset_mask`, shape (num_envs,), names the
                environments to reset, all others keep their episodes.

        Raises:
            ValueError: A given scene is impossible, such as a goal in contact, see
                `viapoint.envs.scenes.scene.check_scenes`; the environments are unchanged.
        """
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(f"options must be a mapping from names to values, or None, got {options!r}")
        options = dict(options or {})
        rows = masked_rows(options.pop("reset_mask", None), self.num_envs, self._running)
        generators, first_seed = self._seeded(seed, rows)
        # Nothing changes before all scenes are there: impossible ones raise an error.
        tried = [copy.deepcopy(generators[i]) for i in rows]
        scenes = draw_given(options, self._episodes[0].sampler, tried)
        geom_meshes(scenes.obstacles, self.task.shapes)
        for i, generator in zip(rows, tried, strict=True):
            generators[i] = generator
        self.generators = generators
        self._np_random, self._np_random_seed = generators[0], first_seed
        self._start(rows, scenes)
        if self.render_mode == "human":
            self._renderers[0].render()
        return self.observe(), {}

    def use_generator(self, generator: np.random.Generator | None, seed: int | None) -> None:
        """Draw the scenes of the first environment from a generator, which was made from `seed`."""
        self._np_random, self._np_random_seed = generator, seed

    def step(self, actions: Any) -> tuple[Observation, Float, Bool, Bool, dict[str, Any]]:
        """Make one decision in each environment; where an episode ends, the next begins as `autoreset_mode` says.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
        """
        self._check_running()
        over = self._over
        if self.autoreset_mode == AutoresetMode.DISABLED and over.any():
            raise gym.error.ResetNeeded(
                f"episode {int(over.argmax())} is over: call reset(options={{'reset_mask': ...}}) before step()"
            )
        decision = self._decide(actions, ~over)
        observation, info = decision.observation, decision.info
        if over.any():  # with next-step autoreset, the next episodes begin instead
            self._restart(over)
            for part in (decision.reward, self.terminated, self.truncated, *info.values()):
                part[over] = 0
            observation = self.observe()
        self._show()
        self._over = ended = self.terminated | self.truncated
        infos = {**info, **_masks(info, ~over)}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            self._over = np.zeros(self.num_envs, bool)
            self._restart(ended)
            last = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                last[i] = {name: part[i] for name, part in observation.items()}
            final = {name: np.where(ended, value, np.zeros_like(value)) for name, value in info.items()}
            finals = {"final_obs": last, "final_info": {**final, **_masks(final, ended)}}
            infos |= {**finals, **_masks(finals, ended)}
            observation = self.observe()
        return observation, decision.reward, self.terminated.copy(), self.truncated.copy(), infos

    def begin(self, scenes: Scenes) -> Observation:
        """Start scenes that were drawn or checked before, one in each environment, and return first observations."""
        self._start(np.arange(self.num_envs), scenes)
        return self.observe()

    def execute_actions(self, actions: Any, active: Bool | None = None) -> Decision:
        """Make one decision in each environment and execute it until it ends, without a reset.

        `terminated` and `truncated` tell which episodes ended; these must not be continued.

        Args:
            actions: Shape (num_envs, m), in [-1, 1]; components beyond are clipped.
            active: True for environments that take part, shape (num_envs,); by default all. Results of others mean
                nothing.
        """
        self._check_running()
        decision = self._decide(actions, np.ones(self.num_envs, bool) if active is None else active)
        self._show()
        return decision

    def execute_plan(self, plan: Plan) -> Decision:
        """Execute one plan in each environment, without a reset.

        Args:
            plan: Movements of all environments, from the present references to the goals.

        Raises:
            ValueError: A plan begins elsewhere, or has another number of via-points where plans are revised.
            TypeError: The task has no plans.
            gymnasium.error.ResetNeeded: An episode is over.
        """
        self._check_running()
        if self._over.any():
            raise gym.error.ResetNeeded(
                f"episode {int(self._over.argmax())} is over: call reset() before another plan"
            )
        if self.task.stepwise:
            raise TypeError("an action steers the arm for one control step; plans need another decide_at")
        number, dimension = self.num_envs, self.task.space.dimension
        waypoints = finite_array("waypoints of the plan", plan.waypoints, (number, None, dimension))
        durations = finite_array("durations of the plan", plan.durations, (number, waypoints.shape[1] - 1))
        if (durations <= 0.0).any():
            raise ValueError(f"durations of the plan must be positive, got {durations.min()}")
        # Nothing moves before all plans are checked.
        plans = {}
        for episodes, share in zip(self._episodes, self._shares, strict=True):
            plans[episodes] = episodes.plan_from_here(waypoints[share], durations[share])
        parts = self._each(lambda episodes, _: episodes.execute(plans[episodes]))
        return self._joined(parts, np.ones(self.num_envs, bool))

    def move_goals(self, goals: Any) -> Observation:
        """Move the targets of the running episodes, which jump no more, and return the new observations.

        The next decision revises the plans without a jump of position, velocity or acceleration.

        Args:
            goals: New targets, shape (num_envs, 2) [m] in hand space, (num_envs, J) [rad] in joint space.

        Raises:
            ValueError: A target is out of reach, or the arm would touch itself or an obstacle where it is now; the
                episodes are unchanged.
        """
        self._check_running()
        space = self.task.space
        goals = finite_array("goals", goals, (self.num_envs, space.dimension))
        if self.task.space_name == "joints":
            now_at = np.concatenate([each.metrics.joints for each in self._episodes])
            goals = nearest_goals(self.task.arm, goals, now_at)
        inside = space.inside(goals)
        if not inside.all():
            row = int(inside.argmin())
            raise ValueError(f"goals must be within the arm's reach, got {goals[row].tolist()} in row {row}")
        joints = space.joints(goals)
        now = np.concatenate([each.time for each in self._episodes])
        obstacles = Scenes.together([each.scenes for each in self._episodes]).obstacles_at(now)
        check_end(self.task.arm, "goal", joints, obstacles, np.ones(self.num_envs, bool))
        for episodes, share in zip(self._episodes, self._shares, strict=True):
            episodes.scenes.goal[:] = joints[share]
            episodes.scenes.jumps[:] = 0.0
        return self.observe()

    def observe(self) -> Observation:
        """Return the present observations."""
        return _together([each.observe() for each in self._episodes])  # type: ignore[no-any-return]

    def state(self) -> dict[str, Any]:
        """Return scenes, random generators and running episodes as values and arrays for :meth:`restore`.

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
        self._check_running()
        return {
            "task": {name: str(getattr(self.task, name)) for name in OF_STATES},
            "generators": [generator.bit_generator.state for generator in self.generators],
            "scenes": as_dict(self.scenes),
            "episodes": _together([each.state() for each in self._episodes]),
            "physics_steps": self.physics_steps,
            "over": self._over.copy(),
            "decisions": self._decisions.copy(),
            "ended": np.stack((self.terminated, self.truncated)),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same task and number, whatever its number of threads was.

        Raises:
            ValueError: The state is one of another task, or of another number of environments or joints.
        """
        for name, value in state.get("task", {}).items():
            own = str(getattr(self.task, name))
            if own != value:
                raise ValueError(f"state must be one of a task with {name} {own}, got {value}")
        number, joints = np.shape(state["scenes"]["start"])
        if (number, joints) != (self.num_envs, len(self.task.arm.home)):
            raise ValueError(
                f"state must be one of {self.num_envs} environments of {len(self.task.arm.home)} joints, got one of "
                f"{number} environments of {joints} joints"
            )
        if not self.generators:
            self.generators = [np.random.default_rng() for _ in range(self.num_envs)]
            self.np_random = self.generators[0]  # which has no seed
        for generator, place in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = place
        scenes = from_dict(self._episodes[0].scenes, state["scenes"])
        for each, share in zip(self._episodes, self._shares, strict=True):
            each.restore(_taken(state["episodes"], share), scenes.take(share))
            each.simulator.physics_steps = 0
        self._episodes[0].simulator.physics_steps = int(state["physics_steps"])
        self._over[:] = state["over"]
        self._decisions[:] = state["decisions"]
        self.terminated, self.truncated = np.array(state["ended"])
        self._running = True

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle holds: the arguments, and the running episodes."""
        return {**EzPickle.__getstate__(self), "running": self.state() if self._running else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue the running episodes of a pickle."""
        running = state.pop("running", None)
        EzPickle.__setstate__(self, state)
        if running is not None:
            self.restore(running)

    def render(self) -> Any:
        """Render the last movement of each environment in the render mode; after a reset, the scenes."""
        self._check_running()
        if self.render_mode is None:
            modes = ", ".join(RENDER_MODES)
            gym.logger.warn(f"render() does nothing without a render_mode; choose one of {modes}")
            return None
        if self.render_mode == "human":
            self._renderers[0].render()
            return None
        return tuple(renderer.render() for renderer in self._renderers)

    def _show(self) -> None:
        """Show a whole episode in the window."""
        if self.render_mode == "human" and (self.terminated | self.truncated)[0]:
            self._renderers[0].render()

    def close_extras(self, **kwargs: Any) -> None:
        """Stop worker threads and close windows."""
        for renderer in self._renderers:
            renderer.close()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    # Inside

    def _each(self, job: Callable[[Episodes, Int], Any]) -> list[Any]:
        """Return the results of a job for the episodes of each thread, which run side by side."""
        if len(self._shares) == 1:
            return [job(self._episodes[0], self._shares[0])]
        if self._pool is None or self._process != os.getpid():  # threads do not survive a fork
            self._process = os.getpid()
            self._pool = ThreadPoolExecutor(len(self._shares), thread_name_prefix="viapoint")
        return list(self._pool.map(job, self._episodes, self._shares))

    def _decide(self, actions: Any, active: Bool) -> Decision:
        """Make one decision in some environments; results of others mean nothing."""
        name = f"actions of all environments ({', '.join(self.action_names)})"
        actions = finite_array(name, actions, (self.num_envs, len(self.action_names)))
        actions = np.clip(actions, -1.0, 1.0)
        parts = self._each(lambda episodes, share: episodes.decide(actions[share], active[share]))
        return self._joined(parts, active)

    def _joined(self, parts: list[Decision], active: Bool) -> Decision:
        """Return the decisions of all environments together, after those of active ones have been counted."""
        decision = Decision(*map(_together, zip(*parts, strict=True)))
        self._decisions += active
        decision = decision._replace(truncated=decision.truncated | (self._decisions >= self._limit))
        self.terminated = decision.terminated
        self.truncated = decision.truncated
        self._over = self._over | (active & (self.terminated | self.truncated))
        return decision

    def _restart(self, ended: Bool) -> None:
        """Draw the next scenes of some environments, and start them."""

        def restart(episodes: Episodes, share: Int) -> None:
            rows = np.flatnonzero(ended[share])
            if rows.size:
                scenes = episodes.sampler([self.generators[i] for i in share[rows]])
                episodes.start(rows, scenes, keep=True)

        self._each(restart)
        self._decisions[ended] = 0

    def _start(self, rows: Int, scenes: Scenes) -> None:
        """Start given scenes in some environments."""
        for episodes, share in zip(self._episodes, self._shares, strict=True):
            inside = np.isin(rows, share)
            if inside.any():
                episodes.start(rows[inside] - share[0], scenes.take(inside))
        for flags in (self.terminated, self.truncated, self._over):
            flags[rows] = False
        self._decisions[rows] = 0
        self._running = True

    def _check_running(self) -> None:
        """Raise an error before the first reset."""
        if not self._running:
            raise gym.error.ResetNeeded("the episodes have not begun: call reset() before step()")

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


def _masks(info: Mapping[str, Any], mask: Bool) -> dict[str, Bool]:
    """Return the masks that go with the entries of an info: True for environments that have them."""
    return {f"_{name}": mask.copy() for name in info}


def _together(parts: Sequence[Any]) -> Any:
    """Return arrays of all environments, also in mappings and lists, from those of the environments of each thread."""
    if len(parts) == 1:
        return parts[0]
    if isinstance(parts[0], Mapping):
        return {name: _together([part[name] for part in parts]) for name in parts[0]}
    if isinstance(parts[0], list):
        return [_together(column) for column in zip(*parts, strict=True)]
    return np.concatenate(parts)


def _taken(arrays: Any, rows: Int) -> Any:
    """Return arrays of some environments, also in mappings and lists, from those of all."""
    if isinstance(arrays, Mapping):
        return {name: _taken(each, rows) for name, each in arrays.items()}
    if isinstance(arrays, list):
        return [_taken(each, rows) for each in arrays]
    return arrays[rows]
