"""Scenes fit the environment that they are met in, whether they are frozen or drawn."""

import numpy as np
import pytest

from viapoint.training.scene_sets import scene_set
from viapoint.training.scene_sets.scene_set import load, scenes_for, shipped_path

ENV = "viapoint/PlanarObstacles-v0"


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(scene_set, "NUMBERS", {"validation": 12, "test": 20})


@pytest.mark.parametrize("kwargs", [{}, {"n_via": 2, "threads": 1}, {"duration_range": [0.7, 1.3]}])
def test_frozen_scenes_are_met_where_they_fit(kwargs, capsys):
    for name in ("validation", "test", "hard", "uniform"):
        assert scenes_for(name, ENV, kwargs).sha256 == load(name, ENV).sha256
    assert capsys.readouterr().err == ""
    path = str(shipped_path("test", ENV))
    assert scenes_for(path, ENV, {"whole_arm": True}).sha256 == load("test", ENV).sha256


@pytest.mark.parametrize(
    ("env_id", "kwargs", "rows", "dimension"),
    [
        (ENV, {"n_obstacles": 3}, 3, 2),
        (ENV, {"n_obstacles": [1, 8]}, 8, 2),
        (ENV, {"arm": "panda"}, 5, 3),
        ("viapoint/Reach-v0", {}, 0, 3),
        ("viapoint/PlanarMovingObstacles-v0", {"n_obstacles": 2}, 2, 2),
    ],
)
def test_others_are_drawn_always_the_same_and_it_is_said(env_id, kwargs, rows, dimension, capsys):
    test, again, validation = (scenes_for(name, env_id, kwargs) for name in ("test", "test", "validation"))
    assert "they are drawn" in capsys.readouterr().err
    assert test.scenes.start.shape == (20, dimension)
    assert test.scenes.present.shape == (20, rows)
    assert (test.band == -1).all()
    assert test.sha256 == again.sha256
    assert not np.isin(validation.scenes.goal, test.scenes.goal).any()
