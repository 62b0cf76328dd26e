"""Trying actions out: any actions in any scenes, in simulation, as many as one likes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.action import Plan
from viapoint.envs.reach import ReachVectorEnv
from viapoint.envs.reach_vector import Decision
from viapoint.envs.registration import check_registered
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
        joints = np.asarray(self.task.arm.posture(scenes.start))
        return self.task.observation.observe(joints, scenes.start, scenes)

    def __call__(self, scenes: Scenes, actions: Float) -> Trials:
        """Simulate one action in each of N scenes, one or more."""
        return self._try(scenes, (actions,), lambda env, some: env.decide(some))

    def play(self, method: Any, scenes: Scenes, decided: Float) -> Trials:
        """Simulate what a method has decided in N scenes, or let it do so itself where it can."""
        trials: Trials = getattr(method, "carry_out", self)(scenes, decided)
        return trials

    def perform(self, scenes: Scenes, plan: Plan) -> Trials:
        """Simulate one plan in each of N scenes, one or more; plans may have any number of via-points."""
        return self._try(scenes, plan, lambda env, *some: env.perform(Plan(*some)))

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
