"""Packages import one another in one direction, and no more than they need."""

import itertools
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BASE = {"numpy", "array_api_compat", "viapoint.primitives"}
SIMULATION = {"gymnasium", "mujoco", "numba", "scipy", "glfw", "viapoint.envs"}
MAY_IMPORT = {"primitives": BASE, "envs": BASE | SIMULATION}
"""Modules outside the standard library; MuJoCo comes with `glfw`."""
IMPORT = re.compile(r"^\s*(?:from (\w[\w.]*) import |import (\w[\w.]*)(?: as \w+)?$)", re.MULTILINE)


def foreign(package):
    """Modules that a package imports, also within functions, with the file, but those of the standard library."""
    for path in sorted((ROOT / package).rglob("*.py")):
        text = path.read_text().replace("from viapoint import ", "import viapoint.")
        for first, second in IMPORT.findall(text):
            parts = (first or second).split(".")
            if parts[0] not in sys.stdlib_module_names:
                yield ".".join(parts[:2]) if parts[0] == "viapoint" else parts[0], path


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


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("viapoint.primitives", {"torch", "mujoco", "gymnasium", "scipy", "matplotlib"}),
        ("viapoint.envs", {"torch", "stable_baselines3", "matplotlib", "scipy", "viapoint.training"}),
        ("viapoint.training.configs", {"torch", "stable_baselines3", "matplotlib"}),
        ("viapoint.training.planning.plan_motion", {"torch", "stable_baselines3", "matplotlib", "pandas"}),
    ],
)
def test_importing_is_light(module, absent):
    script = f"import sys, {module}; print(*({absent!r} & sys.modules.keys()))"
    loaded = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout.strip(), loaded.stderr) == (0, "", "")
