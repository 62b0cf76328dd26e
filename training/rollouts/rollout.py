"""Rollouts of actions and of methods in given scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.registration import ONLINE_TASKS, check_registered
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.vector_env import Decision, ReachVectorEnv


class Trials(NamedTuple):
    """What came of N actions, shape (N,) each."""

    reward: Float
    info: dict[str, NDArray[Any]]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Which of them succeeded."""
        return np.asarray(self.info["is_success"], dtype=bool)


class Trial:
    """Simulates actions in given scenes, `num_envs` at a time.

    Args:
        env_id: Of a registered environment.
        num_envs: Simulated together at most.
        **kwargs: Of the environment.
    """

    def __init__(self, env_id: str, num_envs: int = 512, **kwargs: Any) -> None:
        check_registered(env_id)
        self.env_id, self.kwargs = env_id, kwargs
        sizes = {num_envs, min(num_envs, 64)}
        self._envs: dict[int, ReachVectorEnv] = {
            size: gym.make_vec(env_id, num_envs=size, **kwargs)  # type: ignore[misc]
            for size in sorted(sizes)
        }
        self.task = self._envs[num_envs].task
        self._capacity = num_envs

    def draw(self, number: int, seed: int) -> Any:
        """As many scenes as wanted; the same for the same seed."""
        return self.task.sampler()([np.random.default_rng(seed)] * number)

    def observe(self, scenes: Scenes) -> dict[str, NDArray[np.float32]]:
        """First observations in N scenes, without a simulation."""
        joints = np.asarray(self.task.arm.inverse_kinematics(scenes.start))
        return self.task.observation.observe(joints, scenes.start, scenes)

    def __call__(self, scenes: Scenes, actions: Float) -> Trials:
        """Simulate one action in each of N scenes, one or more."""
        return self._try(scenes, (actions,), lambda env, some: env.execute_actions(some))

    def play(self, method: Any, scenes: Scenes, decided: Float) -> Trials:
        """Simulate what a method has decided in N scenes, or let it do so itself where it can."""
        trials: Trials = getattr(method, "execute", self)(scenes, decided)
        return trials

    def execute_plan(self, scenes: Scenes, plan: Plan) -> Trials:
        """Simulate one plan in each of N scenes, one or more; plans may have any number of via-points."""
        return self._try(scenes, plan, lambda env, *some: env.execute_plan(Plan(*some)))

    def _try(self, scenes: Scenes, what: tuple[Float, ...], act: Callable[..., Decision]) -> Trials:
        """As many at a time as there are environments; those left over repeat the first."""
        pieces = []
        for i in range(0, len(what[0]), self._capacity):
            some = slice(i, i + self._capacity)
            number = len(what[0][some])
            size = next(size for size in self._envs if size >= number)
            env = self._envs[size]
            filled = Scenes(*(repeated(field, size) for field in scenes.take(some)))
            env.reset(options=filled.as_options())
            _, reward, info = act(env, *(repeated(part[some], size) for part in what))
            pieces.append(Trials(reward[:number], {name: value[:number] for name, value in info.items()}))
        info = {name: np.concatenate([piece.info[name] for piece in pieces]) for name in pieces[0].info}
        return Trials(np.concatenate([piece.reward for piece in pieces]), info)

    def close(self) -> None:
        """Let the environments go."""
        for env in self._envs.values():
            env.close()


def repeated(values: Float, number: int) -> Float:
    """The first repeated at the end until there are `number`."""
    return np.concatenate((values, np.repeat(values[:1], number - len(values), axis=0)))


class OnlineTrial(Trial):
    """Plays whole episodes in given scenes, `num_envs` at a time.

    Args:
        env_id: Of a registered environment whose plans are revised.
        num_envs: Simulated together at most.
        **kwargs: Of the environment.
    """

    @property
    def time_limit(self) -> float:
        """Of an episode, [s]."""
        return float(self._envs[self._capacity].time_limit)  # type: ignore[attr-defined]

    def draw(self, number: int, seed: int) -> ChangingScenes:
        """As many scenes as wanted; the same for the same seed."""
        env: Any = self._envs[min(self._envs)]
        pieces = []
        for first in range(0, number, env.num_envs):
            env.reset(seed=[seed + first + i for i in range(env.num_envs)])
            pieces.append(env.scenes)
        together = ChangingScenes(*(np.concatenate(fields) for fields in zip(*pieces, strict=True)))
        return together.take(slice(0, number))

    def observe(self, scenes: Any) -> Observation:
        """First observations in N scenes."""
        pieces: list[Observation] = []
        for some, env in self._groups(scenes):
            observation, _ = env.reset(options=_filled(some, env.num_envs).as_options())
            pieces.append({name: part[: len(some.start)] for name, part in observation.items()})
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def __call__(self, scenes: Any, actions: Float) -> Trials:
        """Begin with one action in each of N scenes; the zero action follows at every later decision."""
        return self._played(scenes, actions, None)

    def first(self, scenes: Any, actions: Float) -> Trials:
        """One decision in each of N scenes, and none that follows."""
        return self._played(scenes, actions, None, once=True)

    def play(self, method: Any, scenes: Any, decided: Float) -> Trials:
        """Begin with what a method has decided in N scenes, and ask it again at every later decision."""
        if hasattr(method, "execute"):
            own: Trials = method.execute(scenes, decided)
            return own
        return self._played(scenes, decided, method)

    def _played(self, scenes: Any, decided: Float, method: Any, *, once: bool = False) -> Trials:
        pieces, done = [], 0
        for some, env in self._groups(scenes):
            number = len(some.start)
            pieces.append(_episodes(env, some, decided[done : done + number], method, once=once))
            done += number
        info = {name: np.concatenate([piece.info[name] for piece in pieces]) for name in pieces[0].info}
        return Trials(np.concatenate([piece.reward for piece in pieces]), info)

    def _groups(self, scenes: Any) -> list[tuple[Any, Any]]:
        """Scenes, as many at a time as there are environments, with those that take them."""
        groups = []
        for first in range(0, len(scenes.start), self._capacity):
            some = scenes.take(slice(first, first + self._capacity))
            groups.append((some, self._envs[next(size for size in self._envs if size >= len(some.start))]))
        return groups


def new_trial(env_id: str, num_envs: int = 512, **kwargs: Any) -> Trial:
    """A trial of the kind that an environment needs."""
    return (OnlineTrial if env_id in ONLINE_TASKS else Trial)(env_id, num_envs, **kwargs)


def _episodes(env: Any, scenes: Any, decided: Float, method: Any, *, once: bool) -> Trials:
    """Play one episode in each scene to its end; environments that are done go on with others, which do not count."""
    number, size = len(decided), env.num_envs
    env.reset(options=_filled(scenes, size).as_options())
    actions, running, reward = repeated(decided, size), np.arange(size) < number, np.zeros(number)
    kept: dict[str, NDArray[Any]] = {}
    decisions = np.zeros(number)
    while running.any():
        now = running[:number].copy()
        observation, earned, terminated, truncated, info = env.step(actions)
        reward += np.where(now, earned[:number], 0.0)
        decisions += now
        for name in (name for name in info if not name.startswith(("_", "final_"))):
            kept[name] = np.where(now, info[name][:number], kept.get(name, info[name][:number]))
        running &= ~(terminated | truncated | once)
        actions, rows = np.zeros_like(actions), np.flatnonzero(running)
        if method is not None and rows.size:
            seen = {name: part[rows] for name, part in observation.items()}
            actions[rows] = method.decide(seen, scenes.take(rows))
    kept["decisions"], kept["duration"] = decisions, kept["time"]
    return Trials(reward, kept)


def _filled(scenes: Any, number: int) -> Any:
    return type(scenes)(*(repeated(field, number) for field in scenes))
