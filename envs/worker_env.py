"""Vector environment whose environments live in worker processes."""

from __future__ import annotations

import os
import re
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle
from gymnasium.vector.utils import batch_space

from viapoint.envs.arms import ARMS, register_arm
from viapoint.envs.common.types import Observation
from viapoint.envs.common.validation import (
    as_given,
    checked_actions,
    masked_rows,
    reset_options,
    seeds_of,
    whole_number,
)
from viapoint.envs.geometry.rows import is_shape_list, obstacle_names
from viapoint.envs.geometry.shape import Shape
from viapoint.envs.geometry.shapes import SHAPES
from viapoint.envs.worker_process import WorkerDiedError, WorkerProcess


class BatchServer:
    """Native batch of environments that a worker runs; the keyword arguments may name the given arms and shapes."""

    def __init__(
        self,
        kind: Any,
        num_envs: int,
        kwargs: Mapping[str, Any],
        arms: Iterable[Any],
        shapes: Mapping[str, type[Shape]],
    ) -> None:
        for arm in arms:
            register_arm(arm)
        SHAPES.clear()  # rows of scenes name shapes by their place in the table
        SHAPES.update(shapes)
        self.env = kind(num_envs, **kwargs)
        self._next: Any = None

    def draw(self, seeds: Sequence[int | None], rows: Any, options: Mapping[str, Any]) -> None:
        """Draw the next episodes of some environments."""
        self._next = self.env.draw_episodes(seeds, rows, options) if len(rows) else None

    def begin(self) -> Observation:
        """Begin the episodes that :meth:`draw` drew, and return the observations."""
        if self._next is not None:
            self.env.begin_episodes(self._next)
        observation: Observation = self.env.observe()
        return observation

    def execute(self, name: str, actions: Any) -> Any:
        """Return the result of a method that executes actions."""
        return getattr(self.env, name)(actions)

    def call(self, name: str, *arguments: Any) -> Any:
        """Return the result of a method of the environments."""
        return getattr(self.env, name)(*arguments)

    def get(self, name: str) -> Any:
        """Return an attribute of the environments."""
        return getattr(self.env, name)

    def set(self, name: str, value: Any) -> None:
        """Set an attribute of the environments."""
        setattr(self.env, name, value)


class WorkerVectorEnv(gym.vector.VectorEnv[Any, Any, Any], EzPickle):
    """Environments of this package in several processes, each with a native batch.

    `gym.make_vec(id, num_envs=N, workers=W)` makes one. It has spaces, results and attributes of the class `kind`, and
    the same episodes bit for bit, whatever the number of workers: environment i has its own random generator, and its
    results do not depend on the others. Processes also share the part of a step that is written in Python, which does
    not become faster with threads.

    Args:
        kind: Class of the vector environment in each process.
        num_envs: Number of environments N.
        workers: Number of processes, N at most.
        **kwargs: Keyword arguments of the class. `threads` are those of each process; 0 shares the cores among them.

    Raises:
        ValueError: An argument is not allowed.
        WorkerDiedError: A process ended, from any method; the environments are closed.

    Example:
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=16, workers=2)
        >>> observation, _ = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(0.1 * envs.action_space.sample())
        >>> reward.shape
        (16,)
        >>> envs.close()
    """

    gathered: ClassVar = (
        "default", "generators", "last_plan", "last_plans", "last_rollout", "physics_steps", "scenes", "terminated",
        "truncated",
    )  # fmt: skip
    """Attributes that are gathered from the processes, as copies."""

    def __init__(self, kind: Any, num_envs: int = 1, workers: int = 1, **kwargs: Any) -> None:
        EzPickle.__init__(self, kind, num_envs, workers, **as_given(kwargs))
        self.num_envs = whole_number("num_envs", num_envs, 1)
        self.n_workers = whole_number("workers", workers, 1)
        """Number of processes."""
        if self.n_workers > self.num_envs:
            raise ValueError(f"workers must be at most num_envs, which is {self.num_envs}, got {workers}")
        if kwargs.get("render_mode") == "human":
            raise ValueError(
                "render_mode must be rgb_array or rgb_array_list where there are workers, got 'human'"
            )
        threads = whole_number("threads", kwargs.get("threads", 0), 0) or max(1, n_cores() // self.n_workers)
        self._prototype = kind(1, **{**kwargs, "threads": 1})
        for name in ("metadata", "render_mode", "single_action_space", "single_observation_space"):
            setattr(self, name, getattr(self._prototype, name))
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._running = False
        bounds = np.linspace(0, self.num_envs, self.n_workers + 1).astype(int).tolist()
        self.parts = [slice(*pair) for pair in pairwise(bounds)]
        """Environments of each process."""
        mine = {**kwargs, "threads": threads}
        servers = [
            partial(BatchServer, kind, part.stop - part.start, mine, list(ARMS.values()), dict(SHAPES))
            for part in self.parts
        ]
        self._workers = self._start(servers, threads)
        self._finalizer = weakref.finalize(self, _close_all, self._workers)
        self._collect()

    def _start(self, servers: Sequence[Callable[[], BatchServer]], threads: int) -> list[Any]:
        """Start the workers, which answer with None when they are ready."""
        return [WorkerProcess(make, self._title(k), threads) for k, make in enumerate(servers)]

    def _title(self, k: int) -> str:
        part = self.parts[k]
        return f"worker {k + 1} of {self.n_workers} (environments {part.start} to {part.stop - 1})"

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes; see :meth:`~viapoint.envs.vector_env.ReachVectorEnv.reset`."""
        options = reset_options(options)
        rows = masked_rows(options.pop("reset_mask", None), self.num_envs, self._running)
        seeds = seeds_of(seed, self.num_envs)
        if not self._running:  # known here, so that lost workers can be made anew
            seeds = [int(np.random.SeedSequence().entropy) if each is None else each for each in seeds]  # type: ignore[arg-type]
        given: dict[str, Any] = self._prototype.parse_options(options, len(rows))
        if any(map(any, obstacle_names(options.get("obstacles", ())))):  # for errors, which name them
            shapes = options["obstacles"]
            scenes = [shapes] if is_shape_list(shapes) else list(shapes)
            given["obstacles"] = scenes * len(rows) if len(scenes) == 1 else scenes
        asked, first = [], []
        for part in self.parts:
            begin, end = (int(np.searchsorted(rows, env)) for env in (part.start, part.stop))
            first.append(begin)
            mine = {name: each[begin:end] for name, each in given.items()}
            asked.append((seeds[part], rows[begin:end] - part.start, mine))
        self._call("draw", asked, first)
        observation: Observation = merge(self._call("begin"))
        self._running = True
        return observation, {}

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Execute one action in each environment; where an episode ends, start the next."""
        results = self._execute("transition", actions)
        if any(each.last_observation for each in results):  # None where no episode ended
            results = [
                each._replace(last_observation=each.last_observation or each.observation) for each in results
            ]
        step: tuple[Observation, Any, Any, Any, dict[str, Any]] = merge(results).as_step()
        return step

    def execute_actions(self, actions: Any) -> Any:
        """Execute one action in each environment, without a reset."""
        return merge(self._execute("execute_actions", actions))

    def observe(self) -> Observation:
        """Return the present observations."""
        observation: Observation = merge(self.call("observe"))
        return observation

    def state(self) -> dict[str, Any]:
        """Return scenes, episodes, random generators and counters, independently of the number of workers.

        :meth:`~viapoint.envs.vector_env.ReachVectorEnv.restore` of environments in one process accepts it, too.
        """
        self._check_running()
        state: dict[str, Any] = merge(self.call("state"))
        return state

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of environments of the same kind and number."""
        states: list[dict[str, Any]] = []
        for part in self.parts:
            episodes = state.get("episodes")
            states.append(
                {
                    "generators": state["generators"][part],
                    "scenes": {name: np.asarray(each)[part] for name, each in state["scenes"].items()},
                    "physics_steps": 0 if states else int(state["physics_steps"]),
                    "episodes": self._prototype.take_episodes(episodes, part) if episodes else None,
                }
            )
        self._call("call", [("restore", each) for each in states])
        self._running = True

    def render(self) -> Any:
        """Render the last movement of each environment in the render mode; after a reset, the scenes."""
        if self.render_mode is None:
            return self._prototype.render() if self._running else None
        self._check_running()
        return merge(self.call("render"))

    def call(self, name: str, *arguments: Any) -> list[Any]:
        """Call a method of the environments in each process, and return the results."""
        return self._call("call", [(name, *arguments)] * self.n_workers)

    def get_attr(self, name: str) -> list[Any]:
        """Return an attribute of the environments in each process."""
        return self._call("get", [(name,)] * self.n_workers)

    def set_attr(self, name: str, value: Any) -> None:
        """Set an attribute of the environments in each process."""
        self._call("set", [(name, value)] * self.n_workers)

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        if "_finalizer" in self.__dict__:  # the constructor may have failed before
            self._finalizer()
            self._prototype.close()

    def __getattr__(self, name: str) -> Any:
        """Return what the environments in this process would have, apart from methods."""
        prototype = self.__dict__.get("_prototype")
        if prototype is None or name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        if name in self.gathered and name in dir(prototype):
            return merge(self.get_attr(name))
        value = getattr(prototype, name)
        if callable(value):
            raise AttributeError(f"{name} works in one process only; call({name!r}) calls it in each process")
        return value

    def _check_running(self) -> None:
        if not self._running:
            raise gym.error.ResetNeeded("the episodes have not begun: call reset() before step()")

    def _execute(self, name: str, actions: Any) -> list[Any]:
        self._check_running()
        checked = checked_actions(actions, self.num_envs, self._prototype.action_names)
        return self._call("execute", [(name, checked[part]) for part in self.parts])

    def _call(
        self, command: str, arguments: Sequence[tuple[Any, ...]] = (), first: Sequence[int] = ()
    ) -> list[Any]:
        """Return the result of a command of each worker; `first` are the numbers of their first scenes in errors."""
        if self.closed:
            raise gym.error.ClosedEnvironmentError("the environments are closed: make new ones")
        try:
            for worker, mine in zip(self._workers, arguments or [()] * self.n_workers, strict=True):
                worker.submit(command, mine)
        except WorkerDiedError as error:
            raise self._closing(error) from None
        return self._collect(first)

    def _collect(self, first: Sequence[int] = ()) -> list[Any]:
        results: list[Any] = []
        errors: list[Exception] = []
        for k, worker in enumerate(self._workers):
            try:
                results.append(worker.result())
            except WorkerDiedError as error:
                raise self._closing(error) from None
            except ValueError as error:
                errors.append(ValueError(_renumbered(str(error), first[k])) if first else error)
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0] from None
        return results

    def _closing(self, error: WorkerDiedError) -> WorkerDiedError:
        """Close the environments, and return the error with what to do."""
        self.close()
        return WorkerDiedError(f"{error}; all {self.num_envs} environments are closed: make new ones")


def merge(parts: Sequence[Any]) -> Any:
    """Return the results of consecutive environments as one: arrays and lists are joined, counters are added.

    Example:
        >>> merge([{"reward": np.zeros(2)}, {"reward": np.ones(1)}])
        {'reward': array([0., 0., 1.])}
    """
    one = parts[0]
    if any(each is None for each in parts):
        return None
    if isinstance(one, np.ndarray):
        return np.concatenate(parts)
    if isinstance(one, dict):
        return {name: merge([each[name] for each in parts]) for name in one}
    if isinstance(one, tuple) and hasattr(one, "_fields"):
        return type(one)(*(merge(column) for column in zip(*parts, strict=True)))
    return sum(parts[1:], start=one)


def n_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _renumbered(message: str, first: int) -> str:
    return re.sub(r"^scene (\d+)", lambda found: f"scene {int(found[1]) + first}", message)


def _close_all(workers: Sequence[Any]) -> None:
    for worker in workers:
        worker.close()
