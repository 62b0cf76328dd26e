"""Figure of the flow from action to observation, with the data of one movement."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float, Frame, Observation
from viapoint.envs.episodes import Recorded
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.paper.movements import required_torque
from viapoint.training.plotting.top_view import View, draw_movement, footprint, planned_only

SIZE = (12.4, 6.5)
"""Width and height, [inch]."""
COLUMNS, ROWS = (0.045, 0.292, 0.539, 0.786), (0.60, 0.085)
"""Left and lower edges of the panels, in fractions of the figure."""
WIDE, TALL = 0.175, 0.295
"""Width and height of a panel, in fractions of the figure."""
ASPECT = TALL * SIZE[1] / (WIDE * SIZE[0])
"""Height of a panel over its width."""
GREY = (0.45, 0.47, 0.52)
MARGIN = 0.035
"""Margin around a scene, [m]."""


class Data(NamedTuple):
    """Data of one movement."""

    task: Task
    recorded: Recorded
    """Scene, plan and execution."""
    action: Float
    """Shape (m,)."""
    observation: Observation
    """Observation before the movement."""
    info: dict[str, Any]
    """Info after the movement."""
    picture: Frame
    """Rendered picture."""

    @property
    def plan(self) -> Plan:
        """Plan without the batch dimension."""
        return self.recorded.history[0][1].take(0)

    @property
    def time(self) -> Float:
        """Instants of the planned movement, [s]."""
        return np.linspace(0.0, float(self.plan.duration), 241)


def draw_flow(path: Path, data: Data) -> None:
    """Draw the flow of a movement to a PNG file."""
    figure = Figure(figsize=SIZE, dpi=120, facecolor="white")
    FigureCanvasAgg(figure)
    for number, (title, place, draw) in enumerate(PANELS):
        row = number // 4
        column = number if row == 0 else 7 - number
        axes = figure.add_axes((COLUMNS[column], ROWS[row], WIDE, TALL))
        _frame(axes)
        draw(axes, data)
        x, y = COLUMNS[column], ROWS[row] + TALL
        figure.text(x, y + 0.047, title, fontsize=11.5, fontweight="bold", color=PALETTE.executed)
        figure.text(x, y + 0.018, place, fontsize=8.5, color=GREY, family="monospace")
    _arrows(figure)
    figure.savefig(path)


def _action(axes: Axes, data: Data) -> None:
    names = [name.replace("_", " ") for name in data.task.action.names]
    places = np.arange(len(names))[::-1]
    axes.barh(places, data.action, height=0.34, color=PALETTE.via)
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.set(xlim=(-1.05, 1.05), ylim=(-0.4, len(names) - 0.3), yticks=[], xticks=[-1, 0, 1])
    for place, name, value in zip(places, names, data.action, strict=True):
        axes.text(-1.0, place + 0.24, name, fontsize=8.5, va="bottom", color=PALETTE.joint)
        axes.text(
            1.0, place + 0.24, f"{value:+.2f}", fontsize=8.5, va="bottom", ha="right", color=PALETTE.joint
        )


def _vias(axes: Axes, data: Data) -> None:
    scene, history, _ = data.recorded
    view = window(scene, data.plan.waypoints, ASPECT)
    plan = planned_only(scene, history[0][1])
    draw_movement(axes, data.task, plan, arm_shown=False, view=view, scale=0.9)
    start, *_, goal = data.plan.waypoints
    axes.plot(*np.stack((start, goal)).T, ":", color=GREY, linewidth=1.0, zorder=1)
    ends = np.concatenate(([0.0], np.cumsum(data.plan.durations)))
    places = np.asarray(data.plan.trajectory()((ends[:-1] + ends[1:]) / 2.0))
    outwards = places - (start + goal) / 2.0
    places += 0.05 * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)
    for (x, y), duration in zip(places, data.plan.durations, strict=True):
        axes.text(x, y, f"{duration:.2f} s", fontsize=8, ha="center", va="center", zorder=9)


def _trajectory(axes: Axes, data: Data) -> None:
    velocity = np.asarray(data.plan.trajectory()(data.time, 1))
    speed = np.sqrt((velocity**2).sum(axis=-1))
    axes.plot(data.time, speed, color=PALETTE.plan, linewidth=2.6)
    axes.fill_between(data.time, speed, color=PALETTE.plan, alpha=0.15)
    passage = np.cumsum(data.plan.durations)[:-1]
    axes.plot(passage, np.interp(passage, data.time, speed), "o", color=PALETTE.via, markersize=7)
    _label(axes, data, "speed [m/s]")
    axes.set_ylim(0.0, 1.15 * speed.max())


def _references(axes: Axes, data: Data) -> None:
    position = np.asarray(data.plan.trajectory()(data.time))
    for column, name, colour in zip(position.T, "xy", (PALETTE.plan, PALETTE.goal), strict=True):
        axes.plot(data.time, column, color=colour, linewidth=2.2)
        axes.text(data.time[-1], column[-1], f" {name}", color=colour, va="center", fontsize=10)
    _label(axes, data, "hand position [m]")


def _controls(axes: Axes, data: Data) -> None:
    """Draw the torque that the references require."""
    torque = required_torque(data.plan.trajectory(), len(data.time))
    colours = PALETTE.executed, PALETTE.via
    for column, name, colour in zip(torque.T, ("shoulder", "elbow"), colours, strict=True):
        axes.plot(data.time, column, color=colour, linewidth=2.2, label=name)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.legend(fontsize=8, frameon=False, loc="best")
    _label(axes, data, "required torque [N m]")


def _rollout(axes: Axes, data: Data) -> None:
    axes.imshow(data.picture[: round(data.picture.shape[1] * ASPECT)])
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _clearance(axes: Axes, data: Data) -> None:
    rollout = data.recorded.rollout
    clearance = 1e3 * rollout.clearance
    top, least = 1.25 * clearance.max(), int(clearance.argmin())
    axes.axhspan(-top, 0.0, color=PALETTE.contact, alpha=0.18, linewidth=0)
    axes.plot(rollout.time, clearance, color=PALETTE.executed, linewidth=2.2)
    axes.plot(rollout.time[least], clearance[least], "o", color=PALETTE.contact, markersize=6)
    place = rollout.time[least], clearance[least]
    thin = {"arrowstyle": "-", "color": GREY, "linewidth": 0.8, "shrinkB": 4}
    said = f"least {clearance[least]:.0f} mm"
    axes.annotate(said, place, (place[0], 0.5 * top), fontsize=8.5, ha="right", arrowprops=thin)
    _label(axes, data, "clearance [mm]")
    axes.set_ylim(-0.08 * top, top)
    reward = sum(value for name, value in data.info.items() if name.startswith("reward_"))
    said = f"is_success {data.info['is_success']}   reward {reward:+.2f}"
    axes.text(0.03, 0.98, said, fontsize=8.5, family="monospace", va="top", transform=axes.transAxes)


def _observation(axes: Axes, data: Data) -> None:
    axes.set_axis_off()
    lines = []
    for name, values in data.observation.items():
        numbers = " ".join(f"{value:+.2f}" for value in values[:4])
        lines += [name, f"  {numbers}{' ...' if len(values) > 4 else ''}"]
    style = {"va": "top", "fontsize": 9, "family": "monospace", "linespacing": 1.5}
    axes.text(0.0, 0.97, "\n".join(lines), style, transform=axes.transAxes)


PANELS: tuple[tuple[str, str, Callable[[Axes, Data], None]], ...] = (
    ("action", "envs/plans.py", _action),
    ("via-points & durations", "envs/plans.py", _vias),
    ("minimum-jerk trajectory", "primitives/", _trajectory),
    ("references", "primitives/trajectory.py", _references),
    ("controls", "envs/arms/", _controls),
    ("physics rollout", "envs/simulator.py", _rollout),
    ("clearance, reward, info", "envs/geometry/ envs/rewards.py", _clearance),
    ("observation", "envs/observation.py", _observation),
)


def _frame(axes: Axes) -> None:
    axes.tick_params(labelsize=8, colors=GREY, length=2)
    for side, spine in axes.spines.items():
        spine.set_color(GREY)
        spine.set_linewidth(0.8)
        spine.set_visible(side in ("left", "bottom"))


def _label(axes: Axes, data: Data, quantity: str) -> None:
    axes.set_xlim(0.0, data.time[-1] * 1.02)
    axes.set_xlabel("time [s]", fontsize=8, color=GREY, labelpad=1)
    axes.set_ylabel(quantity, fontsize=8, color=GREY, labelpad=1)


def window(scene: Scenes, points: Float, aspect: float) -> View:
    """Return limits of x and y around points and the obstacles of a scene, with a given height per width, [m]."""
    outlines = [each for shape in unpack(scene.obstacles, 0) for each in footprint(shape)]
    points = np.concatenate((points, *outlines))
    middle, extent = (points.max(axis=0) + points.min(axis=0)) / 2.0, np.ptp(points, axis=0)
    half = max(extent[0], extent[1] / aspect) / 2.0 + MARGIN
    x, y = (float(m) for m in middle)
    return (x - half, x + half), (y - half * aspect, y + half * aspect)


def _arrows(figure: Figure) -> None:
    """Draw arrows from panel to panel: along the upper row, back along the lower row, and up through the agent."""
    gap = 0.012
    for row, direction in ((0, 1), (1, -1)):
        for column in range(3):
            ends = [COLUMNS[column] + WIDE + gap, COLUMNS[column + 1] - gap][::direction]
            height = ROWS[row] + TALL + 0.053
            _arrow(figure, (ends[0], height), (ends[1], height), PALETTE.plan)
    last = COLUMNS[3] + WIDE / 2.0
    _arrow(figure, (last, ROWS[0] - 0.085), (last, ROWS[1] + TALL + 0.09), PALETTE.plan)
    first = COLUMNS[0] + WIDE / 2.0
    _arrow(figure, (first, ROWS[1] + TALL + 0.09), (first, ROWS[0] - 0.085), PALETTE.goal)
    height = (ROWS[0] + ROWS[1] + TALL) / 2.0
    figure.text(first + 0.012, height, "agent", fontsize=11, color=PALETTE.goal, va="center")


def _arrow(figure: Figure, first: tuple[float, float], second: tuple[float, float], colour: Colour) -> None:
    arrow = FancyArrowPatch(first, second, arrowstyle="-|>", mutation_scale=15, linewidth=2.2, color=colour)
    arrow.set_transform(figure.transFigure)
    figure.add_artist(arrow)
