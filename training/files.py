"""Files that are there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

Arrays = dict[str, NDArray[Any]]


class BadFileError(ValueError):
    """A file or folder that is not what it should be; the message names it and the reason."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = path


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or a run after a crash, sees the old content or the new, never a part.

    Raises:
        OSError: For example of a full disk; what was there is still there.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_folder(path: Path, fill: Callable[[Path], None]) -> None:
    """Make or replace a folder whose content `fill` writes, as atomically as :func:`write_bytes`."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    temporary.mkdir(parents=True)
    try:
        fill(temporary)
        _sync_folder(temporary)
        if path.exists():
            outdated = path.with_name(f".{path.name}.{uuid.uuid4().hex}.old")
            path.rename(outdated)
            temporary.rename(path)
            shutil.rmtree(outdated, ignore_errors=True)
        else:
            temporary.rename(path)
        _sync_folder(path.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON; NaN and infinity are refused, as JSON has none."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        BadFileError: It is missing, not JSON, or not an object.
    """
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise BadFileError(path, "is missing") from None
    except (ValueError, OSError, RecursionError) as error:
        raise BadFileError(path, f"cannot be read as JSON ({error})") from None
    if not isinstance(value, dict):
        raise BadFileError(path, f"must hold a JSON object, not a {type(value).__name__}")
    return value


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays as safetensors: numbers, no code."""
    write_bytes(path, save_arrays({name: np.asarray(array, order="C") for name, array in arrays.items()}))


def read_arrays(path: Path) -> Arrays:
    """Read named arrays.

    Raises:
        BadFileError: It is missing, truncated or no safetensors file.
    """
    try:
        return load_arrays(path.read_bytes())
    except FileNotFoundError:
        raise BadFileError(path, "is missing") from None
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise BadFileError(path, f"is no whole safetensors file ({error})") from None


def _sync_folder(folder: Path) -> None:
    """Make renames in a folder last through a power cut, where the system can."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def tidy(folder: Path) -> None:
    """Undo what a crash amid :func:`write_folder` or :func:`write_bytes` left behind in a folder."""
    for old in sorted(folder.glob(".*.old")):
        target = folder / old.name.split(".")[1]
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.rename(target)
    for part in folder.glob(".*.part"):
        shutil.rmtree(part) if part.is_dir() else part.unlink()
