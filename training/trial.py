"""Trying actions out: any actions in any scenes, in simulation, as many as one likes."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.reach import ReachVectorEnv
from viapoint.envs.scenes import Scenes

Float = NDArray[np.float64]


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
        self.env_id = env_id
        sizes = {num_envs, min(num_envs, 64)}
        self._envs: dict[int, ReachVectorEnv] = {
            size: gym.make_vec(env_id, num_envs=size, **kwargs)  # type: ignore[misc]
            for size in sorted(sizes)
        }
        self.task = self._envs[num_envs].task
        self._capacity = num_envs

    def observe(self, scenes: Scenes) -> dict[str, NDArray[np.float32]]:
        """First observations in N scenes, without a simulation."""
        joints = np.asarray(self.task.arm.posture(scenes.start))
        return self.task.observation.observe(joints, scenes.start, scenes)

    def __call__(self, scenes: Scenes, actions: Float) -> Trials:
        """Simulate one action in each of N scenes, one or more."""
        pieces = [
            self._some(scenes.take(slice(i, i + self._capacity)), actions[i : i + self._capacity])
            for i in range(0, len(actions), self._capacity)
        ]
        info = {name: np.concatenate([piece.info[name] for piece in pieces]) for name in pieces[0].info}
        return Trials(np.concatenate([piece.reward for piece in pieces]), info)

    def _some(self, scenes: Scenes, actions: Float) -> Trials:
        """As many as there are environments at most; those left over repeat the first."""
        number = len(actions)
        size = next(size for size in self._envs if size >= number)
        env = self._envs[size]
        env.reset(options=_filled(scenes, size).as_options())
        _, reward, info = env.decide(np.concatenate((actions, np.tile(actions[:1], (size - number, 1)))))
        return Trials(reward[:number], {name: value[:number] for name, value in info.items()})

    def close(self) -> None:
        """Let the environments go."""
        for env in self._envs.values():
            env.close()


def _filled(scenes: Scenes, number: int) -> Scenes:
    missing = number - len(scenes.start)
    return Scenes(*(np.concatenate((field, np.repeat(field[:1], missing, axis=0))) for field in scenes))
