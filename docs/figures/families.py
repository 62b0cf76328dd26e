"""Figure of the families of hard scenes: `python docs/figures/families.py`."""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.scenes.families import scene_families
from viapoint.training.plotting.top_view import draw_movement
from viapoint.training.scene_sets.scene_set import load

FAMILIES = [name for name, family in scene_families(2).items() if family.hard]
TASKS = {"PlanarObstacles": "the hand must clear", "PlanarWholeArm": "every link must clear"}
VIEW = ((-0.55, 0.45), (-0.10, 0.78))
"""Limits of x and y, [m]."""
TILE = 2.0
"""Width of one scene, [inch]."""


def draw_families(path: Path, number: int = 0) -> None:
    """Draw the scene of the given number of each family of each task, with the planner's solution.

    Args:
        path: PNG file.
        number: Number of the scene within its family in the set `hard`.
    """
    figure = Figure(figsize=(TILE * len(FAMILIES), 0.98 * TILE * len(TASKS)), dpi=90)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(TASKS), len(FAMILIES), squeeze=False)
    for line, (task, condition) in zip(grid, TASKS.items(), strict=True):
        env_id = f"viapoint/{task}-v0"
        frozen, env = load("hard", env_id), gym.make_vec(env_id, num_envs=1)
        record = env.unwrapped.task  # type: ignore[attr-defined]
        env.close()
        for axes, family in zip(line, FAMILIES, strict=True):
            one = frozen.take(np.flatnonzero(frozen.family == family)[[number]])
            plan = record.action.decode(one.solution, one.scenes.start, one.scenes.goal)
            draw_movement(
                axes, record.arm, one.scenes, plan, whole_arm=record.whole_arm, view=VIEW, scale=0.6
            )
            axes.set_title(f"{family}, {100.0 * one.share[0]:.1f} %", fontsize=9, color=PALETTE.joint, pad=3)
        line[0].set_ylabel(condition, fontsize=9, color=PALETTE.joint)
    figure.subplots_adjust(left=0.03, right=0.995, bottom=0.01, top=0.94, wspace=0.04, hspace=0.12)
    figure.savefig(path)


def main() -> None:
    """Draw the figure of the documentation, or of other scenes."""
    parser = argparse.ArgumentParser(description="Draw scenes of every family.")
    parser.add_argument("--out", type=Path, default=Path("docs/images/hard_families.png"), help="the picture")
    parser.add_argument("--number", type=int, default=0, help="of the scene in its family")
    arguments = parser.parse_args()
    draw_families(arguments.out, arguments.number)
    print(f"{arguments.out}  {arguments.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
