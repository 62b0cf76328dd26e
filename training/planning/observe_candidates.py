"""Wrappers that add the computed clearances of fixed candidate plans to observations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from viapoint.envs.common.types import Observation, Single
from viapoint.envs.common.validation import whole_number
from viapoint.training.planning.candidates import OBSERVED, candidate_actions
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import plan_clearances

if TYPE_CHECKING:
    from viapoint.envs.task import Task

    VectorWrapper = gym.vector.VectorWrapper[Any, Any, Any, Any, Any]
else:
    VectorWrapper = gym.vector.VectorWrapper  # not generic before Gymnasium 1.4

MOST_OBSERVED = 4096
"""Greatest number of observed candidates."""
BOUND = 0.05
"""Bound of the observed margins, [m]: the scale of the reward's clearance term."""


def candidate_margins(observation: Mapping[str, NDArray[Any]], task: Task, number: int) -> Single:
    """Return the computed margins of fixed candidate plans, shape (B, number), [m].

    The margin of a plan is its clearance, clipped to +- BOUND; -BOUND where it leaves the reach. Candidate k is the
    same action in every observation, see :func:`~viapoint.training.planning.candidates.candidate_actions`; the first
    one is the zero action.
    """
    actions = candidate_actions(task, number, replanning=task.replanning)
    every = np.broadcast_to(actions, (len(observation["hand"]), *actions.shape))
    found = plan_clearances(task, Problem.of_observation(observation, task), every, BOUND, -BOUND)
    margin: Single = found.clip(-BOUND, BOUND).astype(np.float32)
    return margin


def with_candidates(observation: Mapping[str, NDArray[Any]], task: Task, number: int) -> Observation:
    """Return one observation or a batch with the margins of candidate plans; one that has them is returned as it is."""
    parts = {name: np.asarray(part) for name, part in observation.items()}
    if OBSERVED in parts:
        return parts
    single = parts["hand"].ndim == 1
    batch = {name: part[None] for name, part in parts.items()} if single else parts
    margins = candidate_margins(batch, task, number)
    return {**parts, OBSERVED: margins[0] if single else margins}


class ObserveCandidates(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Wrapper that adds the computed margins of fixed candidate plans to the observation of one environment.

    The observation gets a part `candidates`, shape (n_candidates,), [m]: the clearance of each plan, clipped to
    +-0.05 m. The plans are the zero action and points of a Sobol sequence, the same ones in
    every scene. So an algorithm that learns from observations alone gets what a search computes. After the end of an
    episode the part is zero. :class:`VectorObserveCandidates` wraps vector environments.

    Args:
        env: Environment of this package in which an action is a whole movement.
        n_candidates: Number of candidate plans, 1 to MOST_OBSERVED.

    Raises:
        ValueError: The environment is another one, or the number is not allowed.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import SAC
        >>> from viapoint.training import ObserveCandidates
        >>> env = ObserveCandidates(gym.make("viapoint.envs:viapoint/PlanarObstacles-v0"), n_candidates=16)
        >>> observation, _ = env.reset(seed=0)
        >>> observation["candidates"].shape  # [m]
        (16,)
        >>> model = SAC("MultiInputPolicy", env, learning_starts=4).learn(8)
    """

    def __init__(self, env: gym.Env[Any, Any], n_candidates: int = 32) -> None:
        RecordConstructorArgs.__init__(self, n_candidates=n_candidates)
        super().__init__(env)
        self.n_candidates, self._task = _checked(env, n_candidates)
        self.observation_space = _extended(env.observation_space, self.n_candidates)

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; see the wrapped environment."""
        observation, info = self.env.reset(**kwargs)
        return with_candidates(observation, self._task, self.n_candidates), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Execute an action; see the wrapped environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            seen = _ended(observation, self.n_candidates)
        else:
            seen = with_candidates(observation, self._task, self.n_candidates)
        return seen, reward, terminated, truncated, info


class VectorObserveCandidates(VectorWrapper, RecordConstructorArgs):
    """Wrapper like :class:`ObserveCandidates` for vector environments, which computes all candidates in one batch.

    Args:
        env: Vector environment of this package in which an action is a whole movement.
        n_candidates: Number of candidate plans, 1 to MOST_OBSERVED.

    Raises:
        ValueError: The environment is another one, or the number is not allowed.

    Example:
        >>> import gymnasium as gym
        >>> from viapoint.training import VectorObserveCandidates
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=8)
        >>> observation, _ = VectorObserveCandidates(envs, n_candidates=16).reset(seed=0)
        >>> observation["candidates"].shape  # [m]
        (8, 16)
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], n_candidates: int = 32) -> None:
        RecordConstructorArgs.__init__(self, n_candidates=n_candidates)
        super().__init__(env)
        self.n_candidates, self._task = _checked(env, n_candidates)
        self.single_observation_space = _extended(env.single_observation_space, self.n_candidates)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes; see the wrapped environment."""
        observation, info = self.env.reset(**kwargs)
        return with_candidates(observation, self._task, self.n_candidates), info

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Execute an action in each environment; see the wrapped environment."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            final = info["final_obs"].copy()
            for row in np.flatnonzero(terminated | truncated):
                if terminated[row]:
                    final[row] = _ended(final[row], self.n_candidates)
                else:
                    final[row] = with_candidates(final[row], self._task, self.n_candidates)
            info = {**info, "final_obs": final}
        seen = with_candidates(observation, self._task, self.n_candidates)
        return seen, reward, terminated, truncated, info


def _checked(env: Any, number: Any) -> tuple[int, Task]:
    """Return the number of candidates and the task of an environment.

    Raises:
        ValueError: An action is no whole movement, or the number is not allowed.
    """
    task = getattr(env.unwrapped, "task", None)
    if task is None or task.stepwise:
        raise ValueError(
            "candidates are observed in environments of this package whose actions are whole movements, such as "
            f"viapoint/PlanarObstacles-v0; got {env}"
        )
    if whole_number("n_candidates", number, 1) > MOST_OBSERVED:
        raise ValueError(f"n_candidates must be at most {MOST_OBSERVED}, got {number}")
    return int(number), task


def _extended(space: Any, number: int) -> spaces.Dict:
    """Return an observation space with the margins of candidates."""
    if OBSERVED in space.spaces:
        raise ValueError("the environment observes candidates already")
    return spaces.Dict({**space.spaces, OBSERVED: spaces.Box(-BOUND, BOUND, (number,), np.float32)})


def _ended(observation: Mapping[str, NDArray[Any]], number: int) -> Observation:
    """Return the observation after the end of an episode, from which nothing is planned."""
    return {**observation, OBSERVED: np.zeros(number, np.float32)}
