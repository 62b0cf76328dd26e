"""Command `doctor`: check what works on this machine, and what to install where something does not.

It needs the standard library alone. Each check is a process, as a library may crash or hang.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, NamedTuple

PATIENCE = 180.0  # Time limit of a check, [s]; the first one on a machine compiles machine code
# Extras of packages that a command imports when it needs them; others belong to `training`
EXTRAS = {"minari": "minari", "mjviser": "live", "optuna": "study", "ray": "study", "viser": "live"}
VERSIONS = """import importlib.metadata, platform
names = "viapoint", "numpy", "gymnasium", "mujoco", "numba"
print("Python", platform.python_version(), *(f"{name} {importlib.metadata.version(name)}" for name in names))"""
ENV = "import gymnasium as gym, viapoint.envs\nenv = gym.make('viapoint/PlanarObstacles-v0'{})\nenv.reset(seed=0)\n"
STEP = ENV.format("") + "env.step(env.action_space.sample())\nprint('a movement was simulated')"
FRAME = (
    ENV.format(", render_mode='rgb_array'") + "assert env.render().std(), 'blank'\nprint('a frame was drawn')"
)
AGENT = """from viapoint.training import evaluate, load_agent
print("the shipped agent of", load_agent("viapoint/PlanarObstacles-v0").env_id, "loads")"""
BROWSER = """import shutil
names = "chromium", "google-chrome", "chromium-browser", "microsoft-edge", "firefox"
print(next(filter(None, map(shutil.which, names)), "") or exit("none is installed"))"""
# Permissions alone do not tell, in /proc for example.
FOLDER = """import sys, pathlib, tempfile
out = pathlib.Path(sys.argv[1]).absolute()
place = next(each for each in (out, *out.parents) if each.exists())
try:
    tempfile.TemporaryFile(dir=place).close()
except OSError:
    exit(f"{place} cannot be written")
print(place)"""


class Check(NamedTuple):
    """One thing that should work: a script that prints what it found, or fails."""

    script: str
    remedy: str
    needed: bool = True


CHECKS = {
    "packages": Check(VERSIONS, "pip install viapoint"),
    "MuJoCo engine": Check(STEP, "pip install --force-reinstall 'mujoco>=4'"),
    "OpenGL": Check(FRAME, "for pictures, on Debian: apt-get install libegl1 libgl1", needed=False),
    "agents": Check(AGENT, "pip install 'viapoint[training]'"),
    "browser": Check(BROWSER, "for the live page, on Debian: apt-get install chromium", needed=False),
    "folder": Check(FOLDER, "name another folder for runs with --out"),
}


def run(config: Any) -> None:
    """Run all checks for the folder of runs `config.out`, and print them; exit code 1 where something needed fails."""
    all_well = True
    for name, check in CHECKS.items():
        works, found = outcome(check.script, str(config.out))
        all_well &= works or not check.needed
        failure = "MISSING" if check.needed else "without"
        print(f"{'ok' if works else failure:<8} {name:<14} {found}")
        if not works:
            print(f"{'':<23} -> {check.remedy}")
    raise SystemExit(0 if all_well else 1)


def outcome(script: str, *words: str) -> tuple[bool, str]:
    """Run a script in a process of its own, and return True if it works, and the last line that it prints."""
    command = [sys.executable, "-c", script, *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {PATIENCE:.0f} s"
    said = (done.stderr if done.returncode else done.stdout).strip() or f"ended with code {done.returncode}"
    return done.returncode == 0, said.splitlines()[-1]


def explain_import_error(error: ImportError, subject: str = "the command") -> str:
    """Return one line on a failed import of `subject`: what to install if a package is missing."""
    missing = (error.name or "").partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and missing not in ("", "viapoint"):
        extra = EXTRAS.get(missing, "training")
        return (
            f"{subject} needs the extra `{extra}` (not installed: {missing}): pip install 'viapoint[{extra}]'"
        )
    return f"{type(error).__name__}: {' '.join(str(error).split())} (viapoint doctor says more)"
