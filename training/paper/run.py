"""Reproduction of the paper, its table as Markdown, as JSON and as an HTML page, and the command that runs it."""

from __future__ import annotations

import base64
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure
from tqdm import tqdm

from viapoint.training.config.configs import PaperConfig
from viapoint.training.evaluation.evaluator import one_thread
from viapoint.training.io.files import MARK, check_ours, versions, write_bytes, write_json
from viapoint.training.paper import figures
from viapoint.training.paper.claim import SUBJECTS, Claim, Reproduction
from viapoint.training.paper.rows import alternatives, curved, double_step, obstacles, straight
from viapoint.training.paper.rows.obstacles import check_agent

ROWS: dict[int, Callable[[], list[Claim]]] = {
    1: straight.point_to_point_claims,
    2: straight.invariance_claims,
    3: straight.joint_claims,
    4: curved.passage_claims,
    5: curved.valley_claims,
    6: curved.place_claims,
    7: curved.isochrony_claims,
    8: curved.scaling_claims,
    9: alternatives.alternative_claims,
    10: alternatives.limit_claims,
    11: double_step.replanning_claims,
    13: double_step.double_step_claims,
}
"""Functions of the rows; row 12 needs movements around obstacles."""


class Drawing(NamedTuple):
    """Figure with its file name and caption."""

    name: str
    caption: str
    draw: Callable[..., Figure]
    around_lights: bool = False
    """True if `draw` takes the movements around obstacles."""


DRAWINGS = (
    Drawing("fig01_model", "The model (Fig. 1). A: straight movement, speed T relative to its peak V_M. B: through a "
            "via-point; path with d1, d2, d3, speed, curvature C (valley of the speed dotted) and velocities.",
            figures.model),
    Drawing("fig03_straight", "Straight movements (Fig. 3): path, speed and accelerations. Wide: model; dashed: "
            "simulated arm, here and in the following figures.", figures.straight_movements),
    Drawing("fig04_joints", "Joint angles, joint velocities and torques of two straight movements (Fig. 4): what is "
            "the same for the hand is not for the joints.", figures.joints),
    Drawing("fig05_height", "A larger d3 gives a deeper valley and a higher curvature peak (Fig. 5); d1 = d2; lengths "
            "relative to d1 + d2. Dotted: passage of the via-point.", figures.height),
    Drawing("fig06_place", "The longer side has the higher speed peak (Fig. 6).", figures.place),
    Drawing("fig07_turned", "The same in other directions (Fig. 7).", figures.turned),
    Drawing("fig08_obstacles", "Around a row of lights (Fig. 8): the movement with the deepest valley (A) and a "
            "median one (B), each with the model through its point of greatest curvature.",
            figures.obstacles, around_lights=True),
    Drawing("fig10_isochrony", "Passage times (Fig. 10). A: against d1, for three d3; C: against d3, for three d1. "
            "B, D: difference from the model. Grey squares: movements around rows of lights.",
            figures.isochrony, around_lights=True),
    Drawing("fig11_scaling", "The same three points in 1.1 s and 0.85 s (Fig. 11).", figures.scaling),
    Drawing("valleys", "Where there is a speed valley at all (A), and how much later the curvature has its peak (B).",
            figures.valleys),
    Drawing("alternatives", "Least acceleration, jerk and snap (A, B); least jerk of the hand (C) and of the joints "
            "(D).", figures.alternatives),
    Drawing("limits", "A repetitive movement beside a sinusoid (A); T3 to T6 at the torque limit and faster (B), with "
            "the torques of both (C, D; limits dotted).", figures.limits),
    Drawing("double_step", "The target jumps from T4 to T5 and the movement is revised (orange) 50, 100, 200 or 300 ms "
            "after its start: by a second movement that is added, or by one new plan with the same arrival.",
            figures.paths_and_speeds),
    Drawing("double_step_jerk", "Sum and plan compared. A: jerk, revised at 200 ms. B, C: jerk cost relative to the "
            "plan's and greatest distance from it, for three durations of the second movement. D: peak speeds.",
            figures.comparison),
)  # fmt: skip
"""Figures in the order of the paper."""


def reproduce(out: Path, agent: Path | None, report_step: Callable[[str], None]) -> Reproduction:
    """Compute every row, row 12 with an agent or a search, and draw every figure; each step is reported."""
    claims: list[Claim] = []
    for row, compute in ROWS.items():
        report_step(f"row {row}")
        claims += compute()
    report_step("row 12")
    avoidance = obstacles.light_movements(agent)
    claims += obstacles.obstacle_claims(avoidance)
    claims.sort(key=lambda claim: claim.row)
    pictures = []
    for drawing in DRAWINGS:
        report_step(drawing.name)
        with mpl.rc_context(figures.STYLE):
            figure = drawing.draw(avoidance) if drawing.around_lights else drawing.draw()
            picture, _ = figures.save(figure, out, drawing.name)
        pictures.append((picture, drawing.caption))
    return Reproduction(claims, pictures)


STEPS = len(ROWS) + 1 + len(DRAWINGS)


TITLE = "Flash & Hogan 1985, reproduced with viapoint"
PAGES = ("table.md", "table.json", "index.html")
"""Files besides the figures."""
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


def write(reproduction: Reproduction, out: Path) -> list[Path]:
    """Write the tables and the page to a folder."""
    paths = [out / name for name in PAGES]
    write_bytes(paths[0], markdown(reproduction.claims).encode())
    record = {"viapoint": versions()["viapoint"], "title": TITLE, "holds": not reproduction.failed}
    write_json(paths[1], {**record, "claims": [claim.as_json() for claim in reproduction.claims]})
    write_bytes(paths[2], page(reproduction).encode())
    return paths


def cells(claim: Claim) -> list[str]:
    """Return the cells of one line."""
    return [
        str(claim.row),
        claim.claim,
        claim.figure,
        claim.paper,
        _number(claim.model, claim.unit),
        _or_dash(claim.expected),
        _number(claim.arm, claim.unit),
        _or_dash(claim.arm_expected),
        "-" if claim.deviation is None else f"{claim.deviation:.2f}",
        claim.verdict,
    ]


def markdown(claims: list[Claim]) -> str:
    """Return the table as a Markdown document."""
    lines = [list(HEADINGS), ["---"] * 4 + ["---:"] * 5 + ["---"]]
    lines += [[cell.replace("|", "\\|") for cell in cells(claim)] for claim in claims]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"# {TITLE}\n\n{summary(claims)} {NOTE}\n\n{table}\n\n<!-- {MARK.decode()} -->\n"


def summary(claims: list[Claim]) -> str:
    """Return a sentence with the number of claims that hold."""
    return f"{sum(claim.holds for claim in claims)} of {len(claims)} claims hold."


def page(reproduction: Reproduction) -> str:
    """Return an HTML page with embedded pictures."""
    source = files("viapoint.training") / "paper" / "templates" / "page.html.j2"
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    pictures = [
        (base64.b64encode(path.read_bytes()).decode(), caption) for path, caption in reproduction.pictures
    ]
    claims = reproduction.claims
    return environment.from_string(source.read_text(encoding="utf-8")).render(
        title=TITLE, note=NOTE, summary=summary(claims), headings=HEADINGS[1:], claims=claims, cells=cells,
        subjects=SUBJECTS, figures=pictures,
    )  # fmt: skip


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    text = f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def _or_dash(value: object) -> str:
    return "-" if value is None else str(value)


class ClaimsFailedError(Exception):
    """Error after a run in which some claims do not hold; all results are written."""

    exit_code = 1


def run(config: PaperConfig) -> None:
    """Compute the claims, draw and write them, and raise an error if a claim does not hold."""
    if config.agent is not None:
        check_agent(config.agent)
    pictures = [f"{drawing.name}{suffix}" for drawing in DRAWINGS for suffix in (".png", ".svg")]
    for name in (*PAGES, *pictures):
        check_ours(config.out / name)
    with tqdm(total=STEPS, file=sys.stderr, dynamic_ncols=True, unit=" steps") as bar, one_thread():

        def report_step(name: str) -> None:
            bar.set_description(name)
            bar.update()

        result = reproduce(config.out, config.agent, report_step)
    pages = write(result, config.out)
    print(f"{summary(result.claims)} The page: {pages[-1]}")
    if result.failed:
        names = "; ".join(f"row {claim.row}, {claim.claim}" for claim in result.failed)
        raise ClaimsFailedError(f"{len(result.failed)} of {len(result.claims)} claims fail: {names}")
