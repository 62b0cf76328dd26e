"""The benchmark measures what it says; how fast is not a matter for tests."""

import json

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.sim.simulator import Simulator
from viapoint.training.cli import bench
from viapoint.training.config.configs import BenchConfig


def test_measurements_take_turns():
    calls = []
    times = bench.fastest(3, lambda: calls.append("a"), lambda: calls.append("b"))
    assert calls == ["a", "b"] * 3
    assert len(times) == 2
    assert all(time >= 0.0 for time in times)


@pytest.mark.parametrize("env_id", ["viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"])
def test_the_engine_alone_simulates_the_movements_of_the_environments(env_id, monkeypatch):
    made = []

    def simulator(*args, **kwargs):
        made.append(Simulator(*args, **kwargs))
        return made[0]

    monkeypatch.setattr(bench, "Simulator", simulator)
    envs = gym.make_vec(env_id, num_envs=8, threads=1).unwrapped
    envs.reset(seed=0)
    actions = 0.2 * np.ones((8, *envs.single_action_space.shape), np.float32)
    engine, steps = bench._engine(envs.task, envs.scenes, actions, threads=1)
    engine()
    assert envs.execute_actions(actions).info["collision"].any()
    np.testing.assert_array_equal(made[0].batch.state, envs._simulator.batch.state)
    assert steps == envs.physics_steps
    envs.close()


def test_every_ratio_is_of_its_two_sides(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "TRAJECTORIES", 32)
    path = tmp_path / "bench.json"
    bench.run(BenchConfig(num_envs=8, repeats=1, workers=1, json=path))
    ratios = json.loads(path.read_text())
    assert len(ratios) == 7
    for name, ratio in ratios.items():
        assert ratio["measured"] > 0.0
        assert ratio["floor"] > 0.0
        assert ratio["ratio"] == pytest.approx(ratio["measured"] / ratio["floor"]), name
    units = sorted(ratio["unit"] for ratio in ratios.values())
    assert units == ["decisions/s"] * 2 + ["physics steps/s"] * 3 + ["us/trajectory"] * 2
    assert "make_vec" in capsys.readouterr().out
