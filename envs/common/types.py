"""Type aliases of arrays that all packages share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
"""Array of double precision."""
Single = NDArray[np.float32]
"""Array of single precision."""
Numbers = NDArray[np.floating[Any]]
"""Array of single or double precision."""
Array = NDArray[Any]
"""Array of single or double precision where results have that of the arguments."""
Bool = NDArray[np.bool_]
"""Array of truth values."""
Int = NDArray[np.int64]
"""Array of integers: counts, row numbers, physics steps."""
Index = NDArray[np.intp]
"""Array of indices, as `argmin` and `nonzero` return them."""
Frame = NDArray[np.uint8]
"""Picture, shape (height, width, 3)."""
Observation = dict[str, Single]
"""Observation of one environment or of a batch, by the names of its parts."""
Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Two opposite corners of an axis-aligned box, the lower one first, [m]."""
