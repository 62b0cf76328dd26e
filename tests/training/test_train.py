"""Training leaves what it promises, learns, and goes on as if it had never stopped."""

import dataclasses
import errno
import itertools
import json
import math
import os
import resource
import shlex
import signal

import numpy as np
import pytest
import torch
from helpers import MOVING, PANDA, PLANE, STEP
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from viapoint.training import Run, TrainConfig, ViaVecEnv, train, trainer
from viapoint.training.agents.model_io import load_model
from viapoint.training.cli import entry as cli
from viapoint.training.configs import PRESETS
from viapoint.training.evaluation import evaluate_methods
from viapoint.training.files import BadFileError, read_arrays
from viapoint.training.planning.baselines import agent_method
from viapoint.training.runs import read_state
from viapoint.training.scene_sets import scenes_for
from viapoint.training.trainer import TrainingFailedError, TrainingStoppedError

OFF_POLICY = {"learning_starts": 32, "gradient_steps": 2, "batch_size": 16}
TINY = {
    "viaq": {**OFF_POLICY, "policy_kwargs": {"candidates": 32, "refinements": 1, "per_refinement": 16}},
    "sac": {**OFF_POLICY, "buffer_size": 96},
    "td3": {**OFF_POLICY, "buffer_size": 400},
    "ppo": {"n_steps": 2, "batch_size": 16, "n_epochs": 2},
    "tqc": {**OFF_POLICY, "use_sde": True},
}
STEPS = 192


def config(folder, algo="viaq", **changes):
    values = {"out": folder, "algo": algo, "n_timesteps": STEPS, "n_envs": 16, "progress": False}
    values |= {"eval_every": 64, "eval_scenes": 8, "checkpoint_every": 64}
    values |= {"env_kwargs": {"threads": 1}, "hyperparameters": TINY[algo]}
    return TrainConfig(**{**values, **changes})


def curve(run):
    return [{**record, "seconds": None} for record in run.curve]


def same_weights(one, other, name):
    first, second = (read_arrays(run.folder / name / "weights.safetensors") for run in (one, other))
    assert set(first) == set(second)
    for part in first:
        np.testing.assert_array_equal(first[part], second[part], err_msg=f"{name} {part}")


def same_result(one, other):
    assert curve(one) == curve(other)
    same_weights(one, other, one.best.name)
    same_weights(one, other, "final")
    same_state(*(read_state(run.checkpoints()[-1]) for run in (one, other)))


def same_state(one, other, name=""):
    """All but the times at which episodes ended."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"t", "seconds"}:
            same_state(one[key], other[key], f"{name}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for each, theirs in zip(one, other, strict=True):
            same_state(each, theirs, name)
    else:
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other, name


def after_steps(monkeypatch, steps, event):
    step_wait = ViaVecEnv.step_wait
    number = itertools.count()

    def step(self):
        if next(number) == steps:
            event()
        return step_wait(self)

    monkeypatch.setattr(ViaVecEnv, "step_wait", step)


def die():
    raise SystemError("killed")


def press_ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


def go_on(run, **changes):
    return train(TrainConfig(out=run.folder, resume=True, progress=False, **changes))


@pytest.mark.parametrize(
    ("env_id", "algo"), [(MOVING, "viaq"), (STEP, "sac"), (PLANE, "td3"), (PLANE, "ppo"), (PLANE, "tqc")]
)
def test_a_killed_run_resumes_to_the_same_result(env_id, algo, tmp_path, monkeypatch):
    whole = train(config(tmp_path / "whole", algo, env=env_id))
    assert whole.decisions >= STEPS
    with monkeypatch.context() as patch:
        after_steps(patch, 7, die)  # between the checkpoints at 64 and 128 decisions
        with pytest.raises(SystemError):
            train(config(tmp_path / "killed", algo, env=env_id))
    killed = Run(tmp_path / "killed")
    assert 0 < killed.decisions < STEPS
    same_result(whole, go_on(killed))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of viaq that nothing stops."""
    return train(config(tmp_path_factory.mktemp("whole") / "run"))


def test_a_run_is_the_same_watched_or_not(whole, tmp_path):
    alone = train(config(tmp_path / "alone", eval_every=0, checkpoint_every=10_000))
    same_weights(whole, alone, "final")
    assert alone.curve == []
    assert alone.best.name == "final"


def test_what_a_run_leaves(tmp_path, capsys):
    run = train(config(tmp_path / "run", progress=True))
    assert [record["decisions"] for record in run.curve] == [0, 64, 128, 192]
    told = capsys.readouterr().err  # a line for each validation, and no bar
    assert len(told.strip().splitlines()) == 4
    assert "\r" not in told
    for name in ("physics_steps", "seconds"):
        assert (np.diff([record[name] for record in run.curve]) > 0.0).all()
    best = max(record["success"]["rate"] for record in run.curve)
    assert run.best.name == "best"
    method = agent_method("agent", load_model(run.best))
    scenes = scenes_for("validation", run.config.task, 8)
    (again,) = evaluate_methods([method], scenes, PLANE, time_decisions=False).results
    assert again.success.mean() == best

    events = EventAccumulator(str(run.folder / "tensorboard"))
    events.Reload()
    assert {"rollout/success_rate", "rollout/duration"} <= set(events.Tags()["scalars"])
    for name in ("success", "min_clearance", "goal_error"):
        values = [record[name]["rate"] if name == "success" else record[name] for record in run.curve]
        logged = events.Scalars(f"validation/{name}_rate" if name == "success" else f"validation/{name}")
        assert [event.step for event in logged] == [0, 64, 128, 192]
        assert [event.value for event in logged] == pytest.approx(values, rel=1e-6)


def test_ctrl_c_is_heard_after_the_last_decision_too(tmp_path, monkeypatch):
    """A demo that trains first would go on with its evaluation."""
    save = Run.save

    def interrupted(self, name, model):
        if name == "final":
            press_ctrl_c()
        return save(self, name, model)

    monkeypatch.setattr(Run, "save", interrupted)
    with pytest.raises(TrainingStoppedError):
        train(config(tmp_path / "run"))
    assert Run(tmp_path / "run").ended


def test_ctrl_c_saves_and_leaves_and_the_rest_follows(whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        after_steps(patch, 4, press_ctrl_c)
        with pytest.raises(TrainingStoppedError, match="go on with") as stop:
            train(config(tmp_path / "stopped", checkpoint_every=10_000))
    told = shlex.split(str(stop.value).partition("go on with: ")[2])
    resume = cli.parse(told[1:])
    assert (resume.folder, resume.resume) == (tmp_path / "stopped", True)
    assert stop.value.exit_code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    stopped = Run(tmp_path / "stopped")
    assert stopped.decisions == 80
    assert load_model(stopped.folder / "final").num_timesteps == 80
    same_result(whole, go_on(stopped))


STALLING = {"stop_when_stalled": 0.4, "n_timesteps": 640}


def with_success(monkeypatch, rates):
    """Let validations at 0, 64, 128, ... decisions find these rates of success; presets are of 128 decisions."""
    for algo, preset in PRESETS.items():
        monkeypatch.setitem(PRESETS, algo, dataclasses.replace(preset, n_timesteps=128))
    evaluate = trainer.evaluate

    def measured(agent, **kwargs):
        result = evaluate(agent, **kwargs)
        rate = rates[agent.num_timesteps // 64]
        (only,) = result.results
        number = len(only.success)
        only.outcomes["is_success"][:] = np.arange(number) < round(rate * number)
        return result

    monkeypatch.setattr(trainer, "evaluate", measured)


@pytest.mark.parametrize("algo", ["viaq", "ppo"])
def test_a_training_that_stalls_ends_there_also_if_it_was_interrupted(algo, tmp_path, monkeypatch, shipped):
    with_success(monkeypatch, [0.0, 0.1, 0.2, 0.5, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0])
    heard = Heard()
    run = train(config(tmp_path / "run", algo, **STALLING), heard)
    # Success rises at 192 decisions; at 320, 128 of them are 40 %.
    assert [record["decisions"] for record in run.curve] == [0, 64, 128, 192, 256, 320]
    assert (run.stalled, run.ended, run.decisions) == (True, True, 320)
    assert load_model(run.final).num_timesteps == 320
    assert heard.ended == 1
    same_result(run, go_on(run, n_timesteps=1280))
    with monkeypatch.context() as patch:
        after_steps(patch, 18, die)  # between the checkpoints at 256 and 320 decisions
        with pytest.raises(SystemError):
            train(config(tmp_path / "killed", algo, **STALLING))
    killed = Run(tmp_path / "killed")
    assert (killed.stalled, killed.ended, killed.decisions) == (False, False, 256)
    same_result(run, go_on(killed))


@pytest.mark.parametrize("algo", ["viaq", "ppo"])
def test_a_training_that_a_callback_stops_goes_on_to_the_same_result(algo, tmp_path):
    whole = train(config(tmp_path / "whole", algo, eval_every=0))
    heard = Heard(steps=5)  # of PPO, the first of two steps before an update
    stopped = train(config(tmp_path / "stopped", algo, eval_every=0), [heard])
    assert stopped.decisions == (96 if algo == "ppo" else 80)
    assert load_model(stopped.final).num_timesteps == stopped.decisions
    assert heard.ended == 1
    same_result(whole, go_on(stopped))


class Heard(BaseCallback):
    """Callback that counts its ends, and stops the training after some steps."""

    ended = 0

    def __init__(self, steps=math.inf):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        return self.n_calls < self.steps

    def _on_training_end(self):
        self.ended += 1


@pytest.mark.parametrize(("given", "env_id"), [({}, PANDA), ({"env": PLANE}, PLANE)])
def test_an_environment_that_is_named_keeps_its_id_with_any_arm(given, env_id):
    config = TrainConfig(arm="panda", **given)
    assert (config.env, config.task.arm.name) == (env_id, "panda")


def test_a_run_keeps_its_settings_when_the_presets_change(tmp_path, monkeypatch):
    run = train(config(tmp_path / "run", n_timesteps=64))
    preset = dataclasses.replace(PRESETS["viaq"], n_envs=3, hyperparameters={"learning_rate": 0.5})
    monkeypatch.setitem(PRESETS, "viaq", preset)
    assert go_on(run, n_timesteps=128).decisions == 128


def small(folder, **changes):
    """Training of a small network with a large buffer."""
    learning = {**OFF_POLICY, "buffer_size": 4000, "policy_kwargs": {"net_arch": [16]}}
    usual = {"n_timesteps": 320, "n_envs": 32, "eval_every": 0, "hyperparameters": learning}
    return config(folder, "sac", **{**usual, **changes})


def test_a_partial_evaluation_replaces_no_whole_one(tmp_path, monkeypatch, shipped):
    run = train(small(tmp_path / "run", n_timesteps=32))
    words = ["evaluate", str(run.folder), "--baselines", "straight", "random", "--n-scenes", "4"]
    cli.main(words)
    kept = run.folder / "evaluations"
    (path,) = kept.iterdir()
    whole = path.read_text()

    def interrupted(self, observation, scenes):
        raise KeyboardInterrupt

    monkeypatch.setattr("viapoint.training.planning.baselines.RandomVias.decide", interrupted)
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert end.value.code == 130
    assert path.read_text() == whole
    assert json.loads(path.with_suffix(".partial.json").read_text())["partial"] is True


@pytest.fixture
def full_disk():
    """Files larger than 300 kB cannot be written, as on a full disk, by the system's own refusal."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, hard))
    yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_stops_training_and_keeps_what_was_there(full_disk, tmp_path):
    with pytest.raises(TrainingFailedError, match=r"\.pt.*--resume") as error:
        train(small(tmp_path / "run"))
    assert error.value.__cause__.errno in (errno.EFBIG, errno.ENOSPC)
    run = Run(tmp_path / "run")
    assert 0 < run.decisions < 320
    assert not list(run.folder.rglob(".*.part"))
    full_disk()  # there is room again
    same_weights(go_on(run), train(small(tmp_path / "whole")), "final")


def test_other_versions_are_told(tmp_path, capsys):
    run = train(small(tmp_path / "run", n_timesteps=32))
    (run.folder / "versions.json").write_text(json.dumps({**run.versions, "mujoco": "3.3.0"}))
    go_on(run, n_timesteps=64)
    assert "mujoco 3.3.0" in capsys.readouterr().err
    (run.folder / "versions.json").write_text(json.dumps({"viapoint": "7.2.0"}))
    (run.folder / "config.json").write_text(json.dumps({"colour": "red"}))
    with pytest.raises(BadFileError, match=r"7\.2\.0"):
        Run(run.folder)


def test_what_cannot_learn_is_told(tmp_path, capsys):
    train(small(tmp_path / "a", n_timesteps=32))
    assert "not updated once" in capsys.readouterr().err
    train(small(tmp_path / "b", n_timesteps=64, env_kwargs={"threads": 1, "n_via": 0}))
    told = capsys.readouterr().err
    assert "n_via=0" in told
    assert "updated" not in told


def test_half_a_training_and_the_other_half_are_a_whole_one(tmp_path):
    """With a constant learning rate even where the first half was meant to be all."""
    whole = train(small(tmp_path / "whole", n_timesteps=128))
    halves = go_on(train(small(tmp_path / "halves", n_timesteps=64)), n_timesteps=128)
    one, other = (read_state(run.checkpoints()[-1]) for run in (whole, halves))
    for state in (one, other):  # what was meant to be all differs
        del state["arrays"]["counters"]["_total_timesteps"]
        del state["arrays"]["counters"]["_current_progress_remaining"]
    same_state(one, other)
