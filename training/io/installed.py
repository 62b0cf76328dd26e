"""Versions of the packages that results depend on."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
from importlib.resources import files
from pathlib import Path

PACKAGES = ("viapoint", "gymnasium", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def installed() -> dict[str, str]:
    """Return the versions of the packages, and a hash of the source of this one."""
    return {**versions(), "source of viapoint": _source()}


@functools.cache
def _source() -> str:
    digest = hashlib.sha256()
    for package in ("viapoint.envs", "viapoint.primitives", "viapoint.training"):
        root = Path(str(files(package)))
        for path in sorted(root.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]
