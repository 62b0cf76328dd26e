"""Figures 1, 3 and 4."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from viapoint.envs.arms.planar import ADULT
from viapoint.envs.common.types import Float
from viapoint.primitives import Trajectory
from viapoint.training.paper.figures.style import ARM, MODEL, SECOND, THIRD, dot, letters, path, plane, sheet
from viapoint.training.paper.profiles import EDGE, model_profile
from viapoint.training.paper.reference_movements import curved, straight
from viapoint.training.paper.rows.curved import ENDS, EXAMPLE
from viapoint.training.paper.rows.straight import DURATION
from viapoint.training.paper.simulated import SimulatedMovements, joint_velocity, required_torque, simulate


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
    position, velocity = movement.sample(401, (0, 1))
    angle = np.asarray(ADULT.inverse_kinematics(position))
    planned = (angle, joint_velocity(angle, velocity), required_torque(movement))
    reached = (motion.joints[0], np.gradient(motion.joints[0], motion.time, axis=0), motion.torque[0])
    within = motion.time[:-1] <= DURATION
    for row in range(3):
        scale = np.degrees(1.0) if row < 2 else 1.0
        for joint, (name, colour) in enumerate((("shoulder $S$", SECOND), ("elbow $E$", THIRD))):
            ax[row].plot(time, scale * planned[row][:, joint], color=colour, linewidth=2.0, label=name)
            values = scale * reached[row][: len(within), joint]
            ax[row].plot(motion.time[:-1][within], values[within], **ARM)
        ax[row].axhline(0.0, color="0.8", linewidth=0.6, zorder=0)
