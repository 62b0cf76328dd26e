"""The demo: everything in one folder, and nothing twice."""

import json

import pytest

from viapoint.training.cli import demo
from viapoint.training.config.configs import DemoConfig
from viapoint.training.io.files import BadFileError
from viapoint.training.runs.callback import RunCallback, TrainingStoppedError

FILES = (
    "table.md",
    "table.json",
    "learning_curve.png",
    "success_by_band.png",
    "gallery.png",
    "movements.mp4",
)


@pytest.fixture
def quick(monkeypatch, shipped, tmp_path):
    monkeypatch.setattr(demo, "PICTURES", 2)
    monkeypatch.setattr(demo, "MOVEMENTS", 1)
    return DemoConfig(out=tmp_path / "demo", n_timesteps=64, n_scenes=8, checks=8)


def test_everything_is_there_and_a_second_call_only_shows_it(quick, capsys, monkeypatch):
    demo.run(quick)
    first = capsys.readouterr().out
    written = {name: (quick.out / name).stat().st_mtime_ns for name in FILES}
    for name in (*FILES, "best"):
        assert str(quick.out / name) in first
    record = json.loads((quick.out / "table.json").read_text())
    assert list(record["methods"]) == [
        "agent",
        "agent, 8 checks",
        "untrained",
        "search, 16 checks",
        "search, 512 checks",
        "straight line",
        "random via-point",
        "planner (stored)",
    ]
    assert record["methods"]["straight line"]["success"]["rate"] == 0.0

    def never(*args, **kwargs):
        pytest.fail("did again what was done")

    for name in ("train", "evaluate_methods", "gallery", "record_video"):
        monkeypatch.setattr(demo, name, never)
    demo.run(quick)
    second = capsys.readouterr().out
    assert "starting from it" in second
    assert "straight" in second
    assert written == {name: (quick.out / name).stat().st_mtime_ns for name in FILES}


def test_an_interrupted_demo_goes_on(quick, capsys, monkeypatch):
    begin = RunCallback._on_training_start

    def interrupted(self):
        begin(self)
        self._stop = True

    with monkeypatch.context() as patch:
        patch.setattr(RunCallback, "_on_training_start", interrupted)
        with pytest.raises(TrainingStoppedError, match="viapoint demo again"):
            demo.run(quick)
    demo.run(quick)
    assert "going on with it" in capsys.readouterr().out


def test_another_run_in_the_folder_is_refused(quick, capsys):
    quick.out.mkdir()
    (quick.out / "notes.txt").write_text("mine")
    with pytest.raises(BadFileError, match="not empty"):
        demo.run(quick)
    assert [path.name for path in quick.out.iterdir()] == ["notes.txt"]
