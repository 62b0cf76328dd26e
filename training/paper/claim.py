"""Claims of the paper with their computed numbers and expected ranges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


@dataclass(frozen=True, kw_only=True)
class ExpectedRange:
    """Range of values that a number may have, from `low` to `high`."""

    low: float = -np.inf
    high: float = np.inf

    def contains(self, value: float) -> bool:
        """Return whether a value is in the range; NaN never is."""
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        if np.isfinite(self.low) and np.isfinite(self.high):
            return f"{(self.low + self.high) / 2.0:.6g} ± {(self.high - self.low) / 2.0:.2g}"
        return f"at most {self.high:.4g}" if np.isfinite(self.high) else f"at least {self.low:.4g}"


def near(value: float, tolerance: float) -> ExpectedRange:
    """Return the range around a value."""
    return ExpectedRange(low=value - tolerance, high=value + tolerance)


def at_most(value: float) -> ExpectedRange:
    """Return the range up to a value."""
    return ExpectedRange(high=value)


def at_least(value: float) -> ExpectedRange:
    """Return the range from a value on."""
    return ExpectedRange(low=value)


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Statement with its number on the model and, where it can be simulated, on the arm."""

    row: int
    """Number of its subject in SUBJECTS."""
    claim: str
    """Text of the statement; it says where the statement is only approximate."""
    figure: str = "-"
    """Figure of the paper."""
    paper: str = "-"
    """Statement or measurement of the paper."""
    unit: str = ""
    """Unit of the numbers."""
    model: float | None
    """Number on the model; None where it needs an arm."""
    expected: ExpectedRange | None = None
    """Expected range of the model's number."""
    arm: float | None = None
    """Number on the simulated arm; None for statements about the mathematics alone."""
    arm_expected: ExpectedRange | None = None
    """Expected range of the arm's number."""
    deviation: float | None = None
    """Greatest distance of the simulated hand from the plan, [mm]."""

    @property
    def holds(self) -> bool:
        """Truth of the claim: every number is in its expected range.

        Raises:
            ValueError: There is no number, or a number without an expected range or the reverse.
        """
        pairs = ((self.model, self.expected), (self.arm, self.arm_expected))
        if all(value is None for value, _ in pairs):
            raise ValueError(f"claim without a number: {self.claim}")
        if any((value is None) != (expected is None) for value, expected in pairs):
            raise ValueError(f"a number and its expected range belong together: {self.claim}")
        return all(expected.contains(value) for value, expected in pairs if expected and value is not None)

    @property
    def verdict(self) -> str:
        """Verdict in one word."""
        return "holds" if self.holds else "FAILS"

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON; open ends of a range are null."""
        record: dict[str, Any] = {
            name: getattr(self, name) for name in ("row", "claim", "figure", "paper", "unit")
        }
        for name, value, expected in (
            ("model", self.model, self.expected),
            ("arm", self.arm, self.arm_expected),
        ):
            record[name] = None if value is None else float(value)
            record[f"{name}_expected"] = None if expected is None else _ends(expected)
        record["deviation_mm"] = None if self.deviation is None else float(self.deviation)
        return {**record, "verdict": self.verdict}


SUBJECTS = {
    1: "Point to point",
    2: "Invariance of hand paths",
    3: "Joints and torques",
    4: "Free passage time",
    5: "Speed valley and curvature",
    6: "Place of the via-point",
    7: "Isochrony",
    8: "Scaling with time",
    9: "Alternatives to minimum jerk",
    10: "Repetitive and performance-limited movements",
    11: "The primer and its replanned version",
    12: "Obstacle avoidance",
    13: "A target that jumps on the way (Flash & Henis 1991)",
}
"""Titles of the rows: twelve of Flash & Hogan 1985, one of Flash & Henis 1991."""


def _ends(expected: ExpectedRange) -> list[float | None]:
    return [end if np.isfinite(end) else None for end in (expected.low, expected.high)]


class Reproduction(NamedTuple):
    """Claims, and pictures (PNG) with their captions."""

    claims: list[Claim]
    pictures: list[tuple[Path, str]]

    @property
    def failed(self) -> list[Claim]:
        """Claims that do not hold."""
        return [claim for claim in self.claims if not claim.holds]
