"""The report tells what works, what does not and what to do, also where hardly anything works."""

import os
import subprocess
import sys

import pytest

from viapoint.training.cli import doctor
from viapoint.training.cli import entry as cli

GOOD, GONE = "print('fine')", "import no_such_module"
EXTRA = ("torch", "stable_baselines3", "sb3_contrib", "tyro", "rich", "matplotlib", "safetensors")


def report(capsys, *words):
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor", *words])
    return end.value.code, capsys.readouterr().out


def test_all_is_well_here(capsys, tmp_path):
    code, printed = report(capsys, "--out", str(tmp_path / "runs"))
    assert (code, "MISSING" in printed) == (0, False)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("name", "exit_code", "remedy"), [("MuJoCo engine", 1, "'mujoco>=4'"), ("OpenGL", 0, "libegl1")]
)
def test_what_is_missing_is_named_with_the_remedy(name, exit_code, remedy, capsys, monkeypatch):
    checks = {each: check._replace(script=GOOD) for each, check in doctor.CHECKS.items()}
    checks[name] = checks[name]._replace(script=GONE)
    monkeypatch.setattr(doctor, "CHECKS", checks)
    code, printed = report(capsys)
    assert code == exit_code
    assert "no_such_module" in printed
    assert remedy in printed


def test_a_crash_and_a_hang_end_no_report(monkeypatch):
    assert not doctor.outcome("import os; os.abort()")[0]
    monkeypatch.setattr(doctor, "PATIENCE", 0.2)
    assert not doctor.outcome("import time; time.sleep(60)")[0]


def test_runs_need_a_folder_that_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    assert doctor.outcome(doctor.FOLDER, str(tmp_path / "a" / "b"))[0]
    for nowhere in (tmp_path / "file" / "runs", "/proc", "/proc/runs"):
        works, said = doctor.outcome(doctor.FOLDER, str(nowhere))
        assert not works
        assert said.endswith("cannot be written")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def ran(words, folder):
    """Run the command where a folder comes first on the path of Python."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder), os.environ.get("PYTHONPATH", "")))}
    script = f"import sys; sys.argv[1:] = {words}; from viapoint.training.cli.entry import main; main()"
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=env)


@pytest.mark.parametrize(("words", "code"), [(["train"], 2), (["--help"], 2), (["doctor"], 1)])
def test_without_the_extra_everything_says_what_to_install(words, code, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {EXTRA}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    failed = ran(words, tmp_path)
    assert failed.returncode == code
    assert "pip install 'viapoint[training]'" in failed.stdout + failed.stderr
    assert code == 1 or len(failed.stderr.splitlines()) == 1
