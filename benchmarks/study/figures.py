"""Figure of each environment: learning curves and success by band."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from study.jobs import ALONE, CHECKED, UNTRAINED, WAYS
from study.page import figure_name
from study.plan import short
from viapoint.training.evaluation.statistics import interquartile_mean
from viapoint.training.io.files import write_bytes
from viapoint.training.plotting.plots import AXES, style_axes
from viapoint.training.scene_sets.scene_set import BANDS

Numbers = Mapping[str, Any]
COLOURS = {
    "viaq": "#1f5fa8",
    "sac": "#d1495b",
    "td3": "#8a6fb3",
    "ppo": "#d98e04",
    "tqc": "#3a8f6b",
    "sac-step": "#7a1f2b",
    "td3-step": "#4b3a66",
    "ppo-step": "#7a5002",
    "tqc-step": "#1d4a37",
}
SHOWN_BASELINES = {
    "random80": ("0.55", "D"),
    "constant": ("0.55", "s"),
    "search16": ("0.35", "v"),
    "search512": ("0.35", "<"),
    "stored": ("0.2", "_"),
}
DOTS_PER_INCH, SHADES = 100, 96


def draw(record: Numbers, folder: Path) -> list[Path]:
    """Draw the figure of every environment that has an agent, and return the paths."""
    return [
        _draw(env, numbers, folder / figure_name(env))
        for env, numbers in record["environments"].items()
        if numbers["methods"]
    ]


def _draw(env: str, numbers: Numbers, path: Path) -> Path:
    sets = [name for name in numbers["sets"] if any(name in entry["sets"] for entry in numbers["methods"])]
    figure = Figure(figsize=(9.6, 3.2 * (2 if sets else 1)), layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, 1, hspace=0.04) if sets else (figure, None)
    above, below = parts
    _learning(above.subplots(1, len(AXES), sharey=True), numbers["curves"])
    above.suptitle(f"{short(env)}: learning", fontsize=10)
    if below is not None:
        for ax, name in zip(below.subplots(1, len(sets), squeeze=False, sharey=True)[0], sets, strict=True):
            _abilities(ax, numbers, name)
        handles, labels = below.axes[0].get_legend_handles_labels()
        below.legend(handles, labels, frameon=False, fontsize=7.5, ncols=5, loc="outside lower center")
    _save(figure, path)
    return path


def _learning(axes: Any, curves: Numbers) -> None:
    """Draw success on validation scenes against three clocks: interquartile mean and range of the seeds."""
    for ax, (key, label, scale) in zip(axes, AXES, strict=True):
        for name, curve in curves.items():
            if len(curve["success"]) < 2:
                continue
            x = scale * np.array(curve[key][1:])  # the first point, at zero, has no place on a log axis
            rates = 100.0 * np.array(curve["success"][1:])
            colour = COLOURS[name]
            ax.plot(x, [interquartile_mean(each) for each in rates], color=colour, linewidth=1.6, label=name)
            ax.fill_between(x, rates.min(axis=1), rates.max(axis=1), color=colour, alpha=0.18, linewidth=0.0)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        ax.xaxis.set_major_formatter(FuncFormatter(_short_number))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(label, fontsize=8)
        _tidy(ax)
    axes[0].set_ylabel("success, policy alone,\nvalidation scenes [%]", fontsize=8)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(frameon=False, fontsize=7.5, loc="best")


def _abilities(ax: Axes, numbers: Numbers, name: str) -> None:
    """Draw success by band with intervals, on one set."""
    bands = [band for band in BANDS if numbers["sets"][name]["bands"][band]]
    rows = [
        (
            entry["label"] if way == ALONE else f"{entry['label']}, {WAYS[way]}",
            found,
            COLOURS[entry["name"]],
            way,
        )
        for entry in numbers["methods"]
        for way, found in entry["sets"].get(name, {}).items()
    ]
    rows += [
        (entry["label"], entry["sets"][name], *SHOWN_BASELINES[entry["name"]])
        for entry in numbers["baselines"]
        if entry["name"] in SHOWN_BASELINES and name in entry["sets"]
    ]
    for i, (label, found, colour, kind) in enumerate(rows):
        x = np.arange(len(bands)) + 0.8 * ((i + 0.5) / len(rows) - 0.5)
        rate, low, high = 100.0 * np.array([found["by_band"][band] for band in bands]).T
        error = np.maximum([rate - low, high - rate], 0.0)
        marker = {ALONE: "o", CHECKED: "^", UNTRAINED: "x"}.get(kind, kind)
        ax.errorbar(
            x, rate, yerr=error, color=colour, fmt=marker, markersize=4.5, elinewidth=1.0, label=label
        )
    ax.set_xticks(range(len(bands)), bands)
    ax.set_title(f"{name} scenes, by solution share (easy to hard)", fontsize=8.5)
    ax.set_ylabel("success [%]" if ax.get_subplotspec().is_first_col() else "", fontsize=8)  # type: ignore[union-attr]
    _tidy(ax)


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
