"""Style of the figures: one column of 8.5 cm, and one colour for each quantity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.scene import TARGETS
from viapoint.training.io.files import MARK

WIDTH = 8.5 / 2.54
"""Width of a column, [inch]."""
DOTS_PER_INCH = 200
STYLE: Any = {
    "font.size": 7.0,
    "axes.labelsize": 7.0,
    "axes.titlesize": 7.5,
    "axes.titleweight": "bold",
    "axes.linewidth": 0.6,
    "axes.labelpad": 2.0,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "lines.linewidth": 1.2,
    "legend.title_fontsize": 6.5,
    "legend.borderaxespad": 0.0,
    "mathtext.fontset": "dejavusans",
    "svg.hashsalt": "viapoint",
    "svg.fonttype": "none",
}
MODEL: dict[str, Any] = {"color": PALETTE.plan, "linewidth": 2.2, "solid_capstyle": "round"}
"""Style of the model: a wide light line that stays visible beside the arm."""
ARM: dict[str, Any] = {"color": PALETTE.executed, "linewidth": 0.9, "linestyle": (0, (4, 1.5))}
"""Style of the simulated arm."""
SECOND = PALETTE.goal
THIRD = PALETTE.via
GREY = PALETTE.start


def sheet(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """Return a figure of one column and `height` centimetres, and its axes, shape (rows, columns)."""
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03)
    figure = Figure(figsize=(WIDTH, height / 2.54), layout=layout)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    figure.savefig(paths[0], dpi=DOTS_PER_INCH, metadata={"Software": MARK.decode()})
    figure.set_layout_engine("none")  # the same layout for both files, computed once
    figure.savefig(paths[1], metadata={"Date": None, "Creator": MARK.decode()})
    return paths


def plane(ax: Axes, *, names: tuple[str, ...] = tuple(TARGETS)) -> None:
    """Draw the horizontal plane with the paper's targets, in centimetres."""
    for name in names:
        x, y = 100.0 * np.array(TARGETS[name])
        ax.plot(x, y, "o", color="white", markeredgecolor=GREY, markersize=5.0, markeredgewidth=0.8, zorder=1)
        low = y < 35.0
        ax.annotate(
            f"$T_{name[1]}$", (x, y), xytext=(0, -4 if low else 4), textcoords="offset points", fontsize=6.5,
            ha="center", va="top" if low else "bottom", color=GREY, zorder=4,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
        )  # fmt: skip
    ax.set(aspect="equal", xlim=(-39.0, 15.0), ylim=(15.0, 66.0))
    ax.set(xlabel="$x$ [cm]", ylabel="$y$ [cm]", xticks=[-30, -15, 0], yticks=[20, 40, 60])


def path(ax: Axes, position: Float, **style: Any) -> None:
    """Draw a hand path, shape (T, 2), [m]."""
    ax.plot(*(100.0 * position.T), **style)


def dot(ax: Axes, point: Float, **style: Any) -> None:
    """Draw a via-point, shape (2,), [m]."""
    usual = {"marker": "o", "color": PALETTE.via, "markersize": 3.6, "zorder": 5}
    ax.plot(*(100.0 * point), **{**usual, **style})


def letters(axes: Any, text: str = "ABCDEFGH") -> None:
    """Add panel letters, upper left."""
    for ax, letter in zip(np.ravel(axes), text, strict=False):
        ax.set_title(letter, loc="left", pad=3.0)
