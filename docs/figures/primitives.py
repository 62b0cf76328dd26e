"""Draw the figures of primitives.md: `python docs/figures/primitives.py` writes them to docs/images/."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.primitives import curvature, passage_durations, point_to_point, speed, speed_valleys, through
from viapoint.training.files import write_figure
from viapoint.training.plots import COLUMN, STYLE, style_axes

FOLDER = Path(__file__).parents[1] / "images"
COLOURS = mpl.colormaps["viridis"]


def sheet(height: float) -> Figure:
    """Return an empty figure of one column and `height` centimetres."""
    return Figure(figsize=(COLUMN / 2.54, height / 2.54))


def save(figure: Figure, name: str) -> None:
    """Write one figure as a small PNG."""
    for axes in figure.axes:
        style_axes(axes)
    write_figure(FOLDER / f"primitives_{name}.png", figure)


def reach() -> None:
    """Draw position, speed, acceleration and jerk of a reach for the three orders."""
    figure = sheet(8.4)
    axes = figure.subplots(2, 2, sharex=True).ravel()
    time = np.linspace(0, 1, 301)
    names = ("position [m]", "speed [m/s]", "acceleration [m/s²]", "jerk [m/s³]")
    for order, label in ((2, "least acceleration"), (3, "least jerk"), (4, "least snap")):
        movement = point_to_point([0.0], [1.0], 1.0, order=order)
        for nu, axis in enumerate(axes):
            # The colours of the same three movements on the page of the paper
            colour = {2: PALETTE.via, 3: PALETTE.plan, 4: PALETTE.goal}[order]
            axis.plot(
                time, movement(time, nu)[:, 0], label=label, color=colour, lw=2.2 if order == 3 else 1.2
            )
    for axis, name in zip(axes, names, strict=True):
        axis.set_title(name)
    for axis in axes[2:]:
        axis.set(xlabel="time [s]", xlim=(0.0, 1.0))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    save(figure, "reach")


def family() -> None:
    """Draw movements through via-points of growing height: paths, speeds, curvatures."""
    figure = sheet(9.0)
    parts = figure.subplot_mosaic([["path", "path"], ["speed", "curvature"]], height_ratios=(1.1, 1.0))
    paths, speeds, bends = parts.values()
    time = np.linspace(0, 1, 401)
    for height in np.linspace(0, 0.6, 7):
        waypoints = np.array([[0.0, 0.0], [0.35, height], [1.0, 0.0]])
        movement = through(waypoints, passage_durations(waypoints, 1.0))
        colour = COLOURS(height / 0.65)
        paths.plot(*movement(time).T, color=colour)
        paths.plot(*waypoints[1], "o", color=colour, ms=3.6)
        speeds.plot(time, speed(movement, time), color=colour)
        valley = speed_valleys(movement)
        speeds.plot(valley.time, valley.speed, "v", color=colour, ms=3.6)
        inner = time[20:-20]
        bends.plot(inner, -curvature(movement, inner), color=colour)
    paths.plot([], [], "o", color="0.3", ms=3.6, label="via-point")
    speeds.plot([], [], "v", color="0.3", ms=3.6, label="valley")
    paths.legend(loc="upper right", handlelength=0.8)
    speeds.legend(loc="upper left", handlelength=0.8)
    paths.set(title="path [m]", xlabel="along the straight line [m]", aspect="equal")
    speeds.set(title="speed [m/s]", xlabel="time [s]", xlim=(0, 1), ylim=(-0.1, 3.1))
    bends.set(title="curvature [1/m]", xlabel="time [s]", xlim=(0, 1), ylim=(-1, 12), yticks=[0, 5, 10])
    save(figure, "family")


def passage() -> None:
    """Draw cost against passage time, and passage time against the position of the via-point."""
    figure = sheet(6.4)
    costs, times = figure.subplots(1, 2)
    t = np.linspace(0.15, 0.85, 300)
    for along, colour in ((0.15, "C0"), (0.35, "C1"), (0.5, "C2")):
        waypoints = np.array([[0.0, 0.0], [along, 0.3], [1.0, 0.0]])
        cost = through(waypoints[None], np.stack([t, 1 - t], axis=-1)).cost()
        best = passage_durations(waypoints, 1.0)
        costs.semilogy(t, cost / 360, color=colour, label=f"{along}")
        costs.semilogy(best[0], through(waypoints, best).cost() / 360, "o", color=colour, ms=3.6)
    costs.set(xlabel="passage time / duration", title="jerk cost / straight reach")
    costs.legend(
        title="place of the via-point", loc="upper center", ncols=3, handlelength=1.0, columnspacing=0.8
    )
    costs.set_ylim(top=3000.0)
    along = np.linspace(0, 1, 401)
    for height in (0.0, 0.1, 0.3, 1.0):
        via = np.stack([along, np.full_like(along, height)], axis=-1)
        ends = np.broadcast_to([[[0.0, 0.0]], [[1.0, 0.0]]], (2, 401, 2))
        waypoints = np.stack([ends[0], via, ends[1]], axis=1)
        times.plot(along, passage_durations(waypoints, 1.0)[:, 0], label=f"{height}")
    times.set(xlabel="d1 / (d1 + d2)", title="passage time / duration", xlim=(0, 1), ylim=(0, 1))
    times.legend(title="height", loc="upper left", handlelength=1.0)
    save(figure, "passage")


def replanning() -> None:
    """Draw replanning from noisy states until the end, and with the last plan kept for the last 100 ms."""
    figure = sheet(6.0)
    jerks = figure.subplots()
    step, arrival, goal = 0.01, 0.8, np.array([0.3])
    smooth = point_to_point(np.zeros(1), goal, arrival)
    grid = np.arange(80) * step
    for freeze, label in ((0.0, "replanned to the end"), (0.1, "kept for the last 0.1 s")):
        rng = np.random.default_rng(1)
        state = [np.zeros(1)] * 3
        plan, begun, jerk = smooth, 0.0, []
        for now in grid:
            if arrival - now > freeze:
                seen = [value + rng.normal(size=1) * 1e-4 for value in state]
                ends = {"start_velocity": seen[1], "start_acceleration": seen[2]}
                plan, begun = point_to_point(seen[0], goal, arrival - now, **ends), now
            jerk.append(plan(now - begun, 3)[0])
            state = [plan(now - begun + step, nu) for nu in range(3)]
        jerks.plot(grid, jerk, label=label)
    jerks.plot(grid, smooth(grid, 3)[:, 0], "k:", label="without noise")
    jerks.set(title="jerk [m/s³]", xlabel="time [s]", xlim=(0.0, arrival))
    jerks.set_yscale("symlog", linthresh=100.0)
    jerks.set_ylim(-2e4, 5e2)
    jerks.legend(loc="lower left")
    save(figure, "replanning")


if __name__ == "__main__":
    with matplotlib.style.context(STYLE):
        for draw in (reach, family, passage, replanning):
            draw()
