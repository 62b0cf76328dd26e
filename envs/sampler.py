"""What draws scenes: one for the plane, one for space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.arm import Arm
from viapoint.envs.scenes import Scenes

Float = NDArray[np.float64]


class Sampler(Protocol):
    """Draws scenes for an arm, each from a generator of its own."""

    arm: Arm
    whole_arm: bool

    def __call__(
        self, generators: Sequence[np.random.Generator], ends: tuple[Float, Float] | None = None
    ) -> Scenes:
        """One scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are to be drawn, [m].

        Raises:
            RuntimeError: No scene was found in many attempts.
        """
