"""Figures 5 to 8 and 11: hand path, speed, curvature and velocity components of curved movements."""

from __future__ import annotations

import functools

import numpy as np
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory
from viapoint.training.paper.figures.style import ARM, MODEL, THIRD, dot, letters, path, plane, sheet
from viapoint.training.paper.profiles import EDGE, arm_profile, model_profile
from viapoint.training.paper.reference_movements import curved, minimum_jerk_through
from viapoint.training.paper.rows.curved import ENDS, model_has_valley, valley_threshold
from viapoint.training.paper.rows.obstacles import ObstacleMovements, features
from viapoint.training.paper.rows.timing import FAST, SLOW, THREE_POINTS
from viapoint.training.paper.simulated import SimulatedMovements, simulate
from viapoint.training.plotting.top_view import capsule

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
        inner = (profile.time > EDGE) & (profile.time < 1.0 - EDGE)
        ax[0].plot(end * profile.time, profile.speed, label=label, **style)
        ax[1].plot(end * profile.time[inner], profile.curvature[inner], **style)
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
    found = features(avoidance.executed, avoidance.scenes)
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
    profile, scene = avoidance.executed[row], avoidance.scenes.take([row])
    via = profile.place(bend)
    end = float(avoidance.motion.duration[row])
    movement = minimum_jerk_through(np.stack((scene.start[0], via, scene.goal[0])), end)
    plane(ax[0])
    centre, half, radius = scene.obstacles[0, 0, :2], scene.obstacles[0, 0, 2:4], scene.obstacles[0, 0, 4]
    ax[0].fill(*(100.0 * capsule(centre - half, centre + half, float(radius)).T), color=PALETTE.obstacle)
    path(ax[0], movement.sample(201, 0)[0], **MODEL)
    path(ax[0], profile.position, **ARM)
    dot(ax[0], via)
    model = model_profile(movement)
    for each, style, label in ((model, MODEL, "model through $\\bullet$"), (profile, ARM, avoidance.name)):
        inner = (each.time > EDGE) & (each.time < 1.0 - EDGE)
        ax[1].plot(each.time, each.speed, label=label, **style)
        ax[2].plot(each.time[inner], each.curvature[inner], **style)


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
