"""The motion planner of the library OMPL, as a method of the table."""

import sys

import numpy as np
import pytest
from tasks import PANDA, PLANE, WHOLE

from viapoint.envs import Box
from viapoint.envs.scenes.options import draw_given
from viapoint.training import plan_motion
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planning import ompl_paths
from viapoint.training.planning import plan_motion as module
from viapoint.training.planning.baselines import make_method
from viapoint.training.planning.benchmark import benchmark_panda, benchmark_problems
from viapoint.training.planning.ompl_paths import points_on
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets import load, shipped_path


def test_without_the_library_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl.base", None)
    ompl_paths.import_ompl.cache_clear()
    with pytest.raises(ValueError, match=r"pip install 'viapoint\[planning\]'"):
        make_method("ompl", PLANE)


def test_it_solves_scenes_of_all_bands_and_stands_in_the_table():
    pytest.importorskip("ompl")
    frozen = load(shipped_path("validation", PLANE))
    frozen = frozen.take(np.concatenate([np.flatnonzero(frozen.band == band)[:3] for band in range(4)]))
    result = evaluate_methods(
        [make_method("ompl", PLANE)], frozen, PLANE, batch=20, time_decisions=False
    ).results[0]
    summary = result.summary()
    assert summary["success"]["rate"] >= 0.9
    assert summary["collision"]["rate"] <= 0.1
    counts = result.actions[:, 0].astype(int)
    durations = [row[1 : 2 + count].sum() for row, count in zip(result.actions, counts, strict=True)]
    np.testing.assert_allclose(result.outcomes["duration"], durations)


def test_where_there_is_no_way_it_gives_up(monkeypatch):
    """A ring of bars around the start."""
    pytest.importorskip("ompl")
    monkeypatch.setattr(module, "OMPL_MARGINS", module.OMPL_MARGINS[:1])
    monkeypatch.setattr(module, "OMPL_PATIENCE", 0.05)
    x, y = -0.25, 0.35
    across = [Box((0.01, 0.08, 0.04), position=(x + side, y, 0.0)) for side in (-0.07, 0.07)]
    along = [Box((0.08, 0.01, 0.04), position=(x, y + side, 0.0)) for side in (-0.07, 0.07)]
    simulation = SceneSimulation(PLANE, 1)
    given = {"start": (x, y), "goal": (0.15, 0.35), "obstacles": [*across, *along]}
    scenes = draw_given(given, simulation.task.sampler(), [np.random.default_rng(0)])
    method = make_method("ompl", PLANE)
    assert not method.plan(scenes).success
    assert not method.execute(scenes, method.decide({}, scenes)).success.any()


@pytest.mark.parametrize("name", ["ompl", "plan_motion"])
@pytest.mark.parametrize("env_id", [PLANE, WHOLE, PANDA])
def test_plans_are_as_clear_as_they_are_said_to_be(env_id, name):
    if name == "ompl":
        pytest.importorskip("ompl")
    scenes = load(shipped_path("validation", env_id)).scenes.take(np.arange(0, 240, 20))
    method = make_method(name, env_id)
    plans = [method.plan(scenes.take([row])) for row in range(12)]
    for plan in plans:
        done = plan.execute(force=True)
        assert done.is_success[0] or plan.clearance < 0.002
        assert done.min_clearance[0] > plan.clearance - 0.002
    assert sum(plan.success for plan in plans) > 6


def test_where_no_seed_is_free_a_path_is_followed():
    pytest.importorskip("ompl")
    arm = benchmark_panda()
    problem = next(each for each in benchmark_problems() if each.name == "bookshelf_thin 20")
    plan = plan_motion(arm, problem.start, problem.goal, problem.obstacles, seeds=0, n_via=1, time_limit=20.0)
    assert (plan.success, plan.source) == (True, "ompl")
    assert not plan_motion(
        arm, problem.start, problem.goal, problem.obstacles, seeds=0, n_via=1, ompl=False
    ).success


def test_points_lie_on_the_path_and_keep_its_corners():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [2.0, 2.0]])
    np.testing.assert_array_equal(points_on(path, 2), path)
    np.testing.assert_allclose(points_on(path, 1), [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    for count in (3, 4, 8, 12):
        points = points_on(path, count)
        assert len(points) == count + 2
        assert all((np.abs(points - corner).max(axis=-1) < 1e-12).any() for corner in path)
        length = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum()
        assert length == pytest.approx(4.0)
