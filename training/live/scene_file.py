"""Scenes of the live page: their record, JSON files, and Python code that sets them up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import (
    CAPSULES,
    has_shapes,
    obstacle_names,
    obstacle_rows,
    obstacles_from_rows,
    row_size,
    shape_columns,
    shape_number,
    widened,
)
from viapoint.envs.geometry.shapes import SHAPES
from viapoint.envs.scenes.dynamic_scene import MOST_JUMPS, ChangingScenes
from viapoint.envs.scenes.options import scene_from_json, scene_to_json
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.planning.search import numbers_of_shape

SCENE_SHAPES = tuple(name for name, shape in SHAPES.items() if shape.in_scenes)
"""Shapes that obstacles of a scene may have."""
LARGEST_FILE = 1 << 20
"""Greatest size of a scene file, [bytes]."""
DIGITS = 6
"""Decimal places of coordinates in code, [m]."""


class LiveScene(NamedTuple):
    """One scene with as many rows as it has obstacles."""

    start: Float
    """Shape (D,), [m]."""
    goal: Float
    """Shape (D,), [m]."""
    obstacles: Float
    """Rows with shapes, shape (n, .), [m], see :mod:`viapoint.envs.geometry.rows`."""
    courses: Float
    """Rows (velocity D, time, velocity D), shape (n, 2 D + 1), [m/s] and [s]; zero for obstacles at rest."""
    jumps: Float
    """Rows (time, target D), shape (j, D + 1), [s] and [m]."""
    names: tuple[str, ...] = ()
    """Names of the obstacles; those behind the last one given have none."""

    @classmethod
    def of(cls, scenes: Scenes | ChangingScenes, row: int = 0) -> LiveScene:
        """Return one scene of a batch."""
        present, d = scenes.present[row], scenes.start.shape[-1]
        courses, jumps = np.zeros((int(present.sum()), 2 * d + 1)), np.zeros((0, d + 1))
        if isinstance(scenes, ChangingScenes):
            courses, jumps = scenes.courses[row, present], scenes.jumps[row]
            jumps = jumps[(jumps != 0.0).any(axis=-1)]
        obstacles = widened(scenes.obstacles[row, present])
        parts = (scenes.start[row], scenes.goal[row], obstacles, courses, jumps)
        return cls._make([*(np.array(part, dtype=np.float64) for part in parts), ()])

    @property
    def shapes(self) -> list[str]:
        """Names of the obstacles' shapes."""
        return [list(SHAPES)[int(number)] for number in shape_columns(self.obstacles).kind]

    def with_shapes(self, shapes: Sequence[str]) -> LiveScene:
        """Return the scene with the rows of an environment whose obstacles have some shapes, among them its own."""
        rows, d = self.obstacles, len(self.start)
        if tuple(shapes) == CAPSULES:
            return self._replace(obstacles=np.concatenate((rows[:, : 2 * d], rows[:, -1:]), axis=-1))
        if "sphere" not in shapes:  # a capsule without a length
            rows = rows.copy()
            kind = rows[:, 2 * d]
            kind[kind == shape_number("sphere")] = shape_number("capsule")
        return self._replace(obstacles=rows)

    def options(self, *, changing: bool) -> dict[str, Float]:
        """Return the options of `reset`; `changing` environments get courses and jumps, too."""
        names = ("start", "goal", "obstacles", *(("courses", "jumps") if changing else ()))
        return {name: getattr(self, name) for name in names}

    def batch(self) -> ChangingScenes:
        """Return the scene and its changes as a batch of one."""
        jumps = np.zeros((1, MOST_JUMPS, self.jumps.shape[-1]))
        jumps[0, : len(self.jumps)] = self.jumps
        return ChangingScenes(
            self.start[None], self.goal[None], self.obstacles[None], jumps, self.courses[None]
        )

    def without(self, row: int) -> LiveScene:
        """Return the scene without an obstacle."""
        rows = [i for i in range(len(self.obstacles)) if i != row]
        names = (*self.names[:row], *self.names[row + 1 :])
        return self._replace(obstacles=self.obstacles[rows], courses=self.courses[rows], names=names)

    def with_obstacle(self, numbers: Float) -> LiveScene:
        """Return the scene with one more obstacle at rest."""
        course = np.zeros((1, self.courses.shape[-1]))
        return self._replace(
            obstacles=np.concatenate((self.obstacles, numbers[None])),
            courses=np.concatenate((self.courses, course)),
        )

    def with_row(self, row: int, numbers: Float) -> LiveScene:
        """Return the scene with other numbers of one obstacle."""
        obstacles = self.obstacles.copy()
        obstacles[row] = numbers
        return self._replace(obstacles=obstacles)


def to_json(scene: LiveScene, env_id: str) -> str:
    """Return a scene as the text of a JSON file."""
    shapes = obstacles_from_rows(scene.obstacles)
    names = (*scene.names, *[""] * len(shapes))
    shapes = [replace(each, name=name) for each, name in zip(shapes, names, strict=False)]
    options: dict[str, Any] = {"start": scene.start, "goal": scene.goal, "obstacles": shapes}
    changes = {"courses": scene.courses, "jumps": scene.jumps}
    options |= {name: value for name, value in changes.items() if value.any()}
    return scene_to_json(options, env_id)


def from_json(text: str | bytes, dimension: int) -> LiveScene:
    """Return the scene of a JSON file; whether a movement can start and end in it is checked later.

    Args:
        text: Content of the file.
        dimension: Dimension D of the arm's space.

    Raises:
        ValueError: The text is no scene file, or a value has another shape or is not finite.
    """
    if len(text) > LARGEST_FILE:
        raise ValueError(f"a scene file has at most {LARGEST_FILE} bytes, got {len(text)}")
    options = scene_from_json(text)
    shapes, size = options.get("obstacles", []), 2 * dimension + 1
    rows = obstacle_rows(shapes or np.zeros((0, size)), dimension, SCENE_SHAPES)
    if np.shape(rows)[-1] != row_size(dimension, SCENE_SHAPES):
        rows = widened(numbers_of_shape("obstacles", rows, (None, size)))
    rows = numbers_of_shape("obstacles", rows, (None, row_size(dimension, SCENE_SHAPES)))
    names = tuple(obstacle_names(shapes)[0])
    courses = numbers_of_shape(
        "courses", options.get("courses", np.zeros((len(rows), size))), (len(rows), size)
    )
    jumps = numbers_of_shape(
        "jumps", options.get("jumps") or np.zeros((0, dimension + 1)), (None, dimension + 1)
    )
    start, goal = (numbers_of_shape(name, options.get(name), (dimension,)) for name in ("start", "goal"))
    present, jumps = rows.any(axis=-1), jumps[jumps.any(axis=-1)]
    return LiveScene(start, goal, rows[present], courses[present], jumps, names if any(names) else ())


def to_python(scene: LiveScene, env_id: str, env_kwargs: Mapping[str, Any], *, changing: bool) -> str:
    """Return Python code that sets the scene up in Gymnasium."""
    names = {name: value for name, value in env_kwargs.items() if name not in ("render_mode", "threads")}
    given = "".join(f", {name}={getattr(value, 'name', value)!r}" for name, value in names.items())
    lines = ["import gymnasium as gym", "", f'env = gym.make("viapoint.envs:{env_id}"{given})']
    lines += ["options = {"]
    options = scene.options(changing=changing)
    for name, value in options.items():
        if value.ndim == 1:
            lines.append(f'    "{name}": {_rounded(value)},  # [m]')
        elif name == "obstacles" and has_shapes(value):
            each = (shape.to_dict() for shape in obstacles_from_rows(value))
            lines += [f'    "{name}": [', *(f"        {record}," for record in each), "    ],"]
        else:
            lines += [f'    "{name}": [', *(f"        {_rounded(row)}," for row in value), "    ],"]
    lines += ["}", "observation, info = env.reset(options=options)"]
    return "\n".join(lines) + "\n"


def _rounded(values: Any) -> Any:
    """Return numbers as lists of rounded floats."""
    return (np.round(np.asarray(values, dtype=np.float64), DIGITS) + 0.0).tolist()
