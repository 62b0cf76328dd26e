"""Comparison of methods in one scene of the live page; each decides, and its movement is simulated."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Generator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from viapoint.envs import Plan, ReachVectorEnv
from viapoint.envs.common.types import Float, Observation
from viapoint.training.live.movements import play_episode

if TYPE_CHECKING:
    from viapoint.training.live.scene import LiveScene
    from viapoint.training.live.setting import Setting
    from viapoint.training.planning.baselines import PlannerMethod


class MethodResult(NamedTuple):
    """Simulated outcome of a method in one scene."""

    name: str
    success: bool
    reward: float
    clearance: float
    """Least clearance of the executed movement, [m]."""
    jerk_ratio: float
    seconds: float
    """Time of the first decision, [s]."""


Compared = tuple[str, Callable[[], MethodResult]]
"""Name of a method, and a function that lets it decide and simulates its movement."""


def compare(
    setting: Setting, scene: LiveScene, planners: Mapping[str, PlannerMethod], checks: int = 0
) -> Generator[Compared, None, None]:
    """Yield the methods that are compared in a scene: agent, straight movement, geometry search and planners.

    Args:
        setting: Task and agent.
        scene: Scene.
        planners: Planners by their names.
        checks: Proposals that the agent checks with computed geometry.
    """
    task, decisions, step_env = setting.task, setting.decisions, setting.make_step_env()
    env = setting.make_env()
    try:
        if step_env is not None:
            steps = setting.act
            yield "agent", lambda: _result("agent", step_env, scene, steps)
        elif setting.agent is not None:
            yield "agent", lambda: _result("agent", env, scene, lambda seen: decisions.action(seen, checks))
        straight = np.zeros((1, task.action.size))
        yield "straight", lambda: _result("straight", env, scene, lambda seen: straight)
        yield "geometry search", lambda: _result("geometry search", env, scene, decisions.search)
        for name, planner in planners.items():
            yield name, functools.partial(_planned, name, env, scene, planner)
    finally:
        for each in (env, step_env):
            if each is not None:
                each.close()


def _result(
    name: str, env: ReachVectorEnv, scene: LiveScene, decide: Callable[[Observation], Float]
) -> MethodResult:
    """Return the result of a method that chooses actions from observations."""
    seconds: list[float] = []

    def timed(observation: Observation) -> Float:
        begin = time.perf_counter()
        action = decide(observation)
        seconds.append(time.perf_counter() - begin)
        return action

    info, reward = play_episode(env, scene, timed)
    return _as_result(name, info, reward, seconds[0])


def _planned(name: str, env: ReachVectorEnv, scene: LiveScene, planner: PlannerMethod) -> MethodResult:
    """Return the result of a planner whose movements have any number of via-points."""
    env.reset(options=scene.options())
    assert env.scenes is not None
    begin = time.perf_counter()
    plan = planner.plan(env.scenes)
    seconds = time.perf_counter() - begin
    decision = env.execute_plan(Plan.at_rest(plan.waypoints[None], plan.durations[None]))
    return _as_result(name, decision.info, float(decision.reward[0]), seconds)


def _as_result(name: str, info: dict[str, Float], reward: float, seconds: float) -> MethodResult:
    return MethodResult(
        name=name,
        success=bool(info["is_success"][0]),
        reward=reward,
        clearance=float(info["min_clearance"][0]),
        jerk_ratio=float(info["jerk_ratio"][0]),
        seconds=seconds,
    )
