"""Studies: what a file means, what is refused, and that a study which was killed ends alike."""

import doctest
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import yaml
from helpers import PLANE

from viapoint.training import Study, run_study
from viapoint.training.study import COLUMNS, StudyFailedError, _connected

FEW = {"learning_starts": 64, "gradient_steps": 1}
TRAINING = {
    "n_timesteps": 128, "n_envs": 32, "eval_every": 64, "eval_scenes": 8, "checkpoint_every": 64,
    "hyperparameters": FEW, "env_kwargs": {"threads": 1},
}  # fmt: skip
QUICK = {**FEW, "policy_kwargs": {"candidates": 32, "refinements": 0}}
VIAQ = {"viaq": {**TRAINING, "hyperparameters": QUICK}}
GIVEN = {
    "environments": [PLANE],
    "scenes": ["test"],
    "n_scenes": 12,
    "seeds": [0, 1],
    "agents": {**VIAQ, "sac": {"algo": "sac", "seeds": [0], **TRAINING}},
    "baselines": ["straight", "search64"],
}
GAMMA = {"parameters": {"hyperparameters.gamma": [0.9]}}
ONE_AGENT = {**GIVEN, "agents": VIAQ, "baselines": []}


def results_in(folder):
    """Return what may not depend on where and in how many pieces a study ran: weights, successes and curves."""
    found = {}
    for path in sorted(folder.glob("PlanarObstacles-v0/*/*/result.json")):
        record = json.loads(path.read_text())
        successes = [line["solved"] for line in record["rows"]]
        weights = [each.read_bytes() for each in path.parent.glob("best/weights.safetensors")]
        found[path.relative_to(folder).as_posix()] = (successes, record.get("curve"), weights)
    return found


@pytest.fixture(scope="module")
def ray():
    """One Ray for all studies of this process, as each start takes seconds."""
    with _connected(2):
        yield


@pytest.fixture(scope="module")
def whole(ray, tmp_path_factory):
    """A study that ran through: its folder, table, lines and results."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    told = []
    table = run_study(Study.from_dict(GIVEN), out=folder, told=told.append)
    return folder, table, told, results_in(folder)


def test_tables_hold_every_row_and_a_second_call_does_nothing(whole):
    folder, table, told, before = whole
    assert list(table.columns) == COLUMNS
    assert len(told) == 6  # how much there is to do; two and one seeds of two agents, and two baselines
    rows = table.set_index("method")
    assert set(rows.index) == {"viaq", "sac", "straight", "search64"}
    assert rows.seeds.to_dict() == {"viaq": 2, "sac": 1, "straight": 1, "search64": 1}
    assert (rows.scenes == 12).all()
    assert ((rows.low <= rows.success) & (rows.success <= rows.high)).all()
    assert rows.success["search64"] > 0.5
    assert rows.success["straight"] == 0.0
    assert rows.decisions["viaq"] == 128
    pd.testing.assert_frame_equal(pd.read_csv(folder / "results.csv"), table, check_dtype=False)
    assert "| straight" in (folder / "results.md").read_text()
    assert (folder / "PlanarObstacles-v0.png").stat().st_size > 10_000
    again, lines = run_study(Study.from_dict(GIVEN), out=folder), []
    pd.testing.assert_frame_equal(again, table, check_dtype=False)
    assert results_in(folder) == before
    more = {**GIVEN, "baselines": [*GIVEN["baselines"], "random"]}
    assert len(run_study(Study.from_dict(more), out=folder, told=lines.append)) == len(table) + 1
    assert len(lines) == 2


def test_other_settings_of_a_trained_row_are_an_error_and_its_run_stays(whole, tmp_path):
    folder = shutil.copytree(whole[0], tmp_path / "out")
    before = results_in(folder)
    changed = {**TRAINING, "hyperparameters": {**QUICK, "batch_size": 8}}
    other = {**ONE_AGENT, "seeds": [0], "agents": {"viaq": changed}}
    with pytest.raises(StudyFailedError, match="other settings"):
        run_study(Study.from_dict(other), out=folder)
    assert results_in(folder) == before


def test_a_killed_study_goes_on_to_the_same_results(whole, tmp_path):
    """It is killed when its first training has a checkpoint and is not complete."""
    folder = tmp_path / "out"
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(ONE_AGENT))
    command = "from viapoint.training.cli.entry import main; main()"
    words = [sys.executable, "-c", command, "study", "study.yaml", "--out", str(folder)]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 120.0
    while not list(folder.glob("*/*/*/checkpoints/0*")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    complete = len(results_in(folder))
    assert complete < 2
    lines = []
    run_study(Study.from_dict(ONE_AGENT), out=folder, told=lines.append)
    assert len(lines) == 3 - complete
    assert results_in(folder) == {name: each for name, each in whole[3].items() if "/viaq/" in name}


def test_a_search_writes_its_best_settings_and_a_command_for_them(ray, tmp_path):
    parameters = {
        "hyperparameters.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
        "hyperparameters.batch_size": [16, 32],
    }
    first = [{"hyperparameters.learning_rate": 1e-3, "hyperparameters.batch_size": 32}]
    search = {**TRAINING, "algo": "sac", "trials": 2}
    search |= {"parameters": parameters, "first": first}
    study = Study.from_dict({"environments": [PLANE], "searches": {"tuned": search}})
    told = []
    assert run_study(study, out=tmp_path / "out", told=told.append).empty
    place = tmp_path / "out" / "PlanarObstacles-v0" / "tuned"
    trials = pd.read_csv(place / "trials.csv")
    assert len(trials) == 2
    assert trials["hyperparameters.learning_rate"].between(1e-4, 1e-2).all()
    assert set(trials["hyperparameters.batch_size"]) <= {16, 32}
    assert (trials["hyperparameters.learning_rate"] == 1e-3).any()
    best = json.loads((place / "best.json").read_text())
    assert best["success"] == trials.success[trials.decisions == trials.decisions.max()].max()
    assert "batch_size=" in best["command"]
    lines = []
    run_study(study, out=tmp_path / "out", told=lines.append)
    assert not lines


def test_grids_and_checks_make_rows():
    grid = {"hyperparameters.batch_size": [64, 128], "env_kwargs.n_via": [1, 2]}
    given = {"environments": [PLANE], "seeds": [3], "agents": {"sac": {"grid": grid}}}
    trials = Study.from_dict(given).trials
    assert [trial.row for trial in trials] == [
        f"sac-batch_size={size}-n_via={number}" for size in (64, 128) for number in (1, 2)
    ]
    config = trials[-1].config(trials[-1].folder(Path("out")))
    assert config.folder == Path("out/PlanarObstacles-v0/sac-batch_size=128-n_via=2/seed-3")
    assert config.hyperparameters == {"batch_size": 128}
    assert config.env_kwargs == {"n_via": 2}
    assert (config.seed, config.algorithm) == (3, "sac")  # as the row says


def test_the_examples_of_the_page_and_of_the_function_run(ray):
    page = Path(__file__).parents[2] / "docs" / "studies.md"
    (example,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    exec(compile(example, page, "exec"), {})
    finder = doctest.DocTestFinder(recurse=False)
    for each in finder.find(run_study, "run_study", globs={}):
        assert doctest.DocTestRunner().run(each).failed == 0


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for out in (tmp_path, tmp_path / "notes.txt", ""):
        with pytest.raises(ValueError):
            run_study(Study.from_dict(GIVEN), out=out)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "change",
    [
        {"environments": []},
        *({"environments": given} for given in (5, [{"id": PLANE}])),
        *({"agents": {"viaq": {"environments": given}}} for given in (5, [{"id": PLANE}], ["PandaReach"])),
        {"environments": {"a": {"id": "CartPole-v1"}}},
        {"environments": {"a": {"id": PLANE, "env_kwargs": {"num_envs": 3}}}},
        {"environments": {"../a": {"id": PLANE}}},
        *({"environments": {name: {"id": PLANE}, "a-b": {"id": PLANE}}} for name in ("a/b", "results.csv")),
        *({"agents": {"sac-1": {name: value}}} for name, value in (("algo", "viaq"), ("arm", "panda"))),
        {"agents": {"a": {"algo": "viarank"}}},
        {"seed": [0]},
        {"seeds": [0, 0]},
        {"n_scenes": 0},
        *({"scenes": names} for names in (["tset"], ["test", "test"])),
        *({"agents": {"viaq": {"checks": checks}}} for checks in ([-1], 16)),
        {"agents": {"sac": {"algo": "sac", "checks": [16]}}},
        *({"agents": {"viaq": {"hyperparameters": {name: 0}}}} for name in ("batchsize", "batch_size")),
        {"agents": {"viaq": {"seed": 3}}},
        *({"agents": {"viaq": {"grid": {"hyperparameters.gamma": given}}}} for given in (0.9, [2.0])),
        {"agents": {"straight": {}}},  # the name of a baseline
        *({"baselines": [name]} for name in ("serach64", "search0")),
        {"baselines": {"straight": {"checks": 3}}},
        {"searches": {"a": {"parameters": {}}}},
        {"searches": {"a": {"parameters": {"hyperparameters.gamma": {"low": 2.0, "high": 1.5}}}}},
        {"searches": {"a": {"parameters": {"hyperparameters.gamma": {"low": 0.5, "high": 1.5}}}}},
        {"searches": {"a": {"parameters": {"hyperparameters.gamma": {"low": 0.5, "high": 0.9, "step": 1}}}}},
        {"searches": {"a": {"parameters": {"speed": [1, 2]}}}},
        *({"searches": {"a": {**GAMMA, **other}}} for other in ({"trials": 0}, {"eval_every": 0})),
        {"searches": {"a": {**GAMMA, "first": [{"gamma": 0.9}]}}},
        {"agents": {}, "baselines": []},
    ],
)
def test_what_cannot_be_run_is_an_error_when_the_file_is_read(change, tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump({**GIVEN, **change}))
    with pytest.raises(ValueError):
        Study.from_yaml(path)
