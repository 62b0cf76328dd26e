"""What the wheel holds is what the tree holds: built offline from a copy, so nothing is left in the tree."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("primitives", "envs", "training")
BUILD = (
    "import sys; from setuptools import build_meta; "
    "print(build_meta.build_wheel(sys.argv[1]), file=sys.stderr)"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of the tree, opened."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = subprocess.run(
        [sys.executable, "-c", BUILD, str(target)], cwd=source, capture_output=True, text=True, check=False
    )
    assert build.returncode == 0, build.stderr
    (path,) = target.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def shipped(*suffixes):
    """Files of the three folders with these endings, by their name in the wheel."""
    return {
        f"viapoint/{path.relative_to(ROOT)}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.name.endswith(suffixes) and "__pycache__" not in path.parts
    }


@pytest.mark.parametrize(
    "suffixes",
    [(".py",), (".xml",), ("py.typed",), (".npz",), (".safetensors", ".json")],
    ids=["modules", "models", "typed", "scenes", "pretrained"],
)
def test_everything_is_inside(wheel, suffixes):
    missing = shipped(*suffixes) - set(wheel.namelist())
    assert not missing


def test_there_is_something_of_each_kind(wheel):
    names = wheel.namelist()
    for ending in ("cli/main.py", "planar.xml", "envs/py.typed", "primitives/py.typed", "training/py.typed"):
        assert any(name.endswith(ending) for name in names), ending
    assert any(name.startswith("viapoint/training/scenes/") and name.endswith(".npz") for name in names)


def test_nothing_else_is_inside(wheel):
    foreign = [name for name in wheel.namelist() if not name.startswith(("viapoint/", "viapoint-"))]
    assert foreign == []
    assert "viapoint/__init__.py" not in wheel.namelist()  # a namespace package


def test_the_console_script_is_declared(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "viapoint = viapoint.training.cli.entry:main" in wheel.read(name).decode()
