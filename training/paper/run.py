"""Reproduction of the paper, its table as Markdown, as JSON and as an HTML page, and the command that runs it."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from viapoint.training.configs import PaperConfig
from viapoint.training.evaluation import one_thread
from viapoint.training.files import MARK, check_ours, versions, write_bytes, write_figure, write_json
from viapoint.training.paper import (
    Claim,
    Number,
    double_step,
    figures,
    obstacles,
    one_via,
    point_to_point,
)
from viapoint.training.plots import STYLE
from viapoint.training.report import progress_bar

# Titles and functions of the rows: twelve of Flash & Hogan 1985, one of Flash & Henis 1991
ROWS: dict[int, tuple[str, Callable[..., list[Claim]]]] = {
    1: ("Point to point", point_to_point.point_to_point_claims),
    2: ("Invariance of hand paths", point_to_point.invariance_claims),
    3: ("Joints and torques", point_to_point.joint_claims),
    4: ("Free passage time", one_via.passage_claims),
    5: ("Speed valley and curvature", one_via.valley_claims),
    6: ("Place of the via-point", one_via.place_claims),
    7: ("Isochrony", one_via.isochrony_claims),
    8: ("Scaling with time", one_via.scaling_claims),
    9: ("Alternatives to minimum jerk", point_to_point.alternative_claims),
    10: ("Repetitive and performance-limited movements", point_to_point.limit_claims),
    11: ("The primer and its replanned version", double_step.replanning_claims),
    12: ("Obstacle avoidance", obstacles.obstacle_claims),
    13: ("A target that jumps on the way (Flash & Henis 1991)", double_step.double_step_claims),
}


# Functions of the figures by their file names
DRAWINGS: dict[str, Callable[..., Figure]] = {
    "fig01_model": figures.model,
    "fig03_straight": figures.straight_movements,
    "fig04_joints": figures.joints,
    "fig08_obstacles": figures.around_lights,
    "fig10_isochrony": figures.isochrony,
    "valleys": figures.valleys,
    "alternatives": figures.orders_and_spaces,
    "limits": figures.limits,
    "double_step": figures.paths_and_speeds,
    "double_step_jerk": figures.comparison,
    **{name: partial(figures.pair, name) for name in figures.PAIRS},
}
# Functions of them that take the movements around obstacles
AROUND_LIGHTS = (obstacles.obstacle_claims, figures.around_lights, figures.isochrony)


def reproduce(out: Path, agent: Path | None) -> tuple[list[Claim], dict[Path, str]]:
    """Compute every row, row 12 with an agent or a search, and draw every figure; return captions by PNG, too."""
    avoidance = obstacles.light_movements(agent)

    def result_of(function: Callable[..., Any]) -> Any:
        return function(avoidance) if function in AROUND_LIGHTS else function()

    claims: list[Claim] = []
    for _, compute in progress_bar(iterable=ROWS.values(), desc="rows"):
        claims += result_of(compute)
    pictures = {}
    for name, about in progress_bar(iterable=figures.FIGURES.items(), desc="figures"):
        with matplotlib.style.context(STYLE):
            figure = result_of(DRAWINGS[name])
            pictures[write_figure(out / f"{name}.png", figure)] = about["caption"]
            figure.set_layout_engine("none")  # the same layout for both files, computed once
            write_figure(out / f"{name}.svg", figure)
    return claims, pictures


TITLE = "Flash & Hogan 1985, reproduced with viapoint"
PAGES = ("table.md", "table.json", "index.html")  # Files besides the figures
HEADINGS = (
    "row", "claim", "paper's figure", "paper", "model", "expected", "simulated arm", "expected", "hand off plan [mm]",
    "verdict",
)  # fmt: skip
NOTE = (
    "Model: the minimum-jerk movement, in closed form. Simulated arm: a two-joint arm in MuJoCo that tracks it; "
    "“hand off plan” is the greatest distance of its hand from the plan. A claim holds if every number of its line "
    "is in its expected range. Where a statement of the paper is only approximate, the claim says so and its number "
    "says by how much."
)


def write(claims: list[Claim], pictures: dict[Path, str], out: Path) -> str:
    """Write the tables and the page to a folder; return a sentence with the number of claims that hold."""
    summary = f"{sum(claim.holds for claim in claims)} of {len(claims)} claims hold."
    table = pd.DataFrame([cells(claim) for claim in claims], columns=HEADINGS)
    aligned = ["left"] * 4 + ["right"] * 5 + ["left"]
    text = table.replace("|", r"\|").to_markdown(index=False, disable_numparse=True, colalign=aligned)
    markdown = f"# {TITLE}\n\n{summary} {NOTE}\n\n{text}\n\n<!-- {MARK.decode()} -->\n"
    pages = Environment(
        loader=PackageLoader("viapoint.training.paper"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    html = pages.get_template("page.html.j2").render(
        title=TITLE, note=NOTE, summary=summary, headings=HEADINGS[1:], claims=claims, cells=cells, rows=ROWS,
        figures=[(base64.b64encode(path.read_bytes()).decode(), caption) for path, caption in pictures.items()],
    )  # fmt: skip
    record: dict[str, Any] = {"viapoint": versions()["viapoint"], "title": TITLE}
    record["holds"] = all(claim.holds for claim in claims)
    record["claims"] = [claim.as_json() for claim in claims]
    write_bytes(out / "table.md", markdown.encode())
    write_json(out / "table.json", record)
    write_bytes(out / "index.html", html.encode())
    return summary


def cells(claim: Claim) -> list[str]:
    """Return the cells of one line."""
    deviation = "-" if claim.deviation is None else f"{claim.deviation:.2f}"
    model, arm = (_number_and_range(number, claim.unit) for number in (claim.model, claim.arm))
    return [str(claim.row), claim.claim, claim.figure, claim.paper, *model, *arm, deviation, claim.verdict]


def _number_and_range(number: Number | None, unit: str) -> tuple[str, str]:
    if number is None:
        return "-", "-"
    value, (low, high) = number
    text = f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
    expected = f"{(low + high) / 2.0:.6g} ± {(high - low) / 2.0:.2g}"
    if np.isinf(low):
        expected = f"at most {high:.4g}"
    if np.isinf(high):
        expected = f"at least {low:.4g}"
    return f"{text} {unit}".rstrip(), expected


class ClaimsFailedError(Exception):
    """Error after a run in which some claims do not hold; all results are written."""

    exit_code = 1


def run(config: PaperConfig) -> None:
    """Compute the claims, draw and write them, and raise an error if a claim does not hold."""
    for name in PAGES:
        check_ours(config.out / name)
    for name, suffix in itertools.product(DRAWINGS, (".png", ".svg")):
        check_ours(config.out / f"{name}{suffix}")
    with one_thread():
        claims, pictures = reproduce(config.out, config.agent)
    summary = write(claims, pictures, config.out)
    failed = [f"row {claim.row}, {claim.claim}" for claim in claims if not claim.holds]
    print(f"{summary} The page: {config.out / PAGES[-1]}")
    if failed:
        raise ClaimsFailedError(f"{len(failed)} of {len(claims)} claims fail: {'; '.join(failed)}")
