"""Progress of evaluations, and their tables for terminals, documents and programs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tqdm.auto import tqdm

from viapoint.training.io.files import MARK, write_bytes, write_json
from viapoint.training.scene_sets.scene_set import BANDS

Summary = Mapping[str, Any]
Record = Mapping[str, Any]
"""Result of :meth:`viapoint.training.evaluation.evaluator.EvaluationResult.to_dict`, or the content of its file."""


class Column(NamedTuple):
    """Column of the table."""

    heading: str
    cell: Callable[[Summary], str]


def _percent(rate: Summary | None) -> str:
    return "-" if rate is None or rate["rate"] is None else f"{100.0 * rate['rate']:.1f} %"


def _interval(rate: Summary) -> str:
    ends = (f"{100.0 * rate[end]:.1f}".replace("100.0", "100") for end in ("low", "high"))
    return "-" if rate["rate"] is None else "-".join(ends)


def _number(name: str, scale: float, digits: int) -> Callable[[Summary], str]:
    def cell(summary: Summary) -> str:
        value = summary[name]
        return "-" if value is None else f"{scale * value:.{digits}f}"

    return cell


def _within(part: str, name: str) -> Callable[[Summary], str]:
    return lambda summary: _percent(summary.get(part, {}).get(name))


COLUMNS = (
    Column("success", lambda summary: _percent(summary["success"])),
    Column("95 % interval", lambda summary: _interval(summary["success"])),
    *(Column(f"share {band}", _within("success_by_band", band)) for band in BANDS),
    Column("collision", lambda summary: _percent(summary["collision"])),
    Column("clearance [mm]", _number("min_clearance", 1e3, 1)),
    Column("goal error [mm]", _number("goal_error", 1e3, 2)),
    Column("jerk ratio", _number("jerk_ratio", 1.0, 2)),
    Column("SPL", _number("spl", 1.0, 3)),
    Column("duration [s]", _number("duration", 1.0, 2)),
    Column("decision [ms]", _number("decision_time", 1e3, 2)),
    Column("98 % of them [ms]", _number("decision_time_98", 1e3, 2)),
)

NOTES = (
    "Success: arrived at rest within 1 cm, no contact at any physics step, joint limits kept; with its 95 % "
    "Wilson interval. Share: success among scenes of that solution share, the fraction of random actions "
    "that solve a scene; in hard sets also among scenes of each family. Clearance and goal error are medians "
    "of all scenes, jerk ratio (to the straight movement) and duration of the successes. SPL: success weighted "
    "by straight distance over path length. Decision: median wall time of single decisions, and their 98th "
    "percentile; where that is missing, the mean in a batch."
)


HEADINGS, COLUMN = 21, 11
"""Width of the column of headings, and least width of a method's column, [characters]."""


def rows(record: Record) -> list[list[str]]:
    """Return headings and the cells of each method, without columns in which no method has a value."""
    columns = _columns(record)
    heads = ["method", *(column.heading for column in columns)]
    table = [
        [
            f"{name} (partial: {summary['scenes']} scenes)" if summary["partial"] else name,
            *(column.cell(summary) for column in columns),
        ]
        for name, summary in record["methods"].items()
    ]
    shown = [i for i in range(len(heads)) if any(line[i] != "-" for line in table)]
    return [[line[i] for i in shown] for line in (heads, *table)]


def _columns(record: Record) -> list[Column]:
    """Return the columns of every table and, after the bands, one for each scene family."""
    summaries = record["methods"].values()
    names = dict.fromkeys(name for summary in summaries for name in summary.get("success_by_family", {}))
    behind = 2 + len(BANDS)
    families = (Column(name, _within("success_by_family", name)) for name in names)
    return [*COLUMNS[:behind], *families, *COLUMNS[behind:]]


def title(record: Record) -> str:
    """Return environment, scene set and hash in one line."""
    number = max(summary["scenes"] for summary in record["methods"].values())
    return f"{record['env']}, scenes {record['scenes']} ({number}, sha256 {record['sha256'][:12]})"


def markdown(record: Record) -> str:
    """Return the table as a Markdown document."""
    head, *body = rows(record)
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *body]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"# {title(record)}\n\n{table}\n\n{NOTES}\n"


def show(record: Record, console: Console | None = None) -> None:
    """Print the table with one column for each method, split into several tables if it is too wide."""
    console = console or Console()
    heads, *body = rows(record)
    fitting = max((console.width - HEADINGS) // COLUMN, 1)
    for first in range(0, len(body), fitting):
        lines = [heads, *body[first : first + fitting]]
        table = Table(title=title(record) if not first else None, title_justify="left")
        for i, line in enumerate(lines):
            table.add_column(
                escape(line[0]) if i else "", justify="right" if i else "left", no_wrap=not i, overflow="fold"
            )
        for i in range(1, len(heads)):
            table.add_row(*(escape(line[i]) for line in lines))
        console.print(table)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar over the scenes of each method."""
    with tqdm(unit=" scenes", file=sys.stderr, dynamic_ncols=True) as bar:

        def progress(name: str, done: int, total: int) -> None:
            if bar.desc != f"{name}: ":
                bar.reset(total)
                bar.set_description(name)
            bar.update(done - bar.n)

        yield progress


def write(record: Record, folder: Path) -> tuple[Path, Path]:
    """Write the table as Markdown, and with the outcomes of every scene as JSON."""
    document, data = folder / "table.md", folder / "table.json"
    write_bytes(document, f"{markdown(record)}\n<!-- {MARK.decode()} -->\n".encode())
    write_json(data, dict(record))
    return document, data
