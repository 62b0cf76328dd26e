"""The wheel holds what the tree holds: built offline from a copy, so nothing is left in the tree."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("primitives", "envs", "training")
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of the tree, opened."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = subprocess.run(
        [sys.executable, "-c", BUILD, str(target)], cwd=source, capture_output=True, text=True
    )
    assert build.returncode == 0, build.stderr
    (path,) = target.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def test_modules_models_scenes_and_agents_are_inside_and_nothing_else(wheel):
    tree = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    expected = {f"viapoint/{path.relative_to(ROOT)}" for path in tree if "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if not re.match(r"viapoint-[^/]+\.dist-info/", name)}
    assert found == expected


def test_the_console_script_is_declared(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "viapoint = viapoint.training.cli.entry:main" in wheel.read(name).decode()


def test_dependencies_have_a_lower_bound_that_the_tried_versions_fulfil():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = dict(
        re.findall(
            r"(?m)^([\w.-]+)==([\d.]+)", (ROOT / "constraints.txt").read_text().lower().replace("_", "-")
        )
    )
    for line in project["dependencies"] + project["optional-dependencies"]["training"]:
        name, bound = re.fullmatch(r"([\w.-]+)>=([\d.]+)", line).groups()
        tried = pins[name]
        assert [int(n) for n in bound.split(".")] <= [int(n) for n in tried.split(".")], line
