"""Validation of arguments; errors name the argument, the allowed values and the value."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import Float, Int
from viapoint.primitives.array_api import is_whole

Record = TypeVar("Record")
Name = TypeVar("Name", bound=str)
UNIT_TOLERANCE = 1e-3  # Greatest error of a quaternion's length; smaller ones are corrected


def record_of(name: str, kind: type[Record], value: Any) -> Record:
    """Return a record of a dataclass from itself, or from a mapping of some of its fields."""
    if isinstance(value, kind):
        return value
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    if not isinstance(value, Mapping) or not set(known) >= set(value):
        raise ValueError(f"{name} must be a {kind.__name__}, or some of {', '.join(known)}, got {value!r}")
    return kind(**value)


def did_you_mean(value: Any, allowed: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the closest allowed one, or nothing if none is close."""
    close = difflib.get_close_matches(str(value), list(allowed), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def is_number(value: Any) -> bool:
    """Return True for a real number, also NumPy's; a bool is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def whole_number(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return a whole number from `least` to `most`; None for no upper limit."""
    if not is_whole(value) or value < least or (most is not None and value > most):
        allowed = f"{least} or more" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be a whole number, {allowed}, got {value!r}")
    return int(value)


def names_of(argument: str, names: Any) -> tuple[Any, ...]:
    """Return one name, or a sequence of one or more names, as a tuple.

    Raises:
        TypeError: The argument is something else.
        ValueError: There is no name.
    """
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"{argument} must be a name or a sequence of names, got {names!r:.60}")
    if not names:
        raise ValueError(f"{argument} must be one name or more, got {names!r}")
    return tuple(names)


def one_of(argument: str, name: Name, allowed: Sequence[Any]) -> Name:
    """Return a name that is an allowed one; arrays, which are compared by their elements, are refused, too."""
    if not isinstance(name, str) or name not in allowed:
        raise ValueError(f"{argument} must be one of {', '.join(allowed)}, got {name!r}")
    return name


def fewest_and_most(name: str, number: Any, most: int, most_drawn: int) -> tuple[int, int]:
    """Return (fewest, most) from a number or such a pair; at most `most_drawn` and `most`."""
    try:
        fewest, greatest = (number, number) if is_whole(number) else number
    except (TypeError, ValueError):
        fewest = greatest = None
    whole = is_whole(fewest) and is_whole(greatest)
    if not whole or not 0 <= fewest <= greatest <= most or fewest > most_drawn:
        raise ValueError(
            f"{name} must be a whole number from 0 to {most_drawn} or (fewest, most) with most up to {most}, "
            f"got {number!r}"
        )
    return int(fewest), int(greatest)


def number_of_at_least(name: str, value: Any, least: float, below: float = np.inf) -> float:
    """Return a finite real number that is at least `least` and less than `below`."""
    if not is_number(value) or not least <= float(value) < below:
        allowed = f"{least:g} or more" if below == np.inf else f"from {least:g} to less than {below:g}"
        raise ValueError(f"{name} must be a finite number, {allowed}, got {value!r}")
    return float(value)


def masked_rows(mask: Any, num_envs: int, running: bool) -> Int:
    """Return the indices of the environments in a reset mask; without a mask, of all."""
    if mask is None:
        return np.arange(num_envs)
    array = as_real_array(mask, "b")
    if array is None or array.shape != (num_envs,) or not array.any():
        raise ValueError(
            f"options['reset_mask'] must be {num_envs} bools, one or more of them True, got {mask!r:.60}"
        )
    if not running and not array.all():
        raise ValueError("options['reset_mask'] must be True for every environment at the first reset")
    return np.flatnonzero(array)


def as_real_array(values: Any, kinds: str = "fiu") -> NDArray[Any] | None:
    """Return real numbers, or values of other NumPy kinds, as an array, or None for anything else."""
    if isinstance(values, np.ma.MaskedArray):
        return None  # what is masked is missing
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        # Rows of different lengths, or tensors that require a gradient.
        return None
    return array if array.dtype.kind in kinds else None


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


def finite_array(name: str, values: Any, *shapes: tuple[Any, ...]) -> Float:
    """Return finite real numbers as an array of double precision; an array that is one already is not copied.

    In allowed shapes, None stands for any length but 0, and an ellipsis in front for any leading axes; without shapes,
    all are allowed.
    """
    array = as_real_array(values)
    if array is None:
        raise ValueError(f"{name} must be an array of real numbers, got {values!r:.60}")
    if shapes and not any(_fits(array.shape, shape) for shape in shapes):
        allowed = " or ".join(map(str, shapes)).replace("Ellipsis", "...").replace("None", "n")
        raise ValueError(f"{name} must have shape {allowed}, got {array.shape}")
    finite = np.isfinite(array)
    if not finite.all():
        raise ValueError(f"{name} must be finite, got {array[~finite][0]}")
    return array.astype(np.float64, copy=False)


def unit_quaternion(name: str, values: Any) -> Float:
    """Return a quaternion, shape (4,), whose length may be a little off 1, with the length 1."""
    quaternion = finite_array(name, values, (4,))
    length = float(np.linalg.norm(quaternion))
    off = abs(length - 1.0)
    if off > UNIT_TOLERANCE:
        raise ValueError(f"{name} must have length 1 (within {UNIT_TOLERANCE:g}), got length {length:.6g}")
    # A quaternion that was normalised before stays as it is, so that reading what was written changes nothing.
    return quaternion if off <= 8.0 * np.finfo(np.float64).eps else quaternion / length


def _fits(shape: tuple[int, ...], allowed: tuple[Any, ...]) -> bool:
    """Return True if a shape is an allowed one; see :func:`finite_array`."""
    if allowed[:1] == (...,):
        allowed = allowed[1:]
        shape = shape[max(len(shape) - len(allowed), 0) :]
    if len(shape) != len(allowed):
        return False
    for size, wanted in zip(shape, allowed, strict=True):
        if size != wanted and (wanted is not None or size == 0):
            return False
    return True
