"""Configurations are checked when made, frozen, and survive JSON."""

import dataclasses
import json
from pathlib import Path

import pytest

from viapoint.training.algorithms.model_io import ALGORITHMS
from viapoint.training.config import configs
from viapoint.training.config.checks import BASELINES, ELSEWHERE
from viapoint.training.config.configs import (
    BenchConfig,
    DemoConfig,
    EvaluateConfig,
    ImportConfig,
    PaperConfig,
    PlayConfig,
    TrainConfig,
)
from viapoint.training.config.presets import PRESETS
from viapoint.training.planners.baselines import METHODS, REPLANNING_METHODS

EXAMPLES = [
    TrainConfig(),
    TrainConfig(
        env="viapoint/PlanarReach-v0",
        algo="ppo",
        out=Path("runs") / "x",
        n_timesteps=5,
        env_kwargs={"n_via": 2, "timing": "learned"},
        hyperparameters={"batch_size": 3},
    ),
    EvaluateConfig(agent="runs/x", baselines=("untrained", "random80"), json=Path("a.json")),
    PlayConfig(agent="viapoint/PlanarReach-v0"),
    BenchConfig(num_envs=3),
    DemoConfig(out=Path("d"), n_scenes=4),
]


@pytest.mark.parametrize("config", EXAMPLES, ids=lambda config: type(config).__name__)
def test_round_trip(config):
    assert type(config).from_json(json.loads(json.dumps(config.as_json()))) == config


@pytest.mark.parametrize("config", EXAMPLES, ids=lambda config: type(config).__name__)
def test_frozen_keyword_only_and_documented(config):
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.env = "other"
    with pytest.raises(TypeError):
        type(config)("viapoint/PlanarReach-v0")
    lines = Path(configs.__file__).read_text().splitlines()
    for field in dataclasses.fields(config):
        declared = [i for i, line in enumerate(lines) if line.startswith(f"    {field.name}: ")]
        assert declared, field.name
        assert all(lines[i + 1].startswith('    """') for i in declared), field.name
    assert "Example: viapoint " in type(config).__doc__


def test_nothing_is_shared_between_two_configurations():
    TrainConfig().env_kwargs["n_via"] = 2
    assert TrainConfig().env_kwargs == {}
    PRESETS["sac"].arguments()["policy_kwargs"]["net_arch"] = []
    assert PRESETS["sac"].arguments()["policy_kwargs"]["net_arch"] == [256, 256]


@pytest.mark.parametrize(
    ("kind", "values", "named"),
    [
        (TrainConfig, {"env": "viapoint/Nothing-v0"}, "env must be one of viapoint/"),
        (TrainConfig, {"algo": "dqn"}, "algo must be one of viaq"),
        (TrainConfig, {"seed": -1}, "seed"),
        (TrainConfig, {"seed": 1.5}, "seed"),
        (TrainConfig, {"n_timesteps": 0}, "n_timesteps"),
        (TrainConfig, {"env_kwargs": ("n_via",)}, "env_kwargs must be values by name"),
        (TrainConfig, {"hyperparameters": 5}, "hyperparameters must be values by name, got 5"),
        (EvaluateConfig, {"baselines": ("ompl", "ompl"), "agent": "x"}, "ompl is there twice"),
        (TrainConfig, {"n_envs": True}, "n_envs"),
        (TrainConfig, {"n_envs": 10**9}, "n_envs must be a whole number, from 1 to 65536"),
        (TrainConfig, {"seed": 2**32}, "seed must be a whole number, from 0 to 4294967295"),
        (TrainConfig, {"checkpoint_every": 0}, "checkpoint_every"),
        *[
            (
                TrainConfig,
                {"stop_when_stalled": share},
                "stop_when_stalled must be a number over 0 and below 1",
            )
            for share in (0.0, 1.0, -0.3, True, "0.3", float("nan"))
        ],
        (TrainConfig, {"stop_when_stalled": 0.3}, r"n_timesteps must be over min_timesteps \(40000\)"),
        (TrainConfig, {"observe_candidates": 16}, "observe_candidates must be 0 for viaq"),
        (
            TrainConfig,
            {"observe_candidates": 16, "algo": "sac", "env": "viapoint/PlanarObstaclesStep-v0"},
            "observe_candidates must be 0 .* on viapoint/PlanarObstaclesStep-v0",
        ),
        (TrainConfig, {"observe_candidates": -1}, "observe_candidates must be a whole number, 0 or more"),
        (TrainConfig, {"min_timesteps": 5}, "min_timesteps needs stop_when_stalled"),
        (
            TrainConfig,
            {"stop_when_stalled": 0.3, "n_timesteps": 10**5, "eval_every": 0},
            "stop_when_stalled needs validations",
        ),
        (TrainConfig, {"env": "viapoint/PlanarObstaclesStep-v0"}, "viaq decides on whole movements"),
        (
            TrainConfig,
            {"env": "CartPole-v1"},
            "viapoint/Reach-v0, viapoint/Obstacles-v0, .*got 'CartPole-v1'",
        ),
        (TrainConfig, {"hyperparameters": {"batch_size": -3}}, "batch_size of viaq must be a whole number"),
        *[(TrainConfig, {"env_kwargs": {name: 1}}, f"{name} cannot be among") for name in ELSEWHERE],
        (EvaluateConfig, {}, "name an agent .*--env"),
        (EvaluateConfig, {"baselines": ("magic",)}, "untrained, straight, .* got 'magic'"),
        *[
            (
                EvaluateConfig,
                {"env": "viapoint/PlanarReach-v0", name: value},
                f"{name} concerns an agent",
            )
            for name, value in (("checks", (8,)), ("failures", Path("b")))
        ],
        (EvaluateConfig, {"baselines": ("planner",), "env": "nothing"}, "env"),
        (PlayConfig, {"agent": "a", "n_scenes": 0}, "n_scenes"),
        (BenchConfig, {"num_envs": 0}, "num_envs"),
        (BenchConfig, {"env": "viapoint/PlanarObstaclesStep-v0"}, "an action is a whole movement"),
        (DemoConfig, {"env": "viapoint/PlanarWholeArmStep-v0"}, "viapoint/PlanarWholeArm-v0 for one"),
        (DemoConfig, {"checks": 0}, "checks"),
        (DemoConfig, {"env": "viapoint/Reach-v0"}, "viapoint/PandaReach-v0 for one"),
    ],
)
def test_what_cannot_be_meant_is_refused(kind, values, named):
    with pytest.raises(ValueError, match=named):
        kind(**values)


@pytest.mark.parametrize(
    ("kind", "name", "needed"),
    [
        (EvaluateConfig, "json", {"agent": "a"}),
        (PlayConfig, "video", {"agent": "a"}),
        (BenchConfig, "json", {}),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before_there_is_anything_to_write(
    kind, name, needed, tmp_path
):
    (tmp_path / "file.mp4").write_text("")
    (tmp_path / "folder.mp4").mkdir()
    for good in ("file.mp4", "new.mp4", "deeper/new.mp4"):
        kind(**needed, **{name: tmp_path / good})
    for bad, reason in (
        (tmp_path / "folder.mp4", "is a folder"),
        (tmp_path / "file.mp4" / "new.mp4", r"file\.mp4 is no folder"),
        (tmp_path / "file.mp4" / "deeper" / "new.mp4", r"file\.mp4 is no folder"),
    ):
        with pytest.raises(ValueError, match=f"{name} .*{reason}"):
            kind(**needed, **{name: bad})


@pytest.mark.parametrize(
    ("kind", "name", "needed"),
    [
        (EvaluateConfig, "failures", {"agent": "a"}),
        (PaperConfig, "out", {}),
        (PaperConfig, "guide", {}),
        (DemoConfig, "out", {}),
        (ImportConfig, "out", {"file": Path("a.zip")}),
    ],
)
def test_a_folder_that_cannot_be_written_to_is_refused(kind, name, needed, tmp_path):
    (tmp_path / "file").write_text("")
    for good in (tmp_path, tmp_path / "new" / "deeper"):
        kind(**needed, **{name: good})
    for bad in (tmp_path / "file", tmp_path / "file" / "new"):
        with pytest.raises(ValueError, match=f"{name} .* cannot be written: .*file is no folder"):
            kind(**needed, **{name: bad})


def test_every_method_can_be_named():
    assert set(BASELINES) == {"untrained", *METHODS, *REPLANNING_METHODS}


def test_unknown_names_in_a_file_are_refused():
    with pytest.raises(ValueError, match="colour"):
        TrainConfig.from_json({"colour": "red"})


def test_every_algorithm_has_a_preset_that_fits():
    assert set(PRESETS) == set(ALGORITHMS)
    for name, preset in PRESETS.items():
        assert preset.policy in ALGORITHMS[name].policy_aliases
        assert TrainConfig(algo=name).total_timesteps == preset.n_timesteps
        assert TrainConfig(algo=name, n_timesteps=7, n_envs=3).copies == 3
    assert TrainConfig(algo="sac", seed=4).folder == Path("runs/PlanarObstacles-v0-sac-4")
