"""Scenes that were made again: compared with those shipped, written only where one says so."""

import dataclasses
import sys

import pytest
from scene_sets import generate

from viapoint.training.scene_sets.scene_set import load, shipped_path

ENV = "viapoint/PlanarReach-v0"
REPLANNING = "viapoint/PlanarTargetJump-v0"


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("env_id", [ENV, REPLANNING])
def test_a_difference_is_told_by_the_exit_status_and_replaces_nothing(env_id, same, monkeypatch, capsys):
    path, frozen = shipped_path("test", env_id), load("test", env_id)
    other = dataclasses.replace(frozen, scenes=frozen.scenes._replace(goal=0.99 * frozen.scenes.goal))
    before, made = path.read_bytes(), frozen if same else other
    for maker in ("make", "remake", "make_replanning"):
        monkeypatch.setattr(generate, maker, lambda *_, **__: made)
    monkeypatch.setattr(sys, "argv", ["make", "--env", env_id, "--sets", "test"])
    with pytest.raises(SystemExit) as left:
        generate.main()
    assert left.value.code == (0 if same else 1)
    assert ("DIFFERENT" in capsys.readouterr().out) is not same
    assert path.read_bytes() == before
