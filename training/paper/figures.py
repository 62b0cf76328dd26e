"""Figures of the reproduction: one column of 8.5 cm, and one colour for each quantity."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import unpack
from viapoint.primitives import Trajectory, point_to_point
from viapoint.training.io.files import MARK
from viapoint.training.paper.lights import TARGETS
from viapoint.training.paper.movements import (
    ADULT,
    EDGE,
    Profile,
    SimulatedMovements,
    arm_profile,
    curved,
    joint_motion,
    minimum_jerk_through,
    model_profile,
    passage_share,
    required_torque,
    simulate,
    straight,
    target,
)
from viapoint.training.paper.rows.alternatives import (
    HURRY,
    PEAKS,
    SWING,
    SWINGS,
    diagonal_ends,
    joint_space,
    swings,
    torque_limited,
)
from viapoint.training.paper.rows.curved import (
    ENDS,
    EXAMPLE,
    FAST,
    HEIGHT,
    LENGTHS,
    SHARES,
    SLOW,
    THREE_POINTS,
    TYPICAL,
    arm_shares,
    model_has_valley,
    valley_threshold,
)
from viapoint.training.paper.rows.double_step import (
    MOMENTS,
    NAMES,
    STEP_DURATION,
    DoubleStep,
    double_step,
    greatest_distance,
    peak_speed,
    simulate_double,
)
from viapoint.training.paper.rows.obstacles import ObstacleMovements, features
from viapoint.training.paper.rows.straight import DURATION
from viapoint.training.plotting.top_view import footprint

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


def speed_and_curvature(axes: Any, profile: Profile, end: float = 1.0, **style: Any) -> None:
    """Draw speed on the first and curvature on the second of two axes, the curvature without its unbounded ends."""
    inner = (profile.time > EDGE) & (profile.time < 1.0 - EDGE)
    axes[0].plot(end * profile.time, profile.speed, **style)
    axes[1].plot(end * profile.time[inner], profile.curvature[inner], **{**style, "label": None})


def letters(axes: Any, text: str = "ABCDEFGH") -> None:
    """Add panel letters, upper left."""
    for ax, letter in zip(np.ravel(axes), text, strict=False):
        ax.set_title(letter, loc="left", pad=3.0)


def model() -> Figure:
    """Draw Fig. 1: a straight and a curved movement of the model."""
    figure, axes = sheet(3, 2, 10.5)
    first, second = straight("T2", "T5", 1.0), curved(*ENDS, *EXAMPLE)
    via = np.asarray(second(float(second.knots[1])))
    plane(axes[0, 0])
    path(axes[0, 0], first.sample(101, 0)[0], **MODEL)
    plane(axes[1, 0])
    _construction(axes[1, 0], second, via)
    path(axes[1, 0], second.sample(201, 0)[0], **MODEL)
    dot(axes[1, 0], via)
    for ax, movement in ((axes[0, 1], first), (axes[1, 1], second)):
        profile = model_profile(movement)
        ax.plot(profile.time, profile.speed / profile.speed.max(), **MODEL)
        ax.set(ylabel="$T/V_M$", ylim=(0, 1.08))
    _curvature(axes[2, 0], second)
    velocity = second.sample(201, 1)[0]
    for i, (name, colour) in enumerate((("$V_x$", SECOND), ("$V_y$", THIRD))):
        axes[2, 1].plot(np.linspace(0, 1, 201), velocity[:, i], color=colour, label=name, linewidth=1.6)
    axes[2, 1].set_ylabel("velocity [m/s]")
    axes[2, 1].set_ylim(-0.7, 1.5)
    axes[2, 1].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
    axes[2, 1].legend(loc="upper right", handlelength=1.2)
    for ax in (axes[0, 1], axes[1, 1], axes[2, 0], axes[2, 1]):
        ax.set(xlabel="$t/t_f$", xlim=(0, 1), xticks=[0, 0.5, 1], xticklabels=["0", "0.5", "1"])
    letters(axes[:2, 0])
    return figure


def _construction(ax: Axes, movement: Trajectory, via: Float) -> None:
    """Draw the construction of d1, d2 and d3."""
    start, goal = 100.0 * np.asarray(movement.sample(2, 0)[0])
    x, y = 100.0 * via
    thin: Any = {"color": "0.45", "linewidth": 0.6}
    ax.plot([start[0], goal[0]], [start[1], goal[1]], **thin)
    ax.plot([x, x], [start[1], y], **thin)
    for text, place, align in (
        ("$d_1$", ((start[0] + x) / 2, start[1] - 0.8), ("center", "top")),
        ("$d_2$", ((x + goal[0]) / 2, start[1] - 0.8), ("center", "top")),
        ("$d_3$", (x + 1.0, y + 4.0), ("left", "center")),
    ):
        ax.annotate(text, place, ha=align[0], va=align[1], fontsize=6.5, color="0.3")


def _curvature(ax: Axes, movement: Trajectory) -> None:
    profile = model_profile(movement)
    inner = (profile.time > EDGE) & (profile.time < 1.0 - EDGE)
    ax.plot(profile.time[inner], profile.curvature[inner], **MODEL)
    ax.axvline(profile.valley, color="0.6", linewidth=0.7, linestyle=":")
    ax.set(ylabel="$C$ [1/m]", ylim=(0, 1.15 * profile.bend[1]))


def straight_movements() -> Figure:
    """Draw Fig. 3: two straight movements on the model and on the simulated arm."""
    figure, axes = sheet(4, 2, 12.5)
    for column, (a, b) in enumerate((("T3", "T6"), ("T1", "T4"))):
        movement = straight(a, b, DURATION)
        motion = simulate(movement)
        ax = axes[:, column]
        plane(ax[0])
        path(ax[0], movement.sample(101, 0)[0], **MODEL)
        path(ax[0], motion.hand[0], **ARM)
        planned = movement.sample(401)
        time = np.linspace(0.0, DURATION, 401)
        ax[1].plot(time, np.linalg.norm(planned[1], axis=-1), label="model", **MODEL)
        ax[1].plot(motion.time, np.linalg.norm(motion.velocity()[0], axis=-1), label="simulated arm", **ARM)
        for row, axis in ((2, 1), (3, 0)):
            ax[row].plot(time, planned[2][:, axis], **MODEL)
            ax[row].plot(motion.time, motion.acceleration()[0, :, axis], **ARM)
            ax[row].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
        ax[3].set_xlabel("$t$ [s]")
        ax[0].set_title(f"{'AB'[column]}   $T_{a[1]}$ to $T_{b[1]}$", loc="left", pad=3.0)
        for each, limits in zip(ax[1:], ((0, 1.0), (-4.2, 4.2), (-4.2, 4.2)), strict=True):
            each.set(xlim=(0, 0.9), ylim=limits)
    for row, text in ((1, "$T$ [m/s]"), (2, r"$\ddot{y}$ [m/s²]"), (3, r"$\ddot{x}$ [m/s²]")):
        axes[row, 0].set_ylabel(text)
    axes[1, 1].legend(loc="upper right")
    axes[1, 1].set_ylim(0, 1.5)
    axes[1, 0].set_ylim(0, 1.5)
    return figure


def joints() -> Figure:
    """Draw Fig. 4: joint angles, velocities and torques of two movements."""
    figure, axes = sheet(3, 2, 10.0, sharex=True, sharey="row")
    for column, (a, b) in enumerate((("T3", "T6"), ("T2", "T5"))):
        movement = straight(a, b, DURATION)
        _joint_column(axes[:, column], movement, simulate(movement))
        axes[0, column].set_title(f"{'AB'[column]}   $T_{a[1]}$ to $T_{b[1]}$", loc="left", pad=3.0)
        axes[2, column].set(xlabel="$t$ [s]", xlim=(0, DURATION))
    for row, text in enumerate((r"$\theta$ [deg]", r"$\dot{\theta}$ [deg/s]", r"torque [N m]")):
        axes[row, 0].set_ylabel(text)
    axes[0, 0].legend(loc="upper left", handlelength=1.2)
    axes[0, 0].set_ylim(-10, 215)
    return figure


def _joint_column(ax: Float, movement: Trajectory, motion: SimulatedMovements) -> None:
    time = np.linspace(0.0, DURATION, 401)
    plan = joint_motion(movement)
    planned = (plan.position, plan.velocity, required_torque(movement))
    reached = (motion.joints[0], np.gradient(motion.joints[0], motion.time, axis=0), motion.torque[0])
    within = motion.time[:-1] <= DURATION
    for row in range(3):
        scale = np.degrees(1.0) if row < 2 else 1.0
        for joint, (name, colour) in enumerate((("shoulder $S$", SECOND), ("elbow $E$", THIRD))):
            ax[row].plot(time, scale * planned[row][:, joint], color=colour, linewidth=2.0, label=name)
            values = scale * reached[row][: len(within), joint]
            ax[row].plot(motion.time[:-1][within], values[within], **ARM)
        ax[row].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)


ROWS = ("$T$ [m/s]", "$C$ [1/m]", "$V_x$ [m/s]", "$V_y$ [m/s]")


def height() -> Figure:
    """Draw Fig. 5: a via-point half-way, far from the line and nearer to it."""
    return _pair([curved(*ENDS, 0.5, -0.52), curved(*ENDS, 0.5, -0.35)], ("$d_3$ = 0.52", "$d_3$ = 0.35"))


def place() -> Figure:
    """Draw Fig. 6: a via-point nearer to the start and one nearer to the goal."""
    return _pair([curved(*ENDS, 0.3, -0.45), curved(*ENDS, 0.7, -0.45)], ("$d_1$ = 0.3", "$d_1$ = 0.7"))


def turned() -> Figure:
    """Draw Fig. 7: other directions, in which the hand reverses along both axes."""
    movements = [curved("T2", "T5", 0.35, 0.5), curved("T3", "T6", 0.65, -0.5)]
    return _pair(movements, ("$T_2$ to $T_5$", "$T_3$ to $T_6$"))


def scaling() -> Figure:
    """Draw Fig. 11: the same three points in two durations."""
    movements = [curved(*ENDS, *THREE_POINTS, duration) for duration in (SLOW, FAST)]
    return _pair(movements, (f"{SLOW} s", f"{FAST} s"))


def _pair(movements: list[Trajectory], titles: tuple[str, str]) -> Figure:
    """Draw two movements side by side, on the model and on the simulated arm."""
    figure, axes = sheet(5, 2, 14.0)
    for column, (movement, title) in enumerate(zip(movements, titles, strict=True)):
        motion = simulate(movement)
        plane(axes[0, column])
        path(axes[0, column], movement.sample(201, 0)[0], **MODEL)
        path(axes[0, column], motion.hand[0], **ARM)
        dot(axes[0, column], np.asarray(movement(float(movement.knots[1]))))
        _profiles(axes[1:, column], movement, motion)
        axes[0, column].set_title(f"{'AB'[column]}   {title}", loc="left", pad=6.0)
        axes[4, column].set_xlabel("$t$ [s]")
    _same_scales(axes[1:], max(float(each.duration) for each in movements))
    axes[1, 1].legend(loc="upper right")
    return figure


def _profiles(ax: Float, movement: Trajectory, motion: SimulatedMovements) -> None:
    """Draw speed, curvature and velocity components against time; the passage time is dotted."""
    end = float(movement.duration)
    model, arm = model_profile(movement), arm_profile(motion)
    planned, reached = np.asarray(movement.sample(len(model.time), 1)[0]), motion.velocity()[0]
    for profile, style, label in ((model, MODEL, "model"), (arm, ARM, "simulated arm")):
        speed_and_curvature(ax, profile, end, label=label, **style)
    for i in (0, 1):
        ax[2 + i].plot(end * model.time, planned[:, i], **MODEL)
        ax[2 + i].plot(motion.time, reached[:, i], **ARM)
        ax[2 + i].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
    for each in ax:
        each.axvline(float(movement.knots[..., 1]), color=THIRD, linewidth=0.7, linestyle=":")


def _same_scales(axes: Float, duration: float) -> None:
    """Set one scale for each row, with room for the legend above the speed and labels on the left only."""
    for row, text in zip(axes, ROWS, strict=True):
        limits = np.array([each.get_ylim() for each in row])
        low, high = float(limits[:, 0].min()), float(limits[:, 1].max())
        if text in ROWS[:2]:
            low, high = 0.0, high * (1.6 if text == ROWS[0] else 1.05)
        for each in row:
            each.set(xlim=(0, duration), ylim=(low, high))
        row[0].set_ylabel(text)


def obstacles(avoidance: ObstacleMovements) -> Figure:
    """Draw Fig. 8: two movements around rows of lights, and the model through their points of greatest curvature."""
    figure, axes = sheet(3, 2, 10.5)
    found = features(avoidance.executed, avoidance.plan)
    depth = np.array([each.valley_depth for each in avoidance.executed])
    for column, row in enumerate(np.argsort(depth)[[0, len(depth) // 2]].tolist()):
        _obstacle_column(axes[:, column], avoidance, row, found.bend[row])
        axes[0, column].set_title("AB"[column], loc="left", pad=3.0)
        axes[2, column].set_xlabel("$t/t_f$")
    limits = [max(each.get_ylim()[1] for each in axes[row]) for row in (1, 2)]
    for ax in axes[1]:
        ax.set(ylim=(0, 1.5 * limits[0]), xlim=(0, 1))
    for ax in axes[2]:
        ax.set(ylim=(0, limits[1]), xlim=(0, 1))
    axes[1, 0].set_ylabel(ROWS[0])
    axes[2, 0].set_ylabel(ROWS[1])
    axes[1, 1].legend(loc="upper right")
    return figure


def _obstacle_column(ax: Float, avoidance: ObstacleMovements, row: int, bend: float) -> None:
    profile, (start, *_, goal) = avoidance.executed[row], avoidance.plan.waypoints[row]
    via = profile.place(bend)
    end = float(avoidance.motion.duration[row])
    movement = minimum_jerk_through(np.stack((start, via, goal)), end)
    plane(ax[0])
    (lights,) = unpack(avoidance.scenes.obstacles, row)
    ax[0].fill(*(100.0 * footprint(lights)[0].T), color=PALETTE.obstacle)
    path(ax[0], movement.sample(201, 0)[0], **MODEL)
    path(ax[0], profile.position, **ARM)
    dot(ax[0], via)
    model = model_profile(movement)
    for each, style, label in ((model, MODEL, "model through $\\bullet$"), (profile, ARM, avoidance.name)):
        speed_and_curvature(ax[1:], each, label=label, **style)


def valleys() -> Figure:
    """Draw the region with a speed valley, and its distance in time from the curvature peak."""
    figure, axes = sheet(1, 2, 4.6)
    alongs = np.linspace(0.05, 0.95, 37)
    threshold = [valley_threshold(functools.partial(model_has_valley, along)) for along in alongs]
    axes[0, 0].plot(alongs, threshold, **MODEL)
    axes[0, 0].plot(0.5, 9.0 / 32.0, "o", color=THIRD, markersize=3.6)
    axes[0, 0].annotate(
        "9/32", (0.5, 9 / 32), xytext=(0, -8), textcoords="offset points", ha="center", fontsize=6.5
    )
    axes[0, 0].annotate("two peaks, one valley", (0.5, 0.46), ha="center", fontsize=6.5)
    axes[0, 0].annotate("one peak", (0.5, 0.2), ha="center", fontsize=6.5)
    axes[0, 0].set(xlabel="$d_1/(d_1+d_2)$", ylabel="$d_3/(d_1+d_2)$", ylim=(0.1, 0.55), xlim=(0, 1))
    heights = np.linspace(0.4, 1.0, 25)
    for along, colour in ((0.3, PALETTE.plan), (0.4, THIRD), (0.5, PALETTE.executed)):
        profiles = [model_profile(curved(*ENDS, along, -h)) for h in heights]
        axes[0, 1].plot(
            heights, [100 * (p.bend[0] - p.valley) for p in profiles], color=colour, label=f"{along}"
        )
    axes[0, 1].set(
        xlabel="$d_3/(d_1+d_2)$", ylabel="curvature peak\nminus valley [% of $t_f$]", xlim=(0.4, 1.0)
    )
    axes[0, 1].legend(title="$d_1/(d_1+d_2)$")
    letters(axes)
    return figure


DOTS = {"linestyle": "none", "marker": "o", "markersize": 2.2, "color": PALETTE.executed, "zorder": 5}
FAINT = {
    "linestyle": "none",
    "marker": "s",
    "markersize": 1.8,
    "color": GREY,
    "alpha": 0.6,
    "markeredgewidth": 0.0,
}

SUBJECTS = ((-0.004, 0.02), (-0.0006, 0.017))
"""Mean and standard deviation of the residuals in the paper's Figs. 10B and 10D."""


def isochrony(avoidance: ObstacleMovements) -> Figure:
    """Draw Fig. 10: passage times and their residuals on the simulated arm."""
    figure, axes = sheet(2, 2, 8.4)
    found = features(avoidance.executed, avoidance.plan)
    along = np.linspace(0.001, 0.999, 400)
    for height, width in ((0.1, 0.6), (-HEIGHT, 2.2), (1.0, 1.1)):
        share = passage_share(curved(*ENDS, along, height))
        axes[0, 0].plot(along, share, color=PALETTE.plan, linewidth=width, label=f"{height:g}")
    axes[0, 0].plot(found.via[:, 0], found.bend, **FAINT)
    axes[0, 1].plot(found.via[:, 0], found.residual, label=avoidance.name, **FAINT)
    arm, _ = arm_shares(SHARES, np.array(HEIGHT))
    axes[0, 0].plot(SHARES, arm, **DOTS)
    axes[0, 1].plot(
        SHARES, arm - passage_share(curved(*ENDS, SHARES, HEIGHT)), label="arm, via-points", **DOTS
    )
    lengths = np.linspace(0.02, 1.0, 200)
    for typical, colour in ((0.5, SECOND), (TYPICAL, PALETTE.plan), (0.2, THIRD)):
        axes[1, 0].plot(
            lengths, passage_share(curved(*ENDS, typical, lengths)), color=colour, label=f"{typical:g}"
        )
        shares, _ = arm_shares(np.array(typical), -LENGTHS)
        axes[1, 0].plot(LENGTHS, shares, **DOTS)
        axes[1, 1].plot(LENGTHS, shares - passage_share(curved(*ENDS, typical, -LENGTHS)), **DOTS)
    _label_isochrony(axes)
    return figure


def _label_isochrony(axes: Float) -> None:
    for row, text in enumerate(("$d_1/(d_1+d_2)$", "$d_3/(d_1+d_2)$")):
        axes[row, 0].set(
            xlabel=text, ylabel="$t_1/(t_1+t_2)$", xlim=(0, 1), ylim=(0.2, 0.8) if row == 0 else (0.2, 0.55)
        )
        axes[row, 1].set(xlabel=text, ylabel="residual", xlim=(0, 1), ylim=(-0.04, 0.04))
        mean, deviation = SUBJECTS[row]
        axes[row, 1].axhspan(mean - deviation, mean + deviation, color="0.92", zorder=0)
        axes[row, 1].axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
    axes[1, 1].annotate("grey band:\nsubjects, mean ± s.d.", (0.02, -0.037), fontsize=5.8)
    axes[0, 0].legend(title="$d_3/(d_1+d_2)$", title_fontsize=6.0, loc="upper left", handlelength=1.2)
    axes[0, 1].legend(loc="upper center", handletextpad=0.2)
    axes[1, 0].legend(title="$d_1/(d_1+d_2)$", title_fontsize=6.0, loc="lower right", handlelength=1.2)
    letters(axes, "ABCD")


def alternatives() -> Figure:
    """Draw speed and acceleration of the three orders, and hand paths of minimum joint jerk."""
    figure, axes = sheet(2, 2, 8.4)
    time = np.linspace(0.0, 1.0, 401)
    styles = {2: (THIRD, 1.2), 3: (PALETTE.plan, 2.2), 4: (SECOND, 1.2)}
    for order, (colour, width) in styles.items():
        movement = straight("T1", "T4", 1.0, order=order)
        for ax, nu in ((axes[0, 0], 1), (axes[0, 1], 2)):
            ax.plot(
                time, movement(time, nu)[:, 0] / 0.4, color=colour, linewidth=width, label=PEAKS[order][0]
            )
    axes[0, 0].axhspan(1.805 - 0.153, 1.805 + 0.153, color="0.9", zorder=0)
    axes[0, 0].annotate("peak of\nsubjects", (0.02, 1.8), fontsize=5.5, va="center")
    axes[0, 0].set(ylabel=r"$T\;t_f/A$", xlabel="$t/t_f$", xlim=(0, 1), ylim=(0, 2.4))
    axes[0, 1].set(ylabel=r"$\ddot{x}\;t_f^2/A$", xlabel="$t/t_f$", xlim=(0, 1), ylim=(-9, 19))
    axes[0, 1].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
    axes[0, 1].legend(title="least", loc="upper right", handlelength=1.2)
    for ax, motion in ((axes[1, 0], None), (axes[1, 1], joint_space(diagonal_ends()))):
        plane(ax)
        for row, (start, goal) in enumerate(diagonal_ends()):
            line = np.stack((start, goal)) if motion is None else motion.planned[row]
            path(ax, line, **MODEL)
            executed = (
                simulate(point_to_point(start, goal, 0.8)).hand[0] if motion is None else motion.hand[row]
            )
            path(ax, executed, **ARM)
    letters(axes, "ABCD")
    return figure


def limits() -> Figure:
    """Draw a repetitive movement, and torques at the limit and beyond."""
    figure, axes = sheet(2, 2, 8.0)
    movement = swings()
    motion = simulate(movement)
    _repetitive(axes[0, 0], motion.time, np.linalg.norm(motion.velocity()[0], axis=-1))
    fastest = torque_limited()
    for column, (ax, factor) in enumerate(((axes[1, 0], 1.0), (axes[1, 1], HURRY))):
        each = simulate(fastest.stretched(factor * fastest.duration))
        for joint, (name, colour) in enumerate((("shoulder $S$", SECOND), ("elbow $E$", THIRD))):
            limit = ADULT.torque_limit[joint]
            ax.plot(1e3 * each.time[:-1], each.torque[0, :, joint], color=colour, label=name)
            for sign in (-1, 1):
                ax.axhline(sign * limit, color=colour, linewidth=0.6, linestyle=":")
        ax.set(xlabel="$t$ [ms]", xlim=(0, 250), ylim=(-75, 120))
        if column == 0:
            ax.set_ylabel("torque [N m]")
            ax.legend(loc="upper right", handlelength=1.2)
        style = {**ARM, "linestyle": "-" if column == 0 else (0, (2, 1))}
        path(axes[0, 1], each.hand[0], **style)
    plane(axes[0, 1], names=("T3", "T6"))
    axes[0, 1].annotate("at the\nlimit", (-16.0, 38.0), ha="right", fontsize=6.0)
    axes[0, 1].annotate(f"in {HURRY} of\nthe time", (-4.0, 46.0), fontsize=6.0)
    letters(axes, "ABCD")
    return figure


def _repetitive(ax: Axes, time: Float, speed: Float) -> None:
    amplitude = float(np.linalg.norm(target("T6") - target("T3")))
    scale = SWING / amplitude
    ax.plot(time / SWING, speed * scale, **MODEL, label="least jerk, arm")
    inner = np.linspace(3.0, 5.0, 201)
    ax.plot(inner, np.pi / 2 * np.abs(np.sin(np.pi * inner)), label="sinusoid", **ARM)
    ax.set(xlabel="half cycles", ylabel=r"$T\;t_f/A$", xlim=(0, SWINGS), ylim=(0, 2.5))
    ax.legend(loc="upper right", ncols=1)


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
    moments = np.linspace(0.005, STEP_DURATION - 0.02, 60)
    for remaining, width in zip(SECONDS, (2.2, 1.3, 0.7), strict=True):
        every = [double_step(float(moment), remaining=remaining) for moment in moments]
        style = {"color": PALETTE.contact, "linewidth": width, "label": f"{remaining:g} s"}
        axes[0, 1].plot(moments, [each.ratio for each in every], **style)
        axes[1, 0].plot(moments, [100.0 * greatest_distance(each) for each in every], **style)
        if remaining == STEP_DURATION:
            _peaks(axes[1, 1], moments, every)
    axes[0, 1].axhline(1.0, color="0.6", linewidth=0.6, linestyle=":", zorder=0)
    axes[0, 1].set(ylabel="jerk cost, sum / plan", ylim=(0.0, 14.0), yticks=[1, 5, 10])
    axes[0, 1].legend(title="second movement", loc="upper right", handlelength=1.2)
    axes[1, 0].set(ylabel="greatest distance [cm]", ylim=(0.0, 15.0), yticks=[0, 5, 10, 15])
    for ax in (axes[0, 1], axes[1, 0], axes[1, 1]):
        ax.set(xlabel="revised at [s]", xlim=(0.0, STEP_DURATION))
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
