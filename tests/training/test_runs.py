"""Models, runs and checkpoints come back as they were written, and no file is lost, half written or foreign."""

import dataclasses
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import PLANE, REACH
from stable_baselines3.common.env_util import make_vec_env

from viapoint.envs import RewardWeights, Sensor, arm_of, register_arm
from viapoint.envs.arms import registry
from viapoint.envs.scenes.families_registry import FAMILIES
from viapoint.training import Run, TrainConfig, ViaVecEnv, files, load_agent, runs, train
from viapoint.training.agents.agent import find_model
from viapoint.training.agents.model_io import build, describe, load_model, save_model, weights
from viapoint.training.cli import demo
from viapoint.training.configs import PRESETS
from viapoint.training.files import BadFileError
from viapoint.training.paper import run as paper


def new(algo, env, **hyperparameters):
    preset = PRESETS[algo]
    return build(algo, preset.policy, env, {**preset.hyperparameters, **hyperparameters}, seed=1)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")  # presets are for 64 environments
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


OBJECTS = [
    {"sensor": Sensor(columns=16)},
    {"reward_weights": RewardWeights(success=2.0)},
    {"duration_range": np.array([0.6, 1.0]), "n_obstacles": np.array([1, 3]), "max_episode_steps": 2},
    {"arm": arm_of("planar")},
]


@pytest.mark.parametrize("make", [ViaVecEnv, lambda *args, **kwargs: make_vec_env(*args, env_kwargs=kwargs)])
@pytest.mark.parametrize("kwargs", OBJECTS)
def test_arguments_of_an_environment_may_be_objects(make, kwargs, tmp_path):
    agent = new("sac", make("viapoint/Obstacles-v0", 1, **{"arm": "planar", **kwargs}))
    agent.save(tmp_path / "model")
    (task,), loaded = agent.get_env().get_attr("task"), load_agent(tmp_path / "model")
    assert loaded.get_env().get_attr("task")[0].as_dict() == task.as_dict()
    assert loaded.env_kwargs.get("max_episode_steps") == kwargs.get("max_episode_steps")
    config = TrainConfig(env=agent.env_id, env_kwargs={"arm": "planar", **kwargs})
    assert config.env_kwargs == loaded.env_kwargs
    assert config.task.as_dict() == task.as_dict()


def test_an_agent_of_ones_own_arm_is_loaded_by_whoever_makes_the_arm_known(tmp_path):
    own = dataclasses.replace(arm_of("panda"), name="mine")
    register_arm(own)
    env = ViaVecEnv("viapoint/Reach-v0", 1, arm=own, threads=1)
    save_model(new("viaq", env), tmp_path)
    assert load_model(tmp_path).get_env().env_kwargs["arm"] == "mine"
    registry._OWN.clear()
    with pytest.raises(BadFileError, match=r"'mine'.*register_arm"):
        load_model(tmp_path)


def test_an_agent_of_a_family_of_ones_own_asks_for_the_family(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(FAMILIES, (True, "mine"), FAMILIES[True, "clutter"])
        save_model(new("viaq", ViaVecEnv(PLANE, 1, families="mine", threads=1)), tmp_path)
    with pytest.raises(BadFileError, match=r"'mine'.*register_scene_family") as raised:
        load_model(tmp_path)
    assert "written by" not in str(raised.value)  # the version is not to blame


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
    monkeypatch.setattr(runs, "PATIENCE", 0.0)
    script = (
        "import sys; from pathlib import Path; from viapoint.training.runs import locked\n"
        f"with locked(Path({str(run.folder)!r})):\n    print('in', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "in\n"
    with pytest.raises(BadFileError, match="in use"), runs.locked(run.folder):
        pass
    other.kill()
    other.communicate()
    with runs.locked(run.folder):
        pass


def test_two_that_begin_at_the_same_time_do_not_mix(tmp_path, monkeypatch):
    """The second finds a free folder, but the first is faster."""
    folder, check = tmp_path / "run", runs.check_free

    def slow(path):
        check(path)
        monkeypatch.setattr(runs, "check_free", check)
        Run.create(TrainConfig(out=path, seed=1))

    monkeypatch.setattr(runs, "check_free", slow)
    with pytest.raises(BadFileError):
        Run.create(TrainConfig(out=folder, seed=2))
    assert Run(folder).config.seed == 1


def test_checkpoints_are_kept_two_deep_and_torn_ones_passed_over(env, run, capsys):
    model = new("td3", env)
    model._setup_learn(100)
    for number in (4, 8, 12):
        model.num_timesteps = number
        run.checkpoint(model, float(number))
    assert [int(path.stem) for path in run.checkpoints()] == [8, 12]
    torn = run.checkpoints()[-1]
    content = torn.read_bytes()
    middle = len(content) // 2
    torn.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    assert run.restore(new("td3", env)) == 8.0
    assert capsys.readouterr().err.count("passed over") == 1
    model.num_timesteps = 12
    run.checkpoint(model, 12.0)  # the damaged one is written again
    assert run.restore(new("td3", env)) == 12.0
    for path in run.checkpoints():
        path.write_text("{}")
    with pytest.raises(BadFileError):
        run.restore(new("td3", env))


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path, link = tmp_path / "file", tmp_path / "link"
    link.symlink_to(path)
    files.write_bytes(link, b"old")  # it stays a link
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BadFileError, match="no regular file"):
        files.write_bytes(tmp_path / "pipe", b"new")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    folder = tmp_path / "folder"
    for write in (
        lambda: files.write_bytes(link, b"new"),
        lambda: files.write_folder(folder, lambda part: files.write_bytes(part / "a", b"new")),
    ):
        with pytest.raises(OSError) as error:
            write()
        assert error.value.filename  # a full disk does not say what it has no room for
    assert {p.name for p in tmp_path.iterdir()} == {"file", "link", "pipe"}
    assert path.read_bytes() == b"old"


NOTES = b"years of work with viapoint \xff"
FOREIGN_JSON = b'{"env": "viapoint/PlanarReach-v0", "layers": [8, 8]}'


def content_of(folder):
    """Every file below a folder, with its bytes, and every folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def put(folder, name, content=NOTES):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def tiny(folder, **changes):
    values = {"env": REACH, "out": folder, "n_timesteps": 64, "n_envs": 16, "checkpoint_every": 16}
    values |= {"hyperparameters": {"learning_starts": 64}, "env_kwargs": {"threads": 1}}
    values |= {"eval_every": 0, "progress": False}
    return TrainConfig(**{**values, **changes})


SAVES = [
    (True, "model", "model/notes.txt"),
    (True, "model", "model/thesis/notes.txt"),
    (False, "model", "model/weights.safetensors/notes.txt"),
    (True, "model", "model/model.json", FOREIGN_JSON),
    (False, "model", "model/weights.safetensors"),
    (False, "model", "model"),
    (False, "model.zip", "model"),  # as SB3 names it
]
"""True if there is a model, where an agent is saved, and what else is there."""


@pytest.mark.parametrize("case", SAVES)
def test_an_agent_is_saved_over_a_model_alone(case, tmp_path):
    own, target, *foreign = case
    agent = load_agent(REACH)
    if own:
        agent.save(tmp_path / "model")
    put(tmp_path, *foreign)
    before = content_of(tmp_path)
    with pytest.raises(BadFileError):
        agent.save(tmp_path / target)
    assert content_of(tmp_path) == before


def test_an_own_model_is_replaced_also_behind_a_link(tmp_path):
    agent, other = load_agent(REACH), load_agent(PLANE)
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "new"):
        other.save(folder)
        agent.save(folder)
        for part, array in weights(load_agent(folder)).items():
            np.testing.assert_array_equal(array, weights(agent)[part])
    (tmp_path / "link").symlink_to(tmp_path / "new")
    other.save(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert load_agent(tmp_path / "new").env_id == PLANE


MEASURE = f"evaluate --env {REACH} --baselines straight --n-scenes 2 --json"
FIT = f"fit {Path(__file__).parents[2] / 'docs' / 'reach.csv'} --out"
OVER = [
    *((MEASURE, "foreign.json", content) for content in (NOTES, FOREIGN_JSON)),
    (f"play --env {REACH} --n-scenes 1 --video", "wedding.mp4", NOTES),
    *((f"demo --env {REACH} --out", name, NOTES) for name in ("table.md", "movements.mp4")),
    *(("paper --out", name, NOTES) for name in ("index.html", "limits.png")),
    *((FIT, name, NOTES) for name in ("fit.csv", "fit.png")),
]


@pytest.mark.parametrize(("words", "name", "content"), OVER)
def test_no_file_of_something_else_is_written_over(words, name, content, tmp_path, monkeypatch, failed):
    monkeypatch.setattr(demo, "train_or_resume", pytest.fail)
    monkeypatch.setattr(paper, "reproduce", pytest.fail)
    put(tmp_path, name, content)
    before = content_of(tmp_path)
    assert name in failed(*words.split(), tmp_path if words.endswith("--out") else tmp_path / name)
    assert content_of(tmp_path) == before


@pytest.mark.parametrize("name", ["thesis/a.tex", "versions.json", "best/model.json"])
def test_a_training_begins_in_no_folder_of_something_else(name, tmp_path):
    put(tmp_path, name)
    before = content_of(tmp_path)
    with pytest.raises(BadFileError):
        train(tiny(tmp_path))
    assert content_of(tmp_path) == before


def test_a_training_leaves_foreign_files_in_its_folder_alone(tmp_path):
    folder = tmp_path / "run"
    train(tiny(folder, n_timesteps=32))
    foreign = ["notes.txt", "evaluations/notes.md", ".backup.part", ".cache/a.old", "tensorboard/mine.txt"]
    foreign += [f"checkpoints/{name}" for name in ("12345/a.txt", "0000000016.txt", "1700000000.pt/a.txt")]
    for name in foreign:
        put(folder, name)
    run = train(TrainConfig(out=folder, resume=True, n_timesteps=128, progress=False))
    assert [int(path.stem) for path in run.checkpoints()] == [112, 128]
    assert all((folder / name).read_bytes() == NOTES for name in foreign)


def test_a_run_that_has_lost_files_does_not_go_on(tmp_path, capsys):
    folder = tmp_path / "run"
    train(tiny(folder, n_timesteps=32, eval_every=16, eval_scenes=4))
    curve, before = folder / "learning_curve.jsonl", (folder / "config.json").read_bytes()
    whole = curve.read_bytes()

    def longer():
        return train(TrainConfig(out=folder, resume=True, n_timesteps=40, progress=False))

    for content in (b"[]", b"{}", whole[:-9], b"\xff", b'{"decisions": 0, "success": 1}'):
        curve.write_bytes(content)
        for refused in (lambda: repr(Run(folder)), longer):
            with pytest.raises(BadFileError, match=r"learning_curve\.jsonl"):
                refused()
    curve.write_bytes(whole)
    (folder / "checkpoints").rename(tmp_path / "away")
    with pytest.raises(BadFileError, match="no checkpoint"):
        longer()
    assert (folder / "config.json").read_bytes() == before
    (folder / "final").rename(tmp_path / "final")  # as if it had been killed before the first checkpoint
    assert "48 of 48 decisions" in repr(longer())  # rounds are whole
    assert "begins anew" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["final/notes.txt", "final/thesis/a.tex", "final/model.json", "final"])
def test_a_training_keeps_a_model_with_foreign_files_and_goes_on(name, tmp_path):
    folder = tmp_path / "run"
    train(tiny(folder, n_timesteps=32))
    (folder / "final").rename(folder / "old")
    if name != "final":
        (folder / "old").rename(folder / "final")
    put(folder, name)
    changed = content_of(folder)
    for number in (48, 64):
        train(TrainConfig(out=folder, resume=True, n_timesteps=number, progress=False))
    assert Run(folder).decisions == 64
    assert content_of(folder / "final").keys() == {"model.json", "weights.safetensors"}
    after = content_of(folder)
    assert after[name.replace("final", "final.1", 1)] == NOTES
    for each in changed:
        if each.startswith("final"):
            assert after[each.replace("final", "final.1", 1)] == changed[each]
    assert "final.2" not in after
    assert find_model(folder).name == "final"
