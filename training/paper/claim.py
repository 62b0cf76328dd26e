"""Claims of the paper with their computed numbers and expected ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np


class Range(NamedTuple):
    """Range of values that a number may have."""

    low: float = -np.inf
    high: float = np.inf

    def contains(self, value: float) -> bool:
        """Return whether a value is in the range; NaN never is."""
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        if np.isfinite(self.low) and np.isfinite(self.high):
            return f"{(self.low + self.high) / 2.0:.6g} ± {(self.high - self.low) / 2.0:.2g}"
        return f"at most {self.high:.4g}" if np.isfinite(self.high) else f"at least {self.low:.4g}"


def near(value: float, tolerance: float) -> Range:
    """Return the range around a value."""
    return Range(value - tolerance, value + tolerance)


def at_most(value: float) -> Range:
    """Return the range up to a value."""
    return Range(high=value)


def at_least(value: float) -> Range:
    """Return the range from a value on."""
    return Range(low=value)


Number: TypeAlias = tuple[Any, Range]  # Computed number and its expected range


@dataclass(frozen=True)
class Claim:
    """Statement with its number on the model and, where it can be simulated, on the arm."""

    row: int  # Number of its subject
    claim: str  # Text of the statement; it says where the statement is only approximate
    figure: str = "-"  # Figure of the paper
    paper: str = "-"  # Statement or measurement of the paper
    model: Number | None = None  # Number on the model; None where it needs an arm
    arm: Number | None = None  # Number on the simulated arm; None for mathematics alone
    deviation: float | None = None  # Greatest distance of the simulated hand from the plan, [mm]
    unit: str = ""  # Unit of the numbers

    @property
    def holds(self) -> bool:
        """True if every number is in its expected range."""
        numbers = [number for number in (self.model, self.arm) if number is not None]
        return all(expected.contains(value) for value, expected in numbers)

    @property
    def verdict(self) -> str:
        """Verdict in one word."""
        return "holds" if self.holds else "FAILS"

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON; open ends of a range are null."""
        record: dict[str, Any] = {
            name: getattr(self, name) for name in ("row", "claim", "figure", "paper", "unit")
        }
        for name, number in (("model", self.model), ("arm", self.arm)):
            record[name] = number and float(number[0])
            record[f"{name}_expected"] = number and [
                float(end) if np.isfinite(end) else None for end in number[1]
            ]
        record["deviation_mm"] = None if self.deviation is None else float(self.deviation)
        return {**record, "verdict": self.verdict}
