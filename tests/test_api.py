"""Public packages: their examples run, and what users do with agents works as they are used to."""

import doctest
import enum
import inspect
import itertools
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

from viapoint import envs, primitives, training
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.scenes import families_registry
from viapoint.training import GeometrySearch, TrainConfig, ViaQ, ViaVecEnv, evaluate, load_agent, train

ROOT = Path(__file__).parents[1]
ENV = "viapoint/PlanarObstacles-v0"
EXPORTS = [(package, name) for package in (primitives, envs, training) for name in package.__all__]
SMALL = {"learning_starts": 16, "gradient_steps": 1, "policy_kwargs": {"candidates": 8, "refinements": 0}}


@pytest.fixture
def registered(monkeypatch):
    """Leave shapes and families as they were, to which an example may add."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(families_registry, "FAMILIES", dict(families_registry.FAMILIES))


@pytest.mark.parametrize(("package", "name"), EXPORTS)
@pytest.mark.usefixtures("registered")
def test_examples_run(package, name):
    try:
        value = getattr(package, name)
    except ImportError:
        pytest.skip(f"{name} needs an extra")
    if name == "run_study":
        return  # tests/training/test_study.py runs it, where a Ray is there
    value = type(value) if isinstance(value, enum.Enum) else value
    if not (inspect.isclass(value) or inspect.isfunction(value)):
        return
    tests = doctest.DocTestFinder().find(value, name, globs={})
    assert any(test.examples for test in tests), f"{name} has no example"
    for test in tests:
        report = []
        assert not doctest.DocTestRunner().run(test, out=report.append).failed, "".join(report)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "first"
    options = {"eval_every": 64, "eval_scenes": 8, "progress": False, "env_kwargs": {"threads": 1}}
    return train(
        TrainConfig(env=ENV, n_timesteps=64, n_envs=32, out=folder, hyperparameters=SMALL, **options)
    )


def test_agents_are_loaded_by_id_run_and_model_folder(run):
    observation, _ = gym.make(ENV).reset(seed=3)
    decided = load_agent(run.best).predict(observation, deterministic=True)[0]
    for source in (run.folder, str(run.folder), str(run.best)):
        np.testing.assert_array_equal(load_agent(source).predict(observation, deterministic=True)[0], decided)
    assert (load_agent(ENV).env_id, load_agent(ENV).env_kwargs) == (ENV, {})
    assert type(ViaQ.load(str(run.final))) is ViaQ


def test_a_planned_movement_is_the_one_that_an_environment_executes():
    shapes = ("capsule", "box", "cylinder")
    env = gym.make(ENV, shapes=shapes).unwrapped
    agent = ViaQ("ViaQPolicy", ViaVecEnv(ENV, 4, seed=0, threads=1, shapes=shapes), seed=0)
    search = GeometrySearch(ENV, 256, shapes=shapes)
    for method, seed in itertools.product((agent, search), range(3)):
        observation, _ = env.reset(seed=seed)
        scene = env.batch.scenes
        start, goal = env.task.space.coordinates(np.concatenate((scene.start, scene.goal)))
        plan = method.plan(start=start, goal=goal, obstacles=unpack(scene.obstacles, 0))
        env.step(method.predict(observation, deterministic=True)[0])
        np.testing.assert_allclose(plan.waypoints, env.last_plan.waypoints, atol=1e-6)
        np.testing.assert_allclose(plan.durations, env.last_plan.durations, atol=1e-6)
        ends = plan.trajectory()(np.array([0.0, plan.durations.sum()]))
        np.testing.assert_allclose(ends, [start, goal], atol=1e-9)


def test_an_evaluation_has_one_row_for_each_method_and_number_of_checks():
    search = GeometrySearch(ENV, 8)
    result = evaluate(ENV, checks=(0, 4), baselines=["untrained", search], n_scenes=10)
    names = [row["method"] for row in result.rows]
    assert names == ["agent", "agent, 4 checks", "untrained", "untrained, 4 checks", "sobol8"]
    low, high = result.success_interval
    assert low <= result.success_rate <= high
    assert result.to_dict()["methods"]["agent"]["success"]["rate"] == result.success_rate
    assert evaluate(search, env=ENV, n_scenes=10).success_rate == result.rows[-1]["success"]["rate"]


@pytest.mark.parametrize(
    "make",
    [lambda: ViaVecEnv(ENV, 4, n_obstacles=2), lambda: make_vec_env(ENV, 4, env_kwargs={"n_obstacles": 2})],
)
def test_the_algorithm_is_used_as_those_of_stable_baselines(make, tmp_path):
    env = make()
    callback = CheckpointCallback(save_freq=8, save_path=str(tmp_path), name_prefix="agent")
    agent = ViaQ("ViaQPolicy", env, seed=0, **SMALL).learn(40, CallbackList([callback]))
    assert (agent.env_id, agent.env_kwargs) == (ENV, {"n_obstacles": 2})
    for path in (tmp_path / "agent_32_steps", str(tmp_path / "agent_32_steps.zip")):
        again = ViaQ.load(path, env=env)
        assert again.num_timesteps == 32
        assert again.predict(env.reset())[0].shape == (4, 3)
    again.learn(8, reset_num_timesteps=False)
    assert again.num_timesteps == 40
    env.close()
