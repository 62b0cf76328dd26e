"""Pages of a study: Jinja2 templates that take every number from the record.

Templates see the record as `record`, and the functions and filters of :data:`FUNCTIONS` and :data:`FILTERS`. A page of
another origin may hold tables of the study: what stands between `<!-- table:NAME -->` and `<!-- end -->` is what the
macro NAME of the template of tables returns.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from viapoint.training.io.files import BadFileError, write_bytes
from viapoint.training.io.template import load_template, packaged
from viapoint.training.scene_sets.scene_set import BANDS
from viapoint.training.study.config import Page

Numbers = Mapping[str, Any]
Cells = Sequence[Sequence[str]]
EMPTY = ("-", "0.0 %")
"""Cells of columns that a table leaves out if they hold nothing else."""
FEWEST = 10
"""Least number of scenes of a band that is shown, if another band has as many."""
TABLE = re.compile(r"(<!-- table:([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def write_pages(record: Numbers, page: Page) -> list[Path]:
    """Write the page of a record and the tables of other pages, and return the paths.

    Raises:
        ValueError: A template has an error, or a page has a table without a macro.
    """
    written = {page.file: render_page(record, page)}
    written |= {path: fill_tables(record, page, path.read_text(encoding="utf-8"), path) for path in page.into}
    for path, text in written.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, text.encode())
    return list(written)


def render_page(record: Numbers, page: Page) -> str:
    """Return the page of a record as Markdown."""
    default = packaged("study/templates/page.md.j2")
    template = _template(record, page.template or default)
    figures = Path(os.path.relpath(page.figures, page.file.parent))
    try:
        text = template.render(figures=figures.as_posix())
    except jinja2.TemplateError as error:
        raise BadFileError(page.template or default, f"cannot be filled in ({error})") from error
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def fill_tables(record: Numbers, page: Page, text: str, path: Path) -> str:
    """Return the text of a page with the tables of the record between their markers.

    Raises:
        ValueError: There is no macro for a table.
    """
    if page.tables is None:
        return text
    module = _template(record, page.tables).module

    def filled(found: re.Match[str]) -> str:
        macro = getattr(module, found[2].replace("-", "_"), None)
        if macro is None:
            raise BadFileError(path, f"has a table {found[2]}, and {page.tables} has no macro of this name")
        return f"{found[1]}\n{str(macro()).strip()}\n\n{found[3]}"

    return TABLE.sub(filled, text)


def _template(record: Numbers, path: Path) -> jinja2.Template:
    """Return a template of a file, which sees the record."""
    return load_template(path, filters=FILTERS, **FUNCTIONS, record=record)


def figure_name(environment: str) -> str:
    """Return the file name of an environment's figure."""
    words = re.findall("[A-Z]?[a-z0-9]+", environment.rpartition("/")[2].removesuffix("-v0"))
    return "_".join(["results", *words]).lower() + ".png"


def has_figure(numbers: Numbers) -> bool:
    """Return whether success by band of an agent, or learning curves, are not 1 throughout."""
    agents = [each for each in numbers["rows"] if each["kind"] == "agent"]
    found = [rate for each in agents for a_set in each["sets"].values() for rate in a_set["by_band"].values()]
    bands = any(rate < 1.0 for rate, *_ in found)
    curves = [each["curve"]["success"] for each in agents if each.get("curve")]
    return bands or any(rate < 1.0 for curve in curves for point in curve for rate in point)


def caption(numbers: Numbers) -> str:
    """Return the caption of an environment's figure: axes and number of scenes."""
    clocks = "decisions, simulated time and time of training without validation"
    above = f"success without checks in validation scenes against {clocks}"
    sets = [f"{about['scenes']:,} `{name}`" for name, about in numbers["sets"].items() if about["bands"]]
    if not sets:
        return f"*{above.capitalize()}. The table has the number of seeds.*"
    below = f"success by solution share in {' and '.join(sets)} scenes, with 95 % intervals"
    if any(set(about["bands"]) - set(shown_bands(about)) for about in numbers["sets"].values()):
        below += f", without bands of fewer than {FEWEST} scenes"
    return f"*Above: {above}. Below: {below}. The tables have the numbers of seeds.*"


def shown_bands(about: Numbers) -> list[str]:
    """Return the bands of a set that have enough scenes to be shown, from easy to hard."""
    count = about["bands"]
    enough = min(FEWEST, max(count.values(), default=0))
    return [band for band in BANDS if band in count and count[band] >= enough]


def short(environment: str) -> str:
    """Return the name of an environment without namespace and version."""
    return environment.rpartition("/")[2].removesuffix("-v0")


def row(numbers: Numbers, name: str) -> Numbers | None:
    """Return the row of an id in an environment, or None."""
    return next((each for each in numbers["rows"] if each["row"] == name), None)


def chosen(numbers: Numbers, ids: Sequence[str] | None = None) -> list[Numbers]:
    """Return the rows of some ids that there are, or all rows."""
    if ids is None:
        return list(numbers["rows"])
    return [found for name in ids if (found := row(numbers, name)) is not None]


def summary(
    numbers: Numbers, name: str, ids: Sequence[str] | None = None, labels: Mapping[str, str] | None = None
) -> list[list[str]]:
    """Return a table of the rows on a set: success by band, jerk, time, decision time and training."""
    bands = shown_bands(numbers["sets"][name])
    bands = bands if len(bands) > 1 else []  # one band is the whole set
    head = ["method", "seeds", "success (95 %)", *bands, "collision", "jerk ratio", "jerk ratio / planner"]
    head += ["movement", "decision", "training"]
    lines = [head]
    for each in chosen(numbers, ids):
        if name not in each["sets"]:
            continue
        found = each["sets"][name]
        lines.append(
            [
                (labels or {}).get(each["row"], each["label"]),
                seeds(each),
                interval(found["success"]),
                *(percent(found["by_band"][band][0]) if band in found["by_band"] else "-" for band in bands),
                percent(found["collision"]) if found.get("collision") is not None else "-",
                multiple(found.get("jerk_ratio")),
                multiple((found.get("jerk") or [None])[0]),
                "-" if found.get("time") is None else f"{found['time']:.2f} s",
                milliseconds(each["decision_time"]),
                effort(each),
            ]
        )
    return lines if len(lines) > 1 else []


def by_family(numbers: Numbers, name: str, ids: Sequence[str] | None = None) -> list[list[str]]:
    """Return a table of success by family of scenes; empty where a set has no families."""
    families = numbers["sets"][name]["families"]
    if not families:
        return []
    lines = [["method", *(f"{family} ({count})" for family, count in families.items())]]
    for each in chosen(numbers, ids):
        found = each["sets"].get(name, {}).get("by_family", {})
        if found:
            lines.append([each["label"], *(interval(found[family]) for family in families)])
    return lines if len(lines) > 1 else []


def table(cells: Cells, *, align: str = "---:") -> str:
    """Return a Markdown table without columns that hold nothing but zeros or no value."""
    if not cells:
        return ""
    head, *lines = cells
    kept = [i for i in range(len(head)) if i == 0 or any(line[i] not in EMPTY for line in lines)]
    shown = [[line[i] for i in kept] for line in cells]
    shown.insert(1, ["---", *[align] * (len(kept) - 1)])
    return "\n".join("| " + " | ".join(line) + " |" for line in shown)


def seeds(each: Numbers) -> str:
    """Return the number of seeds of a row, and of those that the study asks for if some are missing."""
    if each["kind"] == "baseline":
        return "-"
    have, wanted = len(each.get("seeds", [])), len(each["seeds_wanted"])
    return f"{have}" if have >= wanted else f"{have} of {wanted}"


def effort(each: Numbers) -> str:
    """Return the decisions of a row's trainings in words, the least and the greatest number, and why they ended.

    Only trainings that end when success stalls may be cut short; all others have the number that they were given.
    """
    training = each.get("training")
    if not training or each.get("untrained"):
        return "-"
    runs = [run["training"] for run in each.get("runs", [])] or [training]
    numbers = sorted({run["decisions"] for run in runs})
    words = "-".join(f"{number:,}" for number in dict.fromkeys((numbers[0], numbers[-1])))
    if each["made"]["training"].get("stop_when_stalled") is None:
        return words
    cut = sum("budget" in run["stopped"] for run in runs)
    return words + {0: ", until it stalled", len(runs): ", cut short"}.get(
        cut, f", {cut} of {len(runs)} cut short"
    )


def percent(rate: float | None) -> str:
    """Return a rate in percent."""
    return "-" if rate is None else f"{100.0 * rate:.1f} %"


def interval(values: Sequence[float]) -> str:
    """Return an estimate in percent with its interval."""
    estimate, low, high = (100.0 * value for value in values)
    return f"{estimate:.1f} % ({low:.1f}-{high:.1f})"


def spread(measured: Numbers) -> str:
    """Return the success in a set in percent, with the least and the greatest of its seeds."""
    each, estimate = measured["each"], percent(measured["success"][0])
    return estimate if len(each) == 1 else f"{estimate} ({100.0 * min(each):.1f}-{100.0 * max(each):.1f})"


def multiple(value: float | None) -> str:
    """Return a ratio."""
    return "-" if value is None else f"{value:,.0f}" if value >= 100.0 else f"{value:.2f}"


def milliseconds(seconds: float | None) -> str:
    """Return a time in milliseconds."""
    if seconds is None:
        return "-"
    value = 1e3 * seconds
    return f"{value:.0f} ms" if value >= 20.0 else f"{value:.1f} ms" if value >= 1.0 else f"{value:.2f} ms"


FILTERS = {
    "percent": percent,
    "interval": interval,
    "spread": spread,
    "multiple": multiple,
    "milliseconds": milliseconds,
    "short": short,
    "seeds": seeds,
    "effort": effort,
}
"""Filters of templates by name."""
FUNCTIONS: dict[str, Any] = {
    "row": row,
    "chosen": chosen,
    "summary": summary,
    "by_family": by_family,
    "table": table,
    "figure_name": figure_name,
    "caption": caption,
    "has_figure": has_figure,
    "BANDS": BANDS,
}
"""Functions and constants of templates by name."""
