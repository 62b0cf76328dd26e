"""Figure of the families of hard scenes: `python docs/figures/families.py`."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from top_view import draw_movement, legend, play

from viapoint.envs.scenes.families_registry import scene_families
from viapoint.training.files import write_figure
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.plots import COLUMN, STYLE
from viapoint.training.scene_sets import scenes_for

FAMILIES = [name for name, family in scene_families(True).items() if not family.trained]
ENV_ID = "viapoint/PlanarObstacles-v0"
VIEW = ((-0.62, 0.42), (-0.08, 0.86))
"""Limits of x and y, [m]."""
HEIGHT = 11.5
"""Height of the figure, [cm]."""
CHECKS, TRIED = 4096, 8
"""Plans that the search checks, and scenes of each family, of which the first that it solves is drawn."""


def draw_families(path: Path) -> None:
    """Draw a scene of each family, with a movement that a search found, to a PNG file."""
    search = GeometrySearch(ENV_ID, CHECKS)
    frozen = scenes_for("hard", search.task)
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, HEIGHT / 2.54))
        every = figure.subplots(3, 2).flat
        for family, axes in zip(FAMILIES, every, strict=False):
            some = frozen.take(np.flatnonzero(frozen.family == family)[:TRIED])
            episodes = play(ENV_ID, some.scenes, search.decide)
            first = next(row for row, (_, success) in enumerate(episodes) if success)
            draw_movement(axes, search.task, episodes[first][0], arm_shown=False, view=VIEW, scale=0.6)
            axes.set_title(f"{family}, {100.0 * some.share[first]:.1f} %")
        for rest in every:
            rest.axis("off")
            rest.legend(handles=legend(), loc="center")
        write_figure(path, figure)


def main() -> None:
    """Draw the figure of the documentation."""
    parser = argparse.ArgumentParser(description="Draw scenes of every family.")
    parser.add_argument("--out", type=Path, default=Path("docs/images/families.png"), help="the picture")
    out: Path = parser.parse_args().out
    draw_families(out)
    print(f"{out}  {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
