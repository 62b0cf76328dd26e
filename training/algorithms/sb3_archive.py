"""Archives of Stable-Baselines3, which `model.save` of that library writes and `load` opens.

An archive holds pickled objects, so opening one runs code. Nothing in this module opens one without being told to:
:func:`algorithm_of` and :func:`environment_of` read names only.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from viapoint.training.io.files import BadFileError
from viapoint.training.rollouts.vec_env import env_arguments

LARGEST_DATA = 64 << 20
"""Size of an archive's description at most, [bytes]."""
TELLTALE = {
    "viaq": "explore_candidates",
    "tqc": "top_quantiles_to_drop_per_net",
    "sac": "target_entropy",
    "td3": "policy_delay",
    "ppo": "clip_range",
}
"""Name in the description of each algorithm's archives, and of no algorithm below it."""
ENVIRONMENT = "viapoint_env"
"""Name in the description of archives of this package: id and arguments of the environment."""
PASSING = (
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
    "ep_info_buffer",
    "ep_success_buffer",
    "trainable",
)
"""Attributes of a model that describe a moment of its training."""


def write_archive(model: BaseAlgorithm, path: Path, hyperparameters: Mapping[str, Any] | None = None) -> None:
    """Write a model as an archive, which the class of Stable-Baselines3 loads with the same decisions.

    Args:
        model: Agent of this package, with an environment.
        path: File to write, which ends in .zip.
        hyperparameters: Sizes of buffers to state in the archive; a model that was loaded for decisions has small ones.
    """
    env_id, env_kwargs = env_arguments(model.get_env())
    sizes = {
        name: value for name, value in (hyperparameters or {}).items() if name in ("buffer_size", "n_steps")
    }
    changed = {**sizes, ENVIRONMENT: {"id": env_id, "kwargs": env_kwargs}}
    before = {name: getattr(model, name) for name in changed if hasattr(model, name)}
    try:
        vars(model).update(changed)
        BaseAlgorithm.save(model, path, exclude=PASSING)
    finally:
        vars(model).update(before)
        vars(model).pop(ENVIRONMENT, None)


def algorithm_of(path: Path) -> str:
    """Return the algorithm of an archive from the names in its description, without opening its objects.

    Raises:
        BadFileError: The file is no archive of Stable-Baselines3, or of another algorithm.
    """
    names = _description(path)
    for algo, telltale in TELLTALE.items():
        if telltale in names:
            return algo
    raise BadFileError(path, f"is of none of {', '.join(TELLTALE)}")


def environment_of(path: Path) -> dict[str, Any] | None:
    """Return `id` and `kwargs` of the environment that an archive names; only archives of this package name one.

    Raises:
        BadFileError: The file is no archive of Stable-Baselines3.
    """
    record = _description(path).get(ENVIRONMENT)
    known = (
        isinstance(record, dict)
        and isinstance(record.get("id"), str)
        and isinstance(record.get("kwargs"), dict)
    )
    return record if known else None


def open_archive(path: Path, kind: type[BaseAlgorithm], env: VecEnv, *, trainable: bool = False) -> Any:
    """Open an archive, which runs its code, and return the model.

    Args:
        path: Archive.
        kind: Class of the model.
        env: Environment of the model.
        trainable: Make a replay buffer of the stated size; otherwise one that holds a single decision.

    Raises:
        BadFileError: The file is no archive, cannot be opened, or its model does not fit the environment.
    """
    size = _description(path).get("buffer_size")
    small = {} if size is None or trainable else {"buffer_size": 1}
    try:
        load: Any = BaseAlgorithm.load
        model = load.__func__(kind, path, env, device="cpu", **small)
    except Exception as error:  # whatever the archive does
        where = f"{kind.__name__} for {env_arguments(env)[0]}"
        raise BadFileError(path, f"cannot be opened as {where} ({type(error).__name__}: {error})") from None
    if size is not None:
        model.buffer_size = size
    vars(model).pop(ENVIRONMENT, None)
    return model


def _description(path: Path) -> dict[str, Any]:
    """Return the description in an archive: numbers and words, and objects that are not opened.

    Raises:
        BadFileError: The file is no archive of Stable-Baselines3.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("data").file_size > LARGEST_DATA:
                raise BadFileError(path, f"has a description of more than {LARGEST_DATA} bytes")
            names = json.loads(archive.read("data"))
            archive.getinfo("policy.pth")
    except FileNotFoundError:
        raise BadFileError(path, "is missing") from None
    except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError, RecursionError) as error:
        raise BadFileError(path, f"is no archive of Stable-Baselines3 ({error})") from None
    if not isinstance(names, dict):
        raise BadFileError(path, "is no archive of Stable-Baselines3 (its description is no object)")
    return names
