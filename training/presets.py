"""Tuned settings of the learning algorithms."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from viapoint.envs.task import Task

Algorithm = Literal["viaq", "viarank", "sac", "td3", "ppo", "tqc"]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Default settings of an algorithm."""

    policy: str = "MultiInputPolicy"  # Name of the policy
    n_envs: int = 64  # Environments that are stepped together
    n_timesteps: int  # Decisions in total
    eval_every: int = 1_000  # Decisions between two evaluations on the validation scenes
    checkpoint_every: int = 5_000  # Decisions between two checkpoints
    hyperparameters: Mapping[str, Any]  # As :mod:`~.agents.model_io` writes them


def _changed(preset: Preset, hyperparameters: Mapping[str, Any], **fields: Any) -> Preset:
    """Return a preset with some other hyperparameters and fields."""
    changed = {**preset.hyperparameters, **hyperparameters}
    return dataclasses.replace(preset, hyperparameters=changed, **fields)


def _falling(start: float, end: float) -> dict[str, Any]:
    """Return a learning rate that falls linearly in the course of a training."""
    return {"kind": "linear", "start": start, "end": end, "end_fraction": 1.0}


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
_LITTLE_ENTROPY = {"ent_coef": "auto_0.02"}  # rewards are of order one, and the usual 1 outweighs them
_NOISE = {"action_noise": {"kind": "normal", "sigma": 0.2}}
_SELDOM: dict[str, Any] = {"eval_every": 10_000, "checkpoint_every": 50_000}

# Presets by the names of algorithms on the command line
PRESETS: dict[str, Preset] = {
    # The defaults of the own policies are their settings.
    "viaq": Preset(
        policy="ViaQPolicy",
        hyperparameters={"learning_starts": 4096, "learning_rate": _falling(3e-3, 3e-5)},
        n_timesteps=40_000,
        eval_every=5_000,
        checkpoint_every=20_000,
    ),
    "viarank": Preset(
        policy="ViaRankPolicy",
        n_timesteps=6_000,  # more gain nothing
        eval_every=2_000,
        checkpoint_every=6_000,
        hyperparameters={"learning_rate": _falling(2e-3, 2e-5)},
    ),
    "sac": Preset(n_timesteps=40_000, hyperparameters={**_OFF_POLICY, **_LITTLE_ENTROPY}),
    "td3": Preset(n_timesteps=40_000, hyperparameters={**_OFF_POLICY, **_NOISE}),
    "tqc": Preset(n_timesteps=40_000, hyperparameters={**_OFF_POLICY, **_LITTLE_ENTROPY}),
    "ppo": Preset(
        n_timesteps=400_000,
        hyperparameters={
            "learning_rate": _falling(1e-3, 1e-5),
            "n_steps": 16,
            "batch_size": 256,
            "n_epochs": 10,
            "ent_coef": 0.001,
            "policy_kwargs": _NETWORK,
        },
        **_SELDOM,
    ),
}

# Presets of tasks in which an action lasts one control step, which counts as a decision
_STEP_WISE = {"learning_starts": 4096, "gamma": 0.98}
_STEPS: dict[str, Any] = {"n_timesteps": 200_000, **_SELDOM}
_PPO_STEP_WISE = {"n_steps": 64, "batch_size": 512, "n_epochs": 5, "gamma": 0.98, "ent_coef": 0.0}
_PPO_STEPS: dict[str, Any] = {"n_timesteps": 2_000_000, "eval_every": 50_000, "checkpoint_every": 200_000}
STEP_PRESETS: dict[str, Preset] = {
    **{name: _changed(PRESETS[name], _STEP_WISE, **_STEPS) for name in ("sac", "td3", "tqc")},
    "ppo": _changed(PRESETS["ppo"], _PPO_STEP_WISE, **_PPO_STEPS),
}

# Presets of tasks without obstacles, which need fewer decisions
REACH_PRESETS = {"viaq": dataclasses.replace(PRESETS["viaq"], n_timesteps=8_000)}
_REVISING = {"gradient_steps": 6, "next_candidates": 4}
# Fewer plans of a scene and more updates than for one look, with which it solved 90 in place of 94 % of validation
_LOOKING = {"gradient_steps": 12, "explore_candidates": 32, "labels": 16}
REPLANNING_PRESETS = {
    "viaq": _changed(PRESETS["viaq"], _REVISING, n_timesteps=24_000),
    "viarank": _changed(PRESETS["viarank"], _LOOKING, n_timesteps=12_000, eval_every=4_000),
}
"""Presets of replanning tasks."""
JOINT_DECISIONS = 16_000  # Decisions in joint space, where one costs several times as much
# Settings of viarank in joint space, where the arm has many more places in a movement
JOINT_SIGHT: dict[str, Any] = {
    "batch_size": 32,
    "labels": 16,
    "explore_candidates": 48,
    "gradient_steps": 6,
    "policy_kwargs": {
        "instants": 16,
        "nearest": 48,
        "candidates": 128,
        "refinements": 0,
        "refine": 4,
    },
}


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
    if task.space.of_hand or algo not in ("viaq", "viarank"):
        return preset
    settings = dict(JOINT_SIGHT) if algo == "viarank" else {}
    if settings and task.replanning:  # movements under way are not refined
        settings["policy_kwargs"] = {**JOINT_SIGHT["policy_kwargs"], "refine": 0}
    return _changed(preset, settings, n_timesteps=min(preset.n_timesteps, JOINT_DECISIONS))
