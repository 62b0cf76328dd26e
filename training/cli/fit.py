"""Command `fit`: via-points of measured movements."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.primitives import ViaPointFit, fit_via_points
from viapoint.training.config.configs import FitConfig
from viapoint.training.io.files import MARK, BadFileError, check_ours, read_bytes, write_bytes

REQUIRED = ("time", "x", "y")  # Columns that a file of movements must have
COORDINATES = ("x", "y", "z")  # Names of the coordinates; z may be left out
TABLE, FIGURE = "fit.csv", "fit.png"  # Files that are written
DRAWN = 6  # Greatest number of movements in the figure
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


def run(config: FitConfig) -> None:
    """Fit the movements of a file, print a table, and write it with a figure."""
    table, figure = config.out / TABLE, config.out / FIGURE
    check_ours(figure)
    if table.exists() and not figure.exists():
        raise BadFileError(table, "exists and was not written by viapoint; name another folder")
    movements = read_movements(config.file)
    fits = []
    for movement in movements:
        try:
            fits.append(
                fit_via_points(movement.time, movement.position, config.numbers, free_ends=config.free_ends)
            )
        except ValueError as error:
            raise BadFileError(config.file, f"movement {movement.name}: {error}") from None
    print(_printed(movements, fits))
    fitted_movements(figure, movements[:DRAWN], fits[:DRAWN])
    write_bytes(table, _written(movements, fits).to_csv(index=False).encode())
    shown = "" if len(movements) <= DRAWN else f" of the first {DRAWN} movements"
    print(f"\ntable: {table}\nfigure{shown}: {figure}")


def read_movements(path: Path) -> list[Measured]:
    """Return the movements of a CSV file; a wrong column or entry raises BadFileError, which names it."""
    read_bytes(path)
    try:
        table = pd.read_csv(path, skipinitialspace=True)
    except (ValueError, pd.errors.ParserError) as error:
        raise BadFileError(path, f"cannot be read as CSV ({' '.join(str(error).split())})") from None
    missing = [name for name in REQUIRED if name not in table]
    if missing:
        found = ", ".join(map(str, table.columns))
        raise BadFileError(
            path, f"has no column {', '.join(missing)}; its first line names the columns {found}"
        )
    names = [name for name in ("time", *COORDINATES) if name in table]
    numbers = table[names].apply(pd.to_numeric, errors="coerce")
    wrong = np.argwhere(~np.isfinite(numbers.to_numpy(dtype=float)))
    if len(wrong):
        row, column = wrong[0]
        raise BadFileError(
            path,
            f"has no number in line {row + 2}, column {names[column]}: {table[names[column]].iloc[row]}; leave out "
            "lines that were not measured",
        )
    labels = table["movement"] if "movement" in table else pd.Series(1, index=table.index)
    if labels.isna().any():
        raise BadFileError(path, f"names no movement in line {int(labels.isna().argmax()) + 2}")
    movements = []
    for label, rows in numbers.groupby(labels, sort=False):
        values = rows.to_numpy(dtype=float)
        movements.append(Measured(str(label), values[:, 0], values[:, 1:]))
    if not movements:
        raise BadFileError(path, "holds no samples")
    return movements


def _printed(movements: list[Measured], fits: list[ViaPointFit]) -> str:
    """Return one line for each movement, for people."""
    rows = []
    for movement, fit in zip(movements, fits, strict=True):
        points = [f"({', '.join(f'{value:.3f}' for value in point)})" for point in fit.via_points]
        row = {
            "movement": movement.name,
            "via-points [m]": " ".join(points) or "none",
            "passage times [s]": " ".join(f"{time:.3f}" for time in fit.passage_times) or "-",
            "duration [s]": f"{float(fit.duration):.3f}",
            "residuals [mm]": f"{1e3 * float(fit.noise):.2f}",
            "R^2": f"{float(fit.r_squared):.5f}",
        }
        rows.append(row)
    printed: Any = pd.DataFrame(rows).to_markdown(index=False, tablefmt="simple", disable_numparse=True)
    return str(printed)


def _written(movements: list[Measured], fits: list[ViaPointFit]) -> pd.DataFrame:
    """Return one line for each movement with all numbers."""
    rows = []
    for movement, fit in zip(movements, fits, strict=True):
        row: dict[str, Any] = {"movement": movement.name, "n_via": int(fit.n_via)}
        for name in ("onset", "end", "duration", "r_squared", "noise", "bic"):
            row[name] = float(getattr(fit, name))
        places = {"start": fit.start, "goal": fit.goal}
        for k, (time, point) in enumerate(zip(fit.passage_times, fit.via_points, strict=True), start=1):
            row[f"via{k}_time"] = float(time)
            places[f"via{k}"] = point
        for place, point in places.items():
            for name, value in zip(COORDINATES, point, strict=False):
                row[f"{place}_{name}"] = float(value)
        rows.append(row)
    return pd.DataFrame(rows)


def fitted_movements(path: Path, movements: Sequence[Measured], fits: Sequence[ViaPointFit]) -> None:
    """Draw path and speed, from neighbouring samples, of each movement, measured and fitted, one row each."""
    with matplotlib.style.context(str(STYLE)):
        height = HEIGHT * len(movements) + LEGEND
        figure = Figure(figsize=(WIDTH / 2.54, height / 2.54))
        axes = figure.subplots(len(movements), 2, squeeze=False)
        for (left, right), movement, fit in zip(axes, movements, fits, strict=True):
            # The path is seen in the plane of the two coordinates that change most.
            shown = np.sort(np.argsort(-np.ptp(movement.position, axis=0), kind="stable")[:2])
            path_fitted = fit(np.linspace(fit.onset, fit.end, 200))
            left.plot(*path_fitted[:, shown].T, **FITTED)
            left.plot(*movement.position[:, shown].T, label="samples", **SAMPLES)
            left.plot(*fit.start[shown], **START)
            left.plot(*fit.via_points[:, shown].T, **VIA)
            left.plot(*fit.goal[shown], **GOAL)
            left.set_aspect("equal", adjustable="datalim")
            horizontal, vertical = ("xyz"[i] for i in shown)
            left.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]", title=f"movement {movement.name}")

            measured = np.linalg.norm(np.gradient(movement.position, movement.time, axis=0), axis=1)
            time = np.linspace(min(fit.onset, movement.time[0]), max(fit.end, movement.time[-1]), 300)
            right.plot(time, np.linalg.norm(fit(time, 1), axis=1), **FITTED)
            right.plot(movement.time, measured, **SAMPLES)
            right.plot(fit.passage_times, np.linalg.norm(fit(fit.passage_times, 1), axis=1), **VIA)
            right.set_ylim(bottom=0.0)
            right.set(xlabel="time [s]", ylabel="speed [m/s]")
            title = f"residuals {1e3 * fit.noise:.2g} mm, $R^2$ = {fit.r_squared:.5f}"
            right.set_title(title, fontweight="normal")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), markerscale=1.2)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": MARK.decode()})
