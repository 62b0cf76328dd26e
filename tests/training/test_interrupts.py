"""Ctrl-C, a second run in the folder and a full disk, with real processes: nothing is lost, and it is said what is."""

import errno
import json
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from viapoint.training.agents.model_io import load_model
from viapoint.training.cli import main as cli
from viapoint.training.config.configs import TrainConfig
from viapoint.training.io.files import BadFileError, read_arrays
from viapoint.training.runs import run_dir
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import TrainingFailedError, train

ENV = "viapoint/PlanarObstacles-v0"
TINY = {"learning_starts": 32, "gradient_steps": 1, "batch_size": 16, "buffer_size": 4000}
SMALL = {**TINY, "policy_kwargs": {"net_arch": [16]}}
PATIENCE = 300.0
"""Longest wait for another process, [s]; it ends as soon as there is what is waited for."""


def config(folder, **changes):
    values = {
        "env": ENV, "algo": "sac", "out": folder, "n_timesteps": 320, "n_envs": 32, "eval_every": 0,
        "checkpoint_every": 64, "env_kwargs": {"threads": 1}, "hyperparameters": SMALL, "progress": False,
    }  # fmt: skip
    return TrainConfig(**{**values, **changes})


@pytest.fixture
def start():
    """Starts the command in a process of its own."""
    processes = []

    def start(*words):
        script = "from viapoint.training.cli.main import main; main()"
        process = subprocess.Popen(
            [sys.executable, "-c", script, *map(str, words)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def wait_for(process, what):
    until = time.monotonic() + PATIENCE
    while not what():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < until
        time.sleep(0.02)


def test_ctrl_c_in_training_saves_and_nobody_else_gets_in(start, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(run_dir, "PATIENCE", 0.0)
    folder = tmp_path / "run"
    words = "--algo sac --n-timesteps 1000000 --n-envs 32 --eval-every 0 --checkpoint-every 64 --env-kwargs threads=1"
    more = [f"{name}={json.dumps(value)}" for name, value in SMALL.items()]
    process = start("train", "--out", folder, *words.split(), "--hyperparameters", *more)
    wait_for(process, lambda: len(list(folder.glob("checkpoints/0*"))) == 2)
    for words in (["--resume"], []):
        with pytest.raises(SystemExit):
            cli.main(["train", "--out", str(folder), *words])
    in_use, another = capsys.readouterr().err.splitlines()
    assert str(process.pid) in in_use
    assert "--resume" in another
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    run = Run(folder)
    assert load_model(folder / "final").num_timesteps == run.decisions > 64
    before = run.decisions
    resumed = train(TrainConfig(out=folder, resume=True, n_timesteps=before + 32, progress=False))
    assert resumed.decisions == before + 32


def test_ctrl_c_in_an_evaluation_leaves_what_is_finished_and_says_that_it_is_partial(
    start, small_scenes, tmp_path
):
    small_scenes.save(tmp_path / "scenes.npz")
    out = tmp_path / "out.json"
    words = ["evaluate", "--env", ENV, "--scenes", tmp_path / "scenes.npz", "--json", out]
    process = start(*words, "--baselines", "straight", "random80", "search512")
    seen = ""
    while "straight line" not in seen:  # it is done, and the next method is at work
        read = process.stderr.read(1)
        assert read, seen
        seen += read
    process.send_signal(signal.SIGINT)
    process.wait(PATIENCE)
    assert process.returncode == 130
    record = json.loads(out.read_text())
    assert record["partial"] is True
    assert record["methods"]["straight line"]["scenes"] == 40
    assert record["methods"]["straight line"]["partial"] is False
    assert "search, 512 checks" not in record["methods"]


def test_a_partial_evaluation_replaces_no_whole_one(tmp_path, monkeypatch, shipped):
    run = train(config(tmp_path / "run", n_timesteps=32))
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
    with pytest.raises(TrainingFailedError, match=r"tensors\.safetensors.*--resume") as error:
        train(config(tmp_path / "run"))
    assert error.value.__cause__.errno in (errno.EFBIG, errno.ENOSPC)
    run = Run(tmp_path / "run")
    assert 0 < run.decisions < 320
    assert not list(run.folder.rglob(".*.part"))
    full_disk()  # there is room again
    resumed = train(TrainConfig(out=run.folder, resume=True, progress=False))
    whole = train(config(tmp_path / "whole"))
    same_arrays(*(each.folder / "final" / "weights.safetensors" for each in (resumed, whole)))


def same_arrays(one, other):
    one, other = read_arrays(one), read_arrays(other)
    assert set(one) == set(other)
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def test_other_versions_are_told(tmp_path, capsys):
    run = train(config(tmp_path / "run", n_timesteps=32))
    (run.folder / "versions.json").write_text(json.dumps({**run.versions, "mujoco": "3.3.0"}))
    train(TrainConfig(out=run.folder, resume=True, n_timesteps=64, progress=False))
    assert "mujoco 3.3.0" in capsys.readouterr().err
    (run.folder / "versions.json").write_text(json.dumps({"viapoint": "7.2.0"}))
    (run.folder / "config.json").write_text(json.dumps({"colour": "red"}))
    with pytest.raises(BadFileError, match=r"7\.2\.0"):
        Run(run.folder)


def test_half_a_training_and_the_other_half_are_a_whole_one(tmp_path):
    """With a constant learning rate even where the first half was meant to be all."""
    whole = train(config(tmp_path / "whole", n_timesteps=128))
    train(config(tmp_path / "halves", n_timesteps=64))
    halves = train(TrainConfig(out=tmp_path / "halves", resume=True, n_timesteps=128, progress=False))
    same_arrays(*(run.checkpoints()[-1] / "tensors.safetensors" for run in (whole, halves)))
