"""Every failure is of one kind, and the kinds are what they say."""

import json

import numpy as np
import pytest

from viapoint.training.config.configs import TrainConfig
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.plotting import failure_report as module
from viapoint.training.plotting.failure_report import (
    KINDS,
    classify,
    classify_failures,
    markdown,
    proposals,
    write_failures,
)
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.trainer import new_model, resolved

ENV = "viapoint/PlanarObstacles-v0"
NAMES = [kind.name for kind in KINDS]


def outcomes(reachable=True, collision=True, planned_clearance=-0.02):
    return {
        "reachable": np.array([reachable]),
        "collision": np.array([collision]),
        "planned_clearance": np.array([planned_clearance]),
    }


@pytest.mark.parametrize(
    ("outcome", "another", "kind"),
    [
        (outcomes(reachable=False, collision=False, planned_clearance=0.1), True, "out_of_reach"),
        (outcomes(collision=False, planned_clearance=0.1), True, "off_goal"),
        (outcomes(planned_clearance=0.001), True, "tracking"),
        (outcomes(planned_clearance=0.0), True, "graze"),
        (outcomes(planned_clearance=-0.005), True, "graze"),
        (outcomes(planned_clearance=-0.0051), True, "wrong_way"),
        (outcomes(planned_clearance=-0.0051), False, "collision"),
    ],
)
def test_each_kind_is_what_it_says(outcome, another, kind):
    assert NAMES[classify(outcome, np.array([another]))[0]] == kind


class Chosen:
    """The worst of the agent's proposals wherever another one succeeds, otherwise what it would do."""

    name = "agent"

    def __init__(self, model, simulation):
        self.model, self.simulation = model, simulation

    def decide(self, observation, scenes):
        actions = proposals(self.model.policy, self.simulation.observe(scenes))
        number, count, size = actions.shape
        every = scenes.take(np.repeat(np.arange(number), count))
        reward = self.simulation(every, actions.reshape(-1, size)).reward.reshape(number, count)
        return actions[np.arange(number), reward.argmin(axis=-1)]


@pytest.fixture(scope="module")
def sorted_out(small_scenes):
    env = ViaVecEnv(ENV, 1, threads=1)
    model = new_model(resolved(TrainConfig(env=ENV)), env)  # untrained
    simulation = SceneSimulation(ENV, 64, threads=1)
    result = evaluate_methods(
        [Chosen(model, simulation)], small_scenes, ENV, env_kwargs={"threads": 1}, time_decisions=False
    ).results[0]
    return result, classify_failures(result, small_scenes, model, ENV, threads=1)


def test_every_failure_is_counted_once(sorted_out):
    result, failures = sorted_out
    np.testing.assert_array_equal(failures.rows, np.flatnonzero(~result.success))
    counts = failures.counts()
    assert sum(each["count"] for each in counts.values()) == len(failures.rows) > 5
    for each in counts.values():
        assert sum(each["by_band"].values()) == each["count"]


def test_the_other_way_was_there(sorted_out, small_scenes):
    """An agent made to take its worst proposal often had a better one."""
    _, failures = sorted_out
    assert 0.1 < failures.another.mean() < 1.0
    wrong = failures.kind == NAMES.index("wrong_way")
    assert wrong.any()
    assert failures.another[wrong].all()
    assert not failures.another[failures.kind == NAMES.index("collision")].any()
    assert (failures.depth[wrong] > module.MAX_GRAZE).all()


def test_tables_and_pictures_are_written(sorted_out, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_PICTURES", 2)
    _, failures = sorted_out
    paths = write_failures(failures, tmp_path / "new", ENV, threads=1)
    names = {path.name for path in paths}
    assert {"failures.md", "failures.json"} <= names
    counts = json.loads((tmp_path / "new" / "failures.json").read_text())["kinds"]
    assert {f"{name}.png" for name, each in counts.items() if each["count"]} == names - {
        "failures.md",
        "failures.json",
    }
    table = (tmp_path / "new" / "failures.md").read_text()
    assert f"| all | {len(failures.rows)} |" in table


def test_a_table_of_no_failures_can_be_written():
    nothing = {
        kind.name: {"count": 0, "by_band": dict.fromkeys(module.BANDS, 0), "another": None} for kind in KINDS
    }
    assert "| all | 0 | 0.0 % | 0 | 0 | 0 | 0 | - |" in markdown(nothing, 10)
