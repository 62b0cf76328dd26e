"""Command `fit`: via-points of measured movements."""

from __future__ import annotations

import io
import itertools
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from viapoint.envs.common.arrays import Float
from viapoint.primitives import ViaPointFit, fit_via_points
from viapoint.training.configs import FitConfig
from viapoint.training.files import BadFileError, check_ours, read_bytes, write_bytes
from viapoint.training.plots import fitted_movements

REQUIRED = ("time", "x", "y")  # Columns that a file of movements must have
EXPECTED = "its first line must name the columns time, x, y, and optionally z and movement"
COORDINATES = ("x", "y", "z")  # Names of the coordinates; z may be left out
# Distances of samples, [s], and extents of movements, [m], above which the units are probably others
SLOW, WIDE = 0.5, 5.0
POOR = 0.9  # R^2 below which the samples are hardly those of one movement
DRAWN = 6  # Greatest number of movements in the figure

Fits = dict[str, ViaPointFit]  # Fits by the names of the movements
# Times of the samples, shape (N,), [s], and positions, shape (N, D), [m], by the names of the movements
Movements = dict[str, tuple[Float, Float]]


def run(config: FitConfig) -> None:
    """Fit the movements of a file, print a table, and write it with a figure."""
    table = config.out / "fit.csv"
    figure = config.out / "fit.png"
    check_ours(figure)
    if table.exists() and not figure.exists():
        raise BadFileError(table, "exists and was not written by viapoint; name another folder")
    again = table.exists()
    movements = read_movements(config.file)
    fits: Fits = {}
    for name, (time, position) in list(movements.items()):
        try:
            with warnings.catch_warnings(record=True, action="always") as told:
                fits[name] = fit_via_points(time, position, config.numbers, free_ends=config.free_ends)
        except ValueError as error:
            reason = str(error).replace("n_via=", "--n-via ")
            if len(movements) == 1:
                raise BadFileError(config.file, f"movement {name}: {reason}") from None
            del movements[name]
            print(f"movement {name} is left out: {reason}", file=sys.stderr)
        for each in told:
            print(f"movement {name}: {each.message}", file=sys.stderr)
    _warn(movements, fits, config)
    print(_printed(fits))
    write_bytes(table, _written(fits).to_csv(index=False).encode())
    fitted_movements(figure, dict(itertools.islice(movements.items(), DRAWN)), fits)
    shown = "" if len(movements) <= DRAWN else f" of the first {DRAWN} movements"
    print(f"\ntable: {table}{', replaced' if again else ''}\nfigure{shown}: {figure}")


def read_movements(path: Path) -> Movements:
    """Return the movements of a CSV file; a wrong column or entry raises BadFileError, which names it."""
    table = _read_table(path)
    missing = [name for name in REQUIRED if name not in table]
    if missing:
        found = ", ".join(map(str, table.columns))
        raise BadFileError(path, f"has no column {', '.join(missing)}; {EXPECTED}, got {found}")
    names = [name for name in ("time", *COORDINATES) if name in table]
    # Spreadsheets of many countries write decimals with commas.
    points = table[names].replace(",", ".", regex=True)
    numbers = points.apply(pd.to_numeric, errors="coerce")
    wrong = np.argwhere(~np.isfinite(numbers.to_numpy(dtype=float)))
    if len(wrong):
        row, column = wrong[0]
        entry = table[names].fillna("nothing").iloc[row, column]
        reason = f"has no number in line {table.index[row]}, column {names[column]}: {entry}"
        raise BadFileError(path, f"{reason}; leave out lines of units, and those that were not measured")
    unread = [name for name in table.columns.dropna() if name not in (*REQUIRED, "z", "movement")]
    if unread:
        told = "the column `movement` names the movement of each line"
        print(f"columns that are not read: {', '.join(unread)}; {told}", file=sys.stderr)
    labels = table["movement"].str.strip() if "movement" in table else pd.Series("1", index=table.index)
    if labels.isna().any():
        line = labels.isna().idxmax()
        raise BadFileError(path, f"names no movement in line {line}; NA, null and the like stand for no name")
    begins = labels[labels != labels.shift()]
    again = begins[begins.duplicated()]
    if len(again):
        told = "if it is another movement, give it another name"
        print(f"movement {again.iloc[0]} begins again in line {again.index[0]}; {told}", file=sys.stderr)
    movements: Movements = {}
    for label, rows in numbers.groupby(labels, sort=False):
        values = rows.to_numpy(dtype=float)
        back = np.flatnonzero(np.diff(values[:, 0]) <= 0.0)
        if back.size:
            reason = f"has an earlier or equal time in line {rows.index[back[0] + 1]}; if another movement begins there"
            advice = "add a column `movement` with the name of the movement of each line"
            otherwise = "otherwise sort the lines, and keep one of equal times"
            raise BadFileError(path, f"{reason}, {advice}, {otherwise}")
        movements[str(label)] = values[:, 0], values[:, 1:]
    if not movements:
        raise BadFileError(path, "holds no samples")
    return movements


def _warn(movements: Movements, fits: Fits, config: FitConfig) -> None:
    """Print what looks like other units than seconds and metres, or like several movements in one."""
    fewest, most = config.numbers
    for name, (time, position) in movements.items():
        gap = float(np.ptp(time)) / len(time)
        extent = float(np.ptp(position, axis=0).max())
        if gap > SLOW:
            print(f"movement {name}: samples are {gap:g} s apart; `time` is in seconds", file=sys.stderr)
        if extent > WIDE:
            print(f"movement {name}: the hand moves {extent:g} m; positions are in metres", file=sys.stderr)
        if fits[name].r_squared < POOR:
            share = f"{float(fits[name].r_squared):.0%} of the variance"
            print(f"movement {name}: the fit explains only {share}; is it one movement?", file=sys.stderr)
        if fewest < most == fits[name].n_via:
            found = f"movement {name}: {most} via-points, the most allowed, fit best"
            told = "too many where samples were filtered: fit unfiltered ones, or give the number (--n-via 1)"
            otherwise = "otherwise cut a recording of several movements, and allow more"
            print(f"{found}; {told}; {otherwise}", file=sys.stderr)


def _read_table(path: Path) -> pd.DataFrame:
    """Return the entries of a CSV file as texts; the index holds the numbers of their lines in the file."""
    content = read_bytes(path)
    if not content.strip():
        raise BadFileError(path, "is empty")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadFileError(path, f"is not UTF-8 text ({error.reason}): save it in this encoding") from None
    begun = text.lstrip()
    first = begun.partition("\n")[0].rstrip()
    separator = next((each for each in ";\t, " if each in first), ",")
    # A separator at the end of a line, without one in the first line, begins no column.
    ended = "\n".join(_without_end(line, separator, first.count(separator)) for line in begun.splitlines())
    try:
        table = pd.read_csv(
            io.StringIO(ended),
            sep=separator,
            header=None,
            dtype=str,
            skipinitialspace=True,
            skip_blank_lines=False,
        )
    except ValueError as error:
        reason = str(error).rpartition("C error: ")[2].strip()  # of pandas, without its own words
        raise BadFileError(path, f"cannot be read as a table: {reason}; {EXPECTED}") from None
    blank_lines = text[: len(text) - len(begun)].count("\n")
    table.index += 1 + blank_lines
    head = table.iloc[0].str.strip().str.lower()
    twice = [name for name in ("time", *COORDINATES, "movement") if (head == name).sum() > 1]
    if twice:
        raise BadFileError(path, f"has several columns {twice[0]}")
    return table.iloc[1:].dropna(how="all").set_axis(head, axis="columns")  # without blank lines


def _without_end(line: str, separator: str, number: int) -> str:
    """Return a line without spaces at its end, and without a separator there beyond a number of them."""
    line = line.rstrip(" ")
    return line.removesuffix(separator) if line.count(separator) > number else line


def _printed(fits: Fits) -> str:
    """Return one line for each movement, for people."""
    rows = []
    for name, fit in fits.items():
        points = [f"({', '.join(f'{value:.3f}' for value in point)})" for point in fit.via_points]
        row = {
            "movement": name,
            "via-points [m]": " ".join(points) or "none",
            "passage times [s]": " ".join(f"{time:.3f}" for time in fit.passage_times) or "-",
            "duration [s]": f"{float(fit.duration):.3f}",
            "residuals [mm]": f"{1e3 * float(fit.noise):.2f}",
            "R^2": f"{float(fit.r_squared):.5f}",
        }
        rows.append(row)
    return str(pd.DataFrame(rows).to_markdown(index=False, tablefmt="simple", disable_numparse=True))


def _written(fits: Fits) -> pd.DataFrame:
    """Return one line for each movement with all numbers."""
    rows = []
    for movement, fit in fits.items():
        row: dict[str, Any] = {"movement": movement, "n_via": int(fit.n_via)}
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
