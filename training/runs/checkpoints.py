"""Checkpoints, from which training continues to the same result as without interruption.

A checkpoint is taken between the collection of experience and the next, when SB3 holds nothing in local
variables. It is a folder of `state.json` and `tensors.safetensors`, written whole or not at all, and like a
model it holds no code.
"""

from __future__ import annotations

import hashlib
import json
import random
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr

from viapoint.training.agents.model_io import describe
from viapoint.training.io.files import (
    BadFileError,
    read_arrays,
    read_bytes,
    read_json,
    write_arrays,
    write_folder,
    write_json,
)
from viapoint.training.rollouts.vec_env import ViaVecEnv

FORMAT = 2
COUNTERS = (
    "seed",
    "num_timesteps",
    "_total_timesteps",
    "_episode_num",
    "_n_updates",
    "_current_progress_remaining",
)
"""Counters of Stable-Baselines3's algorithms."""
FILES = ("state.json", "tensors.safetensors")
"""Files of a checkpoint."""
MAY_DIFFER = ("num_timesteps", "viapoint")
"""Entries of a model's description that say nothing about which model it is."""
ARRAYS = ("_last_obs", "_last_episode_starts")
DEQUES = ("ep_info_buffer", "ep_success_buffer")


def write_checkpoint(model: BaseAlgorithm, folder: Path, extra: Mapping[str, Any]) -> None:
    """Write the complete state of a training run; :func:`read_checkpoint` returns `extra`."""
    tensors: dict[str, Any] = {}
    state = {
        "format": FORMAT,
        "model": describe(model),
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "recent": {name: list(getattr(model, name) or ()) for name in DEQUES},
        "parameters": _extract_arrays(model.get_parameters(), "parameters", tensors),
        "variables": _extract_arrays(_variables(model), "variables", tensors),
        "arrays": _extract_arrays({name: getattr(model, name) for name in ARRAYS}, "arrays", tensors),
        "buffer": _extract_arrays(_buffer_state(model), "buffer", tensors),
        "random": _extract_arrays(_random_state(model), "random", tensors),
        "env": _extract_arrays(_env(model).state(), "env", tensors),
        "extra": dict(extra),
    }

    def fill(temporary: Path) -> None:
        write_arrays(temporary / "tensors.safetensors", tensors)
        state["sha256"] = hashlib.sha256(read_bytes(temporary / "tensors.safetensors")).hexdigest()
        state["digest"] = _digest(state)
        write_json(temporary / "state.json", state)

    write_folder(folder, fill, marked=False)  # a damaged checkpoint is replaced, too


def is_checkpoint(folder: Path) -> bool:
    """Return whether a folder holds files of a checkpoint, damaged or not."""
    return any((folder / name).is_file() for name in FILES)


def remove_checkpoint(folder: Path) -> None:
    """Remove the files of a checkpoint, and its folder unless it holds something else."""
    for name in FILES:
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def read_checkpoint(model: BaseAlgorithm, folder: Path) -> dict[str, Any]:
    """Set a newly built model of the same kind and its environment to the state of a checkpoint.

    Returns:
        Content of `extra`.

    Raises:
        BadFileError: The checkpoint is torn, foreign, or of another model.
    """
    state = _verified_state(folder)
    written_by = f"was written by viapoint {state['model'].get('viapoint')} and"
    mine = describe(model)
    others = [name for name in mine if name not in MAY_DIFFER and mine[name] != state["model"].get(name)]
    if others:
        raise BadFileError(folder / "state.json", f"{written_by} is of another model: {', '.join(others)}")
    tensors = read_arrays(folder / "tensors.safetensors")
    try:
        _restore(model, state, tensors)
        extra: dict[str, Any] = dict(state["extra"])
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = f"{written_by} does not fit the model ({type(error).__name__}: {error})"
        raise BadFileError(folder, reason) from None
    return extra


def _verified_state(folder: Path) -> dict[str, Any]:
    """Return the content of `state.json` after checking the hashes of both files."""
    path, tensors = folder / "state.json", folder / "tensors.safetensors"
    state = read_json(path)
    if state.get("format") != FORMAT or not isinstance(state.get("model"), dict):
        raise BadFileError(path, f"must have format {FORMAT}, got {state.get('format')!r}")
    if state.get("digest") != _digest(state):
        raise BadFileError(path, "is damaged: it does not have the hash that it states")
    if hashlib.sha256(read_bytes(tensors)).hexdigest() != state.get("sha256"):
        raise BadFileError(tensors, "is torn: its hash is not the one that state.json states")
    return state


def _digest(state: Mapping[str, Any]) -> str:
    """Return the hash of everything else in a state."""
    rest = {name: value for name, value in state.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _restore(model: BaseAlgorithm, state: dict[str, Any], tensors: dict[str, Any]) -> None:
    """Set the attributes that a checkpoint holds; the code determines which ones, never the file."""
    trained = {name: torch.from_numpy(a) for name, a in tensors.items() if name.startswith("parameters/")}
    model.set_parameters(_insert_arrays(state["parameters"], trained), exact_match=True)
    variables, arrays = _insert_arrays(state["variables"], tensors), _insert_arrays(state["arrays"], tensors)
    for name in _variables(model):
        recursive_setattr(model, f"{name}.data", torch.from_numpy(variables[name]))
    for name in COUNTERS:
        setattr(model, name, state["counters"][name])
    for name in ARRAYS:
        setattr(model, name, arrays[name])
    for name in DEQUES:
        setattr(model, name, deque(state["recent"][name], maxlen=model._stats_window_size))
    _restore_buffer(model, _insert_arrays(state["buffer"], tensors))
    _env(model).restore(_insert_arrays(state["env"], tensors))
    _restore_random(model, _insert_arrays(state["random"], tensors))  # last: nothing may be drawn after it


def _variables(model: BaseAlgorithm) -> dict[str, Any]:
    """Return tensors outside of modules and optimisers, such as SAC's entropy coefficient."""
    return {name: recursive_getattr(model, name).detach() for name in model._get_torch_save_params()[1]}


def _buffer_arrays(buffer: BaseBuffer) -> dict[str, NDArray[Any]]:
    """Return the arrays of a replay buffer by name, those of observations by `name/part`."""
    arrays = {}
    for name, value in vars(buffer).items():
        parts = value if isinstance(value, dict) else {"": value}
        for part, array in parts.items():
            if isinstance(array, np.ndarray):
                arrays[f"{name}/{part}" if part else name] = array
    return arrays


def _buffer_state(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the filled part of the replay buffer; a rollout buffer is empty between two collections."""
    buffer: BaseBuffer | None = getattr(model, "replay_buffer", None)
    if buffer is None:
        return {}
    filled = {name: array[: buffer.size()] for name, array in _buffer_arrays(buffer).items()}
    return {"pos": buffer.pos, "full": buffer.full, "arrays": filled}


def _restore_buffer(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    buffer: BaseBuffer | None = getattr(model, "replay_buffer", None)
    if buffer is None:
        return
    for name, mine in _buffer_arrays(buffer).items():
        saved = state["arrays"][name]
        if mine.shape[1:] != saved.shape[1:] or mine.dtype != saved.dtype or len(saved) > len(mine):
            must, got = (f"{array.dtype} {array.shape}" for array in (mine, saved))
            raise ValueError(f"{name} of the replay buffer must fit into {must}, is {got}")
        mine[: len(saved)] = saved
    if not 0 <= state["pos"] < buffer.buffer_size:
        raise ValueError(f"the replay buffer has {buffer.buffer_size} rows, no row {state['pos']}")
    buffer.pos, buffer.full = int(state["pos"]), bool(state["full"])


def _random_state(model: BaseAlgorithm) -> dict[str, Any]:
    version, words, gauss = random.getstate()
    return {
        "python": [version, list(words), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _restore_random(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(torch.from_numpy(state["torch"]))
    model.action_space.np_random.bit_generator.state = state["actions"]


def _env(model: BaseAlgorithm) -> ViaVecEnv:
    env = model.get_env()
    assert isinstance(env, ViaVecEnv)
    return env


def _extract_arrays(value: Any, name: str, tensors: dict[str, Any]) -> Any:
    """Return a copy of nested values in which {"tensor": name} replaces each array, and add the arrays to `tensors`."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        tensors[name] = value
        return {"tensor": name}
    if isinstance(value, Mapping):
        whole = [str(key) for key in value if isinstance(key, int)]
        entries = {str(key): _extract_arrays(each, f"{name}/{key}", tensors) for key, each in value.items()}
        return {"whole_numbers": entries} if whole else entries
    if isinstance(value, list | tuple):
        return [_extract_arrays(each, f"{name}/{i}", tensors) for i, each in enumerate(value)]
    return value.item() if isinstance(value, np.generic) else value


def _insert_arrays(value: Any, tensors: Mapping[str, Any]) -> Any:
    """Invert :func:`_extract_arrays`, with arrays in place of torch tensors."""
    if isinstance(value, list):
        return [_insert_arrays(each, tensors) for each in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {"tensor"}:
        return tensors[value["tensor"]]
    if set(value) == {"whole_numbers"}:
        return {int(key): _insert_arrays(each, tensors) for key, each in value["whole_numbers"].items()}
    return {key: _insert_arrays(each, tensors) for key, each in value.items()}
