"""Vector environment for Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

import viapoint.envs
from viapoint.envs.common.arrays import Observation
from viapoint.envs.registration import check_registered
from viapoint.training.files import as_plain

assert viapoint.envs.TASKS, "importing it registers the environments"

ELAPSED = "elapsed"  # Name of the duration of a decision in infos, [s]
# Metrics of an episode that `episode` in the infos holds too, as with `info_keywords` of SB3's `Monitor`
LOGGED = ("collision", "reachable", "min_clearance", "jerk_ratio", "duration")


def env_arguments(env: VecEnv | None) -> tuple[str, dict[str, Any]]:
    """Return the id of a vector environment and the keyword arguments that its id does not imply.

    It is a :class:`ViaVecEnv`, or has environments of this package; another one raises ValueError.
    """
    if env is None:
        raise ValueError("the environment must be one of this package, made by its id, got none")
    check_unwrapped(env)
    inner = env.unwrapped
    if isinstance(inner, ViaVecEnv):
        return inner.env_id, dict(inner.env_kwargs)
    spec: Any = inner.get_attr("spec", [0])[0]
    if spec is None or not hasattr(inner.get_attr("unwrapped", [0])[0], "task"):
        given = inner if spec is None else spec.id
        raise ValueError(f"the environment must be one of this package, made by its id, got {given}")
    registered = gym.spec(spec.id)
    arguments = {**spec.kwargs, "max_episode_steps": spec.max_episode_steps}
    usual = {**registered.kwargs, "max_episode_steps": registered.max_episode_steps}
    for name in ("render_mode", "threads"):
        arguments.pop(name, None)
    for name in usual.keys() & arguments.keys():
        if as_plain(arguments[name]) == as_plain(usual[name]):
            del arguments[name]
    return spec.id, arguments


def check_unwrapped(env: VecEnv) -> None:
    """Check that no wrapper changes observations, or actions of single environments; ValueError otherwise."""
    reason = "models know an environment by its id alone"
    if env.observation_space != env.unwrapped.observation_space:
        raise ValueError(f"{type(env).__name__} changes observations: {reason}")
    for wrapper, example in (
        (gym.ObservationWrapper, "FlattenObservation"),
        (gym.ActionWrapper, "RescaleAction"),
    ):
        if not isinstance(env.unwrapped, ViaVecEnv) and any(env.env_is_wrapped(wrapper, [0])):
            raise ValueError(f"env must have no {wrapper.__name__}, such as {example}: {reason}")


def check_spaces(own: VecEnv, env: VecEnv) -> None:
    """Check that an environment has the observations and actions of an agent's own one; ValueError otherwise."""
    if (env.observation_space, env.action_space) != (own.observation_space, own.action_space):
        trained, given = (" ".join(map(str, filter(None, env_arguments(each)))) for each in (own, env))
        raise ValueError(f"the agent decides in {trained}, observations or actions are others in {given}")


def predicted_actions(model: BaseAlgorithm, observation: Any) -> NDArray[Any]:
    """Return the actions of a model for an observation or a batch as the environment gives it.

    A model of `VecNormalize` gets it normalised with the statistics of its training, which stay as they are.
    """
    normalize = model.get_vec_normalize_env()
    seen = observation if normalize is None else normalize.normalize_obs(observation)
    actions, _ = model.predict(seen, deterministic=True)
    return actions


class ViaVecEnv(VecEnv):
    """Vector environment for Stable-Baselines3 that simulates all copies of an environment in one batch.

    It replaces `make_vec_env` of Stable-Baselines3, which makes one Python environment per copy. `HerReplayBuffer` does
    not apply: the reward of another goal depends on contact and jerk of a movement that was not made.

    Args:
        env_id: Id of a registered environment, also with the module that registers it, `my_module:my/Task-v0`.
        num_envs: Number of copies N.
        seed: Copy i is seeded with `seed + i` at the next reset; None seeds from the system.
        **kwargs: Keyword arguments of the environment.

    Raises:
        ValueError: There is no such environment, or it does not start the next episode in the step that ends the last.

    Example:
        >>> import numpy as np
        >>> from viapoint.training import ViaVecEnv
        >>> env = ViaVecEnv("viapoint/PlanarObstacles-v0", 64, seed=0, n_obstacles=3)
        >>> observation = env.reset()
        >>> observation["hand"].shape, env.action_space.shape  # [m]
        ((64, 3), (3,))
        >>> observation, reward, done, infos = env.step(np.zeros((64, 3), dtype=np.float32))
        >>> reward.shape, done.tolist() == [True] * 64, sorted(infos[0])[:3]
        ((64,), True, ['TimeLimit.truncated', 'collision', 'duration'])
        >>> env.close()
    """

    def __init__(self, env_id: str, num_envs: int, seed: int | None = None, **kwargs: Any) -> None:
        env_id = check_registered(env_id)
        self.venv: Any = gym.make_vec(env_id, num_envs=num_envs, **kwargs)
        mode = self.venv.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"{env_id} must have autoreset mode SAME_STEP, not {mode}")
        self.env_id = env_id
        self.env_kwargs = dict(kwargs)
        self.recorded_id = env_id  # of an agent's file, which need not be registered here; tables name it
        spaces = self.venv.single_observation_space, self.venv.single_action_space
        VecEnv.__init__(self, num_envs, *spaces)
        self._actions: NDArray[Any] | None = None
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)
        self._began = time.monotonic()
        if seed is not None:
            self.seed(seed)

    @property
    def physics_steps(self) -> int:
        """Number of physics steps so far."""
        return int(self.venv.unwrapped.physics_steps)

    def reset(self) -> Observation:
        """Start a new episode in every copy, with the options of `set_options`, if any."""
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        given: Any = self._options
        self._reset_options()  # refused ones must not be met again
        whole = isinstance(given, Sequence) and len(given) == self.num_envs
        if not whole or not all(isinstance(each, Mapping) for each in given):
            raise ValueError(f"options must be a mapping, or a list of {self.num_envs}, got {given!r}")
        begun: Any = slice(None)
        if all(each is given[0] for each in given):  # as SB3 repeats a mapping
            options = dict(given[0])
            observation, _ = self.venv.reset(seed=seeds, options=options or None)
            begun = options.get("reset_mask", begun)
        else:
            observation = self._reset_each(seeds, given)
        self._reset_seeds()  # a later reset goes on with the generators
        self._returns[begun], self._lengths[begun] = 0.0, 0
        started: Observation = observation
        return started

    def _reset_each(self, seeds: list[int | None] | None, given: Sequence[Mapping[str, Any]]) -> Observation:
        """Start a new episode in every copy with options of its own, those of the same names together."""
        names = [tuple(sorted(options)) for options in given]
        if () in names or len(set(names)) > 1:  # all episodes must have begun before some are begun anew
            observation, _ = self.venv.reset(seed=seeds)
        for some in sorted(set(names) - {()}):
            mask = np.array([each == some for each in names])
            chosen = [options for options in given if tuple(sorted(options)) == some]
            options: dict[str, Any] = {name: [each[name] for each in chosen] for name in some}
            observation, _ = self.venv.reset(seed=seeds, options={**options, "reset_mask": mask})
        started: Observation = observation
        return started

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of the next step, shape (N, m)."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all copies; if an episode ended, the observation is the first one of the next episode.

        Returns:
            Observation, reward (N,), done (N,) and N info dictionaries, as from Stable-Baselines3's `make_vec_env`. At
            the end of an episode, `episode` in them holds return r, length l, wall time t [s] since the start, and
            those metrics of `LOGGED` that the environment reports.
        """
        observation, reward, terminated, truncated, info = self.venv.step(self._actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        infos = self._listed(info)
        if done.any():
            ended = self._listed(info.get("final_info", {}))
            seconds = round(time.monotonic() - self._began, 6)
            for row in np.flatnonzero(done).tolist():
                episode = {"r": float(self._returns[row]), "l": int(self._lengths[row]), "t": seconds}
                episode |= {name: ended[row][name] for name in LOGGED if name in ended[row]}
                last = {"terminal_observation": info["final_obs"][row], "episode": episode}
                infos[row] = {**ended[row], **last}
            self._returns[done], self._lengths[done] = 0.0, 0
        for each, cut in zip(infos, (truncated & ~terminated).tolist(), strict=True):
            each["TimeLimit.truncated"] = cut  # SB3 then looks beyond the end of the episode
        return observation, np.asarray(reward, dtype=np.float32), done, infos

    def _listed(self, info: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return the info of a vector environment as one dictionary for each copy, with plain numbers."""
        names = [name for name in info if not name.startswith(("_", "final_"))]
        if not names:
            return [{} for _ in range(self.num_envs)]
        columns = (info[name].tolist() for name in names)
        return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]

    def state(self) -> dict[str, Any]:
        """Return random generators, running episodes and counters as values and arrays for :meth:`restore`."""
        own = self.venv.unwrapped.state()
        return {**own, "returns": self._returns.copy(), "lengths": self._lengths.copy()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of this environment, or of one of the same kind and number of copies."""
        self.venv.unwrapped.restore(state)
        self._returns = np.array(state["returns"])
        self._lengths = np.array(state["lengths"])

    def close(self) -> None:
        """Close the environment."""
        self.venv.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each copy asked for."""
        return [getattr(self.venv.unwrapped, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all copies share."""
        if len(self._rows(indices)) != self.num_envs:
            raise ValueError(f"the copies share {attr_name}: it is set for all of them, not for {indices}")
        setattr(self.venv.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the vector environment once, and return its result for each copy asked for."""
        answer = getattr(self.venv.unwrapped, method_name)(*args, **kwargs)
        return [answer] * len(self._rows(indices))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return True for `Monitor` of Stable-Baselines3, whose infos all copies report, and False otherwise."""
        return [wrapper_class is Monitor] * len(self._rows(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return rendered frames, one for each copy."""
        frames = self.venv.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def _rows(self, indices: Any) -> NDArray[np.int64]:
        """Return the rows of copies; IndexError where there is none."""
        return np.arange(self.num_envs)[list(self._get_indices(indices))]
