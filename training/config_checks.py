"""What several commands are told, checked where they are told it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from viapoint.envs.registration import ENV_IDS, ONLINE_TASKS, OWN_ARM_TASKS, STEP_TASKS

DEFAULT_ENV = "viapoint/PlanarObstacles-v0"

METHODS = (
    "agent", "untrained", "straight", "constant", "random", "random16", "random80", "planner", "ompl", "unrevised",
    "search16", "search64", "search512", "search4096",
)  # fmt: skip
"""Everything that can be measured; not every environment has each of them."""
ELSEWHERE = {
    "num_envs": "--n-envs says how many environments are stepped together",
    "seed": "--seed is that of everything",
    "env_id": "--env names the environment",
    "id": "--env names the environment",
    "render_mode": "viapoint play films",
    "vectorization_mode": "the environments are native vector environments",
    "vector_kwargs": "the environments are native vector environments",
    "wrappers": "the environments are trained on as they are",
}
"""What is no argument of a training's environment, and what is instead."""
GREATEST = {"seed": 2**32 - 1, "n_envs": 1 << 16, "num_envs": 1 << 16}
"""Of what has a limit: seeds as NumPy's old generator takes them, environments as many as may fit into memory."""


def check_env(env: str) -> None:
    """Refuse an id that is not one of this package's."""
    if env not in ENV_IDS:
        raise ValueError(
            f"env must be one of {', '.join(ENV_IDS)}, which `import viapoint.envs` registers; got {env!r}"
        )


def check_env_kwargs(kwargs: Mapping[str, Any]) -> None:
    """Refuse arguments that are given elsewhere; the others are checked by the environment."""
    if not isinstance(kwargs, Mapping):
        raise ValueError(f"env_kwargs must be values by name, got {kwargs!r}")
    for name in kwargs:
        if name in ELSEWHERE:
            raise ValueError(f"{name} cannot be among env_kwargs: {ELSEWHERE[name]}")


def check_whole_movements(env: str) -> None:
    """Refuse a task in which an action is less than a whole movement."""
    if env in STEP_TASKS or env in ONLINE_TASKS:
        like = STEP_TASKS.get(env, DEFAULT_ENV)
        raise ValueError(f"env must be one where an action is a whole movement, {like} for one, got {env!r}")


def check_has_scenes(env: str) -> None:
    """Refuse a task that no scenes are shipped for."""
    if env in OWN_ARM_TASKS:
        raise ValueError(f"env must be one with frozen scenes, {OWN_ARM_TASKS[env]} for one, got {env!r}")


def check_whole(name: str, value: Any, least: int) -> None:
    """Refuse anything but whole numbers from `least` to the greatest that makes sense."""
    most = GREATEST.get(name)
    known = isinstance(value, int) and not isinstance(value, bool)
    if not known or value < least or (most is not None and value > most):
        allowed = f"{least} or more" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be a whole number, {allowed}, got {value!r}")


def check_one_source(run: Path | None, pretrained: str | None, *, needed: bool) -> None:
    """Refuse two agents, or none where one is needed."""
    if run is not None and pretrained is not None:
        raise ValueError("give a run folder or --pretrained, not both")
    if needed and run is None and pretrained is None:
        raise ValueError("name a run folder, or an environment with --pretrained")


def check_methods(methods: tuple[str, ...]) -> None:
    """Refuse none, names that there are not, and one that is there twice, as a table has one row for each."""
    if not methods:
        raise ValueError("methods must name at least one method")
    for name in methods:
        if name not in METHODS:
            raise ValueError(f"methods must be some of {', '.join(METHODS)}, got {name!r}")
        if methods.count(name) > 1:
            raise ValueError(f"methods must differ, {name} is there twice")


def check_file(name: str, path: Path | None, suffix: str = "") -> None:
    """Refuse a file that cannot be written, before there is anything to write."""
    if path is None:
        return
    if suffix and path.suffix.lower() != suffix:
        raise ValueError(f"{name} must end in {suffix}, got {path}")
    if os.path.isdir(path):
        raise ValueError(f"{name} must be a file, and {path} is a folder")
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{name} must be a file, and {path} is something else")
    _check_place(name, path, path.parent)


def check_folder(name: str, path: Path | None) -> None:
    """Refuse a folder that cannot be written to, before there is anything to write."""
    if path is not None:
        _check_place(name, path, path)


def _check_place(name: str, path: Path, folder: Path) -> None:
    """Whether a folder is there or can be made, and can be written to."""
    there = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.exists(each))
    if not os.path.isdir(there):
        raise ValueError(f"{name} {path} cannot be written: {there} is no folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{name} {path} cannot be written: nothing may be written in {there}")
