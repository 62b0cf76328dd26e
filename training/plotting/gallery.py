"""Gallery of movements on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.episodes import Recorded
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.io.files import MARK
from viapoint.training.plotting.top_view import View, draw_movement
from viapoint.training.rollouts.rollout import Decide

TILE = 2.6
"""Width of one picture, [inch]."""
RESOLUTION = 110
"""Resolution, [dots per inch]."""
COLUMNS = 4
"""Greatest number of pictures in a row."""
LINE = 28
"""Greatest number of characters of the heading above one picture."""
PLANE_VIEW: View = ((-0.53, 0.45), (-0.14, 0.75))
"""View of the arm in the plane: limits of x and y, [m]."""


Episode = tuple[Recorded, bool]
"""Episode, and whether it succeeded."""


def play(env_id: str, scenes: Scenes, decide: Decide, **kwargs: Any) -> list[Episode]:
    """Simulate an episode in each of N scenes.

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


def gallery(
    path: Path, task: Task, episodes: Sequence[Episode], titles: Sequence[str], *, heading: str = ""
) -> Path:
    """Draw episodes in a grid, each titled with its outcome, and save the page as a PNG file in an existing folder.

    Args:
        path: PNG file.
        task: Task of the episodes.
        episodes: Episodes of :func:`play`, at least one.
        titles: Text beside the outcome of each, such as the difficulty of the scene.
        heading: Heading of the page.
    """
    columns = min(COLUMNS, len(episodes))
    rows = -(-len(episodes) // columns)
    plane = task.space_name == "hand"
    (left, right), (low, high) = PLANE_VIEW if plane else ((0.0, 1.0), (0.0, 1.0))
    tall = TILE * (high - low) / (right - left) + 0.3
    lines = textwrap.wrap(heading, LINE * columns)
    margin = 0.45 + 0.3 * bool(lines) + 0.2 * len(lines[1:]) + 0.3 * (columns == 1)
    figure = Figure(figsize=(TILE * columns, tall * rows + margin), dpi=RESOLUTION)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[len(episodes) :]:
        axes.set_axis_off()
    view = PLANE_VIEW if plane else None
    for axes, (recorded, success), title in zip(grid.flat, episodes, titles, strict=False):
        draw_movement(axes, task, recorded, view=view, scale=0.7)
        failure = "collision" if recorded.rollout.contact.any() else "missed"
        colour = PALETTE.goal if success else PALETTE.contact
        outcome = "success" if success else failure
        axes.set_title(outcome, loc="left", fontsize=8.5, color=colour, fontweight="bold", pad=3)
        axes.set_title(title, loc="right", fontsize=8, color=PALETTE.joint, pad=3)
    _legend(figure, columns)
    if lines:
        figure.suptitle("\n".join(lines), fontsize=11, color=PALETTE.executed)
    figure.savefig(path, metadata={"Software": MARK.decode()})
    return path


def _legend(figure: Figure, columns: int) -> None:
    """Add the legend of the page."""
    styles = {
        "planned": Line2D([], [], color=PALETTE.plan, linewidth=4),
        "executed": Line2D([], [], color=PALETTE.executed, linewidth=1.6),
        "via-point": Line2D([], [], color=PALETTE.via, marker="o", linestyle="none", markersize=5),
        "goal": Line2D([], [], color=PALETTE.goal, marker="o", linestyle="none", markersize=5),
        "contact": Line2D([], [], color=PALETTE.contact, marker="x", linestyle="none", markersize=5),
    }
    figure.legend(
        list(styles.values()),
        list(styles),
        loc="outside lower center",
        ncols=5 if columns > 1 else 2,
        fontsize=8,
        frameon=False,
    )
