"""Rollouts of actions and of methods in given scenes: whole movements, replanning, actions in every control step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import Float, Int, Observation
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.vector_env import ReachVectorEnv
from viapoint.training.planning.search import registered_task

# Function of observations and scenes that returns actions, shape (N, m)
Decide = Callable[[Observation, Scenes], Float]
# Metrics of N simulated actions or episodes by name, `reward` among them, shape (N,) each
Outcomes = dict[str, NDArray[Any]]


class SceneSimulation:
    """Simulation of episodes in given scenes, up to `num_envs` at a time; `kwargs` are arguments of the environment."""

    def __init__(self, env_id: str, num_envs: int = 512, **kwargs: Any) -> None:
        self.env_id = env_id
        self.kwargs = kwargs
        self._capacity = num_envs
        self._envs: dict[int, ReachVectorEnv] = {}
        self.task = registered_task(env_id, **kwargs)

    def observe(self, scenes: Scenes) -> Observation:
        """Return first observations in N scenes."""
        pieces = []
        for _, _, seen in self._begun(scenes):
            pieces.append(seen)
        return joined(pieces)

    def __call__(self, scenes: Scenes, actions: Float, decide: Decide | None = None) -> Outcomes:
        """Simulate one episode in each of N scenes, from first actions (N, m); later ones are decided, or zero."""
        pieces = []
        for rows, env, _ in self._begun(scenes):
            pieces.append(play_episodes(env, scenes.take(rows), actions[rows], decide))
        return joined(pieces)

    def play(self, method: Any, scenes: Scenes, decisions: Float) -> Outcomes:
        """Simulate episodes that begin with decisions of a method; it makes all others or has its own `execute`."""
        if hasattr(method, "execute"):
            results: Outcomes = method.execute(scenes, decisions)
            return results
        return self(scenes, decisions, method.decide)

    def execute_plan(self, scenes: Scenes, plan: Plan) -> Outcomes:
        """Simulate one plan in each of N scenes, N at least 1; plans may have any number of via-points."""
        pieces = []
        for rows, env, _ in self._begun(scenes):
            decision = env.execute_plan(plan.take(rows))
            pieces.append({**decision.info, "reward": decision.reward})
        return joined(pieces)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()

    def _begun(self, scenes: Scenes) -> Iterator[tuple[Int, ReachVectorEnv, Observation]]:
        """Start groups of scenes; yield their rows, a vector environment of as many copies, and observations."""
        for first in range(0, len(scenes.start), self._capacity):
            rows = np.arange(first, min(first + self._capacity, len(scenes.start)))
            if len(rows) not in self._envs:
                made: Any = gym.make_vec(self.env_id, num_envs=len(rows), **self.kwargs)
                self._envs[len(rows)] = made.unwrapped
            env = self._envs[len(rows)]
            yield rows, env, env.begin(scenes.take(rows))


def joined(pieces: Sequence[Mapping[str, NDArray[Any]]]) -> Outcomes:
    """Return arrays by name, joined over batches."""
    arrays = {}
    for name in pieces[0]:
        arrays[name] = np.concatenate([piece[name] for piece in pieces])
    return arrays


def play_episodes(
    env: ReachVectorEnv, scenes: Scenes, first: Float, decide: Decide | None = None
) -> Outcomes:
    """Play one episode in each scene, which have begun, from first actions (N, m); later ones are decided, or zero."""
    number = len(first)
    actions = np.array(first, dtype=np.float64)
    running = np.ones(number, dtype=bool)
    reward = np.zeros(number)
    decisions = np.zeros(number)
    last: Outcomes = {}
    while running.any():
        now = running.copy()
        decision = env.execute_actions(actions, running)
        reward += np.where(now, decision.reward, 0.0)
        decisions += now
        for name, values in decision.info.items():
            last[name] = np.where(now, values, last.get(name, values))
        running &= ~(decision.terminated | decision.truncated)  # which must not go on
        actions[:] = 0.0  # which keeps the plan under way
        rows = np.flatnonzero(running)
        if decide is not None and rows.size:
            seen = {name: part[rows] for name, part in decision.observation.items()}
            actions[rows] = decide(seen, scenes.take(rows))
    last |= {"reward": reward, "decisions": decisions}
    if not env.task.whole_movement:
        last["duration"] = last["time"]  # of the episode, not of its last decision
    return last


def whole_task(env_id: str, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment with which an action is a whole movement; of most tasks, the given ones."""
    task = registered_task(env_id, **kwargs)
    if not task.stepwise:
        return dict(kwargs)
    twin = task.of_movements()
    return {**kwargs, "decide_at": twin.decide_at, "reward_weights": {**vars(twin.weights)}}
