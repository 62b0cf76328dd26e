"""Environment in which one decision is one movement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.utils import EzPickle

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.types import Observation
from viapoint.envs.common.validation import as_given
from viapoint.envs.sim.outcome import Rollout
from viapoint.envs.vector_env import METADATA, ReachVectorEnv

__all__ = ["ReachEnv", "ReachVectorEnv"]

SINGLE_METADATA = {name: value for name, value in METADATA.items() if name != "autoreset_mode"}


class ReachEnv(gym.Env[Any, Any], EzPickle):
    """One environment of a :class:`ReachVectorEnv`, with the same keyword arguments.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> type(env.unwrapped).__name__
        'ReachEnv'
    """

    metadata = SINGLE_METADATA
    batch_kind: ClassVar[type[ReachVectorEnv]] = ReachVectorEnv
    """Vector environment class that this environment wraps."""

    def __init__(self, *, threads: int = 1, **kwargs: Any) -> None:
        EzPickle.__init__(self, threads=threads, **as_given(kwargs))
        self.batch = self.batch_kind(1, threads=threads, **kwargs)
        """Vector environment with one environment."""
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.render_mode = self.batch.render_mode
        self.task = self.batch.task
        self.action_layout = self.batch.action_layout
        self.observation_layout = self.batch.observation_layout
        self._over = True

    @property
    def last_rollout(self) -> Rollout | None:
        """Last movement at every physics step; None before the first."""
        rollouts = self.batch.last_rollout
        return rollouts[0] if rollouts else None

    @property
    def last_plan(self) -> Plan | None:
        """Last decision as via-points (K + 2, D) [m] and durations (K + 1,) [s]; None before the first."""
        plan = self.batch.last_plan
        return None if plan is None else plan.take(0)

    @property
    def model(self) -> Any:
        """MuJoCo model."""
        return self.batch.model

    @property
    def physics_steps(self) -> int:
        """Physics steps simulated so far."""
        return self.batch.physics_steps

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; see :meth:`ReachVectorEnv.reset`."""
        self.batch.use_generator(self._np_random, self._np_random_seed)
        observation, info = self.batch.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.batch.np_random, self.batch.np_random_seed
        self._over = False
        if self.render_mode == "human":
            self.batch.render()
        return _only(observation), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one action, see :meth:`ReachVectorEnv.step`; where it is a movement, it ends the episode.

        Args:
            action: Shape (m,), in [-1, 1]; components beyond are clipped.
        """
        if self._over:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        observation, reward, info = self.batch.execute_actions([action])
        terminated, truncated = bool(self.batch.terminated[0]), bool(self.batch.truncated[0])
        self._over = terminated or truncated
        values = {name: value[0].item() for name, value in info.items()}
        return _only(observation), float(reward[0]), terminated, truncated, values

    def render(self) -> Any:
        """Render the last movement in the render mode; after a reset, the scene."""
        frames = self.batch.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Stop worker threads and close the render window."""
        self.batch.close()


def _only(observation: Observation) -> Observation:
    return {name: part[0] for name, part in observation.items()}
