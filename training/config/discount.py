"""Discounts that depend on the duration of decisions, as in semi-Markov decision processes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.validation import is_number
from viapoint.envs.registration import REPLANNING_TASKS

ELAPSED = "elapsed"
"""Name of the duration of a decision in infos, [s]."""


@dataclass(frozen=True, kw_only=True)
class TimeDiscount:
    """Discount that depends on the duration of a decision.

    Raises:
        ValueError: gamma is not in (0, 1], or the unit is not positive.
    """

    gamma: float
    """Discount of one unit of time."""
    unit: float
    """Unit of time, [s]."""
    key: str = ELAPSED
    """Name of the duration of a decision in infos, [s]."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1] to be a discount by time, got {self.gamma!r}")
        _check_unit("unit", self.unit)

    def of(self, infos: Sequence[Mapping[str, Any]]) -> NDArray[np.float32]:
        """Return gamma^(elapsed / unit) for N infos, shape (N,).

        Raises:
            ValueError: An info does not tell the elapsed time, or tells one that is negative or not finite.
        """
        try:
            elapsed = np.array([info[self.key] for info in infos], dtype=np.float64)
        except KeyError:
            row, there = next((i, sorted(info)) for i, info in enumerate(infos) if self.key not in info)
            raise ValueError(
                f"to discount by time, info must tell how long a decision took, in seconds, as {self.key!r}; "
                f"that of environment {row} has {', '.join(there) or 'nothing'}"
            ) from None
        if not (np.isfinite(elapsed) & (elapsed >= 0.0)).all():
            raise ValueError(f"{self.key!r} must be finite and not negative, got {elapsed.min()!r} s")
        return np.asarray(self.gamma ** (elapsed / self.unit), dtype=np.float32)


def check_discount_unit(algorithm: str, unit: float, env_id: str) -> None:
    """Check the unit of time for an algorithm in an environment."""
    _check_unit("discount_unit", unit)
    if algorithm == "viaq" and env_id not in REPLANNING_TASKS:
        raise ValueError(f"discount_unit must be None for viaq: episodes of {env_id} are one decision")


def _check_unit(name: str, unit: float) -> None:
    if not (is_number(unit) and 0.0 < unit < math.inf):
        raise ValueError(f"{name} must be a positive number of seconds, got {unit!r}")
