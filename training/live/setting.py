"""Environments and agent of the live page, which all tabs share."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.envs import ReachVectorEnv, Scenes, Task, inverse_kinematics
from viapoint.envs.arms.kinematics import forward
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.clearance import configuration_clearances
from viapoint.envs.geometry.obstacles import KINDS, Obstacles, check_simulated, quaternions_of
from viapoint.envs.scenes.options import draw_given
from viapoint.training.live.decisions import AGENT, MOTION, SEARCH, DecisionMaker
from viapoint.training.live.drawing import ArmDrawing
from viapoint.training.live.movements import DECISION_INTERVAL
from viapoint.training.live.scene import LiveScene
from viapoint.training.paper.movements import TARGETS, rows_of_lights
from viapoint.training.planning.baselines import PLANNERS, PlannerMethod
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import load, shipped_set

N_VIA = 2
"""Number of via-points of the motion planner at first."""
MOST_SHOWN = 24
"""Greatest number of obstacles of a scene."""
SIMULATED = ("sphere", "capsule", "cylinder", "box", "half_space")
"""Shapes that the simulation takes."""
ORIENTED = 6
"""Least number of joints with which the tool can have any orientation."""
NEAR_SEEDS = 8
"""Seeds of the inverse kinematics of a tool that is dragged."""

Draw = Callable[[], tuple[LiveScene, str]]
"""Function that returns the next scene of a kind, and a sentence on where it comes from."""


class Setting:
    """Task of the page with what decides in it: an agent, or the geometry search.

    Args:
        task: Task; where decisions are control steps, the page plans whole movements.
        agent: Agent of that task; None for the geometry search.
    """

    def __init__(self, task: Task, agent: Any = None) -> None:
        self.agent, self.stepwise = agent, task if task.stepwise else None
        task = task.of_movements()
        if task.replanning:
            task = dataclasses.replace(task, horizon=min(task.horizon, DECISION_INTERVAL))
        self.task = task
        self.sampler = task.sampler()
        self.planar = task.arm.space == "hand"
        """True if the arm moves in a horizontal plane."""
        self.height = self.sampler.room.height
        """Half height of obstacles in the plane, [m]."""
        self.decisions = DecisionMaker(task, agent if self.stepwise is None else None)
        others = (AGENT, SEARCH) if agent is not None else (SEARCH,)
        self.methods = others if task.replanning else (MOTION, *others)
        """Names of the methods that can be chosen; the first one is the default."""

    def make_env(self) -> ReachVectorEnv:
        """Return a batch of one environment whose actions are whole movements or revisions of them."""
        return make_env(self.task)

    def make_step_env(self) -> ReachVectorEnv | None:
        """Return an environment for an agent that acts in every control step; None for other agents."""
        if self.stepwise is None or self.agent is None:
            return None
        return make_env(self.stepwise)

    def act(self, observation: Observation) -> Float:
        """Return the velocities that an agent of control steps chooses, shape (1, D)."""
        actions, _ = self.agent.predict(observation, deterministic=True)
        return np.asarray(actions, dtype=np.float64)

    def tool(self, coordinates: Float) -> Float:
        """Return places of the tool, shape (..., 3), [m], for coordinates of shape (..., D)."""
        arm = self.task.arm
        if not self.task.space.of_hand:
            return arm.hand(coordinates)
        level = np.full(coordinates.shape[:-1], arm.hand(arm.home)[2])
        return np.concatenate((coordinates, level[..., None]), axis=-1)

    def moved(self, coordinates: Float, place: Float, obstacles: Obstacles | None, turn: Any = None) -> Float:
        """Return coordinates with the tool at another place, in joint space the nearest ones that are free.

        Args:
            coordinates: Present coordinates, shape (D,).
            place: New place of the tool, shape (3,), [m].
            obstacles: Obstacles of one scene, which are avoided; None for none.
            turn: New orientation of the tool, a quaternion; the present one by default.

        Raises:
            ValueError: The arm cannot reach the place.
        """
        arm = self.task.arm
        if self.task.space.of_hand:
            return np.array(place[:2])
        if turn is None and len(coordinates) >= ORIENTED:
            turn = self.orientation(coordinates)
        found = inverse_kinematics(arm, place, turn, seed=coordinates, n_seeds=NEAR_SEEDS)
        if obstacles is None:
            return np.asarray(found[0])
        rows = obstacles.take(np.zeros(len(found), np.int64))
        clearance = configuration_clearances(arm.chain, arm.spheres, found, rows, np.zeros(len(found)))
        free = clearance.min(axis=-1) > 0.0
        return np.asarray(found[int(free.argmax())])

    def orientation(self, coordinates: Float) -> Float:
        """Return the orientation of the tool for joint positions, a quaternion."""
        _, axes = forward(self.task.arm.chain, coordinates)
        return quaternions_of(axes)

    def limit(self, scene: LiveScene) -> str:
        """Return the limit of the task that a scene exceeds, as part of a sentence; "" if there is none."""
        most = self.task.n_obstacles[1]
        if not most and scene.obstacles:
            return "without obstacles"
        known = {name if name in KINDS else "convex_mesh" for name in self.task.shapes}
        others = [each.kind for each in scene.obstacles if each.kind not in known]
        if others:
            return f"without {others[0].replace('_', '-')} obstacles"
        return f"with at most {most} obstacles" if len(scene.obstacles) > most else ""


class Shared:
    """Settings of the agent and of other scenes, for all tabs.

    Args:
        env_id: Id of the environment.
        agent: Agent; None for the geometry search.
        model_file: MJCF file whose visible geoms are drawn as the arm.
        seed: Seed of the random scenes.
        env_kwargs: Arguments of the environment.
    """

    def __init__(
        self,
        env_id: str,
        agent: Any = None,
        *,
        model_file: str | Path | None = None,
        seed: int | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        self.env_id, self._env_kwargs, self._seed = env_id, dict(env_kwargs or {}), seed
        env: Any = gym.make_vec(env_id, num_envs=1, **self._env_kwargs)
        self.model = env.unwrapped.model
        self.own = Setting(env.unwrapped.task, agent)
        """Setting of the agent."""
        env.close()
        self._wide: Setting | None = None
        self._making = threading.Lock()
        self._model_file = model_file
        self.drawing()  # a file that cannot be drawn is refused
        if model_file is None and self.own.task.arm.file:
            with contextlib.suppress(ValueError):  # MuJoCo alone does not find the meshes of every URDF
                ArmDrawing(self.own.task.arm, self.model, self.own.task.arm.file)
                self._model_file = self.own.task.arm.file
        self._decide_once()

    def _decide_once(self) -> None:
        """Make one decision, which loads compiled functions: the first decision takes no longer than others."""
        env = self.own.make_env()
        observation, _ = env.reset(seed=0)
        assert env.scenes is not None
        self.own.decisions.choose(observation, env.scenes)
        if MOTION in self.own.methods:
            self.own.decisions.plan(LiveScene.of(env.scenes, self.own.task), N_VIA, None, None)
        env.close()

    def drawing(self) -> ArmDrawing:
        """Return the parts of the arm."""
        return ArmDrawing(self.own.task.arm, self.model, self._model_file)

    @functools.cached_property
    def planners(self) -> dict[str, PlannerMethod]:
        """Planners by their names; none where plans are revised, and that of OMPL only with its library."""
        found: dict[str, PlannerMethod] = {}
        if self.own.task.replanning:
            return found
        simulation = SceneSimulation(self.env_id, 1, **self._env_kwargs)
        for name, method in (("plan_motion", "plan_motion"), ("motion planner", "ompl")):
            with contextlib.suppress(ValueError):
                found[name] = PLANNERS[method](simulation)
        return found

    def arguments(self, setting: Setting) -> dict[str, Any]:
        """Return the arguments of an environment that has the scenes of a setting."""
        if setting is self.own:
            return self._env_kwargs
        return {**self._env_kwargs, "shapes": setting.task.shapes, "n_obstacles": setting.task.n_obstacles}

    def setting_of(self, scene: LiveScene) -> Setting:
        """Return the agent's setting, or one with room for more obstacles of any shape, where the agent is not used.

        Raises:
            ValueError: The scene has too many obstacles, or some that cannot be simulated.
        """
        if not self.own.limit(scene):
            return self.own
        if len(scene.obstacles) > MOST_SHOWN:
            raise ValueError(f"a scene has at most {MOST_SHOWN} obstacles, got {len(scene.obstacles)}")
        with self._making:
            if self._wide is None:
                task = self.own.task
                shapes = (*SIMULATED, *(name for name in task.shapes if name not in SIMULATED))
                self._wide = Setting(dataclasses.replace(task, shapes=shapes, n_obstacles=(0, MOST_SHOWN)))
        others = [each.kind for each in scene.obstacles if self._wide.limit(scene)]
        if others:
            raise ValueError(f"obstacles must be one of {', '.join(SIMULATED)}, got {', '.join(others)}")
        return self._wide

    def read(self, content: bytes) -> LiveScene:
        """Return the scene of a JSON file.

        Raises:
            ValueError: The file holds no scene, or an impossible one.
        """
        scene = LiveScene.from_json(content, self.own.task)
        setting = self.setting_of(scene)
        try:
            given = draw_given(scene.options(), setting.sampler, [np.random.default_rng(0)])
            check_simulated(given.obstacles)
        except ValueError as error:
            raise ValueError(f"the scene file is impossible: {error}") from None
        return scene

    def scene_kinds(self) -> dict[str, Draw]:
        """Return functions that draw scenes, by the names of their buttons."""
        generator = np.random.default_rng(self._seed)
        task = self.own.task

        def random() -> tuple[LiveScene, str]:
            return LiveScene.of(self.own.sampler([generator]), task), ""

        kinds: dict[str, Draw] = {"Random": random}
        for label, name in (("Test", "test"), ("Hard", "hard")):
            path = shipped_set(name, task)
            if path is not None:
                kinds[label] = functools.partial(next, _endless(load(path, name).scenes, task, name))
        if task.space.of_hand and task.n_obstacles[1] and not (task.whole_arm or task.replanning):
            kinds["Lights 1985"] = functools.partial(next, _lights(self.own.height))
        return kinds


def make_env(task: Task) -> ReachVectorEnv:
    """Return a batch of one environment of a task."""
    record = {**task.as_dict(), "arm": task.arm}
    arguments: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in record.items()
    }
    return ReachVectorEnv(1, **arguments, threads=1)


def _endless(scenes: Scenes, task: Task, name: str) -> Iterator[tuple[LiveScene, str]]:
    """Yield the scenes of a set, again and again."""
    for row in itertools.cycle(range(len(scenes.start))):
        yield LiveScene.of(scenes, task, row), f"Scene {row} of the set {name}."


def _lights(half_height: float) -> Iterator[tuple[LiveScene, str]]:
    """Yield the obstacle paradigm of Flash & Hogan 1985, pair by pair, again and again."""
    for first, last, lights in itertools.cycle(rows_of_lights(half_height=half_height)):
        start, goal = TARGETS[first].copy(), TARGETS[last].copy()
        scene = LiveScene(start, goal, (lights,), np.zeros((0, 3)), np.zeros((1, 4)))
        yield scene, f"From {first} to {last} past a row of lights, Flash & Hogan 1985."
