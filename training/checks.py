"""Checks of configurations."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from viapoint.envs.common.validation import did_you_mean, whole_number
from viapoint.training.files import BadFileError, check_ours, read_json

DEFAULT_ENV = "viapoint/PlanarObstacles-v0"
SHIPPED = Path(str(files("viapoint.training") / "pretrained"))  # Agents of the package
# Ids of environments with a shipped agent
SHIPPED_IDS = tuple(f"viapoint/{path.parent.name}" for path in sorted(SHIPPED.glob("*/model.json")))

# Arguments that a training's environment does not take, and what to use instead
RESULTS = frozenset({"methods", "problems"})  # Names in files of results, of which each has one
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
# Least and greatest values of whole numbers, by the names of arguments and fields
RANGES: dict[str, tuple[int, int | None]] = {
    "seed": (0, 2**32 - 1),  # that of NumPy's legacy generator
    "n_envs": (1, 1 << 16),  # environments in memory
    "n_timesteps": (1, 10**9),  # days of training
    "port": (0, 65535),
    **dict.fromkeys(("checks", "eval_every"), (0, None)),
    **dict.fromkeys(("n_scenes", "n_via", "refine", "trials", "workers"), (1, None)),
    **dict.fromkeys(("checkpoint_every", "episodes", "eval_scenes"), (1, None)),
}


def unknown_name(what: str, value: object, allowed: Collection[str]) -> str:
    """Return the message about an unknown name, with the closest allowed one."""
    return f"{what} must be one of {', '.join(allowed)}, got {value!r}{did_you_mean(value, allowed)}"


def check_env_kwargs(kwargs: Mapping[str, Any]) -> None:
    """Check that no argument has a flag of its own; the environment checks the others."""
    for name in kwargs:
        if name in ELSEWHERE:
            raise ValueError(f"{name} cannot be among env_kwargs: {ELSEWHERE[name]}")


def check_whole(name: str, value: Any) -> int:
    """Return a whole number in the range of its name."""
    return whole_number(name, value, *RANGES[name])


def named_path(name: str, value: str | Path) -> Path:
    """Return a path of its text, which must not be empty: Python would take that for the present folder."""
    if not isinstance(value, str | Path) or not str(value):
        raise ValueError(f"{name} must name a file or folder, got {value!r}")
    return Path(value).expanduser()


def check_file(name: str, path: Path | None, suffix: str = "") -> None:
    """Check that a file can be written."""
    if path is None:
        return
    if suffix and path.suffix.lower() != suffix:
        raise ValueError(f"{name} must end in {suffix}, got {path}")
    check_ours(path)
    filled = path.is_file() and path.stat().st_size > 0
    if path.suffix == ".json" and filled and RESULTS.isdisjoint(read_json(path)):
        raise BadFileError(path, "holds no results of viapoint; name another file")
    check_folder(f"{name} {path}", path.parent)


def check_folder(name: str, folder: Path) -> None:
    """Check that a folder exists or can be created, and can be written to."""
    there = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.exists(each))
    if not os.path.isdir(there):
        raise ValueError(f"{name} cannot be written: {there} is no folder")
    try:
        with tempfile.TemporaryFile(dir=there):  # permissions alone do not tell, in /proc for example
            pass
    except OSError:
        raise ValueError(f"{name} cannot be written: nothing may be written in {there}") from None
