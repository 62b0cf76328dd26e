"""Computations of the live page: scenes, plans, ranked proposals and simulated movements, without a browser."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import pprint
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import viapoint.envs as ve
from viapoint.envs.arms.kinematics import forward
from viapoint.envs.common.arrays import Float, Observation, norm
from viapoint.envs.episodes import Decision
from viapoint.envs.geometry.clearance import FAR, row_clearances
from viapoint.envs.geometry.obstacles import pack, quaternions_of, unpack
from viapoint.envs.geometry.shapes import KINDS, PLAIN_KINDS
from viapoint.envs.outcome import Rollout
from viapoint.envs.scenes.options import OPTIONS, options_to_json, scene_options
from viapoint.primitives import passage_durations
from viapoint.training.agents.agent import Agent
from viapoint.training.extras import is_installed
from viapoint.training.paper.movements import TARGETS, rows_of_lights
from viapoint.training.planning.baselines import AgentMethod
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.plan_motion import SEEDS, checked_motion, ompl_motion, plan_motion
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    GeometrySearch,
    merits,
    plan_clearances,
    registered_task,
)
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
# Time limits of the motion planner after a change, and in a pause where that found no free movement, [s]
TIME_LIMIT, SECOND_LIMIT = 0.03, 0.3
N_PROPOSALS = 5  # Proposals that are shown
N_CANDIDATES = 256  # Best candidates among which distinct proposals are looked for
APART = 0.03  # Distance by which the paths of two proposals differ somewhere, [m]
N_CHECKS, REFINEMENTS = 512, 3  # Candidates of the geometry search, and rounds around the best
SAME_GOAL = 1e-9  # Rounding error of a goal, in a coordinate
NEXT_START = 0.02  # Least way to a goal that begins a new movement, in a coordinate

Shapes = Iterable[ve.Shape]
_agent_lock = threading.Lock()  # tabs share an agent


class Scene(NamedTuple):
    """One scene in coordinates of the task's space: the options of `reset`."""

    start: Float  # Shape (D,)
    goal: Float  # Shape (D,)
    obstacles: tuple[ve.Shape, ...]  # Obstacles at time 0, with their velocities
    jumps: Any = ()  # Jumps of the target: rows (time [s], target D)
    turns: Any = ()  # Changes of course: rows (time [s], velocity 3 [m/s]) by obstacle
    reaches: Any = ()  # Reaches: rows (begin [s], duration [s], way 3 [m]) by obstacle
    origin: str = ""  # Sentence on where the scene comes from, before a user changes it

    def options(self) -> dict[str, Any]:
        """Return the options of `reset`; what does not change is left out."""
        given = {name: value for name, value in zip(OPTIONS, self, strict=False) if len(value)}
        return {**given, "obstacles": list(self.obstacles)}

    def to_json(self, env_id: str) -> str:
        """Return the scene as the text of a JSON file, with the names of its obstacles."""
        return options_to_json(self.options(), env_id)

    def to_python(self, env_id: str, arguments: Mapping[str, Any]) -> str:
        """Return Python code that makes an environment with arguments and sets the scene up."""
        given = "".join(f", {name}={getattr(value, 'name', value)!r}" for name, value in arguments.items())
        record = json.loads(self.to_json(env_id), parse_float=lambda text: round(float(text), 6))
        options = {name: record[name] for name in self.options()}
        return (
            f'import gymnasium as gym\n\nenv = gym.make("viapoint.envs:{env_id}"{given})\n'
            f"options = {pprint.pformat(options, width=100, sort_dicts=False)}\n"
            "observation, info = env.reset(options=options)\n"
        )

    def with_obstacle(self, row: int, shape: ve.Shape) -> Scene:
        """Return the scene with another obstacle in a row, or with one more."""
        return self._replace(obstacles=(*self.obstacles[:row], shape, *self.obstacles[row + 1 :]))

    def without(self, row: int) -> Scene:
        """Return the scene without an obstacle."""
        left: dict[str, Any] = {"obstacles": (*self.obstacles[:row], *self.obstacles[row + 1 :])}
        for name in ("turns", "reaches"):
            rows = getattr(self, name)
            if row < len(rows):  # obstacles that were added have none
                left[name] = np.delete(rows, row, axis=0)
        return self._replace(**left)


class Proposal(NamedTuple):
    """One plan that was considered."""

    motion: MotionPlan  # Plan, with what is known of it
    maker: str  # Method that made it
    seconds: float = 0.0  # Time that the decision took, [s]
    value: float = np.nan  # Value by which the agent ranks the plan; NaN where it does not
    reward: float = np.nan  # Simulated reward; NaN for a plan that fails, or not yet


class Movement(NamedTuple):
    """Simulated movement up to the next decision, or to its end."""

    rollout: Rollout  # The movement from its beginning, at every physics step
    scenes: ve.Scenes  # Its scene, which has the places of obstacles over time
    plan: ve.Plan | None  # Plan that is followed; None where the arm is steered
    info: Mapping[str, Any]  # Metrics so far, of a batch of one
    reward: float  # Reward so far


@dataclass(kw_only=True)
class State:
    """Everything that a tab shows; arrays and records in it are replaced, never changed."""

    scene: Scene  # Present scene
    drawn: Scene  # Scene before the user changed it
    method: str  # Name of the method that decides
    n_via: int | None = None  # Number of via-points; None for that of the method
    checks: int = 0  # Proposals that the agent checks with computed geometry
    duration: float | None = None  # Duration that the user wants, [s]; None for that of the method
    by_hand: Float | None = None  # Via-points that the user has chosen, shape (K, D)
    selected: int | None = None  # Row of the selected obstacle
    turning: bool = False  # True if rings are shown that turn the tool at the goal
    proposals: tuple[Proposal, ...] = ()  # Plans; the one of the method, or by hand, is first
    picked: int = 0  # Index of the proposal that is the plan
    before: MotionPlan | None = None  # Plan before the last change, which is pale; None from a pause on
    movement: Movement | None = None  # Executed movement so far
    instant: int = 0  # Row of its rollout that is shown
    playing: bool = False  # True while the movement is played
    # Compared: method, time [s], and movement unless the method refused the scene
    results: tuple[tuple[str, float, Movement | None], ...] = ()
    message: str = "Getting ready."  # Sentence on the plan or the movement
    good: bool = True  # False for bad news

    @property
    def plan(self) -> MotionPlan | None:
        """The plan; None before the first one."""
        return self.proposals[self.picked].motion if self.proposals else None


class Arena:
    """Arm, task, agent (or None) and environments of one tab."""

    def __init__(
        self, env_id: str, agent: Agent | None, seed: int | None, own: Mapping[str, Any], named: bool = False
    ) -> None:
        self.env_id, self.agent, self._seed = env_id, agent, seed
        self.policy: Any = getattr(agent, "policy", None)
        planned = whole_task(env_id, own)  # the page plans whole movements, or revises them
        self.task = registered_task(env_id, **planned)
        any_shape = tuple(dict.fromkeys((*PLAIN_KINDS, *self.task.shapes)))
        more = {"shapes": any_shape, "n_obstacles": (0, MOST_OBSTACLES)}
        revising = self.task.replanning
        never = {"decide_at": (), "horizon": 1e3} if revising else {}
        self.arguments = {
            "own": dict(own),  # as the id says, with obstacles as the agent knows them
            "any": {**planned, **more},  # with obstacles of any number and shape
            "whole": {**planned, **more, **never},  # the same, with a plan that is never revised
        }
        self._envs: dict[str, ve.ReachVectorEnv] = {}
        self.stepwise = self.env("own").task.stepwise  # True if the agent acts in every control step
        self.planar = self.task.arm.space == "hand"  # True if the arm moves in a horizontal plane
        self._sampler = self.task.sampler()
        room = self._sampler.room
        self.foot, self.scale = np.array(room.foot), room.scale  # Place of the base, [m], and relative reach
        own_agent = () if agent is None else (AGENT,)
        decides = (*own_agent, MOTION) if named or revising else (MOTION, *own_agent)
        library = () if revising or not is_installed("ompl") else (OMPL,)
        self.methods = (*decides, SEARCH, STRAIGHT, *library)  # the first one is the default

    def env(self, name: str) -> ve.ReachVectorEnv:
        """Return a batch of one environment, `own`, `any` or `whole`, which is made once."""
        if name not in self._envs:
            env: Any = gym.make_vec(self.env_id, num_envs=1, **self.arguments[name])
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

    # Scenes

    def scenes(self) -> dict[str, Iterator[Scene]]:
        """Return endless scenes by the names of their buttons."""
        task, generator = self.task, np.random.default_rng(self._seed)
        random = (self.scene_of(self._sampler([generator])) for _ in itertools.count())
        kinds: dict[str, Iterator[Scene]] = {"Random": random}
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
        most, shapes = self.task.n_obstacles[1], self.task.shapes
        known = {name if name in KINDS else "convex_mesh" for name in shapes}
        if len(scene.obstacles) <= most and all(each.kind in known for each in scene.obstacles):
            return ""
        return f"with at most {most} obstacles ({', '.join(shapes)})" if most else "without obstacles"

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

    def clearances(self, coordinates: Float, obstacles: Shapes, times: Any = 0.0) -> Float:
        """Return clearances from obstacles at T times [s] and of the arm from itself, shape (T, 2), [m]."""
        arm = self.task.arm
        joints = self.task.space.joints(coordinates)
        rows = pack([obstacles]).take(np.zeros(len(joints), np.int64))
        when = np.broadcast_to(times, len(joints))
        rows = rows._replace(centre=rows.centre + when[:, None, None] * rows.velocity)
        apart, own = row_clearances(arm.chain, arm.spheres, joints, rows, FAR)
        return np.stack((apart.min(axis=1, initial=FAR), own), axis=-1)

    def moved(self, coordinates: Float, place: Float, obstacles: Shapes = (), turn: Any = None) -> Float:
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
        if np.hypot(line[0], line[1]) < 1e-9:  # no direction: any will do
            line = np.array([1.0, 0.0, 0.0])
        aside = np.array([-line[1], line[0], 0.0]) / np.hypot(line[0], line[1])
        if aside @ (middle - self.foot) < 0.0:
            aside = -aside
        shape, sides = self.new_shapes()[name], [aside, -aside]
        if name == "wall":
            shape, sides = ve.HalfSpace.facing(-aside), [aside]
        for way, side in itertools.product(0.02 * np.arange(1, 26), sides):
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
        changed: dict[str, Any] = {parameter: np.array(getattr(shape, parameter))}
        changed[parameter][index] = value
        return dataclasses.replace(shape, **changed)


def decide(arena: Arena, state: State, time_limit: float = TIME_LIMIT) -> Proposal:
    """Return the plan of the method, or by hand; where the scene is impossible, the motion planner says why."""
    if state.by_hand is not None and state.plan is not None:
        return _by_hand(arena, state, state.by_hand, state.duration or state.plan.duration)
    if state.method in (MOTION, OMPL):
        return _planned(arena, state, time_limit)
    scene, (name, task, decide_) = state.scene, _chooser(arena, state)
    try:
        observation = begin_episode(arena.env(name), scene)
    except ValueError:
        best = _planned(arena, state, time_limit)
        if best.motion.success:
            raise  # what changes later is at fault, which the motion planner does not know
        return best
    begin = time.perf_counter()
    action = decide_(observation)
    seconds = time.perf_counter() - begin
    plan = task.action.decode(action, scene.start[None], scene.goal[None]).take(0)
    if state.duration is not None:
        return _by_hand(arena, state, plan.waypoints[1:-1], state.duration)
    maker = SEARCH if state.method == AGENT and name == "any" else state.method
    return Proposal(_checked(arena, scene, plan), maker, seconds)


def n_via(arena: Arena, state: State) -> int:
    """Return the number of via-points that the user wants, or that the method has by default."""
    usual = 2 if state.method == MOTION and not arena.task.replanning else arena.task.n_via
    return usual if state.n_via is None else state.n_via


def _agent_decides(arena: Arena, state: State) -> bool:
    """Return True if the agent decides in a scene, False if the search does in its place."""
    own = arena.stepwise or n_via(arena, state) == arena.task.n_via
    return state.method == AGENT and own and not arena.limit(state.scene)


def _checked(arena: Arena, scene: Scene, plan: ve.Plan) -> MotionPlan:
    return checked_motion(arena.task.arm, arena.task.space_name, plan, pack([scene.obstacles]), "given")


def _chooser(arena: Arena, state: State) -> tuple[str, ve.Task, Callable[[Observation], Float]]:
    """Return the environment in which a method decides, the task of its actions, and its function of observations."""
    if _agent_decides(arena, state) and not arena.stepwise:
        return "own", arena.task, functools.partial(arena.act, checks=state.checks)
    task = dataclasses.replace(arena.env("any").task, n_via=n_via(arena, state))
    # The first candidate of a search is the straight movement.
    number, rounds = (1, 0) if state.method == STRAIGHT else (N_CHECKS, REFINEMENTS)
    return "any", task, GeometrySearch(task, number, refinements=rounds).decide


def _planned(arena: Arena, state: State, time_limit: float) -> Proposal:
    """Return the plan of a motion planner, which also says why there is no free movement."""
    scene, task = state.scene, arena.task
    problem = task.arm, scene.start, scene.goal, pack([scene.obstacles])
    begin = time.perf_counter()
    if state.method == OMPL:
        motion = ompl_motion(*problem, space=task.space_name)
    else:
        number, last = int(np.clip(n_via(arena, state), 1, 3)), state.before
        seeds: Any = SEEDS
        if last is not None and len(last.waypoints) == number + 2 and time_limit == TIME_LIMIT:
            seeds = last.waypoints[None, 1:-1]
        limits: Any = {"time_limit": time_limit, "duration": state.duration, "ompl": False}
        motion = plan_motion(*problem, n_via=number, seeds=seeds, space=task.space_name, **limits)
    seconds = time.perf_counter() - begin
    if state.duration is not None:  # or the shortest that the limits allow; as it is if that fails
        plan = ve.Plan(motion.waypoints, motion.durations * (state.duration / motion.duration))
        retimed = _checked(arena, scene, plan)
        motion = retimed if retimed.success else motion
    return Proposal(motion, OMPL if state.method == OMPL else MOTION, seconds)


def _by_hand(arena: Arena, state: State, vias: Float, duration: float) -> Proposal:
    """Return the plan from start to goal through via-points, shape (K, D), in a duration, [s]."""
    waypoints = np.concatenate((state.scene.start[None], vias, state.scene.goal[None]))
    plan = ve.Plan(waypoints, np.asarray(passage_durations(waypoints, np.asarray(duration))))
    return Proposal(_checked(arena, state.scene, plan), HAND)


def propose(arena: Arena, state: State) -> tuple[Proposal, ...]:
    """Return the plan and the best others that differ from it, with their simulated rewards."""
    first, found = state.proposals[0], []
    if first.maker == MOTION and not first.motion.success:  # it looks once more
        return (decide(arena, state, SECOND_LIMIT),)
    if state.method in (MOTION, OMPL, STRAIGHT):
        return (first,)
    env = arena.env("whole")
    now = state.scene._replace(jumps=(), turns=(), reaches=())  # later changes are not known
    try:
        begin_episode(env, now)
    except ValueError:  # the scene is impossible
        return (first,)
    for each in _distinct(arena, state):
        begin_episode(env, now)
        outcome = env.execute_plan(each.motion.plan.take(np.newaxis))
        success = each.motion.success and outcome.info["is_success"][0]
        found.append(each._replace(reward=float(outcome.reward[0]) if success else np.nan))
    return tuple(found)


def _distinct(arena: Arena, state: State) -> list[Proposal]:
    """Return the plan and the best candidates whose paths differ from it and from one another."""
    scene, first = state.scene, state.proposals[0]
    name, task, _ = _chooser(arena, state)
    by_agent = name == "own"
    if by_agent and not hasattr(arena.policy, "propose"):  # it proposes one action
        return [first]
    if by_agent:
        observation = begin_episode(arena.env(name), scene)
        with _agent_lock:
            (actions,), (values,) = arena.policy.propose(Problem.of_observation(observation, task))
    else:
        actions = candidate_actions(task, N_CHECKS, replanning=False).astype(np.float64)
        # Merits of several actions in one problem are bounds for all but the best.
        rest, start, goal = np.zeros_like(scene.start)[None], scene.start[None], scene.goal[None]
        problem = Problem(start, rest, rest, goal, pack([scene.obstacles]))
        each_alone = problem.take(np.zeros(len(actions), np.int64))
        values = merits(task, each_alone, actions[:, None])[:, 0]
    order = np.argsort(-values, kind="stable")[:N_CANDIDATES]
    known = values[order] if by_agent else np.full(len(order), np.nan)
    ends = (np.tile(end, (len(order), 1)) for end in (scene.start, scene.goal))
    plans = task.action.decode(np.asarray(actions[order], dtype=np.float64), *ends)
    chosen, paths = first.motion.plan, arena.path(plans, 9)
    apart = norm(paths - arena.path(chosen, 9)).max(axis=-1)
    same = (apart < 1e-6) & np.isclose(plans.duration, chosen.duration)
    found = [first._replace(value=float(known[same.argmax()]) if same.any() else np.nan)]
    while len(found) < N_PROPOSALS and (apart > APART).any():
        i = int((apart > APART).argmax())
        motion = _checked(arena, scene, plans.take(i))
        found.append(Proposal(motion, AGENT if by_agent else SEARCH, value=float(known[i])))
        apart = np.minimum(apart, norm(paths - paths[i]).max(axis=-1))
    return found


def execute(arena: Arena, state: State) -> Iterator[Movement]:
    """Execute the plan, decision by decision where it is revised, and yield the movement so far after each.

    A goal that is dragged meanwhile is followed; one that is dragged into contact goes back. When the arm has reached a
    goal that has been dragged away, a new episode begins there.
    """
    assert state.plan is not None
    scene, goal, reward = state.scene, state.scene.goal, 0.0
    if arena.stepwise and _agent_decides(arena, state) and state.by_hand is None and state.picked == 0:
        env = arena.env("own")
        decide_: Callable[[Observation], Float] = arena.act
        decision = env.execute_actions(decide_(begin_episode(env, scene)))
    else:
        name, _, decide_ = _chooser(arena, state)
        env = arena.env(name)
        begin_episode(env, scene)
        decision = _execute_plan(env, state.plan)
    while True:
        rollout, scenes, plans = env.last_rollout[0], env.scenes, env.last_plan
        assert scenes is not None
        reward += float(decision.reward[0])
        info = {name: value[0] for name, value in decision.info.items()}
        kept = state.scene
        yield Movement(rollout, scenes, None if plans is None else plans.take(0), info, reward)
        moved = not np.array_equal(state.scene.goal, goal)
        observation, goal, now = decision.observation, state.scene.goal, rollout.time[-1:]
        if decision.terminated[0] or decision.truncated[0]:
            here = env.task.space.coordinates(rollout.joints[-1])
            if not moved or not info["is_success"] or np.abs(here - goal).max() < NEXT_START:
                return
            left = scenes.obstacles_at(now)
            scene = Scene(here, goal, tuple(unpack(left._replace(velocity=0.0 * left.velocity), 0)))
            observation, now = begin_episode(env, scene), np.zeros(1)
        elif moved:
            try:
                observation = env.move_goals(goal[None])
            except ValueError:
                state.scene, goal = kept, kept.goal
        if state.method == MOTION:
            decision = _plan_on(env, observation, now, decide_)
        else:
            decision = env.execute_actions(decide_(observation))


def _plan_on(
    env: ve.ReachVectorEnv, observation: Observation, time: Float, search: Callable[[Observation], Float]
) -> Decision:
    """Execute a decision of the motion planner at a time, shape (1,), [s].

    The present plan stays while it is clear and its goal the present one. Where no other plan is found, the search
    decides.
    """
    task, scenes = env.task, env.scenes
    assert scenes is not None
    problem = Problem.of_observation(observation, task)._replace(obstacles=scenes.obstacles_at(time))
    goal = task.space.coordinates(scenes.goals(time))[0]
    if task.replanning and env.last_plan is not None:
        keep = np.zeros((1, task.action.size))
        clear = plan_clearances(task, problem, keep[None], CLEARANCE_MARGIN, CLEARANCE_MARGIN)[0, 0]
        same = np.abs(env.last_plan.waypoints[0, -1] - goal).max() < SAME_GOAL
        if same and clear >= CLEARANCE_MARGIN:
            return env.execute_actions(keep)
    number = int(np.clip(task.n_via, 1, 3))
    motion = plan_motion(
        task.arm, problem.start[0], goal, problem.obstacles, n_via=number, velocity=problem.velocity[0],
        acceleration=problem.acceleration[0], time_limit=TIME_LIMIT, space=task.space_name, ompl=False,
    )  # fmt: skip
    return _execute_plan(env, motion) if motion.success else env.execute_actions(search(observation))


def _execute_plan(env: ve.ReachVectorEnv, motion: MotionPlan) -> Decision:
    """Execute a plan; a straight one passes the via-points that plans under revision have at even times."""
    plan = motion.plan
    if env.task.replanning and len(plan.durations) == 1:
        times = plan.duration * np.linspace(0.0, 1.0, env.task.n_via + 2)
        points = np.array(plan.trajectory()(times))
        points[[0, -1]] = plan.waypoints  # without rounding: another goal would be planned for anew
        plan = plan._replace(waypoints=points, durations=np.diff(times))
    return env.execute_plan(plan.take(np.newaxis))


def begin_episode(env: ve.ReachVectorEnv, scene: Scene) -> Observation:
    """Begin an episode in a scene, and return the observation; a target without jumps gets none."""
    jumps = {"jumps": ()} if env.task.n_jumps[1] else {}
    observation, _ = env.reset(options={**jumps, **scene.options()})
    return observation


def profile(arena: Arena, scene: Scene, plan: ve.Plan, until: float = 0.0) -> dict[str, Float]:
    """Return time, to the end of a plan or `until`, [s], speed of the tool, jerk, and clearance from obstacles."""
    times = np.linspace(0.0, max(float(plan.duration), until), SAMPLES)
    trajectory = plan.trajectory()
    coordinates = np.asarray(trajectory(times))
    return {
        "time": times,
        "speed": norm(np.gradient(arena.tool(coordinates), times, axis=0)),
        "jerk": norm(np.asarray(trajectory(times, 3))),
        "clearance": arena.clearances(coordinates, scene.obstacles, times)[:, 0],
    }


def describe_plan(proposal: Proposal, duration: float | None = None) -> str:
    """Return one sentence on a plan, for which a user may want a duration, [s]."""
    motion = proposal.motion
    if not motion.success and proposal.maker == MOTION:
        return f"No free movement was found: {motion.reason}. The best one is shown in red."
    if not motion.success:
        return f"This plan fails: {motion.reason}."
    far = motion.clearance >= 0.999 * FAR
    clear = "no obstacle near" if far else f"{1e3 * motion.clearance:.0f} mm clear"
    jerk = f"{motion.jerk:.1f} times the jerk of the straight line"
    short = duration is not None and motion.duration > duration + 0.005
    limits = ", the shortest time that the limits of the arm allow" if short else ""
    return f"The plan takes {motion.duration:.2f} s{limits}, {clear}, with {jerk}."


def describe_outcome(info: Mapping[str, Any], in_joints: bool) -> str:
    """Return one sentence on an executed movement."""
    if info["collision"]:
        return f"Failure: the arm touches something after {info['first_contact_time']:.2f} s."
    if not info["reachable"]:
        return "Failure: the plan leaves the arm's reach."
    clearance = 1e3 * info["min_clearance"]
    error = 1e3 * info["goal_error"]
    near = "" if clearance >= 999.0 * FAR else f", least clearance {clearance:.0f} mm"
    state = "Success: at rest" if info["is_success"] else "Failure:"
    return f"{state} {error:.1f} {'mrad' if in_joints else 'mm'} from the goal after {info['duration']:.2f} s{near}."
