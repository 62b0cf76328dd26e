"""The study behind docs/results.md: done once, gone on with, and its page made of files alone."""

import copy
import dataclasses
import json
import os
import re
from pathlib import Path

import learning
import numpy as np
import pytest
from PIL import Image
from study import aggregate, jobs, page
from study.plan import ABLATIONS, FREEDOM, WHOLE, Cell, Study, split_settings

from viapoint.training.io.files import read_json
from viapoint.training.runs.run_dir import Run

ENV = "viapoint/PlanarObstacles-v0"
DOCS = Path(__file__).parents[2] / "docs"


def words(folder, *more):
    fixed = f"--out {folder}/runs --docs {folder}/docs --envs {ENV} --methods viaq --jobs 0"
    tiny = "--n-timesteps 64 --n-scenes 8 --checks 16 --tables results --baselines stored random16 search16"
    return [*f"{fixed} {tiny}".split(), *more]


def study_of(folder, **changes):
    fixed = {"out": folder / "runs", "docs": folder / "docs", "envs": (ENV,), "methods": ("viaq",)}
    tiny = {"n_timesteps": 64, "n_scenes": 8, "checks": 16, "tables": ("results",)}
    return Study(**{**fixed, **tiny, "seeds": (0, 1), **changes})


STEPS = ("--only", "train", "evaluate", "baselines", "page", "--seeds", "0", "1")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    assert learning.main(words(folder, *STEPS)) == 0
    return folder


def cells_of(text, label):
    line = next(line for line in text.splitlines() if line.startswith(f"| {label} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_page_is_made_of_the_files(done):
    text, record = (done / "docs" / "results.md").read_text(), read_json(done / "docs" / "results.json")
    assert page.page(record) == text
    success = []
    for seed in (0, 1):
        run = Run(done / "runs" / "PlanarObstacles-v0" / "viaq" / f"seed-{seed}")
        outcomes = read_json(run.folder / "evaluations" / "study-test.json")["methods"]["checked"]["outcomes"]
        success.append(outcomes["is_success"])
    cells = cells_of(text, "viaq, checked proposals")
    assert cells[1] == "2"
    assert cells[2].startswith(f"{100 * np.mean(success):.1f} % (")
    assert "64" in cells  # decisions
    assert cells_of(text, "planner (stored)")[2].startswith("100.0 %")
    assert "All of them are in." in text
    assert "**A trial, not a result**: n_timesteps = 64, n_scenes = 8" in text


def test_the_figure_is_small(done):
    path = done / "docs" / "images" / page.figure_name(ENV)
    assert path.name == "results_planar_obstacles.png"
    assert f"images/{path.name}" in (done / "docs" / "results.md").read_text()
    assert path.stat().st_size < 80_000
    assert np.asarray(Image.open(path).convert("L")).std() > 5.0


def test_a_second_call_does_nothing_again(done, monkeypatch):
    assert all(
        job.done() for job in jobs.all_jobs(study_of(done, baselines=("stored", "random16", "search16")))
    )

    def never(*args, **kwargs):
        pytest.fail("did again what was done")

    before = {path: path.read_bytes() for path in (done / "docs").rglob("*.*")}
    for name in ("train", "evaluate_methods"):
        monkeypatch.setattr(jobs, name, never)
    assert learning.main(words(done, *STEPS)) == 0
    assert before == {path: path.read_bytes() for path in (done / "docs").rglob("*.*")}


def test_what_is_lost_is_measured_again(done, monkeypatch):
    measured, evaluate = [], jobs.evaluate_methods

    def counted(methods, *rest, **kwargs):
        measured.append([method.name for method in methods])
        return evaluate(methods, *rest, **kwargs)

    monkeypatch.setattr(jobs, "evaluate_methods", counted)
    lost = done / "runs" / "PlanarObstacles-v0" / "viaq" / "seed-1" / "evaluations" / "study-test.json"
    before = lost.read_bytes()
    lost.unlink()
    assert (
        "test" not in aggregate.aggregate(study_of(done))["environments"][ENV]["methods"][0]["sets"]
    )  # half is nothing
    assert learning.main(words(done, *STEPS)) == 0
    assert measured == [["alone", "checked", "untrained"]]
    assert lost.read_bytes() == before
    record = json.loads(before)
    lost.write_text(json.dumps({**record, "weights": "of another agent"}))
    assert learning.main(words(done, *STEPS)) == 0
    assert lost.read_bytes() == before


def test_what_is_interrupted_is_not_kept(monkeypatch, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.StoredSolutions, "decide", interrupted)
    with pytest.raises(KeyboardInterrupt):
        jobs.baseline(ENV, "stored", study_of(tmp_path))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_partial_study_says_which_seeds_are_in(done):
    record = aggregate.aggregate(study_of(done, seeds=(0, 1, 2)))
    text = page.page(record)
    assert "Seeds asked for: 0, 1, 2." in text
    assert "**Not all of them are in**; what there is: PlanarObstacles-v0, viaq: 0, 1." in text


def test_a_run_with_other_settings_is_refused_and_left_out(done, capsys):
    assert learning.main(words(done, "--only", "train", "--n-timesteps", "128", "--seeds", "0")) == 1
    assert "was trained with other settings (n_timesteps)" in capsys.readouterr().err
    other = study_of(done, n_timesteps=128)
    assert aggregate.finished(ENV, WHOLE, other) == []
    assert "None is in yet." in page.page(aggregate.aggregate(other))


def test_decisions_are_timed_once(done):
    study = study_of(done, baselines=("random16",))
    jobs.time_decisions(study)
    times = read_json(jobs.timings_path(ENV, study))
    assert set(times) == {"random16", "viaq alone", "viaq checked", "viaq untrained"}
    assert all(0.0 < each["median"] < 10.0 for each in times.values())
    jobs.time_decisions(study)
    assert read_json(jobs.timings_path(ENV, study)) == times
    assert aggregate.aggregate(study)["environments"][ENV]["decision_time"]["random16"] == pytest.approx(
        times["random16"]["median"], abs=1e-6
    )


def test_failures_add_up(done):
    record = read_json(done / "docs" / "results.json")["environments"][ENV]
    success = record["methods"][0]["sets"]["test"]
    assert set(record["failures"]["test"]) == {"alone", "checked"}
    for way, kinds in record["failures"]["test"].items():
        share = sum(kind["share"] for kind in kinds.values())
        assert share == pytest.approx(1.0 - np.mean(success[way]["each"]), abs=1e-5)


def synthetic(record, names, gains):
    """Entries of other variants, each a copy of the whole agent that is so much better in every band."""
    whole = record["environments"][ENV]["methods"][0]
    found = []
    for name, gain in zip(names, gains, strict=True):
        entry = copy.deepcopy(whole) | {"name": name, "label": name}
        for way in entry["sets"]["test"].values():
            way["by_band"] = {band: [0.5 + gain, 0.45 + gain, 0.55 + gain] for band in way["by_band"]}
        found.append(entry)
    return found


def test_ablations_and_freedom_are_told_by_band(done):
    record = read_json(done / "docs" / "results.json")
    record["ablations"] = {
        ENV: synthetic(record, [each.name for each in ABLATIONS], np.linspace(0, -0.4, len(ABLATIONS)))
    }
    record["freedom"] = {
        ENV: {
            "agents": synthetic(record, [each.name for each in FREEDOM], (0, 0.02, -0.1, 0, 0, 0.2)),
            "planner": {},
        }
    }
    text = page.page(record)
    assert "What each part contributes: PlanarObstacles-v0" in text
    assert cells_of(text, "viaq-no-refinement")
    answer = next(line for line in text.splitlines() if line.startswith("Best in each band"))
    assert answer.count("viaq-k3-learned, +20.0 points, the intervals are apart") == len(
        record["environments"][ENV]["sets"]["test"]["bands"]
    )
    record["freedom"][ENV]["agents"].pop()
    answer = next(line for line in page.page(record).splitlines() if line.startswith("Best in each band"))
    assert "viaq, " not in answer
    assert "+2.0 points, the intervals overlap" in answer


def test_settings_go_where_they_are_taken():
    assert split_settings({"temperature": 0.2, "width": 8}) == {
        "temperature": 0.2,
        "policy_kwargs": {"width": 8},
    }
    with pytest.raises(ValueError, match="neither ViaQ nor its policy has a setting 'colour'"):
        split_settings({"colour": 1})


def test_trainings_are_ordered_by_seed_and_shared_between_tables(tmp_path):
    cells = Study(out=tmp_path, seeds=(3, 5)).cells()
    assert len(cells) == len({(cell.env, cell.variant.name, cell.seed) for cell in cells})
    assert [cell.seed for cell in cells] == sorted(cell.seed for cell in cells)
    folders = {cell.folder(Study(out=tmp_path)) for cell in cells}
    assert len(folders) == len(cells)
    two = next(cell for cell in cells if cell.variant.name == "viaq-k2-learned")
    assert two.training(Study(out=tmp_path)).env_kwargs == {"n_via": 2, "timing": "learned"}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"envs": ("viapoint/Nothing-v0",)}, "envs must be among"),
        ({"methods": ("dqn",)}, "methods must be among"),
        ({"baselines": ("magic",)}, "baselines must be among"),
        ({"seeds": ()}, "seeds must name"),
        ({"jobs": -1}, "jobs must be 0 or more"),
    ],
)
def test_a_study_of_nothing_is_refused(changes, named, tmp_path):
    with pytest.raises(ValueError, match=named):
        study_of(tmp_path, **changes)


def test_one_job_that_fails_does_not_stop_the_others(tmp_path, monkeypatch):
    study = study_of(tmp_path)

    def job(label, function, *arguments):
        return jobs.Job(label, function, arguments, jobs.has_planned)

    queue = [
        job("dead", os._exit, 7),
        job("custom", jobs.read_json, tmp_path / "nothing.json"),  # an error that cannot be pickled
    ]
    monkeypatch.setattr(jobs.Job, "done", lambda self: False)
    failed = dict(learning.run_jobs(queue, 1))
    assert set(failed) == {"dead", "custom"}
    assert "ended with code 7" in failed["dead"]
    assert "nothing.json: is missing" in failed["custom"]
    here = [job("bad", jobs.scenes, "nowhere", ENV, study), job("good", jobs.cores)]
    failed = learning.run_jobs(here, 0)
    assert [label for label, _ in failed] == ["bad"]
    assert "scenes must be one of" in failed[0][1]


def test_a_cell_that_cannot_be_trained_says_why(tmp_path):
    study = study_of(tmp_path)
    variant = dataclasses.replace(WHOLE, name="strange", settings={"colour": 1})
    with pytest.raises(ValueError, match="setting 'colour'"):
        jobs.train_and_evaluate(Cell(env=ENV, variant=variant, seed=0), study)


def test_no_number_of_the_page_is_typed_by_hand():
    record = read_json(DOCS / "results.json")
    assert page.page(record) == (DOCS / "results.md").read_text()
    for name in re.findall(r"images/(\S+\.png)", page.page(record)):
        assert (DOCS / "images" / name).stat().st_size < 150_000
