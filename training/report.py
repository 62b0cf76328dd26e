"""Output of commands: tables of evaluations, and progress bars, which are shown on terminals alone."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm.auto import tqdm  # a bar of its own kind in a notebook

from viapoint.training.configs import Format
from viapoint.training.files import MARK, write_bytes, write_json
from viapoint.training.scene_sets import BANDS

Record = Mapping[str, Any]  # Result of `EvaluationResult.to_dict`, or the content of its file

# Metric, scale and number of digits of the columns of numbers, by heading
NUMBERS = {
    "clearance [mm]": ("min_clearance", 1e3, 1),
    "goal error [mm, mrad]": ("goal_error", 1e3, 2),
    "jerk ratio": ("jerk_ratio", 1.0, 2),
    "duration [s]": ("duration", 1.0, 2),
    "decision [ms]": ("decision_time", 1e3, 2),
    "98 % of them [ms]": ("decision_time_98", 1e3, 2),
}
NOTES = (
    "Success: arrived at rest within 1 cm, or in joint space 0.02 rad of every joint, no contact at any "
    "physics step, joint limits kept; with its 95 % Wilson interval. Share: success among scenes of that "
    "solution share, the fraction of random actions whose plan is clear; in hard sets also among scenes of "
    "each family. Clearance and goal error are medians of all scenes, jerk ratio (to the straight movement) "
    "and duration of the successes. Decision: median wall time of single decisions, and their 98th "
    "percentile; where that is missing, the mean in a batch."
)
HEADINGS, COLUMN = 18, 14  # Widths in a terminal, [characters]


def table(record: Record) -> pd.DataFrame:
    """Return the cells of each method, without columns in which no method has a value."""
    lines = {}
    for name, summary in record["methods"].items():
        label = f"{name} (partial: {summary['scenes']} scenes)" if summary["partial"] else name
        lines[label] = _cells(summary)
    frame = pd.DataFrame.from_dict(lines, orient="index").fillna("-").rename_axis("method")
    return frame.loc[:, (frame != "-").any()]


def _cells(summary: Record) -> dict[str, str]:
    """Return the cells of one method by heading."""
    success = summary["success"]
    cells = {"success": _percent(success), "95 % interval": "-"}
    if success["rate"] is not None:
        ends = [f"{100.0 * success[end]:.1f}".replace("100.0", "100") for end in ("low", "high")]
        cells["95 % interval"] = "-".join(ends)
    for band in BANDS:
        cells[f"share {band}"] = _percent(summary["success_by_band"].get(band))
    for family, rate in summary["success_by_family"].items():
        cells[family] = _percent(rate)
    cells["collision"] = _percent(summary["collision"])
    for heading, (name, scale, digits) in NUMBERS.items():
        value = summary[name]
        cells[heading] = "-" if value is None else f"{scale * value:.{digits}f}"
    return cells


def _percent(rate: Record | None) -> str:
    return "-" if rate is None or rate["rate"] is None else f"{100.0 * rate['rate']:.1f} %"


def title(record: Record) -> str:
    """Return environment, scene set and hash in one line."""
    number = max(summary["scenes"] for summary in record["methods"].values())
    return f"{record['env']}, scenes {record['scenes']} ({number}, sha256 {record['sha256'][:12]})"


def markdown(record: Record) -> str:
    """Return the table as a Markdown document."""
    cells = table(record)
    align = ["left", *["right"] * cells.shape[1]]
    return f"# {title(record)}\n\n{cells.to_markdown(colalign=align, disable_numparse=True)}\n\n{NOTES}\n"


def text(record: Record) -> str:
    """Return the table with one column for each method, in several parts if it is wider than the terminal."""
    cells = table(record).T
    fitting = max((shutil.get_terminal_size().columns - HEADINGS) // COLUMN, 1)
    parts = [title(record)]
    for first in range(0, cells.shape[1], fitting):
        part = cells.iloc[:, first : first + fitting]
        names = [name.replace(", ", ",\n").replace(" (", "\n(") for name in part]
        align = ["left", *["right"] * len(names)]
        settings: Any = {"tablefmt": "simple", "colalign": align, "disable_numparse": True}
        parts.append(part.to_markdown(headers=["", *names], **settings))
    return "\n\n".join(parts)


def formatted(record: Record, form: Format) -> str:
    """Return the metrics of an evaluation in a format: a table for terminals, Markdown, CSV or JSON."""
    if form == "csv":
        rows = [{"method": name, **summary} for name, summary in record["methods"].items()]
        return str(pd.json_normalize(rows, sep=" ").to_csv(index=False)).rstrip()
    if form == "json":
        return json.dumps({name: value for name, value in record.items() if name != "outcomes"}, indent=1)
    return markdown(record).rstrip() if form == "md" else text(record)


def write(record: Record, folder: Path) -> None:
    """Write the table as Markdown, and with the outcomes of every scene as JSON."""
    write_bytes(folder / "table.md", f"{markdown(record)}\n<!-- {MARK.decode()} -->\n".encode())
    write_json(folder / "table.json", dict(record))


def progress_bar(**settings: Any) -> Any:
    """Return a bar of tqdm on the standard error output, which shows nothing if that is no terminal."""
    return tqdm(**{"disable": None, "file": sys.stderr, "dynamic_ncols": True, **settings})


@contextmanager
def scene_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar over the scenes of each method; the context is a function of name, finished and all scenes."""
    with progress_bar(unit=" scenes", delay=0.01) as bar:
        shown = ""

        def progress(name: str, done: int, total: int) -> None:
            nonlocal shown
            if name != shown:
                shown = name
                bar.reset(total)
                bar.set_description(name)
                bar.delay = 0.0  # it is shown now, and ends its line even if one report is all
            bar.update(done - bar.n)

        yield progress
