"""Arm, task, agent and environments of one tab of the live page, and the obstacles that can be added."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

import viapoint.envs as ve
from viapoint.envs.arms.kinematics import forward
from viapoint.envs.common.arrays import Float, Observation
from viapoint.envs.geometry.clearance import FAR, row_clearances
from viapoint.envs.geometry.obstacles import pack, quaternions_of
from viapoint.envs.geometry.shapes import KINDS, PLAIN_KINDS
from viapoint.envs.scenes.options import scene_options
from viapoint.training.agents.agent import Agent
from viapoint.training.live.state import Scene, State
from viapoint.training.paper.movements import TARGETS, rows_of_lights
from viapoint.training.planning.baselines import AgentMethod
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import whole_task
from viapoint.training.scene_sets import shipped_set

MOTION, AGENT, SEARCH = "motion planner", "agent", "geometry search"
STRAIGHT, OMPL, HAND = "straight movement", "OMPL", "by hand"  # Names of methods
SAMPLES = 80  # Points of a path
MOST_OBSTACLES = 24  # Greatest number of obstacles of a scene
# Sliders of obstacles by name: parameter, index of the number in it, and bounds, [m]
SIZES: dict[str, tuple[str, Any, float, float]] = {
    "radius": ("radius", (), 0.01, 0.1),
    "half-length": ("half_length", (), 0.005, 0.3),
    "half-depth": ("size", 0, 0.005, 0.5),
    "half-width": ("size", 1, 0.005, 0.5),
    "half-height": ("size", 2, 0.005, 0.5),
}
UPRIGHT = ("half-length", "half-height")  # Heights of obstacles in the plane, which have no sliders

_agent_lock = threading.Lock()  # tabs share an agent


class Arena:
    """Arm, task, agent (or None) and environments of one tab."""

    def __init__(
        self, env_id: str, agent: Agent | None, seed: int | None, env_kwargs: Mapping[str, Any]
    ) -> None:
        self.env_id, self.agent, self._seed = env_id, agent, seed
        self.policy: Any = getattr(agent, "policy", None)
        own = dict(env_kwargs)
        task = registered_task(env_id, **own)
        self.stepwise = task.stepwise  # True if the agent acts in every control step
        any_shape = tuple(dict.fromkeys((*PLAIN_KINDS, *task.shapes)))
        more = {"shapes": any_shape, "n_obstacles": (0, MOST_OBSTACLES)}
        self.arguments = {"own": own, "any": {**own, **more}}  # as a user writes them
        planned = whole_task(env_id, own)  # the page plans whole movements, or revises them
        self._arguments = {
            "steps": own,  # as the id says
            "own": planned,  # with obstacles as the agent knows them
            "any": {**planned, **more},  # with obstacles of any number and shape
            "whole": {**planned, **more},  # the same, with a plan that is never revised
        }
        self._envs: dict[str, ve.ReachVectorEnv] = {}
        self.task = self.env("own").task
        if self.task.replanning:
            self._arguments["whole"].update(decide_at=(), horizon=1e3)
        self.planar = self.task.arm.space == "hand"  # True if the arm moves in a horizontal plane
        self._sampler = self.task.sampler()
        methods = [SEARCH, STRAIGHT]
        if agent is not None:
            methods.insert(0, AGENT)
        if not self.task.replanning:
            methods.insert(0, MOTION)
            methods += [OMPL] if importlib.util.find_spec("ompl") else []
        self.methods = tuple(methods)  # those that can be chosen; the first one is the default

    def env(self, name: str) -> ve.ReachVectorEnv:
        """Return a batch of one environment, `own`, `any`, `whole` or `steps`, which is made once."""
        if name not in self._envs:
            env: Any = gym.make_vec(self.env_id, num_envs=1, **self._arguments[name])
            self._envs[name] = env.unwrapped
        return self._envs[name]

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()

    def act(self, observation: Observation, checks: int = 0) -> Float:
        """Return the action that the agent chooses, shape (1, m)."""
        with _agent_lock:
            return AgentMethod(AGENT, self.agent, checks).decide(observation)

    def propose(self, problem: Any) -> tuple[Float, Float]:
        """Return the candidates of the agent in one problem, shape (N, m), and its values of them, shape (N,)."""
        with _agent_lock:
            actions, values = self.policy.propose(problem)
        return actions[0], values[0]

    def agent_decides(self, state: State) -> bool:
        """Return True if the agent decides in a scene, False if the search does in its place."""
        own = self.stepwise or self.n_via(state) == self.task.n_via
        return state.method == AGENT and own and not self.limit(state.scene)

    def n_via(self, state: State) -> int:
        """Return the number of via-points that the user wants, or that the method has by default."""
        usual = 2 if state.method == MOTION else self.task.n_via
        return usual if state.n_via is None else state.n_via

    # Scenes

    def scenes(self) -> dict[str, Iterator[Scene]]:
        """Return endless scenes by the names of their buttons."""
        task, generator = self.task, np.random.default_rng(self._seed)
        kinds: dict[str, Iterator[Scene]] = {}
        kinds["Random"] = (self.scene_of(self._sampler([generator])) for _ in itertools.count())
        for name in ("test", "hard"):
            frozen = shipped_set(name, task)
            if frozen is not None:
                kinds[name.capitalize()] = self._shipped(name, frozen.scenes)
        if task.space.of_hand and task.n_obstacles[1] and not (task.whole_arm or task.replanning):
            kinds["Lights 1985"] = self._lights()
        return kinds

    def _shipped(self, name: str, scenes: ve.Scenes) -> Iterator[Scene]:
        for row in itertools.cycle(range(len(scenes.start))):
            yield self.scene_of(scenes, row)._replace(origin=f"Scene {row} of the set {name}.")

    def _lights(self) -> Iterator[Scene]:
        for first, last, lights in itertools.cycle(rows_of_lights(half_height=self._sampler.room.height)):
            origin = f"From {first} to {last} past a row of lights, Flash & Hogan 1985."
            yield Scene(TARGETS[first], TARGETS[last], (lights,), origin=origin)

    def scene_of(self, scenes: ve.Scenes, row: int = 0) -> Scene:
        """Return one of the scenes of an environment."""
        options = scene_options(scenes, self.task.arm, self.task.space_name, row)
        return Scene(**{**options, "obstacles": tuple(options["obstacles"])})

    def read(self, content: str | bytes) -> Scene:
        """Return the scene of a JSON file; missing parts are drawn, and an impossible one raises ValueError."""
        options = ve.scene_from_json(content)
        env = self.env("any")
        try:
            env.reset(options=options)
        except ValueError as error:
            raise ValueError(f"the scene file is impossible: {error}") from None
        assert env.scenes is not None
        scene = self.scene_of(env.scenes)
        return scene._replace(obstacles=tuple(options.get("obstacles", scene.obstacles)))  # with their names

    def limit(self, scene: Scene) -> str:
        """Return the limit of the task that a scene exceeds, as part of a sentence; "" if there is none."""
        most = self.task.n_obstacles[1]
        if not most and scene.obstacles:
            return "without obstacles"
        known = {name if name in KINDS else "convex_mesh" for name in self.task.shapes}
        others = [each.kind for each in scene.obstacles if each.kind not in known]
        if others:
            return f"without {others[0].replace('_', '-')} obstacles"
        return f"with at most {most} obstacles" if len(scene.obstacles) > most else ""

    # Geometry

    def tool(self, coordinates: Float) -> Float:
        """Return places of the tool, shape (..., 3), [m], for coordinates of shape (..., D)."""
        arm = self.task.arm
        if not self.task.space.of_hand:
            return arm.hand(coordinates)
        level = np.full((*coordinates.shape[:-1], 1), arm.hand(arm.home)[2])
        return np.concatenate((coordinates, level), axis=-1)

    def path(self, plan: ve.Plan, samples: int = SAMPLES) -> Float:
        """Return places of the tool at evenly spaced times of plans, shape (..., samples, 3), [m]."""
        times = plan.duration[..., None] * np.linspace(0.0, 1.0, samples)
        return self.tool(np.asarray(plan.trajectory()(times)))

    def orientation(self, coordinates: Float) -> Float:
        """Return the orientation of the tool for joint positions, a quaternion."""
        return quaternions_of(forward(self.task.arm.chain, coordinates)[1])

    def clearances(self, coordinates: Float, obstacles: Iterable[ve.Shape], times: Any = 0.0) -> Float:
        """Return clearances from obstacles at T times [s] and of the arm from itself, shape (T, 2), [m]."""
        arm = self.task.arm
        joints = self.task.space.joints(coordinates)
        rows = pack([obstacles]).take(np.zeros(len(joints), np.int64))
        when = np.broadcast_to(times, len(joints))
        rows = rows._replace(centre=rows.centre + when[:, None, None] * rows.velocity)
        apart, own = row_clearances(arm.chain, arm.spheres, joints, rows, FAR)
        return np.stack((apart.min(axis=1, initial=FAR), own), axis=-1)

    def moved(
        self, coordinates: Float, place: Float, obstacles: Iterable[ve.Shape] = (), turn: Any = None
    ) -> Float:
        """Return coordinates with the tool at another place, in joint space the nearest that are free of obstacles.

        `turn` is a new orientation of the tool. A place out of reach raises ValueError.
        """
        if self.task.space.of_hand:
            return np.array(place[:2])
        if turn is None and len(coordinates) >= 6:  # with fewer joints, the tool cannot have any orientation
            turn = self.orientation(coordinates)
        found = ve.inverse_kinematics(self.task.arm, place, turn, seed=coordinates, n_seeds=8)
        free = self.clearances(found, obstacles).min(axis=-1) > 0.0
        return np.asarray(found[int(free.argmax())])

    # Obstacles

    def new_shapes(self) -> dict[str, ve.Shape]:
        """Return the obstacles that can be added, by name."""
        height = self._sampler.room.height
        shapes: dict[str, ve.Shape] = {
            "sphere": ve.Sphere(0.06),
            "capsule": ve.Capsule(0.035, 0.1),
            "box": ve.Box((0.05, 0.05, 0.05)),
            "cylinder": ve.Cylinder(0.04, 0.08),
        }
        if self.planar:
            shapes = {"post": ve.Cylinder(0.025, height), "bar": ve.Box((0.09, 0.015, height))}
            shapes["box"] = ve.Box((0.03, 0.03, height))
        return {**shapes, "wall": ve.HalfSpace()}

    def new_obstacle(self, scene: Scene, name: str) -> ve.Shape:
        """Return a new obstacle beside the middle of a movement, clear of the others and of both ends if possible.

        A half-space is a wall along the movement, on the side away from the base of the arm.
        """
        ends = np.stack((scene.start, scene.goal))
        start, goal = self.tool(ends)
        middle, line = 0.5 * (start + goal), goal - start
        aside = np.array([-line[1], line[0], 0.0]) / max(float(np.hypot(line[0], line[1])), 1e-9)
        if aside @ middle < 0.0:
            aside = -aside
        shape = self.new_shapes()[name]
        sides, least = [aside, -aside], 0.02
        if name == "wall":
            shape, sides, least = ve.HalfSpace.facing(-aside), [aside], 0.17
        for way, side in itertools.product(least + 0.02 * np.arange(20), sides):
            shape = dataclasses.replace(shape, position=middle + way * side)
            alone = all(other.distance(shape.position, 0.03) > 0.0 for other in scene.obstacles)
            if alone and self.clearances(ends, [shape])[:, 0].min() > 0.0:
                break
        return shape

    def sizes_of(self, shape: ve.Shape) -> dict[str, float]:
        """Return the sizes of an obstacle by the names of their sliders, [m]."""
        sizes = {}
        for name, (parameter, index, *_) in SIZES.items():
            if parameter in shape.sizes and not (self.planar and name in UPRIGHT):
                sizes[name] = float(np.asarray(getattr(shape, parameter))[index])
        return sizes

    def resized(self, shape: ve.Shape, name: str, value: float) -> ve.Shape:
        """Return an obstacle with another size, see :meth:`sizes_of`."""
        parameter, index, *_ = SIZES[name]
        sizes = np.array(getattr(shape, parameter))
        sizes[index] = value
        changed: dict[str, Any] = {parameter: sizes}
        return dataclasses.replace(shape, **changed)
