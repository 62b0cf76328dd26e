"""Settings for RL Zoo are those of the presets."""

import sys
from pathlib import Path

import pytest
import yaml

from viapoint.envs.registration import ENV_IDS, OWN_ARM_TASKS
from viapoint.training import SceneExtractor
from viapoint.training.config.presets import preset_of

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))

import rl_zoo  # noqa: E402


@pytest.mark.parametrize("algo", rl_zoo.ALGORITHMS)
def test_the_files_are_those_of_the_presets(algo):
    text = (BENCHMARKS / "rl_zoo" / f"{algo}.yml").read_text()
    assert text == rl_zoo.content(algo), "run python benchmarks/rl_zoo.py"
    settings = yaml.safe_load(text)
    assert set(settings) == set(ENV_IDS) - set(OWN_ARM_TASKS)
    for env_id, values in settings.items():
        network = eval(values["policy_kwargs"])  # as RL Zoo does
        assert network == {"features_extractor_class": SceneExtractor, "net_arch": [256, 256]}
        preset = preset_of(env_id, algo)
        assert (values["n_envs"], values["n_timesteps"]) == (preset.n_envs, preset.n_timesteps)
        assert {"action_noise", "discount_unit"}.isdisjoint(values)
