"""Environments, agent and comparison of methods that all tabs of the live page share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from viapoint.envs.common.types import Observation
from viapoint.envs.mdp.task import Task
from viapoint.envs.registration import STEP_TASKS
from viapoint.envs.scenes.scene import Scenes, check_scenes
from viapoint.training.agents.agent import Agent
from viapoint.training.live.decisions import DecisionMaker
from viapoint.training.live.drawing import ArmDrawing
from viapoint.training.live.movements import DECISION_INTERVAL
from viapoint.training.live.scene_draws import Draw, scene_kinds
from viapoint.training.live.scene_file import SCENE_SHAPES, LiveScene, from_json
from viapoint.training.planning.baselines import Method, agent_method, make_method
from viapoint.training.rollouts.rollout import SceneSimulation, new_simulation, whole_task

BASELINES = {"straight": "straight", "geometry search": "search512", "planner": "planner"}
"""Compared methods by their names in the table."""
MOST_SHOWN = 24
"""Greatest number of obstacles of a scene."""


class MethodResult(NamedTuple):
    """Simulated outcome of a method in one scene."""

    name: str
    success: bool
    reward: float
    clearance: float
    """Least clearance of the executed movement, [m]."""
    jerk_ratio: float
    seconds: float
    """Time of the decision, [s]."""


class Setting:
    """Environment, what decides in it (without an agent the geometry search), and a comparison of methods."""

    def __init__(self, env_id: str, agent: Agent | None, env_kwargs: Mapping[str, Any]) -> None:
        self.env_id, self.agent, self.env_kwargs = env_id, agent, dict(env_kwargs)
        self.whole_id, self.whole_kwargs = whole_task(env_id, self.env_kwargs)
        env = self.make_env()
        self.task: Task = env.task
        self.model = env.model
        env.close()
        self._steps = agent is not None and env_id in STEP_TASKS
        self.decisions = DecisionMaker(self.task, None if self._steps else agent)
        self._simulation: SceneSimulation | None = None
        self._methods: dict[str, Method] = {}
        self.comparing = threading.Lock()
        """Lock of the comparison, whose environments all tabs share."""

    def make_env(self) -> Any:
        """Return a vector environment of one environment, whose actions are whole movements or revisions of them."""
        kwargs = dict(self.whole_kwargs)
        env: Any = gym.make_vec(self.whole_id, num_envs=1, threads=1, **kwargs)
        if env.unwrapped.task.replanning and "horizon" not in kwargs:
            env.close()
            env = gym.make_vec(self.whole_id, num_envs=1, threads=1, **kwargs, horizon=DECISION_INTERVAL)
        return env.unwrapped

    def make_step_env(self) -> Any:
        """Return an environment for an agent that acts in every control step; None for other agents."""
        if not self._steps:
            return None
        env: Any = gym.make_vec(self.env_id, num_envs=1, threads=1, **self.env_kwargs)
        return env.unwrapped

    def observe(self, scene: LiveScene, env: Any) -> Observation:
        """Return the first observation in a scene, after a check of the scene.

        Args:
            scene: Scene with the rows of this setting.
            env: Environment of :meth:`make_env`.

        Raises:
            ValueError: The scene is impossible, with the reason.
        """
        check_scenes(scene.batch(), self.task.collision_model)  # type: ignore[arg-type]
        observation: Observation
        if self.task.replanning:
            observation = env.reset(options=scene.options(changing=True))[0]
            return observation
        rows = self._filled(scene)
        joints = np.asarray(self.task.arm.inverse_kinematics(rows.start))
        observation = self.task.observation.observe(joints, rows.start, rows)
        return observation

    def compare(self, scene: LiveScene, checks: int = 0) -> Iterator[tuple[str, Callable[[], MethodResult]]]:
        """Yield the name of each method and a function that lets it decide in a scene and simulates its decision."""
        if self.agent is not None:
            ranks = hasattr(self.agent.policy, "checks")
            method = agent_method("agent", self.agent, checks if ranks else None)
            yield "agent", lambda: self._result("agent", method, scene)
        for name, known in BASELINES.items():
            yield name, lambda name=name, known=known: self._result(name, self._baseline(known), scene)  # type: ignore[misc]

    def close(self) -> None:
        """Close the environments of the comparison."""
        if self._simulation is not None:
            self._simulation.close()

    def _baseline(self, name: str) -> Method:
        if name not in self._methods:
            self._methods[name] = make_method(name, self.whole_id, **self.whole_kwargs)
        return self._methods[name]

    def _result(self, name: str, method: Method, scene: LiveScene) -> MethodResult:
        if self._simulation is None:
            self._simulation = new_simulation(self.whole_id, 1, **self.whole_kwargs)
        simulation, scenes = self._simulation, self._filled(scene)
        observation = simulation.observe(scenes)
        begin = time.perf_counter()
        decisions = method.decide(observation, scenes)
        seconds = time.perf_counter() - begin
        results = simulation.play(method, scenes, decisions)
        info = results.info
        return MethodResult(
            name=name, success=bool(results.success[0]), reward=float(results.reward[0]),
            clearance=float(info["min_clearance"][0]), jerk_ratio=float(info["jerk_ratio"][0]), seconds=seconds,
        )  # fmt: skip

    def _filled(self, scene: LiveScene) -> Any:
        """Return a scene as a batch of one, with as many rows of obstacles as the observation has."""
        changing = scene.batch()
        scenes: Any = changing if self.task.replanning else Scenes(*changing[:3])
        missing = self.task.observation.n_rows - len(scene.obstacles)
        names = [name for name in ("obstacles", "courses") if name in scenes._fields]
        padded = {name: np.pad(getattr(scenes, name), ((0, 0), (0, missing), (0, 0))) for name in names}
        return scenes._replace(**padded)

    def limit(self, scene: LiveScene) -> str:
        """Return the limit of the environment that a scene exceeds, as part of a sentence; "" if it has room for it."""
        known, most = self.task.scenes.shapes, self.task.observation.n_rows
        others = [name for name in scene.shapes if name not in known]
        others = [name for name in others if name != "sphere" or "capsule" not in known]
        if not most and len(scene.obstacles):
            return "without obstacles"
        if others:
            return f"without {others[0].replace('_', '-')} obstacles"
        return f"with at most {most} obstacles" if len(scene.obstacles) > most else ""


class Shared:
    """Settings, and everything else that is expensive to make, for all tabs; arguments as of :class:`LivePage`."""

    def __init__(
        self,
        env_id: str,
        agent: Agent | None,
        *,
        model_file: str | Path | None,
        seed: int | None,
        env_kwargs: Mapping[str, Any],
    ) -> None:
        self.own = Setting(env_id, agent, env_kwargs)
        """Setting of the agent."""
        self._wide: Setting | None = None
        self._making = threading.Lock()
        self._model_file, self._seed = model_file, seed
        self.drawing()

    def setting_of(self, scene: LiveScene) -> Setting:
        """Return the agent's setting, or one with room for more obstacles of any shape, where the agent is not used."""
        if not self.own.limit(scene):
            return self.own
        if len(scene.obstacles) > MOST_SHOWN:
            raise ValueError(f"a scene has at most {MOST_SHOWN} obstacles, got {len(scene.obstacles)}")
        with self._making:
            if self._wide is None:
                room = {"shapes": SCENE_SHAPES, "n_obstacles": (0, MOST_SHOWN)}
                self._wide = Setting(self.own.env_id, None, self.own.env_kwargs | room)
        return self._wide

    def read(self, content: bytes) -> LiveScene:
        """Return the scene of a JSON file.

        Raises:
            ValueError: The file holds no scene, or an impossible one.
        """
        scene = from_json(content, self.own.task.arm.dimension)
        try:
            task = self.setting_of(scene).task
            check_scenes(scene.with_shapes(task.scenes.shapes).batch(), task.collision_model)  # type: ignore[arg-type]
        except ValueError as error:
            reason = str(error).removeprefix("scene 0: ")
            raise ValueError(f"the scene file is impossible: {reason}") from None
        return scene

    def drawing(self) -> ArmDrawing:
        """Return the parts of the arm."""
        return ArmDrawing(self.own.task.arm, self.own.model, self._model_file)

    def scene_kinds(self) -> dict[str, Draw]:
        """Return functions that draw scenes, by the names of their buttons."""
        return scene_kinds(self.own.whole_id, self.own.whole_kwargs, self.own.task, self._seed)

    def close(self) -> None:
        """Close the environments of the comparisons."""
        for setting in (self.own, self._wide):
            if setting is not None:
                setting.close()
