"""The table, the figures."""

import io
import json

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from viapoint.training.evaluation import report
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planning.baselines import make_method
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
        [Still(), make_method("search32", ENV)], small_scenes, ENV, time_decisions=False
    )
    return evaluation.to_dict()


def test_the_document_holds_every_method_and_metric(record, tmp_path):
    report.write(record, tmp_path / "new")
    document, data = (tmp_path / "new" / f"table.{suffix}" for suffix in ("md", "json"))
    lines = [line for line in document.read_text().splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert {len(line) for line in cells} == {len(cells[0])}
    assert [line[0] for line in cells[2:]] == ["still [bold]", "search32"]
    summary = record["methods"]["search32"]
    search = dict(zip(cells[0], cells[3], strict=True))
    assert search["success"] == f"{100 * summary['success']['rate']:.1f} %"
    assert search["clearance [mm]"] == f"{1e3 * summary['min_clearance']:.1f}"
    assert json.loads(data.read_text()) == record
    assert record["sha256"][:12] in document.read_text()
    rate = summary["success"]["rate"]
    csv = pd.read_csv(io.StringIO(report.formatted(record, "csv"))).set_index("method")
    assert csv["success rate"]["search32"] == rate
    parsed = json.loads(report.formatted(record, "json"))
    assert parsed["methods"]["search32"]["success"]["rate"] == rate
    assert f"{100 * rate:.1f} %" in report.formatted(record, "table")


@pytest.mark.parametrize("number", [1, 5, 12])
def test_the_table_fits_a_terminal_of_80_columns(record, number):
    (summary, *_) = record["methods"].values()
    names = [f"untrained, {16 * i} checks" for i in range(number)]
    shown = report.text({**record, "methods": dict.fromkeys(names, summary)})
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.count("untrained") == number


def test_pictures_are_drawn(record, tmp_path):
    rates = ({"rate": r, "low": r - 0.1, "high": r + 0.1} for r in (0.2, 0.5, 0.9))
    curve = [{"decisions": 10 * i, "seconds": float(i), "success": rate} for i, rate in enumerate(rates)]
    line = plots.learning_curve(tmp_path / "a" / "curve.png", curve)
    bars = plots.success_by_band(tmp_path / "bars.png", record)
    for path in (line, bars):
        assert np.asarray(Image.open(path).convert("L")).std() > 5.0
