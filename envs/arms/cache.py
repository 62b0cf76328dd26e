"""Arms of files that were loaded before, on disk: covering a file's geoms takes seconds.

The folder is `viapoint/arms` in XDG_CACHE_HOME, or in `~/.cache`. It may be deleted at any time.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import tempfile
import zipfile
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.arm import Arm, asset
from viapoint.envs.arms.chain import Chain, FirstTwo, Spheres
from viapoint.envs.arms.spheres import LeftOut

UNREADABLE = (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile)
"""Errors of files that are missing or broken."""


def key_of(model: mujoco.MjModel, arguments: dict[str, Any]) -> str:
    """Return a name for what is loaded: it tells models, arguments and versions of the program apart."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    digest = hashlib.blake2b(content.tobytes(), digest_size=16)
    digest.update(_program().encode())
    digest.update(json.dumps(arguments, sort_keys=True, default=_plain).encode())
    return digest.hexdigest()


@functools.cache
def _program() -> str:
    """Return the versions of what makes arms of files: of MuJoCo, and the code beside this file."""
    code = hashlib.blake2b(digest_size=16)
    for path in sorted(files(__package__).iterdir(), key=lambda path: path.name):
        if path.name.endswith(".py"):
            code.update(path.read_bytes())
    code.update(asset("stage.xml").encode())
    return f"{mujoco.__version__} {code.hexdigest()}"


def _plain(value: Any) -> Any:
    """Return an argument of another type as numbers or text."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def read_arm(key: str) -> Arm | None:
    """Return the arm of a key; None if there is none, or if its file is broken."""
    try:
        with np.load(_folder() / f"{key}.npz", allow_pickle=False) as stored:
            parts: dict[str, Any] = {
                name: np.ascontiguousarray(stored[name]) for name in stored.files if name != "text"
            }
            text = json.loads(str(stored["text"]))
        for kind in (Chain, Spheres):
            name = kind.__name__.lower()
            text[name] = kind(*(parts.pop(f"{name}.{part}") for part in kind._fields))
        text["chain"] = text["chain"]._replace(first_two=FirstTwo(*text["chain"].first_two.tolist()))
        text["left_out"] = [LeftOut(*pair) for pair in text["left_out"]]
        lists = {name: tuple(value) for name, value in text.items() if type(value) is list}
        return Arm(**parts, **{**text, **lists})
    except UNREADABLE:
        return None


def write_arm(key: str, arm: Arm) -> None:
    """Store an arm under a key; nothing happens where the folder cannot be written."""
    parts, text = {}, {}
    for field in dataclasses.fields(arm):
        value = getattr(arm, field.name)
        if isinstance(value, Chain | Spheres):
            parts.update({f"{field.name}.{name}": array for name, array in value._asdict().items()})
        elif isinstance(value, np.ndarray):
            parts[field.name] = value
        else:
            text[field.name] = value
    with suppress(OSError):
        folder = _folder()
        folder.mkdir(parents=True, exist_ok=True)
        # A file of its own, which is renamed at the end: other processes never see half of it.
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".part", delete=False) as file:
            np.savez(file, allow_pickle=False, text=np.array(json.dumps(text)), **parts)
        os.replace(file.name, folder / f"{key}.npz")


def _folder() -> Path:
    """Return the folder of stored arms."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "viapoint" / "arms"
