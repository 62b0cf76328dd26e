"""The motion planner of the library OMPL, as a method of the table."""

import sys

import numpy as np
import pytest

from viapoint.envs import Cylinder
from viapoint.envs.geometry.clearance import configuration_clearances
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.scenes.scene import resting
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planning import ompl_planner
from viapoint.training.planning.baselines import make_method
from viapoint.training.planning.ompl_planner import points_on
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import load, shipped_path

PLANE = "viapoint/PlanarObstacles-v0"


def test_without_the_library_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl.base", None)
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
    np.testing.assert_allclose(result.outcomes["duration"], result.actions[:, 1])


def test_every_link_of_the_whole_arm_clears():
    pytest.importorskip("ompl")
    simulation = SceneSimulation("viapoint/PlanarWholeArm-v0", 4)
    scenes = simulation.task.sampler()([np.random.default_rng(0)] * 4)
    method = make_method("ompl", "viapoint/PlanarWholeArm-v0")
    done = method.execute(scenes, method.decide({}, scenes))
    assert done.success.mean() > 0.5
    assert not (done.success & (done.info["min_clearance"] <= 0.0)).any()


def test_where_there_is_no_way_it_gives_up(monkeypatch):
    """A ring of bars around the start."""
    pytest.importorskip("ompl")
    start, goal = np.array([-0.25, 0.35]), np.array([0.15, 0.35])
    ring = [[0.07, 0.0, 0.0, 0.07], [-0.07, 0.0, 0.0, 0.07], [0.0, 0.07, 0.07, 0.0], [0.0, -0.07, 0.07, 0.0]]
    rows = np.array([[*(start + bar[:2]), *bar[2:], 0.01] for bar in ring])
    simulation = SceneSimulation(PLANE, 1)
    scenes = Scenes(start[None], goal[None], np.concatenate((rows, np.zeros((1, 5))))[None])
    monkeypatch.setattr(ompl_planner, "MARGINS", ompl_planner.MARGINS[:1])
    monkeypatch.setattr(ompl_planner, "PATIENCE", 0.05)
    method = ompl_planner.MotionPlanner(simulation)
    done = method.execute(scenes, method.decide({}, scenes))
    assert not done.success.any()


@pytest.mark.parametrize("env_id", [PLANE, "viapoint/PandaObstacles-v0"])
def test_a_line_is_clear_where_the_arm_keeps_the_margin_along_it(env_id):
    """Against the clearance at many places along random lines."""
    pytest.importorskip("ompl")
    planner, scenes = (
        ompl_planner.MotionPlanner(SceneSimulation(env_id, 1)),
        load("validation", env_id).scenes,
    )
    model, margin, share = planner._task.collision_model, 0.004, np.linspace(0.0, 1.0, 401)[:, None]
    generator, answers = np.random.default_rng(0), []
    for row in range(100):
        scene = scenes.take([row])
        first, second = scene.start[0] + generator.uniform(-0.1, 0.1, (2, scene.start.shape[1]))
        line = first + share * (second - first)
        least = float(model.least_clearance(line[None], scene.obstacles, scene.present)[0])
        within = float(np.asarray(model.arm.reach_margin(line)).min())
        if abs(least - margin) < 0.001 or abs(within) < 0.001:  # the planner looks at fewer places
            continue
        answers.append(least > margin and within > 0.0)
        assert planner._clear(scene, margin)(first, second) == answers[-1]
    assert 20 < sum(answers) < len(answers) - 20


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
