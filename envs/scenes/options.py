"""Scenes and their changes that are given to reset as options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.dynamic_scene import MOST_JUMPS
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import Scenes, check_scenes, problems

GIVEN = ("start", "goal", "obstacles")
"""What options may give."""
ATTEMPTS = 50
"""How often start and goal are drawn until given obstacles leave room for them."""


def draw_given(
    options: Mapping[str, Any], sampler: SceneSampler, generators: Sequence[np.random.Generator], n_rows: int
) -> Scenes:
    """N scenes with what `options` gives, and the rest drawn to fit.

    Obstacles that are drawn stand in the way of the given ends; with given obstacles, start and goal are only drawn
    clear of them.

    Args:
        options: See :func:`given_scenes`.
        sampler: Draws the rest.
        generators: N of them.
        n_rows: Obstacles of a scene at most.

    Raises:
        ValueError: A scene is impossible, with the reason.
    """
    collision_model, arm, number = sampler.collision_model, sampler.collision_model.arm, len(generators)
    nothing = Scenes(
        np.full((number, arm.dimension), np.nan),
        np.full((number, arm.dimension), np.nan),
        np.zeros((number, n_rows, 2 * arm.dimension + 1)),
    )
    given = given_scenes(options, nothing, arm)
    with np.errstate(invalid="ignore"):
        check_scenes(given, collision_model)  # comparisons with what is not given are false
    if set(options) >= set(GIVEN):
        return given
    scenes = _drawn(options, sampler, generators, given)
    for _ in range(ATTEMPTS):
        wrong = np.zeros(number, dtype=bool)
        for these, _ in problems(scenes, collision_model):
            wrong |= these
        if not wrong.any() or "obstacles" not in options:
            break
        again = np.flatnonzero(wrong)
        some = {name: _rows(options[name], again, number, 2 + (name == "obstacles")) for name in options}
        scenes.put(again, _drawn(some, sampler, [generators[int(i)] for i in again], given.take(again)))
    check_scenes(scenes, collision_model)
    return scenes


def _drawn(
    options: Mapping[str, Any],
    sampler: SceneSampler,
    generators: Sequence[np.random.Generator],
    given: Scenes,
) -> Scenes:
    try:
        sampled = sampler(generators, (given.start, given.goal))
    except RuntimeError as error:
        raise ValueError(f"{error}; give the obstacles too, or ends farther inside the arm's reach") from None
    return given_scenes(options, sampled, sampler.collision_model.arm)


def _rows(value: Any, rows: NDArray[np.int64], number: int, batched: int) -> Any:
    """What a batch of options gives to some of its `number` scenes; what all share stays as it is."""
    array = np.asarray(value)
    return array[rows] if array.ndim == batched and len(array) == number else array


def given_scenes(options: Mapping[str, Any], sampled: Scenes, arm: Arm) -> Scenes:
    """Sampled scenes with what `options` gives in their place.

    Args:
        options: May hold `start` and `goal`, shape (D,) or (N, D), and `obstacles`, shape (n, 2 D + 1) or
            (N, n, 2 D + 1), with at most as many rows as the sampled ones, [m].
        sampled: The scenes to overwrite.
        arm: Only names the dimension.

    Raises:
        ValueError: An array is not finite or has another shape, or a name is unknown.
    """
    refuse_unknown_options(options, GIVEN)
    number, rows = sampled.obstacles.shape[:2]
    fields = {name: getattr(sampled, name).copy() for name in GIVEN}
    for name in ("start", "goal"):
        if name in options:
            fields[name][:] = _broadcast(name, options[name], (number, arm.dimension))
    if "obstacles" in options:
        given = numbers("obstacles", options["obstacles"])
        given = given.reshape((0, 2 * arm.dimension + 1)) if given.size == 0 else given
        count = given.shape[-2] if given.ndim >= 2 else -1
        if not 0 <= count <= rows:
            raise ValueError(
                f"options['obstacles'] must have shape (n, {2 * arm.dimension + 1}) or "
                f"({number}, n, {2 * arm.dimension + 1}) with n at most {rows}, got {given.shape}"
            )
        fields["obstacles"][:] = 0.0
        fields["obstacles"][:, :count] = _broadcast(
            "obstacles", given, (number, count, 2 * arm.dimension + 1)
        )
    return Scenes(**fields)


def refuse_unknown_options(options: Mapping[str, Any], known: Sequence[str]) -> None:
    """Refuse options that there are not, with those that there are."""
    unknown = sorted(repr(name) for name in options if name not in known)
    if unknown:
        raise ValueError(f"reset options know {', '.join(known)} and reset_mask, not {', '.join(unknown)}")


def _broadcast(name: str, value: Any, shape: tuple[int, ...]) -> Float:
    array = numbers(name, value)
    try:
        result = np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(
            f"options[{name!r}] must have shape {shape} or {shape[1:]}, got {array.shape}"
        ) from None
    if not np.isfinite(array).all():
        raise ValueError(f"options[{name!r}] must be finite, got {array[~np.isfinite(array)][0]}")
    return result


def numbers(name: str, value: Any) -> Float:
    """Real numbers, or a reason why not."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError
        return array.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"options[{name!r}] must be real numbers, got {value!r}") from None


CHANGES = ("jumps", "courses")
"""What options may give beside a scene."""


def given_changes(
    options: Mapping[str, Any], number: int, dimension: int, n_rows: int
) -> tuple[Float | None, Float | None]:
    """Jumps and courses of N scenes, shape (N, MOST_JUMPS, D + 1) and (N, n, 2 D + 1); None where not given.

    Args:
        options: May hold `jumps`, rows (time, target D), and `courses`, rows (velocity D, time, velocity D), one
            for each obstacle that is given; of one scene, which all share, or of each, shape (N, ., .).
        number: Of scenes, N.
        dimension: D.
        n_rows: Obstacles of a scene at most, n.

    Raises:
        ValueError: An array is not finite or has another shape, a course belongs to no obstacle, or a name is unknown.
    """
    refuse_unknown_options(options, (*GIVEN, *CHANGES))
    jumps, courses = None, None
    if "jumps" in options:
        jumps = _packed(_padded("jumps", options["jumps"], (number, MOST_JUMPS, dimension + 1)))
    if "courses" in options:
        if "obstacles" not in options:
            raise ValueError("options['courses'] are those of options['obstacles'], which must be given, too")
        courses = _padded("courses", options["courses"], (number, n_rows, 2 * dimension + 1))
    elif "obstacles" in options:
        courses = np.zeros((number, n_rows, 2 * dimension + 1))
    return jumps, courses


def check_owners(courses: Float, present: NDArray[np.bool_]) -> None:
    """Refuse courses of obstacles that there are not."""
    lost = (courses != 0.0).any(axis=-1) & ~present
    if lost.any():
        scene, row = np.argwhere(lost)[0]
        raise ValueError(
            f"scene {scene}: course {row} belongs to no obstacle; there are {present[scene].sum()}"
        )


def _packed(rows: Float) -> Float:
    """Rows of zeros, which are none, behind the others."""
    order = np.argsort((rows == 0.0).all(axis=-1), axis=-1, kind="stable")
    return np.take_along_axis(rows, order[..., None], axis=1)


def _padded(name: str, value: Any, shape: tuple[int, int, int]) -> Float:
    """Rows of one scene or of each, with rows of zeros behind them."""
    number, most, size = shape
    given = numbers(name, value)
    given = given.reshape((0, size)) if given.size == 0 else given
    fits = given.ndim in (2, 3) and given.shape[-1] == size and given.shape[-2] <= most
    if not fits or (given.ndim == 3 and len(given) not in (1, number)):
        raise ValueError(
            f"options[{name!r}] must have shape (n, {size}) or ({number}, n, {size}) with n at most {most}, "
            f"got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise ValueError(f"options[{name!r}] must be finite, got {given[~np.isfinite(given)][0]}")
    rows = np.zeros(shape)
    rows[:, : given.shape[-2]] = given
    return rows
