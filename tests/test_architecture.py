"""Packages import one another in one direction, without cycles, and no more than they need."""

import ast
import functools
import graphlib
import itertools
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("primitives", "envs", "training")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAY_IMPORT = {
    "primitives": {"numpy", "array_api_compat", "viapoint.primitives"},
    "envs": {
        "numpy",
        "array_api_compat",
        "gymnasium",
        "mujoco",
        "numba",
        "scipy",
        "glfw",
        "viapoint.primitives",
        "viapoint.envs",
    },
}
"""Modules outside the standard library; MuJoCo comes with `glfw`."""


@functools.cache
def modules():
    """Our modules, by name, with their files."""
    found = {}
    for path in (path for folder in PACKAGES for path in sorted((ROOT / folder).rglob("*.py"))):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(("viapoint", *(parts[:-1] if parts[-1] == "__init__" else parts)))] = path
    return found


def imported(name, path):
    """Modules that a module imports, also within functions; names imported from a package count as its modules."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join((*parents, *([node.module] if node.module else [])))
            members = {f"{base}.{alias.name}" for alias in node.names}
            known = members & modules().keys()
            yield from known
            if known != members:
                yield base


def top(module):
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "viapoint" else parts[0]


def foreign(package):
    """Modules that a package imports, with the file, but those of the standard library."""
    for name, path in modules().items():
        if name.split(".")[1] == package:
            yield from (
                (top(each), path) for each in imported(name, path) if top(each) not in sys.stdlib_module_names
            )


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_point_one_way(package):
    assert [each for each in foreign(package) if each[0] not in MAY_IMPORT[package]] == []


def test_what_training_imports_is_declared():
    extras = PROJECT["optional-dependencies"].values()
    lines = itertools.chain(PROJECT["dependencies"], *extras)
    declared = {re.split(r"[><=\[; ]", line)[0].lower().replace("-", "_") for line in lines}
    allowed = {*declared, "yaml", "pil", "mpl_toolkits"}  # PyYAML, and what Matplotlib brings
    outside = [each for each in foreign("training") if not each[0].startswith("viapoint.")]
    assert [each for each in outside if each[0].lower() not in allowed] == []


def test_modules_import_one_another_without_cycles():
    graph = {}
    for name, path in modules().items():
        others = modules().keys() & set(imported(name, path))
        graph[name] = {each for each in others if not f"{name}.".startswith(f"{each}.")}
    graphlib.TopologicalSorter(graph).prepare()  # raises an error for a cycle


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("viapoint.primitives", {"torch", "mujoco", "gymnasium", "scipy", "matplotlib"}),
        ("viapoint.envs", {"torch", "stable_baselines3", "matplotlib", "scipy", "viapoint.training"}),
        ("viapoint.training.cli.main", {"torch", "stable_baselines3", "matplotlib"}),
        ("viapoint.training.planning.plan_motion", {"torch", "stable_baselines3", "matplotlib", "pandas"}),
    ],
)
def test_importing_is_light(module, absent):
    script = f"import sys, {module}; print(*({absent!r} & sys.modules.keys()))"
    loaded = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout.strip(), loaded.stderr) == (0, "", "")
