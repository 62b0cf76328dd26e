"""Type aliases of NumPy arrays, operations on them, and rows of records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]  # Array of double precision
Single = NDArray[np.float32]  # Array of single precision
Bool = NDArray[np.bool_]  # Array of truth values
Int = NDArray[np.int64]  # Array of integers: counts, row numbers, physics steps
Frame = NDArray[np.uint8]  # Picture, shape (height, width, 3)
Observation = dict[str, Single]  # Observation of one environment or of a batch, by the names of its parts
Record = TypeVar("Record", bound=tuple[Any, ...])


def take(record: Record, rows: Any) -> Record:
    """Return the rows of a named tuple of arrays, or of such tuples; `rows` is an index, slice or mask."""
    return type(record)(*[take(part, rows) if isinstance(part, tuple) else part[rows] for part in record])


def put(record: Record, rows: Any, others: Record) -> None:
    """Overwrite rows of a named tuple of arrays."""
    for mine, theirs in zip(record, others, strict=True):
        mine[rows] = theirs


def as_dict(record: Any) -> dict[str, Any]:
    """Return copies of the arrays of a named tuple, and of such tuples in it, by their names."""
    copies = {}
    for name, part in record._asdict().items():
        copies[name] = as_dict(part) if isinstance(part, tuple) else part.copy()
    return copies


def from_dict(like: Record, copies: Mapping[str, Any]) -> Record:
    """Return a named tuple of the same kinds as another one with arrays of :func:`as_dict`, which are copied."""
    parts = []
    for name, part in like._asdict().items():  # type: ignore[attr-defined]
        value = copies[name]
        parts.append(from_dict(part, value) if isinstance(part, tuple) else np.array(value))
    return type(like)(*parts)


def norm(vectors: Float) -> Float:
    """Return the Euclidean length along the last axis, which is short: then NumPy's own sums are slow."""
    square = vectors * vectors
    total = square[..., 0]
    for i in range(1, vectors.shape[-1]):
        total = total + square[..., i]
    return np.asarray(np.sqrt(total))


def frozen(array: Any) -> Any:
    """Return a NumPy array after making it read-only."""
    array.flags.writeable = False
    return array


def frame_matrices(quaternion: Float) -> Float:
    """Return the axes of frames as columns, shape (..., 3, 3), from their quaternions, shape (..., 4)."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    found = np.empty((*quaternion.shape[:-1], 3, 3))
    found[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    found[..., 0, 1] = 2.0 * (x * y - w * z)
    found[..., 0, 2] = 2.0 * (x * z + w * y)
    found[..., 1, 0] = 2.0 * (x * y + w * z)
    found[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    found[..., 1, 2] = 2.0 * (y * z - w * x)
    found[..., 2, 0] = 2.0 * (x * z - w * y)
    found[..., 2, 1] = 2.0 * (y * z + w * x)
    found[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return found


def quaternion_to(direction: Any) -> Float:
    """Return the quaternion that turns the z axis to a direction, shape (3,)."""
    quaternion = np.empty(4)
    mujoco.mju_quatZ2Vec(quaternion, np.asarray(direction, dtype=np.float64))
    return quaternion
