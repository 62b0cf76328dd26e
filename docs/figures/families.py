"""Figure of the families of hard scenes: `python docs/figures/families.py`."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from top_view import draw_movement, play

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.scenes.families_registry import scene_families
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.scene_sets import scenes_for

FAMILIES = [name for name, family in scene_families(True).items() if not family.trained]
TASKS = {"PlanarObstacles": "the hand must clear", "PlanarWholeArm": "every link must clear"}
VIEW = ((-0.55, 0.45), (-0.10, 0.78))
"""Limits of x and y, [m]."""
TILE = 2.0
"""Width of one scene, [inch]."""
CHECKS, TRIED = 4096, 8
"""Plans that the search checks, and scenes of each family, of which the first that it solves is drawn."""


def draw_families(path: Path) -> None:
    """Draw a scene of each family of each task, with a movement that a search found, to a PNG file."""
    figure = Figure(figsize=(TILE * len(FAMILIES), 0.98 * TILE * len(TASKS)), dpi=90)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(TASKS), len(FAMILIES), squeeze=False)
    for line, (task, condition) in zip(grid, TASKS.items(), strict=True):
        search = GeometrySearch(f"viapoint/{task}-v0", CHECKS)
        frozen = scenes_for("hard", search.task)
        for axes, family in zip(line, FAMILIES, strict=True):
            some = frozen.take(np.flatnonzero(frozen.family == family)[:TRIED])
            episodes = play(f"viapoint/{task}-v0", some.scenes, search.decide)
            first = next(row for row, (_, success) in enumerate(episodes) if success)
            draw_movement(axes, search.task, episodes[first][0], view=VIEW, scale=0.6)
            share = f"{family}, {100.0 * some.share[first]:.1f} %"
            axes.set_title(share, fontsize=9, color=PALETTE.joint, pad=3)
        line[0].set_ylabel(condition, fontsize=9, color=PALETTE.joint)
    figure.subplots_adjust(left=0.03, right=0.995, bottom=0.01, top=0.94, wspace=0.04, hspace=0.12)
    figure.savefig(path)


def main() -> None:
    """Draw the figure of the documentation."""
    parser = argparse.ArgumentParser(description="Draw scenes of every family.")
    parser.add_argument("--out", type=Path, default=Path("docs/images/families.png"), help="the picture")
    out: Path = parser.parse_args().out
    draw_families(out)
    print(f"{out}  {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
