"""Command `doctor`: check what works on this machine, and what to install where something does not.

Nothing but the standard library is imported before a check asks for it, so that this runs where little else does.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

PATIENCE = 120.0
"""Time limit of a check in a separate process, [s]."""
INSTALL, INSTALL_TRAINING = "pip install viapoint", "pip install 'viapoint[training]'"
EXTRAS = {"minari": "minari", "mjviser": "live", "optuna": "study", "ray": "study", "viser": "live"}
"""Extras of packages that a command imports when it needs them."""
MODULES = {"pyyaml": "yaml"}
"""Modules of packages with other names."""
BROWSERS = ("chromium", "google-chrome", "chromium-browser", "microsoft-edge", "firefox")
"""Programs that show the live page."""
STEP = """
import gymnasium as gym, viapoint.envs
env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=3, threads=2)
env.reset(seed=0)
env.step(env.action_space.sample())
print("one movement of three environments:", env.unwrapped.physics_steps, "physics steps")
"""
FRAME = """
import gymnasium as gym, numpy as np, viapoint.envs
env = gym.make("viapoint/PlanarObstacles-v0", render_mode="rgb_array", width=64, height=64)
env.reset(seed=0)
assert np.ptp(env.render()) > 0, "the frame is blank"
print("a frame was rendered")
env.close()
"""
LEARN = """
from viapoint.training import load_agent
import torch
agent = load_agent("viapoint/PlanarObstacles-v0")
torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
print("the shipped agent of", agent.env_id, "loads")
"""


class Finding(NamedTuple):
    """Result of one check."""

    name: str
    works: bool
    found: str
    remedy: str
    """Advice if it fails."""
    needed: bool = True
    """False for a check that may fail."""


def run(config: Any) -> None:
    """Check everything for the folder of runs `config.out` and print it; exit code 1 where something needed fails."""
    works = True
    for finding in examine(config.out):
        works &= finding.works or not finding.needed
        state = "ok" if finding.works else "MISSING" if finding.needed else "without"
        print(f"{state:<8} {finding.name:<18} {finding.found}")
        if not finding.works:
            print(f"{'':<8} {'':<18} -> {finding.remedy}")
    raise SystemExit(0 if works else 1)


def explain_import_error(error: ImportError, subject: str = "the command") -> str:
    """Return one line on a failed import of `subject`: what to install if packages of an extra are missing."""
    extra = EXTRAS.get(error.name or "")
    missing = error.name if extra else ", ".join(missing_packages())
    if missing:
        extra = extra or "training"
        return (
            f"{subject} needs the extra `{extra}` (not installed: {missing}): pip install 'viapoint[{extra}]'"
        )
    return f"{type(error).__name__}: {' '.join(str(error).split())} (viapoint doctor says more)"


def examine(folder: Path) -> Iterator[Finding]:
    """Run all checks; `folder` is the folder for runs."""
    yield Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "install 3.11 or newer")
    for name, extra in requirements():
        version = installed(name)
        yield Finding(name, bool(version), version or "not installed", INSTALL_TRAINING if extra else INSTALL)
    yield in_a_process("MuJoCo engine", STEP, "pip install --force-reinstall 'mujoco>=4'")
    without = "without it nothing is rendered; on Debian and Ubuntu: apt-get install libegl1 libgl1"
    yield in_a_process("OpenGL", FRAME, without, needed=False)
    if not missing_packages():
        # Some versions of triton crash if they are imported after a frame was rendered.
        yield in_a_process("agents", FRAME + LEARN, INSTALL_TRAINING)
    browser = next(filter(None, map(shutil.which, BROWSERS)), "")
    remedy = (
        "on Debian and Ubuntu: apt-get install chromium; or open the page from elsewhere by an SSH tunnel"
    )
    yield Finding("browser", bool(browser), browser or "none for `viapoint live`", remedy, needed=False)
    yield disk(folder)


def requirements() -> list[tuple[str, str]]:
    """Return name and extra ('' if always needed) of the packages that the package and training need."""
    try:
        lines = importlib.metadata.requires("viapoint") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found = [(re.split(r"[^\w.-]", line)[0], re.search(r"extra == ['\"](\w+)", line)) for line in lines]
    named = [(name, extra[1] if extra else "") for name, extra in found]
    return [(name, extra) for name, extra in named if extra in ("", "training")]


def installed(name: str) -> str:
    """Return the version of a package that can be found by an import as well, '' if there is none."""
    try:
        version = importlib.metadata.version(name)
        module = MODULES.get(name.lower(), name.replace("-", "_"))
        return version if importlib.util.find_spec(module) else ""
    except (importlib.metadata.PackageNotFoundError, ImportError):
        return ""


def missing_packages() -> list[str]:
    """Return the packages of the extra `training` that are not installed."""
    return [name for name, extra in requirements() if extra and not installed(name)]


def in_a_process(name: str, script: str, remedy: str, *, needed: bool = True) -> Finding:
    """Run a script in a separate process, so that a crash or a hang in a library does not end the report."""
    words = [sys.executable, "-c", script]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        return Finding(name, False, f"no answer within {PATIENCE:.0f} s", remedy, needed)
    works = done.returncode == 0
    said = (done.stdout if works else done.stderr).strip() or f"ended with code {done.returncode}"
    return Finding(name, works, said.splitlines()[-1], remedy, needed)


def disk(folder: Path) -> Finding:
    """Check that the folder for runs, or its first existing parent, is writable."""
    place = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    works = place.is_dir() and os.access(place, os.W_OK)
    free = shutil.disk_usage(place).free / 1e9
    found = f"{place} can be written, {free:.1f} GB free" if works else f"{place} cannot be written"
    return Finding("disk", works, found, f"name another folder than {folder}")
