"""Run the test suite with the oldest versions that pyproject.toml allows, or with the newest that pip finds.

    python benchmarks/versions.py oldest [--folder DIR] [--json FILE] [TESTS ...]
    python benchmarks/versions.py newest

The tests run in a new virtual environment in the folder (a temporary one by default) with a copy of the tracked files.
The oldest versions are the lower bounds of the dependencies; pip selects the others. The bounds of pytest and of other
development tools are not tested.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
BOUND = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)(\[[a-z,]+\])?>=(?P<version>[0-9.]+)")
EXTRAS = ("training", "study")
TOOLS = [
    "pytest",
    "pytest-xdist",
    "hypothesis",
    "mpmath",
    "moviepy",
    "setuptools",
    "build",
    "ruff",
    "mypy",
]


def lower_bounds() -> dict[str, str]:
    """Return the dependencies with their lower bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"], *(line for name in EXTRAS for line in extras[name])]
    found = [BOUND.match(line) for line in lines]
    assert all(found), f"a dependency without a lower bound: {lines}"
    return {each["name"]: each["version"] for each in found if each}


def make(folder: Path, which: str) -> Path:
    """Return the interpreter of a virtual environment with the oldest or newest versions, made if it is missing."""
    python, tree = folder / "venv" / "bin" / "python", folder / "tree"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    shutil.rmtree(tree, ignore_errors=True)
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True).stdout.split(
        b"\0"
    )
    for name in filter(None, map(os.fsdecode, files)):
        if (ROOT / name).exists():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tree / name, follow_symlinks=False)
    bounds = folder / "bounds.txt"
    pinned = [f"{name}=={version}" for name, version in lower_bounds().items()]
    bounds.write_text("\n".join(pinned if which == "oldest" else []))
    extra = ["--upgrade", "--upgrade-strategy", "eager"] if which == "newest" else []
    install = [python, "-m", "pip", "install", "--quiet", *extra, "-c", bounds]
    subprocess.run([*install, "-e", f"{tree}[{','.join(EXTRAS)}]", *TOOLS], check=True, cwd=tree)
    return python


def installed(python: Path) -> dict[str, str]:
    """Return the versions that are installed for an interpreter."""
    script = "import importlib.metadata as m, json, sys; print(json.dumps({n: m.version(n) for n in sys.argv[1:]}))"
    done = subprocess.run([python, "-c", script, *lower_bounds()], check=True, capture_output=True, text=True)
    return {"python": sys.version.split()[0], **json.loads(done.stdout)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("which", choices=("oldest", "newest"))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("tests", nargs="*", default=["tests"])
    arguments = parser.parse_intermixed_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        python = make(folder, arguments.which)
        versions = installed(python)
        print(
            f"{arguments.which}: {', '.join(f'{name} {version}' for name, version in versions.items())}",
            flush=True,
        )
        options = ["-q", "--tb=native", "--assert=plain", "-p", "no:cacheprovider"]
        command = [python, "-m", "pytest", *options, *arguments.tests]
        done = subprocess.run(command, cwd=folder / "tree", stdout=subprocess.PIPE, text=True)
        print(done.stdout[-6000:])
        summary = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else ""
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"versions": versions, "summary": summary}, indent=1))
    raise SystemExit(done.returncode)


if __name__ == "__main__":
    main()
