"""Agents: algorithms of Stable-Baselines3 that are saved as model folders and plan without an environment."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np
import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from viapoint.envs.common.arrays import Observation
from viapoint.envs.common.validation import did_you_mean, finite_array
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training.agents.model_io import ALGORITHMS, load_model, save_model
from viapoint.training.checks import SHIPPED, SHIPPED_IDS
from viapoint.training.files import BadFileError, write_folder
from viapoint.training.planning.beliefs import Sight
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.plan_motion import checked_motion
from viapoint.training.vec_env import env_arguments, predicted_actions

SAME_RAY = 0.02  # Greatest distance of a point from the ray of the sensor, [m]


def checked_observation(observation: Any, space: spaces.Dict, task: Task) -> Observation:
    """Return the parts of an observation of a task, or of a batch of them, after a check.

    Raises:
        ValueError: The observation has other parts or sizes than the observation space, or is not finite; in tasks with
            whole movements, start and goal are the same; points are not on the rays of the task's sensor.
    """
    wanted = ", ".join(space.spaces)
    if not isinstance(observation, Mapping):
        raise ValueError(f"observation must be a dict of {wanted}; got {type(observation).__name__}")
    if observation.keys() != space.spaces.keys():
        got = ", ".join(map(str, observation))
        raise ValueError(f"observation must have the parts {wanted}; got {got}")
    arrays = {}
    batch = {}
    for name, box in space.spaces.items():
        shape: Any = box.shape
        finite_array(name, observation[name], (..., *shape))
        arrays[name] = np.asarray(observation[name])
        batch[name] = arrays[name].reshape(-1, *shape)
    here, there = ("joints", "goal_joints") if "goal_joints" in batch else ("hand", "goal")
    apart = batch[here] != batch[there]
    if task.whole_movement and not apart.any(axis=-1).all():
        raise ValueError("start and goal must differ: no movement leads from a point to itself")
    if task.sensor is not None and len(apart):
        _check_rays(Sight.of(batch, task), task.sensor)
    return arrays


def _check_rays(sight: Sight, sensor: Sensor) -> None:
    """Check that readings are those of the sensor of the training."""
    if (sight.ranges > sensor.range + SAME_RAY).any():
        raise ValueError(
            f"ranges must be at most {sensor.range:g} m, as in training, got {sight.ranges.max():.3g}"
        )
    rays = np.einsum("nlij,rj->nlri", sight.rotation, sensor.directions).reshape(sight.points.shape)
    apart = np.abs(sight.eyes + sight.ranges[..., None] * rays - sight.points)
    farthest = apart.reshape(*sight.made.shape, -1)[sight.made].max(initial=0.0)
    if farthest > SAME_RAY:
        raise ValueError(
            f"points must lie on the rays of the sensor of the training, {sensor}, got {farthest:.2g} m from them"
        )


class Agent(BaseAlgorithm):
    """Learning algorithm of Stable-Baselines3 whose models are folders of JSON and safetensors.

    All agents that :func:`load_agent` returns are of this class. `predict`, `learn` and `set_env` are those of
    Stable-Baselines3.

    Example:
        >>> import numpy as np
        >>> from viapoint.training import load_agent
        >>> agent = load_agent("viapoint/PlanarObstacles-v0")
        >>> post = {"shape": "cylinder", "radius": 0.03, "half_length": 0.04, "position": (-0.05, 0.35, 0.0)}
        >>> plan = agent.plan(start=(-0.2, 0.3), goal=(0.1, 0.4), obstacles=[post])
        >>> plan.success, plan.waypoints.shape  # start, via-point and goal, [m]
        (True, (3, 2))
        >>> plan.trajectory()(np.linspace(0.0, plan.durations.sum(), 50)).shape  # positions of the hand, [m]
        (50, 2)
    """

    trainable: bool = True
    """Mark of an agent that has a replay buffer to learn with."""

    @property
    def env_id(self) -> str:
        """Id of the environment that the agent decides in."""
        return env_arguments(self.get_env())[0]

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of that environment, without those that belong to its id."""
        return env_arguments(self.get_env())[1]

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """Return actions for one observation or a batch, and no state, as in Stable-Baselines3.

        Raises:
            ValueError: The observation cannot be one of the agent's environment: it has other parts or sizes, is not
                finite, or holds readings of another sensor.
        """
        normalize, env = self.get_vec_normalize_env(), self.get_env()
        raw = normalize is None or not normalize.norm_obs
        # Policies that know the task check observations themselves.
        if raw and env is not None and not hasattr(self.policy, "task"):
            (task,) = env.get_attr("task", [0])
            space: Any = self.observation_space
            observation = checked_observation(observation, space, task)
        return super().predict(observation, *args, **kwargs)

    def plan(self, start: Any, goal: Any, obstacles: Any = ()) -> MotionPlan:
        """Return the plan of a movement from rest to rest among obstacles that stand still, without an environment.

        The plan is the one that an environment with this scene would execute after `predict`. Its `success` tells
        whether it touches nothing and keeps the limits.

        Args:
            start: Start, as `reset` takes it: a position of the hand, joint positions, or a pose.
            goal: Goal, likewise.
            obstacles: Shapes or dictionaries, at most as many as the environment of the agent may have.

        Raises:
            ValueError: An argument is not allowed, the scene is impossible, or an action of the agent is not a whole
                movement.
        """
        (task,) = self.env.get_attr("task", [0])  # type: ignore[union-attr]
        if not task.whole_movement:
            raise ValueError(
                f"plan() needs an agent whose actions are whole movements; in {self.env_id} an action depends on the "
                "motion under way: step the environment with predict()"
            )
        given = {"start": start, "goal": goal, "obstacles": obstacles}
        scenes = draw_given(given, task.sampler(), [np.random.default_rng(0)])
        arm = task.arm
        goals = scenes.goal, arm.hand(scenes.goal)
        seen = task.observation.observe(scenes.start, arm.hand(scenes.start), goals, scenes.obstacles)
        actions = predicted_actions(self, seen)
        ends = task.space.coordinates(scenes.start), task.space.coordinates(scenes.goal)
        plan = task.action.decode(np.asarray(actions, dtype=np.float64), *ends).take(0)
        return checked_motion(arm, task.space_name, plan, scenes.obstacles, "agent")

    def save(self, path: str | Path) -> None:  # type: ignore[override]
        """Write the agent as a folder of `model.json` and `weights.safetensors`.

        The folder is replaced as a whole. It holds what decisions and further training from these weights need; the
        replay buffer and the state of the optimizer are in the checkpoints of a run only.

        Args:
            path: Folder to write; a suffix `.zip`, which callbacks of Stable-Baselines3 add, is dropped.

        Raises:
            ValueError: The agent has no environment of this package, or holds objects that JSON cannot represent.
        """
        write_folder(
            Path(os.fspath(path).removesuffix(".zip")).expanduser(), lambda folder: save_model(self, folder)
        )

    @classmethod
    def load(cls, path: str | Path, env: GymEnv | None = None) -> Self:  # type: ignore[override]
        """Load an agent of this algorithm; see :func:`load_agent`, which loads those of every algorithm.

        Args:
            path: Model folder, run folder, or id of an environment with a shipped agent.
            env: Environment to continue training on, with any number of copies; if not given, the agent can decide but
                not learn.

        Raises:
            ValueError: There is no agent, its files are damaged, or it is of another algorithm.
        """
        wrapped = None if env is None else BaseAlgorithm._wrap_env(env)
        model: Any = load_model(find_model(path), wrapped)
        if not isinstance(model, cls):
            raise ValueError(
                f"{path} holds an agent of {type(model).__name__}, not of {cls.__name__}; load_agent() loads both"
            )
        model.trainable = env is not None
        return model

    def _setup_model(self) -> None:
        buffer = getattr(self, "replay_buffer_class", None)
        if buffer is not None and issubclass(buffer, HerReplayBuffer):
            raise ValueError(
                "HerReplayBuffer does not apply: the observation has no achieved_goal, and the reward of another goal "
                "depends on contact and jerk of a movement that was not made; leave replay_buffer_class out"
            )
        super()._setup_model()  # type: ignore[safe-super]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        if not self.trainable:
            kind = type(self).__name__
            raise ValueError(
                f"this agent was loaded for decisions; {kind}.load(path, env=ViaVecEnv(...)) loads it for training"
            )
        return super()._setup_learn(*args, **kwargs)


class SAC(Agent, stable_baselines3.SAC):
    """SAC of Stable-Baselines3."""


class TD3(Agent, stable_baselines3.TD3):
    """TD3 of Stable-Baselines3."""


class PPO(Agent, stable_baselines3.PPO):
    """PPO of Stable-Baselines3."""


class TQC(Agent, sb3_contrib.TQC):
    """TQC of sb3-contrib."""


ALGORITHMS.update(sac=SAC, td3=TD3, ppo=PPO, tqc=TQC)


def load_agent(source: str | Path, env: GymEnv | None = None) -> Agent:
    """Load a trained agent of any algorithm.

    Args:
        source: Id of an environment, for the agent that is shipped for it; a run folder, for its best model; or a
            model folder, such as `runs/first/final`.
        env: Environment to continue training on, with any number of copies; if not given, the agent can decide but not
            learn.

    Returns:
        The agent, with `predict`, `plan`, `learn` and `save`.

    Raises:
        ValueError: There is no agent, or its files are damaged; the message lists the shipped agents.

    Example:
        >>> import gymnasium as gym
        >>> from viapoint.training import load_agent
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> agent = load_agent("viapoint/PlanarObstacles-v0")
        >>> action, _ = agent.predict(observation, deterministic=True)
        >>> *_, info = env.step(action)
        >>> info["is_success"]
        True
    """
    return Agent.load(source, env)


def find_model(source: str | Path) -> Path:
    """Return the model folder that an id, a run folder or a model folder stands for.

    Raises:
        ValueError: It is none of them.
    """
    source = str(source).removeprefix("viapoint.envs:")
    folder = Path(source).expanduser()
    known = ", ".join(SHIPPED_IDS)
    if source in SHIPPED_IDS:
        return SHIPPED / folder.name
    if source in gym.registry:
        raise ValueError(f"no agent is shipped for {source!r}; agents are shipped for {known}")
    if folder.suffix == ".zip" and not folder.exists():
        folder = folder.with_suffix("")
    if (folder / "model.json").is_file():
        return folder
    if (folder / "config.json").is_file():
        return best_model(folder)
    if folder.suffix == ".zip":
        raise BadFileError(
            folder, "is an archive of Stable-Baselines3, which may hold code: use `load` of its class"
        )
    hint = did_you_mean(source, SHIPPED_IDS) or f"; agents are shipped for {known}"
    raise BadFileError(folder, f"is no run folder, model folder or id of a shipped agent{hint}")


def best_model(run: Path) -> Path:
    """Return the folder of the best model of a run, or of the last one where training did not validate.

    Raises:
        BadFileError: The run has no model yet.
    """
    for name in ("best", "final"):
        replaced = sorted(run.glob(f".{name}.*.old"))  # there is one amid a replacement only
        for folder in (run / name, *replaced):
            if (folder / "model.json").is_file():
                return folder
    raise BadFileError(run, "holds no model yet")
