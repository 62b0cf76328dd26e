"""Packages of the extras, by the standard library alone, as it must say what is missing."""

from __future__ import annotations

import importlib.util

# Packages that are imported where they are needed, and their extras; others belong to `training`
PACKAGES = {
    "torch": "training", "tensorboard": "training", "ompl": "planning", "viser": "live", "mjviser": "live",
    "trimesh": "live", "minari": "minari", "h5py": "minari", "ray": "study", "optuna": "study",
}  # fmt: skip


def is_installed(name: str) -> bool:
    """Return True if a package is found; finders may raise errors instead of an answer."""
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def explain_import_error(error: ImportError, subject: str = "the command") -> str:
    """Return one line on a failed import of `subject`: what to install if a package is missing."""
    # A library that has found out itself says so without the name of a module.
    missing = next((name for name in PACKAGES if f"{name} is not installed" in str(error)), "")
    if isinstance(error, ModuleNotFoundError):
        missing = (error.name or "").partition(".")[0]
    if missing not in ("", "viapoint"):
        extra = PACKAGES.get(missing, "training")
        remedy = f"pip install '.[{extra}]' in a clone of the project"
        return f"{subject} needs the extra `{extra}` (not installed: {missing}): {remedy}"
    return f"{type(error).__name__}: {' '.join(str(error).split())} (viapoint doctor says more)"
