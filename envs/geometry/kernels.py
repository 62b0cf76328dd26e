"""Decorators of the innermost compiled functions, which allocate no memory."""

from __future__ import annotations

from typing import Any, cast

from numba import njit

from viapoint.envs.geometry.compiled import FASTMATH, Function

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": FASTMATH, "error_model": "numpy", "_nrt": False}
"""Without `_nrt`, Numba does not count references to arrays, which takes 5 ns for each array and call. Then functions
cannot make arrays. Divisions by zero give infinity instead of an exception."""


def kernel(function: Function) -> Function:
    """Compile a function that makes no arrays; the machine code is cached on disk."""
    return cast("Function", njit(cache=True, **OPTIONS)(function))


def inlined(function: Function) -> Function:
    """Compile a function as a part of each function that calls it.

    A call with packed obstacles passes 150 numbers, which takes longer than a distance.
    """
    return cast("Function", njit(inline="always", **OPTIONS)(function))
