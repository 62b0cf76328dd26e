"""Scenes that `reset(options=...)` gives, wholly or in part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.sampler import Sampler
from viapoint.envs.scenes import Scenes, check_scenes, problems

Float = NDArray[np.float64]

GIVEN = ("start", "goal", "obstacles")
"""What options may give."""
ATTEMPTS = 50
"""How often start and goal are drawn until given obstacles leave room for them."""


def draw_given(
    options: Mapping[str, Any], sampler: Sampler, generators: Sequence[np.random.Generator], n_rows: int
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
    arm, whole_arm, number = sampler.arm, sampler.whole_arm, len(generators)
    nothing = Scenes(
        np.full((number, arm.dimension), np.nan),
        np.full((number, arm.dimension), np.nan),
        np.zeros((number, n_rows, 2 * arm.dimension + 1)),
    )
    given = given_scenes(options, nothing, arm)
    with np.errstate(invalid="ignore"):
        check_scenes(given, arm, whole_arm=whole_arm)  # comparisons with what is not given are false
    if set(options) >= set(GIVEN):
        return given
    scenes = _drawn(options, sampler, generators, given)
    for _ in range(ATTEMPTS):
        wrong = np.zeros(number, dtype=bool)
        for these, _ in problems(scenes, arm, whole_arm=whole_arm):
            wrong |= these
        if not wrong.any() or "obstacles" not in options:
            break
        again = np.flatnonzero(wrong)
        some = {name: _rows(options[name], again, number, 2 + (name == "obstacles")) for name in options}
        scenes.put(again, _drawn(some, sampler, [generators[int(i)] for i in again], given.take(again)))
    check_scenes(scenes, arm, whole_arm=whole_arm)
    return scenes


def _drawn(
    options: Mapping[str, Any],
    sampler: Sampler,
    generators: Sequence[np.random.Generator],
    given: Scenes,
) -> Scenes:
    try:
        sampled = sampler(generators, (given.start, given.goal))
    except RuntimeError as error:
        raise ValueError(f"{error}; give the obstacles too, or ends farther inside the arm's reach") from None
    return given_scenes(options, sampled, sampler.arm)


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
