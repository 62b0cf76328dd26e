"""Gallery of movements on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Movement of a gallery."""

    task: Task
    recorded: Recorded
    """Episode."""
    title: str
    """Text beside the outcome, such as the difficulty of the scene."""
    success: bool

    @property
    def outcome(self) -> str:
        """Outcome in one word."""
        if self.success:
            return "success"
        return "collision" if self.recorded.rollout.contact.any() else "missed"


def play(env_id: str, scenes: Scenes, titles: Sequence[str], decide: Decide, **kwargs: Any) -> list[Entry]:
    """Simulate an episode in each of N scenes.

    Args:
        env_id: Id of an environment.
        scenes: Scenes.
        titles: Title of each scene.
        decide: Function of observations and scenes that returns actions, shape (N, m).
        **kwargs: Keyword arguments of the environment.
    """
    envs: Any = gym.make_vec(env_id, num_envs=len(titles), **kwargs)
    inner = envs.unwrapped
    observation = inner.begin(scenes)
    running, success = np.ones(len(titles), bool), np.zeros(len(titles), bool)
    while running.any():
        decision = inner.execute_actions(decide(observation, scenes), running)
        observation = decision.observation
        success = np.where(running, decision.info["is_success"], success)
        running &= ~(decision.terminated | decision.truncated)
    entries = []
    for row, title in enumerate(titles):
        recorded = Recorded(scenes.take([row]), inner.last_plans[row], inner.last_rollout[row])
        entry = Entry(task=inner.task, recorded=recorded, title=title, success=bool(success[row]))
        entries.append(entry)
    envs.close()
    return entries


def gallery(path: Path, entries: Sequence[Entry], *, heading: str = "") -> Path:
    """Draw movements in a grid, each titled with its outcome, and save the page as a PNG file in an existing folder.

    Raises:
        ValueError: There is no entry.
    """
    if not entries:
        raise ValueError("entries must hold at least one movement")
    columns = min(COLUMNS, len(entries))
    rows = -(-len(entries) // columns)
    plane = entries[0].task.space_name == "hand"
    (left, right), (low, high) = PLANE_VIEW if plane else ((0.0, 1.0), (0.0, 1.0))
    tall = TILE * (high - low) / (right - left) + 0.3
    lines = textwrap.wrap(heading, LINE * columns)
    margin = 0.45 + 0.3 * bool(lines) + 0.2 * len(lines[1:]) + 0.3 * (columns == 1)
    figure = Figure(figsize=(TILE * columns, tall * rows + margin), dpi=RESOLUTION)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[len(entries) :]:
        axes.set_axis_off()
    for axes, entry in zip(grid.flat, entries, strict=False):
        view = PLANE_VIEW if plane else None
        draw_movement(axes, entry.task, entry.recorded, view=view, scale=0.7)
        colour = PALETTE.goal if entry.success else PALETTE.contact
        axes.set_title(entry.outcome, loc="left", fontsize=8.5, color=colour, fontweight="bold", pad=3)
        axes.set_title(entry.title, loc="right", fontsize=8, color=PALETTE.joint, pad=3)
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
