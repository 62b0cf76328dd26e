"""The report tells what works, what does not and what to do, also where hardly anything works."""

import json
import os
import subprocess
import sys

import pytest

from viapoint.training.cli import doctor
from viapoint.training.cli import main as cli

GOOD, GONE = "print('fine')\n", "import no_such_module\n"
EXTRA = (
    "torch",
    "stable_baselines3",
    "sb3_contrib",
    "tyro",
    "rich",
    "tqdm",
    "matplotlib",
    "safetensors",
)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The checks in processes of their own are tried once, below."""
    for name in ("STEP", "FRAME", "LEARN"):
        monkeypatch.setattr(doctor, name, GOOD)


def report(capsys, *words):
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor", *words])
    return end.value.code, capsys.readouterr().out


def test_all_is_well_here(capsys, tmp_path, monkeypatch):
    monkeypatch.undo()  # the real checks
    code, printed = report(capsys, "--json", "--out", str(tmp_path / "runs"))
    record = json.loads(printed)
    assert record["works"] is (code == 0)
    assert [each["name"] for each in record["findings"] if each["needed"] and not each["works"]] == []
    assert not (tmp_path / "runs").exists()


def test_what_is_missing_is_named_with_the_remedy(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "STEP", GONE)
    code, printed = report(capsys)
    assert code == 1
    assert "no_such_module" in printed
    assert "--force-reinstall 'mujoco>=4'" in printed


def test_what_is_not_needed_is_no_failure(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "FRAME", GONE)
    monkeypatch.setattr(doctor, "missing_packages", lambda: ["torch"])  # agents are not tried then
    code, printed = report(capsys)
    assert code == 0
    assert "libegl1" in printed


def test_a_crash_and_a_hang_end_no_report(monkeypatch):
    assert not doctor.in_a_process("it", "import os; os.abort()", "do this").works
    monkeypatch.setattr(doctor, "PATIENCE", 0.2)
    assert not doctor.in_a_process("it", "import time; time.sleep(60)", "").works


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
        "no-such-package>=1",
    ]
    found = {each.name: each.works for each in doctor.packages(lines)}
    assert found == {"Python": True, "numpy": False, "gymnasium": True, "no-such-package": False}


def test_runs_need_a_folder_that_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    assert doctor.disk(tmp_path / "a" / "b").works
    assert not doctor.disk(tmp_path / "file").works
    assert not doctor.disk(tmp_path / "file" / "runs").works
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def ran(script, folder):
    """Run a script where a folder comes first on the path of Python."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder), os.environ.get("PYTHONPATH", "")))}
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=env)


def told(words, folder):
    """Run the command in the same way."""
    script = f"import sys; sys.argv[1:] = {words}; from viapoint.training.cli.entry import main; main()"
    return ran(script, folder)


def test_an_upgrade_in_place_is_recognised_even_if_nothing_can_be_imported(tmp_path):
    """It leaves a record of files that are gone, and a package without content."""
    record = tmp_path / "mujoco_core-4.0.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: mujoco-core\nVersion: 4.0.0\n")
    (record / "RECORD").write_text("mujoco/batch.py,,\nmujoco/__init__.py,,\n")
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text("")
    doctors = told(["doctor", "--json"], tmp_path)
    assert doctors.returncode == 1, doctors.stderr
    findings = {each["name"]: each for each in json.loads(doctors.stdout)["findings"]}
    assert not findings["MuJoCo engine"]["works"]
    assert "--force-reinstall 'mujoco>=4'" in findings["MuJoCo engine"]["remedy"]
    trainings = told(["train"], tmp_path)
    assert trainings.returncode == 2
    (line,) = trainings.stderr.splitlines()
    assert "--force-reinstall" in line


@pytest.fixture
def without_extra(tmp_path):
    """Folder that lets Python import no package of the extra."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {EXTRA}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    return tmp_path


@pytest.mark.parametrize("words", [["train"], ["--help"]])
def test_without_the_extra_the_command_says_in_one_line_what_to_install(without_extra, words):
    failed = told(words, without_extra)
    assert failed.returncode == 2
    (line,) = failed.stderr.splitlines()
    assert "pip install 'viapoint[training]'" in line


def test_without_the_extra_the_report_advises_the_extra_alone(without_extra):
    report = told(["doctor", "--json"], without_extra)
    assert report.returncode == 1, report.stderr
    findings = json.loads(report.stdout)["findings"]
    remedies = {each["remedy"] for each in findings if each["needed"] and not each["works"]}
    assert remedies == {"pip install 'viapoint[training]'"}


def test_without_the_extra_a_public_name_says_what_to_install(without_extra):
    script = "import viapoint.training as vt\ntry:\n    vt.load_agent\nexcept ImportError as error:\n    print(error)"
    said = ran(script, without_extra)
    assert "pip install 'viapoint[training]'" in said.stdout, said.stderr
