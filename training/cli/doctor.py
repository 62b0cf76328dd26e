"""Command `doctor`: check what works on this machine, and what to install where something does not.

Nothing but the standard library is imported before a check asks for it, so that this runs where little else does.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, NoReturn

PATIENCE = 120.0
"""Time limit of a check in a separate process, [s]."""
SPACE = 1 << 30
"""Free disk space for a few trainings, [bytes]."""
REINSTALL = "pip install --force-reinstall 'mujoco>=4'"
OPTIONAL = {
    "moviepy": "gymnasium's RecordVideo",
    "ompl": "the baseline by a motion planner (RRT-Connect)",
    "viser": "the live page",
}
"""Packages that only some features need, and these features."""
MODULES = {"pyyaml": "yaml"}
"""Modules of packages with other names."""
EXTRAS = {"mjviser": "live", "optuna": "study", "ray": "study", "viser": "live"}
"""Extras of packages that a command imports when it needs them."""
BROWSERS = ("chromium", "google-chrome", "chromium-browser", "microsoft-edge", "firefox")
"""Programs that show the live page."""
INSTALL_TRAINING = "pip install 'viapoint[training]'"
REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)(\[[^]]*\])?(>=(?P<least>[0-9.]+))?")

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
context = env.unwrapped.batch._renderer._screen._context
print("a frame rendered by", type(context).__module__.rpartition(".")[2])
env.close()
"""
RENDER_THEN_TRAIN = """
import gymnasium as gym, viapoint.envs
env = gym.make("viapoint/PlanarObstacles-v0", render_mode="rgb_array", width=16, height=16)
env.reset(seed=0)
try:
    env.render()
except viapoint.envs.rendering.renderer.GLUnavailableError:
    print("nothing can be rendered, so nothing can collide")
    raise SystemExit
import torch
torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
print("an optimizer was made after a frame was rendered")
"""
UPDATE_TRITON = "import torch (and triton) before the first picture is rendered, or pip uninstall triton"
AGENT = """
from viapoint.training import load_agent
agent = load_agent("viapoint/PlanarObstacles-v0")
print("the shipped agent of", agent.env_id, "loads")
"""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of one check."""

    name: str
    works: bool
    needed: bool
    """Mark of a check that must pass."""
    found: str
    remedy: str = ""
    """Advice if it fails."""


def run(config: Any) -> None:
    """Check everything and print it; exit code 1 where something that is needed does not work."""
    findings = list(examine(config.out))
    if config.json:
        record = {"works": all_works(findings), "findings": [asdict(each) for each in findings]}
        print(json.dumps(record, indent=1))
    else:
        for finding in findings:
            state = "ok" if finding.works else "MISSING" if finding.needed else "without"
            print(f"{state:<8} {finding.name:<18} {finding.found}")
            if not finding.works and finding.remedy:
                print(f"{'':<8} {'':<18} -> {finding.remedy}")
    raise SystemExit(0 if all_works(findings) else 1)


def run_without_command(words: Sequence[str]) -> NoReturn:
    """Check everything where what reads the command line cannot be imported."""
    run(SimpleNamespace(out=Path("runs"), json="--json" in words))
    raise AssertionError  # run exits


def explain_import_error(error: ImportError, subject: str = "the command") -> str:
    """Return one line on a failed import of `subject`: what to install if packages of an extra are missing."""
    extra = EXTRAS.get(error.name or "")
    if extra is not None:
        return f"{subject} needs the extra `{extra}` (not installed: {error.name}): pip install 'viapoint[{extra}]'"
    missing = missing_packages()
    if missing:
        names = ", ".join(missing)
        return f"{subject} needs the extra `training` (not installed: {names}): {INSTALL_TRAINING}"
    return f"{type(error).__name__}: {' '.join(str(error).split())} (viapoint doctor says more)"


def missing_packages() -> list[str]:
    """Return the packages of the extra `training` that are not installed."""
    try:
        requirements = importlib.metadata.requires("viapoint") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [
        each.name for each in parsed(requirements) if each.extra == "training" and not installed(each.name)
    ]


def all_works(findings: list[Finding]) -> bool:
    """Return whether all needed checks pass."""
    return all(finding.works for finding in findings if finding.needed)


def examine(folder: Path) -> Iterator[Finding]:
    """Run all checks; `folder` is the folder for runs."""
    least = "3.11"
    python = platform.python_version()
    yield Finding(
        name="Python", works=at_least(python, least), needed=True, found=f"{python} on {platform.platform()}",
        remedy=f"viapoint needs Python {least} or newer",
    )  # fmt: skip
    yield from packages(importlib.metadata.requires("viapoint") or [])
    yield mujoco_files()
    yield in_a_process("MuJoCo engine", STEP, REINSTALL)
    yield in_a_process(
        "OpenGL", FRAME, "without it films are drawn from above; on Debian and Ubuntu: apt-get install libegl1 libgl1",
        needed=False,
    )  # fmt: skip
    if not missing_packages():
        yield attempt("video encoder", encoder, "pip install imageio-ffmpeg")
        yield attempt("torch", torch_threads, INSTALL_TRAINING)
        yield in_a_process("train and render", RENDER_THEN_TRAIN, UPDATE_TRITON)
        yield in_a_process("shipped agent", AGENT, "pip install --force-reinstall viapoint")
    yield browser()
    yield attempt("processors", processors, "")
    yield attempt(
        "disk", lambda: disk(folder), f"choose another folder than {folder}, or make room on its disk"
    )


class Requirement(NamedTuple):
    """Required package, as the metadata of this package state it."""

    name: str
    least: str
    """Oldest version."""
    extra: str
    """Name of the extra that needs it; '' if it is always needed."""


def parsed(lines: Iterable[str]) -> Iterator[Requirement]:
    """Yield the requirements that the installed package states."""
    for line in lines:
        found = REQUIREMENT.match(line)
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if found is not None and found["name"] != "viapoint":
            yield Requirement(found["name"], found["least"] or "0", extra[1] if extra else "")


def installed(name: str) -> str:
    """Return the version of a package that can be found by an import as well, '' if there is none."""
    try:
        version = importlib.metadata.version(name)
        module = MODULES.get(name.lower(), name.replace("-", "_"))
        return version if importlib.util.find_spec(module) else ""
    except (importlib.metadata.PackageNotFoundError, ImportError):
        return ""


def packages(lines: Iterable[str]) -> Iterator[Finding]:
    """Compare versions with the bounds that the installed package states."""
    missing = []
    for name, least, extra in parsed(lines):
        if extra not in ("", "training") and name not in OPTIONAL:
            continue  # a tool of development
        version = installed(name)
        if extra == "training" and not version:
            missing.append(name)
            continue
        use = f" (for {OPTIONAL[name]})" if name in OPTIONAL else ""
        yield Finding(
            name=name, works=bool(version) and at_least(version, least), needed=name not in OPTIONAL,
            found=f"{version or 'not installed'}, {least} or newer wanted{use}",
            remedy=f"pip install '{name}>={least}'",
        )  # fmt: skip
    if missing:
        yield Finding(
            name="extra training", works=False, needed=True, remedy=INSTALL_TRAINING,
            found=f"the environments work without, the commands do not; not installed: {', '.join(missing)}",
        )  # fmt: skip


def at_least(version: str, least: str) -> bool:
    """Return whether a version is the least one or newer."""
    mine, wanted = (
        [int(part) for part in re.findall(r"\d+", each.partition("+")[0])] for each in (version, least)
    )
    return mine[: len(wanted)] >= wanted


def mujoco_files() -> Finding:
    """Check the files of MuJoCo 4, some of which an upgrade of MuJoCo 3 in place removes."""
    gone, there = [], 0
    for name in ("mujoco", "mujoco-core"):
        try:
            files = importlib.metadata.files(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for file in files:
            if "__pycache__" not in file.parts:
                there += 1
                gone += [] if Path(str(file.locate())).exists() else [str(file)]
    lost = f"{len(gone)} of {there} are gone, as {gone[0]}" if gone else ""
    found = lost or f"{there} files of its package are there"
    return Finding(
        name="MuJoCo's files", works=there > 0 and not gone, needed=True, found=found,
        remedy=f"an older version was upgraded in place, which breaks it; mend it with: {REINSTALL}",
    )  # fmt: skip


def in_a_process(name: str, script: str, remedy: str, *, needed: bool = True) -> Finding:
    """Run a script in a separate process, so that a crash or a hang in a library does not end the report."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        found = f"no answer within {PATIENCE:.0f} s"
        return Finding(name=name, works=False, needed=needed, found=found, remedy=remedy)
    works = done.returncode == 0
    said = (done.stdout if works else done.stderr).strip() or f"ended with code {done.returncode}"
    return Finding(name=name, works=works, needed=needed, found=said.splitlines()[-1], remedy=remedy)


def attempt(name: str, check: Callable[[], str], remedy: str) -> Finding:
    """Run a check that returns its finding or raises."""
    try:
        return Finding(name=name, works=True, needed=True, found=check())
    except Exception as error:
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Finding(name=name, works=False, needed=True, found=found, remedy=remedy)


def encoder() -> str:
    """Encode a few frames."""
    import imageio_ffmpeg

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = imageio_ffmpeg.write_frames(str(path), (64, 64), codec="libx264", ffmpeg_log_level="error")
        writer.send(None)
        for shade in range(8):
            writer.send(bytes([shade * 30]) * (64 * 64 * 3))
        writer.close()
        size = path.stat().st_size
    return f"a film of {size} bytes by ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}"


def torch_threads() -> str:
    """Compute a little."""
    import torch

    assert float(torch.ones(3) @ torch.ones(3)) == 3.0
    others = f", {torch.cuda.get_device_name(0)} is there, too" if torch.cuda.is_available() else ""
    return f"training on the CPU, on one thread of {torch.get_num_threads()}{others}"


def browser() -> Finding:
    """Look for a browser, which the live page needs."""
    places = [path for path in map(shutil.which, BROWSERS) if path]
    with contextlib.suppress(webbrowser.Error):
        places.append(getattr(webbrowser.get(), "name", "the default browser"))
    return Finding(
        name="browser", works=bool(places), needed=False, found=places[0] if places else "none for `viapoint live`",
        remedy="on Debian and Ubuntu: apt-get install chromium; or look at the page from elsewhere by an SSH tunnel",
    )  # fmt: skip


def processors() -> str:
    """Return the number of threads of the simulation."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{allowed} of {os.cpu_count()} may be used"


def disk(folder: Path) -> str:
    """Check that the folder for runs, or its first existing parent, is writable."""
    place = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    if not place.is_dir():
        raise NotADirectoryError(f"{place} is no folder")
    with tempfile.NamedTemporaryFile(dir=place) as file:
        file.write(bytes(1 << 20))
        file.flush()
        os.fsync(file.fileno())
    free = shutil.disk_usage(place).free
    if free < SPACE:
        raise OSError(f"only {free / 1e9:.1f} GB free in {place}, {SPACE / 1e9:.1f} GB wanted")
    return f"{place} can be written, {free / 1e9:.1f} GB free"
