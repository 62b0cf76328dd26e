"""Frozen scenes are what their files say, planners certify them, and difficulty is measured right."""

import contextlib
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scene_sets.difficulty import planned_share, solution_share
from scene_sets.generate import (
    SEEDS,
    SETS,
    hard_families,
    lots,
    remake,
    size_of,
)
from scene_sets.scene_search import Kinds, Source, first_solved, redrawn, search

from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.sampler import UniformSampler
from viapoint.envs.scenes.scene import check_scenes
from viapoint.training.planners.baselines import METHODS, make_method
from viapoint.training.planners.cma_planner import Planner, PlannerBudget, screen
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets import scene_set
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes, bands, load, shipped_path
from viapoint.training.search.geometry_search import GeometrySearch

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "scenes.md").read_text(encoding="utf-8")
ENV_ID, IN_SPACE = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"


@pytest.fixture(scope="module")
def simulation():
    simulation = SceneSimulation(ENV_ID, 256)
    yield simulation
    simulation.close()


SHIPPED = [(env_id, name) for env_id, names in SETS.items() for name in names]


@pytest.fixture(params=["test", "validation"])
def frozen(request):
    return load(request.param, ENV_ID)


@pytest.fixture(params=SHIPPED, ids=lambda pair: f"{pair[0][9:-3]} {pair[1]}")
def shipped(request):
    """Every set there is; loading one compares its hash."""
    return load(request.param[1], request.param[0])


@pytest.fixture(scope="module")
def results():
    made = {}
    yield lambda env_id: made.setdefault(env_id, SceneSimulation(env_id, 128, threads=1))
    for each in made.values():
        each.close()


def test_shipped_sets_are_whole_and_distinct_and_shares_are_known_unless_uniform(shipped, results):
    size = size_of(results(shipped.env_id).task, shipped.name)
    assert len(shipped.share) == len(shipped.family) == size
    known = (shipped.share > 0.0) & (shipped.share <= 1.0)
    assert np.isnan(shipped.share).all() if shipped.name == "uniform" else known.all()
    assert len(np.unique(shipped.scenes.start, axis=0)) == size


def test_drawn_sets_hold_a_quarter_of_each_band_and_hard_ones_as_many_of_each_family(shipped, results):
    if shipped.name == "hard":
        names, counts = np.unique(shipped.family, return_counts=True)
        families = hard_families(results(shipped.env_id).task)
        assert set(names) == set(families)
        assert set(counts) == {100}
        assert set(shipped.family[: len(families)]) == set(families)  # in turn, so that any part is mixed
        assert (shipped.share < 0.05).all()
    else:
        assert (shipped.family == "").all()
        if "Reach" not in shipped.env_id and shipped.name != "uniform":
            assert (np.bincount(shipped.band, minlength=len(BANDS)) == len(shipped.share) / len(BANDS)).all()


@pytest.mark.parametrize("env_id", SETS)
def test_no_scene_is_in_two_sets(env_id):
    starts = [tuple(start) for name in SETS[env_id] for start in load(name, env_id).scenes.start]
    assert len(set(starts)) == len(starts)


def test_every_scene_can_begin_and_the_planner_certifies_it(shipped, results):
    """The first of each set, and those that the straight line may solve, which is only where nothing is in the way."""
    simulation = results(shipped.env_id)
    check_scenes(shipped.scenes, simulation.task.collision_model)
    some = shipped.take(slice(0, 120))
    assert simulation(some.scenes, some.solution).success.all()
    straight = simulation(some.scenes, np.zeros_like(some.solution)).success
    assert straight.all() if "Reach" in shipped.env_id else not straight.any()


@pytest.mark.parametrize("name", ["hard", "uniform"])
def test_scenes_made_again_by_their_numbers_are_the_same_on_any_threads(name):
    some = load(name, ENV_ID).take(slice(0, 5))
    assert remake(some, threads=1).sha256 == some.sha256


def test_scenes_that_are_searched_for_are_of_the_kind_asked_for_and_solved_and_can_be_drawn_again(simulation):
    def gates():
        return next(lot for lot in lots(simulation.task, "hard", 500) if lot.family == "gate")

    lot = gates()
    found = search(simulation, lot.source, dataclasses.replace(lot.kinds, quota=2), seed=1, label="gates")
    assert len(found.share) == 2
    assert ((found.share > 0.0) & (found.share < 0.05)).all()
    assert simulation(found.scenes, found.solution).success.all()
    for one, other in zip(redrawn(gates().source, found.number), found.scenes, strict=True):
        np.testing.assert_array_equal(one, other)


def test_uniform_scenes_are_those_of_the_sampler_that_have_a_solution(simulation):
    task = simulation.task
    (lot,) = lots(task, "uniform", 3)
    found = first_solved(simulation, dataclasses.replace(lot.source, block=4), 3, "uniform")
    assert simulation(found.scenes, found.solution).success.all()
    drawn = UniformSampler(task.collision_model, task.scenes)([np.random.default_rng(SEEDS["uniform"])] * 4)
    for one, other in zip(drawn.take(found.number), found.scenes, strict=True):
        np.testing.assert_array_equal(one, other)
    left = np.setdiff1d(np.arange(found.number[-1]), found.number)
    search = GeometrySearch(task, 512)
    for row in left:  # no other method solves them either
        action = search.decide(simulation.observe(drawn.take([row])))
        assert not simulation(drawn.take([row]), action).success.any()


def test_what_is_too_rare_is_said_to_be_missing(simulation):
    impossible = Kinds(
        of_share=lambda share: np.where(share > 2.0, 1, 0), names=("any", "more than all"), quota=1
    )
    sampler, generator = simulation.task.sampler(), np.random.default_rng(0)
    source = Source(draw=lambda number: sampler([generator] * number), block=64)
    with pytest.raises(RuntimeError, match="2 more than all scenes by estimate after 128 drawn"):
        search(simulation, source, impossible, seed=0, label="some", most_drawn=128)


@pytest.mark.parametrize("env_id", [ENV_ID, "viapoint/PlanarWholeArm-v0", IN_SPACE])
def test_every_band_is_drawn_in_training_about_as_often_as_documented(env_id, results):
    """With estimated shares, a little too high."""
    task = results(env_id).task
    scenes = task.sampler()([np.random.default_rng(1_000 + i) for i in range(300)])
    share = planned_share(results(env_id), scenes, draws=128)
    found = np.bincount(bands(share), minlength=len(BANDS)) / 300
    (row,) = re.findall(rf"^\| `{env_id}` \|((?: [0-9]+ % \|)+)$", PAGE, flags=re.MULTILINE)
    stated = np.array([float(part) for part in re.findall(r"[0-9]+", row)]) / 100.0
    recorded = json.loads((DOCS / "scenes.json").read_text())["bands"][env_id]
    assert (stated == [round(recorded[band], 2) for band in BANDS]).all()
    assert (found > 0.0).all()
    assert (np.abs(found - stated) < 0.09).all(), (found, stated)


def test_the_families_are_documented():
    assert all(f"`{name}` (" in PAGE.replace("\n", " ") for name in scene_families(2))


def test_the_stated_share_is_what_one_measures(frozen, simulation):
    """Other draws than those of the file give the same shares, within what chance allows."""
    some = frozen.take(np.flatnonzero(frozen.share > 0.1)[:12])
    draws = np.random.default_rng(123).uniform(-1.0, 1.0, (200, 3))
    rows = np.repeat(np.arange(12), 200)
    measured = (
        simulation(some.scenes.take(rows), np.tile(draws, (12, 1))).success.reshape(12, 200).mean(axis=-1)
    )
    spread = np.sqrt(some.share * (1.0 - some.share) * (1.0 / 200 + 1.0 / 512))
    assert (np.abs(measured - some.share) < 4.5 * spread).all()


def test_share_counts_only_what_fails_for_certain_as_failed(simulation):
    scenes = simulation.task.sampler()([np.random.default_rng(i) for i in range(40)])
    rows = np.repeat(np.arange(40), 32)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (len(rows), 3))
    fails = screen(simulation.task, scenes.take(rows), actions).fails
    assert not simulation(scenes.take(rows), actions).success[fails].any()
    assert 0.3 < fails.mean() < 0.98
    assert solution_share(simulation, scenes.take(slice(0, 2))).shape == (2,)


def test_what_succeeds_for_certain_does_and_only_in_space_it_is_known(simulation, results):
    scenes = results(IN_SPACE).task.sampler()([np.random.default_rng(i) for i in range(40)])
    rows = np.repeat(np.arange(40), 16)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (len(rows), 4))
    screened = screen(results(IN_SPACE).task, scenes.take(rows), actions)
    assert 40 < screened.succeeds.sum() < 300
    assert results(IN_SPACE)(scenes.take(rows[screened.succeeds]), actions[screened.succeeds]).success.all()
    planar = simulation.task.sampler()([np.random.default_rng(i) for i in range(40)])
    assert not screen(simulation.task, planar, np.ones((40, 3))).succeeds.any()


def test_the_planner_solves_unseen_scenes_better_than_chance_could(simulation):
    scenes = simulation.task.sampler()([np.random.default_rng(500 + i) for i in range(40)])
    planned = Planner(simulation, budget=PlannerBudget(first=32, generations=4))(scenes)
    assert planned.success.all()
    done = simulation(scenes, planned.action)
    assert done.success.all()
    np.testing.assert_allclose(done.reward, planned.reward)
    again = Planner(simulation, budget=PlannerBudget(first=32, generations=4))(scenes.take(slice(3, 5)))
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
    for name, other in (("share", content["share"] * 0.5), ("family", np.full(5, "gate"))):
        np.savez(path, **{**content, name: other})
        with pytest.raises(ValueError, match="damaged"):
            load(path, ENV_ID)


def test_a_small_archive_that_claims_a_huge_array_is_refused(frozen, tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, start=np.zeros((1_000_000, 2)))
    monkeypatch.setattr(scene_set, "LARGEST", 1_000_000)
    with pytest.raises(
        ValueError, match=r"bomb.npz is not a file of scenes: its arrays would take 16000128 bytes"
    ):
        load(path, ENV_ID)


def test_what_is_no_set_is_refused(tmp_path):
    with pytest.raises(ValueError, match="validation, test, hard, uniform"):
        load("tests", ENV_ID)
    with pytest.raises(ValueError, match="for viapoint/PlanarObstacles-v0, not for viapoint/PlanarReach-v0"):
        load(shipped_path("test", ENV_ID), "viapoint/PlanarReach-v0")


def test_a_file_that_is_broken_in_any_way_is_refused_with_its_name(frozen, tmp_path):
    path = tmp_path / "broken"
    frozen.take(slice(0, 5)).save(tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    flipped = [
        whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :] for at in range(30, len(whole) - 30, 67)
    ]
    np.save(tmp_path / "one.npy", np.zeros(3))
    one = (tmp_path / "one.npy").read_bytes()
    for content in (b"", b"no archive", b"PK", whole[: len(whole) // 2], one):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken is not a file of scenes: .*no archive of arrays"):
            load(path, ENV_ID)
    for content in flipped:
        path.write_bytes(content)
        with contextlib.suppress(ValueError):  # a bit may lie where nothing is read
            load(path, ENV_ID)


@pytest.mark.parametrize(
    ("name", "forge"),
    [
        ("share", lambda share: share[:3]),
        ("share", lambda share: share[0]),
        ("share", lambda share: share * 9.0),
        ("start", lambda start: start[:, :1]),
        ("start", lambda start: start.astype(str)),
        ("goal", lambda goal: goal.astype(complex)),
        ("obstacles", lambda rows: rows[..., :4]),
        ("obstacles", lambda rows: rows[:0]),
        ("solution", lambda solution: solution[:2]),
        ("family", lambda family: np.arange(len(family))),
        ("number", lambda number: number[:1]),
        ("number", lambda number: np.array([None] * len(number))),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused_whatever_their_hash(frozen, tmp_path, name, forge):
    path = tmp_path / "forged.npz"
    frozen.take(slice(0, 5)).save(path)
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, name: forge(content[name])})
    with pytest.raises(ValueError, match="is not a file of scenes"):
        load(path, ENV_ID)


@pytest.mark.parametrize("name", ["straight", "random", "random16"])
def test_baselines_decide_for_any_number_of_scenes(name, simulation):
    scenes = simulation.task.sampler()([np.random.default_rng(i) for i in range(7)])
    actions = METHODS[name](simulation).decide(simulation.observe(scenes), scenes)
    assert actions.shape == (7, 3)
    assert (np.abs(actions) <= 1.0).all()


def test_an_unknown_method_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="straight, constant, random"):
        make_method("magic", ENV_ID)


def test_frozen_scenes_of_nothing_have_bands():
    empty = load("test", ENV_ID).take(slice(0, 0))
    assert isinstance(empty, FrozenScenes)
    assert empty.band.shape == (0,)
