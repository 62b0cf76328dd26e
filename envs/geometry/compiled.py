"""Decorator of compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

FASTMATH = {"reassoc", "contract", "arcp", "nsz", "afn"}
"""Optimisations of arithmetic that are allowed; NaN and infinity keep their meaning."""


def compiled(function: Function) -> Function:
    """Compile a function of plain numbers and arrays with Numba when it is first called.

    The machine code is cached on disk, and runs without Python's global lock.
    """
    fast = njit(cache=True, nogil=True, fastmath=FASTMATH)(function)
    return cast("Function", fast)
