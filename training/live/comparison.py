"""Comparison of methods in one scene of the live page."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.scenes.scene import Scenes
from viapoint.training.planners.baselines import Method, agent_method, make_method
from viapoint.training.rollouts.rollout import SceneSimulation, new_simulation

if TYPE_CHECKING:
    from viapoint.training.live.scene_file import LiveScene

BASELINES = {"straight": "straight", "geometry search": "search512", "planner": "planner"}
"""Compared methods by their names in the table."""


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


class Comparison:
    """Comparison of an agent with methods without learning.

    Args:
        env_id: Environment whose actions are whole movements or revisions of them.
        agent: Agent; None for none.
        **kwargs: Arguments of the environment.
    """

    def __init__(self, env_id: str, agent: Any = None, **kwargs: Any) -> None:
        self._env_id, self._agent, self._kwargs = env_id, agent, kwargs
        self._simulation: SceneSimulation | None = None
        self._methods: dict[str, Method] = {}

    def __call__(self, scene: LiveScene, checks: int = 0) -> Iterator[tuple[str, Callable[[], MethodResult]]]:
        """Yield the name of each method and a function that lets it decide and simulates its decision."""
        if self._agent is not None:
            ranks = hasattr(self._agent.policy, "checks")
            method = agent_method("agent", self._agent, checks if ranks else None)
            yield "agent", lambda: self._result("agent", method, scene)
        for name, known in BASELINES.items():
            yield name, lambda name=name, known=known: self._result(name, self._baseline(known), scene)  # type: ignore[misc]

    def close(self) -> None:
        """Close the environments."""
        if self._simulation is not None:
            self._simulation.close()

    def _baseline(self, name: str) -> Method:
        if name not in self._methods:
            self._methods[name] = make_method(name, self._env_id, **self._kwargs)
        return self._methods[name]

    def _result(self, name: str, method: Method, scene: LiveScene) -> MethodResult:
        if self._simulation is None:
            self._simulation = new_simulation(self._env_id, 1, **self._kwargs)
        simulation, changing = self._simulation, scene.batch()
        replanning = simulation.task.replanning
        scenes: Any = changing if replanning else Scenes(*changing[:3])
        rows = simulation.task.observation.n_rows
        scenes = scenes._replace(
            **{each: _padded(getattr(scenes, each), rows) for each in _row_names(scenes)}
        )
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


def _row_names(scenes: Any) -> tuple[str, ...]:
    return tuple(name for name in ("obstacles", "courses") if name in scenes._fields)


def _padded(rows: Any, number: int) -> Any:
    return np.pad(rows, ((0, 0), (0, number - rows.shape[1]), (0, 0)))
