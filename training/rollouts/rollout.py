"""Rollouts of actions and of methods in given scenes: whole movements, episodes, and actions in every control step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import Motion, Plan
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.registration import REPLANNING_TASKS, STEP_TASKS, check_registered, twin_of
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes

if TYPE_CHECKING:
    from viapoint.envs.vector_env import Decision, ReachVectorEnv
    from viapoint.envs.velocity_env import VelocityVectorEnv


class SimulationResults(NamedTuple):
    """Results of N simulated actions or episodes, shape (N,) each."""

    reward: Float
    info: dict[str, NDArray[Any]]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Mask of the successful ones."""
        return np.asarray(self.info["is_success"], dtype=bool)

    @classmethod
    def concatenate(cls, pieces: Sequence[SimulationResults]) -> SimulationResults:
        """Join the results of several batches."""
        info = {name: np.concatenate([piece.info[name] for piece in pieces]) for name in pieces[0].info}
        return cls(np.concatenate([piece.reward for piece in pieces]), info)


class SceneSimulation:
    """Simulation of actions in given scenes, `num_envs` at a time."""

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
        """Sample scenes of the task, the same ones for the same seed."""
        return self.task.sampler()([np.random.default_rng(seed)] * number)

    def observe(self, scenes: Scenes) -> Observation:
        """Return first observations in N scenes, without a simulation."""
        joints = np.asarray(self.task.arm.inverse_kinematics(scenes.start))
        return self.task.observation.observe(joints, scenes.start, scenes)

    def __call__(self, scenes: Scenes, actions: Float) -> SimulationResults:
        """Simulate one action in each of N scenes, N at least 1."""
        return self._simulate(scenes, (actions,), lambda env, some: env.execute_actions(some))

    def play(self, method: Any, scenes: Scenes, decisions: Float) -> SimulationResults:
        """Simulate the decisions of a method in N scenes, by its own `execute` if it has one."""
        results: SimulationResults = getattr(method, "execute", self)(scenes, decisions)
        return results

    def execute_plan(self, scenes: Scenes, plan: Plan) -> SimulationResults:
        """Simulate one plan in each of N scenes, N at least 1; plans may have any number of via-points."""
        return self._simulate(scenes, plan, lambda env, *some: env.execute_plan(Plan(*some)))

    def _simulate(
        self, scenes: Scenes, arrays: tuple[Float, ...], act: Callable[..., Decision]
    ) -> SimulationResults:
        pieces = []
        for rows, env in self._groups(len(arrays[0])):
            env.reset(options=_filled(scenes.take(rows), env.num_envs).as_options())
            _, reward, info = act(env, *(repeated(each[rows], env.num_envs) for each in arrays))
            number = rows.stop - rows.start
            pieces.append(
                SimulationResults(reward[:number], {name: value[:number] for name, value in info.items()})
            )
        return SimulationResults.concatenate(pieces)

    def _groups(self, number: int) -> Iterator[tuple[slice, Any]]:
        """Yield rows of scenes with the smallest vector environment that takes them."""
        for first in range(0, number, self._capacity):
            rows = slice(first, min(first + self._capacity, number))
            yield rows, self._envs[next(size for size in self._envs if size >= rows.stop - rows.start)]

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()


def repeated(values: Float, number: int) -> Float:
    """Return values padded with copies of the first row to `number` rows."""
    return np.concatenate((values, np.repeat(values[:1], number - len(values), axis=0)))


class EpisodeSimulation(SceneSimulation):
    """Simulation of whole episodes in given scenes, `num_envs` at a time."""

    @property
    def time_limit(self) -> float:
        """Time limit of an episode, [s]."""
        return float(self._envs[self._capacity].time_limit)  # type: ignore[attr-defined]

    def draw(self, number: int, seed: int) -> ChangingScenes:
        """Sample scenes of the task, the same ones for the same seed."""
        env: Any = self._envs[min(self._envs)]
        pieces = []
        for first in range(0, number, env.num_envs):
            env.reset(seed=[seed + first + i for i in range(env.num_envs)])
            pieces.append(env.scenes)
        together = ChangingScenes(*(np.concatenate(fields) for fields in zip(*pieces, strict=True)))
        return together.take(slice(0, number))

    def observe(self, scenes: Any) -> Observation:
        """Return first observations in N scenes."""
        pieces: list[Observation] = []
        for rows, env in self._groups(len(scenes.start)):
            observation, _ = env.reset(options=_filled(scenes.take(rows), env.num_envs).as_options())
            pieces.append({name: part[: rows.stop - rows.start] for name, part in observation.items()})
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def __call__(self, scenes: Any, actions: Float) -> SimulationResults:
        """Play episodes that begin with one action in each of N scenes; all later actions are zero."""
        return self._play(scenes, actions, None)

    def first(self, scenes: Any, actions: Float) -> SimulationResults:
        """Simulate one decision in each of N scenes."""
        return self._play(scenes, actions, None, single_decision=True)

    def play(self, method: Any, scenes: Any, decisions: Float) -> SimulationResults:
        """Play episodes that begin with the decisions of a method; it makes every later decision, too."""
        if hasattr(method, "execute"):
            return super().play(method, scenes, decisions)
        return self._play(scenes, decisions, method)

    def _play(
        self, scenes: Any, actions: Float, method: Any, *, single_decision: bool = False
    ) -> SimulationResults:
        pieces = [
            _episodes(env, scenes.take(rows), actions[rows], method, single_decision)
            for rows, env in self._groups(len(scenes.start))
        ]
        return SimulationResults.concatenate(pieces)


def new_simulation(env_id: str, num_envs: int = 512, **kwargs: Any) -> SceneSimulation:
    """Return the simulation that an environment needs: of actions, or of whole episodes with replanning."""
    return (EpisodeSimulation if env_id in REPLANNING_TASKS else SceneSimulation)(env_id, num_envs, **kwargs)


def _episodes(
    env: Any, scenes: Any, first_actions: Float, method: Any, single_decision: bool
) -> SimulationResults:
    """Play one episode in each scene; environments that have ended go on with others, which do not count."""
    number, size = len(first_actions), env.num_envs
    env.reset(options=_filled(scenes, size).as_options())
    actions, running, reward = repeated(first_actions, size), np.arange(size) < number, np.zeros(number)
    last: dict[str, NDArray[Any]] = {}
    decisions = np.zeros(number)
    while running.any():
        now = running[:number].copy()
        observation, earned, terminated, truncated, info = env.step(actions)
        reward += np.where(now, earned[:number], 0.0)
        decisions += now
        for name in (name for name in info if not name.startswith(("_", "final_"))):
            last[name] = np.where(now, info[name][:number], last.get(name, info[name][:number]))
        running &= ~(terminated | truncated | single_decision)
        actions, rows = np.zeros_like(actions), np.flatnonzero(running)
        if method is not None and rows.size:
            seen = {name: part[rows] for name, part in observation.items()}
            actions[rows] = method.decide(seen, scenes.take(rows))
    last["decisions"], last["duration"] = decisions, last["time"]
    return SimulationResults(reward, last)


def _filled(scenes: Any, number: int) -> Any:
    """Return scenes padded with copies of the first one to `number`."""
    return type(scenes)(*(repeated(field, number) for field in scenes))


def whole_task(env_id: str, kwargs: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return id and arguments of the equivalent task with whole movements as actions; of most tasks, their own."""
    if env_id not in STEP_TASKS:
        return env_id, dict(kwargs)
    shared = {name: value for name, value in kwargs.items() if name != "control_step"}
    if isinstance(shared.get("reward_weights"), Mapping):
        weights = shared["reward_weights"]
        shared["reward_weights"] = {name: value for name, value in weights.items() if name != "progress"}
    return twin_of(env_id), shared


class StepAgentMethod:
    """Trained agent that acts in every control step, in environments of its own.

    A decision is the first action; the others follow during the simulation. The decision time is that of one control
    step, of which a movement has about twenty.
    """

    def __init__(self, name: str, model: Any, env_id: str, env_kwargs: Mapping[str, Any]) -> None:
        self.name, self._model, self._env_id, self._kwargs = name, model, env_id, dict(env_kwargs)
        self._envs: dict[int, VelocityVectorEnv] = {}

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return actions for the next step, shape (N, D), from observations of the step-wise task or its twin."""
        if "time_left" not in observation:
            env: Any = self._env(len(scenes.start))
            rest, time = Motion.at_rest(scenes.start), np.zeros(len(scenes.start))
            observation = env.observation_layout.moving(observation, scenes, rest, time)
        actions, _ = self._model.predict(observation, deterministic=True)
        return np.asarray(actions, dtype=np.float64)

    def execute(self, scenes: Scenes, decisions: Float) -> SimulationResults:
        """Play every episode to its end, beginning with the given actions."""
        env = self._env(len(decisions))
        env.reset(options=scenes.as_options())
        running, reward = np.ones(len(decisions), dtype=bool), np.zeros(len(decisions))
        last: dict[str, NDArray[Any]] = {}
        while running.any():
            observation, earned, info = env.execute_actions(decisions)
            reward += np.where(running, earned, 0.0)
            last = {name: np.where(running, now, last.get(name, now)) for name, now in info.items()}
            running &= ~(env.terminated | env.truncated)
            decisions = self.decide(observation, scenes)
        return SimulationResults(reward, last)

    def _env(self, number: int) -> VelocityVectorEnv:
        if number not in self._envs:
            env: Any = gym.make_vec(self._env_id, num_envs=number, **self._kwargs)
            self._envs[number] = env
        return self._envs[number]
