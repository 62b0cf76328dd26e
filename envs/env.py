"""One environment, a batch of one, and the recording of its movements."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import FrameType
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

from viapoint.envs.common.arrays import Observation
from viapoint.envs.common.validation import finite_array
from viapoint.envs.episodes import History
from viapoint.envs.outcome import Rollout
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.envs.vector_env import SINGLE_METADATA, ReachVectorEnv


class ReachEnv(gym.Env[Any, Any]):
    """One environment of a :class:`~viapoint.envs.vector_env.ReachVectorEnv`, with the same keyword arguments.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> type(env.unwrapped).__name__
        'ReachEnv'
    """

    metadata = SINGLE_METADATA

    def __init__(self, **kwargs: Any) -> None:
        if "num_envs" in kwargs:
            raise TypeError("got an unexpected keyword argument 'num_envs'; gym.make_vec makes batches")
        self.batch = ReachVectorEnv(1, **kwargs)
        """Vector environment with one environment."""
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.render_mode = self.batch.render_mode
        self._over = True
        self._warned = False

    @property
    def task(self) -> Task:
        """Task of an episode."""
        return self.batch.task

    @property
    def last_rollout(self) -> Rollout | None:
        """Last movement at every physics step; None before the first."""
        rollouts = self.batch.last_rollout
        return rollouts[0] if rollouts else None

    @property
    def scenes(self) -> Scenes | None:
        """The scene of the episode, as a batch of one; None before the first reset."""
        return self.batch.scenes

    @property
    def last_plan(self) -> Plan | None:
        """Last decision as via-points (K + 2, D) and durations (K + 1,) [s]; None before the first."""
        plan = self.batch.last_plan
        return None if plan is None else plan.take(0)

    @property
    def last_plans(self) -> History:
        """All plans of the episode with the times at which they began, [s]."""
        return self.batch.last_plans[0]

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
        """Start a new episode; see :meth:`~viapoint.envs.vector_env.ReachVectorEnv.reset`."""
        self.batch.use_generator(self._np_random, self._np_random_seed)
        observation, info = self.batch.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.batch.np_random, self.batch.np_random_seed
        self._over = False
        return {name: part[0] for name, part in observation.items()}, info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one decision; see :meth:`~viapoint.envs.vector_env.ReachVectorEnv.step`.

        Args:
            action: Shape (m,), in [-1, 1]; components beyond are clipped.
        """
        if self._over:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        names = self.batch.action_names
        action = finite_array(f"action ({', '.join(names)})", action, (len(names),))
        decision = self.batch.execute_actions([action])
        terminated = bool(decision.terminated[0])
        truncated = bool(decision.truncated[0])
        self._over = terminated or truncated
        seen = {name: part[0] for name, part in decision.observation.items()}
        values = {name: value[0].item() for name, value in decision.info.items()}
        return seen, float(decision.reward[0]), terminated, truncated, values

    def render(self) -> Any:
        """Render the last movement in the render mode; after a reset, the scene."""
        if not self._warned and not self.task.stepwise and _is_recorded():
            self._warned = True
            gym.logger.warn(
                "RecordVideo keeps one frame of each step, and here a step is a movement: "
                "viapoint.envs.RecordMovements with render_mode='rgb_array_list' keeps all frames"
            )
        frames = self.batch.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Stop worker threads and close the render window."""
        self.batch.close()


def _is_recorded() -> bool:
    """Return True if Gymnasium's RecordVideo, which does not say so, has asked for a picture."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if frame.f_code is RecordVideo._capture_frame.__code__:
            return True
        frame = frame.f_back
    return False


class RecordMovements(RecordVideo[Any, Any]):
    """Version of Gymnasium's `RecordVideo` that keeps every frame of a movement.

    `RecordVideo` takes one frame per step, so with `render_mode="rgb_array_list"` it keeps only the last frame of the
    list. This wrapper keeps all frames, whether a movement is one step or several. The arguments are those of
    `RecordVideo`; moviepy must be installed.

    Raises:
        ValueError: The environment's `render_mode` is not `rgb_array_list`.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("viapoint.envs:viapoint/PlanarReach-v0", render_mode="rgb_array_list")
        >>> env = RecordMovements(env, "videos")  # doctest: +SKIP
    """

    recorded_frames: list[Any] = []  # noqa: RUF012 - Gymnasium reads it in `__del__`, also after an error in `__init__`

    def __init__(self, env: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> None:
        if env.render_mode != "rgb_array_list":
            raise ValueError(
                "RecordMovements records every frame of a movement and needs render_mode='rgb_array_list', "
                f"got {env.render_mode!r}; Gymnasium's RecordVideo records one frame per step"
            )
        super().__init__(env, *args, **kwargs)
        self._shown = 0
        """Number of frames of the episode that are in the video."""

    def reset(self, **kwargs: Any) -> Any:
        """Reset the environment, and start a video if the episode is to be recorded."""
        self._shown = 0
        return super().reset(**kwargs)

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        self.recorded_frames.extend(frames[self._shown :])
        # Each step returns the frames from the beginning of the episode.
        self._shown = len(frames)
