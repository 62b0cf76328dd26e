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
import sys
import viapoint.training.live.page, minari, ray.tune
if sys.version_info < (3, 14):  # newer ones have no package of it yet
    import ompl
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


@pytest.fixture(scope="module")
def clean(wheel_path, tmp_path_factory):
    """A new environment, in which only the wheel is installed."""
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, with_pip=False)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python")]
    install = [*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel_path)]
    subprocess.run(install, check=True, capture_output=True)
    return folder


@pytest.mark.parametrize("extras", INSTALLED)
def test_the_wheel_works_in_an_environment_of_its_own(extras, clean, tmp_path):
    """Packages come from the environment of the tests, so that nothing is downloaded, and some are hidden."""
    hidden, use = INSTALLED[extras]
    begin = "import sys; sys.path.append(sys.path.pop(1))\n"
    begin += "".join(f"sys.modules[{name!r}] = None\n" for name in hidden)
    done = subprocess.run(
        [str(clean / "bin" / "python"), "-c", begin + use + WHERE],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")},  # after those of the new one
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert all(Path(file).is_relative_to(clean) for file in done.stdout.split()[-3:])


def test_modules_models_scenes_agents_and_the_command_are_inside_and_nothing_else(wheel):
    tree = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    expected = {f"viapoint/{path.relative_to(ROOT)}" for path in tree if "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if not re.match(r"viapoint-[^/]+\.dist-info/", name)}
    assert found == expected
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


IMPORT = re.compile(r"^\s*(?:from (\w[\w.]*) import |import (\w[\w.]*)(?: as \w+)?$)", re.MULTILINE)
OF_OTHER_NAMES = {"yaml", "pil", "mpl_toolkits", "glfw"}
"""PyYAML, and what Matplotlib and MuJoCo bring."""


@pytest.mark.parametrize("folder", FOLDERS)
def test_imports_are_declared_and_point_one_way(folder):
    """Also those within functions."""
    extras = PROJECT["optional-dependencies"].values() if folder == "training" else []
    lines = itertools.chain(PROJECT["dependencies"], *extras)
    declared = {re.split(r"[><=\[; ]", line)[0].lower().replace("-", "_") for line in lines}
    before = {f"viapoint.{name}" for name in FOLDERS[: FOLDERS.index(folder) + 1]}
    for path in (ROOT / folder).rglob("*.py"):
        text = path.read_text().replace("from viapoint import ", "import viapoint.")
        for names in IMPORT.findall(text):
            parts = "".join(names).lower().split(".")
            if parts[0] not in sys.stdlib_module_names:
                name = ".".join(parts[:2]) if parts[0] == "viapoint" else parts[0]
                assert name in declared | before | OF_OTHER_NAMES, path


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
