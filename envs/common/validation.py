"""Validation of arguments; errors name the argument, the allowed values and the value."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float, Int

MIN_GOAL_DISTANCE = 0.02
"""Least distance between start and goal, [m]."""


def is_whole(value: Any) -> bool:
    """Return True for a whole number, also NumPy's; a bool is none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return True for a real number, also NumPy's; a bool is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def whole_number(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return a whole number from `least` to `most`; None for no upper limit."""
    if not is_whole(value) or value < least or (most is not None and value > most):
        allowed = f"{least} or more" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be a whole number, {allowed}, got {value!r}")
    return int(value)


def check_increasing_pair(name: str, pair: Any) -> None:
    """Check that a pair is two positive finite numbers in increasing order."""
    try:
        low, high = pair
    except (TypeError, ValueError):
        low = high = None
    if not (is_number(low) and is_number(high)):
        raise ValueError(f"{name} must be two numbers, got {pair!r}")
    if not (0.0 < low < high < float("inf")):
        raise ValueError(f"{name} must be two positive numbers in increasing order, got {pair!r}")


def as_given(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of arguments, independent of later changes of the caller's lists and mappings."""
    return {
        name: copy.copy(value) if isinstance(value, Mapping | list) else value
        for name, value in arguments.items()
    }


def fewest_and_most(number: Any, name: str = "n_obstacles") -> tuple[int, int]:
    """Return (fewest, most) from an exact number or such a pair."""
    pair = (number, number) if isinstance(number, int | np.integer) else number
    try:
        fewest, most = pair
        return whole_number(name, fewest, 0), whole_number(name, most, 0)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a whole number or (fewest, most), got {number!r}") from None


def number_of_at_least(name: str, value: Any, least: float, why: str = "") -> float:
    """Return a finite real number that is at least `least`; `why` explains the bound in the error."""
    if not is_number(value) or not least <= float(value) < np.inf:
        raise ValueError(f"{name} must be a finite number, {least:g} or more{why}, got {value!r}")
    return float(value)


def reset_options(options: Any) -> dict[str, Any]:
    """Return a copy of the options of `reset`."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be a mapping from names to values, or None, got {options!r}")
    return dict(options or {})


def masked_rows(mask: Any, num_envs: int, running: bool) -> Int:
    """Return the indices of the environments in a reset mask; without a mask, of all."""
    if mask is None:
        return np.arange(num_envs)
    mask = np.asarray(mask)
    if mask.shape != (num_envs,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(
            f"options['reset_mask'] must be a bool array of shape ({num_envs},) with a True in it, got {mask!r}"
        )
    if not running and not mask.all():
        raise ValueError("options['reset_mask'] must be True for every environment at the first reset")
    return np.flatnonzero(mask)


def as_real_array(values: Any) -> NDArray[Any] | None:
    """Return real numbers as an array, or None for anything else."""
    try:
        array = np.asarray(values)
    except (
        TypeError,
        ValueError,
        RuntimeError,
    ):  # rows of different lengths; tensors that require a gradient
        return None
    return array if array.dtype.kind in "fiu" else None


def real_numbers(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return actions as an array of real numbers; the error names their shape, which is not checked."""
    array = as_real_array(actions)
    if array is None:
        raise ValueError(f"action must be real numbers of shape {shape}, got {actions!r}")
    return array


def checked_actions(actions: Any, num_envs: int, names: Sequence[str]) -> Float:
    """Return finite actions of shape (num_envs, m), clipped to [-1, 1]; `names` are those of the m components."""
    shape = (num_envs, len(names))
    array = real_numbers(actions, shape).astype(np.float64, copy=False)
    if array.shape != shape:
        raise ValueError(f"action must have shape {shape} ({', '.join(names)}), got {array.shape}")
    if not np.isfinite(array).all():
        env, component = np.argwhere(~np.isfinite(array))[0]
        value = array[env, component]
        raise ValueError(f"action must be finite, got {value} for {names[component]} of environment {env}")
    return np.clip(array, -1.0, 1.0)


def seeds_of(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """Return a seed for each environment: `seed + i`, `seed[i]`, or None."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, np.ndarray) and not seed.ndim:
        seed = seed.item()
    if not isinstance(seed, Sequence | np.ndarray):
        first = whole_number("seed", seed, 0)
        return [first + i for i in range(num_envs)]
    seeds = [None if s is None else whole_number("seed", s, 0) for s in cast("Sequence[Any]", seed)]
    if len(seeds) != num_envs:
        raise ValueError(f"seed must be a whole number or {num_envs} of them, got {len(seeds)}")
    return seeds


def finite_array(name: str, values: Any) -> Float:
    """Return finite real numbers as an array of double precision; an array that is one already is not copied."""
    array = as_real_array(values)
    if array is None:
        raise ValueError(f"{name} must be an array of real numbers, got {values!r:.60}")
    finite = np.isfinite(array)
    if not finite.all():
        raise ValueError(f"{name} must be finite, got {array[~finite][0]}")
    return array.astype(np.float64, copy=False)


def array_of_shape(name: str, values: Any, wanted: str, fits: Callable[..., bool]) -> Float:
    """Return real numbers as a new array.

    Args:
        name: Name of the argument for errors.
        values: Array or nested lists.
        wanted: Description of the shape for errors.
        fits: Function that returns True for an allowed shape, given as its lengths.
    """
    array = as_real_array(values)
    if array is None or not fits(*array.shape):
        got = "no real numbers" if array is None else f"shape {array.shape}"
        raise ValueError(f"{name} must have shape {wanted}, got {got}")
    return array.astype(np.float64)
