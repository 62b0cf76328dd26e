"""Studies: what a YAML file may say, that nothing is done twice, and that pages hold what was measured."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from viapoint.training import Study, run_study
from viapoint.training.config.presets import PRESETS
from viapoint.training.io.files import read_json
from viapoint.training.study import jobs, run, timing
from viapoint.training.study.config import rows_of
from viapoint.training.study.page import effort, fill_tables, render_page, row, shown_bands, table
from viapoint.training.study.results import gather, unpacked

ENV, MOVING = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"
SMALL = {
    "seeds": [0, 1],
    "environments": {ENV: {"n_scenes": 8, "scenes": ["test", "hard"]}},
    "agents": {
        "viaq": {
            "n_timesteps": 64,
            "eval_scenes": 8,
            "checks": [0, 4],
            "untrained": True,
            "hyperparameters": {"policy_kwargs": {"candidates": 16}},
        }
    },
    "baselines": {
        "stored": None,
        "search{checks}": {"method": "search", "grid": {"checks": [16, 32]}},
        "in-time": {"method": "search", "time_of": "viaq/4"},
        "search-k{n_via}": {
            "method": "search",
            "checks": 16,
            "scenes": ["test"],
            "n_scenes": 4,
            "grid": {"env_kwargs.n_via": [2]},
        },
    },
    "compare": [["viaq", "viaq/untrained"], ["viaq/4", "search16"]],
}


def study_of(folder, **changes):
    return Study.from_dict({**SMALL, "out": str(folder), **changes}, name="small")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return folder, run_study(study_of(folder), workers=0)


def rows(record, env=ENV):
    return {each["row"]: each for each in record["environments"][env]["rows"]}


def test_every_row_is_that_of_its_files(done):
    folder, record = done
    found = rows(record)
    modes = ["viaq", "viaq/4", "viaq/untrained", "viaq/untrained/4"]
    assert list(found) == [*modes, "stored", "search16", "search32", "in-time", "search-k2"]
    for name in modes:
        for scenes in ("test", "hard"):
            mode = name.removeprefix("viaq").strip("/").replace("/", "-") or "alone"
            runs = [folder / "PlanarObstacles-v0" / "viaq" / f"seed-{seed}" for seed in (0, 1)]
            files = [read_json(each / "evaluations" / f"{scenes}.{mode}.json") for each in runs]
            each = [np.mean(file["outcomes"]["is_success"]) for file in files]
            assert found[name]["sets"][scenes]["each"] == pytest.approx(each)
        assert found[name]["seeds"] == [0, 1]
    assert found["stored"]["sets"]["test"]["success"][0] == 1.0
    assert found["stored"]["sets"]["test"]["jerk"] == [1.0, 1.0, 1.0]
    assert found["search-k2"]["sets"]["test"]["scenes"] == 4
    assert found["in-time"]["checks"] >= 4
    assert all(0.0 < found[name]["decision_time"] < 10.0 for name in (*modes, "search16", "in-time"))
    assert found["viaq"]["training"]["decisions"] == 64
    compared = record["environments"][ENV]["compared"]
    assert "probability" in compared[0]["sets"]["test"]
    assert set(compared[1]["sets"]["hard"]) == {"difference", "p_values"}


def test_the_page_and_the_figures_are_made_of_the_record(done):
    folder, record = done
    study = study_of(folder)
    text = (folder / "results.md").read_text()
    assert render_page(json.loads((folder / "results.json").read_text()), study.page) == text
    assert f"{100 * rows(record)['viaq']['sets']['test']['success'][0]:.1f} %" in text
    pictures = re.findall(r"\((figures/\S+\.png)\)", text)
    assert pictures == ["figures/results_planar_obstacles.png"]
    assert (folder / pictures[0]).stat().st_size < 80_000
    assert np.asarray(Image.open(folder / pictures[0]).convert("L")).std() > 5.0


def test_a_second_call_does_nothing_again(done, monkeypatch):
    folder, record = done

    def never(*args, **kwargs):
        pytest.fail("did again what was done")

    for module, name in ((jobs, "train"), (jobs, "evaluate_methods"), (run, "make_runner")):
        monkeypatch.setattr(module, name, never)
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    assert run_study(study_of(folder), workers=0) == record
    assert before == {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}


def test_what_is_lost_or_of_something_else_is_measured_again(done):
    folder, record = done
    lost = folder / "PlanarObstacles-v0" / "viaq" / "seed-1" / "evaluations" / "test.4.json"
    before = lost.read_bytes()
    for content in (None, {**json.loads(before), "weights": "of another agent"}):
        lost.unlink() if content is None else lost.write_text(json.dumps(content))
        assert rows(gather(study_of(folder)))["viaq/4"]["seeds"] == [0]
        assert run_study(study_of(folder), workers=0, only=["evaluate"]) == record
        assert lost.read_bytes() == before


def test_rows_are_measured_again_on_demand(done, tmp_path):
    """Only those that the patterns name, by the steps that run; a mark in each file shows which are made again."""
    folder, record = Path(shutil.copytree(done[0], tmp_path / "study")), done[1]
    measured = sorted((folder / "PlanarObstacles-v0").glob("**/test*.json"))
    for path in measured:
        path.write_text(json.dumps({**read_json(path), "mark": True}))
    lines = []
    again = run_study(
        study_of(folder),
        workers=0,
        only=["evaluate", "page"],
        redo=["viaq/untrained*", "PlanarObstacles-v0/viaq/4", "search16"],
        report=lines.append,
    )
    assert again == record
    assert [line for line in lines if "removed" in line] == [
        "PlanarObstacles-v0 viaq/4: 4 measurements removed",
        "PlanarObstacles-v0 viaq/untrained: 4 measurements removed",
        "PlanarObstacles-v0 viaq/untrained/4: 4 measurements removed",
        "PlanarObstacles-v0 search16: 0 measurements removed",
    ]
    made = {path.name for path in measured if "mark" not in read_json(path)}
    assert made == {"test.4.json", "test.untrained.json", "test.untrained-4.json"}
    run_study(study_of(folder), workers=0, only=["baselines", "time"], redo=["search16"], report=lines.append)
    assert "PlanarObstacles-v0 search16: 3 measurements removed" in lines  # two sets and a time
    with pytest.raises(ValueError, match=r"redo must match rows; .* viaq, viaq/4, .*; got 'viaqs'"):
        run_study(study_of(folder), workers=0, redo=["viaq", "viaqs"])


def of_seeds(record, seeds):
    """Return a record in which the agent has been measured with some of its seeds only."""
    changed = json.loads(json.dumps(record))
    for each in changed["environments"][ENV]["rows"]:
        if each["kind"] == "agent":
            each["runs"] = [run for run in each["runs"] if run["seed"] in seeds]
            each["seeds"] = seeds
    return changed


def test_rows_outlive_their_files_and_grow_by_seed(done, tmp_path):
    folder, record = done
    assert rows(gather(study_of(tmp_path / "empty"))) == {}
    assert gather(study_of(tmp_path / "empty"), record) == record
    other = Path(shutil.copytree(folder, tmp_path / "study"))
    shutil.rmtree(other / "PlanarObstacles-v0" / "viaq" / "seed-1")
    grown = gather(study_of(other), of_seeds(record, [1]))
    assert [each["seeds"] for each in grown["environments"][ENV]["rows"][:4]] == [[0, 1]] * 4
    assert grown == record


def test_rows_without_runs_stay_until_as_many_seeds_are_measured(done):
    folder, record = done
    for seeds, expected in (([0], [0, 1]), ([0, 1, 2], [0, 1, 2])):
        earlier = of_seeds(record, seeds)
        for each in earlier["environments"][ENV]["rows"]:
            each["runs"] = []
        assert rows(gather(study_of(folder), earlier))["viaq"]["seeds"] == expected


def test_a_run_that_solves_nothing_replaces_an_earlier_one(done, tmp_path):
    folder, record = Path(shutil.copytree(done[0], tmp_path / "study")), done[1]
    path = folder / "PlanarObstacles-v0" / "viaq" / "seed-1" / "evaluations" / "test.4.json"
    measured = read_json(path)
    measured["outcomes"]["is_success"] = [0.0] * len(measured["outcomes"]["is_success"])
    path.write_text(json.dumps(measured))
    assert rows(gather(study_of(folder), record))["viaq/4"]["sets"]["test"]["each"][1] == 0.0


def test_the_solved_scenes_of_every_run_are_in_the_record(done):
    folder, record = done
    for each in rows(record)["viaq/4"]["runs"]:
        path = folder / "PlanarObstacles-v0" / "viaq" / f"seed-{each['seed']}" / "evaluations" / "hard.4.json"
        solved = unpacked(each["sets"]["hard"]["solved"], each["sets"]["hard"]["scenes"])
        assert solved.tolist() == [value > 0.5 for value in read_json(path)["outcomes"]["is_success"]]


def test_rows_of_other_scenes_do_not_stay(done, tmp_path):
    _, record = done
    changed = json.loads(json.dumps(record))
    changed["environments"][ENV]["sets"]["test"]["sha256"] = "of other scenes"
    found = rows(gather(study_of(tmp_path), changed))
    assert {name for each in found.values() for name in each["sets"]} == {"hard"}


@pytest.mark.parametrize("of", ["study", "preset"])
def test_rows_of_other_settings_do_not_stay(done, tmp_path, monkeypatch, of):
    _, record = done
    changes = {"baselines": [], "compare": []}
    if of == "study":  # in the record, a search of another kind has this name
        changes |= {"agents": {}, "baselines": ["search16"]}
    else:
        slower = dataclasses.replace(PRESETS["viaq"], hyperparameters=(("learning_rate", 1e-4),))
        monkeypatch.setitem(PRESETS, "viaq", slower)
    assert rows(gather(study_of(tmp_path, **changes), record)) == {}


def test_a_run_with_other_settings_is_refused_and_others_go_on(done):
    folder, _ = done
    other, lines = {"viaq": {**SMALL["agents"]["viaq"], "n_timesteps": 128}}, []
    study = study_of(folder, agents=other, seeds=[0], baselines=["straight"], compare=[])
    with pytest.raises(run.StudyFailedError, match="1 jobs failed: PlanarObstacles-v0 viaq seed 0"):
        run_study(study, workers=0, only=["train", "baselines"], report=lines.append)
    assert "was trained with other settings (n_timesteps)" in lines[1]
    assert "PlanarObstacles-v0 straight: test" in lines[2]


def test_what_is_interrupted_is_not_kept(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("viapoint.training.planners.baselines.StoredSolutions.decide", interrupted)
    study = study_of(tmp_path, agents={}, compare=[], baselines=["stored"])
    with pytest.raises(KeyboardInterrupt):
        run_study(study, workers=0, only=["baselines"])
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_grid_has_an_entry_for_each_point():
    agents = {
        "k{n_via}-{timing}": {
            "grid": {"env_kwargs.n_via": [1, 2], "env_kwargs.timing": ["optimal", "learned"]}
        },
        "sac": {"algo": "sac", "grid": {"hyperparameters.batch_size": [64]}, "label": "SAC of {batch_size}"},
        "ppo-step": {"algo": "ppo", "step_wise": True},
    }
    study = Study.from_dict({"environments": [ENV, MOVING], "agents": agents})
    found = {each.name: each for each in study.agents}
    assert list(found) == [
        "k1-optimal", "k1-learned", "k2-optimal", "k2-learned", "sac-batch_size=64", "ppo-step",
    ]  # fmt: skip
    assert found["k2-learned"].training["env_kwargs"] == {"n_via": 2, "timing": "learned"}
    assert found["sac-batch_size=64"].label == "SAC of 64"
    assert found["ppo-step"].environments == (ENV,)
    assert found["ppo-step"].config(study.environments[0], 0, Path("x")).env.endswith("ObstaclesStep-v0")
    assert rows_of(found["sac-batch_size=64"]) == ["sac-batch_size=64"]


def test_settings_of_the_policy_are_merged_with_those_of_the_preset(tmp_path):
    agents = {"sac": {"algo": "sac", "hyperparameters": {"policy_kwargs": {"critic": "minimum"}}}}
    study = Study.from_dict({"environments": [ENV], "agents": agents})
    policy = study.agents[0].config(study.environments[0], 0, tmp_path).hyperparameters["policy_kwargs"]
    assert policy["critic"] == "minimum"
    assert policy["net_arch"] == [256, 256]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"enviroments": [ENV]}, "the study: fields must be one of .*, got 'enviroments'; did you mean 'environments'"),
        ({"environments": ["viapoint/PlanarObstacle-v0"]}, f"id must be one of .*did you mean '{ENV}'"),
        ({"environments": []}, "environments must be a list of names"),
        ({"seeds": [0, 0]}, "seeds must hold at least one number and none twice"),
        ({"agents": {"a": {"algo": "sacc"}}}, "agents.a: algo must be one of .*did you mean 'sac'"),
        ({"agents": {"a": {"n_timestep": 5}}}, "agents.a: fields must be one of .*did you mean 'n_timesteps'"),
        ({"agents": {"a": {"n_timesteps": 0}}}, "agents.a in viapoint/PlanarObstacles-v0: n_timesteps must be"),
        ({"agents": {"a": {"seed": 3}}}, "got 'seed'; did you mean 'seeds'"),
        ({"agents": {"a": {"hyperparameters": {"batchsize": 3}}}}, "a.hyperparameters: .*you mean 'batch_size'"),
        ({"agents": {"a": {"algo": "sac", "checks": [4]}}}, "sac has no proposals to check"),
        ({"agents": {"a": {"environments": ["b"]}}}, "agents.a.environments must be one of"),
        ({"agents": {"a": {"grid": {"n_step.x": [1]}}}}, "agents.a.grid must be one of .*, got 'n_step'"),
        ({"agents": {"a-{x}": {"grid": {"n_timesteps": [64]}}}}, "got 'x'"),
        ({"baselines": ["magic"]}, "baselines.magic: method must be one of .*search"),
        ({"baselines": {"s": {"method": "search"}}}, "search needs checks, a number"),
        ({"baselines": {"s": {"method": "search", "time_of": "viaq"}}, "agents": {}}, "time_of must be one of"),
        ({"baselines": {"straight": {"checks": 4}}}, "checks and time_of are for search"),
        ({"baselines": {"unrevised": {"environments": [ENV]}}}, f"does not exist in {ENV}"),
        ({"agents": {"straight": {}}, "baselines": ["straight"]}, "straight is there twice"),
        ({"compare": [["viaq", "magic"]]}, "compare must be one of"),
        ({"page": {"template": "nowhere.j2"}}, "nowhere.j2 is missing"),
        ({"scenes": ["tests"]}, "must be one of .*did you mean 'test'"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_with_what_is_allowed(changes, reason):
    given = {"environments": [ENV], "agents": {"viaq": {}}, "baselines": [], **changes}
    with pytest.raises(ValueError, match=reason):
        Study.from_dict(given)


def test_a_file_is_named_in_its_errors(tmp_path):
    path = tmp_path / "bad.yaml"
    for content, reason in (
        ("agents: {}\n", "bad.yaml: environments must be"),
        ("a: [", "bad.yaml: cannot be read"),
    ):
        path.write_text(content)
        with pytest.raises(ValueError, match=reason):
            Study.from_yaml(path)
    with pytest.raises(ValueError, match=r"only must be some of train, .* got 'trian'"):
        run_study(Study.from_dict({"environments": [ENV]}), only=["trian"])


@pytest.mark.parametrize(
    ("stopped", "stalling", "words"),
    [
        (["stalled", "stalled"], 0.3, "100-200, until it stalled"),
        (["budget", "budget"], 0.3, "100-200, cut short"),
        (["budget", "stalled"], 0.3, "100-200, 1 of 2 cut short"),
        (["budget", "budget"], None, "100-200"),
    ],
)
def test_trainings_that_wait_for_a_stall_say_whether_it_came(stopped, stalling, words):
    made = {"training": {"stop_when_stalled": stalling}}
    row = {"made": made, "training": {"decisions": 100, "stopped": sorted(set(stopped))}}
    runs = [{"training": {"decisions": 100 * i, "stopped": each}} for i, each in enumerate(stopped, 1)]
    assert effort({**row, "runs": runs}) == words
    assert effort(row) == "100" + words[7:].replace("1 of 2 ", "")  # a record without its runs


def test_tables_of_other_pages_are_filled_in(done, tmp_path):
    _, record = done
    (tmp_path / "tables.j2").write_text(
        "{% macro rates() %}{% for each in chosen(record.environments['" + ENV + "'], ['viaq', 'magic']) %}"
        "{{ each.label }}: {{ each.sets.test.success | interval }}{% endfor %}{% endmacro %}"
    )
    page = Study.from_dict({"environments": [ENV], "page": {"tables": "tables.j2"}}, folder=tmp_path).page
    text = fill_tables(record, page, "a\n<!-- table:rates -->\nold\n<!-- end -->\nb", Path("x.md"))
    rate = 100 * row(record["environments"][ENV], "viaq")["sets"]["test"]["success"][0]
    assert text.startswith(f"a\n<!-- table:rates -->\n\nviaq: {rate:.1f} % (")
    assert text.endswith(")\n\n<!-- end -->\nb")
    with pytest.raises(ValueError, match=r"has a table other, and .*tables.j2 has no macro"):
        fill_tables(record, page, "<!-- table:other -->\n<!-- end -->", Path("x.md"))


def test_tables_leave_out_columns_of_zeros():
    text = table(
        [["method", "success", "collision", "jerk"], ["a", "1", "0.0 %", "-"], ["b", "2", "0.0 %", "-"]]
    )
    assert text.splitlines() == ["| method | success |", "| --- | ---: |", "| a | 1 |", "| b | 2 |"]


@pytest.mark.parametrize("power", [0.7, 1.0, 1.6])
@pytest.mark.parametrize("seconds", [0.0005, 0.004, 0.031, 0.5])
def test_a_search_of_equal_time_takes_nearly_the_whole_time(tmp_path, monkeypatch, power, seconds):
    study = study_of(tmp_path)
    (baseline,) = (each for each in study.baselines if each.name == "in-time")
    monkeypatch.setattr(timing, "method_of", lambda search, *_, **__: search.checks)
    monkeypatch.setattr(timing, "median_time", lambda _, checks, kwargs: 0.001 + 1e-5 * checks**power)
    checks, took = timing.checks_within(study.environments[0], baseline, seconds)
    assert took == pytest.approx(0.001 + 1e-5 * checks**power)
    if took > seconds:
        assert checks == timing.FEWEST_CHECKS
    else:
        assert took >= timing.NEARLY * seconds or checks == timing.MOST_CHECKS


def test_bands_of_few_scenes_are_left_out_unless_all_have_few():
    assert shown_bands({"bands": {"> 20 %": 110, "1-5 %": 25, "< 1 %": 6}}) == ["> 20 %", "1-5 %"]
    assert shown_bands({"bands": {"1-5 %": 4, "< 1 %": 3}}) == ["1-5 %"]
    assert shown_bands({"bands": {}}) == []


def test_a_search_of_more_via_points_is_timed_in_a_task_of_replanning(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "N_TIMED", 3)
    moving = {"viapoint/PlanarMovingObstacles-v0": {"n_scenes": 4}}
    searches = {"search-k{n_via}": SMALL["baselines"]["search-k{n_via}"]}
    study = study_of(tmp_path, environments=moving, agents={}, baselines=searches, compare=[])
    (line,) = timing.time_decisions(study)
    assert re.search(r"PlanarMovingObstacles-v0 search-k2: \d+\.\d+ ms", line)
