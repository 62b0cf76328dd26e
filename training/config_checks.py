"""What several commands are told, checked where they are told it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym

import viapoint.envs
from viapoint.envs.registration import ONLINE_TASKS, STEP_TASKS

DEFAULT_ENV = "viapoint/PlanarObstacles-v0"


def check_env(env: str) -> None:
    """Refuse an id that is not registered."""
    if env not in gym.registry:
        raise ValueError(
            f"env must be one of {', '.join((*viapoint.envs.TASKS, *STEP_TASKS, *ONLINE_TASKS))}, got {env!r}"
        )


def check_whole_movements(env: str) -> None:
    """Refuse a task in which an action is less than a whole movement."""
    if env in STEP_TASKS or env in ONLINE_TASKS:
        like = STEP_TASKS.get(env, DEFAULT_ENV)
        raise ValueError(f"env must be one where an action is a whole movement, {like} for one, got {env!r}")


def check_whole(name: str, value: Any, least: int) -> None:
    """Refuse anything but whole numbers from `least` on."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number, {least} or more, got {value!r}")


def check_one_source(run: Path | None, pretrained: str | None, *, needed: bool) -> None:
    """Refuse two agents, or none where one is needed."""
    if run is not None and pretrained is not None:
        raise ValueError("give a run folder or --pretrained, not both")
    if needed and run is None and pretrained is None:
        raise ValueError("name a run folder, or an environment with --pretrained")
