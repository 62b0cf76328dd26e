"""Packages import no more than they need; wheel and source distribution hold what the tree holds, and work."""

import itertools
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOLDERS = ("primitives", "envs", "training")
BUILD = "import sys; from setuptools import build_meta as b; getattr(b, sys.argv[1])(sys.argv[2])"
BASE = """
import numpy, viapoint.envs, viapoint.primitives, viapoint.training
from viapoint.envs import TASKS, Task
for kwargs in TASKS.values():
    Task.of(**kwargs)
viapoint.primitives.point_to_point([0.0], [1.0], 1.0)
"""
TRAINING = """
import viapoint.training.cli.entry
from viapoint.training import evaluate, load_agent, plan_motion, train
assert load_agent("viapoint/PlanarObstacles-v0").env_id == "viapoint/PlanarObstacles-v0"
"""
ALL = """
import viapoint.training.live.page, minari, ray.tune, ompl
from viapoint.training.study import run_study
"""
OF_TRAINING = ("torch", "stable_baselines3", "matplotlib", "pandas", "tyro")
OF_OTHERS = ("ray", "optuna", "viser", "mjviser", "ompl", "minari", "gymnasium_robotics", "furo")
INSTALLED = {
    "base": ((*OF_TRAINING, *OF_OTHERS), BASE),
    "training": (OF_OTHERS, BASE + TRAINING),
    "all": ((), BASE + TRAINING + ALL),
}
"""Packages that are absent from an environment, and a script that works there, by the extras that are installed."""
WHERE = """
print(viapoint.envs.__file__, viapoint.primitives.__file__, viapoint.training.__file__)
"""


def build(kind, source, target):
    """Build a `wheel` or an `sdist` offline, and return its path."""
    target.mkdir(exist_ok=True)
    command = [sys.executable, "-c", BUILD, f"build_{kind}", str(target)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the tree, in which builds may leave files."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def wheel_path(source, tmp_path_factory):
    """The wheel of the tree."""
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def wheel(wheel_path):
    """The wheel of the tree, opened."""
    with zipfile.ZipFile(wheel_path) as archive:
        yield archive


def test_the_wheel_of_the_source_distribution_is_the_same(source, wheel, tmp_path):
    """Installers that build from source get every file, too."""
    sdist = build("sdist", source, tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    again = build("wheel", tmp_path / sdist.name.removesuffix(".tar.gz"), tmp_path / "wheel")
    with zipfile.ZipFile(again) as archive:
        assert sorted(archive.namelist()) == sorted(wheel.namelist())


@pytest.mark.parametrize("extras", INSTALLED)
def test_the_wheel_works_in_an_environment_of_its_own(extras, wheel_path, tmp_path):
    """The environment is new; packages come from this one, so that nothing is downloaded, and some are hidden."""
    hidden, use = INSTALLED[extras]
    venv.create(tmp_path / "clean", with_pip=False)
    python = tmp_path / "clean" / "bin" / "python"
    install = ["pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([sys.executable, "-m", *install, str(wheel_path)], check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")}  # after those of the new one
    begin = "import sys; sys.path.append(sys.path.pop(1))\n"
    begin += "".join(f"sys.modules[{name!r}] = None\n" for name in hidden)
    done = subprocess.run(
        [str(python), "-c", begin + use + WHERE],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert all(Path(file).is_relative_to(tmp_path / "clean") for file in done.stdout.split()[-3:])


def test_modules_models_scenes_and_agents_are_inside_and_nothing_else(wheel):
    tree = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    expected = {f"viapoint/{path.relative_to(ROOT)}" for path in tree if "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if not re.match(r"viapoint-[^/]+\.dist-info/", name)}
    assert found == expected


def test_the_console_script_is_declared(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "viapoint = viapoint.training.cli.entry:main" in wheel.read(name).decode()


def test_dependencies_have_a_lower_bound_that_the_tried_versions_fulfil():
    pins = dict(
        re.findall(
            r"(?m)^([\w.-]+)==([\d.]+)", (ROOT / "constraints.txt").read_text().lower().replace("_", "-")
        )
    )
    for line in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["training"]:
        name, bound = re.fullmatch(r"([\w.-]+)>=([\d.]+)", line).groups()
        tried = pins[name]
        assert [int(n) for n in bound.split(".")] <= [int(n) for n in tried.split(".")], line


NUMERICAL = {"numpy", "array_api_compat", "viapoint.primitives"}
SIMULATION = {"gymnasium", "mujoco", "numba", "scipy", "glfw", "viapoint.envs"}
MAY_IMPORT = {"primitives": NUMERICAL, "envs": NUMERICAL | SIMULATION}
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
