"""Top view of scenes and movements with Matplotlib."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull

from viapoint.envs import Box, ConvexMesh, Cylinder, HalfSpace, PointCloud, Shape, Task
from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.common.arrays import Float
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.episodes import Recorded
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.outcome import Rollout
from viapoint.envs.plans import Plan
from viapoint.envs.renderer import FADED, Picture, picture_of
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollout import Decide

View = tuple[tuple[float, float], tuple[float, float]]
"""Limits of x and y, [m]."""

PLANE_VIEW: View = ((-0.56, 0.48), (-0.14, 0.90))
"""View of the arm in the plane."""
MARGIN = 0.1
"""Margin around the movement of an arm in space, [m]."""
GOAL_RADIUS, START_RADIUS, HAND_RADIUS = 0.026, 0.018, 0.015
"""Radii of the drawn circles, [m]."""
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]  # Angles of the points of a circle, [rad]
CONTACT_TOLERANCE = 0.01
"""Greatest clearance of an obstacle that counts as the one in contact, [m]."""


def draw_movement(
    axes: Axes,
    task: Task,
    recorded: Recorded,
    *,
    step: int | None = None,
    arm_shown: bool = True,
    view: View | None = None,
    scale: float = 1.0,
) -> None:
    """Draw a scene, the plan, its execution up to a step, and the posture there or at the first contact.

    Args:
        axes: Axes to draw on; their frame and ticks are removed.
        task: Task.
        recorded: Episode, or one of :func:`planned_only`.
        step: Last state that is drawn, 0 for the start; None for the whole movement.
        arm_shown: False to leave out the arm.
        view: Limits of x and y, [m]; by default those of :func:`view_of`.
        scale: Factor on line widths.
    """
    last = len(recorded.rollout.time) if step is None else step
    picture = picture_of(task, recorded, last)
    if step is None and picture.touched < last:
        picture = picture_of(task, recorded, picture.touched)
    touched = picture.touched < len(picture.done)
    contact = first_contact(task.arm, picture) if touched else None
    plane = task.space_name == "hand"
    _prepare(axes, view_of(task, recorded) if view is None else view)
    _draw_ends(axes, picture, scale)
    _draw_paths(axes, picture, scale)
    rim = HAND_RADIUS if plane and not task.whole_arm else 0.0
    for number, shape in enumerate(unpack(picture.obstacles, 0)):
        hit = contact is not None and contact[0] == number
        _draw_obstacle(axes, shape, PALETTE.contact if hit else PALETTE.obstacle, rim)
    if arm_shown:
        _draw_arm(axes, task.arm, picture.joints, 0.38 if rim else 0.75)
        colour = PALETTE.executed if contact is None else PALETTE.contact
        axes.add_patch(Circle(_xy(picture.done[-1]), HAND_RADIUS, color=colour, linewidth=0, zorder=7))
    if contact is not None:
        _draw_cross(axes, contact[1], scale)


def legend(*more: str) -> list[Line2D]:
    """Return the handles of a legend; lines of contact have the names of `more`."""
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 5.0}
    return [
        Line2D([], [], label="start", color=PALETTE.start, markerfacecolor="none", **dot),
        Line2D([], [], label="goal", color=PALETTE.goal, **dot),
        Line2D([], [], label="via-point", color=PALETTE.via, **dot),
        Line2D([], [], label="plan", color=PALETTE.plan, linewidth=2.2),
        Line2D([], [], label="executed", color=PALETTE.executed),
        *(Line2D([], [], label=name, color=PALETTE.contact) for name in more),
    ]


def planned_only(scene: Scenes, plan: Plan | None = None) -> Recorded:
    """Return the record of a scene, and a plan of one row, that has not been executed."""
    joints = scene.start.shape[1]
    empty = np.zeros(0)
    rollout = Rollout(
        time=empty,
        planned=np.zeros((0, 0 if plan is None else plan.waypoints.shape[-1])),
        joints=np.zeros((0, joints)),
        hand=np.zeros((0, 3)),
        contact=np.zeros(0, bool),
        clearance=empty,
    )
    return Recorded(scene, [] if plan is None else [(0.0, plan)], rollout)


def view_of(task: Task, recorded: Recorded) -> View:
    """Return the part of the plane that shows an episode: a square."""
    if task.space_name == "hand":
        return PLANE_VIEW
    arm, scene = task.arm, recorded.scene
    joints = np.concatenate((scene.start, scene.goal, recorded.rollout.joints[::50]))
    places = sphere_centres(arm.chain, arm.spheres, joints).reshape(-1, 3)[:, :2]
    shapes = [shape for shape in unpack(scene.obstacles, 0) if not isinstance(shape, HalfSpace)]
    points = np.concatenate([places, *(outline for shape in shapes for outline in footprint(shape))])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * float((high - low).max()) + MARGIN
    x, y = _xy(0.5 * (low + high))
    return (x - half, x + half), (y - half, y + half)


def first_contact(arm: Arm, picture: Picture) -> tuple[int, Float]:
    """Return the obstacle that is nearest to a moving link of the arm in a picture of a contact.

    Returns:
        Index among the obstacles, -1 if the arm touched itself, and the centre of the nearest sphere of the arm, [m].
    """
    moving = np.repeat(arm.spheres.link, np.diff(arm.spheres.first)) > 0
    centres = sphere_centres(arm.chain, arm.spheres, picture.joints)[moving]
    found, least = (-1, picture.done[-1]), CONTACT_TOLERANCE
    for number, shape in enumerate(unpack(picture.obstacles, 0)):
        clearance = shape.distance(centres) - arm.spheres.radius[moving]
        if clearance.min() < least:
            found, least = (number, centres[clearance.argmin()]), float(clearance.min())
    return found


def _prepare(axes: Axes, view: View) -> None:
    axes.set(xlim=view[0], ylim=view[1], xticks=[], yticks=[], aspect="equal", facecolor=PALETTE.table)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for axis, limits in zip("xy", view, strict=True):
        lines: Any = axes.axvline if axis == "x" else axes.axhline
        for place in np.arange(np.ceil(limits[0] * 10), np.floor(limits[1] * 10) + 1) / 10:
            lines(place, color="black", alpha=0.045, linewidth=0.8, zorder=0)


def _draw_obstacle(axes: Axes, shape: Shape, colour: Colour, rim: float) -> None:
    """Draw the footprint of an obstacle with a rim, which the centre of the hand must not enter."""
    for wide in footprint(shape, rim) if rim else []:
        axes.add_patch(Polygon(wide, facecolor=colour, alpha=0.20, linewidth=0, zorder=2))
    for each in footprint(shape):
        alpha = 1.0 if rim else 0.8
        axes.add_patch(Polygon(each, facecolor=colour, alpha=alpha, linewidth=0, zorder=3))


def _draw_ends(axes: Axes, picture: Picture, scale: float) -> None:
    start, goal = (_xy(end) for end in picture.ends)
    thin = {"fill": False, "zorder": 4.1}
    axes.add_patch(Circle(start, START_RADIUS, color=PALETTE.start, linewidth=1.8 * scale, **thin))
    axes.add_patch(Circle(goal, GOAL_RADIUS, color=PALETTE.goal, linewidth=2.2 * scale, **thin))
    axes.add_patch(Circle(goal, 0.6 * GOAL_RADIUS, color=PALETTE.goal, linewidth=0, zorder=4.1))


def _draw_paths(axes: Axes, picture: Picture, scale: float) -> None:
    """Draw plans, wide enough to show as rims of the executed path, and this path, red after contact."""
    wide: Any = {"linewidth": 4.6 * scale, "solid_capstyle": "round", "zorder": 4}
    for path in picture.replaced:
        axes.plot(*path[:, :2].T, color=FADED, **wide)
    axes.plot(*picture.planned[:, :2].T, color=PALETTE.plan, **wide)
    style: Any = {"markersize": 7.5 * scale, "markeredgecolor": "white", "zorder": 6}
    axes.plot(*picture.vias[:, :2].T, "o", color=PALETTE.via, **style)
    done, free = picture.done[:, :2], picture.touched
    for part, colour in ((done[: free + 1], PALETTE.executed), (done[free:], PALETTE.contact)):
        axes.plot(*part.T, color=colour, linewidth=1.9 * scale, solid_capstyle="round", zorder=5)


def _draw_arm(axes: Axes, arm: Arm, joints: Float, alpha: float) -> None:
    """Draw the bodies of the arm as hulls of their spheres."""
    centres = sphere_centres(arm.chain, arm.spheres, joints)[:, :2]
    for first, last in itertools.pairwise(arm.spheres.first):
        hull = outline(centres[first:last], arm.spheres.radius[first:last])
        axes.add_patch(Polygon(hull, facecolor=PALETTE.arm, alpha=alpha, linewidth=0, zorder=6.5))
        axes.add_patch(Polygon(hull, fill=False, edgecolor=PALETTE.joint, linewidth=0.7, zorder=6.6))


def _draw_cross(axes: Axes, position: Float, scale: float) -> None:
    """Draw a cross at the first contact."""
    for colour, size, width in (("white", 10.5, 4.4), (PALETTE.contact, 9.5, 2.4)):
        (cross,) = axes.plot(*_xy(position), "x", color=colour, zorder=8)
        cross.set(markersize=size * scale, markeredgewidth=width * scale)


def _xy(point: Float) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def play(env_id: str, scenes: Scenes, decide: Decide, **kwargs: Any) -> list[tuple[Recorded, bool]]:
    """Simulate an episode in each of N scenes, and return its record and whether it succeeded.

    Args:
        env_id: Id of an environment.
        scenes: Scenes.
        decide: Function of observations and scenes that returns actions, shape (N, m).
        **kwargs: Keyword arguments of the environment.
    """
    number = len(scenes.start)
    envs: Any = gym.make_vec(env_id, num_envs=number, **kwargs)
    inner = envs.unwrapped
    observation = inner.begin(scenes)
    running, success = np.ones(number, bool), np.zeros(number, bool)
    while running.any():
        decision = inner.execute_actions(decide(observation, scenes), running)
        observation = decision.observation
        success = np.where(running, decision.info["is_success"], success)
        running &= ~(decision.terminated | decision.truncated)
    episodes = []
    for row in range(number):
        recorded = Recorded(scenes.take([row]), inner.last_plans[row], inner.last_rollout[row])
        episodes.append((recorded, bool(success[row])))
    envs.close()
    return episodes


def footprint(shape: Shape, rim: float = 0.0) -> list[Float]:
    """Return the outlines of a shape from above, widened by a rim, convex polygons of shape (K, 2) each, [m].

    A half-space is a large square if it is a wall; a floor or a ceiling has no outline.
    """
    if isinstance(shape, HalfSpace):
        normal = shape.rotation[:2, 2]
        if np.linalg.norm(normal) < 0.7:
            return []
        normal = normal / np.linalg.norm(normal)
        along = np.array([-normal[1], normal[0]])
        corners = [4.0 * (way * along - depth * normal) for way in (-1.0, 1.0) for depth in (0.0, 1.0)]
        return [outline(shape.position[:2] + np.array(corners), rim)]
    points, radius = _outer_points(shape)
    places = (points @ shape.rotation.T + shape.position)[:, :2]
    if isinstance(shape, PointCloud):
        return [outline(place[None], radius + rim) for place in places]
    return [outline(places, radius + rim)]


def outline(points: Float, radius: Any) -> Float:
    """Return the outline of the convex hull of discs around points, shape (K, 2), [m].

    Args:
        points: Centres of the discs, shape (n, 2), [m].
        radius: Radius of all discs, or of each, shape (n,), [m].
    """
    circle = np.stack((np.cos(CIRCLE), np.sin(CIRCLE)), axis=-1)
    discs = points[:, None] + np.reshape(radius, (-1, 1, 1)) * circle
    around = discs.reshape(-1, 2)
    return np.asarray(around[ConvexHull(around).vertices])


def _outer_points(shape: Shape) -> tuple[Float, float]:
    """Return points in the frame of a shape, (n, 3), and the radius of balls of which it is the hull, [m]."""
    if isinstance(shape, Box):
        return np.array(list(itertools.product(*((-half, half) for half in shape.size)))), 0.0
    if isinstance(shape, ConvexMesh):
        return np.asarray(shape.vertices), 0.0
    if isinstance(shape, PointCloud):
        return np.asarray(shape.points), shape.radius
    if isinstance(shape, Cylinder):
        rim = [shape.radius * np.cos(CIRCLE), shape.radius * np.sin(CIRCLE)]
        ends = [np.stack((*rim, np.full(len(CIRCLE), way * shape.half_length)), axis=-1) for way in (-1, 1)]
        return np.concatenate(ends), 0.0
    radius, half, _ = shape.packed_size
    return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(radius)
