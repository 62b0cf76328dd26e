"""Decorators of compiled functions, and rotations of vectors."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit, typeof, types
from numba.core.caching import IndexDataCacheFile

from viapoint.envs.common.arrays import Float

TINY = 1e-12  # Length below which a vector has no direction, [m]
Vector = tuple[float, float, float]  # Three components
Function = TypeVar("Function", bound=Callable[..., Any])

# Arithmetic in another order would be 3 % faster. But the order would depend on which functions the compiler met first,
# and results on whether machine code comes from the cache.
# `_nrt` allows arrays to be made; left out, Numba takes it from the function that is compiled around this one.
COMPILED: dict[str, Any] = {"nogil": True, "_nrt": True, "no_cfunc_wrapper": True}
KERNEL: dict[str, Any] = {**COMPILED, "error_model": "numpy", "_nrt": False}
"""Options of functions that make no arrays. Without `_nrt`, Numba does not count references to arrays, which takes 5 ns
for each array and call. Divisions by zero give infinity instead of an exception."""
SOURCES = set[str]()  # Files with compiled functions
INNER: dict[str, Any] = {"no_cpython_wrapper": True}  # Further options of functions that Python never calls


def _for_types(made: Any) -> Any:
    """Return a function that compiled functions call by the types of arguments, also where these are constants.

    Otherwise, Numba compiles it again for each constant that they pass, and for defaults.
    """
    if not hasattr(made, "_compiler"):  # Numba is switched off
        return made
    SOURCES.add(made.py_func.__code__.co_filename)
    fold = made._compiler.fold_argument_types
    type_of = cast("Any", typeof)
    unliteral = cast("Any", types.unliteral)

    def fold_to_types(*given: Any) -> tuple[Any, tuple[types.Type, ...]]:
        signature, folded = fold(*given)
        plain = (type_of(each.value) if isinstance(each, types.Omitted) else each for each in folded)
        return signature, tuple(map(unliteral, plain))

    made._compiler.fold_argument_types = fold_to_types
    return made


def compiled(function: Function) -> Function:
    """Compile a function of plain numbers and arrays with Numba when it is first called.

    The machine code is cached on disk, and runs without Python's global lock.
    """
    return cast("Function", _for_types(njit(cache=True, **COMPILED)(function)))


def kernel(function: Function) -> Function:
    """Compile a function that makes no arrays; the machine code is cached on disk."""
    return cast("Function", _for_types(njit(cache=True, **KERNEL)(function)))


def inner(function: Function) -> Function:
    """Compile a function that makes no arrays, and that compiled functions alone call; the code is cached on disk.

    It has no entrance for calls from Python, which for packed obstacles takes half a second to compile.
    """
    made = _for_types(njit(cache=True, **KERNEL, **INNER)(function))

    def refuse(*_: Any, **__: Any) -> None:
        raise TypeError(f"{function.__name__} is for compiled functions; from Python, call its `py_func`")

    # Numba itself would end the interpreter.
    made._compile_for_args = refuse
    made._insert = lambda *_, **__: None
    return cast("Function", made)


def inlined(function: Function) -> Function:
    """Compile a function as a part of each function that calls it.

    A call with packed obstacles passes 150 numbers, which takes longer than a distance.
    """
    SOURCES.add(function.__code__.co_filename)
    return cast("Function", njit(inline="always", **KERNEL)(function))


@inlined
def rotated(axes: Float, vector: Vector) -> Vector:
    """Return a vector of a frame in the world, for the axes of the frame as columns, shape (3, 3)."""
    x, y, z = vector
    return (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )


@inlined
def rotated_back(axes: Float, vector: Vector) -> Vector:
    """Return a vector of the world in a frame, for the axes of the frame as columns, shape (3, 3)."""
    x, y, z = vector
    return (
        axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z,
        axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z,
        axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z,
    )


def _no_clock(kind: int, moment: Any) -> int:
    return 0


# The clock of the operating system, where there is one that compiled functions can call: it fills in seconds and
# nanoseconds.
_read_clock: Any = njit(cache=True)(_no_clock)
if hasattr(time, "clock_gettime"):
    moment_type = types.CPointer(types.int64)  # type: ignore[no-untyped-call]
    _read_clock = types.ExternalFunction("clock_gettime", types.int32(types.int32, moment_type))
STEADY = getattr(time, "CLOCK_MONOTONIC", 0)  # Number of the clock that nobody sets


@compiled
def clock() -> float:
    """Return the time of a steady clock, [s], for differences; always 0 on systems without `clock_gettime`."""
    moment = np.zeros(2, np.int64)
    _read_clock(STEADY, moment.ctypes)
    return float(moment[0] + 1e-9 * moment[1])


_read_index: Callable[[Any], Any] = IndexDataCacheFile._load_index


def _index(cache: Any) -> Any:
    """Return the index of machine code on disk, an empty one where it may be of an earlier version of the package.

    Numba itself looks at the file of a function, but not at those of the functions that it calls, which may have
    changed, or be in other modules now.
    """
    written = Path(cache._index_path)
    files = (Path(file) for file in SOURCES)
    newest = max((file.stat().st_mtime for file in files if file.is_file()), default=0.0)
    try:
        return _read_index(cache) if written.is_file() and written.stat().st_mtime > newest else {}
    except (ImportError, AttributeError):
        return {}


setattr(IndexDataCacheFile, "_load_index", _index)  # noqa: B010 - mypy knows no such assignment
