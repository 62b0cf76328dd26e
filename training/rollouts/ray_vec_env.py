"""Vector environment for Stable-Baselines3 whose environments live in actors of Ray."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from viapoint.envs.common.validation import whole_number
from viapoint.envs.registration import ENV_IDS, check_registered
from viapoint.envs.worker_env import BatchServer, WorkerVectorEnv, merge
from viapoint.envs.worker_process import WorkerDiedError
from viapoint.training.rollouts.ray_actors import (
    ATTEMPTS,
    ActorHandle,
    ActorLostError,
    RecoveringActor,
    join_cluster,
    leave_cluster,
)
from viapoint.training.rollouts.vec_env import ViaVecEnv

LOST = "lost"
"""Key of `info` that is True where an episode was lost with its actor."""


class _ActorVectorEnv(WorkerVectorEnv):
    """Environments of this package in actors, each with a native batch."""

    def _start(self, servers: Sequence[Callable[[], BatchServer]], threads: int) -> list[Any]:
        return [RecoveringActor(make, self._title(k), threads) for k, make in enumerate(servers)]

    @property
    def restarts(self) -> int:
        """Number of actors that died."""
        return sum(worker.handle.restarts for worker in self._workers)


class DummyServer:
    """Environments of Gymnasium that an actor runs in a `DummyVecEnv`."""

    def __init__(self, spec: EnvSpec, num_envs: int, kwargs: Mapping[str, Any]) -> None:
        self.env = DummyVecEnv([lambda: Monitor(gym.make(spec, **kwargs)) for _ in range(num_envs)])

    def reset(self, seeds: list[Any], options: list[Any]) -> tuple[Any, list[dict[str, Any]]]:
        """Start new episodes, and return observations and infos."""
        self.env._seeds, self.env._options = list(seeds), list(options)
        return self.env.reset(), self.env.reset_infos

    def step(self, actions: Any) -> Any:
        """Step all environments."""
        return self.env.step(actions)

    def each(self, indices: list[int], command: str, args: Any, kwargs: Any) -> list[Any]:
        """Return the results of a method of `DummyVecEnv` for some environments, such as `get_attr`."""
        results = getattr(self.env, command)(*args, indices=indices, **kwargs)
        return [None] * len(indices) if results is None else results

    def images(self) -> Sequence[Any]:
        """Return rendered frames of all environments."""
        return self.env.get_images()


class RayVecEnv(VecEnv):
    """Vector environment for Stable-Baselines3 whose environments live in actors of Ray, on one machine or several.

    For an id of this package each actor has a native batch, and the object is a :class:`ViaVecEnv`. For any other id of
    Gymnasium each actor has a `DummyVecEnv` with `Monitor`, as `make_vec_env` of Stable-Baselines3. Equal seeds give
    the same episodes as these without Ray, whatever the number of actors.

    An actor that dies is replaced. The environments of this package continue exactly where they were: the new actor
    repeats the steps since the last snapshot, and nothing is lost. Of other environments the running episodes are
    lost: the step ends them as truncated, with reward 0, the last known observation as `terminal_observation`, and
    `info["lost"]`; there is no `info["episode"]`, so that statistics do not count them. New episodes begin with other
    seeds. Off-policy algorithms should be given :class:`LostEpisodesCallback`.

    Args:
        env_id: Id of a registered environment.
        num_envs: Number of environments N.
        seed: Environment i is seeded with `seed + i` at the next reset; None seeds from the system.
        workers: Number of actors, N at most. Each uses one core, or `threads` of them if that is an argument.
        on: `ray` for the cluster of the environment variable RAY_ADDRESS, or without it for a Ray of its own on this
            machine; `ray://HOST:PORT` for a cluster elsewhere.
        **kwargs: Keyword arguments of the environment.

    Raises:
        ImportError: Ray is not installed.
        ValueError: There is no such environment or cluster, or an argument is not allowed.
        WorkerDiedError: From any method: several actors died at the same point, or the cluster has no room.

    Example:
        >>> from viapoint.training import RayVecEnv
        >>> env = RayVecEnv("viapoint/PlanarReach-v0", 4, seed=0, workers=1)
        >>> observation = env.reset()
        >>> observation["hand"].shape, env.lost_episodes
        ((4, 2), 0)
        >>> env.close()
    """

    def __new__(
        cls,
        env_id: str,
        num_envs: int,
        seed: int | None = None,
        *,
        workers: int = 2,
        on: str = "ray",
        **kwargs: Any,
    ) -> Any:
        """Return an object of the class for the id."""
        return super().__new__(_NativeRayVecEnv if env_id in ENV_IDS else cls)

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        seed: int | None = None,
        *,
        workers: int = 2,
        on: str = "ray",
        **kwargs: Any,
    ) -> None:
        check_registered(env_id)
        number = _at_most(num_envs, workers)
        spec = gym.spec(env_id)
        one = gym.make(spec, **kwargs)  # refuses wrong arguments before there is an actor
        one.close()
        self.lost_episodes = 0
        """Number of episodes that were lost with an actor."""
        bounds = np.linspace(0, num_envs, number + 1).astype(int).tolist()
        self._parts = [slice(*pair) for pair in pairwise(bounds)]
        self._entropy: list[int] = [0] * num_envs
        self._observation: Any = None
        self._first: dict[int, Any] = {}
        """First observations of the actors whose episodes were lost since the last step."""
        self._actors: list[ActorHandle] = []
        self._connected = join_cluster(on, number)
        try:
            for k, part in enumerate(self._parts):
                make = partial(DummyServer, spec, part.stop - part.start, kwargs)
                title = f"worker {k + 1} of {number} (environments {part.start} to {part.stop - 1})"
                self._actors.append(ActorHandle(make, title))
            for k, actor in enumerate(self._actors):
                self._attempt(k, actor.wait)
            VecEnv.__init__(self, num_envs, one.observation_space, one.action_space)
        except BaseException:
            self.close()
            raise
        if seed is not None:
            self.seed(seed)

    @property
    def restarts(self) -> int:
        """Number of actors that died and were replaced."""
        return sum(actor.restarts for actor in self._actors)

    def reset(self) -> Any:
        """Start a new episode in every environment."""
        drawn: Any = np.random.SeedSequence().generate_state(self.num_envs)
        self._entropy = [int(d if s is None else s) for s, d in zip(self._seeds, drawn, strict=True)]
        self._observation, self._first = None, {}
        asked = [("reset", (self._seeds[part], self._options[part])) for part in self._parts]
        for actor, question in zip(self._actors, asked, strict=True):
            actor.ask(*question)
        answers = [self._take(k, *question) for k, question in enumerate(asked)]
        self._observation = merge([first for first, _ in answers])
        self.reset_infos = [info for _, infos in answers for info in infos]
        self._reset_seeds()
        self._reset_options()
        return self._observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begin a step of all environments, actions of shape (N, ...)."""
        for k, (actor, part) in enumerate(zip(self._actors, self._parts, strict=True)):
            if k not in self._first:
                actor.ask("step", (actions[part],))

    def step_wait(self) -> Any:
        """Return observation, reward (N,), done (N,) and N info dictionaries of the step."""
        answers = []
        for k, actor in enumerate(self._actors):
            if k not in self._first:
                try:
                    answers.append(actor.take())
                    continue
                except ActorLostError as error:
                    self._replace(k, error)
            answers.append(self._lost_step(k))
        self._observation, reward, done, infos = (merge(column) for column in zip(*answers, strict=True))
        return self._observation, reward, done, infos

    def close(self) -> None:
        """End the actors."""
        for actor in self._actors:
            actor.close()
        self._actors = []
        leave_cluster(self._connected)
        self._connected = False

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of each environment asked for."""
        return self._each("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of each environment asked for; actors that replace others do not have it."""
        self._each("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment asked for."""
        return self._each("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return whether each environment asked for has a wrapper."""
        return self._each("env_is_wrapped", indices, wrapper_class)

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return rendered frames, one for each environment."""
        for actor in self._actors:
            actor.ask("images", ())
        return [frame for k in range(len(self._actors)) for frame in self._take(k, "images", ())]

    def _each(self, command: str, indices: Any, /, *args: Any, **kwargs: Any) -> list[Any]:
        rows = list(range(self.num_envs))
        rows = [rows[row] for row in self._get_indices(indices)]
        answers: dict[int, Any] = {}
        for k, part in enumerate(self._parts):
            mine = [row for row in rows if part.start <= row < part.stop]
            if mine:
                question = "each", ([row - part.start for row in mine], command, args, kwargs)
                self._actors[k].ask(*question)
                answers |= zip(mine, self._take(k, *question), strict=True)
        return [answers[row] for row in rows]

    def _take(self, k: int, command: str, arguments: tuple[Any, ...]) -> Any:
        """Return the answer of an actor, which is asked again if it died."""
        return self._attempt(k, self._actors[k].take, lambda: self._actors[k].ask(command, arguments))

    def _attempt(self, k: int, take: Callable[[], Any], again: Callable[[], None] = lambda: None) -> Any:
        for _ in range(ATTEMPTS):
            try:
                return take()
            except ActorLostError as error:
                lost = error
                self._replace(k, error)
                again()
        raise WorkerDiedError(f"{lost}, {ATTEMPTS} times at the same point")

    def _replace(self, k: int, lost: ActorLostError) -> None:
        """Start another actor, with new episodes if there were some."""
        actor, part = self._actors[k], self._parts[k]
        for _ in range(ATTEMPTS):
            try:
                actor.start()
                if self._observation is None:
                    return
                actor.wait()
                self._entropy[part] = [
                    int(np.random.SeedSequence((seed, actor.restarts)).generate_state(1)[0])
                    for seed in self._entropy[part]
                ]
                actor.ask("reset", (self._entropy[part], [{}] * (part.stop - part.start)))
                self._first[k] = actor.take()[0]
                return
            except ActorLostError as error:
                lost = error
        raise WorkerDiedError(f"{lost}, {ATTEMPTS} times at the same point")

    def _lost_step(self, k: int) -> Any:
        """Return the step in which the episodes of an actor end as lost."""
        part, first = self._parts[k], self._first.pop(k)
        rows = range(part.start, part.stop)
        self.lost_episodes += len(rows)
        infos = [
            {LOST: True, "TimeLimit.truncated": True, "terminal_observation": _row(self._observation, row)}
            for row in rows
        ]
        return first, np.zeros(len(rows), dtype=np.float32), np.ones(len(rows), dtype=bool), infos


class _NativeRayVecEnv(ViaVecEnv, RayVecEnv):
    """Environments of this package in actors of Ray."""

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        seed: int | None = None,
        *,
        workers: int = 2,
        on: str = "ray",
        **kwargs: Any,
    ) -> None:
        self._on, self._connected, self.lost_episodes = on, False, 0
        try:
            ViaVecEnv.__init__(self, env_id, num_envs, seed, workers=_at_most(num_envs, workers), **kwargs)
        except BaseException:
            leave_cluster(self._connected)
            raise

    def _make(self, env_id: str, num_envs: int, workers: int, kwargs: Mapping[str, Any]) -> Any:
        spec = gym.spec(env_id)
        kind: Any = load_env_creator(str(spec.vector_entry_point))
        arguments = {**spec.kwargs, "threads": 1, **kwargs}
        threads = whole_number("threads", arguments["threads"], 1)
        kind(1, **{**arguments, "threads": 1}).close()  # refuses wrong arguments before there is an actor
        self._connected = join_cluster(self._on, workers * threads)
        return _ActorVectorEnv(kind, num_envs, workers, **arguments)

    @property
    def restarts(self) -> int:
        """Number of actors that died and were replaced."""
        return int(self.venv.unwrapped.restarts)

    def close(self) -> None:
        """End the actors."""
        ViaVecEnv.close(self)
        leave_cluster(self._connected)
        self._connected = False


class LostEpisodesCallback(BaseCallback):
    """Callback that keeps lost transitions of a :class:`RayVecEnv` out of the replay buffer of off-policy algorithms.

    A buffer of Stable-Baselines3 stores one transition of every environment in each step. In the place of a lost one
    it gets a copy of the transition of another environment. If all were lost, they are stored as they are: truncated,
    with reward 0. On-policy algorithms are left alone: they learn next to nothing from a truncated step.

    Example:
        >>> from stable_baselines3 import SAC
        >>> from viapoint.training import LostEpisodesCallback
        >>> agent = SAC("MlpPolicy", "Pendulum-v1", learning_starts=4).learn(8, callback=LostEpisodesCallback())
    """

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        lost = [row for row, info in enumerate(infos) if info.get(LOST)]
        kept = [row for row in range(len(infos)) if row not in lost]
        if "replay_buffer" in self.locals and kept:
            for row in lost:
                self._copy(kept[row % len(kept)], row)
        return True

    def _copy(self, source: int, row: int) -> None:
        """Replace the transition of a row before it is stored."""
        values = self.locals
        done, info = bool(values["dones"][source]), values["infos"][source]
        # An end that is truncated is bootstrapped, as a step in the middle of an episode is.
        values["infos"][row] |= {
            "TimeLimit.truncated": info.get("TimeLimit.truncated", False) if done else True,
            "terminal_observation": info["terminal_observation"] if done else _row(values["new_obs"], source),
        }
        values["infos"][row] |= {name: info[name] for name in info if name not in values["infos"][row]}
        for array in (values["buffer_actions"], values["rewards"], *_parts(self.model._last_obs)):
            array[row] = array[source]
        if self.model._vec_normalize_env is not None:
            for array in _parts(self.model._last_original_obs):
                array[row] = array[source]


def _parts(observation: Any) -> list[NDArray[Any]]:
    return list(observation.values()) if isinstance(observation, dict) else [observation]


def _row(observation: Any, row: int) -> Any:
    if isinstance(observation, dict):
        return {name: part[row].copy() for name, part in observation.items()}
    return observation[row].copy()


def _at_most(num_envs: int, workers: Any) -> int:
    number = whole_number("workers", workers, 1)
    if number > whole_number("num_envs", num_envs, 1):
        raise ValueError(f"workers must be at most num_envs, which is {num_envs}, got {workers}")
    return number
