"""Models, runs and checkpoints come back as they were written, and a crash leaves nothing half written."""

import dataclasses
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from viapoint.envs import arm_of, register_arm
from viapoint.envs.arms import registry
from viapoint.training import Run, TrainConfig, ViaVecEnv
from viapoint.training.agents.model_io import build, describe, load_model, save_model
from viapoint.training.config.presets import PRESETS
from viapoint.training.io import files
from viapoint.training.io.files import BadFileError
from viapoint.training.runs import run_dir


def new(algo, env, **hyperparameters):
    preset = PRESETS[algo]
    return build(algo, preset.policy, env, {**preset.arguments(), **hyperparameters}, seed=1)


@pytest.mark.filterwarnings(
    "ignore:You have specified a mini-batch size"
)  # the preset is for 64 environments
@pytest.mark.parametrize("algo", PRESETS)
def test_a_model_decides_the_same_after_a_round_trip(algo, env, tmp_path):
    if algo == "viarank":
        env = ViaVecEnv("viapoint/PlanarSensed-v0", 4, seed=0, threads=1)
    model = new(algo, env)
    save_model(model, tmp_path)
    np.random.seed(7)  # noqa: NPY002 - SB3 draws from it
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    loaded = load_model(tmp_path)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    observation = env.reset()
    for each in (loaded, load_model(tmp_path, env)):
        np.testing.assert_array_equal(
            each.predict(observation, deterministic=True)[0],
            model.predict(observation, deterministic=True)[0],
        )
    written = json.loads((tmp_path / "model.json").read_text())
    assert written.pop("weights_sha256")
    assert describe(load_model(tmp_path, env)) == written


def test_an_agent_of_ones_own_arm_is_loaded_by_whoever_makes_the_arm_known(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_OWN", {})
    own = dataclasses.replace(arm_of("panda"), name="mine")
    register_arm(own)
    env = ViaVecEnv("viapoint/Reach-v0", 1, arm=own, threads=1)
    save_model(new("viaq", env), tmp_path)
    assert load_model(tmp_path).get_env().env_kwargs["arm"] == "mine"
    registry._OWN.clear()
    with pytest.raises(BadFileError, match=r"'mine'.*register_arm"):
        load_model(tmp_path)


def test_an_error_of_a_file_reaches_other_processes():
    error = pickle.loads(pickle.dumps(BadFileError(Path("a"), "is missing")))
    assert (error.path, str(error)) == (Path("a"), "a: is missing")


def test_a_crash_amid_a_replacement_is_undone(tmp_path):
    one, other = 32 * "a", 32 * "b"
    (tmp_path / f".best.{one}.old").mkdir()
    (tmp_path / f".best.{one}.old" / "model.json").write_text("{}")
    (tmp_path / f".best.{other}.part").mkdir()
    (tmp_path / f".config.json.{one}.part").write_text("{")
    (tmp_path / ".film.mp4.part").write_text("of another program")
    files.tidy(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".film.mp4.part", "best"]
    assert (tmp_path / "best" / "model.json").read_text() == "{}"


@pytest.fixture
def run(tmp_path):
    return Run.create(TrainConfig(out=tmp_path / "run", algo="td3", eval_every=0))


def test_a_folder_in_use_is_refused_and_a_dead_process_holds_nothing(run, monkeypatch):
    monkeypatch.setattr(run_dir, "PATIENCE", 0.0)
    script = (
        "import sys; from pathlib import Path; from viapoint.training.runs.run_dir import Run\n"
        f"with Run(Path({str(run.folder)!r})).locked():\n    print('in', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "in\n"
    with pytest.raises(BadFileError, match="in use"), run.locked():
        pass
    other.kill()
    other.communicate()
    with run.locked():
        pass


def test_two_that_begin_at_the_same_time_do_not_mix(tmp_path, monkeypatch):
    """The second finds a free folder, but the first is faster."""
    folder, check = tmp_path / "run", run_dir.check_free

    def slow(path):
        check(path)
        monkeypatch.setattr(run_dir, "check_free", check)
        Run.create(TrainConfig(out=path, seed=1))

    monkeypatch.setattr(run_dir, "check_free", slow)
    with pytest.raises(BadFileError):
        Run.create(TrainConfig(out=folder, seed=2))
    assert Run(folder).config.seed == 1


def test_checkpoints_are_kept_two_deep_and_torn_ones_passed_over(env, run, capsys):
    model = new("td3", env)
    model._setup_learn(100)
    for number in (4, 8, 12):
        model.num_timesteps = number
        run.checkpoint(model, {"number": number})
    assert [int(path.stem) for path in run.checkpoints()] == [8, 12]
    torn = run.checkpoints()[-1]
    content = torn.read_bytes()
    middle = len(content) // 2
    torn.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    assert run.restore(new("td3", env)) == {"number": 8}
    assert capsys.readouterr().err.count("passed over") == 1
    model.num_timesteps = 12
    run.checkpoint(model, {"number": 12})  # the damaged one is written again
    assert run.restore(new("td3", env)) == {"number": 12}
    for path in run.checkpoints():
        path.write_text("{}")
    with pytest.raises(BadFileError):
        run.restore(new("td3", env))


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "file"
    files.write_bytes(path, b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    for write in (
        lambda: files.write_bytes(path, b"new"),
        lambda: files.write_folder(
            tmp_path / "folder", lambda folder: files.write_bytes(folder / "a", b"new")
        ),
    ):
        with pytest.raises(OSError):
            write()
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert path.read_bytes() == b"old"
