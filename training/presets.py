"""Tuned settings of the learning algorithms, which `presets.yaml` holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

from viapoint.envs.task import Task
from viapoint.training.files import parse_yaml

Algorithm = Literal["viaq", "viarank", "sac", "td3", "ppo", "tqc"]
JOINT_DECISIONS = 16_000  # Most decisions in joint space, where one costs several times as much


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Default settings of an algorithm."""

    policy: str = "MultiInputPolicy"  # Name of the policy
    n_envs: int = 64  # Environments that are stepped together
    n_timesteps: int  # Decisions in total
    eval_every: int = 1_000  # Decisions between two evaluations on the validation scenes
    checkpoint_every: int = 5_000  # Decisions between two checkpoints
    hyperparameters: Mapping[str, Any]  # As :mod:`~.agents.model_io` writes them


_SETTINGS = parse_yaml((files("viapoint.training") / "presets.yaml").read_bytes())


def _presets(kind: str) -> dict[str, Preset]:
    """Return the presets of a kind of tasks by the names of algorithms."""
    return {algo: Preset(**fields) for algo, fields in _SETTINGS[kind].items()}


PRESETS = _presets("one decision")
STEP_PRESETS = _presets("control steps")
REACH_PRESETS = _presets("no obstacles")
REPLANNING_PRESETS = _presets("replanning")


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
    settings = dict(_SETTINGS["joint space"].get(algo, {}))
    if settings and task.replanning:  # movements under way are not refined
        settings["policy_kwargs"] = {**settings["policy_kwargs"], "refine": 0}
    fewer = min(preset.n_timesteps, JOINT_DECISIONS)
    return dataclasses.replace(
        preset, n_timesteps=fewer, hyperparameters={**preset.hyperparameters, **settings}
    )
