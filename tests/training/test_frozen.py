"""Frozen scenes are what their files say, planners certify them, and difficulty is measured right."""

import contextlib
import dataclasses

import numpy as np
import pytest
from scene_sets.difficulty import solution_share
from scene_sets.generate import SEEDS, SETS, hard_families, lots, remake, size_of
from scene_sets.scene_search import Kinds, Source, first_solved, redrawn, search

from viapoint.envs.scenes.sampler import UniformSampler
from viapoint.envs.scenes.scene import check_scenes
from viapoint.training.planning.cma_planner import Planner, PlannerBudget, screen
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets import scene_set
from viapoint.training.scene_sets.scene_set import BANDS, bands, load

ENV_ID, IN_SPACE = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
SHIPPED = [(env_id, name) for env_id, names in SETS.items() for name in names]


@pytest.fixture(scope="module")
def simulations():
    made = {}
    yield lambda env_id: made.setdefault(env_id, SceneSimulation(env_id, 128, threads=1))
    for each in made.values():
        each.close()


@pytest.fixture
def simulation(simulations):
    return simulations(ENV_ID)


@pytest.fixture(params=SHIPPED, ids=lambda pair: f"{pair[0][9:-3]} {pair[1]}")
def shipped(request):
    """Every set there is; loading one compares its hash."""
    return load(request.param[1], request.param[0])


@pytest.fixture
def some():
    return load("test", ENV_ID).take(slice(0, 5))


def test_shipped_sets_are_whole_distinct_and_of_the_kind_that_they_promise(shipped, simulations):
    task, size = simulations(shipped.env_id).task, len(shipped.share)
    assert size == size_of(task, shipped.name)
    assert len(np.unique(shipped.scenes.start, axis=0)) == size
    if shipped.name == "uniform":
        assert np.isnan(shipped.share).all()
        return
    assert ((shipped.share > 0.0) & (shipped.share <= 1.0)).all()
    if shipped.name == "hard":
        families = hard_families(task)
        names, counts = np.unique(shipped.family, return_counts=True)
        assert dict(zip(names, counts, strict=True)) == dict.fromkeys(families, 100)
        assert set(shipped.family[: len(families)]) == set(families)  # in turn, so that any part is mixed
        assert (shipped.share < 0.05).all()
    elif "Reach" not in shipped.env_id:
        assert (np.bincount(shipped.band, minlength=len(BANDS)) == size / len(BANDS)).all()


@pytest.mark.parametrize("env_id", SETS)
def test_no_scene_is_in_two_sets(env_id):
    starts = [tuple(start) for name in SETS[env_id] for start in load(name, env_id).scenes.start]
    assert len(set(starts)) == len(starts)


def test_every_scene_can_begin_and_the_planner_certifies_it(shipped, simulations):
    """The first of each set, and those that the straight line may solve, which is only where nothing is in the way."""
    simulation = simulations(shipped.env_id)
    check_scenes(shipped.scenes, simulation.task.collision_model)
    first = shipped.take(slice(0, 60))
    assert simulation(first.scenes, first.solution).success.all()
    straight = simulation(first.scenes, np.zeros_like(first.solution)).success
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
    for row in left:  # no other method solves them either
        action = GeometrySearch(task, 512).decide(simulation.observe(drawn.take([row])))
        assert not simulation(drawn.take([row]), action).success.any()


def test_what_is_too_rare_ends_the_search(simulation):
    impossible = Kinds(of_share=lambda share: np.where(share > 2.0, 1, 0), names=("any", "more"), quota=1)
    sampler, generator = simulation.task.sampler(), np.random.default_rng(0)
    source = Source(draw=lambda number: sampler([generator] * number), block=64)
    with pytest.raises(RuntimeError):
        search(simulation, source, impossible, seed=0, label="some", most_drawn=128)


def test_the_stated_share_is_what_one_measures(simulation):
    """Other draws than those of the file give the same shares, within what chance allows."""
    frozen = load("validation", ENV_ID)
    some = frozen.take(np.flatnonzero(frozen.share > 0.1)[:12])
    draws = np.random.default_rng(123).uniform(-1.0, 1.0, (200, 3))
    rows = np.repeat(np.arange(12), 200)
    success = simulation(some.scenes.take(rows), np.tile(draws, (12, 1))).success
    measured = success.reshape(12, 200).mean(axis=-1)
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


def test_what_succeeds_for_certain_does(simulations):
    simulation = simulations(IN_SPACE)
    scenes = simulation.task.sampler()([np.random.default_rng(i) for i in range(40)])
    rows = np.repeat(np.arange(40), 16)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (len(rows), 4))
    certain = screen(simulation.task, scenes.take(rows), actions).succeeds
    assert 40 < certain.sum() < 300
    assert simulation(scenes.take(rows[certain]), actions[certain]).success.all()


def test_the_planner_solves_unseen_scenes(simulation):
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
    assert load("test", ENV_ID).take(slice(0, 0)).band.shape == (0,)


def refused(path):
    with pytest.raises(ValueError) as error:
        load(path, ENV_ID)
    assert path.name in str(error.value)


def test_a_file_comes_back_as_it_was_and_any_damage_is_noticed(some, tmp_path, monkeypatch):
    path = tmp_path / "some.npz"
    some.save(path)
    assert load(path, ENV_ID).sha256 == some.sha256
    whole = path.read_bytes()
    np.save(tmp_path / "one.npy", np.zeros(3))
    for content in (b"", b"no archive", b"PK", whole[: len(whole) // 2], (tmp_path / "one.npy").read_bytes()):
        path.write_bytes(content)
        refused(path)
    for at in range(30, len(whole) - 30, 67):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        with contextlib.suppress(ValueError):  # a bit may lie where nothing is read
            load(path, ENV_ID)
    np.savez_compressed(path, start=np.zeros((1_000_000, 2)))
    monkeypatch.setattr(scene_set, "LARGEST", 1_000_000)
    refused(path)


@pytest.mark.parametrize(
    ("name", "forge"),
    [
        ("share", lambda share: share[:3]),
        ("share", lambda share: share[0]),
        ("share", lambda share: share * 0.5),
        ("share", lambda share: share * 9.0),
        ("start", lambda start: start[:, :1]),
        ("start", lambda start: start.astype(str)),
        ("goal", lambda goal: goal.astype(complex)),
        ("obstacles", lambda rows: rows[..., :4]),
        ("obstacles", lambda rows: rows[:0]),
        ("solution", lambda solution: solution[:2]),
        ("family", lambda family: np.arange(len(family))),
        ("family", lambda family: np.full(len(family), "gate")),
        ("number", lambda number: number[:1]),
        ("number", lambda number: np.array([None] * len(number))),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(some, tmp_path, name, forge):
    path = tmp_path / "forged.npz"
    some.save(path)
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, name: forge(content[name])})
    refused(path)
