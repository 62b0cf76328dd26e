"""The border of the package: any array library in, one clear error for bad numbers.

The formulas of this package use operators and Array API names only, so one source serves NumPy and torch.
torch is imported by array-api-compat, and only when the caller hands in tensors.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator, Sequence
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

_PLAIN = (int, float, list, tuple, np.generic, np.ndarray)
_NOT_NUMBERS = (None, FREE)


def as_floats(**named: Any) -> tuple[Namespace, list[Any]]:
    """Bring all arguments to one array library and one floating dtype; None and FREE pass through.

    Args:
        **named: arrays, numbers or nested lists by argument name.

    Returns:
        The namespace and the arrays in the order given. The dtype is the widest floating dtype among the
        arrays (numbers, lists and integer arrays do not count, and are float64 if nothing else is there).

    Raises:
        ValueError: an argument is not numeric, or not finite.
    """
    values = [value for value in named.values() if not _is_marker(value)]
    if all(isinstance(value, _PLAIN) for value in values):
        xp, arrays = np, _numpy_floats(named)
    else:
        xp, arrays = _foreign_floats(named, values)
    for name, array in zip(named, arrays, strict=True):
        if not _is_marker(array):
            require(xp, xp.isfinite(array), name, array, "must be finite")
    return xp, arrays


def namespace_of(array: Array) -> Namespace:
    """Return the Array API functions that belong to an array."""
    if isinstance(array, np.ndarray):
        return np
    from array_api_compat import array_namespace

    return array_namespace(array)


def _is_marker(value: Any) -> bool:
    return value is None or value is FREE


def _numpy_floats(named: dict[str, Any]) -> list[Any]:
    floating = [v.dtype for v in named.values() if isinstance(v, np.ndarray) and v.dtype.kind == "f"]
    dtype = floating[0] if floating else np.dtype(np.float64)
    for other in floating[1:]:
        dtype = dtype if other == dtype else np.promote_types(dtype, other)
    arrays: list[Any] = []
    for name, value in named.items():
        if _is_marker(value):
            arrays.append(value)
            continue
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"dtype {array.dtype}")
            arrays.append(array if array.dtype == dtype else array.astype(dtype))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be an array of real numbers, got {value!r} ({error})") from None
    return arrays


def _foreign_floats(named: dict[str, Any], values: list[Any]) -> tuple[Namespace, list[Any]]:
    from array_api_compat import array_namespace, device

    foreign = [value for value in values if not isinstance(value, _PLAIN)]
    try:
        xp = array_namespace(*foreign)
    except TypeError as error:
        names = ", ".join(named)
        raise ValueError(f"{names} must be NumPy arrays or torch tensors of one kind ({error})") from None
    place = device(foreign[0])
    floating = [value.dtype for value in foreign if xp.isdtype(value.dtype, "real floating")]
    dtype = xp.result_type(*floating) if floating else xp.float64
    arrays: list[Any] = []
    for name, value in named.items():
        if _is_marker(value):
            arrays.append(value)
        elif isinstance(value, _PLAIN):
            plain = _numpy_floats({name: value})[0]
            arrays.append(xp.asarray(np.ascontiguousarray(plain), dtype=dtype, device=place))
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


def whole_orders(nu: int | Sequence[int]) -> tuple[int, ...]:
    """Return orders of derivative as a tuple, or raise ValueError."""
    orders = tuple(nu) if isinstance(nu, Sequence | np.ndarray) else (nu,)
    if not orders or any(not isinstance(n, int | np.integer) or isinstance(n, bool) or n < 0 for n in orders):
        raise ValueError(f"nu must be whole numbers of at least 0, got {nu!r}")
    return tuple(int(order) for order in orders)


def check_buffers(out: Sequence[Array], count: int, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless `out` are `count` arrays of the shape."""
    shapes = [tuple(buffer.shape) for buffer in out]
    if shapes != [shape] * count:
        raise ValueError(f"out must be {count} arrays of shape {shape}, got shapes {shapes}")


def broadcast_to(xp: Namespace, array: Array, shape: tuple[int, ...]) -> Array:
    """xp.broadcast_to, free of charge where the shape is right already."""
    return array if tuple(array.shape) == tuple(shape) else xp.broadcast_to(array, shape)


def to_numpy(array: Array) -> np.ndarray[Any, Any]:
    """Return a NumPy view or copy of `array`, outside of any gradient."""
    if isinstance(array, np.ndarray):
        return array
    if hasattr(array, "detach"):
        array = array.detach().cpu()
    return np.asarray(array)


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
