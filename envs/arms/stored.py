"""Copies of arms: one MJCF file that holds all that was chosen when an arm was loaded.

Copies are kept in folders of runs and models, and in a cache folder, because covering a file's geoms takes seconds.
That folder is `viapoint/arms` in XDG_CACHE_HOME, or in `~/.cache`. It may be deleted at any time.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from viapoint.envs.arms.arm import Arm, arm_from_xml, asset

MARK = "viapoint_arm"  # Name of the text element with the choices
# Fields of an arm that it is made with, and those that its file adds
ARGUMENTS = ("home", "velocity_limit", "torque_limit", "space", "bandwidth", "steerable_share")
ADDED = ("left_out", "excess", "continuous", "notes")
COPY = "arm.xml"  # Name of a copy in the folder of a run or a model


def keep_arm(folder: Path, arm: Arm) -> None:
    """Write a copy of an arm that was loaded from a file into a folder; arms that are known by name need none."""
    if arm.file:
        write_arm(folder / COPY, arm)


def with_kept_arm(env_kwargs: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return arguments of an environment with the copy in a folder in place of an arm file that is gone."""
    found = dict(env_kwargs)
    file, copy = found.get("arm"), folder / COPY
    if isinstance(file, str) and Path(file).suffix and not Path(file).is_file() and copy.is_file():
        found["arm"] = str(copy.resolve())
    return found


def write_arm(path: str | Path, arm: Arm) -> None:
    """Write an arm as a self-contained MJCF file, the same arm for :func:`load_arm`, `arm=` and `--arm`.

    Its geoms are the capsules that collide; visual meshes are left out.

    Raises:
        ValueError: The file's name does not end in `.xml`.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from viapoint.envs import arm_of, load_arm, write_arm
        >>> file = Path(tempfile.mkdtemp()) / "arm.xml"
        >>> write_arm(file, arm_of("planar"))  # or an arm of load_arm, which may have needed arguments
        >>> load_arm(file).joint_names
        ('shoulder', 'elbow')
    """
    path = Path(path).expanduser()
    if path.suffix != ".xml":
        raise ValueError(f"path must end in .xml, got {str(path)!r}")
    choices: dict[str, Any] = {"name": arm.name, "joints": arm.joint_names}
    for each in (*ARGUMENTS, *ADDED):
        choices[each] = getattr(arm, each)
    model, _, _ = arm.xml.rpartition("</mujoco>")
    text = f"{model}{_element(json.dumps(choices, default=_plain))}</mujoco>\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _element(choices: str) -> str:
    """Return the element of a copy that holds the choices."""
    return f"<custom><text name={quoteattr(MARK)} data={quoteattr(choices)}/></custom>"


def read_arm(file: Any) -> Arm | None:
    """Return the arm of a file of :func:`write_arm`, or of its text; None for everything else.

    Raises:
        ValueError: Someone changed the file, and it is no arm any more.
    """
    text = str(file)
    if not text.lstrip().startswith("<"):
        path = Path(text).expanduser()
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    if MARK not in text:
        return None
    try:
        mark = ET.fromstring(text).find(f"custom/text[@name='{MARK}']")
    except ET.ParseError:  # MuJoCo tells what is wrong
        mark = None
    if mark is None:
        return None
    data = mark.attrib["data"]
    xml = text.replace(_element(data), "")
    try:
        choices: dict[str, Any] = json.loads(data)
        exclude = {frozenset((first, second)): reason for first, second, reason in choices["left_out"]}
        kept = {each: choices[each] for each in ("joints", *ARGUMENTS) if each in choices}  # old: fewer
        arm = arm_from_xml(choices["name"], xml, tool="hand", exclude=exclude, **kept)
        texts: dict[str, Any] = {each: tuple(choices[each]) for each in ("continuous", "notes")}
        return replace(arm, excess=choices["excess"], **texts)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{MARK} in the file is not what write_arm wrote: {error}") from None


def cached_arm(model: mujoco.MjModel, arguments: dict[str, Any], make: Callable[[], Arm]) -> Arm:
    """Return an arm from its copy in the cache folder; where there is none, or a broken one, make it and write one.

    The name of the copy tells models, arguments and versions of the program apart.
    """
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    digest = hashlib.blake2b(_program() + content.tobytes(), digest_size=16)
    digest.update(json.dumps(arguments, sort_keys=True, default=_plain).encode())
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "viapoint" / "arms"
    path = folder / f"{digest.hexdigest()}.xml"
    with suppress(OSError, ValueError):
        stored = read_arm(path)
        if stored is not None:
            return stored
    arm = make()
    with suppress(OSError):  # the folder cannot be written
        folder.mkdir(parents=True, exist_ok=True)
        # A file of its own, which is renamed at the end: other processes never see half of it.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".part", suffix=".xml", delete=False) as file:
            write_arm(Path(file.name), arm)
        os.replace(file.name, path)
    return arm


@functools.cache
def _program() -> bytes:
    """Return what makes arms of files: the version of MuJoCo, and the code beside this file."""
    code = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    return b"".join((mujoco.__version__.encode(), asset("stage.xml").encode(), *code))


def _plain(value: Any) -> Any:
    """Return an argument of another type as numbers or text."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
