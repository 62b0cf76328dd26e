"""The table, the figures."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from viapoint.training.evaluation import report
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planners.baselines import StoredSolutions
from viapoint.training.plotting import plots

ENV = "viapoint/PlanarObstacles-v0"


class Still:
    """The straight line; its name is full of markup."""

    name = "still [bold]"

    def decide(self, observation, scenes):
        return np.zeros((len(scenes.goal), 3))


@pytest.fixture(scope="module")
def record(small_scenes):
    evaluation = evaluate_methods(
        [Still(), StoredSolutions(small_scenes)], small_scenes, ENV, time_decisions=False
    )
    return evaluation.to_dict()


def test_the_document_holds_every_method_and_metric(record, tmp_path):
    document, data = report.write(record, tmp_path / "new")
    lines = [line for line in document.read_text().splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert {len(line) for line in cells} == {len(cells[0])}
    assert [line[0] for line in cells[2:]] == ["still [bold]", "planner (stored)"]
    still = dict(zip(cells[0], cells[2], strict=True))
    summary = record["methods"]["planner (stored)"]
    planner = dict(zip(cells[0], cells[3], strict=True))
    assert still["success"] == "0.0 %"
    assert still["jerk ratio"] == "-"
    assert planner["success"] == f"{100 * summary['success']['rate']:.1f} %"
    assert planner["clearance [mm]"] == f"{1e3 * summary['min_clearance']:.1f}"
    assert "decision [ms]" not in cells[0]  # nobody was timed
    assert json.loads(data.read_text()) == record
    assert record["sha256"][:12] in document.read_text()


def test_families_have_columns_of_their_own(record):
    rate = {"rate": 0.25, "low": 0.1, "high": 0.5, "count": 1, "of": 4}
    summary = {**record["methods"]["still [bold]"], "success_by_family": {"cul-de-sac": rate}}
    heads, first, other = report.rows({**record, "methods": {"one": summary, **record["methods"]}})[:3]
    assert first[heads.index("cul-de-sac")] == "25.0 %"
    assert other[heads.index("cul-de-sac")] == "-"
    assert "cul-de-sac" not in report.rows(record)[0]


def test_the_printed_table_loses_nothing_to_markup(record):
    console = Console(width=100, record=True, file=io.StringIO())
    report.show(record, console)
    text = console.export_text()
    for word in ("[bold]", "clearance [mm]", "goal error [mm]", "0.0 %", ENV):
        assert word in text


def test_the_usual_five_methods_fit_a_terminal_of_80_columns(record):
    summary = {**record["methods"]["planner (stored)"], "decision_time": 0.863, "decision_time_98": 0.904}
    names = ("agent", "agent, 16 checks", "straight line", "random via-point", "planner")
    many = {**record, "methods": dict.fromkeys(names, summary)}
    console = Console(width=80, record=True, file=io.StringIO())
    report.show(many, console)
    text = console.export_text()
    for heading, cell, *_ in zip(*report.rows(many), strict=True):
        assert heading == "method" or any(heading in line and cell in line for line in text.splitlines())


def test_partial_results_say_so(record):
    partial = {**record["methods"]["still [bold]"], "partial": True, "scenes": 3}
    assert "partial: 3 scenes" in report.markdown({**record, "methods": {"x": partial}})


def pixels(path):
    return np.asarray(Image.open(path).convert("L"))


def test_pictures_are_drawn(record, tmp_path):
    rates = ({"rate": r, "low": r - 0.1, "high": r + 0.1} for r in (0.2, 0.5, 0.9))
    curve = [
        {"decisions": 10 * i, "simulated_seconds": 9.0 * i, "seconds": float(i), "success": rate}
        for i, rate in enumerate(rates)
    ]
    line = plots.learning_curve(tmp_path / "a" / "curve.png", curve)
    bars = plots.success_by_band(tmp_path / "bars.png", record)
    for path in (line, bars):
        assert pixels(path).shape[0] > 300
        assert pixels(path).std() > 5.0
    with pytest.raises(ValueError, match="never evaluated"):
        plots.learning_curve(tmp_path / "none.png", [])
