"""Gallery of movements on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from viapoint.envs.common.palette import PALETTE
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.io.files import MARK
from viapoint.training.plotting.video import describe_outcome, play
from viapoint.training.rollouts.rollout import Decide

TILE = 2.6  # Width of one picture, [inch]
RESOLUTION = 110  # Resolution, [dots per inch]
COLUMNS = 4  # Greatest number of pictures in a row
LINE = 28  # Greatest number of characters of the heading above one picture


def gallery(
    path: Path,
    env: gym.Env[Any, Any],
    scenes: Scenes,
    decide: Decide,
    titles: Sequence[str],
    *,
    heading: str = "",
) -> None:
    """Play an episode in each scene, and save a page of their last pictures as a PNG file in an existing folder.

    Args:
        path: PNG file.
        env: Environment made with `render_mode="rgb_array"`.
        scenes: Scenes, at least one, with as many rows for obstacles as the environment has.
        decide: Function from observation and scene, of one row each, to actions, shape (1, m).
        titles: Text below each picture, such as the difficulty of the scene.
        heading: Heading of the page.

    Raises:
        GLUnavailableError: There is no OpenGL library.
    """
    columns = min(COLUMNS, len(titles))
    rows = -(-len(titles) // columns)
    lines = textwrap.wrap(heading, LINE * columns)
    margin = 0.45 + 0.3 * bool(lines) + 0.2 * len(lines[1:]) + 0.3 * (columns == 1)
    figure = Figure(figsize=(TILE * columns, (TILE + 0.5) * rows + margin), dpi=RESOLUTION)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set(xticks=[], yticks=[], frame_on=False)
    for row, (axes, title) in enumerate(zip(grid.flat, titles, strict=False)):
        outcome, colour = describe_outcome(play(env, scenes.take([row]), decide))
        axes.imshow(env.unwrapped.render())
        axes.set_title(outcome, fontsize=8.5, color=colour, fontweight="bold", pad=3)
        axes.set_xlabel(title, fontsize=8, color=PALETTE.joint)
    marks = {
        "planned": "plan",
        "executed": "executed",
        "via-point": "via",
        "goal": "goal",
        "contact": "contact",
    }
    handles = [Line2D([], [], color=getattr(PALETTE, name), linewidth=4) for name in marks.values()]
    places: Any = {"loc": "outside lower center", "ncols": 5 if columns > 1 else 2}
    figure.legend(handles, list(marks), **places, fontsize=8, frameon=False)
    if lines:
        figure.suptitle("\n".join(lines), fontsize=11, color=PALETTE.executed)
    figure.savefig(path, metadata={"Software": MARK.decode()})
