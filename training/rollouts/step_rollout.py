"""Rollouts of agents that act in every control step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import Motion
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.registration import STEP_TASKS, twin_of
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import SimulationResults

if TYPE_CHECKING:
    from viapoint.envs.velocity_env import VelocityVectorEnv


def is_step_wise(env_id: str) -> bool:
    """Return whether an action of an environment lasts one control step only."""
    return env_id in STEP_TASKS


def whole_task(env_id: str, kwargs: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return id and arguments of the equivalent task with whole movements as actions; of most tasks, their own."""
    if not is_step_wise(env_id):
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
