"""Tables and figures of a study, from the records of its trials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from viapoint.training.evaluation.statistics import across_seeds, wilson
from viapoint.training.io.files import write_bytes
from viapoint.training.plotting.plots import success_of_rows
from viapoint.training.study.config import Study, Trial
from viapoint.training.study.trials import finished_record

KEYS = ["environment", "set", "method"]
MEDIANS = ["collision", "jerk_ratio", "movement_s", "decision_ms", "decisions"]
"""Columns that are medians over seeds; `decisions` are those of a training."""
NOTE = (
    "Success with 95 % intervals. Jerk of successes, relative to the straight movement's. Median time of a decision on "
    "the cores of one trial. Written by `viapoint study`."
)
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
        if len(runs) == 1:
            success, low, high = wilson(int(solved.sum()), solved.size)
        else:
            success, low, high = across_seeds(solved, band, np.random.default_rng(0))
        row = dict(zip(KEYS, keys, strict=True))
        row |= {"seeds": len(runs), "scenes": solved.shape[1], "success": success, "low": low, "high": high}
        rows.append({**row, **runs[MEDIANS].astype(float).median()})
    return pd.DataFrame(rows, columns=COLUMNS).round(4)


def markdown(table: pd.DataFrame, title: str) -> str:
    """Return a page with one table for each environment: sets of scenes side by side, success in percent."""
    parts = [f"# {title}", NOTE]
    for environment, lines in table.groupby("environment", sort=False):
        rows = lines.drop_duplicates("method").set_index("method")
        shown = rows[["seeds"]].copy()
        for name, some in lines.groupby("set", sort=False):
            percent = (100.0 * some.set_index("method")[["success", "low", "high"]]).map("{:.1f}".format)
            shown[name] = percent["success"] + " % (" + percent["low"] + "-" + percent["high"] + ")"
        shown["jerk"] = rows["jerk_ratio"].map("{:.2f}".format, na_action="ignore")
        shown["decision ms"] = rows["decision_ms"].map("{:.1f}".format, na_action="ignore")
        text = shown.fillna("-").reset_index().to_markdown(index=False, disable_numparse=True)
        parts += [f"## {environment}", text]
    return "\n\n".join(parts) + "\n"


def write_results(table: pd.DataFrame, study: Study, folder: Path) -> None:
    """Write `results.csv`, `results.md` and a figure for each environment."""
    write_bytes(folder / "results.csv", table.to_csv(index=False).encode())
    write_bytes(folder / "results.md", markdown(table, study.name).encode())
    for environment in dict.fromkeys(table["environment"]):
        curves: dict[str, list[list[list[float]]]] = {}
        for trial in study.trials:
            record = finished_record(trial, folder) or {}
            if trial.env.name == environment and "curve" in record:
                curves.setdefault(trial.row, []).append(record["curve"])
        part = table[table["environment"] == environment]
        success_of_rows(folder / f"{environment.rpartition('/')[2]}.png", part, curves)
