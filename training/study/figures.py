"""Figures of a study: learning curves, success by band, and failures against the number of checks."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from viapoint.training.evaluation.statistics import interquartile_mean
from viapoint.training.io.files import write_bytes
from viapoint.training.plotting.plots import AXES, style_axes
from viapoint.training.study.page import chosen, figure_name, has_figure, short, shown_bands

Numbers = Mapping[str, Any]
DOTS_PER_INCH, SHADES = 100, 96
AGENT_COLOURS = [colormaps["tab10"](i) for i in (0, 1, 2, 3, 4, 5, 6, 8, 9)]  # grey is that of baselines
BASELINE_COLOURS = ("0.15", "0.35", "0.5", "0.65")
MARKERS = "o^sDv<>P"
LEAST_FAILURE = 0.05
"""Failures that stand for none on a logarithmic axis, [%]."""


def draw_figures(record: Numbers, folder: Path, shown: Sequence[str] = ()) -> list[Path]:
    """Draw the figures of all environments that have rows, and return the paths."""
    paths = []
    for name, numbers in record["environments"].items():
        if has_figure(numbers):
            folder.mkdir(parents=True, exist_ok=True)
            paths.append(_environment(name, numbers, folder / figure_name(name), shown))
    counted = [name for name, numbers in record["environments"].items() if len(_series(numbers)) > 1]
    if counted:
        paths.append(
            _checks({name: record["environments"][name] for name in counted}, folder / "agent_checks.png")
        )
    return paths


def _environment(name: str, numbers: Numbers, path: Path, shown: Sequence[str]) -> Path:
    """Draw learning curves above, and success by band on each set below."""
    rows = chosen(numbers, shown or [each["row"] for each in numbers["rows"] if each["kind"] == "agent"])
    sets = [
        each
        for each in numbers["sets"]
        if numbers["sets"][each]["bands"] and any(each in r["sets"] for r in rows)
    ]
    figure = Figure(figsize=(9.6, 3.2 * (2 if sets else 1)), layout="constrained")
    parts: Any = figure.subfigures(2, 1, hspace=0.04) if sets else (figure, None)
    above, below = parts
    colours = _colours(rows)
    _learning(above.subplots(1, len(AXES), sharey=True), rows, colours, legend=below is None)
    above.suptitle(f"{short(name)}: learning", fontsize=10)
    if below is not None:
        for ax, each in zip(below.subplots(1, len(sets), squeeze=False, sharey=True)[0], sets, strict=True):
            _abilities(ax, rows, each, numbers, colours)
        handles, labels = below.axes[0].get_legend_handles_labels()
        below.legend(handles, labels, frameon=False, fontsize=7.5, ncols=4, loc="outside lower center")
    _save(figure, path)
    return path


def _colours(rows: Sequence[Numbers]) -> dict[str, Any]:
    """Return the colour of each agent and baseline among rows."""
    agents = dict.fromkeys(each["name"] for each in rows if each["kind"] == "agent")
    others = dict.fromkeys(each["name"] for each in rows if each["kind"] == "baseline")
    greys = {name: BASELINE_COLOURS[i % len(BASELINE_COLOURS)] for i, name in enumerate(others)}
    return {name: AGENT_COLOURS[i % len(AGENT_COLOURS)] for i, name in enumerate(agents)} | greys


def _learning(axes: Any, rows: Sequence[Numbers], colours: Mapping[str, Any], *, legend: bool) -> None:
    """Draw success on validation scenes against three clocks: interquartile mean and range of the seeds."""
    curves = {each["name"]: (each["label"], each["curve"]) for each in rows if each.get("curve")}
    for ax, (key, label, scale) in zip(axes, AXES, strict=True):
        for name, (words, curve) in curves.items():
            if len(curve["success"]) < 2:
                continue
            x = scale * np.array([curve[key][1] / 2.0, *curve[key][1:]])  # a log axis has no place for zero
            rates = 100.0 * np.array(curve["success"])
            middle = [interquartile_mean(each) for each in rates]
            style: Any = {"color": colours[name]}
            ax.plot(x[1:], middle[1:], linewidth=1.6, label=words, **style)
            ax.plot(x[:2], middle[:2], linewidth=1.0, linestyle=":", **style)
            ax.plot(x[:1], middle[:1], marker="o", markersize=4, fillstyle="none", **style)
            ax.fill_between(
                x, rates.min(axis=1), rates.max(axis=1), color=colours[name], alpha=0.18, linewidth=0.0
            )
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        ax.xaxis.set_major_formatter(FuncFormatter(_short_number))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(label, fontsize=8)
        _tidy(ax)
    axes[0].set_ylabel("success without checks,\nvalidation scenes [%]", fontsize=8)
    if legend and axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(frameon=False, fontsize=7.5, loc="best")


def _abilities(
    ax: Axes, rows: Sequence[Numbers], name: str, numbers: Numbers, colours: Mapping[str, Any]
) -> None:
    """Draw success by band with intervals, on one set."""
    bands = shown_bands(numbers["sets"][name])
    here = [each for each in rows if name in each["sets"] and each["sets"][name]["by_band"]]
    seen: dict[str, int] = {}
    for i, each in enumerate(here):
        group = each["name"] if each["kind"] == "agent" else "baselines"
        marker = MARKERS[seen.get(group, 0) % len(MARKERS)]
        seen[group] = seen.get(group, 0) + 1
        x = np.arange(len(bands)) + 0.8 * ((i + 0.5) / len(here) - 0.5)
        rate, low, high = 100.0 * np.array([each["sets"][name]["by_band"][band] for band in bands]).T
        error = np.maximum([rate - low, high - rate], 0.0)
        ax.errorbar(
            x, rate, yerr=error, color=colours[each["name"]], fmt=marker, markersize=4.5, elinewidth=1.0,
            label=each["label"],
        )  # fmt: skip
    ax.set_xticks(range(len(bands)), bands)
    ax.set_title(f"{name} scenes, by solution share (easy to hard)", fontsize=8.5)
    ax.set_ylabel("success [%]" if ax.get_subplotspec().is_first_col() else "", fontsize=8)  # type: ignore[union-attr]
    _tidy(ax)


def _series(numbers: Numbers) -> dict[str, list[Numbers]]:
    """Return the rows with different numbers of checks, by agent or kind of search."""
    found: dict[str, list[Numbers]] = {}
    for each in numbers["rows"]:
        made, kind = each["made"], each["kind"]
        changed = (
            made["training"] if kind == "agent" else made["env_kwargs"] or made["time_of"] or made["n_scenes"]
        )
        if each["checks"] is None or changed or each.get("untrained") or each.get("unrevised"):
            continue
        name = each["name"] if each["kind"] == "agent" else each["method"]
        found.setdefault(name, []).append(each)
    found = {
        name: sorted(rows, key=lambda each: each["checks"]) for name, rows in found.items() if len(rows) > 2
    }
    first = next(iter(numbers["sets"]), "")
    failing = [each for rows in found.values() for each in rows if first in each["sets"]]
    return found if any(np.mean(each["sets"][first]["each"]) < 1.0 for each in failing) else {}


def _checks(environments: Mapping[str, Numbers], path: Path) -> Path:
    """Draw failures and jerk against the number of checks, and failures against the time of a decision."""
    figure = Figure(figsize=(3.4 * len(environments), 8.0), layout="constrained")
    axes = figure.subplots(3, len(environments), squeeze=False, sharey="row")
    for column, (name, numbers) in enumerate(environments.items()):
        for i, (series, rows) in enumerate(_series(numbers).items()):
            first = next(iter(numbers["sets"]))
            here = [each for each in rows if first in each["sets"]]
            checks = [max(each["checks"], 0.5) for each in here]
            rates = [each["sets"][first]["success"][0] for each in here]
            failures = [max(100.0 * (1.0 - rate), LEAST_FAILURE) for rate in rates]
            jerk = [each["sets"][first].get("jerk_ratio") or np.nan for each in here]
            times = [1e3 * (each["decision_time"] or np.nan) for each in here]
            label = series.replace("_", " ").replace("sobol", "Sobol order")
            style: Any = {"label": label, "color": AGENT_COLOURS[i], "marker": MARKERS[i], "markersize": 4}
            axes[0, column].plot(checks, failures, **style)
            axes[1, column].plot(checks, jerk, **style)
            axes[2, column].plot(times, failures, **style)
        axes[0, column].set_title(short(name), fontsize=10)
        _style_checks(axes[:, column])
    for ax, words in zip(axes[:, 0], ("failures [%]", "jerk ratio", "failures [%]"), strict=True):
        ax.set_ylabel(words, fontsize=8)
    axes[0, 0].legend(fontsize=8, frameon=False)
    _save(figure, path)
    return path


def _style_checks(axes: Any) -> None:
    """Set scales, ticks and labels of the figure's column."""
    for ax, words in zip(axes, (*["checks per decision"] * 2, "time of a decision [ms]"), strict=True):
        ax.set_xscale("log")
        ax.set_xlabel(words, fontsize=8)
        ax.tick_params(labelsize=7.5)
        style_axes(ax)
    for ax in axes[:2]:
        ax.set_xticks([0.5, 4, 16, 64, 512, 4096], ["0", "4", "16", "64", "512", "4096"])
        ax.minorticks_off()
    for ax in (axes[0], axes[2]):
        ax.set_yscale("log")
        ax.set_yticks([LEAST_FAILURE, 0.1, 1, 10, 100], ["0", "0.1", "1", "10", "100"])
        ax.minorticks_off()
    axes[2].xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes[2].xaxis.set_major_formatter(FuncFormatter(_short_number))
    axes[2].xaxis.set_minor_formatter(NullFormatter())


def _short_number(value: float, _: Any) -> str:
    """Format a tick: 0.03, 300, 10k, 3M."""
    for unit, suffix in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{suffix}"
    return f"{value:g}"


def _tidy(ax: Axes) -> None:
    ax.set_ylim(-3.0, 103.0)
    ax.tick_params(labelsize=7.5)
    style_axes(ax)


def _save(figure: Figure, path: Path) -> None:
    """Save a figure as a small PNG; SHADES colours are enough."""
    drawn, packed = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, dpi=DOTS_PER_INCH, metadata={"Software": None})
    picture = Image.open(drawn).convert("RGB").quantize(SHADES, dither=Image.Dither.NONE)
    picture.save(packed, "PNG", optimize=True)
    write_bytes(path, packed.getvalue())
