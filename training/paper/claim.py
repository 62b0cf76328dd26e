"""Claims of the paper with their computed numbers and expected ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

Range: TypeAlias = tuple[float, float]  # Least and greatest value that a number may have
Number: TypeAlias = tuple[Any, Range]  # Computed number and its expected range


def near(value: float, tolerance: float) -> Range:
    """Return the range around a value."""
    return value - tolerance, value + tolerance


def at_most(value: float) -> Range:
    """Return the range up to a value."""
    return -np.inf, value


def at_least(value: float) -> Range:
    """Return the range from a value on."""
    return value, np.inf


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
        """True if every number is in its expected range, which NaN never is."""
        numbers = [number for number in (self.model, self.arm) if number is not None]
        return all(low <= value <= high for value, (low, high) in numbers)

    @property
    def verdict(self) -> str:
        """Verdict in one word."""
        return "holds" if self.holds else "FAILS"

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON; open ends of a range are null."""
        record = {name: getattr(self, name) for name in ("row", "claim", "figure", "paper", "unit")}
        for name in ("model", "arm"):
            value, ends = getattr(self, name) or (None, ())
            record[name] = None if value is None else float(value)
            record[f"{name}_expected"] = [float(end) if np.isfinite(end) else None for end in ends] or None
        record["deviation_mm"] = None if self.deviation is None else float(self.deviation)
        return {**record, "verdict": self.verdict}
