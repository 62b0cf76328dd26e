"""Versions of the packages that results depend on."""

from __future__ import annotations

import importlib.metadata
import platform

PACKAGES = ("viapoint", "gymnasium", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }
