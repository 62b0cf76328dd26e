"""Figures of targets that jump: the sum of two movements beside the revised plan."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.training.paper.figures.style import ARM, MODEL, SECOND, THIRD, dot, letters, path, plane, sheet
from viapoint.training.paper.rows.double_step import (
    DURATION,
    MOMENTS,
    NAMES,
    DoubleStep,
    double_step,
    greatest_distance,
    peak_speed,
    simulate_double,
)
from viapoint.training.paper.simulated import SimulatedMovements

SUM: dict[str, Any] = {"color": PALETTE.contact, "linewidth": 1.1}
"""Style of the superposition."""
PART: dict[str, Any] = {"color": PALETTE.contact, "linewidth": 0.6, "linestyle": ":"}
"""Style of its two parts."""
NOW: dict[str, Any] = {"color": THIRD, "linewidth": 0.8}
"""Style of the moment of revision."""
SECONDS = (0.7, 0.85, 1.0)
"""Durations of the second movement, [s]."""


def paths_and_speeds() -> Figure:
    """Draw hand paths and speeds for four moments of revision."""
    figure, axes = sheet(len(MOMENTS), 2, 12.0, width_ratios=(1.25, 1.0), sharex="col", sharey="col")
    for row, moment in zip(axes, MOMENTS, strict=True):
        movement = double_step(moment)
        motion = simulate_double(movement)
        _paths(row[0], movement, motion)
        _speeds(row[1], movement, motion)
        row[0].annotate(f"{1e3 * moment:.0f} ms", (-33.5, 52.5), color=THIRD, fontweight="bold")
    for ax in axes[:-1].flat:
        ax.set_xlabel("")
    lines, names = axes[0, 1].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside upper center", ncols=4, handlelength=1.8, columnspacing=1.4)
    letters(axes)
    return figure


def _paths(ax: Axes, movement: DoubleStep, motion: SimulatedMovements) -> None:
    plane(ax, names=NAMES)
    time = np.linspace(0.0, movement.arrival, 401)
    path(ax, movement.planned(time), **MODEL)
    path(ax, motion.hand[1], **ARM)
    path(ax, movement.superposed(time), **SUM)
    dot(ax, np.asarray(movement.first(movement.moment)))
    ax.set(xlim=(-36.0, 13.0), ylim=(36.0, 63.0), yticks=[40, 50, 60])


def _speeds(ax: Axes, movement: DoubleStep, motion: SimulatedMovements) -> None:
    time = np.linspace(0.0, movement.arrival, 601)

    def speed(velocity: Any) -> Any:
        return np.linalg.norm(velocity, axis=-1)

    ax.plot(time, speed(movement.planned(time, 1)), label="plan revised", **MODEL)
    ax.plot(motion.time, speed(motion.velocity()[1]), label="simulated arm", **ARM)
    ax.plot(time, speed(movement.superposed(time, 1)), label="sum", **SUM)
    for begins, each in ((0.0, movement.first), (movement.moment, movement.second)):
        own = np.linspace(0.0, float(each.duration), 201)
        ax.plot(begins + own, speed(each(own, 1)), label=None if begins else "its parts", **PART)
    ax.axvline(movement.moment, **NOW)
    ax.set(
        xlabel="$t$ [s]",
        ylabel="speed [m/s]",
        xlim=(0.0, 1.05),
        xticks=[0.0, 0.5, 1.0],
        ylim=(0.0, 1.2),
        yticks=[0.0, 0.5, 1.0],
    )


def comparison() -> Figure:
    """Draw the cost of the sum and its distance from the plan against the moment of revision."""
    figure, axes = sheet(2, 2, 8.4)
    _jerk(axes[0, 0], double_step(0.2))
    moments = np.linspace(0.005, DURATION - 0.02, 60)
    for remaining, width in zip(SECONDS, (2.2, 1.3, 0.7), strict=True):
        every = [double_step(float(moment), remaining=remaining) for moment in moments]
        style = {"color": PALETTE.contact, "linewidth": width, "label": f"{remaining:g} s"}
        axes[0, 1].plot(moments, [each.ratio for each in every], **style)
        axes[1, 0].plot(moments, [100.0 * greatest_distance(each) for each in every], **style)
        if remaining == DURATION:
            _peaks(axes[1, 1], moments, every)
    axes[0, 1].axhline(1.0, color="0.6", linewidth=0.6, linestyle=":", zorder=0)
    axes[0, 1].set(ylabel="jerk cost, sum / plan", ylim=(0.0, 14.0), yticks=[1, 5, 10])
    axes[0, 1].legend(title="second movement", loc="upper right", handlelength=1.2)
    axes[1, 0].set(ylabel="greatest distance [cm]", ylim=(0.0, 15.0), yticks=[0, 5, 10, 15])
    for ax in (axes[0, 1], axes[1, 0], axes[1, 1]):
        ax.set(xlabel="revised at [s]", xlim=(0.0, DURATION))
    letters(axes)
    return figure


def _jerk(ax: Axes, movement: DoubleStep) -> None:
    """Draw the jerk along the first movement, which has all of the difference."""
    time = np.linspace(0.0, movement.arrival, 1_801)
    ax.axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
    ax.plot(time, movement.planned(time, 3)[:, 0], **MODEL, label="plan revised")
    ax.plot(time, movement.superposed(time, 3)[:, 0], **SUM, label="sum")
    ax.axvline(movement.moment, **NOW)
    ax.set(
        xlabel="$t$ [s]", ylabel="jerk along $x$ [m/s$^3$]", xlim=(0.0, movement.arrival), ylim=(-80.0, 125.0)
    )
    ax.legend(loc="upper right", handlelength=1.4)


def _peaks(ax: Axes, moments: Any, every: list[DoubleStep]) -> None:
    ax.plot(moments, [peak_speed(each, "planned") for each in every], **MODEL, label="plan revised")
    ax.plot(moments, [peak_speed(each, "superposed") for each in every], **SUM, label="sum")
    ax.axhline(float(every[0].first.peak(1)), color=SECOND, linewidth=0.8, linestyle=":", label="no jump")
    ax.set(ylabel="peak speed [m/s]", ylim=(0.6, 1.2))
    ax.legend(loc="lower right", handlelength=1.2)
