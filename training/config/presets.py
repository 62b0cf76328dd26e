"""Tuned settings of the learning algorithms."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from viapoint.envs.task import Task

Algorithm = Literal["viaq", "viarank", "sac", "td3", "ppo", "tqc"]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Default settings of an algorithm."""

    policy: str  # Name of the policy
    n_envs: int = 64  # Environments that are stepped together
    n_timesteps: int  # Decisions in total
    eval_every: int = 1_000  # Decisions between two evaluations on the validation scenes
    checkpoint_every: int = 5_000  # Decisions between two checkpoints
    hyperparameters: Mapping[str, Any]  # As :mod:`~.agents.model_io` writes them

    def arguments(self) -> dict[str, Any]:
        """Return the hyperparameters as a new dictionary."""
        return copy.deepcopy(dict(self.hyperparameters))


def _preset(n_timesteps: int, policy: str = "MultiInputPolicy", **values: Any) -> Preset:
    """Return a preset from its fields and hyperparameters."""
    fields = {name: values.pop(name) for name in ("eval_every", "checkpoint_every") if name in values}
    return Preset(policy=policy, n_timesteps=n_timesteps, **fields, hyperparameters=values)


_NETWORK: dict[str, Any] = {
    "features_extractor_class": {"kind": "extractor", "name": "SceneExtractor"},
    "net_arch": [256, 256],
}
_OFF_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3,
    "buffer_size": 200_000,
    "learning_starts": 1024,
    "batch_size": 256,
    "gamma": 0.99,  # of no account where an episode is one decision
    "train_freq": 1,
    "gradient_steps": 16,
    "policy_kwargs": _NETWORK,
}
_LITTLE_ENTROPY = "auto_0.02"  # rewards are of order one, and the usual 1 outweighs them
_STEP_WISE: dict[str, Any] = {**_OFF_POLICY, "learning_starts": 4096, "gamma": 0.98}
_SELDOM: dict[str, Any] = {"eval_every": 10_000, "checkpoint_every": 50_000}

PRESETS: dict[str, Preset] = {
    "viaq": _preset(
        40_000,
        "ViaQPolicy",  # its defaults are its settings
        eval_every=5_000,
        checkpoint_every=20_000,
        learning_starts=4096,
        learning_rate={"kind": "linear", "start": 3e-3, "end": 3e-5, "end_fraction": 1.0},
    ),
    "viarank": _preset(
        40_000,
        "ViaRankPolicy",  # its defaults are its settings
        eval_every=5_000,
        checkpoint_every=20_000,
        learning_rate={"kind": "linear", "start": 2e-3, "end": 2e-5, "end_fraction": 1.0},
    ),
    "sac": _preset(40_000, **_OFF_POLICY, ent_coef=_LITTLE_ENTROPY),
    "td3": _preset(40_000, **_OFF_POLICY, action_noise={"kind": "normal", "sigma": 0.2}),
    "tqc": _preset(40_000, **_OFF_POLICY, ent_coef=_LITTLE_ENTROPY),
    "ppo": _preset(
        400_000,
        **_SELDOM,
        learning_rate={"kind": "linear", "start": 1e-3, "end": 1e-5, "end_fraction": 1.0},
        n_steps=16,
        batch_size=256,
        n_epochs=10,
        ent_coef=0.001,
        policy_kwargs=_NETWORK,
    ),
}
"""Presets by the names of algorithms on the command line."""

STEP_PRESETS: dict[str, Preset] = {
    "sac": _preset(200_000, **_SELDOM, **_STEP_WISE, ent_coef=_LITTLE_ENTROPY),
    "td3": _preset(200_000, **_SELDOM, **_STEP_WISE, action_noise={"kind": "normal", "sigma": 0.2}),
    "tqc": _preset(200_000, **_SELDOM, **_STEP_WISE, ent_coef=_LITTLE_ENTROPY),
    "ppo": _preset(
        2_000_000,
        eval_every=50_000,
        checkpoint_every=200_000,
        learning_rate={"kind": "linear", "start": 1e-3, "end": 1e-5, "end_fraction": 1.0},
        n_steps=64,
        batch_size=512,
        n_epochs=5,
        gamma=0.98,
        ent_coef=0.0,
        policy_kwargs=_NETWORK,
    ),
}
"""Presets of tasks in which an action lasts one control step, which counts as a decision."""

# Presets of tasks without obstacles, which need fewer decisions
REACH_PRESETS: dict[str, Preset] = {"viaq": dataclasses.replace(PRESETS["viaq"], n_timesteps=8_000)}

REPLANNING_PRESETS: dict[str, Preset] = {
    "viaq": dataclasses.replace(
        PRESETS["viaq"],
        n_timesteps=24_000,
        hyperparameters={**PRESETS["viaq"].hyperparameters, "gradient_steps": 6, "next_candidates": 4},
    )
}
"""Presets of replanning tasks."""
JOINT_DECISIONS = 16_000  # decisions in joint space, where one costs several times as much


JOINT_SIGHT: dict[str, Any] = {
    "batch_size": 32,
    "labels": 16,
    "explore_candidates": 48,
    "gradient_steps": 6,
    "policy_kwargs": {"instants": 16, "nearest": 48, "candidates": 128, "refine": 4},
}
"""Settings of viarank in joint space, where the arm has many more places in a movement."""


def usual_algorithm(task: Task) -> Algorithm:
    """Return the algorithm that a task is trained with if none is named."""
    return "viaq" if task.sensor is None else "viarank"


def preset_of(task: Task, algo: Algorithm) -> Preset:
    """Return the default settings of an algorithm for a task."""
    if task.stepwise:
        return STEP_PRESETS[algo]
    preset = PRESETS[algo]
    if task.replanning:
        preset = REPLANNING_PRESETS.get(algo, preset)
    elif not task.n_obstacles[1]:
        preset = REACH_PRESETS.get(algo, preset)
    if algo == "viaq" and not task.space.of_hand:
        preset = dataclasses.replace(preset, n_timesteps=min(preset.n_timesteps, JOINT_DECISIONS))
    if algo == "viarank" and not task.space.of_hand:
        settings = {**preset.hyperparameters, **JOINT_SIGHT}
        preset = dataclasses.replace(preset, n_timesteps=JOINT_DECISIONS, hyperparameters=settings)
    return preset
