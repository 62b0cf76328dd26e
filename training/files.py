"""Files and folders that are written completely or not at all."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import io
import json
import math
import os
import platform
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from viapoint.envs.arms.arm import Arm

LARGEST_JSON = 64 << 20  # Greatest size of a JSON or YAML file, [bytes]
# Numbers such as 1e-3, which YAML 1.1 reads as words because they lack a point or a sign
_NUMBER = re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+")
MARK = b"written by viapoint"  # In every file that a user names, but JSON
JSON_MARK = b'"viapoint":'  # Name of the version in JSON files of this package
# Temporary names of :func:`write_bytes` and :func:`write_folder`, which a crash leaves behind
UNFINISHED = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{32}\.(?P<kind>part|old)")
# Packages that results depend on
PACKAGES = ("viapoint", "gymnasium", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **packages}


def written_by(version: Any) -> str:
    """Return the end of a message about a file that another version of viapoint wrote; empty if unknown or this."""
    mine = importlib.metadata.version("viapoint")
    return "" if version in (None, mine) else f"; it was written by viapoint {version}, and this is {mine}"


def folder_name(env: str) -> str:
    """Return the name that the folder of an environment has, by its id or another name.

    Example:
        >>> folder_name("viapoint/PlanarReach-v0"), folder_name("my_module:my/Task-v0")
        ('PlanarReach-v0', 'my-Task-v0')
    """
    return env.rpartition(":")[2].removeprefix("viapoint/").replace("/", "-")


class BadFileError(ValueError):
    """Error of a file or folder; the message names it and the reason."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes the error again, in another process of a study."""
        return type(self), (self.path, self.reason)


def check_ours(path: Path) -> None:
    """Check that a file may be written: there is none yet, an empty one, or one that this package wrote."""
    _check_regular(path)
    empty = path.is_file() and path.stat().st_size == 0
    if os.path.lexists(path) and not empty and not _is_ours(path):
        raise BadFileError(path, "exists and was not written by viapoint; name another file, or move it away")


def _check_regular(path: Path) -> None:
    """Check that a path is no folder, pipe or device, which a new file would replace."""
    if path.exists() and not path.is_file():
        raise BadFileError(path, "exists and is no regular file; name another one")


def _is_ours(path: Path) -> bool:
    """Return True for a file that this package wrote."""
    content = path.read_bytes() if path.is_file() else b""
    return MARK in content or JSON_MARK in content


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file and its folder; readers see the old content or the new, even after a crash."""
    _check_regular(path)
    path = Path(os.path.realpath(path))  # a link to a file stays a link
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # a rename may reach the disk before the content
        temporary.replace(path)
        _sync_folder(path.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk does not say which file it has no room for
        raise


def write_folder(path: Path, fill: Callable[[Path], None], *, move_foreign: bool = False) -> None:
    """Create a folder, or replace one that this package wrote, atomically; `fill` writes its content.

    One with further files, or whose JSON lacks the mark of this package, stays as it is with BadFileError; with
    `move_foreign`, it is renamed, and a line says so.
    """
    path = Path(os.path.realpath(path))  # a link to a folder stays a link
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    temporary.mkdir(parents=True)
    try:
        fill(temporary)
        _sync_folder(temporary)
        aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}.old")
        foreign = _foreign(path, temporary)
        if foreign and not move_foreign:
            raise BadFileError(path, foreign)
        if foreign:
            number = 1
            while os.path.lexists(aside := path.with_name(f"{path.name}.{number}")):
                number += 1
            print(f"{path} holds what viapoint did not write: it is kept as {aside}", file=sys.stderr)
        if path.exists():
            path.rename(aside)
        temporary.rename(path)
        if not foreign:
            shutil.rmtree(aside, ignore_errors=True)  # there is none of a new folder
        _sync_folder(path.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _foreign(path: Path, newer: Path) -> str:
    """Return why a folder is neither empty nor an earlier version of a newer one; an empty text if it may go."""
    if not path.is_dir():
        return "exists and is no folder; name another one" if path.exists() else ""
    there = sorted(path.iterdir())
    for each in there:
        if not each.is_file() or not (newer / each.name).exists():
            return f"holds {each.name}, which is not written here; name a new folder"
    for record in newer.glob("*.json"):
        if there and not _is_ours(path / record.name):
            return f"holds no {record.name} that viapoint wrote; name a new folder"
    return ""


def write_figure(path: Path, figure: Any, **options: Any) -> Path:
    """Write a figure of Matplotlib in the format of the suffix; options are those of `savefig`."""
    content = io.BytesIO()
    mark = MARK.decode()
    metadata = {"Creator": mark, "Date": None} if path.suffix == ".svg" else {"Software": mark}
    figure.savefig(content, format=path.suffix[1:], metadata=metadata, **options)
    write_bytes(path, content.getvalue())
    return path


def as_plain(value: Any) -> Any:
    """Return the numbers, texts, lists and dictionaries that stand for a value in JSON; an arm is its file or name."""
    return json.loads(json.dumps(value, default=_as_json))


def _as_json(value: Any) -> Any:
    """Return what the encoder of JSON takes for an object, such as an array or a sensor."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Arm):
        return value.file or value.name
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise ValueError(f"values must be numbers, texts, lists and dictionaries, got {value!r:.80}")


def write_json(path: Path, value: Any) -> None:
    """Write JSON; NaN and infinity raise ValueError."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path, largest: int = LARGEST_JSON) -> dict[str, Any]:
    """Read a JSON object of finite numbers; what is missing, too large [bytes] or no object raises BadFileError."""
    content = read_bytes(path, largest)
    try:
        value = json.loads(content, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise BadFileError(path, f"cannot be read as JSON ({error})") from None
    if not isinstance(value, dict):
        raise BadFileError(path, f"must hold a JSON object, not a {type(value).__name__}")
    return value


def read_bytes(path: Path, largest: int | None = None) -> bytes:
    """Return the content of a regular file; what is missing, too large [bytes] or unreadable raises BadFileError."""
    try:
        if not path.is_file():  # reading a pipe or a device may never end
            raise BadFileError(path, "is no regular file" if path.exists() else "is missing")
        size = path.stat().st_size
        if largest is not None and size > largest:
            raise BadFileError(path, f"must have at most {largest} bytes, has {size}")
        return path.read_bytes()
    except OSError as error:
        raise BadFileError(path, f"cannot be read ({error.strerror})") from None


class _Loader(yaml.SafeLoader):
    """Loader of plain values that refuses repeated names."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; a repeated name raises an error."""
        names = [key.value for key, _ in node.value]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise yaml.constructor.ConstructorError(None, None, f"{repeated} is there twice", node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def parse_yaml(text: str | bytes) -> Any:
    """Return the plain values of a YAML text; other texts, and names that are there twice, raise ValueError."""
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"cannot be read as YAML ({' '.join(str(error).split())})") from None


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays as safetensors, which hold no code."""
    write_bytes(path, save_arrays({name: np.asarray(array, order="C") for name, array in arrays.items()}))


def read_arrays(path: Path, largest: int | None = None) -> dict[str, NDArray[Any]]:
    """Read named arrays; a file that is missing, too large [bytes] or torn raises BadFileError."""
    content = read_bytes(path, largest)
    try:
        return load_arrays(content)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise BadFileError(path, f"is no whole safetensors file ({error})") from None


def _finite(text: str) -> float:
    """Return a number of JSON; Python's reader would also take NaN, Infinity and 1e999."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} is no finite number")
    return number


def _sync_folder(folder: Path) -> None:
    """Make renames in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def tidy(folder: Path) -> None:
    """Remove or restore files that a crash during :func:`write_folder` or :func:`write_bytes` left behind."""
    for left in sorted(folder.glob(".*")):
        found = UNFINISHED.fullmatch(left.name)
        if found is None:
            continue
        if found["kind"] == "old" and not (folder / found["name"]).exists():
            left.rename(folder / found["name"])
        elif left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink()
