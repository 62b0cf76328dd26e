"""Write the configuration files of RL Zoo from the presets of this package: docs/rl-zoo.md.

    python benchmarks/rl_zoo.py

Each file `benchmarks/rl_zoo/<algorithm>.yml` has one entry per environment id. RL Zoo writes some values in another
form: action noise as `noise_type` and `noise_std`, a falling learning rate as `lin_START`, which ends at 0, and
`policy_kwargs` as Python code that it evaluates.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from viapoint.envs.registration import ENV_IDS, OWN_ARM_TASKS
from viapoint.training.config.presets import Algorithm, preset_of

FOLDER = Path(__file__).parent / "rl_zoo"
ALGORITHMS: tuple[Algorithm, ...] = ("sac", "td3", "tqc", "ppo")
EXTRACTOR = "__import__('viapoint.training', fromlist=['SceneExtractor']).SceneExtractor"
"""Expression for the feature extractor; RL Zoo evaluates it where the package is not imported."""


def entry(env_id: str, algo: Algorithm) -> dict[str, Any]:
    """Return the settings of RL Zoo for an algorithm in an environment."""
    preset = preset_of(env_id, algo)
    values = preset.arguments()
    noise = values.pop("action_noise", None)
    if noise is not None:
        values |= {"noise_type": noise["kind"], "noise_std": noise["sigma"]}
    if isinstance(values["learning_rate"], dict):
        values["learning_rate"] = f"lin_{values['learning_rate']['start']:g}"
    network = values.pop("policy_kwargs")
    values["policy_kwargs"] = f"dict(features_extractor_class={EXTRACTOR}, net_arch={network['net_arch']})"
    return {"n_envs": preset.n_envs, "n_timesteps": preset.n_timesteps, "policy": preset.policy, **values}


def content(algo: Algorithm) -> str:
    """Return the configuration file of an algorithm."""
    ids = [env_id for env_id in ENV_IDS if env_id not in OWN_ARM_TASKS]
    text = yaml.safe_dump({env_id: entry(env_id, algo) for env_id in ids}, sort_keys=False, width=200)
    return f"# Settings of {algo} for RL Zoo, written by benchmarks/rl_zoo.py; docs/rl-zoo.md shows their use.\n{text}"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in ALGORITHMS:
        (FOLDER / f"{name}.yml").write_text(content(name))
