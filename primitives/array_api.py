"""Array conversion, validation and the few operations that NumPy and torch do not share.

All formulas of the package use operators and Array API names, so that one source serves both libraries.
array-api-compat imports torch only when a caller passes tensors.
"""

from __future__ import annotations

import enum
import functools
import math
import operator
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias, TypeGuard

import numpy as np

# A numpy.ndarray or torch.Tensor of a floating dtype; arguments may be anything that numpy.asarray accepts
Array: TypeAlias = Any

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]  # A NumPy array in double precision

Namespace: TypeAlias = Any  # The Array API functions of an array: numpy, or array_api_compat.torch


class Free(enum.Enum):
    """Type of FREE, the boundary value that minimisation of the cost determines (natural boundary condition).

    Pass `FREE` as goal velocity or goal acceleration to leave it open.

    Example:
        >>> from viapoint.primitives import FREE, point_to_point
        >>> hit = point_to_point([0.0], [1.0], 1.0, goal_velocity=FREE, goal_acceleration=FREE)
        >>> round(float(hit(1.0, 1)[0]), 9)  # a movement that hits its goal at 2.5 times its mean speed
        2.5
    """

    FREE = "FREE"

    def __repr__(self) -> str:
        return self.value


FREE: Final = Free.FREE
"""Boundary value that minimisation of the cost determines (natural boundary condition)."""

# A given boundary value, None for rest (zero), or FREE
Boundary: TypeAlias = Array | Literal[Free.FREE] | None

Ends: TypeAlias = dict[str, Boundary]  # The four boundary values by name, in the order of END_NAMES

END_NAMES = ("start_velocity", "start_acceleration", "goal_velocity", "goal_acceleration")

# Distance of waypoints that count as equal, in units of the rounding of their greatest coordinate.
_EQUAL = 64.0

_PLAIN = (np.ndarray, float, int, list, tuple, np.generic)

_MAY_BE_FREE = ("goal_velocity", "goal_acceleration")


def is_given(value: Boundary) -> TypeGuard[Array]:
    """Return True for a boundary value that is an array, neither None nor FREE."""
    return value is not None and value is not FREE


def change_given(function: Callable[[Array], Array], values: Iterable[Boundary]) -> list[Boundary]:
    """Return boundary values of which arrays are changed by a function; None and FREE stay."""
    return [function(value) if is_given(value) else value for value in values]


def change_time_unit(state: Iterable[Boundary], unit: Array) -> list[Boundary]:
    """Return the first, second, ... derivatives times unit (..., 1), unit^2, ...; None and FREE stay."""
    changed: list[Boundary] = []
    power = unit
    for value in state:
        changed.append(value * power if is_given(value) else value)
        power = power * unit
    return changed


def unit_time_ends(ends: Sequence[Boundary], duration: Array) -> list[Any]:
    """Return the values of END_NAMES in unit time, V = v T and A = a T^2; None and FREE stay."""
    time = duration[..., None]
    return change_time_unit(ends[:2], time) + change_time_unit(ends[2:], time)


def as_floats(optional: Mapping[str, Any] | None = None, /, **required: Any) -> tuple[Namespace, list[Any]]:
    """Convert arguments by name to one array library and one floating dtype; return it and them, required ones first.

    Among the optional ones None is returned as it is, and FREE for the goal's velocity and acceleration. The dtype is
    the widest floating dtype among the arrays. Numbers, lists and integer arrays do not count; without any floating
    array it is float64. An argument that is missing, not numeric, or not finite raises ValueError.
    """
    # Every call of the package passes here: loops and inlined tests of `is_given` halve the calls of a movement.
    named = {**required, **optional} if optional else required
    plain = True
    for name, value in named.items():
        if value is None or value is FREE:
            if name in required or (value is FREE and name not in _MAY_BE_FREE):
                raise ValueError(f"{name} must be an array of real numbers, got {value!r}")
        elif not isinstance(value, _PLAIN):
            plain = False
    xp, arrays = (np, _numpy_floats(named)) if plain else _foreign_floats(named)
    for name, array in zip(named, arrays, strict=True):
        if array is not None and array is not FREE and not (finite := xp.isfinite(array)).all():
            require(finite, name, array, "must be finite")
    return xp, arrays


def read_arguments(
    ends: tuple[Boundary, Boundary, Boundary, Boundary],
    optional: Mapping[str, Any] | None = None,
    /,
    **required: Any,
) -> tuple[Namespace, list[Any], Ends]:
    """Convert the arguments of a movement to one library and dtype, see `as_floats`.

    `ends` are the values of END_NAMES. They are returned by name, after the namespace and the other arrays.
    """
    named = dict(zip(END_NAMES, ends, strict=True))
    xp, arrays = as_floats({**(optional or {}), **named}, **required)
    return xp, arrays[:-4], dict(zip(END_NAMES, arrays[-4:], strict=True))


def namespace_of(array: Array) -> Namespace:
    """Return the Array API functions of an array."""
    if isinstance(array, np.ndarray):
        return np
    from array_api_compat import array_namespace

    return array_namespace(array)


def _numpy_floats(named: dict[str, Any]) -> list[Any]:
    """Return the arguments as NumPy arrays of their widest floating dtype."""
    dtype: np.dtype[Any] | None = None
    for value in named.values():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            if dtype is None:  # before any comparison: NumPy's float64 equals None
                dtype = value.dtype
            elif value.dtype != dtype:
                dtype = np.promote_types(dtype, value.dtype)
    dtype = np.dtype(np.float64) if dtype is None else dtype
    arrays: list[Any] = []
    for name, value in named.items():
        if value is None or value is FREE:
            arrays.append(value)
            continue
        try:
            if isinstance(value, np.ma.MaskedArray):
                raise TypeError("leave out what is masked")
            array = np.asarray(value)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"dtype {array.dtype}")
            arrays.append(array if array.dtype == dtype else array.astype(dtype))
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(
                f"{name} must be an array of real numbers, got {value!r:.60} ({error})"
            ) from None
    return arrays


def _foreign_floats(named: dict[str, Any]) -> tuple[Namespace, list[Any]]:
    """Return the arguments in the library, widest floating dtype and device of the tensors among them."""
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
        if not is_given(value):
            arrays.append(value)
        elif name not in foreign:
            # Copy: torch would share the caller's memory, and accepts neither read-only arrays nor long doubles.
            plain = np.array(_numpy_floats({name: value})[0], dtype=np.float64, order="C")
            arrays.append(xp.asarray(plain, dtype=dtype, device=place))
        elif xp.isdtype(value.dtype, ("real floating", "integral")):
            arrays.append(value if value.dtype == dtype else xp.astype(value, dtype))
        else:
            raise ValueError(f"{name} must be an array of real numbers, got dtype {value.dtype}")
    return xp, arrays


def require(holds: Array, name: str, array: Array, requirement: str) -> None:
    """Raise ValueError with the first entry of `array` for which `holds` is False."""
    if holds.all():
        return
    index = tuple(int(i) for i in np.argwhere(~to_numpy(holds))[0])
    value = float(to_numpy(array)[index])
    place = f" at index {index}" if index else ""
    raise ValueError(f"{name} {requirement}, got {value}{place} (shape {tuple(array.shape)})")


def leading_shape(name: str, array: Array, *sizes: int | None) -> tuple[int, ...]:
    """Return the shape of an array before its last axes; raise ValueError unless these have the sizes.

    None stands for any size of at least 1.
    """
    shape = tuple(array.shape)
    first = len(shape) - len(sizes)
    fits = first >= 0
    for size, found in zip(sizes, shape[max(first, 0) :], strict=False):
        fits = fits and (found >= 1 if size is None else found == size)
    if not fits:
        letters = iter("NDKM")
        wanted = ", ".join(["...", *(next(letters) if size is None else str(size) for size in sizes)])
        raise ValueError(f"{name} must have shape ({wanted}), got shape {shape}")
    return shape[:first]


def broadcast_batch(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the common leading shape; raise ValueError with all shapes if they do not broadcast."""
    first, *rest = shapes.values()
    if rest.count(first) == len(rest):
        return first
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"leading dimensions do not broadcast: {listed}") from None


def end_shapes(ends: Mapping[str, Boundary], dimension: int) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of the given boundary values; raise ValueError if a last axis is not D."""
    shapes = {}
    for name, value in ends.items():
        if is_given(value):
            shapes[name] = leading_shape(name, value, dimension)
    return shapes


def waypoint_shapes(waypoints: Array, ends: Ends) -> dict[str, tuple[int, ...]]:
    """Return the leading shapes of waypoints and of boundary values, or raise ValueError."""
    shape = leading_shape("waypoints", waypoints, None, None)
    if waypoints.shape[-2] < 2:
        raise ValueError("waypoints must hold start and goal, got one point")
    return {"waypoints": shape, **end_shapes(ends, waypoints.shape[-1])}


def check_durations(name: str, durations: Array, waypoints: Array, ends: Ends) -> None:
    """Raise ValueError for durations (..., S) below 0, and for 0 between waypoints (..., S + 1, D) that differ.

    All durations of a movement may be 0 only if its ends are at rest.
    """
    if (durations > 0).all():
        return
    require(durations >= 0, name, durations, "must not be negative")
    points, numbers = to_numpy(waypoints), to_numpy(durations)
    positive = np.broadcast_to(numbers > 0, (*points.shape[:-2], numbers.shape[-1]))
    rounding = _EQUAL * np.finfo(points.dtype).eps * np.abs(points).max(axis=(-2, -1), initial=0.0)
    equal = np.abs(np.diff(points, axis=-2)).max(axis=-1) <= rounding[..., None]
    require(positive | equal, name, 1.0 * positive, "may be 0 only between equal waypoints")
    moves = np.zeros(positive.shape[:-1], dtype=bool)
    for value in ends.values():
        if is_given(value):
            moves = moves | (to_numpy(value) != 0).any(axis=-1)
    require(positive.any(axis=-1) | ~moves, name, 1.0 * moves, "must not be 0 for a movement whose ends move")


def is_whole(value: Any) -> bool:
    """Return True for an integer of at least 0 (not for a bool)."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= 0


def whole_orders(nu: int | Sequence[int]) -> tuple[int, ...]:
    """Return one order of derivative, or a sequence of them, as a tuple, or raise ValueError."""
    given: Any = nu
    try:
        orders = (given,) if is_whole(given) else tuple(given)
    except TypeError:
        orders = ()
    if not orders or not all(map(is_whole, orders)):
        raise ValueError(f"nu must be whole numbers of at least 0, got {nu!r}")
    return tuple(map(int, orders))


def as_number(value: Any) -> float:
    """Return a single real number as a float and anything else as NaN, which fails every range check."""
    try:
        single = not isinstance(value, str | bytes | bool) and np.ndim(value) == 0
        return float(value) if single else math.nan
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return math.nan


def broadcast_to(xp: Namespace, array: Array, shape: tuple[int, ...]) -> Array:
    """Broadcast an array, without the overhead of a call if it has the shape already."""
    return array if tuple(array.shape) == tuple(shape) else xp.broadcast_to(array, shape)


def flat_batch(xp: Namespace, array: Array, batch: Sequence[int], own: int) -> Array:
    """Return an array with its full batch in one axis; the last `own` axes stay."""
    shape = tuple(array.shape[len(array.shape) - own :])
    full = broadcast_to(xp, array, (*batch, *shape))
    return xp.reshape(full, (math.prod(batch), *shape))


def ordered_sum(array: Any, axis: int = 0) -> Any:
    """Sum a NumPy array along one axis from first to last.

    `numpy.sum` chooses its order by the memory layout, so that an item of a batch could differ from the same
    item alone in the last bit.
    """
    return functools.reduce(operator.add, np.moveaxis(array, axis, 0) if axis else array)


def to_numpy(array: Array) -> np.ndarray[Any, Any]:
    """Return a NumPy view or copy of `array`, detached from any gradient."""
    if isinstance(array, np.ndarray):
        return array
    if hasattr(array, "detach"):
        array = array.detach().cpu()
        if str(array.dtype) == "torch.bfloat16":  # a dtype that NumPy lacks; float32 represents it exactly
            array = array.float()
    return np.asarray(array)


def like(xp: Namespace, values: np.ndarray[Any, Any], other: Array) -> Array:
    """Convert `values` to the library, dtype and device of `other`."""
    if xp is np:
        return values.astype(other.dtype, copy=False)
    return xp.asarray(values, dtype=other.dtype, device=other.device)


def unit_factors(xp: Namespace, array: Array, axis: int | tuple[int, ...] = -1) -> Array:
    """Return powers of two that scale an array to a size of about 1 along the axes, which they keep with size 1.

    Squares of the scaled array neither over- nor underflow, and multiplication by a power of two is exact.
    """
    size = np.abs(to_numpy(array)).max(axis=axis, keepdims=True)
    # The largest n for which 2^n and 2^-n are both normal numbers of the dtype and of a double
    limit = math.frexp(min(float(xp.finfo(array.dtype).max), sys.float_info.max))[1] - 2
    exponent = np.minimum(np.maximum(np.frexp(size)[1], -limit), limit)
    return like(xp, np.ldexp(1.0, -exponent), array)


def vector_length(xp: Namespace, vectors: Array) -> Array:
    """Return the Euclidean norm of the last axis, without over- or underflow of squares."""
    factors = unit_factors(xp, vectors)
    return xp.linalg.vector_norm(vectors * factors, axis=-1) / factors[..., 0]
