"""A page of results that grows: nothing is lost, nothing is mixed that does not belong together."""

import copy
import json
from pathlib import Path

import learning
from study import aggregate
from study.merge import merged
from study.plan import METHODS, WHOLE

from viapoint.training.io.files import read_json

ENV = "viapoint/PlanarObstacles-v0"
DOCS = Path(__file__).parents[2] / "docs"


def part(record, names):
    """The record of a machine that measured some of the methods only."""
    some = copy.deepcopy(record)
    for each in some["environments"].values():
        each["methods"] = [method for method in each["methods"] if method["name"] in names]
        each["curves"] = {name: curve for name, curve in each["curves"].items() if name in names}
        if WHOLE.name not in names:
            each["failures"] = {name: {} for name in each["failures"]}
            each["compared"] = {name: {} for name in each["compared"]}
        each["improvement"] = aggregate.improvement(each["methods"])
    return some


def test_parts_that_were_measured_apart_make_the_whole_page():
    record = read_json(DOCS / "results.json")
    assert merged(record, record) == record
    whole, others = part(record, [WHOLE.name]), part(record, [each.name for each in METHODS[1:]])
    whole["ablations"], others["freedom"] = {}, {}
    for env in list(others["environments"])[1:]:
        others["environments"][env]["baselines"] = []
    assert merged(whole, others) == record
    assert merged(others, whole) == record


def test_of_one_method_the_entry_with_more_seeds_is_kept():
    record = read_json(DOCS / "results.json")
    fewer = part(record, [WHOLE.name])
    for each in fewer["environments"].values():
        each["methods"][0] = {**each["methods"][0], "seeds": [0], "label": "again"}
    there = [each["methods"][0] for each in merged(fewer, record)["environments"].values()]
    assert [each["label"] == "again" for each in there] == [
        len(each["methods"][0]["seeds"]) == 1 for each in record["environments"].values()
    ]


def test_an_entry_that_tells_less_replaces_nothing():
    """Such as of agents that are trained and not yet measured, or measured without the planner beside them."""
    record = read_json(DOCS / "results.json")
    unmeasured, alone, first = (copy.deepcopy(record) for _ in range(3))
    for each in unmeasured["environments"].values():
        each["failures"], each["compared"] = {}, {}
        for method in each["methods"]:
            method["sets"] = {}
    for each in alone["environments"].values():
        for method in each["methods"]:
            for way in (way for found in method["sets"].values() for way in found.values()):
                way["jerk"] = way["duration"] = None
    for each in first["environments"].values():
        for baseline in each["baselines"]:
            baseline["sets"].pop("hard", None)
    for less in (unmeasured, alone, first):
        assert merged(less, record) == record


def test_numbers_of_other_scenes_or_other_conditions_are_not_mixed(tmp_path, capsys):
    record = read_json(DOCS / "results.json")
    other = part(record, ["sac"])
    other["environments"][ENV]["sets"]["test"]["sha256"] = "of other scenes"
    other["ablations"], other["freedom"] = {}, {}
    result = merged(other, record)
    assert [each["name"] for each in result["environments"][ENV]["methods"]] == ["sac"]
    assert (result["ablations"], result["freedom"]) == ({}, {})
    words = f"--out {tmp_path}/runs --docs {tmp_path}/docs --n-timesteps 64"
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "results.json").write_text(json.dumps(record))
    assert learning.main([*words.split(), "--only", "train", "page"]) == 1
    assert "holds results with trial = " in capsys.readouterr().err
    assert read_json(tmp_path / "docs" / "results.json") == record
    assert not (tmp_path / "runs").exists()
