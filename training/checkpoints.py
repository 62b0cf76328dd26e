"""Checkpoints, from which training continues to the same result as without interruption.

A checkpoint is taken between the collection of experience and the next, when SB3 holds nothing in local variables. It
is one file of `torch.save`, written whole or not at all, and read with `weights_only=True`, so no code of it is run.
"""

from __future__ import annotations

import io
import json
import random
import zipfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from torch.utils._pytree import tree_map, tree_map_only

from viapoint.envs.arms.registry import ARM_FILES
from viapoint.envs.arms.stored import COPY
from viapoint.training.agents.model_io import describe
from viapoint.training.files import BadFileError, read_bytes, write_bytes, written_by
from viapoint.training.vec_env import ViaVecEnv

FORMAT = 3
# Counters of Stable-Baselines3's algorithms
COUNTERS = (
    "seed",
    "num_timesteps",
    "_total_timesteps",
    "_episode_num",
    "_n_updates",
    "_current_progress_remaining",
)
ARRAYS = ("_last_obs", "_last_episode_starts")
DEQUES = ("ep_info_buffer", "ep_success_buffer")
MAY_DIFFER = ("num_timesteps", "viapoint")  # Entries that do not tell models apart


def write_checkpoint(model: BaseAlgorithm, path: Path, seconds: float) -> None:
    """Write the complete state of a training run that has taken a time, [s]."""
    env = model.get_env()
    assert isinstance(env, ViaVecEnv)
    arrays = {
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "recent": {name: list(getattr(model, name) or ()) for name in DEQUES},
        "last": {name: getattr(model, name) for name in ARRAYS},
        "buffer": {},
        "random": {
            "python": random.getstate(),
            "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
            "actions": model.action_space.np_random.bit_generator.state,
        },
        "env": env.state(),
    }
    buffer: Any = getattr(model, "replay_buffer", None)  # a rollout buffer is empty between two collections
    if buffer is not None:
        filled = tree_map_only(np.ndarray, lambda array: array[: buffer.size()], _buffer_arrays(buffer))
        arrays["buffer"] = {"pos": buffer.pos, "full": buffer.full, "arrays": filled}
    state = {
        "format": FORMAT,
        "model": describe(model),
        "parameters": model.get_parameters(),
        "variables": {name: variable.detach() for name, variable in _variables(model).items()},
        "torch_random": torch.get_rng_state(),
        "arrays": tree_map_only((np.ndarray, np.generic), _to_torch, arrays),
        "extra": {"seconds": seconds},
    }
    content = io.BytesIO()
    torch.save(state, content)
    write_bytes(path, content.getvalue())


def read_checkpoint(model: BaseAlgorithm, path: Path) -> float:
    """Set a newly built model and its environment to the state of a checkpoint, and return the time so far, [s].

    A checkpoint that is torn, foreign, or of another model raises BadFileError.
    """
    state = read_state(path)
    written = written_by(state["model"].get("viapoint"))
    mine = _with_any_file(describe(model))
    theirs = _with_any_file(state["model"])
    others = [name for name in mine if name not in MAY_DIFFER and mine[name] != theirs.get(name)]
    if others:
        raise BadFileError(path, f"is of another model: {', '.join(others)}{written}")
    try:
        _restore(model, state, tree_map_only(torch.Tensor, torch.Tensor.numpy, state["arrays"]))
        return float(state["extra"]["seconds"])
    except Exception as error:  # of a library, for content that does not fit the model
        reason = f"does not fit the model ({type(error).__name__}: {error})"
        raise BadFileError(path, reason + written) from None


def _with_any_file(record: Any) -> Any:
    """Return a description of a model, in which all arms of files have the same name.

    A run goes on with the copy of its arm where the file is gone, and with the file where it is there again.
    """

    def renamed(part: dict[str, Any]) -> dict[str, Any]:
        return {**part, "arm": COPY} if str(part.get("arm")).endswith(ARM_FILES) else part

    return json.loads(json.dumps(record), object_hook=renamed)


def read_state(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint after checking the sums of its parts; a bad one raises BadFileError."""
    content = io.BytesIO(read_bytes(path))
    try:
        with zipfile.ZipFile(content) as archive:
            torn = archive.testzip()
        if torn is not None:
            raise ValueError(f"the sum of {torn} is another one")
        content.seek(0)  # for a second reader
        state = torch.load(content, weights_only=True)
        if state["format"] != FORMAT or not isinstance(state["model"], dict):
            raise ValueError(f"format must be {FORMAT}")
    except Exception as error:  # of a library, for content that is none of a checkpoint
        raise BadFileError(path, f"is no whole checkpoint ({' '.join(str(error).split())[:200]})") from None
    return dict(state)


def _restore(model: BaseAlgorithm, state: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Set the attributes that a checkpoint holds; the code determines which ones, never the file."""
    model.set_parameters(state["parameters"], exact_match=True)
    for name in _variables(model):
        recursive_setattr(model, f"{name}.data", state["variables"][name])
    for name in COUNTERS:
        setattr(model, name, arrays["counters"][name])
    for name in ARRAYS:
        setattr(model, name, arrays["last"][name])
    for name in DEQUES:
        setattr(model, name, deque(arrays["recent"][name], maxlen=model._stats_window_size))
    buffer: Any = getattr(model, "replay_buffer", None)
    if buffer is not None:
        tree_map(_fill, _buffer_arrays(buffer), arrays["buffer"]["arrays"])
        buffer.pos = arrays["buffer"]["pos"]
        buffer.full = arrays["buffer"]["full"]
    env: Any = model.get_env()
    env.restore(arrays["env"])
    # Last: nothing may be drawn after it.
    random.setstate(arrays["random"]["python"])
    np.random.set_state(arrays["random"]["numpy"])  # noqa: NPY002 - SB3 draws from it
    model.action_space.np_random.bit_generator.state = arrays["random"]["actions"]
    torch.set_rng_state(state["torch_random"])


def _variables(model: BaseAlgorithm) -> dict[str, Any]:
    """Return tensors outside of modules and optimisers, such as SAC's entropy coefficient."""
    return {name: recursive_getattr(model, name) for name in model._get_torch_save_params()[1]}


def _buffer_arrays(buffer: Any) -> dict[str, Any]:
    """Return the arrays of a replay buffer, and the dictionaries that hold those of observations."""
    return {name: each for name, each in vars(buffer).items() if isinstance(each, np.ndarray | dict)}


def _fill(array: Any, saved: Any) -> None:
    """Set the first rows of an array to saved ones; other attributes of a buffer are the same in all."""
    if isinstance(array, np.ndarray):
        array[: len(saved)] = saved


def _to_torch(value: Any) -> Any:
    """Return an array as a tensor, which `torch.load` reads without code, and a NumPy scalar as a number."""
    if isinstance(value, np.generic):
        return value.item()
    return torch.from_numpy(np.require(value, requirements=["C", "W"]))
