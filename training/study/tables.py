"""Tables and figures of a study, from the records of its trials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from viapoint.training.evaluation.statistics import across_seeds
from viapoint.training.io.files import write_bytes
from viapoint.training.plotting.plots import success_of_rows
from viapoint.training.study.config import Study, Trial
from viapoint.training.study.trials import finished_record

KEYS = ["environment", "set", "method"]
MEDIANS = ["collision", "jerk_ratio", "movement_s", "decision_ms", "decisions"]
"""Columns that are medians over seeds; `decisions` are those of a training."""
COLUMNS = [*KEYS, "seeds", "scenes", "success", "low", "high", *MEDIANS]
"""Columns of `results.csv`; success is a share with its 95 % interval."""


def tables(trials: Sequence[Trial], folder: Path) -> pd.DataFrame:
    """Return one line for each environment, set of scenes and row of the trials that are complete."""
    lines = []
    for trial in trials:
        record = finished_record(trial, folder) or {"rows": []}
        lines += [{"environment": trial.env.name, **line} for line in record["rows"]]
    rows = []
    for keys, runs in pd.DataFrame(lines, columns=[*COLUMNS, "solved", "band"]).groupby(KEYS, sort=False):
        solved = np.array([[bit == "1" for bit in each] for each in runs["solved"]], dtype=float)
        band = np.array(runs["band"].iloc[0])
        success, low, high = across_seeds(solved, band, np.random.default_rng(0))
        row = dict(zip(KEYS, keys, strict=True))
        row |= {"seeds": len(runs), "scenes": solved.shape[1], "success": success, "low": low, "high": high}
        rows.append({**row, **runs[MEDIANS].astype(float).median()})
    return pd.DataFrame(rows, columns=COLUMNS).round(4)


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table for people: success with its interval in percent, sets side by side."""
    shown = table[["environment", "method", "seeds"]].drop_duplicates(["environment", "method"]).copy()
    for name in dict.fromkeys(table["set"]):
        part = table[table["set"] == name].set_index(["environment", "method"])
        words = part.apply(
            lambda row: f"{100 * row.success:.1f} % ({100 * row.low:.1f}-{100 * row.high:.1f})", axis=1
        )
        shown[name] = [words.get((row.environment, row.method), "-") for row in shown.itertuples()]
    first = table.drop_duplicates(["environment", "method"]).set_index(["environment", "method"])
    for column, digits in (("jerk_ratio", 2), ("decision_ms", 1)):
        values = [first[column].get((row.environment, row.method)) for row in shown.itertuples()]
        shown[column.replace("_", " ")] = ["-" if pd.isna(each) else f"{each:.{digits}f}" for each in values]
    return shown


def markdown(table: pd.DataFrame, title: str) -> str:
    """Return a page with one table for each environment."""
    parts = [f"# {title}", "Success with 95 % intervals; jerk of successes relative to the straight movement's; median "
             "time of a decision on the cores of one trial. Written by `viapoint study`."]  # fmt: skip
    shown = readable(table)
    for environment in dict.fromkeys(shown["environment"]):
        part = shown[shown["environment"] == environment].drop(columns="environment")
        parts += [f"## {environment}", part.to_markdown(index=False, disable_numparse=True)]
    return "\n\n".join(parts) + "\n"


def write_results(table: pd.DataFrame, study: Study, folder: Path) -> None:
    """Write `results.csv`, `results.md` and a figure for each environment."""
    write_bytes(folder / "results.csv", table.to_csv(index=False).encode())
    write_bytes(folder / "results.md", markdown(table, study.name).encode())
    for environment in dict.fromkeys(table["environment"]):
        curves: dict[str, list[list[list[float]]]] = {}
        for trial in study.trials:
            if trial.env.name == environment and not trial.method:
                record = finished_record(trial, folder)
                if record is not None:
                    curves.setdefault(trial.row, []).append(record["curve"])
        part = table[table["environment"] == environment]
        success_of_rows(folder / f"{environment.rpartition('/')[2]}.png", part, curves)
