"""Frozen scenes are what their files say, can be made again, and difficulty is measured right."""

import contextlib
import dataclasses

import frozen_scenes as make
import numpy as np
import pytest
from helpers import MOVING, PLANE, REACH

from viapoint.envs import ENV_IDS, Task
from viapoint.envs.scenes.scene import check_scenes
from viapoint.training import scene_sets
from viapoint.training.planning.baselines import make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import BANDS, SETS, drawn, load, scenes_for, shipped_path, shipped_set

FILES = sorted(shipped_path(PLANE).parent.glob("*.npz"))
SHIPPED = {f"{path.stem} {name}": each for path in FILES for name, each in make.shipped_sets(path).items()}


@pytest.fixture(scope="module")
def simulation():
    return SceneSimulation(PLANE, 250, threads=1)


@pytest.fixture
def some():
    return load(shipped_path(PLANE), "test").take(slice(0, 5))


@pytest.mark.parametrize("frozen", SHIPPED.values(), ids=SHIPPED)
def test_shipped_sets_are_whole_possible_and_of_the_kind_that_they_promise(frozen):
    check_scenes(frozen.scenes, Task.of(**frozen.task).arm)
    name = frozen.name
    changing = frozen.task["moving_obstacles"] or not frozen.task["n_obstacles"][1]
    wanted = (make.FEWER if changing else make.NUMBERS)[name]
    assert 0.95 * wanted <= len(frozen.share) <= wanted
    assert ((frozen.share >= 0.0) & (frozen.share <= 1.0)).all()
    if not frozen.task["n_obstacles"][1]:
        assert (frozen.share == 1.0).all()
    elif name == "hard":
        assert (frozen.share < 0.05).all()
        assert np.unique(frozen.family, return_counts=True)[1].min() > 30
    elif name != "uniform":
        assert (np.bincount(frozen.band) == len(frozen.share) / len(BANDS)).all()


def test_every_task_has_the_sets_of_its_scenes():
    for env_id in ENV_IDS:
        task = registered_task(env_id)
        own = shipped_set("test", task)
        if env_id not in ("viapoint/Reach-v0", "viapoint/Obstacles-v0"):  # those of the Panda
            path = shipped_path(env_id.replace("Step-v", "-v"))
            assert own.sha256 == load(path, "test").sha256
        assert own.task["arm"] == task.arm.name


def test_sets_made_again_are_the_same():
    made = make.Maker(REACH).make("validation")
    assert made.sha256 == load(shipped_path(REACH), "validation").sha256


def test_scenes_are_of_the_kind_asked_for_and_can_be_solved(simulation, monkeypatch):
    monkeypatch.setattr(make, "NUMBERS", {"test": 4, "hard": 6, "uniform": 4})
    monkeypatch.setattr(make, "TOGETHER", 25)
    maker = make.Maker(PLANE)
    test, hard, uniform = (maker.make(name) for name in ("test", "hard", "uniform"))
    np.testing.assert_array_equal(np.bincount(test.band), [1, 1, 1, 1])
    assert sorted(hard.family) == sorted(set(hard.family))
    assert (hard.share < 0.05).all()
    method = make_method("search4096", PLANE)
    for each in (test, hard, uniform):
        assert len(each.share) == len(each.scenes.start) == make.NUMBERS[each.name]
        done = simulation(each.scenes, method.decide(simulation.observe(each.scenes), each.scenes))
        assert done["is_success"].mean() > 0.7


def test_the_stated_share_is_what_one_measures(simulation):
    """Other random actions give the same shares in physics, within what chance and the least clearance allow."""
    frozen = load(shipped_path(PLANE), "validation")
    few = frozen.take(np.flatnonzero(frozen.share > 0.1)[:12])
    draws = np.random.default_rng(123).uniform(-1.0, 1.0, (100, 3))
    rows = np.repeat(np.arange(12), 100)
    success = simulation(few.scenes.take(rows), np.tile(draws, (12, 1)))["is_success"]
    measured = success.reshape(12, 100).mean(axis=-1)
    spread = np.sqrt(few.share * (1.0 - few.share) * (1.0 / 100 + 1.0 / 512))
    assert (np.abs(measured - few.share) < 4.0 * spread + 0.03).all()


def test_bands_by_their_edges(some):
    share = np.array([0.21, 0.2, 0.05, 0.01, np.nan])
    np.testing.assert_array_equal(dataclasses.replace(some, share=share).band, [0, 1, 2, 3, -1])
    assert some.take(slice(0, 0)).band.shape == (0,)


@pytest.mark.parametrize("kwargs", [{}, {"n_via": 2}, {"duration_range": (0.7, 1.3)}, {"decide_at": "steps"}])
def test_frozen_scenes_are_met_where_they_fit(kwargs, capsys):
    task = registered_task(PLANE, **kwargs)
    for name in SETS:
        assert scenes_for(name, task).sha256 == load(shipped_path(PLANE), name).sha256
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("env_id", "kwargs", "rows"),
    [(PLANE, {"n_obstacles": 3}, 3), (PLANE, {"arm": "panda"}, 5), (MOVING, {"n_obstacles": 2}, 2)],
)
def test_others_are_drawn_always_the_same_and_it_is_said(env_id, kwargs, rows, capsys):
    task = registered_task(env_id, **kwargs)
    test, again, validation = (scenes_for(name, task, 20) for name in ("test", "test", "validation"))
    assert "they are drawn" in capsys.readouterr().err
    assert test.scenes.obstacles.kind.shape == (20, rows)
    assert (test.band == -1).all()
    assert test.sha256 == again.sha256
    assert not (validation.scenes.goal[:, None] == test.scenes.goal).all(axis=-1).any()
    with pytest.raises(ValueError):
        scenes_for("hard", task)


def test_a_file_is_met_wherever_its_scenes_are_possible(some, tmp_path):
    path = tmp_path / "some.npz"
    some.save(path)
    found = scenes_for(path, registered_task(PLANE, n_obstacles=8, whole_arm=True)).scenes
    assert found.obstacles.kind.shape == (5, 8)
    np.testing.assert_array_equal(found.obstacles.centre[:, :5], some.scenes.obstacles.centre)
    assert not found.obstacles.present[:, 5:].any()
    for kwargs in ({"n_obstacles": 2}, {"arm": "panda"}, {"shapes": "sphere"}):
        with pytest.raises(ValueError):
            scenes_for(path, registered_task(PLANE, **kwargs))


def refused(path):
    with pytest.raises(ValueError):
        load(path)


def test_a_file_comes_back_as_it_was_and_any_damage_is_noticed(some, tmp_path, monkeypatch):
    path = tmp_path / "some.npz"
    refused(path)
    for frozen in (drawn("validation", registered_task(MOVING, courses="reaches"), 5), some):
        frozen.save(path)
        again = load(path)
        assert again.sha256 == frozen.sha256
        np.testing.assert_array_equal(again.scenes.reach, frozen.scenes.reach)
    whole = path.read_bytes()
    np.save(tmp_path / "one.npy", np.zeros(3))
    for content in (b"", b"no archive", b"PK", whole[: len(whole) // 2], (tmp_path / "one.npy").read_bytes()):
        path.write_bytes(content)
        refused(path)
    for at in range(30, len(whole) - 30, 201):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        with contextlib.suppress(ValueError):  # a bit may lie where nothing is read
            assert load(path).sha256 == some.sha256
    path.write_bytes(whole)
    monkeypatch.setattr(scene_sets, "LARGEST", 1_000)
    refused(path)


FORGED = [
    ("share", lambda share: share[:3]),
    ("share", lambda share: share + 9.0),
    ("start", lambda start: start * np.nan),
    ("kind", lambda kind: kind + 9),
    ("centre", lambda centre: centre[..., :2]),
    ("family", lambda family: np.arange(len(family))),
    ("task", lambda task: np.array("{")),
    ("task", lambda task: np.array([None])),
    ("sha256", lambda sha256: np.array("0")),
]


@pytest.mark.parametrize(("name", "forge"), FORGED)
def test_arrays_that_do_not_fit_together_are_refused(some, tmp_path, name, forge):
    path = tmp_path / "forged.npz"
    some.save(path)
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, name: forge(content[name])})
    refused(path)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_scene_is_in_two_sets(path):
    sets = make.shipped_sets(path).values()
    ends = np.concatenate([np.hstack((each.scenes.start, each.scenes.goal)) for each in sets])
    assert len(np.unique(ends, axis=0)) == len(ends)
