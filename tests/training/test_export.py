"""An exported archive decides as the agent does, comes back unchanged, and has a card with what was measured."""

import json

import gymnasium as gym
import numpy as np
import pytest
import yaml
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3

from viapoint.training import ViaQ, ViaVecEnv, load_agent
from viapoint.training.algorithms.model_io import build, save_model
from viapoint.training.algorithms.sb3_archive import environment_of
from viapoint.training.cli import main as cli
from viapoint.training.config.presets import preset_of
from viapoint.training.io.files import BadFileError

ENV, REPLANNING = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"
EXTRACTOR = {"features_extractor_class": {"kind": "extractor", "name": "SceneExtractor"}, "net_arch": [16]}
SMALL = {"buffer_size": 1000, "learning_starts": 8}
CASES = {
    "sac": (SAC, ENV, {}, {**SMALL, "policy_kwargs": {**EXTRACTOR, "critic": "minimum"}}, None),
    "td3": (TD3, ENV, {"n_via": 2}, {**SMALL, "action_noise": {"kind": "normal", "sigma": 0.2}}, None),
    "tqc": (TQC, REPLANNING, {}, {**SMALL, "policy_kwargs": EXTRACTOR}, 0.1),
    "ppo": (PPO, REPLANNING, {}, {"n_steps": 8, "batch_size": 8, "policy_kwargs": EXTRACTOR}, 0.1),
    "viaq": (ViaQ, ENV, {}, {**SMALL, "policy_kwargs": {"candidates": 32}}, None),
}


def cli_run(*words):
    cli.main([str(word) for word in words])


def card_of(folder):
    """Header and text of a card."""
    _, header, text = (folder / "README.md").read_text().split("---\n", 2)
    return yaml.safe_load(header), text


@pytest.mark.parametrize("algo", CASES)
def test_an_archive_decides_as_the_agent_does_and_comes_back_unchanged(algo, tmp_path, capsys):
    kind, env_id, env_kwargs, hyperparameters, unit = CASES[algo]
    env = ViaVecEnv(env_id, 4, seed=0, **env_kwargs)
    policy = preset_of(env_id, algo).policy
    save_model(build(algo, policy, env, hyperparameters, discount_unit=unit, seed=3), tmp_path / "model")
    cli_run("export", tmp_path / "model", "--out", tmp_path / "shared")
    (archive,) = (tmp_path / "shared").glob("*.zip")
    assert archive.name == f"{algo}-{env_id.replace('/', '-')}.zip"
    assert environment_of(archive) == {"id": env_id, "kwargs": env_kwargs}

    mine = load_agent(tmp_path / "model")
    theirs = ViaQ.load(archive, trust=True) if algo == "viaq" else kind.load(archive, device="cpu")
    assert type(theirs) is kind
    observation = env.reset()
    for _ in range(3):
        action, _ = mine.predict(observation, deterministic=True)
        np.testing.assert_array_equal(theirs.predict(observation, deterministic=True)[0], action)
        observation, *_ = env.step(action)
    if algo != "viaq":
        assert theirs.observation_space == mine.observation_space
        agent = load_agent(archive, trust=True)
        np.testing.assert_array_equal(
            agent.predict(observation, deterministic=True)[0],
            mine.predict(observation, deterministic=True)[0],
        )

    cli_run("import-sb3", archive, "--out", tmp_path / "back", "--trust")
    before, after = (json.loads((tmp_path / name / "model.json").read_text()) for name in ("model", "back"))
    assert after == before
    header, text = card_of(tmp_path / "shared")
    assert header["library_name"] == "stable-baselines3"
    assert env_id in header["tags"]
    assert "license" not in header
    assert "model-index" not in header
    assert before["weights_sha256"] in text
    assert "--scenes test measures it" in capsys.readouterr().out


def test_an_exported_agent_can_be_trained_further(tmp_path):
    cli_run("export", ENV, "--out", tmp_path / "mine.zip")
    env = ViaVecEnv(ENV, 16, seed=0)
    agent = ViaQ.load(tmp_path / "mine.zip", env, trust=True)
    assert agent.buffer_size == 50_000
    before = agent.num_timesteps
    agent.learning_starts = 16
    assert agent.learn(32, reset_num_timesteps=False).num_timesteps == before + 32
    with pytest.raises(ValueError, match="loaded for decisions"):
        ViaQ.load(tmp_path / "mine.zip", trust=True).learn(1)


def test_nothing_opens_an_archive_without_being_told_to(tmp_path):
    cli_run("export", ENV, "--out", tmp_path / "mine.zip")
    for load in (load_agent, ViaQ.load):
        with pytest.raises(BadFileError, match=r"it is a file \(viapoint import-sb3 converts .*trust=True"):
            load(tmp_path / "mine.zip")


def test_the_card_of_a_shipped_agent_states_measurements_command_and_licence(tmp_path, shipped):
    cli_run("export", ENV, "--out", tmp_path / "a", "--scenes", "test")
    header, text = card_of(tmp_path / "a")
    assert header["license"] == "mit"
    (model,) = header["model-index"]
    (result,) = model["results"]
    assert result["dataset"]["type"] == ENV
    (metric,) = result["metrics"]
    assert (metric["type"], metric["value"]) == ("success_rate", 1.0)
    assert "| 40 | agent | 100.0 % (91.2-100.0) |" in text
    assert f"viapoint train --env {ENV} --algo viaq --seed 0\n" in text


def test_the_card_of_a_run_has_its_command_and_evaluations_of_its_own_weights_only(tmp_path, shipped):
    run = tmp_path / "run"
    words = ("--n-timesteps", 32, "--n-envs", 16, "--eval-every", 0, "--no-progress", "--out", run)
    small = ("--hyperparameters", "learning_starts=16", 'policy_kwargs={"candidates":16}')
    cli_run("train", "--env", ENV, "--seed", 5, *words, *small)
    cli_run("evaluate", run, "--baselines", "straight", "--n-scenes", 4, "--checks", 0, 2)
    other = json.loads((run / "evaluations" / "test.first-4.json").read_text())
    for name, change in (("older", {"weights_sha256": "0" * 64}), ("stopped", {"partial": True})):
        (run / "evaluations" / f"{name}.json").write_text(json.dumps({**other, **change}))
    cli_run("export", run, "--out", tmp_path / "a", "--license", "apache-2.0")
    header, text = card_of(tmp_path / "a")
    assert header["license"] == "apache-2.0"
    names = [each["name"] for each in header["model-index"][0]["results"][0]["metrics"]]
    assert [name.rpartition(", ")[2] for name in names] == ["agent", "2 checks"]
    (command,) = [line for line in text.splitlines() if line.startswith("viapoint train")]
    assert "--seed 5" in command
    assert 'policy_kwargs={"candidates":16}' in command


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("nowhere",), "no run folder or model folder"),
        (("viapoint/Reach-v0",), "no agent is shipped"),
        ((ENV, "--scenes", "easy"), "easy"),
        ((ENV, "--speed", "2"), "--speed"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(words, named, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        cli_run("export", *words, "--out", tmp_path / "a")
    assert end.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert named in lines[-1]
    assert not (tmp_path / "a").exists()


def test_files_that_are_there_stay(tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(SystemExit):
        cli_run("export", ENV, "--out", tmp_path)
    assert "README.md: exists already" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "mine"


def test_environment_names_in_foreign_archives_import_nothing(tmp_path, monkeypatch):
    """Gymnasium would import the module before the colon."""
    (tmp_path / "canary.py").write_text(f"open({str(tmp_path / 'sung')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    model = SAC("MultiInputPolicy", gym.make(ENV), buffer_size=10, policy_kwargs={"net_arch": [4]})
    model.viapoint_env = {"id": "canary:Bird-v0", "kwargs": {}}
    model.save(tmp_path / "model.zip")
    with pytest.raises(BadFileError, match="canary:Bird-v0"):
        load_agent(tmp_path / "model.zip", trust=True)
    with pytest.raises(SystemExit):
        cli_run("import-sb3", tmp_path / "model.zip", "--out", tmp_path / "back", "--trust")
    assert not (tmp_path / "sung").exists()
