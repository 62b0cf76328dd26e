"""Frozen scenes are what their files say, planners certify them, and difficulty is measured right."""

import numpy as np
import pytest

from viapoint.envs.scenes import check_scenes
from viapoint.training.baselines import METHODS, make_method
from viapoint.training.difficulty import solution_share
from viapoint.training.frozen_scenes import BANDS, FrozenScenes, bands, load, shipped_path
from viapoint.training.planner import Planner, PlannerBudget
from viapoint.training.screening import screen
from viapoint.training.trial import Trial

ENV_ID = "viapoint/PlanarObstacles-v0"


@pytest.fixture(scope="module")
def trial():
    trial = Trial(ENV_ID, 256)
    yield trial
    trial.close()


@pytest.fixture(params=["test", "validation"])
def frozen(request):
    return load(request.param, ENV_ID)


def test_shipped_sets_are_whole_distinct_and_of_all_bands(frozen):
    assert len(frozen.share) == {"test": 1000, "validation": 500}[frozen.name]
    assert ((frozen.share > 0.0) & (frozen.share <= 1.0)).all()
    assert (np.bincount(frozen.band, minlength=len(BANDS)) > 0.1 * len(frozen.share)).all()
    assert len(np.unique(frozen.scenes.start, axis=0)) == len(frozen.share)


def test_no_scene_is_in_both_sets():
    one, other = load("test", ENV_ID).scenes.start, load("validation", ENV_ID).scenes.start
    assert not set(map(tuple, one)) & set(map(tuple, other))


def test_every_scene_is_certified_and_the_straight_line_solves_none(frozen, trial):
    check_scenes(frozen.scenes, trial.task.arm, whole_arm=False)
    assert trial(frozen.scenes, frozen.solution).success.all()
    assert not trial(frozen.scenes, np.zeros_like(frozen.solution)).success.any()


def test_the_stated_share_is_what_one_measures(frozen, trial):
    """Other draws than those of the file give the same shares, within what chance allows."""
    some = frozen.take(np.flatnonzero(frozen.share > 0.1)[:12])
    draws = np.random.default_rng(123).uniform(-1.0, 1.0, (200, 3))
    rows = np.repeat(np.arange(12), 200)
    measured = trial(some.scenes.take(rows), np.tile(draws, (12, 1))).success.reshape(12, 200).mean(axis=-1)
    spread = np.sqrt(some.share * (1.0 - some.share) * (1.0 / 200 + 1.0 / 512))
    assert (np.abs(measured - some.share) < 4.5 * spread).all()


def test_share_counts_only_what_fails_for_certain_as_failed(trial):
    scenes = trial.task.sampler()([np.random.default_rng(i) for i in range(40)])
    rows = np.repeat(np.arange(40), 32)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (len(rows), 3))
    fails = screen(trial.task, scenes.take(rows), actions).fails
    assert not trial(scenes.take(rows), actions).success[fails].any()
    assert 0.3 < fails.mean() < 0.98
    assert solution_share(trial, scenes.take(slice(0, 2))).shape == (2,)


def test_the_planner_solves_unseen_scenes_better_than_chance_could(trial):
    scenes = trial.task.sampler()([np.random.default_rng(500 + i) for i in range(40)])
    planned = Planner(trial, budget=PlannerBudget(first=32, generations=4))(scenes)
    assert planned.success.all()
    done = trial(scenes, planned.action)
    assert done.success.all()
    np.testing.assert_allclose(done.reward, planned.reward)
    again = Planner(trial, budget=PlannerBudget(first=32, generations=4))(scenes.take(slice(3, 5)))
    np.testing.assert_array_equal(again.action, planned.action[3:5])


def test_bands_by_their_edges():
    np.testing.assert_array_equal(
        bands(np.array([0.9, 0.21, 0.2, 0.051, 0.05, 0.011, 0.01, 0.0])), [0, 0, 1, 1, 2, 2, 3, 3]
    )


def test_a_file_comes_back_as_it_was_and_damage_is_noticed(frozen, tmp_path):
    path = tmp_path / "some.npz"
    some = frozen.take(slice(0, 5))
    some.save(path)
    again = load(path, ENV_ID)
    assert again.sha256 == some.sha256
    with np.load(path) as archive:
        content = dict(archive)
    content["share"] = content["share"] * 0.5
    np.savez(path, **content)
    with pytest.raises(ValueError, match="damaged"):
        load(path, ENV_ID)


def test_what_is_no_set_is_refused(tmp_path):
    with pytest.raises(ValueError, match="validation, test, hard"):
        load("tests", ENV_ID)
    with pytest.raises(ValueError, match="for viapoint/PlanarObstacles-v0, not for viapoint/PlanarReach-v0"):
        load(shipped_path("test", ENV_ID), "viapoint/PlanarReach-v0")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(ValueError, match="not a file of scenes"):
        load(tmp_path / "text.npz", ENV_ID)


@pytest.mark.parametrize("name", ["straight", "random", "random16"])
def test_baselines_decide_for_any_number_of_scenes(name, trial):
    scenes = trial.task.sampler()([np.random.default_rng(i) for i in range(7)])
    actions = METHODS[name](trial).decide(trial.observe(scenes), scenes)
    assert actions.shape == (7, 3)
    assert (np.abs(actions) <= 1.0).all()


def test_an_unknown_method_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="straight, constant, random"):
        make_method("magic", ENV_ID)


def test_frozen_scenes_of_nothing_have_bands():
    empty = load("test", ENV_ID).take(slice(0, 0))
    assert isinstance(empty, FrozenScenes)
    assert empty.band.shape == (0,)
