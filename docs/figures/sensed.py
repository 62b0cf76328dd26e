"""Draw what a sensor sees, the plans of the shipped agent, and how sure it is: `python docs/figures/sensed.py`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from top_view import footprint, legend

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.plans import Movements
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training import load_agent
from viapoint.training.files import write_figure
from viapoint.training.plots import COLUMN, METHOD_STYLES, STYLE, style_axes
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import scenes_for

ENV_ID, SCENES = "viapoint/PlanarSensed-v0", (300, 420, 450)
"""Environment, and rows of its `validation` set."""
LIMITS = (-0.5, 0.48), (-0.06, 0.7)
RAY = "#e8c15a"
DRAWN, N_DRAWN = 7, 3000
"""First part of the seeds of scenes in which success is counted, and their number."""
BINS = 8
"""Numbers of equally many scenes in which success is counted."""
FINE_RAYS = 4_000
"""Rays with which the seen part of the space is drawn."""


def draw_scene(axes: Axes, task: Task, scene: Scenes, agent: Any) -> None:
    """Draw obstacles, rays and plan of one scene."""
    sensor = task.sensor
    assert sensor is not None
    found = sensor.read(task.arm, scene.start, scene.obstacles)
    origin = np.array(sensor.position)[:2]
    fine = Sensor(
        position=sensor.position, quaternion=sensor.quaternion, columns=FINE_RAYS, range=sensor.range
    ).read(task.arm, scene.start, scene.obstacles)
    visible = np.concatenate((origin[None], fine.points[0, :, :2]))
    axes.add_patch(Polygon(visible, facecolor="#fbf4df", edgecolor="none", zorder=0))
    for shape in unpack(scene.obstacles, 0):
        for corners in footprint(shape):
            axes.add_patch(
                Polygon(corners, facecolor="white", edgecolor=PALETTE.obstacle, hatch="/////", zorder=2)
            )
    met = found.seen[0] >= 0
    for end in found.points[0][met]:
        axes.plot(*np.stack((origin, end[:2])).T, color=RAY, linewidth=0.5, zorder=1)
    axes.scatter(*found.points[0][met][:, :2].T, s=3, linewidths=0.0, color=PALETTE.executed, zorder=4)
    start, goal = task.space.coordinates(scene.start), task.space.coordinates(scene.goal)
    goals = scene.goal, task.arm.hand(scene.goal)
    hand = task.arm.hand(scene.start)
    seen = task.observation.observe(scene.start, hand, goals, scene.obstacles)
    actions, _ = agent.predict(seen, deterministic=True)
    plan = task.action.decode(actions.astype(np.float64), start, goal)
    path = Movements.of(plan).sample(plan.duration[:, None] * np.linspace(0.0, 1.0, 100)).position[0]
    axes.plot(*np.stack((start[0], goal[0])).T, color="0.4", linestyle=":", linewidth=1.0, zorder=3)
    axes.plot(*path.T, color=PALETTE.plan, linewidth=2.0, zorder=5)
    for via in plan.waypoints[0, 1:-1]:
        axes.add_patch(Circle(via, 0.018, color=PALETTE.via, zorder=6))
    axes.add_patch(Circle(start[0], 0.018, fill=False, linewidth=1.2, color=PALETTE.start, zorder=6))
    axes.add_patch(Circle(goal[0], 0.020, color=PALETTE.goal, zorder=6))
    axes.add_patch(Circle(origin, 0.02, color=PALETTE.joint, zorder=6))
    axes.set(xlim=LIMITS[0], ylim=LIMITS[1], aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor("#e9e9ec")
    for spine in axes.spines.values():
        spine.set_visible(False)


def seen_legend() -> list[Artist]:
    """Return the handles of the legend of scenes."""
    return [
        Patch(label="obstacle", facecolor="white", edgecolor=PALETTE.obstacle, hatch="/////"),
        Line2D([], [], label="ray", color=RAY),
        Line2D([], [], label="seen point", color=PALETTE.executed, linestyle="none", marker="."),
        *legend()[:4],
    ]


def draw_calibration(axes: Axes, env_id: str, agent: Any) -> None:
    """Draw the share of successes against the predicted probability, in scenes that the environment draws."""
    task: Task = agent.policy.task
    scenes = task.sampler()([np.random.default_rng((DRAWN, each)) for each in range(N_DRAWN)])
    simulation = SceneSimulation(env_id)
    actions, predicted = agent.policy.assess(simulation.observe(scenes))
    success = simulation(scenes, actions)["is_success"]
    order = np.argsort(predicted)
    bins = np.array_split(order, BINS)
    x = np.array([predicted[rows].mean() for rows in bins])
    y = np.array([success[rows].mean() for rows in bins])
    error = float((np.abs(x - y) * [len(rows) for rows in bins]).sum() / len(order))
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    axes.plot(x, y, "-", markersize=4.0, **METHOD_STYLES["agent"])
    axes.set(xlim=(0, 1.03), ylim=(0, 1.03), aspect="equal", xlabel="predicted success", ylabel="success")
    axes.set(xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    style_axes(axes)
    name = env_id.removeprefix("viapoint/").removesuffix("-v0")
    axes.set_title(f"{name}: {error:.2f}")
    print(f"{name}: predicted {predicted.mean():.3f}, success {success.mean():.3f}, error {error:.3f}")


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", default=ENV_ID)
    parser.add_argument("--out", type=Path, default=Path("docs/images/sensed.png"))
    parser.add_argument("--scenes", type=int, nargs="+", default=SCENES)
    given = parser.parse_args()
    agent = load_agent(given.agent)
    task: Task = agent.policy.task
    frozen = scenes_for("validation", task)
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, 6.4 / 2.54))
        every = figure.subplots(2, 2).flat
        for row, axes in zip(given.scenes, every, strict=False):
            draw_scene(axes, task, frozen.scenes.take([row]), agent)
        for rest in every:
            rest.axis("off")
            rest.legend(handles=seen_legend(), loc="center")
        write_figure(given.out, figure)
        figure = Figure(figsize=(COLUMN / 2.54, 4.8 / 2.54))
        for axes, env_id in zip(figure.subplots(1, 2), (ENV_ID, "viapoint/PandaSensed-v0"), strict=True):
            draw_calibration(axes, env_id, load_agent(env_id))
        write_figure(given.out.with_name("sensed_calibration.png"), figure)


if __name__ == "__main__":
    main()
