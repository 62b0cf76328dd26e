"""Arms of files in training, evaluation and models."""

import shutil
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import arm_of
from viapoint.training import Run, evaluate, load_agent
from viapoint.training.cli.main import main

UR5E = Path(__file__).parents[2] / "docs" / "ur5e.xml"


def test_the_command_line_takes_an_arm_of_a_file(tmp_path, monkeypatch) -> None:
    shutil.copy(UR5E, tmp_path / "my_arm.xml")
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    main(
        [
            "train", "--env", "viapoint/Obstacles-v0", "--env-kwargs", "arm=my_arm.xml", "n_obstacles=2",
            "--n-timesteps", "64", "--n-envs", "16", "--eval-every", "0", "--out", str(run),
        ]
    )  # fmt: skip
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert Run(run).config.env_kwargs["arm"] == str(tmp_path / "my_arm.xml")
    agent = load_agent(run)
    result = evaluate(agent, baselines=["straight"], scenes="validation", n_scenes=4)
    assert len(result.rows) == 2


def test_environments_take_files_and_say_what_is_missing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make("viapoint/Reach-v0", arm=str(UR5E))
    env.reset(seed=0)
    assert env.unwrapped.task.arm is arm_of(str(UR5E))
    assert env.unwrapped.task.as_dict()["arm"] == str(UR5E)
    assert np.isfinite(env.step(env.action_space.sample())[1])
    env.close()
    with pytest.raises(ValueError, match=r"no file 'nowhere\.urdf'"):
        gym.make("viapoint/Reach-v0", arm="nowhere.urdf")
