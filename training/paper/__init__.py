"""Claims of the paper with their computed numbers and expected ranges.

The table `claims.csv` holds what is known before anything is computed: row, text, figure, statement of the paper, and
ranges of the numbers on the model and on the simulated arm.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from fractions import Fraction
from importlib.resources import files
from typing import Any, TypeAlias

import numpy as np

Range: TypeAlias = tuple[float, float]  # Least and greatest value that a number may have
Number: TypeAlias = tuple[Any, Range]  # Computed number and its expected range


TABLE = {}  # Lines of the table by their keys
for _line in csv.DictReader((files(__package__) / "claims.csv").read_text(encoding="utf-8").splitlines()):
    TABLE[_line["key"]] = _line


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
        for number in (self.model, self.arm):
            if number is not None:
                value, (low, high) = number
                if not low <= value <= high:
                    return False
        return True

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


def claim(
    key: str, model: Any = None, arm: Any = None, deviation: Any = None, *, expected: Any = None, **words: Any
) -> Claim:
    """Return a claim of the table with its numbers.

    Args:
        key: Key of its line.
        model: Number on the model.
        arm: Number on the simulated arm.
        deviation: Greatest distance of the simulated hand from the plan, [mm].
        expected: Centre of the range of the model's number, where the table has a tolerance alone.
        **words: Values of the placeholders in its text.
    """
    line = TABLE[key]
    return Claim(
        row=int(line["row"]),
        claim=line["claim"].format(**words),
        figure=line["figure"],
        paper=line["paper"],
        model=None if model is None else (model, _range(line["model"], expected)),
        arm=None if arm is None else (arm, _range(line["arm"], model)),
        deviation=deviation,
        unit=line["unit"],
    )


def _range(cell: str, centre: float) -> Range:
    """Return a range that is written as `<= 1`, `>= 1`, `1 ± 0.1`, or `± 0.1` around a centre."""
    if cell.startswith("<="):
        return -np.inf, float(cell[2:])
    if cell.startswith(">="):
        return float(cell[2:]), np.inf
    middle, _, tolerance = cell.partition("±")
    if middle:
        centre = float(Fraction(middle))
    return centre - float(tolerance), centre + float(tolerance)
