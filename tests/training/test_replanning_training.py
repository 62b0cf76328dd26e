"""Laws of measuring where plans are revised: whole episodes, the true course for the planner alone."""

import numpy as np
import pytest
from scene_sets.replanning import SIZES, solution_shares

from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planning.baselines import make_method
from viapoint.training.rollouts.rollout import EpisodeSimulation
from viapoint.training.scene_sets.scene_set import load

MOVING, JUMPS = "viapoint/PlanarMovingObstacles-v0", "viapoint/PlanarTargetJump-v0"


def results(env_id, *names, number=12):
    frozen = load("validation", env_id).take(slice(0, number))
    methods = [make_method(name, env_id) for name in names]
    found = evaluate_methods(methods, frozen, env_id, time_decisions=False).results
    return {name: each.summary()["success"]["rate"] for name, each in zip(names, found, strict=True)}


def test_the_planner_solves_frozen_scenes_and_straight_movements_do_not():
    rates = results(MOVING, "planner", "straight")
    assert rates["planner"] == 1.0
    assert rates["straight"] < 0.3


def test_a_jumping_target_is_reached_by_revision_only():
    rates = results(JUMPS, "straight", "unrevised")
    assert rates == {"straight": 1.0, "unrevised": 0.0}


def test_an_episode_is_the_same_alone_and_among_others():
    simulation = EpisodeSimulation(MOVING, 8)
    scenes = simulation.draw(11, seed=4)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (11, simulation.task.action.size))
    together = simulation(scenes, actions)
    for row in (0, 7, 10):
        alone = simulation(scenes.take([row]), actions[[row]])
        for name, value in alone.info.items():
            np.testing.assert_array_equal(value[0], together.info[name][row])


def test_drawn_scenes_are_the_same_for_the_same_seed():
    one, other = (EpisodeSimulation(MOVING, size).draw(5, seed=9) for size in (3, 70))
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("env_id", [MOVING, JUMPS])
def test_shipped_sets_hold_what_they_promise(env_id):
    for name, size in SIZES.items():
        frozen = load(name, env_id)
        assert len(frozen.share) == size
        assert len(np.unique(frozen.number)) == size
        if env_id == MOVING:
            simulation, some = EpisodeSimulation(env_id, 4), frozen.take(slice(0, 4))
            np.testing.assert_allclose(
                solution_shares(simulation, some.scenes)[:1], some.share[:1], atol=1e-3
            )


def test_files_of_changing_scenes_come_back_whole(tmp_path):
    frozen = load("validation", JUMPS).take(slice(0, 3))
    frozen.save(tmp_path / "some.npz")
    again = load(tmp_path / "some.npz", JUMPS)
    assert again.sha256 == frozen.sha256
    np.testing.assert_array_equal(again.scenes.jumps, frozen.scenes.jumps)
