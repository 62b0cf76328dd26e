"""Arms of files in training, evaluation and models."""

import shutil
from pathlib import Path

import numpy as np

from viapoint.training import Run, evaluate, load_agent
from viapoint.training.cli.entry import main

UR5E = Path(__file__).parents[2] / "docs" / "ur5e.xml"


def not_filmed(monkeypatch) -> list[str]:
    """Let `play` decide without rendering; the arms of its videos are listed."""
    filmed: list[str] = []

    def record(path, env, scenes, decide, **_) -> None:
        observation, _ = env.reset(seed=0)
        decide({name: value[None] for name, value in observation.items()}, scenes)
        filmed.append(env.unwrapped.task.arm.file)

    monkeypatch.setattr("viapoint.training.plotting.video.record_video", record)
    return filmed


def test_the_command_line_takes_an_arm_of_a_file(tmp_path, monkeypatch) -> None:
    shutil.copy(UR5E, tmp_path / "my_arm.xml")
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    main(
        [
            "train", "--arm", "my_arm.xml", "--env-kwargs", "n_obstacles=2",
            "--n-timesteps", "64", "--n-envs", "16", "--eval-every", "0", "--out", str(run),
        ]
    )  # fmt: skip
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert Run(run).config.env_kwargs["arm"] == str(tmp_path / "my_arm.xml")
    agent = load_agent(run)
    result = evaluate(agent, baselines=["straight"], scenes="validation", n_scenes=4)
    assert len(result.rows) == 2

    seen = agent.observation_space.sample()
    action, _ = agent.predict(seen, deterministic=True)
    (tmp_path / "my_arm.xml").unlink()  # the run keeps a copy
    kept = load_agent(run)
    assert Run(run).config.env_kwargs["arm"] == str(run / "arm.xml")
    np.testing.assert_array_equal(kept.predict(seen, deterministic=True)[0], action)
    main(["evaluate", str(run), "--baselines", "straight", "--n-scenes", "4", "--scenes", "validation"])
    filmed = not_filmed(monkeypatch)
    main(["play", str(run), "--n-scenes", "1", "--scenes", "validation", "--video", str(tmp_path / "a.mp4")])
    assert filmed == [kept.env_kwargs["arm"]]


def test_a_run_goes_on_with_its_copy_of_an_arm(tmp_path, capsys) -> None:
    file = tmp_path / "my_arm.xml"
    shutil.copy(UR5E, file)
    settings = ("--n-envs", "16", "--eval-every", "0", "--out", str(tmp_path / "run"))
    main(["train", "--arm", str(file), "--n-timesteps", "16", *settings])
    shutil.copytree(tmp_path / "run", tmp_path / "same")
    decisions = 16
    # The run goes on without the file, and then with the file again; the other run the other way round.
    for name in ("elsewhere.xml", "my_arm.xml"):
        decisions += 16
        main(["train", "--resume", "--out", str(tmp_path / "same"), "--n-timesteps", str(decisions)])
        file = file.rename(tmp_path / name)
        main(["train", "--resume", "--out", str(tmp_path / "run"), "--n-timesteps", str(decisions)])
    assert "damaged" not in capsys.readouterr().err
    assert Run(tmp_path / "run").config == Run(tmp_path / "same").config
    first, second = (tmp_path / name / "final" / "weights.safetensors" for name in ("run", "same"))
    assert first.read_bytes() == second.read_bytes()


def test_methods_are_measured_on_an_arm_of_a_file(tmp_path, monkeypatch, failed) -> None:
    arm = ["--arm", str(UR5E), "--scenes", "validation"]
    out = tmp_path / "results.json"
    main(["evaluate", *arm, "--baselines", "straight", "plan_motion", "--n-scenes", "4", "--json", str(out)])
    assert out.is_file()
    filmed = not_filmed(monkeypatch)
    main(["play", *arm, "--n-scenes", "1", "--video", str(tmp_path / "b.mp4")])
    assert filmed == [str(UR5E)]
    assert "nowhere.xml" in failed("evaluate", "--arm", "nowhere.xml")
