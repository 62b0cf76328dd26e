"""State of the live page: scene, method, plan, playing time and selection."""

from __future__ import annotations

import json
import pprint
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs import Plan, Scenes, Shape
from viapoint.envs.common.arrays import Float
from viapoint.envs.outcome import Rollout
from viapoint.envs.scenes.options import OPTIONS, options_to_json
from viapoint.training.planning.motion_plan import MotionPlan


class Scene(NamedTuple):
    """One scene in coordinates of the task's space: the options of `reset`."""

    start: Float  # Shape (D,)
    goal: Float  # Shape (D,)
    obstacles: tuple[Shape, ...]  # Obstacles at time 0, with their velocities
    jumps: Any = ()  # Jumps of the target: rows (time [s], target D)
    turns: Any = ()  # Changes of course: rows (time [s], velocity 3 [m/s]) by obstacle
    reaches: Any = ()  # Reaches: rows (begin [s], duration [s], way 3 [m]) by obstacle
    origin: str = ""  # Sentence on where the scene comes from, before a user changes it

    def options(self) -> dict[str, Any]:
        """Return the options of `reset`; what does not change is left out."""
        given = {name: value for name, value in self._asdict().items() if name in OPTIONS and len(value)}
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

    def with_goal(self, goal: Float) -> Scene:
        """Return the scene with another goal, which does not jump."""
        return self._replace(goal=goal, jumps=())

    def with_obstacle(self, row: int, shape: Shape) -> Scene:
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
    value: float | None = None  # Value by which the agent ranks the plan
    reward: float | None = None  # Simulated reward; None for a plan that fails, or not yet


class Movement(NamedTuple):
    """Simulated movement up to the next decision, or to its end."""

    rollout: Rollout  # The movement from its beginning, at every physics step
    scenes: Scenes  # Its scene, which has the places of obstacles over time
    plan: Plan | None  # Plan that is followed; None where the arm is steered
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
    # Compared methods: name, time of the first decision, [s], and simulated movement
    results: tuple[tuple[str, float, Movement], ...] = ()
    message: str = "Getting ready."  # Sentence on the plan or the movement
    good: bool = True  # False for bad news

    @property
    def plan(self) -> MotionPlan | None:
        """The plan; None before the first one."""
        return self.proposals[self.picked].motion if self.proposals else None
