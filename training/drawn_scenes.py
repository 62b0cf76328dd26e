"""Scenes for an environment as it was made: the frozen ones where they fit, otherwise drawn, always the same."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from viapoint.envs.registration import ONLINE_TASKS, OWN_ARM_TASKS
from viapoint.training.frozen_scenes import SETS, FrozenScenes, load, shipped_path
from viapoint.training.online_trial import new_trial

ACTION_ARGUMENTS = frozenset(
    {"n_via", "timing", "reward_weights", "threads", "render_mode", "width", "height"}
)
"""Arguments of an environment that leave its scenes as they are; so does `duration_range` where nothing changes
on the way."""
SEEDS = {"validation": 1_000_003, "test": 2_000_003}
"""Of the sets that can be drawn; far from the seeds people train with, and from each other."""
NUMBERS = {"validation": 500, "test": 1_000}
"""How many scenes such a set has."""


def scene_arguments(env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Those arguments of an environment that its scenes depend on."""
    others = ACTION_ARGUMENTS if env_id in ONLINE_TASKS else ACTION_ARGUMENTS | {"duration_range"}
    return {name: value for name, value in env_kwargs.items() if name not in others}


def frozen_fit(name: str, env_id: str, env_kwargs: Mapping[str, Any]) -> bool:
    """Whether a set is shipped whose scenes are those of an environment made with these arguments."""
    return shipped_path(name, env_id).is_file() and not scene_arguments(env_id, env_kwargs)


def drawn(name: str, env_id: str, env_kwargs: Mapping[str, Any], number: int) -> FrozenScenes:
    """Scenes in place of a set, without shares and solutions; the same for the same arguments."""
    trial = new_trial(env_id, 64 if env_id in ONLINE_TASKS else 1, **env_kwargs)
    scenes = trial.draw(number, SEEDS[name])
    trial.close()
    return FrozenScenes(
        name="drawn",
        env_id=env_id,
        scenes=scenes,
        share=np.full(number, np.nan),
        solution=np.zeros((number, trial.task.action.size)),
    )


def scenes_for(name_or_path: str, env_id: str, env_kwargs: Mapping[str, Any]) -> FrozenScenes:
    """The scenes that a command names; drawn ones, with a line that says so, where no frozen ones fit.

    Raises:
        ValueError: There is no such set, or its scenes cannot be those of the environment.
    """
    others = scene_arguments(env_id, env_kwargs)
    if name_or_path not in SETS:
        frozen = load(name_or_path, env_id)
        _check_shapes(frozen, env_kwargs)
        return frozen
    if frozen_fit(name_or_path, env_id, env_kwargs) or not (others or env_id in OWN_ARM_TASKS):
        return load(name_or_path, env_id)
    made = f"{env_id} with {', '.join(f'{name}={value}' for name, value in others.items())}"
    where = made if others else env_id
    if name_or_path not in SEEDS:
        raise ValueError(
            f"there are no {name_or_path} scenes for {where}; scenes must be {', '.join(SEEDS)}, which are drawn "
            "for it, or a file"
        )
    print(f"no frozen {name_or_path} scenes are for {where}: they are drawn", file=sys.stderr)
    return drawn(name_or_path, env_id, env_kwargs, NUMBERS[name_or_path])


def _check_shapes(frozen: FrozenScenes, env_kwargs: Mapping[str, Any]) -> None:
    """Refuse a file whose scenes have other rows of obstacles or another dimension than the environment."""
    trial = new_trial(frozen.env_id, 1, **env_kwargs)
    layout = trial.task.observation
    trial.close()
    mine, theirs = (
        (layout.n_rows, layout.dimension),
        (frozen.scenes.present.shape[1], frozen.scenes.start.shape[1]),
    )
    if mine != theirs:
        raise ValueError(
            f"{frozen.name} holds scenes of {theirs[0]} obstacles at most in {theirs[1]} dimensions; the "
            f"environment, made with {dict(env_kwargs)}, has {mine[0]} in {mine[1]}"
        )
