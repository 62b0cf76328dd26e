"""Write the tables of docs/baselines.md and docs/choosing.md from docs/results.json and docs/agent.json.

    python benchmarks/pages.py

A table stands between two comments, `<!-- table:NAME -->` and `<!-- end -->`. Nothing is measured here.
"""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"
TASKS = ("PlanarObstacles", "PlanarWholeArm", "PandaObstacles")
SETS = ("test", "hard")
BASELINES = (
    ("viaq, learned alone", "viaq", "alone"),
    ("viaq, 64 checks", "viaq", "checked"),
    ("viaq untrained, 64 checks", "viaq", "untrained"),
    ("SAC", "sac", "alone"),
    ("TQC", "tqc", "alone"),
    ("TD3", "td3", "alone"),
    ("PPO", "ppo", "alone"),
    *((f"`{name}`", name, "") for name in ("search16", "search64", "search512", "search4096", "ompl")),
    *((f"`{name}`", name, "") for name in ("random80", "random16", "constant", "random", "straight")),
)
"""Label, name in results.json, and kind of decision of each row."""
TIMED = ("random16", "random80", "ompl", "planner")
LEARNED = ("SAC", "TD3", "TQC", "PPO")


def pages() -> dict[str, str]:
    """Return the text of each page, by file name, with the tables that belong to the measurements."""
    study = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))
    agents = json.loads((DOCS / "agent.json").read_text(encoding="utf-8"))["measured"]
    tables = {
        "baselines.md": {"baselines": baselines(study), "times": times(study)},
        "choosing.md": {
            "freedom": freedom(study),
            "sobol": number_of_checks(agents, "candidates", "sobol", (16, 64, 256, 512)),
            "checks": number_of_checks(agents, "checks", "viaq", (0, 4, 16, 64)),
            "budget": budget(study),
        },
    }
    written = {}
    for page, named in tables.items():
        text = (DOCS / page).read_text(encoding="utf-8")
        for name, rows in named.items():
            block = f"<!-- table:{name} -->\n{rows}\n<!-- end -->"
            text, found = re.subn(f"<!-- table:{name} -->\n.*?<!-- end -->", block, text, flags=re.DOTALL)
            assert found == 1, f"{page} must have one table {name}"
        written[page] = text
    return written


def baselines(study: Any) -> str:
    """Return the table of success rates."""
    rows = [
        [label, *(_success(study, task, name, kind, scenes) for task in TASKS for scenes in SETS)]
        for label, name, kind in BASELINES
    ]
    return _table(["method", *(cell for task in TASKS for cell in (f"{task} `test`", "`hard`"))], rows)


def times(study: Any) -> str:
    """Return the table of decision times."""
    names = [(f"`{name}`", name) for name in TIMED] + [(name, f"{name.lower()} alone") for name in LEARNED]
    measured = [study["environments"][f"viapoint/{task}-v0"]["decision_time"] for task in TASKS]
    return _table(
        ["method", *TASKS],
        ([label, *(_milliseconds(each.get(name)) for each in measured)] for label, name in names),
    )


def freedom(study: Any) -> str:
    """Return the table of plans with more via-points and learned timing."""
    measured = study["freedom"]["viapoint/PlanarObstacles-v0"]["planner"]
    rows = []
    for k in (1, 2, 3):
        for timing in ("optimal", "learned"):
            one = measured["viaq" if (k, timing) == (1, "optimal") else f"viaq-k{k}-{timing}"]
            success, jerk, duration = (one[name][0] for name in ("success", "jerk", "duration"))
            rows.append([str(k), timing, _percent(success), f"{jerk:.2f}", f"{duration:.2f}"])
    return _table(["K", "timing", "success", "jerk", "duration"], rows)


def number_of_checks(agents: Any, head: str, kind: str, numbers: Iterable[int]) -> str:
    """Return the table of success rates and times against a number of checks or candidates."""
    rows = []
    for number in numbers:
        cells = [str(number)]
        for task in TASKS:
            measured = [agents[f"{task}-v0"][scenes][f"{kind}-{number}"] for scenes in SETS]
            cells += [_percent(statistics.mean(each["success"])) for each in measured]
            cells.append(_milliseconds(statistics.median(measured[0]["decision_time"])))
        rows.append(cells)
    return _table([head, *(cell for task in TASKS for cell in (f"{task} `test`", "`hard`", "time"))], rows)


def budget(study: Any) -> str:
    """Return the table of training times."""
    rows = []
    for name, task in study["environments"].items():
        (training,) = (method["training"] for method in task["methods"] if method["name"] == "viaq")
        wall = statistics.median(training["seconds"])
        rows.append([f"`{name.removeprefix('viapoint/')}`", f"{training['decisions']:,}"])
        rows[-1] += [f"{training['simulated_seconds'] / 3600.0:.1f} h", f"{wall / 60.0:.1f} min"]
    return _table(["task", "decisions", "simulated time", "wall time"], rows)


def _success(study: Any, task: str, name: str, kind: str, scenes: str) -> str:
    results = study["environments"][f"viapoint/{task}-v0"]
    for each in results["methods"] + results["baselines"]:
        if each["name"] == name:
            measured = each["sets"][scenes]
            return _percent((measured[kind] if kind else measured)["success"][0])
    return "-"


def _percent(rate: float) -> str:
    return f"{100.0 * rate:.1f} %".replace("100.0", "100")


def _milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.{0 if seconds >= 0.02 else 1}f} ms"


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines).replace(" --- ", "---")


if __name__ == "__main__":
    for page, text in pages().items():
        (DOCS / page).write_text(text, encoding="utf-8")
