"""Top view of scenes and movements with Matplotlib, for figures and for machines without OpenGL."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.arms.base import Arm, CollisionModel
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import obstacles_from_rows
from viapoint.envs.rendering.overlay import FirstContact, Movement
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Rollout

VIEW = ((-0.56, 0.48), (-0.14, 0.90))
"""Limits of x and y, [m]."""
GOAL_RADIUS, START_RADIUS = 0.026, 0.018
"""Radii of the drawn circles, [m]."""


def draw_movement(
    axes: Axes,
    arm: Arm,
    scene: Scenes,
    plan: Plan | None = None,
    rollout: Rollout | None = None,
    *,
    whole_arm: bool = False,
    step: int | None = None,
    arm_shown: bool = True,
    view: tuple[tuple[float, float], tuple[float, float]] = VIEW,
    scale: float = 1.0,
) -> None:
    """Draw a scene and, if given, a plan and its execution.

    Args:
        axes: Axes to draw on; their frame and ticks are removed.
        arm: Arm of the task.
        scene: One scene.
        plan: One plan, drawn as its path and via-points.
        rollout: Its execution, drawn as the path, the first contact, and the posture there or at the end.
        whole_arm: True where the links can touch obstacles, too.
        step: Last state that is drawn, 0 for the start; None for the whole movement.
        arm_shown: False to leave out the arm.
        view: Limits of x and y, [m].
        scale: Factor on line widths.
    """
    _prepare(axes, view)
    _draw_ends(axes, scene, scale)
    if plan is not None:
        _draw_plan(axes, plan, scale)
    joints, hand, contact = np.asarray(arm.inverse_kinematics(scene.start))[0], scene.start[0], None
    if plan is not None and rollout is not None:
        movement = Movement.of(CollisionModel(arm, whole_arm), scene, plan, rollout)
        last = len(movement.hand) - 1 if step is None else step
        _draw_execution(axes, movement, last, scale)
        contact = movement.contact if movement.contact is not None and last >= movement.contact.step else None
        pose = contact.step if contact is not None and step is None else last
        joints, hand = movement.joints[pose], movement.hand[pose]
    _draw_obstacles(axes, arm, scene, None if contact is None else contact.obstacle)
    if arm_shown:
        _draw_arm(axes, arm, joints, above=not whole_arm)
        colour = PALETTE.contact if contact is not None and contact.link is None else PALETTE.executed
        axes.add_patch(Circle(_xy(hand), arm.hand_radius, color=colour, linewidth=0, zorder=7))
    if contact is not None:
        _draw_contact(axes, contact, scale)


def capsule(first: Float, second: Float, radius: float) -> Float:
    """Return the outline of a capsule in the plane, shape (66, 2), [m]."""
    along = np.arctan2(*(second - first)[1::-1]) if np.any(first != second) else 0.0
    angle = along + np.linspace(-np.pi / 2, np.pi / 2, 33)
    arc = radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    return np.concatenate((second[:2] + arc, first[:2] - arc))


def widened_outline(outline: Float, distance: float) -> Float:
    """Return the outline of all points within a distance of a convex outline, shape (K, 2) both, [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    circle = distance * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    points = (outline[:, None] + circle).reshape(-1, 2)
    return np.asarray(points[ConvexHull(points).vertices])


def _prepare(axes: Axes, view: tuple[tuple[float, float], tuple[float, float]]) -> None:
    axes.set(xlim=view[0], ylim=view[1], xticks=[], yticks=[], aspect="equal", facecolor=PALETTE.table)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for axis, limits in zip("xy", view, strict=True):
        lines: Any = axes.axvline if axis == "x" else axes.axhline
        for place in np.arange(np.ceil(limits[0] * 10), np.floor(limits[1] * 10) + 1) / 10:
            lines(place, color="black", alpha=0.045, linewidth=0.8, zorder=0)


def _draw_obstacles(axes: Axes, arm: Arm, scene: Scenes, touched: int | None) -> None:
    """Draw footprints with a rim of the hand's radius, which the centre of the hand must not enter."""
    rows = np.flatnonzero(scene.present[0])
    for row, shape in zip(rows, obstacles_from_rows(scene.obstacles[0, rows]), strict=True):
        colour: Colour = PALETTE.contact if row == touched else PALETTE.obstacle
        for outline in shape.footprint():
            rim = widened_outline(outline, arm.hand_radius)
            axes.add_patch(Polygon(rim, facecolor=colour, alpha=0.20, linewidth=0, zorder=2))
            axes.add_patch(Polygon(outline, facecolor=colour, linewidth=0, zorder=3))


def _draw_ends(axes: Axes, scene: Scenes, scale: float) -> None:
    start, goal = _xy(scene.start[0]), _xy(scene.goal[0])
    axes.add_patch(
        Circle(start, START_RADIUS, fill=False, color=PALETTE.start, linewidth=1.8 * scale, zorder=1)
    )
    axes.add_patch(Circle(goal, GOAL_RADIUS, fill=False, color=PALETTE.goal, linewidth=2.2 * scale, zorder=1))
    axes.add_patch(Circle(goal, 0.6 * GOAL_RADIUS, color=PALETTE.goal, linewidth=0, zorder=1))


def _draw_plan(axes: Axes, plan: Plan, scale: float) -> None:
    """Draw the planned path and its via-points, wide enough to show as a rim of the executed path."""
    single = Plan(np.asarray(plan.waypoints).reshape(-1, plan.waypoints.shape[-1]), np.ravel(plan.durations))
    path = np.asarray(single.trajectory()(np.linspace(0.0, float(single.durations.sum()), 121)))
    axes.plot(*path[:, :2].T, color=PALETTE.plan, linewidth=4.6 * scale, solid_capstyle="round", zorder=4)
    vias = single.waypoints[1:-1]
    axes.plot(
        *vias[:, :2].T, "o", color=PALETTE.via, markersize=7.5 * scale, markeredgecolor="white", zorder=6
    )  # fmt: skip


def _draw_execution(axes: Axes, movement: Movement, step: int, scale: float) -> None:
    """Draw the executed path up to a step, red after contact."""
    free = step if movement.contact is None else min(step, movement.contact.step)
    for first, last, colour in ((0, free, PALETTE.executed), (free, step, PALETTE.contact)):
        executed = movement.hand[first : last + 1, :2]
        axes.plot(*executed.T, color=colour, linewidth=1.9 * scale, solid_capstyle="round", zorder=5)


def _draw_arm(axes: Axes, arm: Arm, joints: Float, *, above: bool) -> None:
    """Draw the links, transparent where they pass above the obstacles."""
    for (first, second), radius in zip(np.asarray(arm.links(joints)), arm.link_radii, strict=True):
        outline = capsule(first[:2], second[:2], radius)
        alpha = 0.38 if above else 0.75
        axes.add_patch(Polygon(outline, facecolor=PALETTE.arm, alpha=alpha, linewidth=0, zorder=6.5))
        axes.add_patch(Polygon(outline, fill=False, edgecolor=PALETTE.joint, linewidth=0.7, zorder=6.6))
        axes.add_patch(Circle(_xy(first), 0.4 * radius, color=PALETTE.joint, linewidth=0, zorder=6.7))


def _draw_contact(axes: Axes, contact: FirstContact, scale: float) -> None:
    """Draw a cross at the first contact."""
    for colour, size, width in (("white", 10.5, 4.4), (PALETTE.contact, 9.5, 2.4)):
        (cross,) = axes.plot(*_xy(contact.position), "x", color=colour, zorder=8)
        cross.set(markersize=size * scale, markeredgewidth=width * scale)


def _xy(point: Float) -> tuple[float, float]:
    return float(point[0]), float(point[1])
