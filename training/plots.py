"""Figures of success in trainings and studies, and of fits to measured movements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from viapoint.envs.common.arrays import Float
from viapoint.envs.common.palette import PALETTE
from viapoint.primitives import ViaPointFit
from viapoint.training.files import write_figure

BLUE = "#1f5fa8"
AGENT = {"color": BLUE, "marker": "o"}
# Colour and marker of each method in all figures
METHOD_STYLES: dict[str, dict[str, Any]] = {
    "agent": AGENT,
    "viaq": AGENT,
    "viarank": AGENT,
    "untrained": {"color": "#9dc3e6", "marker": "o"},
    "plan_motion": {"color": "#c0504d", "marker": "D"},
    "ompl": {"color": "#4f8f4f", "marker": "P"},
    "search": {"color": "#7f7f7f", "marker": "s"},
    "straight": {"color": "#404040", "marker": "x"},
    "sac": {"color": "#2a9d8f", "marker": "v"},
    "tqc": {"color": "#8e6bb0", "marker": "<"},
    "ppo": {"color": "#d1812f", "marker": "^"},
}
OTHER_COLOURS = "#c9b458", "#d9a6c2", "#b5a08c", "#a8c686", "#5c5c8a"  # Of methods that are not among them
DOTS_PER_INCH = 130
STYLE = "viapoint.training.style"  # Style of figures in centimetres, for Matplotlib's `style.use`
WIDTH, HEIGHT, LEGEND = 17.0, 5.4, 0.7  # Of a figure of fits, each movement, the legend, [cm]
COLUMN = 8.5  # Width of a figure in STYLE that can be read on a narrow page, [cm]
# Style of the fit: a wide light line below the samples
FITTED: dict[str, Any] = {"color": PALETTE.plan, "linewidth": 2.2, "label": "fitted"}
POINT: dict[str, Any] = {"linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.6}
SAMPLES: dict[str, Any] = {"color": PALETTE.executed, "linestyle": "none", "marker": ".", "markersize": 1.8}
VIA: dict[str, Any] = {**POINT, "color": PALETTE.via, "marker": "o", "markersize": 6.0, "label": "via-points"}
START: dict[str, Any] = {**POINT, "color": PALETTE.start, "marker": "s", "markersize": 5.0, "label": "start"}
GOAL: dict[str, Any] = {**POINT, "color": PALETTE.goal, "marker": "D", "markersize": 5.0, "label": "goal"}


@matplotlib.rc_context({"text.parse_math": False})  # names are no formulas
def success_of_rows(
    path: Path, table: Any, curves: Mapping[str, Sequence[Sequence[Sequence[float]]]], sets: str = "scenes"
) -> Path:
    """Draw success with intervals of each method in each set of scenes, and success during trainings.

    `table` has lines of one environment with `method`, `set`, `success`, `low` and `high`; `curves` has pairs of
    decisions and success in validation, for each run of each method; `sets` says what the names of sets mean.
    """
    methods = list(dict.fromkeys(table["method"]))
    figure = Figure(figsize=(11.0, 1.6 + 0.32 * len(methods)), layout="constrained")
    axes, *others = figure.subplots(1, 2 if curves else 1, squeeze=False)[0]
    for i, (name, part) in enumerate(table.groupby("set", sort=False)):
        place = [methods.index(method) + 0.2 * i for method in part["method"]]
        rate = 100.0 * part["success"].astype(float)
        spread = np.stack((rate - 100.0 * part["low"], 100.0 * part["high"] - rate)).clip(0.0)
        axes.errorbar(rate, place, xerr=spread, fmt="o", markersize=4, capsize=2, label=name)
    axes.set_yticks(range(len(methods)), methods)
    axes.invert_yaxis()
    axes.set_xlim(-2.0, 102.0)
    axes.set_xlabel("success [%], 95 % interval")
    for ax in others:
        for row, runs in curves.items():
            for j, curve in enumerate(each for each in runs if each):
                decisions, rate = np.array(curve).T
                ax.plot(decisions, 100.0 * rate, label=None if j else row, **_colour(row, list(curves)))
        ax.set_xlabel("decisions")
        ax.set_ylabel("success in validation [%]")
        ax.set_ylim(-2.0, 102.0)
    for ax, title in zip((axes, *others), (sets, None), strict=False):
        ax.legend(frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), title=title)
        style_axes(ax)
    return write_figure(path, figure, dpi=DOTS_PER_INCH)


def fitted_movements(
    path: Path, movements: Mapping[str, tuple[Float, Float]], fits: Mapping[str, ViaPointFit]
) -> Path:
    """Draw path and speed, from neighbouring samples, of each movement, measured and fitted, one row each.

    Movements are times, shape (N,), [s], and positions, shape (N, D), [m], by name; `fits` has one for each of them.
    """
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(WIDTH / 2.54, (HEIGHT * len(movements) + LEGEND) / 2.54))
        axes = figure.subplots(len(movements), 2, squeeze=False)
        for (left, right), (name, (time, position)) in zip(axes, movements.items(), strict=True):
            fit = fits[name]
            # The path is seen in the plane of the two coordinates that change most.
            shown = np.sort(np.argsort(-np.ptp(position, axis=0), kind="stable")[:2])
            path_fitted = fit(np.linspace(fit.onset, fit.end, 200))
            left.plot(*path_fitted[:, shown].T, **FITTED)
            left.plot(*position[:, shown].T, label="samples", **SAMPLES)
            left.plot(*fit.start[shown], **START)
            left.plot(*fit.via_points[:, shown].T, **VIA)
            left.plot(*fit.goal[shown], **GOAL)
            left.set_aspect("equal", adjustable="datalim")
            horizontal, vertical = ("xyz"[i] for i in shown)
            left.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]")
            left.set_title(f"movement {name}", parse_math=False)  # a name is no formula

            measured = np.linalg.norm(np.gradient(position, time, axis=0), axis=1)
            every = np.linspace(min(fit.onset, time[0]), max(fit.end, time[-1]), 300)
            right.plot(every, np.linalg.norm(fit(every, 1), axis=1), **FITTED)
            right.plot(time, measured, **SAMPLES)
            right.plot(fit.passage_times, np.linalg.norm(fit(fit.passage_times, 1), axis=1), **VIA)
            right.set_ylim(bottom=0.0)
            right.set(xlabel="time [s]", ylabel="speed [m/s]")
            title = f"residuals {1e3 * fit.noise:.2g} mm, $R^2$ = {fit.r_squared:.5f}"
            right.set_title(title, fontweight="normal")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), markerscale=1.2)
        return write_figure(path, figure)


def style_axes(ax: Any) -> None:
    """Remove the upper and right spines and draw horizontal grid lines."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(axis="y", color="0.9")
    ax.set_axisbelow(True)


def _colour(name: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the colour of a method; of its variants, such as numbers of checks, the first ones are paler."""
    kind = next((known for known in METHOD_STYLES if name.startswith(known)), None)
    if kind is None:
        others = [each for each in names if not each.startswith(tuple(METHOD_STYLES))]
        return {"color": OTHER_COLOURS[others.index(name) % len(OTHER_COLOURS)]}
    variants = [each for each in names if each.startswith(kind)]
    return {"color": METHOD_STYLES[kind]["color"], "alpha": (1 + variants.index(name)) / len(variants)}
