"""The page of results, and the tables of other pages, are those that the study makes of its record."""

import hashlib
import json
import re
from pathlib import Path

import pytest

from viapoint.training import Study
from viapoint.training.study.config import rows_of
from viapoint.training.study.page import fill_tables, render_page

ROOT = Path(__file__).parents[2]
AGAIN = "run viapoint study benchmarks/results.yaml --only page"


@pytest.fixture(scope="module")
def study():
    return Study.from_yaml(ROOT / "benchmarks" / "results.yaml")


@pytest.fixture(scope="module")
def record(study):
    return json.loads((ROOT / study.page.record).read_text(encoding="utf-8"))


def test_no_number_of_the_page_is_typed_by_hand(study, record):
    text = render_page(record, study.page)
    assert text == (ROOT / study.page.file).read_text(encoding="utf-8"), AGAIN
    pictures = re.findall(r"\((images/results_\S+\.png)\)", text)
    assert pictures
    for name in [*pictures, "images/agent_checks.png"]:
        assert (ROOT / "docs" / name).stat().st_size < 150_000


def test_tables_are_those_of_the_measurements(study, record):
    assert len(study.page.into) > 3
    for path in study.page.into:
        text = (ROOT / path).read_text(encoding="utf-8")
        assert "<!-- table:" in text, path
        assert fill_tables(record, study.page, text, path) == text, f"{path}: {AGAIN}"


def test_every_table_of_a_study_is_on_a_page_that_it_fills(study):
    setups = Study.from_yaml(ROOT / "benchmarks" / "setups.yaml").page
    text, record = (ROOT / setups.into[0]).read_text(), json.loads((ROOT / setups.record).read_text())
    assert fill_tables(record, setups, text, setups.into[0]) == text, "viapoint study benchmarks/setups.yaml"
    pages = [ROOT / path for path in (*study.page.into, *setups.into)]
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        there = re.search(r"^<!-- table:", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        assert path in pages or not there, path


def test_shipped_agents_are_those_of_seed_0(record):
    first = {
        name: run["weights"]
        for name, numbers in record["environments"].items()
        for each in numbers["rows"]
        for run in each["runs"]
        if each["row"] == "viaq" and run["seed"] == 0 and "weights" in run
    }
    assert first
    for name, weights in first.items():
        shipped = ROOT / "training" / "pretrained" / name.removeprefix("viapoint/") / "weights.safetensors"
        assert hashlib.sha256(shipped.read_bytes()).hexdigest() == weights, name


def test_the_record_holds_rows_of_the_study_alone(study, record):
    agents = {row for agent in study.agents for row in rows_of(agent)}
    known = agents | {each.name for each in study.baselines}
    for numbers in record["environments"].values():
        assert {each["row"] for each in numbers["rows"]} <= known
        for each in numbers["rows"]:
            for found in each["sets"].values():
                estimate, low, high = found["success"]
                assert 0.0 <= low <= estimate + 1e-6
                assert estimate - 1e-6 <= high <= 1.0
