"""The demo: everything in one folder, and nothing twice."""

import json

import pytest

from viapoint.training.cli import demo
from viapoint.training.config.configs import DemoConfig
from viapoint.training.runs.trainer import RunCallback, TrainingStoppedError


@pytest.fixture
def quick(monkeypatch, shipped, tmp_path):
    monkeypatch.setattr(demo, "PICTURES", 2)
    monkeypatch.setattr(demo, "MOVEMENTS", 1)
    return DemoConfig(out=tmp_path / "demo", n_timesteps=64, n_scenes=8)


def test_an_interrupted_demo_goes_on_and_what_is_done_is_not_done_again(quick, capsys, monkeypatch):
    begin = RunCallback._on_training_start

    def interrupted(self):
        begin(self)
        self._stop = True

    with monkeypatch.context() as patch:
        patch.setattr(RunCallback, "_on_training_start", interrupted)
        with pytest.raises(TrainingStoppedError):
            demo.run(quick)
    demo.run(quick)
    told = capsys.readouterr().out
    written = {name: (quick.out / name).stat().st_mtime_ns for name in demo.FILES}
    assert all(str(quick.out / name) in told for name in (*demo.FILES, "best"))
    methods = json.loads((quick.out / "table.json").read_text())["methods"]
    assert {"agent", "agent, 16 checks", "untrained", "search512"} <= set(methods)
    assert methods["straight"]["success"]["rate"] == 0.0

    for name in ("evaluate", "gallery", "record_video"):
        monkeypatch.setattr(demo, name, pytest.fail)
    demo.run(quick)
    assert written == {name: (quick.out / name).stat().st_mtime_ns for name in demo.FILES}
