"""Figure 10, and figures of statements in the text: alternatives and limits."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from viapoint.envs.arms.planar import ADULT
from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Float
from viapoint.primitives import point_to_point
from viapoint.training.paper.figures.style import ARM, GREY, MODEL, SECOND, THIRD, letters, path, plane, sheet
from viapoint.training.paper.reference_movements import curved, passage_share, straight, target
from viapoint.training.paper.rows.alternatives import PEAKS, diagonal_ends, joint_space
from viapoint.training.paper.rows.curved import ENDS
from viapoint.training.paper.rows.limits import HURRY, SWING, SWINGS, swings, torque_limited
from viapoint.training.paper.rows.obstacles import ObstacleMovements, features
from viapoint.training.paper.rows.timing import HEIGHT, LENGTHS, SHARES, TYPICAL, arm_shares
from viapoint.training.paper.simulated import simulate

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
    found = features(avoidance.executed, avoidance.scenes)
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
