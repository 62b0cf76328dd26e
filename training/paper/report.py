"""Table of claims as Markdown, as JSON and as a self-contained HTML page."""

from __future__ import annotations

import base64
from pathlib import Path

from viapoint.training.io.files import write_bytes, write_json
from viapoint.training.io.template import load_template, packaged
from viapoint.training.paper.claim import SUBJECTS, Claim, Reproduction

TITLE = "Flash & Hogan 1985, reproduced"
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
    """Write table.md, table.json and index.html to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / name for name in ("table.md", "table.json", "index.html")]
    write_bytes(paths[0], markdown(reproduction.claims).encode())
    record = {"title": TITLE, "holds": not reproduction.failed}
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
    return f"# {TITLE}\n\n{summary(claims)} {NOTE}\n\n{table}\n"


def summary(claims: list[Claim]) -> str:
    """Return a sentence with the number of claims that hold."""
    return f"{sum(claim.holds for claim in claims)} of {len(claims)} claims hold."


def page(reproduction: Reproduction) -> str:
    """Return an HTML page with embedded pictures."""
    template = load_template(packaged("paper/templates/page.html.j2"), escape=True)
    figures = [
        (base64.b64encode(path.read_bytes()).decode(), caption) for path, caption in reproduction.pictures
    ]
    claims = reproduction.claims
    return template.render(
        title=TITLE, note=NOTE, summary=summary(claims), headings=HEADINGS[1:], claims=claims, cells=cells,
        subjects=SUBJECTS, figures=figures,
    )  # fmt: skip


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    text = f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def _or_dash(value: object) -> str:
    return "-" if value is None else str(value)
