"""Packages import no more than they need; wheel and source distribution hold what the tree holds, and work."""

import importlib.metadata
import itertools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOLDERS = ("primitives", "envs", "training")
BUILD = "import sys; from setuptools import build_meta as b; getattr(b, sys.argv[1])(sys.argv[2])"
IMPORT_ALL = """
import importlib, pkgutil
def import_all(package):
    package = importlib.import_module(package)
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
"""
BASE = """
import_all("viapoint.primitives")
import_all("viapoint.envs")
import gymnasium, numpy, viapoint.envs
from viapoint.training import plan_motion, write_motion
env = gymnasium.make("viapoint/PlanarReach-v0")
env.reset(seed=0)
env.step(numpy.zeros(3))
tetrahedron = viapoint.envs.ConvexMesh([(0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.0, 0.1, 1.0), (0.0, 0.0, 1.1)])
plan = plan_motion("planar", (-0.2, 0.3), (0.1, 0.4), [tetrahedron])
write_motion(plan, "plan.yaml")
"""
TRAINING = """
import viapoint.training.cli.entry
from viapoint.training import TrainConfig, load_agent, train
few = {"gradient_steps": 1, "policy_kwargs": {"candidates": 4}}
sizes = {"n_timesteps": 4, "n_envs": 2, "eval_scenes": 1}
run = train(TrainConfig(env="viapoint/PlanarReach-v0", hyperparameters=few, out="run", progress=False, **sizes))
load_agent(run.folder)
"""
ALL = """
import_all("viapoint.training")
import gymnasium_robotics, minari, optuna, ray.tune
"""
SCRIPTS = {"base": BASE, "training": TRAINING, "all": ALL}
"""Scripts that work where only the dependencies of an extra are installed."""


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
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def wheel(wheel_path):
    with zipfile.ZipFile(wheel_path) as archive:
        yield archive


def test_the_wheel_of_the_source_distribution_is_the_same(source, wheel, tmp_path):
    """So what is tested of the wheel below holds for installations from source, too."""
    sdist = build("sdist", source, tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    again = build("wheel", tmp_path / sdist.name.removesuffix(".tar.gz"), tmp_path / "wheel")
    with zipfile.ZipFile(again) as archive:
        assert checksums(archive) == checksums(wheel)


def checksums(archive):
    return {info.filename: info.CRC for info in archive.infolist()}


def required(distribution, extras):
    """Return the distributions that one requires with extras, and those that they require, by their names."""
    found = {}
    for requirement in map(Requirement, distribution.requires or ()):
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            name = requirement.name
            other = distribution if name == "viapoint" else importlib.metadata.distribution(name)
            found |= {name: other, **required(other, requirement.extras)}
    return found


@pytest.mark.parametrize("extra", SCRIPTS)
def test_the_wheel_works_with_the_packages_that_it_requires(extra, wheel_path, tmp_path):
    """The packages are links to those of the tests, so that nothing is downloaded, and no others can be imported.

    Functions are not compiled, as this would take a minute.
    """
    venv.create(tmp_path / "clean", with_pip=False)
    python = str(tmp_path / "clean" / "bin" / "python")
    (site,) = (tmp_path / "clean").glob("lib/python*/site-packages")
    (wheel,) = importlib.metadata.distributions(path=[str(wheel_path)])
    for distribution in required(wheel, [extra]).values():
        if distribution is not wheel:
            for name in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
                if not (site / name).exists():  # several may share a folder
                    (site / name).symlink_to(distribution.locate_file(name))
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-index"]
    named = str(wheel_path) if extra == "base" else f"{wheel_path}[{extra}]"
    for command in ([*install, named], [python, "-I", "-c", IMPORT_ALL + SCRIPTS[extra]]):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_modules_models_scenes_agents_and_the_command_are_inside_and_nothing_else(wheel):
    tree = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    expected = {f"viapoint/{path.relative_to(ROOT)}" for path in tree if "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if not re.match(r"viapoint-[^/]+\.dist-info/", name)}
    assert found == expected
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "viapoint = viapoint.training.cli.entry:main" in wheel.read(name).decode()


IMPORT = re.compile(r"^\s*(?:from (\w[\w.]*) import |import (\w[\w.]*)(?: as \w+)?$)", re.MULTILINE)
OF_OTHER_NAMES = {"yaml", "pil", "mpl_toolkits", "glfw"}
"""PyYAML, and what Matplotlib and MuJoCo bring."""


def test_links_of_the_description_lead_to_the_repository(tmp_path):
    jobs = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())["jobs"]
    (script,) = [step["run"] for step in jobs["build"]["steps"] if step.get("name", "").startswith("Links")]
    shutil.copy(ROOT / "README.md", tmp_path)
    run = f"GITHUB_REPOSITORY=o/r GITHUB_REF_NAME=v1; {script}"
    subprocess.run(["bash", "-ec", run], cwd=tmp_path, check=True)


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
