"""Draw the steps of one decision of the shipped agent: `python docs/figures/decision.py`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib.style
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from top_view import View, draw_movement, footprint, legend, planned_only

from viapoint.envs.common.arrays import Float
from viapoint.envs.common.palette import PALETTE
from viapoint.envs.episodes import Recorded
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training import load_agent
from viapoint.training.files import write_figure
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import plan_clearances
from viapoint.training.plots import COLUMN, STYLE
from viapoint.training.scene_sets import scenes_for

ENV_ID, SCENE = "viapoint/PlanarObstacles-v0", 19
"""Environment, and row of its `validation` set."""
CHECKS = 4
"""Number of plans that are checked by computed geometry."""
HEIGHT, ASPECT = 7.8, 0.92
"""Height of the figure, [cm], and height of a panel divided by its width."""
MARGIN = 0.035
"""Margin around a scene, [m]."""
GREY = (0.45, 0.47, 0.52)


class Decision(NamedTuple):
    """Data of one decision."""

    task: Task
    recorded: Recorded
    """Scene, plan and execution."""
    paths: Float
    """Planned path of each candidate, shape (H, T, 2), [m]."""
    margin: Float
    """Clearance that the critic predicts, shape (H,), [m]."""
    checked: list[int]
    """Candidates that are checked, the most promising first."""
    clearance: Float
    """Their computed clearance, [m]."""
    info: dict[str, Any]

    @property
    def view(self) -> View:
        """Part of the plane that is shown, [m]."""
        return window(self.recorded.scene, self.paths.reshape(-1, 2), ASPECT)


def decide(agent: str) -> Decision:
    """Return the data of the decision of an agent in one scene."""
    envs: Any = gym.make_vec(ENV_ID, num_envs=1).unwrapped
    task: Task = envs.task
    scene = scenes_for("validation", task).scenes.take([SCENE])
    observation = envs.begin(scene)
    problem = Problem.of_observation(observation, task)
    policy: Any = load_agent(agent).policy
    policy.checks = CHECKS
    with torch.no_grad():
        actions, merits = policy.propose(problem)
        margin = policy.critic(policy.inputs(problem, actions)).margin[0].numpy()
    checked = [int(row) for row in policy._promising(merits, CHECKS)[0]]
    clearance = plan_clearances(task, problem, actions[:, checked], most=1.0, least=-1.0)[0]
    ends = [np.broadcast_to(end, (len(actions[0]), 2)) for end in (problem.start, problem.goal)]
    plans = task.action.decode(actions[0], *ends)
    paths = plans.trajectory()(plans.duration[:, None] * np.linspace(0.0, 1.0, 61))
    info = envs.execute_actions(policy.decide(observation)).info
    recorded = Recorded(scene, envs.last_plans[0], envs.last_rollout[0])
    last = {name: value[0] for name, value in info.items()}
    return Decision(task, recorded, np.asarray(paths), margin, checked, clearance, last)


def draw(path: Path, data: Decision) -> None:
    """Draw the figure to a PNG file."""
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, HEIGHT / 2.54))
        every = figure.subplots(2, 3).flat
        for number, (title, panel) in enumerate(PANELS, start=1):
            axes = next(every)
            base(axes, data)
            axes.set_title(f"{number}  {title}")
            axes.set_xlabel(panel(axes, data))
        rest = next(every)
        rest.axis("off")
        rest.legend(handles=legend("contact\npredicted"), loc="center left")
        write_figure(path, figure)


def base(axes: Axes, data: Decision) -> None:
    """Draw the scene."""
    scene = planned_only(data.recorded.scene)
    draw_movement(axes, data.task, scene, arm_shown=False, view=data.view, scale=0.6)


def observation(axes: Axes, data: Decision) -> str:
    """Draw the straight line, and return the caption."""
    scene = data.recorded.scene
    ends = data.task.space.coordinates(np.concatenate((scene.start, scene.goal)))
    axes.plot(*ends.T, ":", color=GREY, lw=1.2)
    return "the straight line\nis blocked"


def candidates(axes: Axes, data: Decision) -> str:
    """Draw the planned path of every candidate, and return the caption."""
    for path in data.paths:
        axes.plot(*path.T, color=PALETTE.plan, lw=0.4, alpha=0.35, zorder=1)
    return f"{len(data.paths)} plans, more\naround the best"


def critic(axes: Axes, data: Decision) -> str:
    """Draw the candidates coloured by the sign of their predicted clearance, and return the caption."""
    for row in data.margin.argsort():
        colour = PALETTE.plan if data.margin[row] > 0.0 else PALETTE.contact
        axes.plot(*data.paths[row].T, color=colour, lw=0.4, alpha=0.5, zorder=4)
    return "learned: clearance\nof each plan"


def checks(axes: Axes, data: Decision) -> str:
    """Draw the checked candidates, and return the caption with their clearances."""
    for row in data.checked:
        axes.plot(*data.paths[row].T, color=PALETTE.plan, lw=1.2, zorder=4)
    values = ", ".join(f"{1e3 * each:.0f}" for each in data.clearance)
    return f"computed clearance\n{values} mm"


def action(axes: Axes, data: Decision) -> str:
    """Draw the executed movement, and return the caption."""
    draw_movement(axes, data.task, data.recorded, view=data.view, scale=0.6)
    result = "success" if data.info["is_success"] else "failure"
    return f"executed: {result},\n{1e3 * data.info['min_clearance']:.0f} mm clear"


PANELS: tuple[tuple[str, Callable[[Axes, Decision], str]], ...] = (
    ("observation", observation),
    ("candidates", candidates),
    ("critic", critic),
    ("checks", checks),
    ("action", action),
)


def window(scene: Scenes, points: Float, aspect: float) -> View:
    """Return limits of x and y around points and the obstacles of a scene, with a given height per width, [m]."""
    outlines = [each for shape in unpack(scene.obstacles, 0) for each in footprint(shape)]
    points = np.concatenate((points, *outlines))
    middle, extent = (points.max(axis=0) + points.min(axis=0)) / 2.0, np.ptp(points, axis=0)
    half = max(extent[0], extent[1] / aspect) / 2.0 + MARGIN
    x, y = (float(m) for m in middle)
    return (x - half, x + half), (y - half * aspect, y + half * aspect)


def main() -> None:
    """Write `decision.png`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write to")
    parser.add_argument("--agent", default=ENV_ID, help="run folder or model folder of another agent")
    arguments = parser.parse_args()
    draw(arguments.out / "decision.png", decide(arguments.agent))


if __name__ == "__main__":
    main()
