"""The border of the package: any array library in, one clear error for bad numbers.

The formulas of this package use operators and Array API names only, so one source serves NumPy and torch.
torch is imported by array-api-compat, and only when the caller hands in tensors.
"""

from __future__ import annotations

import enum
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any, Final, Literal, TypeAlias

import numpy as np

Array: TypeAlias = Any
"""A numpy.ndarray or a torch.Tensor of a floating dtype; anything that numpy.asarray takes comes in."""

Namespace: TypeAlias = Any
"""The Array API functions that belong to an array: numpy, or array_api_compat.torch."""


class Free(enum.Enum):
    """Type of FREE."""

    FREE = "FREE"

    def __repr__(self) -> str:
        return self.value


FREE: Final = Free.FREE
"""A boundary value that the least cost decides (natural boundary), instead of the caller."""

Boundary: TypeAlias = Array | Literal[Free.FREE] | None
"""A given boundary value, None for rest (zero), or FREE."""

_PLAIN = (np.ndarray, float, int, list, tuple, np.generic)
_PLAIN_OR_OPEN = (*_PLAIN, type(None), Free)


def as_floats(optional: Mapping[str, Any] | None = None, /, **required: Any) -> tuple[Namespace, list[Any]]:
    """Bring all arguments to one array library and one floating dtype.

    Args:
        optional: further arguments by name; of these None and FREE pass through.
        **required: arrays, numbers or nested lists by argument name.

    Returns:
        The namespace and the arrays in the order given, first the required ones. The dtype is the widest
        floating dtype among the arrays (numbers, lists and integer arrays do not count, and are float64 if
        nothing else is there).

    Raises:
        ValueError: an argument is missing, not numeric, or not finite.
    """
    for name, value in required.items():
        if value is None or value is FREE:
            raise ValueError(f"{name} must be an array of real numbers, got {value!r}")
    named = {**required, **optional} if optional else required
    if all(isinstance(value, _PLAIN_OR_OPEN) for value in named.values()):
        xp, arrays = np, _numpy_floats(named)
    else:
        xp, arrays = _foreign_floats(named)
    for name, array in zip(named, arrays, strict=True):
        if array is not None and array is not FREE:
            require(xp, xp.isfinite(array), name, array, "must be finite")
    return xp, arrays


def namespace_of(array: Array) -> Namespace:
    """Return the Array API functions that belong to an array."""
    if isinstance(array, np.ndarray):
        return np
    from array_api_compat import array_namespace

    return array_namespace(array)


def _numpy_floats(named: dict[str, Any]) -> list[Any]:
    floating = [v.dtype for v in named.values() if isinstance(v, np.ndarray) and v.dtype.kind == "f"]
    dtype = floating[0] if floating else np.dtype(np.float64)
    for other in floating[1:]:
        dtype = dtype if other == dtype else np.promote_types(dtype, other)
    arrays: list[Any] = []
    for name, value in named.items():
        if value is None or value is FREE:
            arrays.append(value)
            continue
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"dtype {array.dtype}")
            arrays.append(array if array.dtype == dtype else array.astype(dtype))
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{name} must be an array of real numbers, got {value!r} ({error})") from None
    return arrays


def _foreign_floats(named: dict[str, Any]) -> tuple[Namespace, list[Any]]:
    from array_api_compat import array_namespace, device, is_array_api_obj

    foreign = {n: v for n, v in named.items() if not isinstance(v, _PLAIN) and is_array_api_obj(v)}
    if not foreign:
        return np, _numpy_floats(named)
    try:
        xp = array_namespace(*foreign.values())
    except TypeError as error:
        names = ", ".join(foreign)
        raise ValueError(f"{names} must be NumPy arrays or torch tensors of one kind ({error})") from None
    place = device(next(iter(foreign.values())))
    floating = [value.dtype for value in foreign.values() if xp.isdtype(value.dtype, "real floating")]
    dtype = xp.result_type(*floating) if floating else xp.float64
    arrays: list[Any] = []
    for name, value in named.items():
        if value is None or value is FREE:
            arrays.append(value)
        elif name not in foreign:
            # A copy: torch would share the caller's memory, and takes neither read-only arrays nor long doubles.
            plain = np.array(_numpy_floats({name: value})[0], dtype=np.float64, order="C")
            arrays.append(xp.asarray(plain, dtype=dtype, device=place))
        elif xp.isdtype(value.dtype, ("real floating", "integral")):
            arrays.append(value if value.dtype == dtype else xp.astype(value, dtype))
        else:
            raise ValueError(f"{name} must be an array of real numbers, got dtype {value.dtype}")
    return xp, arrays


def require(xp: Namespace, holds: Array, name: str, array: Array, what: str) -> None:
    """Raise ValueError naming the first entry of `array` for which `holds` is False."""
    if holds.all():
        return
    index = tuple(int(i) for i in np.argwhere(~to_numpy(holds))[0])
    value = float(to_numpy(array)[index])
    place = f" at index {index}" if index else ""
    raise ValueError(f"{name} {what}, got {value}{place} (shape {tuple(array.shape)})")


def require_vectors(name: str, array: Array, dimension: int | None = None) -> None:
    """Raise ValueError unless `array` has shape (..., D), with the D that is asked for."""
    if array.ndim < 1 or array.shape[-1] < 1:
        raise ValueError(f"{name} must have shape (..., D) with D >= 1, got shape {tuple(array.shape)}")
    if dimension is not None and array.shape[-1] != dimension:
        raise ValueError(f"{name} must have shape (..., {dimension}), got shape {tuple(array.shape)}")


def broadcast_batch(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the common leading shape; ValueError names arguments that do not go together."""
    first, *rest = shapes.values()
    if all(shape == first for shape in rest):
        return first
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"leading dimensions do not broadcast: {listed}") from None


def refuse_free(**named: Any) -> None:
    """Raise ValueError for an argument that is FREE where a movement cannot leave it open."""
    for name, value in named.items():
        if value is FREE:
            raise ValueError(
                f"{name} cannot be FREE: only the goal's velocity and acceleration may be left open"
            )


def is_whole(value: Any) -> bool:
    """Whether `value` is a whole number of at least 0."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= 0


def whole_order(nu: int) -> int:
    """Return one order of derivative, or raise ValueError."""
    if not is_whole(nu):
        raise ValueError(f"nu must be a whole number of at least 0, got {nu!r}")
    return int(nu)


def whole_orders(nu: int | Sequence[int]) -> tuple[int, ...]:
    """Return orders of derivative as a tuple, or raise ValueError."""
    orders = tuple(nu) if isinstance(nu, Sequence) or (isinstance(nu, np.ndarray) and nu.ndim) else (nu,)
    if not orders or not all(is_whole(order) for order in orders):
        raise ValueError(f"nu must be whole numbers of at least 0, got {nu!r}")
    return tuple(int(order) for order in orders)


def as_number(value: Any) -> float:
    """Return a single real number as a float; anything else as NaN, which lies in no range."""
    try:
        single = not isinstance(value, str | bytes | bool) and np.ndim(value) == 0
        return float(value) if single else math.nan
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return math.nan


def check_buffers(out: Sequence[Array], count: int, shape: tuple[int, ...], xp: Namespace) -> None:
    """Raise ValueError unless `out` are `count` arrays of the library and shape that numbers can be written to."""
    try:
        is_own = all(namespace_of(buffer) is xp for buffer in out)
    except TypeError:
        is_own = False
    if not is_own:
        raise ValueError(f"out must be {count} arrays of the trajectory's own kind, got {type(out).__name__}")
    shapes = [tuple(buffer.shape) for buffer in out]
    if shapes != [shape] * count:
        raise ValueError(f"out must be {count} arrays of shape {shape}, got shapes {shapes}")
    for buffer in out:
        is_floating = buffer.dtype.kind == "f" if xp is np else xp.isdtype(buffer.dtype, "real floating")
        if not is_floating:
            raise ValueError(f"out must be of a floating dtype, got {buffer.dtype}")
        if xp is np and not buffer.flags.writeable:
            raise ValueError(f"out must be writeable, got a read-only array of shape {shape}")


def broadcast_to(xp: Namespace, array: Array, shape: tuple[int, ...]) -> Array:
    """xp.broadcast_to, free of charge where the shape is right already."""
    return array if tuple(array.shape) == tuple(shape) else xp.broadcast_to(array, shape)


def to_numpy(array: Array) -> np.ndarray[Any, Any]:
    """Return a NumPy view or copy of `array`, outside of any gradient."""
    if isinstance(array, np.ndarray):
        return array
    if hasattr(array, "detach"):
        array = array.detach().cpu()
        if str(array.dtype) == "torch.bfloat16":  # a dtype that NumPy lacks; float32 holds it exactly
            array = array.float()
    return np.asarray(array)


def own(array: Array) -> Array:
    """Return the same numbers in memory that no caller shares, within the same gradient."""
    return array.copy(order="K") if isinstance(array, np.ndarray) else 1.0 * array


def detach(array: Array) -> Array:
    """Return the same numbers, outside of any gradient."""
    return array.detach() if hasattr(array, "detach") else array


def follows_gradient(*arrays: Array) -> bool:
    """Whether any of the arrays is part of a torch graph."""
    return any(getattr(array, "requires_grad", False) for array in arrays)


def like(xp: Namespace, values: np.ndarray[Any, Any], other: Array) -> Array:
    """`values` as an array of the library, dtype and device of `other`."""
    if xp is np:
        return values.astype(other.dtype, copy=False)
    return xp.asarray(values, dtype=other.dtype, device=other.device)


def unit_factors(xp: Namespace, array: Array) -> Array:
    """Powers of two (..., 1) that bring vectors (..., D) to a size of about 1: no square over- or underflows."""
    size = np.abs(to_numpy(array)).max(axis=-1, keepdims=True)
    largest = min(float(xp.finfo(array.dtype).max), sys.float_info.max)
    # Powers of two up to this one, and their inverses, are of full precision.
    limit = math.frexp(largest)[1] - 2
    exponent = np.clip(np.frexp(size)[1], -limit, limit)
    return like(xp, np.ldexp(1.0, -exponent), array)


def constant(table: tuple[tuple[float, ...], ...], other: Array) -> Array:
    """Return a constant matrix in the library, dtype and device of `other`, made once."""
    if isinstance(other, np.ndarray):
        return _numpy_constant(table, other.dtype)
    return _tensor_constant(table, other.dtype, other.device)


@lru_cache(maxsize=256)
def _numpy_constant(table: tuple[tuple[float, ...], ...], dtype: Any) -> Array:
    return np.array(table, dtype=dtype)


@lru_cache(maxsize=256)
def _tensor_constant(table: tuple[tuple[float, ...], ...], dtype: Any, device: Any) -> Array:
    import array_api_compat.torch

    torch: Any = array_api_compat.torch
    with torch.inference_mode(False):  # a constant made in inference mode could not serve a gradient later
        return torch.tensor(table, dtype=dtype, device=device)


def error_state(xp: Namespace) -> AbstractContextManager[Any]:
    """Silence NumPy's warnings where a masked branch divides by zero; torch has none."""
    return np.errstate(all="ignore") if xp is np else nullcontext()


def blocks(count: int, size: int) -> Iterator[slice]:
    """Slices of at most `size` that cover range(count)."""
    return (slice(first, min(first + size, count)) for first in range(0, count, size))
