"""Table of claims as Markdown, as JSON and as a self-contained HTML page."""

from __future__ import annotations

import base64
import html
from pathlib import Path

from viapoint.training.io.files import write_bytes, write_json
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
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;color:#122}
table{border-collapse:collapse;font-size:13px}
th,td{padding:.3rem .5rem;border-bottom:1px solid #ddd;text-align:left}
th{background:#f6f5f0;position:sticky;top:0}td.n{text-align:right;white-space:nowrap}
tr.s td{font-weight:600;background:#fbfaf6}
.holds{color:#17803f}.fails{color:#b3121d;font-weight:700}
figure{display:inline-block;vertical-align:top;width:21.5rem;margin:0 1.5rem 1.5rem 0}figure img{width:100%}
figcaption{font-size:13px;color:#444}
"""


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
    rows, subject = [], 0
    for claim in reproduction.claims:
        if claim.row != subject:
            subject = claim.row
            rows.append(
                f'<tr class="s"><td colspan="{len(HEADINGS) - 1}">{subject}. {SUBJECTS[subject]}</td></tr>'
            )
        rows.append(_row(claim))
    figures = "".join(_figure(path, caption) for path, caption in reproduction.pictures)
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in HEADINGS[1:])
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(TITLE)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{html.escape(TITLE)}</h1>"
        f"<p><b>{summary(reproduction.claims)}</b> {html.escape(NOTE)}</p>"
        f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        f"<h2>Figures</h2>{figures}</body></html>\n"
    )


def _row(claim: Claim) -> str:
    made = []
    for i, cell in enumerate(cells(claim)[1:], start=1):
        kind = "n" if i in (4, 6, 8) else ("holds" if claim.holds else "fails") if i == 9 else ""
        made.append(f'<td class="{kind}">{html.escape(cell)}</td>')
    return f"<tr>{''.join(made)}</tr>"


def _figure(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    text = f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def _or_dash(value: object) -> str:
    return "-" if value is None else str(value)
