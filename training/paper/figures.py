"""Figures of the reproduction: one column of 8.5 cm, and one colour for each quantity."""

from __future__ import annotations

import functools
import itertools
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from viapoint import primitives
from viapoint.envs.common.arrays import Float
from viapoint.envs.common.palette import PALETTE
from viapoint.envs.geometry.obstacles import unpack
from viapoint.training.files import parse_yaml
from viapoint.training.paper import double_step, movements, one_via, point_to_point
from viapoint.training.paper.movements import TARGETS, Profile, curved, passage_share, simulate, straight
from viapoint.training.paper.obstacles import ObstacleMovements, features
from viapoint.training.paper.one_via import ENDS
from viapoint.training.paper.point_to_point import DIAGONALS, DURATION, diagonals
from viapoint.training.plots import COLUMN

COVERED = 0.04  # Distance of a target from a row of lights up to which it is not drawn, [m]
# Style of the model: a wide light line that stays visible beside the arm
MODEL: dict[str, Any] = {"color": PALETTE.plan, "linewidth": 2.2, "solid_capstyle": "round"}
# Style of the simulated arm
ARM: dict[str, Any] = {"color": PALETTE.executed, "linewidth": 0.9, "linestyle": (0, (4, 1.5))}
# Style of via-points
VIA: dict[str, Any] = {
    "color": PALETTE.via, "linestyle": "none", "marker": "o", "markersize": 3.6, "zorder": 5
}  # fmt: skip
SECOND = PALETTE.goal
THIRD = PALETTE.via
GREY = PALETTE.start
JOINTS = (("shoulder $S$", SECOND), ("elbow $E$", THIRD))


FIGURES: dict[str, Any] = parse_yaml((files(__package__) / "figures.yaml").read_bytes())["figures"]
# Arguments of `curved` for figures of two movements
PAIRS: dict[str, Any] = {
    "fig05_height": ((*ENDS, 0.5, -0.52), (*ENDS, 0.5, -0.35)),
    "fig06_place": ((*ENDS, 0.3, -0.45), (*ENDS, 0.7, -0.45)),
    "fig07_turned": (("T2", "T5", 0.35, 0.5), ("T3", "T6", 0.65, -0.5)),
    "fig11_scaling": (
        (*ENDS, *one_via.THREE_POINTS, one_via.SLOW),
        (*ENDS, *one_via.THREE_POINTS, one_via.FAST),
    ),
}


def sheet(name: str, **options: Any) -> tuple[Figure, Any]:
    """Return a figure of one column and its axes, shape (rows, columns), with the settings in `figures.yaml`."""
    rows = FIGURES[name]["rows"]
    figure = Figure(figsize=(COLUMN / 2.54, FIGURES[name]["height"] / 2.54))
    axes = figure.subplots(len(rows), len(rows[0]), squeeze=False, **options)
    for ax, settings in zip(axes.flat, itertools.chain(*rows), strict=True):
        ax.set(**settings)
    return figure, axes


def targets(ax: Axes, *, names: tuple[str, ...] = tuple(TARGETS)) -> None:
    """Draw the paper's targets in the horizontal plane, in centimetres."""
    for name in names:
        x, y = 100.0 * TARGETS[name]
        ax.plot(x, y, "o", color="white", markeredgecolor=GREY, markersize=5.0, markeredgewidth=0.8, zorder=1)
        low = y < 35.0
        ax.annotate(
            f"$T_{name[1]}$", (x, y), xytext=(0, -4 if low else 4), textcoords="offset points", fontsize=6.5,
            ha="center", va="top" if low else "bottom", color=GREY, zorder=4,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
        )  # fmt: skip


def path(ax: Axes, position: Any, **style: Any) -> None:
    """Draw a hand path, shape (T, 2), [m]."""
    ax.plot(*(100.0 * position.T), **style)


def paths(ax: Axes, planned: Float, hand: Float) -> None:
    """Draw the hand path of a plan and that of the simulated arm, shape (T, 2), [m]."""
    path(ax, planned, **MODEL)
    path(ax, hand, **ARM)


def _dot(ax: Axes, point: Any) -> None:
    """Draw a via-point, shape (2,), [m]."""
    ax.plot(*(100.0 * point), **VIA)


def zero(ax: Axes) -> None:
    """Draw a line at zero behind everything."""
    ax.axhline(0.0, color="0.8", linewidth=0.6, zorder=0)


def model() -> Figure:
    """Draw Fig. 1: a straight and a curved movement of the model."""
    figure, axes = sheet("fig01_model")
    first = straight("T2", "T5", 1.0)
    second = curved(*ENDS, *one_via.EXAMPLE)
    for ax, movement in ((axes[0], first), (axes[1], second)):
        (profile,) = movements.model_profiles(movement)
        targets(ax[0])
        path(ax[0], profile.position, zorder=2.1, **MODEL)
        ax[1].plot(profile.time, profile.speed / profile.speed.max(), **MODEL)
    via = second(float(second.knots[1]))
    _dot(axes[1, 0], via)
    # The construction of d1, d2 and d3, in centimetres
    start, (x, y), goal = 100.0 * second(0.0), 100.0 * via, 100.0 * second(1.0)
    thin: Any = {"color": "0.45", "linewidth": 0.6}
    axes[1, 0].plot([start[0], goal[0]], [start[1], goal[1]], **thin)
    axes[1, 0].plot([x, x], [start[1], y], **thin)
    label = functools.partial(axes[1, 0].annotate, fontsize=6.5, color="0.3")
    label("$d_1$", ((start[0] + x) / 2, start[1] - 0.8), ha="center", va="top")
    label("$d_2$", ((x + goal[0]) / 2, start[1] - 0.8), ha="center", va="top")
    label("$d_3$", (x + 1.0, y + 4.0), ha="left", va="center")
    axes[2, 0].plot(profile.time, profile.curvature, **MODEL)
    axes[2, 0].axvline(profile.valley[0], color="0.6", linewidth=0.7, linestyle=":")
    axes[2, 0].set_ylim(0, 1.15 * profile.bend[1])
    for values, name, colour in zip(profile.velocity.T, ("$V_x$", "$V_y$"), (SECOND, THIRD), strict=True):
        axes[2, 1].plot(profile.time, values, color=colour, label=name, linewidth=1.6)
    zero(axes[2, 1])
    axes[2, 1].legend(loc="upper right", handlelength=1.2)
    return figure


def straight_movements() -> Figure:
    """Draw Fig. 3: two straight movements on the model and on the simulated arm."""
    figure, axes = sheet("fig03_straight")
    time = np.linspace(0.0, DURATION, 401)
    movement = diagonals()
    motion = simulate(movement)
    planned = movement(time, 2)
    reached = motion.derivative(motion.derivative(motion.hand))
    for row, ax in enumerate(axes.T):
        targets(ax[0])
        paths(ax[0], motion.planned[row], motion.hand[row])
        ax[1].plot(time, primitives.speed(movement, time)[row], label="model", **MODEL)
        ax[1].plot(motion.time, motion.speed()[row], label="simulated arm", **ARM)
        for each, axis in ((ax[2], 1), (ax[3], 0)):
            each.plot(time, planned[row, :, axis], **MODEL)
            each.plot(motion.time, reached[row, :, axis], **ARM)
            zero(each)
    axes[1, 1].legend(loc="upper right")
    return figure


def joints() -> Figure:
    """Draw Fig. 4: joint angles, velocities and torques of two movements."""
    figure, axes = sheet("fig04_joints", sharex=True, sharey="row")
    movement = diagonals()
    motion = simulate(movement)
    time = np.linspace(0.0, DURATION, 401)
    angles, rates, _ = map(np.degrees, movements.joint_motion(movement))
    reached = np.degrees(motion.joints)
    quantities = (
        (angles, reached),
        (rates, motion.derivative(reached)),
        (movements.required_torque(movement), motion.torque),
    )
    within = np.flatnonzero(motion.time[:-1] <= DURATION)
    for pair_of_axes, (model, arm) in zip(axes, quantities, strict=True):
        for ax, row in zip(pair_of_axes, (0, 2), strict=True):
            for joint, (name, colour) in enumerate(JOINTS):
                ax.plot(time, model[row, :, joint], color=colour, linewidth=2.0, label=name)
                ax.plot(motion.time[within], arm[row, within, joint], **ARM)
            zero(ax)
    axes[0, 0].legend(loc="upper left", handlelength=1.2)
    return figure


def _two_movements(name: str) -> tuple[Figure, Any]:
    """Return a sheet for the paths of two movements and for `profiles`, with one scale in each row of these."""
    figure, axes = sheet(name)
    for left, right in axes[1:]:
        right.sharey(left)
    return figure, axes


def profiles(axes: Any, model: Profile, arm: Profile, end: float) -> None:
    """Draw speed, curvature and velocities on as many axes as there are."""
    for profile, style, name in ((model, MODEL, "model"), (arm, ARM, "simulated arm")):
        quantities = (profile.speed, profile.curvature, *profile.velocity.T)
        for ax, values in zip(axes, quantities, strict=False):
            ax.plot(end * profile.time, values, label=name, **style)


def _finish(axes: Any, duration: float) -> None:
    """Begin the scales at zero, with room for the legend above the speed."""
    for ax in axes.flat:
        ax.set_xlim(0, duration)
    axes[0, 0].set_ylim(0, 1.6 * axes[0, 0].get_ylim()[1])
    axes[1, 0].set_ylim(0, 1.05 * axes[1, 0].get_ylim()[1])
    axes[0, 1].legend(loc="upper right")


def pair(name: str) -> Figure:
    """Draw two movements of PAIRS side by side, on the model and on the simulated arm."""
    figure, axes = _two_movements(name)
    plans = [curved(*each) for each in PAIRS[name]]
    for ax, movement in zip(axes.T, plans, strict=True):
        motion = simulate(movement)
        passage = float(movement.knots[1])
        targets(ax[0])
        paths(ax[0], motion.planned[0], motion.hand[0])
        _dot(ax[0], movement(passage))
        (model,) = movements.model_profiles(movement)
        (arm,) = movements.arm_profiles(motion)
        profiles(ax[1:], model, arm, float(movement.duration))
        for each in ax[1:]:
            each.axvline(passage, color=THIRD, linewidth=0.7, linestyle=":")
        for each in ax[3:]:
            zero(each)
    _finish(axes[1:], max(float(each.duration) for each in plans))
    return figure


def around_lights(avoidance: ObstacleMovements) -> Figure:
    """Draw Fig. 8: two movements around rows of lights, and the model through their points of greatest curvature."""
    figure, axes = _two_movements("fig08_obstacles")
    depth = np.array([each.valley[1] for each in avoidance.profiles])
    for ax, row in zip(axes.T, np.argsort(depth)[[0, len(depth) // 2]].tolist(), strict=True):
        profile, (start, *_, goal) = avoidance.profiles[row], avoidance.plan.waypoints[row]
        via = profile.place(profile.bend[0])
        duration = avoidance.motion.duration[row]
        (model,) = movements.model_profiles(movements.minimum_jerk_through((start, via, goal), duration))
        (lights,) = unpack(avoidance.scenes.obstacles, row)
        away = lights.distance(np.array([[*place, 0.0] for place in TARGETS.values()]))
        clear = [name for name, distance in zip(TARGETS, away, strict=True) if distance > COVERED]
        targets(ax[0], names=tuple(clear))  # labels of the others would lie on the lights
        paths(ax[0], model.position, profile.position)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * lights.packed_size[:2]
        outline = corners @ lights.rotation[:2, :2].T + lights.position[:2]
        ax[0].fill(*(100.0 * outline.T), color=PALETTE.obstacle)
        _dot(ax[0], via)
        profiles(ax[1:], model, profile, 1.0)
        ax[1].plot([], [], label="via-point", **VIA)
    _finish(axes[1:], 1.0)
    return figure


def valleys() -> Figure:
    """Draw the region with a speed valley, and its distance in time from the curvature peak."""
    figure, axes = sheet("valleys")
    region, late = axes[0]
    alongs = np.linspace(0.05, 0.95, 37)
    heights = np.linspace(0.4, 1.0, 25)
    region.plot(alongs, [one_via.valley_threshold(along) for along in alongs], **MODEL)
    region.plot(0.5, 9.0 / 32.0, "o", color=THIRD, markersize=3.6)
    label = functools.partial(region.annotate, ha="center", fontsize=6.5)
    label("9/32", (0.5, 9 / 32), xytext=(0, -8), textcoords="offset points")
    label("two peaks, one valley", (0.5, 0.46))
    label("one peak", (0.5, 0.2))
    for along, colour in ((0.3, PALETTE.plan), (0.4, THIRD), (0.5, PALETTE.executed)):
        family = movements.model_profiles(curved(*ENDS, along, -heights))
        late.plot(heights, [100 * (p.bend[0] - p.valley[0]) for p in family], color=colour, label=f"{along}")
    late.legend(title="$d_1/(d_1+d_2)$")
    return figure


DOTS: dict[str, Any] = {
    "linestyle": "none", "marker": "o", "markersize": 2.2, "color": PALETTE.executed, "zorder": 5,
}  # fmt: skip
FAINT: dict[str, Any] = {
    "linestyle": "none", "marker": "s", "markersize": 1.8, "color": GREY, "alpha": 0.6, "markeredgewidth": 0.0,
}  # fmt: skip
SUBJECTS = ((-0.004, 0.02), (-0.0006, 0.017))  # Mean and s.d. of residuals in Figs. 10B and 10D


def isochrony(avoidance: ObstacleMovements) -> Figure:
    """Draw Fig. 10: passage times and their residuals on the simulated arm."""
    figure, axes = sheet("fig10_isochrony")
    (over_place, place_residual), (over_height, height_residual) = axes
    alongs = np.linspace(0.001, 0.999, 400)
    heights = np.linspace(0.02, 1.0, 200)
    for height, colour in ((1.0, SECOND), (-one_via.HEIGHT, PALETTE.plan), (0.1, THIRD)):
        share = passage_share(curved(*ENDS, alongs, height))
        over_place.plot(alongs, share, color=colour, label=f"{height:g}")
    found = features(avoidance.profiles, avoidance.plan)
    over_place.plot(found.along, found.bend, **FAINT)
    place_residual.plot(found.along, found.residual, label="around lights", **FAINT)
    arm, _ = one_via.arm_shares(one_via.SHARES, one_via.HEIGHT)
    over_place.plot(one_via.SHARES, arm, **DOTS)
    residual = arm - passage_share(curved(*ENDS, one_via.SHARES, one_via.HEIGHT))
    place_residual.plot(one_via.SHARES, residual, label="arm, via-points", **DOTS)
    for along, colour in ((0.5, SECOND), (one_via.TYPICAL, PALETTE.plan), (0.2, THIRD)):
        share = passage_share(curved(*ENDS, along, heights))
        over_height.plot(heights, share, color=colour, label=f"{along:g}")
        arm, _ = one_via.arm_shares(along, -one_via.LENGTHS)
        over_height.plot(one_via.LENGTHS, arm, **DOTS)
        model = passage_share(curved(*ENDS, along, -one_via.LENGTHS))
        height_residual.plot(one_via.LENGTHS, arm - model, **DOTS)
    for ax, (mean, deviation) in zip(axes[:, 1], SUBJECTS, strict=True):
        ax.axhspan(mean - deviation, mean + deviation, color="0.92", zorder=0)
        ax.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
    height_residual.annotate("grey band:\nsubjects, mean ± s.d.", (0.02, -0.037), fontsize=5.8)
    small = {"title_fontsize": 6.0, "handlelength": 1.2}
    over_place.legend(title="$d_3/(d_1+d_2)$", loc="upper left", **small)
    over_height.legend(title="$d_1/(d_1+d_2)$", loc="lower right", **small)
    place_residual.legend(loc="upper center", handletextpad=0.2)
    return figure


def orders_and_spaces() -> Figure:
    """Draw speed and acceleration of the three orders, and hand paths of minimum joint jerk."""
    figure, axes = sheet("alternatives")
    time = np.linspace(0.0, 1.0, 401)
    for order, colour, width in ((2, THIRD, 1.2), (3, PALETTE.plan, 2.2), (4, SECOND, 1.2)):
        movement = straight("T1", "T4", 1.0, order=order)
        style = {"color": colour, "linewidth": width, "label": point_to_point.PEAKS[order][0]}
        for ax, nu in zip(axes[0], (1, 2), strict=True):
            ax.plot(time, movement(time, nu)[:, 0] / 0.4, **style)
    axes[0, 0].axhspan(1.805 - 0.153, 1.805 + 0.153, color="0.9", zorder=0)
    axes[0, 0].annotate("peak of\nsubjects", (0.02, 1.8), fontsize=5.5, va="center")
    zero(axes[0, 1])
    axes[0, 1].legend(title="least", loc="upper right", handlelength=1.2)
    motions = (simulate(diagonals()), point_to_point.joint_space(DIAGONALS))
    for ax, motion in zip(axes[1], motions, strict=True):
        targets(ax)
        for planned, hand in zip(motion.planned, motion.hand, strict=True):
            paths(ax, planned, hand)
    return figure


def limits() -> Figure:
    """Draw a repetitive movement, and torques at the limit and beyond."""
    figure, axes = sheet("limits")
    (repetitive, both), torques = axes
    motion = simulate(point_to_point.swings())
    cycles = np.linspace(3.0, 5.0, 201)
    speed = motion.speed()[0] * (point_to_point.SWING / point_to_point.LENGTHS[0])
    repetitive.plot(motion.time / point_to_point.SWING, speed, **MODEL, label="least jerk, arm")
    repetitive.plot(cycles, np.pi / 2 * np.abs(np.sin(np.pi * cycles)), label="sinusoid", **ARM)
    repetitive.legend(loc="upper right", ncols=1)
    fastest = point_to_point.torque_limited()
    for ax, factor, dashes in zip(torques, (1.0, point_to_point.HURRY), ("-", (0, (2, 1))), strict=True):
        motion = simulate(fastest.stretched(factor * fastest.duration))
        path(both, motion.hand[0], **{**ARM, "linestyle": dashes})
        for joint, (name, colour) in enumerate(JOINTS):
            limit = movements.ADULT.torque_limit[joint]
            ax.plot(1e3 * motion.time[:-1], motion.torque[0, :, joint], color=colour, label=name)
            for sign in (-1, 1):
                ax.axhline(sign * limit, color=colour, linewidth=0.6, linestyle=":")
    torques[0].legend(loc="upper right", handlelength=1.2)
    targets(both, names=("T3", "T6"))
    both.annotate("at the\nlimit", (-16.0, 38.0), ha="right", fontsize=6.0)
    both.annotate(f"in {point_to_point.HURRY} of\nthe time", (-4.0, 46.0), fontsize=6.0)
    return figure


SUM: dict[str, Any] = {"color": PALETTE.contact, "linewidth": 1.1}  # Style of the superposition
# Style of its two parts
PART: dict[str, Any] = {"color": PALETTE.contact, "linewidth": 0.6, "linestyle": ":"}
NOW: dict[str, Any] = {"color": THIRD, "linewidth": 0.8}  # Style of the moment of revision


def paths_and_speeds() -> Figure:
    """Draw hand paths and speeds for four moments of revision."""
    moments = double_step.MOMENTS
    figure, axes = sheet("double_step", width_ratios=(1.25, 1.0), sharex="col", sharey="col")
    for (left, right), moment in zip(axes, moments, strict=True):
        movement = double_step.double_step(moment)
        motion = double_step.simulate_double(movement)
        time = np.linspace(0.0, movement.arrival, 601)
        targets(left, names=double_step.NAMES)
        path(left, movement.planned(time), **MODEL)
        path(left, motion.hand[1], **ARM)
        path(left, movement.superposed(time), **SUM)
        _dot(left, movement.first(moment))
        left.annotate(f"{1e3 * moment:.0f} ms", (-33.5, 52.5), color=THIRD, fontweight="bold")
        right.plot(time, np.hypot(*movement.planned(time, 1).T), label="plan revised", **MODEL)
        right.plot(motion.time, motion.speed()[1], label="simulated arm", **ARM)
        right.plot(time, np.hypot(*movement.superposed(time, 1).T), label="sum", **SUM)
        for begins, each in ((0.0, movement.first), (moment, movement.second)):
            own = np.linspace(0.0, float(each.duration), 201)
            label = None if begins else "its parts"
            right.plot(begins + own, primitives.speed(each, own), label=label, **PART)
        right.axvline(moment, **NOW)
    lines, names = axes[0, 1].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside upper center", ncols=4, handlelength=1.8, columnspacing=1.4)
    return figure


def comparison() -> Figure:
    """Draw the cost of the sum and its distance from the plan against the moment of revision."""
    figure, axes = sheet("double_step_jerk")
    (jerk, cost), (distance, peaks) = axes
    movement = double_step.double_step(0.2)
    time = np.linspace(0.0, movement.arrival, 1_801)
    jerk.plot(time, movement.planned(time, 3)[:, 0], **MODEL, label="plan revised")
    jerk.plot(time, movement.superposed(time, 3)[:, 0], **SUM, label="sum")
    jerk.axvline(movement.moment, **NOW)
    zero(jerk)
    jerk.legend(loc="upper right", handlelength=1.4)
    usual = double_step.STEP_DURATION
    moments = np.linspace(0.005, usual - 0.02, 60)
    for remaining, width in ((usual, 2.2), (0.85, 1.3), (1.0, 0.7)):
        every = [double_step.double_step(float(moment), remaining=remaining) for moment in moments]
        apart = [100.0 * double_step.greatest_distance(each) for each in every]
        style = {"color": PALETTE.contact, "linewidth": width, "label": f"{remaining:g} s"}
        cost.plot(moments, [each.cost("superposed") / each.cost("planned") for each in every], **style)
        distance.plot(moments, apart, **style)
        if remaining == usual:
            for way, line, name in (("planned", MODEL, "plan revised"), ("superposed", SUM, "sum")):
                peaks.plot(moments, [double_step.peak_speed(each, way) for each in every], **line, label=name)
            peaks.axhline(every[0].first.peak(1), color=SECOND, linewidth=0.8, linestyle=":", label="no jump")
    cost.axhline(1.0, color="0.6", linewidth=0.6, linestyle=":", zorder=0)
    cost.legend(title="second movement", loc="upper right", handlelength=1.2)
    peaks.legend(loc="lower right", handlelength=1.2)
    return figure
