"""Figure of measured movements and of the movements that were fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.primitives import ViaPointFit
from viapoint.training.io.files import MARK

STYLE = files("viapoint.training") / "paper" / "paper.mplstyle"  # Style of figures
WIDTH, HEIGHT, LEGEND = 17.0, 5.4, 0.7  # Of the figure, each movement, the legend, [cm]
# Style of the fit: a wide light line below the samples
FITTED: dict[str, Any] = {"color": PALETTE.plan, "linewidth": 2.2, "label": "fitted"}
POINT: dict[str, Any] = {"linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.6}
SAMPLES: dict[str, Any] = {"color": PALETTE.executed, "linestyle": "none", "marker": ".", "markersize": 1.8}
VIA: dict[str, Any] = {**POINT, "color": PALETTE.via, "marker": "o", "markersize": 6.0, "label": "via-points"}
START: dict[str, Any] = {**POINT, "color": PALETTE.start, "marker": "s", "markersize": 5.0, "label": "start"}
GOAL: dict[str, Any] = {**POINT, "color": PALETTE.goal, "marker": "D", "markersize": 5.0, "label": "goal"}


class Measured(NamedTuple):
    """Measured movement."""

    name: str
    time: Float  # Times of the samples, shape (N,), [s]
    position: Float  # Positions, shape (N, D), [m]


def fitted_movements(path: Path, movements: Sequence[Measured], fits: Sequence[ViaPointFit]) -> None:
    """Draw path and speed of each movement, measured and fitted, one row each.

    A path in space is seen along the coordinate that changes least. The measured speed is that of differences of
    neighbouring samples.
    """
    with matplotlib.style.context(str(STYLE)):
        height = HEIGHT * len(movements) + LEGEND
        figure = Figure(figsize=(WIDTH / 2.54, height / 2.54))
        axes = figure.subplots(len(movements), 2, squeeze=False)
        for (left, right), movement, fit in zip(axes, movements, fits, strict=True):
            _draw_path(left, movement, fit)
            _draw_speed(right, movement, fit)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), markerscale=1.2)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": MARK.decode()})


def _draw_path(ax: Any, movement: Measured, fit: ViaPointFit) -> None:
    """Draw the path in the plane of the two coordinates that change most."""
    shown = np.sort(np.argsort(-np.ptp(movement.position, axis=0), kind="stable")[:2])
    path = fit(np.linspace(fit.onset, fit.end, 200))
    ax.plot(*path[:, shown].T, **FITTED)
    ax.plot(*movement.position[:, shown].T, label="samples", **SAMPLES)
    ax.plot(*fit.start[shown], **START)
    ax.plot(*fit.via_points[:, shown].T, **VIA)
    ax.plot(*fit.goal[shown], **GOAL)
    ax.set_aspect("equal", adjustable="datalim")
    horizontal, vertical = ("xyz"[i] for i in shown)
    ax.set_xlabel(f"{horizontal} [m]")
    ax.set_ylabel(f"{vertical} [m]")
    ax.set_title(f"movement {movement.name}")


def _draw_speed(ax: Any, movement: Measured, fit: ViaPointFit) -> None:
    """Draw the speed over time."""
    measured = np.linalg.norm(np.gradient(movement.position, movement.time, axis=0), axis=1)
    time = np.linspace(min(fit.onset, movement.time[0]), max(fit.end, movement.time[-1]), 300)
    ax.plot(time, np.linalg.norm(fit(time, 1), axis=1), **FITTED)
    ax.plot(movement.time, measured, **SAMPLES)
    ax.plot(fit.passage_times, np.linalg.norm(fit(fit.passage_times, 1), axis=1), **VIA)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("speed [m/s]")
    ax.set_title(f"residuals {1e3 * fit.noise:.2g} mm, $R^2$ = {fit.r_squared:.5f}", fontweight="normal")
