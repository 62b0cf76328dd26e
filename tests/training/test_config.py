"""Configurations are checked when made, frozen, and survive JSON and the command line."""

import json
import shlex
from pathlib import Path

import pytest

from viapoint.training import TrainConfig
from viapoint.training.agents.model_io import ALGORITHMS, check_hyperparameters
from viapoint.training.cli import entry as cli
from viapoint.training.config.configs import EvaluateConfig, from_words, to_words
from viapoint.training.config.presets import PRESETS, REACH_PRESETS, REPLANNING_PRESETS, STEP_PRESETS


def test_the_configuration_of_a_training_survives_json():
    config = TrainConfig(
        algo="ppo", out=Path("x"), env_kwargs={"n_via": 2}, hyperparameters={"batch_size": 3}
    )
    assert TrainConfig(**json.loads(json.dumps(config.as_json()))) == config


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("[1,8]", [1, 8]),
        ('{"a":[16]}', {"a": [16]}),
        ("a=b", "a=b"),
    ],
)
def test_words_are_values_in_yaml(text, value):
    assert from_words([f"x={text}"]) == {"x": value}


@pytest.mark.parametrize("value", [1e-7, True, None, [1, 8], {"a": [16]}, "learned", "2", "true", "", "a: b"])
def test_values_survive_the_way_to_words_and_back(value):
    assert from_words(to_words({"x": value})) == {"x": value}


def test_words_become_a_configuration():
    words = "train --env viapoint/PlanarReach-v0 --algo sac --seed 3 --n-timesteps 9"
    words += " --env-kwargs n_via=2 timing=learned --hyperparameters tau=0.1"
    config = cli.parse(shlex.split(words))
    assert config == TrainConfig(
        env="viapoint/PlanarReach-v0",
        algo="sac",
        seed=3,
        n_timesteps=9,
        env_kwargs={"n_via": 2, "timing": "learned"},
        hyperparameters={"tau": 0.1},
    )
    assert cli.parse(shlex.split(config.command)[1:]) == config
    config = cli.parse(shlex.split("evaluate runs/x --baselines planner --json a.json"))
    assert config == EvaluateConfig(agent="runs/x", baselines=("planner",), json=Path("a.json"))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_short_training_begins_to_learn_in_proportion(algo):
    usual = TrainConfig(algo=algo)
    short = TrainConfig(algo=algo, n_timesteps=usual.total_timesteps // 8)
    if "learning_starts" in usual.all_hyperparameters:
        ratio = short.all_hyperparameters["learning_starts"] / usual.all_hyperparameters["learning_starts"]
        assert ratio == pytest.approx(1 / 8)
    given = TrainConfig(algo="sac", n_timesteps=64, hyperparameters={"learning_starts": 100})
    assert given.all_hyperparameters["learning_starts"] == 100


def test_every_algorithm_has_presets_that_fit():
    assert set(PRESETS) == set(ALGORITHMS)
    for presets in (PRESETS, STEP_PRESETS, REACH_PRESETS, REPLANNING_PRESETS):
        for algo, preset in presets.items():
            assert preset.policy in ALGORITHMS[algo].policy_aliases
            check_hyperparameters(algo, preset.arguments())
    for algo, preset in PRESETS.items():
        assert TrainConfig(algo=algo).total_timesteps == preset.n_timesteps
