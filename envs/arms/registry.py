"""Registry of arms by name: the built-in ones, and a user's own."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

from viapoint.envs.arms.arm import Arm, asset
from viapoint.envs.arms.load import load_arm

ARM_FILES = (".xml", ".urdf")  # Suffixes of files of arms
# Arms of the assets: the right arm of an adult in the horizontal plane, and the Franka Emika Panda with its hand
BUILT_IN = ("planar", "panda")
_OWN: dict[str, Arm] = {}


def arm_names() -> tuple[str, ...]:
    """Return the names of all arms."""
    return (*BUILT_IN, *_OWN)


def register_arm(arm: Arm) -> None:
    """Register an arm under its name, so that tasks and models can refer to it; a process that loads them must, too.

    Raises:
        TypeError: It is no arm.
        ValueError: The name is that of a built-in arm or of a file, or empty.

    Example:
        >>> from viapoint.envs import arm_of, load_arm, register_arm
        >>> arm = load_arm("docs/ur5e.xml")
        >>> register_arm(arm)
        >>> arm_of(arm.name) is arm
        True
    """
    if not isinstance(arm, Arm):
        raise TypeError(f"arm must be an Arm, as load_arm returns it, got {arm!r:.60}")
    if arm.name in BUILT_IN:
        raise ValueError(f"there is a built-in arm of the name {arm.name!r}; give another one")
    if not arm.name or arm.name.endswith(ARM_FILES):
        raise ValueError(
            f"name of an arm must be a word, and not end in {' or '.join(ARM_FILES)}, got {arm.name!r}"
        )
    _OWN[arm.name] = arm


def arm_of(arm: Any) -> Arm:
    """Return an arm as it is, the arm of a name, or that of an MJCF or URDF file; a task keeps the path of the file.

    A process reads a file again only where its time has changed; changes of files that it includes do not count.

    Raises:
        ValueError: There is no such arm, or the file cannot be read.

    Example:
        >>> from viapoint.envs import arm_of
        >>> arm_of("panda").joint_names[0]
        'joint1'
    """
    if isinstance(arm, Arm):
        return arm
    name = str(arm) if isinstance(arm, str | Path) else ""
    if name in BUILT_IN:
        return _built_in(name)
    if name in _OWN:
        return _OWN[name]
    if name.endswith(ARM_FILES):
        path = Path(name).expanduser().resolve()
        if not path.is_file():
            raise ValueError(f"arm: there is no file {name!r}")
        return _of_file(path, path.stat().st_mtime_ns)
    raise ValueError(
        f"arm must be an Arm, a file that ends in {' or '.join(ARM_FILES)}, or one of {', '.join(arm_names())}, got "
        f"{arm!r:.60}; register_arm adds an arm of your own"
    )


@functools.cache
def _built_in(name: str) -> Arm:
    """Return a built-in arm."""
    return load_arm(asset(f"{name}.xml"))


@functools.lru_cache(maxsize=16)
def _of_file(path: Path, changed: int) -> Arm:
    """Return the arm of a file, which was last changed at some time."""
    try:
        arm = load_arm(path)
    except ValueError as error:
        raise ValueError(f"{error}; give arguments to load_arm, and keep its arm with write_arm") from None
    return dataclasses.replace(arm, file=str(path))
