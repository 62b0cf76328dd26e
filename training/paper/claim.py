"""One line of the table: what the paper says, what comes out, and whether it holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Promise:
    """The values that a number may have: everything from `low` to `high`."""

    low: float = -np.inf
    high: float = np.inf

    def kept(self, value: float) -> bool:
        """Whether a value is among them; one that is not a number never is."""
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        if np.isfinite(self.low) and np.isfinite(self.high):
            return f"{(self.low + self.high) / 2.0:.6g} ± {(self.high - self.low) / 2.0:.2g}"
        return f"at most {self.high:.4g}" if np.isfinite(self.high) else f"at least {self.low:.4g}"


def near(value: float, tolerance: float) -> Promise:
    """A value and how far off it may be."""
    return Promise(low=value - tolerance, high=value + tolerance)


def at_most(value: float) -> Promise:
    """Everything up to a value."""
    return Promise(high=value)


def at_least(value: float) -> Promise:
    """Everything from a value on."""
    return Promise(low=value)


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A statement with its number on the model and, where it can be carried out, on the simulated arm."""

    row: int
    """Which of the subjects it belongs to."""
    claim: str
    """Worded so that it is exact, or says what it holds approximately."""
    figure: str = "-"
    """Of the paper."""
    paper: str = "-"
    """What the paper says or measured."""
    unit: str = ""
    """Of the numbers."""
    model: float | None
    """On the model; None where there is nothing to compute without an arm."""
    promise: Promise | None = None
    """What the model's number must be."""
    arm: float | None = None
    """On the simulated arm; None where it is a statement about the mathematics alone."""
    arm_promise: Promise | None = None
    """What the arm's number must be."""
    deviation: float | None = None
    """Greatest distance of the simulated hand from the plan, [mm]."""

    @property
    def holds(self) -> bool:
        """Whether every number is as promised; a number without a promise, or the reverse, is an error."""
        pairs = ((self.model, self.promise), (self.arm, self.arm_promise))
        if all(value is None for value, _ in pairs):
            raise ValueError(f"claim without a number: {self.claim}")
        if any((value is None) != (promise is None) for value, promise in pairs):
            raise ValueError(f"a number and its promise belong together: {self.claim}")
        return all(promise.kept(value) for value, promise in pairs if promise and value is not None)

    @property
    def verdict(self) -> str:
        """In a word."""
        return "holds" if self.holds else "FAILS"

    def as_json(self) -> dict[str, Any]:
        """Plain values; open ends of a promise are null."""
        record: dict[str, Any] = {
            name: getattr(self, name) for name in ("row", "claim", "figure", "paper", "unit")
        }
        for name, value, promise in (
            ("model", self.model, self.promise),
            ("arm", self.arm, self.arm_promise),
        ):
            record[name] = None if value is None else float(value)
            record[f"{name}_promised"] = None if promise is None else _ends(promise)
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
    11: "The primer and its online version",
    12: "Obstacle avoidance",
    13: "A target that jumps on the way (Flash & Henis 1991)",
}
"""Twelve rows of Flash & Hogan 1985, and one of what followed from it."""


def _ends(promise: Promise) -> list[float | None]:
    return [end if np.isfinite(end) else None for end in (promise.low, promise.high)]


class Reproduction(NamedTuple):
    """All claims, and the pictures (PNG) with their captions."""

    claims: list[Claim]
    pictures: list[tuple[Path, str]]

    @property
    def failed(self) -> list[Claim]:
        """Those that do not hold."""
        return [claim for claim in self.claims if not claim.holds]
