"""Hyperparameter search: what a file may say, which trials there are, and that none is lost or done twice."""

import json
import re
import shlex
import sys
import threading
from pathlib import Path

import optuna
import pytest
from filelock import FileLock
from optuna.trial import TrialState

from viapoint.training import TrainConfig
from viapoint.training.cli import main as cli
from viapoint.training.io.files import BadFileError, read_json, read_yaml
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import resolved
from viapoint.training.study import tuning as module
from viapoint.training.study.runners import LocalRunner
from viapoint.training.study.search_space import ATTEMPTS, ERROR, SearchSpace
from viapoint.training.study.tuning import MOST_REPEATS, Tuning, TuningStoppedError
from viapoint.training.study.tuning_report import importance, write_report

ROOT = Path(__file__).parents[2]
RATE = {"type": "float", "low": 1e-4, "high": 1e-2, "log": True}
BASE = {
    "env": "viapoint/PlanarReach-v0", "algo": "sac", "n_timesteps": 256, "n_envs": 32, "eval_every": 64,
    "eval_scenes": 8, "trials": 6, "pruner": {"name": "none"}, "parameters": {"learning_rate": RATE},
}  # fmt: skip


def search(**changes):
    return SearchSpace(**{**BASE, **changes})


@pytest.fixture
def trainings(monkeypatch):
    """Trainings that take no time: success depends on the learning rate; returns the configurations in turn."""
    seen = []

    def train(config, callback=None):
        seen.append(config)
        run = Run(config.folder) if config.resume else Run.create(resolved(config))
        rate = config.hyperparameters["learning_rate"]
        for decisions in range(0, config.n_timesteps + 1, config.eval_every):
            reached = 10.0 * rate * decisions / config.n_timesteps
            run.write_curve([*run.curve, {"decisions": decisions, "success": {"rate": reached}}])
            if callback is not None and decisions < config.n_timesteps:
                callback.num_timesteps = decisions
                callback._on_rollout_start()

        run.final.mkdir(exist_ok=True)
        return run

    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "check_models", lambda search: None)
    return seen


def drawn(tuning):
    return [(each.state, each.params, each.value) for each in tuning.trials]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"env": "viapoint/Nothing-v0"}, "env must be one of"),
        ({"algo": "dqn"}, "algo must be one of"),
        ({"speed": 1}, "not 'speed'"),
        ({"scenes": "test"}, "not 'scenes'"),
        ({"trials": 0}, "trials must be a whole number"),
        ({"seeds": [0, 0]}, "seeds must differ"),
        ({"seeds": [-1]}, "seed must be a whole number"),
        ({"objective": "test"}, "final, mean"),
        ({"parameters": {}}, "at least one parameter"),
        ({"parameters": {"tau": {"type": "real"}}}, "float, int, categorical"),
        ({"parameters": {"tau": {**RATE, "low": 1.0}}}, "low must be less than high, got 1.0 and 0.01"),
        ({"parameters": {"tau": {**RATE, "choices": [1]}}}, "not 'choices'"),
        ({"parameters": {"tau": {"type": "float", "low": 0.0, "high": 1.0, "log": True}}}, "parameter tau"),
        ({"parameters": {"batch_size": {"type": "int", "low": 1.5, "high": 8}}}, "number of type int, got 1.5"),
        ({"parameters": {"batch_size": {"type": "categorical", "choices": [1]}}}, "at least two"),
        ({"parameters": {"gamma": {"type": "float", "low": 0.5, "high": 1.5}}}, "gamma of sac must be"),
        ({"parameters": {"learning_rate.start": RATE}}, "learning_rate is 0.001, which has no parts"),
        ({"sampler": {"name": "magic"}}, "tpe, random"),
        ({"sampler": {"name": "tpe", "speed": 1}}, "not 'speed'"),
        ({"pruner": "magic"}, "none, median, percentile, successive_halving"),
        ({"pruner": {"name": "percentile", "percentile": 200.0}}, "ercentile must be between 0 and 100"),
        ({"first": [{"tau": 1}]}, "first names 'tau'"),
        ({"first": [{"learning_rate": 1.0}]}, "learning_rate = 1.0 in its entry 0, which is out of range"),
        ({"env_kwargs": {"num_envs": 2}}, "--n-envs"),
        ({"eval_every": 0}, "eval_every must be"),
    ],
)  # fmt: skip
def test_a_file_with_an_error_is_refused_in_one_line(changes, named, tmp_path, capsys):
    file = tmp_path / "search.yaml"
    file.write_text(json.dumps({**BASE, **changes}))
    with pytest.raises(SystemExit) as end:
        cli.main(["tune", str(file), "--out", str(tmp_path / "out")])
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert named in line
    assert end.value.code == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"parameters": {"speed": RATE}}, "no hyperparameter 'speed'"),
        ({"parameters": {"policy_kwargs.speed": RATE}}, "speed"),
        ({"env_kwargs": {"n_vi": 2}}, "n_vi"),
    ],
)
def test_what_no_model_can_have_is_refused_before_there_is_a_folder(changes, named, tmp_path):
    with pytest.raises(ValueError, match=named):
        Tuning.create(tmp_path / "out", search(**changes))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("a: 1\na: 2", "a is there twice"),
        ("- 1", "values by name"),
        ("a: [", "YAML"),
        ("a: !!python/name:os.system ''", "YAML"),
    ],
)
def test_yaml_is_plain_values_by_name(text, named, tmp_path):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(BadFileError, match=named):
        read_yaml(tmp_path / "a.yaml")


def test_numbers_are_those_of_python(tmp_path):
    (tmp_path / "a.yaml").write_text("a: [1e-4, -2E3, 1.5e-2, 3, auto_1e-3]")
    assert read_yaml(tmp_path / "a.yaml") == {"a": [1e-4, -2e3, 1.5e-2, 3, "auto_1e-3"]}


def test_parameters_reach_every_field():
    space = search(
        algo="viaq",
        hyperparameters={"policy_kwargs": {"heads": 2}},
        parameters={
            "learning_rate.start": RATE,
            "policy_kwargs.width": {"type": "int", "low": 8, "high": 16},
            "policy_kwargs.optimizer_kwargs.betas": {
                "type": "categorical",
                "choices": [[0.9, 0.99], [0.8, 0.9]],
            },
            "n_envs": {"type": "categorical", "choices": [16, 32]},
        },
    )
    for values in space.extremes():
        config = space.training(values, seed=7)
        assert config.seed == 7
        assert config.n_envs in (16, 32)
        assert config.hyperparameters["learning_rate"]["start"] == values["learning_rate.start"]
        assert config.hyperparameters["learning_rate"]["kind"] == "linear"
        assert config.hyperparameters["policy_kwargs"]["heads"] == 2
        assert isinstance(config.hyperparameters["policy_kwargs"]["optimizer_kwargs"]["betas"], list)


def test_a_search_improves_and_ends_with_its_number_of_trials(tmp_path, trainings):
    tuning = Tuning.create(tmp_path / "a", search(trials=30, first=[{"learning_rate": 2e-4}]))
    tuning.work(workers=0)
    assert tuning.trials[0].params == {"learning_rate": 2e-4}
    assert len(tuning.trials) == tuning.finished == 30
    half = [each.value for each in tuning.trials]
    assert sum(half[15:]) > 1.2 * sum(half[:15])
    assert tuning.best.value == max(half)
    tuning.work(workers=0)
    assert len(trainings) == 30
    tuning.work(32, workers=0)
    assert len(tuning.trials) == 32


def test_a_search_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path, trainings, monkeypatch):
    whole = Tuning.create(tmp_path / "whole", search())
    whole.work(workers=0)
    parts = Tuning.create(tmp_path / "parts", search())
    parts.work(2, workers=0)
    train = module.train
    monkeypatch.setattr(module, "train", lambda *_: (_ for _ in ()).throw(OSError("no space left on device")))
    with pytest.raises(TuningStoppedError, match="trial 2 ended without a result: OSError: no space left"):
        parts.work(workers=0)
    monkeypatch.setattr(module, "train", train)
    again = Tuning.create(tmp_path / "parts", search())
    again.work(workers=0)
    assert drawn(again) == drawn(whole)
    states = [each.state for each in again.study.trials]
    assert states.count(TrialState.FAIL) == 1
    (repeated,) = [each for each in again.trials if ATTEMPTS in each.user_attrs]
    assert repeated.user_attrs[ATTEMPTS] == [2]
    assert again.folder_of(repeated) == "trials/0002"


def test_a_trial_continues_the_run_of_its_earlier_attempt(tmp_path, trainings):
    tuning = Tuning.create(tmp_path / "a", search(trials=1))
    taken = tuning._next_trial(1)
    run = Run.create(
        resolved(tuning.search.training(taken.trial.params, 0, tmp_path / "a/trials/0000/seed-0"))
    )
    run.write_curve([{"decisions": 64, "success": {"rate": 0.5}}])
    run.final.mkdir()  # as Ctrl-C leaves it
    taken.lock.release()
    Tuning(tmp_path / "a").work(workers=0)
    assert [each.resume for each in trainings] == [True]
    assert tuning.best.value != 0.5


def test_a_run_that_had_ended_is_not_trained_again(tmp_path, trainings):
    tuning = Tuning.create(tmp_path / "a", search(trials=1))
    taken = tuning._next_trial(1)
    module.train(tuning.search.training(taken.trial.params, 0, tmp_path / "a/trials/0000/seed-0"))
    taken.lock.release()
    Tuning(tmp_path / "a").work(workers=0)
    assert len(trainings) == 1
    assert tuning.best.value == 10.0 * taken.trial.params["learning_rate"]


def test_an_earlier_attempt_may_still_be_writing_its_checkpoint(tmp_path, trainings, monkeypatch):
    config = search().training({"learning_rate": 1e-3}, 0, tmp_path / "run")
    Run.create(resolved(config))
    train, lock = module.train, FileLock(tmp_path / "run" / "lock", thread_local=False)
    lock.acquire()
    held = []
    monkeypatch.setattr(module, "train", lambda *each: (held.append(lock.is_locked), train(*each))[1])
    ending = threading.Timer(0.2, lock.release)
    ending.start()
    module._train(config, None)
    assert held == [False]
    (tmp_path / "run" / "final").rmdir()
    lock.acquire()
    monkeypatch.setattr(module, "SAVING_TIME", 0.1)
    module._train(config, None)  # which raises the error that names the other process
    assert held == [False, True]


def test_trials_of_living_processes_are_neither_repeated_nor_exceeded(tmp_path, trainings):
    one = Tuning.create(tmp_path / "a", search(trials=3))
    two = Tuning.create(tmp_path / "a", search(trials=3))
    taken = one._next_trial(3)
    two.work(workers=0)
    assert len(trainings) == 2
    assert [each.state.name for each in two.trials] == ["RUNNING", "COMPLETE", "COMPLETE"]
    assert len({each.params["learning_rate"] for each in two.trials}) == 3
    taken.lock.release()
    two.work(workers=0)
    assert [each.state.name for each in two.trials] == ["COMPLETE"] * 3
    assert two.trials[-1].params == taken.trial.params


def test_a_trial_that_ends_every_process_is_given_up(tmp_path, trainings):
    tuning = Tuning.create(tmp_path / "a", search(trials=1))
    for _ in range(MOST_REPEATS + 1):
        tuning._next_trial(1).lock.release()
    tuning.work(workers=0)
    (trial,) = tuning.trials
    assert "4 times" in trial.user_attrs[ERROR]
    assert trainings == []
    assert "4 times" in write_report(tuning).read_text()


def test_hopeless_trials_are_pruned(tmp_path, trainings):
    pruner = {"name": "median", "n_startup_trials": 2, "n_warmup_steps": 64}
    given = [{"learning_rate": rate} for rate in (1e-3, 2e-3, 5e-4, 4e-3)]
    tuning = Tuning.create(tmp_path / "a", search(trials=4, first=given, pruner=pruner, seeds=[3, 4]))
    tuning.work(workers=0)
    assert [each.state.name for each in tuning.trials] == ["COMPLETE", "COMPLETE", "PRUNED", "COMPLETE"]
    assert tuning.trials[2].last_step == 64  # before training nothing counts
    assert [each.seed for each in trainings] == [3, 4, 3, 4, 3, 3, 4]
    assert tuning.trials[3].intermediate_values == pytest.approx({64: 0.01, 128: 0.02, 192: 0.03, 256: 0.04})


def test_successive_halving_compares_with_trials_of_other_processes(tmp_path, trainings):
    pruner = {"name": "successive_halving", "min_resource": 64, "reduction_factor": 2}
    given = [{"learning_rate": rate} for rate in (4e-3, 1e-3, 5e-4)]
    tuning = Tuning.create(tmp_path / "a", search(trials=3, first=given, pruner=pruner))
    tuning.work(workers=0)
    assert [each.state.name for each in tuning.trials] == ["COMPLETE", "PRUNED", "PRUNED"]


def test_a_trial_that_cannot_be_trained_is_told_and_does_not_stop_the_others(
    tmp_path, trainings, monkeypatch
):
    train = module.train

    def some(config, callback=None):
        if config.hyperparameters["learning_rate"] > 1e-3:
            raise ValueError("too fast")
        return train(config, callback)

    monkeypatch.setattr(module, "train", some)
    tuning = Tuning.create(tmp_path / "a", search(first=[{"learning_rate": 2e-3}]))
    tuning.work(workers=0)
    assert tuning.finished == 6
    assert tuning.trials[0].user_attrs[ERROR] == "too fast"
    assert "* trial 0: too fast" in write_report(tuning).read_text()


def test_a_folder_holds_one_search(tmp_path, trainings):
    Tuning.create(tmp_path / "a", search())
    assert Tuning.create(tmp_path / "a", search(trials=9)).trials == []
    with pytest.raises(BadFileError, match="n_timesteps = 256, not 512"):
        Tuning.create(tmp_path / "a", search(n_timesteps=512))
    record = read_json(tmp_path / "a" / "tuning.json")
    (tmp_path / "a" / "tuning.json").write_text(json.dumps({**record, "viapoint": "9.9"}))
    with pytest.raises(BadFileError, match=r"a search by viapoint 9\.9"):
        Tuning.create(tmp_path / "a", search())
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "file").write_text("")
    with pytest.raises(BadFileError, match="holds no search"):
        Tuning.create(tmp_path / "b", search())


def test_the_command_trains_reports_and_names_a_command_that_trains_the_best(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(module, "make_runner", lambda on, root, workers: LocalRunner(root, 0))
    file = tmp_path / "search.yaml"
    small = {"learning_starts": 32, "gradient_steps": 1}
    nets = {"type": "categorical", "choices": [[8], [8, 8]]}
    file.write_text(
        json.dumps({
            **BASE, "n_timesteps": 96, "trials": 2, "hyperparameters": small,
            "parameters": {"learning_rate": RATE, "policy_kwargs.net_arch": nets},
        })
    )  # fmt: skip
    for _ in range(2):
        cli.main(["tune", str(file), "--out", str(tmp_path / "out")])
    told = capsys.readouterr().out.splitlines()
    assert len([line for line in told if line.startswith("trial ")]) == 2
    assert f"{tmp_path / 'out'}: 2 of 2 trials are finished" in told
    report = (tmp_path / "out" / "report.md").read_text()
    assert "8 shipped validation scenes" in report
    (command,) = [line for line in report.splitlines() if line.startswith("viapoint train")]
    best = TrainConfig.from_json(read_json(tmp_path / "out" / "best.json"))
    config = cli.parse(shlex.split(command)[1:])
    assert config.hyperparameters == best.hyperparameters
    assert best.hyperparameters.keys() == {
        "learning_starts",
        "gradient_steps",
        "learning_rate",
        "policy_kwargs",
    }
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1000
    assert not list((tmp_path / "out" / "trials").glob("*/*/checkpoints"))
    first, second = read_json(tmp_path / "out" / "trials.json")["trials"]
    assert first["parameters"]["policy_kwargs.net_arch"] in ([8], [8, 8])
    assert first["validation"].keys() == {"64", "96"}
    assert (second["state"], len(second["scores"])) == ("complete", 1)


def test_the_important_parameter_is_found(tmp_path, trainings):
    space = search(
        trials=30,
        sampler={"name": "random", "seed": 1},
        parameters={"learning_rate": RATE, "tau": {"type": "float", "low": 0.1, "high": 0.9}},
    )
    tuning = Tuning.create(tmp_path / "a", space)
    tuning.work(2, workers=0)
    assert importance(tuning) == {}
    tuning.work(workers=0)
    assert importance(tuning)["learning_rate"] > 0.6


def test_without_optuna_the_command_names_the_extra(tmp_path, capsys, monkeypatch):
    for name in [
        each for each in sys.modules if each.startswith(("optuna", "viapoint.training.study.tuning"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "viapoint.training.study.search_space")
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(SystemExit):
        cli.main(["tune", str(tmp_path / "search.yaml")])
    (line,) = capsys.readouterr().err.splitlines()
    assert "the extra `tuning` (not installed: optuna): pip install 'viapoint[tuning]'" in line


def test_journals_are_those_of_optuna(tmp_path, trainings):
    """Other tools of Optuna, such as its dashboard, read the folder."""
    Tuning.create(tmp_path / "a", search(trials=2)).work(workers=0)
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / "a" / "journal.log"))
    study = optuna.load_study(study_name=None, storage=optuna.storages.JournalStorage(backend))
    assert len(study.trials) == 2


def test_the_shipped_files_and_the_one_on_the_page_are_searches(tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "tuning.md").read_text(), re.DOTALL)
    (tmp_path / "page.yaml").write_text(example)
    for path in (tmp_path / "page.yaml", *sorted((ROOT / "benchmarks" / "tuning").glob("*.yaml"))):
        assert SearchSpace.read(path).distributions()
