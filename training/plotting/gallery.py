"""Gallery of movements on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.arms.base import Arm
from viapoint.envs.common.palette import PALETTE
from viapoint.envs.common.types import Observation
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Rollout
from viapoint.training.io.files import MARK
from viapoint.training.plotting.top_view import draw_movement

TILE = 2.6
"""Width of one picture, [inch]."""
RESOLUTION = 110
"""Resolution, [dots per inch]."""
COLUMNS = 4
"""Greatest number of pictures in a row."""
LINE = 28
"""Greatest number of characters of the heading above one picture."""
VIEW = ((-0.53, 0.45), (-0.09, 0.75))
"""Limits of x and y, [m]."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Movement of a gallery."""

    arm: Arm
    scene: Scenes
    """One row."""
    plan: Plan
    """One row."""
    rollout: Rollout
    title: str
    """Text beside the outcome, such as the difficulty of the scene."""
    success: bool
    whole_arm: bool = False
    """True where the links can touch obstacles, too."""

    @property
    def outcome(self) -> str:
        """Outcome in one word."""
        if self.success:
            return "success"
        return "collision" if self.rollout.contact.any() else "missed"


def play(
    env_id: str, scenes: Scenes, titles: Sequence[str], act: Callable[[int, Observation], Any], **kwargs: Any
) -> list[Entry]:
    """Simulate one movement in each scene; `act` returns the action from its row and its first observation."""
    env: Any = gym.make(env_id, **kwargs)
    inner, entries = env.unwrapped, []
    for row, title in enumerate(titles):
        scene = scenes.take([row])
        observation, _ = env.reset(options=scene.as_options())
        success = bool(env.step(act(row, observation))[-1]["is_success"])
        entries.append(
            Entry(
                arm=inner.task.arm, scene=scene, plan=inner.last_plan, rollout=inner.last_rollout, title=title,
                success=success, whole_arm=inner.task.whole_arm,
            )
        )  # fmt: skip
    env.close()
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
    tall = TILE * (VIEW[1][1] - VIEW[1][0]) / (VIEW[0][1] - VIEW[0][0]) + 0.3
    lines = textwrap.wrap(heading, LINE * columns)
    margin = 0.45 + 0.3 * bool(lines) + 0.2 * len(lines[1:]) + 0.3 * (columns == 1)
    figure = Figure(figsize=(TILE * columns, tall * rows + margin), dpi=RESOLUTION)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[len(entries) :]:
        axes.set_axis_off()
    for axes, entry in zip(grid.flat, entries, strict=False):
        shown = entry.arm, entry.scene, entry.plan, entry.rollout
        draw_movement(axes, *shown, whole_arm=entry.whole_arm, view=VIEW, scale=0.7)
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
