"""What NumPy and torch both need and the Array API standard has only slowly."""

from __future__ import annotations

import functools
import operator
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

Array = Any
"""A NumPy array or a torch tensor; what comes in decides what goes out."""


def namespace_of(array: Array) -> Any:
    """The Array API functions that belong to an array; of NumPy's, which are asked for most often, at once."""
    return np if type(array) is np.ndarray else array_namespace(array)


def clamp(values: Array, low: float, high: float) -> Array:
    """Values no less than `low` and no more than `high`; the method is several times as fast as the function."""
    if type(values) is np.ndarray:
        return values.clip(low, high)
    xp = namespace_of(values)
    return xp.minimum(xp.maximum(values, low), high)


def cosine_and_sine(angles: Array) -> tuple[Array, Array]:
    """Both of angles; NumPy computes either several times as slowly as the tangent of the half, which gives both."""
    xp = namespace_of(angles)
    if xp is not np:
        return xp.cos(angles), xp.sin(angles)
    tangent = np.tan(0.5 * angles)
    square = tangent * tangent
    share = 1.0 / (1.0 + square)
    return (1.0 - square) * share, 2.0 * tangent * share


def squared_length(vectors: Array) -> Array:
    """Sum of squares along the last axis: component by component, as sums of a few numbers each are slow."""
    square = vectors * vectors
    return functools.reduce(operator.add, (square[..., i] for i in range(vectors.shape[-1])))


def last(array: Array, axes: int = 1) -> Array:
    """The same with its first axes behind the others, each of their items by itself in memory, where it is quick."""
    return namespace_of(array).moveaxis(array, tuple(range(axes)), tuple(range(-axes, 0)))


Float = NDArray[np.float64]


def norm(vectors: Float) -> Float:
    """Euclidean length along the last axis."""
    return np.asarray(np.sqrt(squared_length(vectors)))
