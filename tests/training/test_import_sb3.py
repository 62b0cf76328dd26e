"""An archive of Stable-Baselines3 becomes a model of tensors and JSON; nobody opens one unasked."""

import base64
import io
import json
import pickle
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3

from viapoint.training.algorithms.model_io import load_model
from viapoint.training.algorithms.sb3_archive import algorithm_of
from viapoint.training.cli import archives
from viapoint.training.cli import main as cli
from viapoint.training.io.files import BadFileError

ENV = "viapoint/PlanarObstacles-v0"
KINDS = {"ppo": PPO, "sac": SAC, "td3": TD3, "tqc": TQC}


def archive(kind, path, env_id=ENV, **more):
    """What a user of SB3 has."""
    more = {"n_steps": 8, "batch_size": 8} if kind is PPO else {"buffer_size": 10}
    small = {"policy_kwargs": {"net_arch": [16]}, "seed": 0, "device": "cpu"}
    model = kind("MultiInputPolicy", gym.make(env_id), **small, **more)
    model.save(path)
    return model


def words(path, out, *more):
    return ["import-sb3", str(path), "--env", ENV, "--out", str(out), *more]


@pytest.mark.parametrize("algo", KINDS)
def test_it_decides_as_it_did(algo, tmp_path, capsys):
    theirs = archive(KINDS[algo], tmp_path / "model.zip")
    cli.main(words(tmp_path / "model.zip", tmp_path / "out", "--trust"))
    told = capsys.readouterr()
    assert "runs whatever code" in told.err
    assert f"viapoint evaluate {tmp_path / 'out'}" in told.out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["model.json", "weights.safetensors"]
    mine = load_model(tmp_path / "out")
    observation, _ = gym.make_vec(ENV, num_envs=20).reset(seed=0)
    for each in (theirs, mine):
        each.policy.set_training_mode(False)
    expected = theirs.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(mine.predict(observation, deterministic=True)[0], expected)


def test_it_can_be_measured(shipped, tmp_path, capsys):
    archive(PPO, tmp_path / "model.zip")
    cli.main(words(tmp_path / "model.zip", tmp_path / "out", "--trust"))
    cli.main(["evaluate", str(tmp_path / "out"), "--baselines", "straight", "--n-scenes", "6"])
    assert "agent" in capsys.readouterr().out


class Canary:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.fixture
def evil(tmp_path):
    """An archive that makes a file when it is opened."""
    archive(PPO, tmp_path / "good.zip")
    code = base64.b64encode(pickle.dumps(Canary(tmp_path / "canary"))).decode()
    with zipfile.ZipFile(tmp_path / "good.zip") as good, zipfile.ZipFile(tmp_path / "evil.zip", "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name == "data":
                content = json.dumps({**json.loads(content), "extra": {":type:": "x", ":serialized:": code}})
            bad.writestr(name, content)
    return tmp_path / "evil.zip"


def test_nothing_is_opened_unasked(evil, tmp_path, capsys, monkeypatch):
    with pytest.raises(SystemExit) as end:
        cli.main(words(evil, tmp_path / "out"))  # nobody can be asked here
    assert end.value.code == 2
    assert "--trust" in capsys.readouterr().err
    for answer, opened in (("", False), ("y", False), ("no", False), ("yes", True)):
        monkeypatch.setattr(archives.sys, "stdin", Terminal())
        monkeypatch.setattr("builtins.input", lambda question, answer=answer: answer)
        if opened:
            cli.main(words(evil, tmp_path / "out"))
        else:
            with pytest.raises(SystemExit):
                cli.main(words(evil, tmp_path / "out"))
        assert (tmp_path / "canary").exists() is opened  # the danger is real, and only where it was asked for
        assert (tmp_path / "out").exists() is opened


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_what_is_no_such_archive_is_refused_unopened(tmp_path, capsys):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        file.writestr("data", "{}")
        file.writestr("policy.pth", b"")
    for name, bytes_, reason in (
        ("missing", None, "is missing"),
        ("text", b"text", "is no archive"),
        ("half", content.getvalue()[: len(content.getvalue()) // 2], "is no archive"),
        ("none", content.getvalue(), "is of none of"),
    ):
        if bytes_ is not None:
            (tmp_path / name).write_bytes(bytes_)
        with pytest.raises(BadFileError, match=reason):
            algorithm_of(tmp_path / name)
        with pytest.raises(SystemExit):
            cli.main(words(tmp_path / name, tmp_path / "out", "--trust"))
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_is_refused(tmp_path):
    archive(PPO, tmp_path / "other.zip", "viapoint/PlanarReach-v0")
    with pytest.raises(BadFileError, match="cannot be opened as PPO for viapoint/PlanarObstacles-v0"):
        archives.convert(tmp_path / "other.zip", "ppo", ENV, tmp_path / "out")
    with pytest.raises(BadFileError, match="cannot be opened as SAC"):
        archives.convert(tmp_path / "other.zip", "sac", ENV, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    with pytest.raises(BadFileError, match="is not empty"):
        archives.import_sb3(cli.parse(words(tmp_path / "other.zip", tmp_path / "full", "--trust")))
