"""Scenes of the live page: their record, JSON files, and Python code that sets them up."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs import Scenes, Shape, Task, scene_from_json, scene_to_json
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.obstacles import Obstacles, pack
from viapoint.envs.scenes.options import FORMAT

LARGEST_FILE = 1 << 20
"""Greatest size of a scene file, [bytes]."""
DIGITS = 6
"""Decimal places of numbers in code."""


class LiveScene(NamedTuple):
    """One scene in coordinates of the task's space: the options of `reset`."""

    start: Float
    """Shape (D,)."""
    goal: Float
    """Shape (D,)."""
    obstacles: tuple[Shape, ...]
    """Obstacles at time 0, with their velocities."""
    jumps: Float
    """Jumps of the target: rows (time [s], target D), shape (k, D + 1)."""
    turns: Float
    """Changes of course: rows (time [s], velocity 3 [m/s]) for each obstacle, zero for none, shape (n, 4)."""

    @classmethod
    def of(cls, scenes: Scenes, task: Task, row: int = 0) -> LiveScene:
        """Return one of the scenes of a task."""
        return cls.from_json(scene_to_json(scenes, task.arm, task.space_name, scene=row), task)

    @classmethod
    def from_json(cls, text: str | bytes, task: Task) -> LiveScene:
        """Return the scene of a JSON file; the environment checks later whether it is possible.

        Raises:
            ValueError: The text is no scene file, or a value has another shape or is not finite.
        """
        if len(text) > LARGEST_FILE:
            raise ValueError(f"a scene file has at most {LARGEST_FILE} bytes, got {len(text)}")
        options = scene_from_json(text)
        missing = ", ".join(name for name in ("start", "goal") if name not in options)
        if missing:
            raise ValueError(f"the scene file must have start and goal, missing is {missing}")
        dimension = task.space.dimension
        start, goal = (finite_array(name, options[name], (dimension,)) for name in ("start", "goal"))
        obstacles = tuple(options.get("obstacles", ()))
        jumps, turns = np.zeros((0, dimension + 1)), np.zeros((len(obstacles), 4))
        if options.get("jumps"):
            jumps = finite_array("jumps", options["jumps"], (None, dimension + 1))
        if options.get("turns"):
            turns = finite_array("turns", options["turns"], turns.shape)
        return cls(start, goal, obstacles, jumps, turns)

    def to_json(self, env_id: str) -> str:
        """Return the scene as the text of a JSON file, with the names of its obstacles."""
        record = {"format": FORMAT, "env": env_id, **self.plain()}
        return json.dumps(record, indent=1) + "\n"

    def plain(self) -> dict[str, Any]:
        """Return the scene as plain numbers and lists; what does not change is left out."""
        options = self.options()
        record: dict[str, Any] = {
            name: np.asarray(value).tolist() for name, value in options.items() if name != "obstacles"
        }
        record["obstacles"] = [shape.to_dict() for shape in self.obstacles]
        return record

    def options(self) -> dict[str, Any]:
        """Return the options of `reset`; what does not change is left out."""
        changes = {name: getattr(self, name) for name in ("jumps", "turns") if getattr(self, name).any()}
        return {"start": self.start, "goal": self.goal, "obstacles": list(self.obstacles), **changes}

    @property
    def packed(self) -> Obstacles:
        """Obstacles as one scene of packed arrays."""
        return pack([self.obstacles])

    def with_obstacle(self, shape: Shape, row: int | None = None) -> LiveScene:
        """Return the scene with another obstacle in a row, or with one more."""
        if row is not None:
            return self._replace(obstacles=(*self.obstacles[:row], shape, *self.obstacles[row + 1 :]))
        return self._replace(
            obstacles=(*self.obstacles, shape), turns=np.concatenate((self.turns, np.zeros((1, 4))))
        )

    def without(self, row: int) -> LiveScene:
        """Return the scene without an obstacle."""
        left = (*self.obstacles[:row], *self.obstacles[row + 1 :])
        return self._replace(obstacles=left, turns=np.delete(self.turns, row, axis=0))

    def at_rest(self) -> LiveScene:
        """Return the scene with a target that does not jump."""
        return self._replace(jumps=self.jumps[:0])


def to_python(scene: LiveScene, env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """Return Python code that sets the scene up in Gymnasium."""
    names = {name: value for name, value in env_kwargs.items() if name not in ("render_mode", "threads")}
    given = "".join(f", {name}={getattr(value, 'name', value)!r}" for name, value in names.items())
    lines = ["import gymnasium as gym", "", f'env = gym.make("viapoint.envs:{env_id}"{given})', "options = {"]
    for name, value in scene.plain().items():
        if name in ("start", "goal"):
            lines.append(f'    "{name}": {_rounded(value)},')
        else:
            lines += [f'    "{name}": [', *(f"        {_rounded(each)}," for each in value), "    ],"]
    lines += ["}", "observation, info = env.reset(options=options)"]
    return "\n".join(lines) + "\n"


def _rounded(value: Any) -> Any:
    """Return plain values with rounded numbers."""
    if isinstance(value, dict):
        return {name: _rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return round(value, DIGITS) + 0.0 if isinstance(value, float) else value
