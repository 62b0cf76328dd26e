"""Scenes and their changes that are given to `reset` as options."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float, Int
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.rows import (
    CAPSULES,
    dimension_of,
    has_shapes,
    is_shape_list,
    obstacle_names,
    obstacle_rows,
    row_size,
    shape_number,
    widened,
)
from viapoint.envs.geometry.shape import UNIT_TOLERANCE
from viapoint.envs.geometry.shapes import MESH_HINT, SHAPES, as_obstacle, as_obstacles, refuse_single
from viapoint.envs.scenes.dynamic_scene import MOST_JUMPS
from viapoint.envs.scenes.families import MOST_OBSTACLES
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import Scenes, check_scenes, problems

GIVEN = ("start", "goal", "obstacles")
"""Options that give a scene, or a part of one."""
CHANGES = ("jumps", "courses")
"""Options that give the changes of a scene."""
FORMAT = "viapoint-scene"
"""Value of the key `format` of a scene file."""
ATTEMPTS = 50
"""Attempts to draw start and goal such that given obstacles leave room for them."""


def draw_given(
    options: Mapping[str, Any], sampler: SceneSampler, generators: Sequence[np.random.Generator], n_rows: int
) -> Scenes:
    """Return N scenes with the parts that `options` gives; the other parts are sampled to fit.

    Sampled obstacles stand in the way of the given ends; with given obstacles, start and goal are only sampled clear of
    them.

    Args:
        options: May hold `start` and `goal`, shape (D,) or (N, D), and `obstacles`, shape (n, 2 D + 1) or
            (N, n, 2 D + 1), [m]; or a list of shapes, or of their dictionaries, for all scenes, or N such lists.
        sampler: Sampler of the task's scenes.
        generators: N random generators.
        n_rows: Greatest number of obstacles in a scene.

    Raises:
        ValueError: An array is not finite or has another shape, a name is unknown, or a scene is impossible.
    """
    refuse_unknown_options(options, GIVEN)
    collision_model, shapes, number = sampler.collision_model, sampler.distribution.shapes, len(generators)
    dimension = collision_model.arm.dimension
    point = (number, dimension)
    sizes = {"start": point, "goal": point, "obstacles": (number, n_rows, row_size(dimension, shapes))}
    parts = {}
    for name, value in options.items():
        rows = _rows_of(value, dimension, shapes) if name == "obstacles" else value
        parts[name] = _parse(name, rows, sizes[name])
    names = obstacle_names(options.get("obstacles", []))
    nowhere = np.full(point, np.nan)
    given = Scenes(nowhere, nowhere, np.zeros(sizes["obstacles"]))._replace(**parts)
    if has_shapes(given.obstacles):
        given = given._replace(obstacles=_with_unit_quaternions(given.obstacles))
    with np.errstate(invalid="ignore"):
        # Parts that are not given are NaN: comparisons with them are false.
        check_scenes(given, collision_model, names)
    if set(parts) >= set(GIVEN):
        return given

    def sample(rows: Int) -> Scenes:
        some = given.take(rows)
        try:
            sampled = sampler([generators[int(i)] for i in rows], (some.start, some.goal))
        except RuntimeError as error:
            raise ValueError(
                f"{error}; give the obstacles too, or ends farther inside the arm's reach"
            ) from None
        return sampled._replace(**{name: getattr(some, name) for name in parts})

    scenes = sample(np.arange(number))
    for _ in range(ATTEMPTS):
        wrong = np.zeros(number, dtype=bool)
        for these, _ in problems(scenes, collision_model):
            wrong |= these
        if not wrong.any() or "obstacles" not in parts:
            break
        again = np.flatnonzero(wrong)
        scenes.put(again, sample(again))
    check_scenes(scenes, collision_model, names)
    return scenes


def _rows_of(obstacles: Any, dimension: int, shapes: Sequence[str]) -> Any:
    """Return given obstacles as rows of scenes that may have some shapes."""
    try:
        rows = obstacle_rows(obstacles, dimension, shapes)
    except ValueError as error:
        raise ValueError(f"options['obstacles']: {error}") from None
    if tuple(shapes) != CAPSULES and np.shape(rows)[-1:] == (row_size(dimension),):
        rows = widened(_numbers("obstacles", rows))
    return rows


def _with_unit_quaternions(rows: Float) -> Float:
    """Return rows with shapes whose quaternions have length 1, if they nearly had."""
    begin = 2 * dimension_of(rows) + 1
    quaternion = rows[..., begin : begin + 4]
    size = norm(quaternion)[..., None]
    error = np.abs(size - 1.0)
    # As in records, what has been normalised stays as it is.
    inexact = (error > 8.0 * np.finfo(np.float64).eps) & (error <= UNIT_TOLERANCE)
    again = rows.copy()
    again[..., begin : begin + 4] = np.where(inexact, quaternion / np.where(inexact, size, 1.0), quaternion)
    return again


def scene_to_json(options: Mapping[str, Any], env_id: str = "") -> str:
    """Return the options of `reset` that set up one scene as JSON, with all digits and the names of obstacles.

    Args:
        options: Some of `start`, `goal`, `obstacles`, `jumps` and `courses`, also of a batch of one scene.
        env_id: Environment of the scene, for readers of the file.

    Raises:
        ValueError: An option is unknown, or does not hold real numbers, or obstacles, of one scene.

    Example:
        >>> from viapoint.envs import Sphere, scene_from_json, scene_to_json
        >>> ball = Sphere(0.03, position=(0.5, 0.0, 0.4), name="ball")
        >>> text = scene_to_json({"start": (0.45, -0.33, 0.4), "goal": (0.45, 0.33, 0.4), "obstacles": [ball]})
        >>> scene_from_json(text)["obstacles"] == [ball]
        True
    """
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be those of reset, a dictionary, got {options!r:.60}")
    refuse_unknown_options(options, (*GIVEN, *CHANGES))
    record: dict[str, Any] = {"format": FORMAT, **({"env": env_id} if env_id else {})}
    for name, value in options.items():
        if name == "obstacles":
            refuse_single(value)
            one = isinstance(value, list | tuple) and len(value) == 1 and is_shape_list(value[0])
            value = value[0] if one else value
        if name == "obstacles" and is_shape_list(value):
            record[name] = [each.to_dict() for each in as_obstacles(value)]
        else:
            array = _numbers(name, value)
            batched = array.ndim == (2 if name in ("start", "goal") else 3)
            if batched and len(array) != 1:
                raise ValueError(f"options[{name!r}] must be those of one scene, got {len(array)} scenes")
            array = array[0] if batched else array
            if name == "obstacles" and array.ndim == 2 and has_shapes(array):
                # Rows hold indices into this table, which is another one where other meshes are registered.
                record["shapes"] = list(SHAPES)
            record[name] = array.tolist()
    return json.dumps(record, indent=1) + "\n"


def scene_from_json(text: str | bytes) -> dict[str, Any]:
    """Return the options of `reset` from the JSON of :func:`scene_to_json` or a file of the live page.

    Obstacles are shapes, or rows of numbers if they were written as such. Numbers are checked by `reset`.

    Raises:
        ValueError: The text is no scene file, or an obstacle is not allowed.

    Example:
        >>> from viapoint.envs import scene_from_json
        >>> scene_from_json('{"format": "viapoint-scene", "goal": [0.1, 0.4]}')
        {'goal': [0.1, 0.4]}
    """
    try:
        record = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the scene file is not JSON: {error}") from None
    if not isinstance(record, Mapping) or record.get("format") != FORMAT:
        raise ValueError(f'a scene file is a JSON object with "format": "{FORMAT}"')
    refuse_unknown_options(
        {name: None for name in record if name not in ("format", "env", "shapes")}, (*GIVEN, *CHANGES)
    )
    options = {name: record[name] for name in (*GIVEN, *CHANGES) if name in record}
    obstacles = options.get("obstacles", [])
    if not isinstance(obstacles, list):
        raise ValueError(f"obstacles of the scene file must be a list, got {obstacles!r:.60}")
    if obstacles and not all(isinstance(each, list) for each in obstacles):
        options |= _obstacles_of_file(obstacles)
    elif "shapes" in record:
        options["obstacles"] = _rows_of_file(obstacles, record["shapes"])
    return options


def _rows_of_file(rows: Sequence[Any], shapes: Any) -> list[list[float]]:
    """Return rows with shapes, whose numbers of shapes are indices into `shapes`, as rows of this process.

    Raises:
        ValueError: A shape is unknown here, or the rows are none with shapes.
    """
    array = _numbers("obstacles", rows)
    if not (isinstance(shapes, list) and array.ndim == 2 and has_shapes(array)):
        raise ValueError(
            "shapes of the scene file must be a list of names, and its obstacles rows with shapes"
        )
    column = array[:, 2 * dimension_of(array)]
    for i, number in enumerate(column):
        name = shapes[int(number)] if 0.0 <= number < len(shapes) and number == int(number) else number
        if not isinstance(name, str) or name not in SHAPES:
            raise ValueError(
                f"obstacle {i} of the scene file: unknown shape {name!r}. Shapes are {', '.join(SHAPES)}; {MESH_HINT}"
            )
        column[i] = shape_number(name)
    return array.tolist()  # type: ignore[no-any-return]


def _obstacles_of_file(records: Sequence[Any]) -> dict[str, Any]:
    """Return the obstacles of a file, and their courses if it has them beside the shapes, as older files do."""
    found, courses = [], []
    for i, each in enumerate(records):
        one = dict(each) if isinstance(each, Mapping) else each
        courses.append(one.pop("course", None) if isinstance(one, dict) else None)
        try:
            found.append(as_obstacle(one))
        except ValueError as error:
            raise ValueError(f"obstacle {i} of the scene file: {error}") from None
    given = [each for each in courses if each is not None]
    if not given:
        return {"obstacles": found}
    rest = np.zeros(np.shape(given[0])).tolist()
    return {"obstacles": found, "courses": [rest if each is None else each for each in courses]}


def refuse_unknown_options(options: Mapping[str, Any], known: Sequence[str]) -> None:
    """Check the names of options.

    Raises:
        ValueError: A name is unknown; the message lists the known ones.
    """
    unknown = sorted(repr(name) for name in options if name not in known)
    if unknown:
        raise ValueError(f"reset options know {', '.join(known)} and reset_mask, not {', '.join(unknown)}")


def given_changes(
    options: Mapping[str, Any], number: int, dimension: int, n_rows: int
) -> tuple[Float | None, Float | None]:
    """Return given jumps and courses of N scenes; None where not given.

    Args:
        options: May hold `jumps`, rows (time, target D), and `courses`, rows (velocity D, time, velocity D), one
            for each given obstacle; shape (n, .) for all scenes, or (N, n, .).
        number: Number of scenes, N.
        dimension: D.
        n_rows: Greatest number of obstacles in a scene, n.

    Returns:
        Jumps, shape (N, MOST_JUMPS, D + 1), and courses, shape (N, n, 2 D + 1).

    Raises:
        ValueError: An array is not finite or has another shape, or a name is unknown.
    """
    refuse_unknown_options(options, (*GIVEN, *CHANGES))
    jumps, courses = None, None
    if "jumps" in options:
        jumps = _parse("jumps", options["jumps"], (number, MOST_JUMPS, dimension + 1))
        absent_last = np.argsort((jumps == 0.0).all(axis=-1), axis=-1, kind="stable")
        jumps = np.take_along_axis(jumps, absent_last[..., None], axis=1)
    if "courses" in options:
        if "obstacles" not in options:
            raise ValueError("options['courses'] are those of options['obstacles'], which must be given, too")
        courses = _parse("courses", options["courses"], (number, n_rows, 2 * dimension + 1))
    elif "obstacles" in options:
        courses = np.zeros((number, n_rows, 2 * dimension + 1))
    return jumps, courses


def _parse(name: str, value: Any, shape: tuple[int, ...]) -> Float:
    """Return an option as an array of a shape: (N, D), or (N, n, .) with rows of zeros behind the given ones.

    The option may be one for all scenes.
    """
    array = _numbers(name, value)
    result, (number, *most, size) = np.zeros(shape), shape
    if not most:
        if array.shape not in (shape, shape[1:], (1, size)):
            raise ValueError(f"options[{name!r}] must have shape {shape} or {shape[1:]}, got {array.shape}")
        result[:] = array
        return result
    if array.shape in ((0,), (number, 0)):
        return result
    one, several = array.ndim == 2, array.ndim == 3 and len(array) in (1, number)
    if array.shape[-1:] != (size,) or not (one or several):
        raise ValueError(
            f"options[{name!r}] must have shape (n, {size}) or ({number}, n, {size}), got {array.shape}"
        )
    if array.shape[-2] > most[0]:
        hint = ""
        if name == "obstacles":
            hint = f"; make the environment with n_obstacles=(0, n) and n up to {MOST_OBSTACLES}"
        raise ValueError(f"options[{name!r}] must have at most {most[0]} {name}, got {array.shape[-2]}{hint}")
    result[:, : array.shape[-2]] = array
    return result


def _numbers(name: str, value: Any) -> Float:
    """Return an option as finite real numbers."""
    return finite_array(f"options[{name!r}]", value)
