"""Nothing that this package did not write is deleted or overwritten, and what it wrote is replaced."""

import gymnasium as gym
import numpy as np
import pytest
from tasks import PLANE, REACH

from viapoint.training import Run, TrainConfig, load_agent, train
from viapoint.training.agents.agent import find_model
from viapoint.training.agents.model_io import weights
from viapoint.training.cli import demo
from viapoint.training.cli import entry as cli
from viapoint.training.config.configs import DemoConfig, PaperConfig
from viapoint.training.io.files import BadFileError
from viapoint.training.paper import run as paper
from viapoint.training.plotting.video import record_video

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


def evaluate(path):
    words = ["evaluate", "--env", REACH, "--baselines", "straight", "--n-scenes", "2", "--json", str(path)]
    cli.main(words)


def film(path):
    env = gym.make(REACH, render_mode="rgb_array_list", width=64, height=64)
    scenes = env.unwrapped.task.sampler()([np.random.default_rng(0)])
    record_video(path, env, scenes, lambda *_: np.zeros((1, 3)))
    env.close()


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


def begin_demo(path):
    demo.run(DemoConfig(out=path.parent, env=REACH))


def begin_paper(path):
    paper.run(PaperConfig(out=path.parent))


OVER = [
    *((evaluate, "foreign.json", content) for content in (NOTES, b"", FOREIGN_JSON)),
    (film, "wedding.mp4", NOTES),
    *((begin_demo, name, NOTES) for name in ("table.md", "movements.mp4")),
    *((begin_paper, name, NOTES) for name in ("index.html", "limits.png")),
]


@pytest.mark.parametrize(("write", "name", "content"), OVER)
def test_no_file_of_something_else_is_written_over(write, name, content, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "train_or_resume", pytest.fail)
    monkeypatch.setattr(paper, "reproduce", pytest.fail)
    put(tmp_path, name, content)
    before = content_of(tmp_path)
    with pytest.raises((BadFileError, SystemExit)):
        write(tmp_path / name)
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
