"""What is written comes back the same; what is wrong is refused by name; nothing that is read is run."""

import dataclasses
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from viapoint.envs.arms import ARMS, PANDA
from viapoint.training.algorithms.agent import find_model
from viapoint.training.algorithms.model_io import build, describe, load_model, save_model, weights
from viapoint.training.config.configs import TrainConfig
from viapoint.training.config.presets import PRESETS
from viapoint.training.io import files
from viapoint.training.io.files import BadFileError
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.checkpoints import read_checkpoint, write_checkpoint
from viapoint.training.runs.run_dir import Run

ENV = "viapoint/PlanarObstacles-v0"


@pytest.fixture(scope="module")
def env():
    env = ViaVecEnv(ENV, 4, seed=0, threads=1)
    yield env
    env.close()


def new(algo, env, **hyperparameters):
    preset = PRESETS[algo]
    return build(algo, preset.policy, env, {**preset.arguments(), **hyperparameters}, seed=1)


@pytest.fixture(scope="module")
def saved(env, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    save_model(new("td3", env), folder)
    return folder


@pytest.fixture
def copy(saved, tmp_path):
    """A model's folder to spoil."""
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


@pytest.mark.filterwarnings(
    "ignore:You have specified a mini-batch size"
)  # the preset is for 64 environments
@pytest.mark.parametrize("algo", PRESETS)
def test_a_model_decides_the_same_after_a_round_trip(algo, env, tmp_path):
    model = new(algo, env)
    save_model(model, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.json", "weights.safetensors"]
    loaded = load_model(tmp_path)
    observation = env.reset()
    for each in (loaded, load_model(tmp_path, env)):
        np.testing.assert_array_equal(
            each.predict(observation, deterministic=True)[0],
            model.predict(observation, deterministic=True)[0],
        )
    again = describe(load_model(tmp_path, env))
    written = json.loads((tmp_path / "model.json").read_text())
    assert written.pop("weights_sha256")
    assert again == written


def test_loading_does_not_touch_random_states(saved):
    np.random.seed(7)  # noqa: NPY002 - SB3 draws from it
    expected = np.random.get_state()[1].copy()  # noqa: NPY002
    load_model(saved)
    np.testing.assert_array_equal(np.random.get_state()[1], expected)  # noqa: NPY002


class Canary:
    """Unpickling it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("name", ["model.json", "weights.safetensors"])
def test_a_pickle_in_place_of_a_file_is_not_opened(name, copy):
    canary = copy / "canary"
    (copy / name).write_bytes(pickle.dumps(Canary(canary)))
    with pytest.raises(BadFileError, match=name):
        load_model(copy)
    assert not canary.exists()


def test_no_module_is_imported_by_name(copy):
    (copy / "evil_module.py").write_text("raise SystemExit('imported')")
    sys.path.insert(0, str(copy))
    try:
        _edit(copy, env={"id": "evil_module:viapoint/PlanarReach-v0", "kwargs": {}})
        with pytest.raises(BadFileError, match=r"evil_module.*is not known"):
            load_model(copy)
    finally:
        sys.path.remove(str(copy))
    assert "evil_module" not in sys.modules


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format": 99}, "format"),
        ({"algorithm": "os.system"}, "algorithm must be one of"),
        ({"policy": "CnnPolicy2"}, "policy"),
        ({"hyperparameters": {"policy_kwargs": {"net_arch": "a lot"}}}, "does not describe"),
        ({"hyperparameters": {"tensorboard_log": "x"}}, "no hyperparameter 'tensorboard_log'"),
        ({"hyperparameters": {"learning_rate": {"kind": "eval"}}}, "kind must be"),
        ({"env": {"id": ENV, "kwargs": {"nothing": 1}}}, "nothing"),
        ({"env": None}, "does not describe"),
        ({"num_timesteps": "many"}, "does not describe"),
    ],
)
def test_json_that_says_something_else_is_refused(change, reason, copy):
    _edit(copy, **change)
    with pytest.raises(BadFileError, match=reason):
        load_model(copy)


def _edit(folder, **change):
    record = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**record, **change}))


def _shorter(arrays, name):
    arrays[name] = arrays[name][:-1]


def _missing(arrays, name):
    del arrays[name]


def _more(arrays, name):
    arrays["more"] = np.zeros(3, np.float32)


def _nan(arrays, name):
    arrays[name] = np.full_like(arrays[name], np.nan)


def _double(arrays, name):
    arrays[name] = arrays[name].astype(np.float64)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (_shorter, "must be"),
        (_missing, "missing"),
        (_more, "unknown"),
        (_nan, "not finite"),
        (_double, "must be"),
    ],
)
def test_weights_that_do_not_fit_are_refused(spoil, reason, copy):
    path = copy / "weights.safetensors"
    arrays = load_file(path)
    spoil(arrays, sorted(arrays)[0])
    save_file(arrays, path)
    with pytest.raises(BadFileError, match=reason):
        load_model(copy)


@pytest.mark.parametrize("name", ["model.json", "weights.safetensors"])
def test_a_truncated_or_missing_file_is_refused_by_name(name, copy):
    content = (copy / name).read_bytes()
    for part in (content[: len(content) // 2], b""):
        (copy / name).write_bytes(part)
        with pytest.raises(BadFileError, match=name):
            load_model(copy)
    (copy / name).unlink()
    with pytest.raises(BadFileError, match="missing"):
        load_model(copy)


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "file"
    files.write_bytes(path, b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        files.write_bytes(path, b"new")
    with pytest.raises(OSError, match="No space"):
        files.write_folder(tmp_path / "folder", lambda folder: files.write_bytes(folder / "a", b"new"))
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert path.read_bytes() == b"old"


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


def test_a_run_comes_back_with_its_configuration(run):
    again = Run(run.folder)
    assert again.config == run.config
    assert again.config.algo == "td3"
    assert again.curve == []
    again.write_curve([{"decisions": 1}])
    with (run.folder / "learning_curve.jsonl").open("a") as file:
        file.write('{"decisi')
    assert again.curve == [{"decisions": 1}]
    assert {"python", "torch", "mujoco", "viapoint"} <= set(
        json.loads((run.folder / "versions.json").read_text())
    )


def test_what_is_no_run_is_refused_by_name(run, tmp_path):
    with pytest.raises(BadFileError, match="no such folder"):
        Run(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    with pytest.raises(BadFileError, match="it is a file"):
        Run(tmp_path / "file")
    with pytest.raises(ValueError, match="file is no folder"):
        Run.create(TrainConfig(out=tmp_path / "file"))
    with pytest.raises(BadFileError, match=r"holds no config\.json"):
        Run(tmp_path)
    with pytest.raises(BadFileError, match="holds a run already"):
        Run.create(TrainConfig(out=run.folder))
    with pytest.raises(BadFileError, match="is not empty"):
        Run.create(TrainConfig(out=tmp_path))
    with pytest.raises(BadFileError, match="holds no model"):
        find_model(run.folder)
    (run.folder / "config.json").write_text('{"env": "viapoint/Nothing-v0"}')
    with pytest.raises(BadFileError, match="env must be one of"):
        Run(run.folder)
    (run.folder / "config.json").write_text('{"colour": "red"}')
    with pytest.raises(BadFileError, match="colour"):
        Run(run.folder)


def test_a_folder_in_use_is_refused_and_a_dead_process_holds_nothing(run):
    script = (
        "import sys; from pathlib import Path; from viapoint.training.runs.run_dir import Run\n"
        f"with Run(Path({str(run.folder)!r})).locked():\n    print('in', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "in\n"
    with pytest.raises(BadFileError, match=f"process with number {other.pid}"), run.locked():
        pass
    other.kill()
    other.communicate()
    with run.locked():
        pass


def test_checkpoints_are_kept_two_deep_and_torn_ones_passed_over(env, run):
    model = new("td3", env)
    model._setup_learn(100)
    for number in (4, 8, 12):
        model.num_timesteps = number
        run.checkpoint(model, {"number": number})
    assert [int(path.name) for path in run.checkpoints()] == [8, 12]
    torn = run.checkpoints()[-1] / "tensors.safetensors"
    content = torn.read_bytes()
    torn.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    extra, passed_over = run.restore(new("td3", env))
    assert extra == {"number": 8}
    assert len(passed_over) == 1
    assert "torn" in passed_over[0]
    (run.checkpoints()[0] / "state.json").write_text("{}")
    with pytest.raises(BadFileError, match="torn"):
        run.restore(new("td3", env))


def test_a_checkpoint_of_another_model_is_refused(env, tmp_path):
    model = new("td3", env)
    model._setup_learn(100)
    write_checkpoint(model, tmp_path / "checkpoint", {})
    with pytest.raises(BadFileError, match="batch_size was 256, is 8"):
        read_checkpoint(new("td3", env, batch_size=8), tmp_path / "checkpoint")
    same = new("td3", env)
    assert read_checkpoint(same, tmp_path / "checkpoint") == {}
    for name, array in weights(model).items():
        np.testing.assert_array_equal(weights(same)[name], array)


def test_an_agent_of_ones_own_arm_is_loaded_by_whoever_makes_the_arm_known(tmp_path, monkeypatch):
    own = dataclasses.replace(PANDA, name="mine")
    monkeypatch.setitem(ARMS, "mine", own)
    env = ViaVecEnv("viapoint/Reach-v0", 1, arm=own, threads=1)
    preset = PRESETS["viaq"]
    model = build("viaq", preset.policy, env, preset.arguments(), seed=0)
    save_model(model, tmp_path)
    assert load_model(tmp_path).get_env().env_kwargs["arm"] == "mine"
    monkeypatch.delitem(ARMS, "mine")
    with pytest.raises(BadFileError, match=r"got 'mine'; .*register_arm registers an arm"):
        load_model(tmp_path)
