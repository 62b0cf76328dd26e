"""Methods that agents are compared with, and agents as such methods."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from viapoint.envs.common.arrays import Float, Observation
from viapoint.envs.common.validation import whole_number
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.checks import unknown_name
from viapoint.training.planning.beliefs import Sight, thick_points
from viapoint.training.planning.candidates import MOST_CANDIDATES
from viapoint.training.planning.cautious import (
    BELIEFS,
    DEFAULT_BELIEF,
    PRIVILEGED,
    BeliefMethod,
    CautiousSearch,
)
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.ompl_paths import import_ompl
from viapoint.training.planning.plan_motion import ompl_motion, plan_motion
from viapoint.training.planning.predictions import PREDICTIONS, PredictedSearch
from viapoint.training.planning.rrt_connect import VIA_COUNTS
from viapoint.training.planning.search import GeometrySearch, registered_task
from viapoint.training.rollout import Outcomes, SceneSimulation
from viapoint.training.vec_env import env_arguments, predicted_actions

DEEP = "deep:plan_motion"  # Name of the planner that assumes the greatest depth behind what is seen
DEEPEST = {"hand": 0.4, "joints": 0.12}  # Its first depth, [m]
# From one of its depths to the next: the factor; then the depth that ends it, [m], and the time for each, [s]
SHALLOWER, SHALLOWEST, DEEP_TIME = 0.8, 0.02, 0.02


class Method(Protocol):
    """Decision maker that chooses a movement in each of N scenes.

    A method whose movements are no actions of the environment has `execute(scenes, decisions)` as well, which simulates
    them and returns what :class:`~viapoint.training.rollout.SceneSimulation` does.
    """

    @property
    def name(self) -> str:
        """Name in tables of results."""

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return actions, shape (N, m), from observations; planners that simulate use the scenes."""


class Straight:
    """Straight minimum-jerk movement, the zero action."""

    name = "straight"

    def __init__(self, simulation: SceneSimulation) -> None:
        self._size = simulation.task.action.size

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return zero actions, see :class:`Method`."""
        return np.zeros((len(scenes.start), self._size))


class RandomVias:
    """Uniformly random actions."""

    name = "random"

    def __init__(self, simulation: SceneSimulation) -> None:
        self._size = len(simulation.task.action_names)
        self._generator = np.random.default_rng(0)  # the same actions in every evaluation

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return random actions, see :class:`Method`."""
        return self._generator.uniform(-1.0, 1.0, (len(scenes.start), self._size))


class PlannerMethod:
    """Planner whose movements have as many via-points as they need, and durations of their own.

    A decision is a row: number of via-points, durations of the segments [s], waypoints, then zeros.
    """

    def __init__(self, simulation: SceneSimulation, name: str) -> None:
        if name == "ompl":
            import_ompl()  # an error where it is not installed
        self.name, self._simulation, self._planner = name, simulation, PLANNERS[name]

    def plan(self, scene: Scenes, **kwargs: Any) -> MotionPlan:
        """Return the plan of one scene; further arguments are those of the planner."""
        task = self._simulation.task
        start = task.space.coordinates(scene.start)[0]
        goal = task.space.coordinates(scene.goal)[0]
        return self._planner(task.arm, start, goal, scene.obstacles, space=task.space_name, **kwargs)

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return plans as rows, see :class:`Method`."""
        return self.rows([self.plan(scenes.take([i])) for i in range(len(scenes.start))])

    def rows(self, plans: Sequence[MotionPlan]) -> Float:
        """Return plans as rows."""
        dimension, most = self._simulation.task.space.dimension, VIA_COUNTS[-1]
        rows = np.zeros((len(plans), 2 + most + (most + 2) * dimension))
        for i, plan in enumerate(plans):
            row = np.concatenate(([len(plan.durations) - 1], plan.durations, plan.waypoints.ravel()))
            rows[i, : len(row)] = row
        return rows

    def execute(self, scenes: Scenes, decisions: Float) -> Outcomes:
        """Simulate the plans; those with equally many via-points run together."""
        dimension = self._simulation.task.space.dimension
        counts = decisions[:, 0].astype(np.int64)
        outcomes: Outcomes = {}
        for count in np.unique(counts):
            rows = np.flatnonzero(counts == count)
            durations = decisions[rows, 1 : 2 + count]
            waypoints = decisions[rows, 2 + count : 2 + count + (count + 2) * dimension]
            plan = Plan.at_rest(waypoints.reshape(len(rows), count + 2, dimension), durations)
            result = self._simulation.execute_plan(scenes.take(rows), plan)
            for name, values in result.items():
                outcomes.setdefault(name, np.zeros(len(decisions), dtype=values.dtype))[rows] = values
        return outcomes


class DeepPlanner(PlannerMethod):
    """Planner that keeps as far as it can from what may be behind the fronts that a sensor sees.

    It plans as if all that is seen went on behind its front, to the greatest depth of a falling sequence with which a
    movement is found. The numbers were tuned on `validation` scenes.
    """

    def __init__(self, simulation: SceneSimulation) -> None:
        super().__init__(simulation, "plan_motion")
        self.name = DEEP

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return plans as rows, see :class:`Method`."""
        task = self._simulation.task
        sight = Sight.of(observation, task)
        plans = dict[int, MotionPlan]()
        depth = DEEPEST[task.space_name]
        while depth > SHALLOWEST:
            left = [row for row in range(len(scenes.start)) if row not in plans or not plans[row].success]
            if not left:
                break
            believed = thick_points(task, sight.take(left), depth)
            for i, row in enumerate(left):
                scene = scenes.take([row])._replace(obstacles=believed.take([i]))
                plans[row] = self.plan(scene, time_limit=DEEP_TIME)
            depth *= SHALLOWER
        return self.rows([plans[row] for row in range(len(scenes.start))])


class AgentMethod:
    """Trained agent that checks and refines this many of its proposals; None for the numbers of the model."""

    def __init__(self, name: str, model: Any, checks: int | None = None, refine: int | None = None) -> None:
        self.name, self._model = name, model
        given = {"checks": checks, "refine": refine}
        self._settings = {name: number for name, number in given.items() if number is not None}

    def decide(self, observation: Observation, scenes: Any = None) -> Float:
        """Return actions of the agent, see :class:`Method`; only privileged beliefs need the scenes."""
        policy = self._model.policy
        own = {name: getattr(policy, name) for name in self._settings if hasattr(policy, name)}
        for name in own:
            setattr(policy, name, self._settings[name])
        try:
            if getattr(policy, "belief", DEFAULT_BELIEF) in PRIVILEGED and scenes is not None:
                actions, _ = policy.assess(observation, scenes.obstacles)
            else:
                actions = predicted_actions(self._model, observation)
        finally:
            for name, number in own.items():
                setattr(policy, name, number)
        return np.asarray(actions, dtype=np.float64)


class StepAgentMethod:
    """Trained agent that acts in every control step, in environments of its own.

    A decision is the first action; the others follow during the simulation. The decision time is that of one control
    step, of which a movement has about twenty.
    """

    def __init__(self, name: str, model: Any, env_id: str, env_kwargs: Mapping[str, Any]) -> None:
        self.name, self._model = name, model
        self._simulation = SceneSimulation(env_id, 250, **env_kwargs)

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return actions for the next step, shape (N, D), from observations of the step-wise task or its twin."""
        if "time_left" not in observation or "remaining" in observation:  # that of the twin
            observation = self._simulation.observe(scenes)
        actions = predicted_actions(self._model, observation)
        return np.asarray(actions, dtype=np.float64)

    def execute(self, scenes: Scenes, decisions: Float) -> Outcomes:
        """Play every episode to its end, beginning with the given actions."""
        return self._simulation(scenes, decisions, self.decide)


def agent_method(name: str, model: Any, checks: int | None = None, refine: int | None = None) -> Method:
    """Return a trained agent as a method; ValueError if it cannot check or refine its proposals."""
    if checks and not hasattr(model.policy, "checks"):
        raise ValueError(f"proposals are checked by ViaQ only; this agent is a {type(model).__name__}")
    if refine and not getattr(model.policy, "can_refine", False):
        raise ValueError("proposals are refined by ViaQ only, in tasks with one decision for a movement")
    if checks:
        name += f", {checks} checks"
    if refine:
        name += f", {refine} refined"
    env_id, env_kwargs = env_arguments(model.get_env())
    if registered_task(env_id, **env_kwargs).stepwise:
        return StepAgentMethod(name, model, env_id, env_kwargs)
    return AgentMethod(name, model, checks, refine)


def _refined_search(simulation: SceneSimulation, checks: int) -> Method:
    """Return a search that spends half of its checks on refinement."""
    rounds = 2 if checks < 512 else 4
    each = checks // 2 // rounds
    return GeometrySearch(simulation.task, checks - rounds * each, refinements=rounds, per_round=each)


# Factories of baselines whose names end in the number of plans that they check, such as `search512`
COUNTED: dict[str, Callable[[SceneSimulation, int], Method]] = {
    "search": _refined_search,
    "sobol": lambda simulation, checks: GeometrySearch(simulation.task, checks),
    "cautious": lambda simulation, checks: CautiousSearch(simulation.task, checks),
}
SEARCHES = ("search", "sobol")  # Those that plan with any obstacles; `cautious` needs a sensor

# Planners for known obstacles: functions of arm, start, goal and obstacles, and `space`
PLANNERS: dict[str, Callable[..., MotionPlan]] = {"plan_motion": plan_motion, "ompl": ompl_motion}

# Factories of baselines for all tasks; those with one decision for a movement have PLANNERS, too
METHODS: dict[str, Callable[[SceneSimulation], Method]] = {"straight": Straight, "random": RandomVias}


def make_method(name: str, env_id: str, **kwargs: Any) -> Method:
    """Return a baseline for an environment made with `kwargs`."""
    simulation = SceneSimulation(env_id, **kwargs)
    return factory(name, simulation.task)(simulation)


def factory(name: str, task: Task) -> Callable[[SceneSimulation], Method]:
    """Return the factory of a baseline for a task; ValueError where there is none."""
    sensed = task.sensor is not None
    predicted = task.replanning and task.moving_obstacles and not sensed
    counted = tuple(COUNTED) if sensed else SEARCHES
    if sensed and name == DEEP and not task.replanning:
        return DeepPlanner
    belief, _, planner = name.rpartition(":")
    if sensed and name in PLANNERS:  # they take the obstacles that they are given, which are not known here
        belief = DEFAULT_BELIEF
    planner = planner if belief else name
    made = _counted(planner, SEARCHES if belief else counted)
    if planner in PLANNERS and not task.replanning:
        made = functools.partial(PlannerMethod, name=planner)
    if made is not None:
        if not belief:
            return made
        if sensed and belief in BELIEFS:
            return lambda simulation: BeliefMethod(task, belief, made(simulation))
        if predicted and belief in PREDICTIONS and planner not in PLANNERS:
            return lambda simulation: PredictedSearch(simulation, belief, made(simulation))
    if name in METHODS:
        return METHODS[name]
    if name == "untrained":
        raise ValueError("untrained needs an agent, whose network it is before training")
    if not sensed and (belief in BELIEFS or name == DEEP or _counted(name, COUNTED)):
        raise ValueError(f"{name} needs a task with a sensor: it plans with what is seen")
    names = [*METHODS, *(() if task.replanning else PLANNERS), *(f"{each}N" for each in counted), "untrained"]
    names += [*(f"{each}:METHOD" for each in BELIEFS), DEEP] if sensed else []
    names += [f"{each}:searchN" for each in PREDICTIONS] if predicted else []
    raise ValueError(unknown_name("baseline", name, names))


def _counted(name: str, allowed: Collection[str]) -> Callable[[SceneSimulation], Method] | None:
    """Return the factory of a baseline whose name ends in the number of plans that it checks; None for others."""
    found = re.fullmatch(r"(\w+?)([0-9]+)", name)
    if found is None or found[1] not in allowed:
        return None
    kind, fewest = found[1], 4 if found[1] == "search" else 1
    checks = whole_number(f"N of {kind}N", int(found[2]), fewest, MOST_CANDIDATES)
    return lambda simulation: COUNTED[kind](simulation, checks)
