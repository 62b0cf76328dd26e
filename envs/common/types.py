"""Type aliases of arrays that all packages share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]  # Array of double precision
Single = NDArray[np.float32]  # Array of single precision
Bool = NDArray[np.bool_]  # Array of truth values
Int = NDArray[np.int64]  # Array of integers: counts, row numbers, physics steps
Frame = NDArray[np.uint8]  # Picture, shape (height, width, 3)
Observation = dict[str, Single]  # Observation of one environment or of a batch, by the names of its parts
