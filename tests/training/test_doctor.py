"""The report tells what works, what does not and what to do, also where hardly anything works."""

import json
import os
import subprocess
import sys

import pytest

from viapoint.training.cli import doctor
from viapoint.training.cli import main as cli

GOOD, GONE = "print('fine')", "import no_such_module"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The checks in processes of their own are tried once, below."""
    for name in ("STEP", "FRAME", "RENDER_THEN_TRAIN", "AGENT"):
        monkeypatch.setattr(doctor, name, GOOD)


def report(capsys, *words):
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor", *words])
    return end.value.code, capsys.readouterr().out


def test_all_is_well_here(capsys, tmp_path, monkeypatch):
    monkeypatch.undo()  # the real checks
    code, printed = report(capsys, "--json", "--out", str(tmp_path / "runs"))
    record = json.loads(printed)
    findings = {each["name"]: each for each in record["findings"]}
    assert {"Python", "mujoco", "torch", "MuJoCo engine", "OpenGL", "video encoder", "disk"} <= set(findings)
    assert record["works"] is (code == 0)
    assert [name for name, each in findings.items() if each["needed"] and not each["works"]] == []
    assert "physics steps" in findings["MuJoCo engine"]["found"]
    assert findings["train and render"]["works"]
    assert not (tmp_path / "runs").exists()


def test_what_is_missing_is_named_with_the_remedy(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "STEP", GONE)
    code, printed = report(capsys)
    assert code == 1
    lines = printed.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("MISSING"))
    assert "MuJoCo engine" in lines[at]
    assert "no_such_module" in lines[at]
    assert "--force-reinstall 'mujoco>=4'" in lines[at + 1]


def test_what_is_not_needed_is_no_failure(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "FRAME", GONE)
    code, printed = report(capsys)
    assert code == 0
    assert "without  OpenGL" in printed
    assert "libegl1" in printed


def test_a_crash_and_a_hang_end_no_report(monkeypatch):
    crash = doctor.in_a_process("it", "import os; os.abort()", "do this")
    assert not crash.works
    assert crash.remedy == "do this"
    monkeypatch.setattr(doctor, "PATIENCE", 0.2)
    assert "no answer" in doctor.in_a_process("it", "import time; time.sleep(60)", "").found


@pytest.mark.parametrize(
    ("version", "least", "enough"),
    [
        ("2.10", "2.9", True),
        ("2.9", "2.10", False),
        ("2.13.0+cpu", "2.13", True),
        ("4.0.0", "4", True),
        ("3.9", "4.0", False),
    ],
)
def test_versions_are_numbers(version, least, enough):
    assert doctor.at_least(version, least) is enough


def test_bounds_are_those_of_the_installed_package():
    lines = [
        "numpy>=99.1",
        "gymnasium[mujoco]>=0.1",
        "mypy>=99; extra == 'dev'",
        "moviepy>=99; extra == 'dev'",
    ]
    found = {each.name: (each.works, each.needed) for each in doctor.packages([*lines, "no-such-package>=1"])}
    assert found == {
        "numpy": (False, True),
        "gymnasium": (True, True),
        "moviepy": (False, False),
        "no-such-package": (False, True),
    }


def test_a_disk_that_cannot_be_written_or_is_full(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "SPACE", 1 << 60)
    finding = doctor.attempt("disk", lambda: doctor.disk(tmp_path / "a" / "b"), "")
    assert not finding.works
    assert f"GB free in {tmp_path}" in finding.found
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_place_for_runs(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "runs"):
        finding = doctor.attempt("disk", lambda place=place: doctor.disk(place), "")
        assert not finding.works
        assert f"{tmp_path / 'file'} is no folder" in finding.found


@pytest.fixture
def broken(tmp_path):
    """What an upgrade of MuJoCo 3 in place leaves: a record of files that are gone, and a package without content."""
    record = tmp_path / "mujoco_core-4.0.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: mujoco-core\nVersion: 4.0.0\n")
    (record / "RECORD").write_text("mujoco/batch.py,,\nmujoco/__init__.py,,\n")
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text("")
    return tmp_path


def test_an_upgrade_in_place_is_recognised_even_if_nothing_can_be_imported(broken):
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(broken), os.environ.get("PYTHONPATH", "")))}
    script = "import sys; sys.argv[1:] = WORDS; from viapoint.training.cli.entry import main; main()"
    told = subprocess.run(
        [sys.executable, "-c", script.replace("WORDS", "['doctor', '--json']")],
        capture_output=True,
        text=True,
        env=env,
    )
    assert told.returncode == 1, told.stderr
    findings = {each["name"]: each for each in json.loads(told.stdout)["findings"]}
    assert not findings["MuJoCo's files"]["works"]
    assert "upgraded in place" in findings["MuJoCo's files"]["remedy"]
    assert "--force-reinstall 'mujoco>=4'" in findings["MuJoCo's files"]["remedy"]
    assert not findings["MuJoCo engine"]["works"]
    other = subprocess.run(
        [sys.executable, "-c", script.replace("WORDS", "['train']")], capture_output=True, text=True, env=env
    )
    assert other.returncode == 2
    (line,) = other.stderr.splitlines()
    assert "--force-reinstall" in line


EXTRA = (
    "torch",
    "stable_baselines3",
    "sb3_contrib",
    "tyro",
    "rich",
    "tqdm",
    "matplotlib",
    "scipy",
    "safetensors",
)


@pytest.fixture
def without_extra(tmp_path):
    """Environment variables of a Python that cannot import the packages of the extra."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {EXTRA}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))}


@pytest.mark.parametrize("words", [["train"], [], ["--help"], ["evaluate", "--env", "viapoint/Nothing-v0"]])
def test_without_the_extra_the_command_says_in_one_line_what_to_install(without_extra, words):
    script = f"import sys; sys.argv[1:] = {words}; from viapoint.training.cli.entry import main; main()"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=without_extra)
    assert told.returncode == 2
    (line,) = told.stderr.splitlines()
    assert "pip install 'viapoint[training]'" in line
    assert "tyro" in line


def test_without_the_extra_a_public_name_says_what_to_install(without_extra):
    script = "import viapoint.training as vt\ntry:\n    vt.load_agent\nexcept ImportError as error:\n    print(error)"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=without_extra)
    assert told.stdout.startswith("viapoint.training.load_agent needs the extra `training`"), told.stderr
    assert told.stdout.rstrip().endswith("pip install 'viapoint[training]'")


def test_without_the_extra_the_report_advises_the_extra_and_no_new_installation(without_extra):
    script = "import sys; sys.argv[1:] = ['doctor', '--json']; from viapoint.training.cli.entry import main; main()"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=without_extra)
    assert told.returncode == 1, told.stderr
    failed = [each for each in json.loads(told.stdout)["findings"] if each["needed"] and not each["works"]]
    assert [(each["name"], each["remedy"]) for each in failed] == [
        ("extra training", "pip install 'viapoint[training]'")
    ]
    assert "torch" in failed[0]["found"]


def test_a_package_that_only_one_command_needs_is_named_by_that_command(capsys, monkeypatch):
    def broken(self, config):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(cli.Command, "__call__", broken)
    monkeypatch.setattr(doctor, "installed", lambda name: "" if name == "torch" else "1")
    with pytest.raises(SystemExit) as end:
        cli.main(["train"])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "viapoint: the command needs the extra `training` (not installed: torch): "
        "pip install 'viapoint[training]'"
    )
