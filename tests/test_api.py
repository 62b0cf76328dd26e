"""Public names of the three packages: complete, documented, typed, with examples that run; and the tour of them."""

import ast
import contextlib
import doctest
import enum
import importlib.util
import inspect
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

import viapoint.envs as ve
from viapoint import envs, primitives, training
from viapoint.envs import SHAPES
from viapoint.envs.arms import ARMS
from viapoint.envs.scenes import families
from viapoint.training import GeometrySearch, TrainConfig, ViaQ, ViaVecEnv, evaluate, load_agent, train
from viapoint.training.io.files import BadFileError

ENV, REPLANNING, STEPWISE = (
    f"viapoint/Planar{name}-v0" for name in ("Obstacles", "MovingObstacles", "ObstaclesStep")
)
PACKAGES = (primitives, envs, training)
ABSENT = set() if importlib.util.find_spec("viser") else {"LivePage"}
"""Exports of the extra `live`, which excludes the oldest versions of other packages."""
EXPORTS = [(package, name) for package in PACKAGES for name in package.__all__ if name not in ABSENT]
SMALL = {"learning_starts": 16, "gradient_steps": 1, "policy_kwargs": {"candidates": 8, "refinements": 0}}


def objects(condition):
    """Exported objects that fulfil a condition, as test parameters."""
    values = [(getattr(package, name), f"{package.__name__}.{name}") for package, name in EXPORTS]
    return [
        pytest.param(value, id=name)
        for value, name in values
        if callable(value) and value.__module__.startswith("viapoint") and condition(value)
    ]


def own_methods(cls):
    """Public methods of a class and its constructor, as this project defines them."""
    return [
        value.__func__ if isinstance(value, classmethod | staticmethod) else value
        for name, value in vars(cls).items()
        if (name == "__init__" or not name.startswith("_"))
        and (inspect.isfunction(value) or isinstance(value, classmethod | staticmethod))
        and (value.__func__ if not inspect.isfunction(value) else value).__module__.startswith("viapoint")
    ]


@pytest.mark.parametrize("package", PACKAGES)
def test_the_exports_are_sorted_and_exist(package):
    def order(name):  # constants, classes, functions, as ruff sorts them
        return (0 if name.isupper() else 1 if name[0].isupper() else 2), name

    assert package.__all__ == sorted(package.__all__, key=order)
    assert set(package.__all__) <= set(dir(package))
    for name in set(package.__all__) - ABSENT:
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


@pytest.mark.parametrize("package", [envs, training])
def test_type_checkers_see_what_is_imported_on_first_use(package):
    tree = ast.parse(Path(package.__file__).read_text())
    (typing,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.name: node.module for node in typing.body for alias in node.names}
    assert seen == package._MODULES
    eager = {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(package.__all__) - eager == set(seen)
    for name, module in ((name, module) for name, module in seen.items() if name not in ABSENT):
        assert getattr(package, name) is getattr(importlib.import_module(module), name)


@pytest.fixture
def registered_shapes():
    """Put the table of shapes back, to which an example may add a mesh."""
    before = dict(SHAPES)
    yield
    SHAPES.clear()
    SHAPES.update(before)


@pytest.mark.parametrize("value", objects(lambda value: True))
@pytest.mark.usefixtures("registered_shapes")
def test_examples_run(value, monkeypatch, ray_lock):
    monkeypatch.chdir(Path(__file__).parents[1])
    monkeypatch.setattr(families, "_FAMILIES", {d: dict(each) for d, each in families._FAMILIES.items()})
    value = type(value) if isinstance(value, enum.Enum) else value
    tests = doctest.DocTestFinder(recurse=False).find(value, globs={})
    assert any(test.examples for test in tests), "there is no example"
    runner = doctest.DocTestRunner()
    for test in tests:
        report = []
        with ray_lock if "RayVecEnv(" in test.docstring else contextlib.nullcontext():
            assert not runner.run(test, out=report.append).failed, "".join(report)


@pytest.mark.parametrize("value", objects(inspect.isfunction))
def test_functions_are_documented_and_typed(value):
    check_documented(value, inspect.getdoc(value))


@pytest.mark.parametrize("value", objects(inspect.isclass))
def test_classes_are_documented_and_typed(value):
    text = inspect.getdoc(value)
    assert text
    assert "\nExample" in text
    for method in own_methods(value):
        check_documented(method, text if method.__name__ == "__init__" else inspect.getdoc(method))


def check_documented(function, text):
    """Check that a text has a sentence for the function and one for each argument, all of which are typed."""
    assert text, function
    assert text.splitlines()[0].endswith("."), f"the first sentence of {function.__qualname__} is too long"
    signature = inspect.signature(function)
    assert function.__name__ == "__init__" or signature.return_annotation is not signature.empty
    for name, parameter in signature.parameters.items():
        if name in ("self", "cls") or name.startswith("_") or parameter.kind is parameter.VAR_KEYWORD:
            continue
        assert parameter.annotation is not parameter.empty, f"{function.__qualname__} has no type for {name}"
        if "\nArgs:\n" in text:
            assert f"\n    {name}: " in text.replace("**", ""), f"{function.__qualname__} lacks {name}"


def test_agents_are_loaded_by_id_run_and_model_folder(run):
    observation, _ = gym.make(ENV).reset(seed=3)
    shipped = load_agent(ENV)
    assert (shipped.env_id, shipped.env_kwargs) == (ENV, {})
    decided = load_agent(run.best).predict(observation, deterministic=True)[0]
    for source in (run.folder, str(run.folder), str(run.best)):
        again = load_agent(source).predict(observation, deterministic=True)[0]
        np.testing.assert_array_equal(again, decided)
    assert type(ViaQ.load(str(run.final))) is ViaQ


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("viapoint/Reach-v0", f"no agent is shipped for 'viapoint/Reach-v0'; .*{ENV}"),
        ("viapoint/Nothing-v0", f"there is no such folder; .*{ENV}"),
        (Path("nowhere"), "nowhere: is no run folder or model folder: there is no such folder"),
        (Path(__file__), "it is a file .*import-sb3"),
        (Path(__file__).parent, "it holds no config.json and no model.json"),
    ],
)
def test_what_is_no_agent_is_refused_with_those_that_there_are(source, reason):
    with pytest.raises(ValueError, match=reason):
        load_agent(source)


def test_an_algorithm_loads_its_own_agents_only(tmp_path):
    agent = train(
        TrainConfig(
            env=ENV,
            algo="sac",
            n_timesteps=8,
            n_envs=4,
            eval_every=0,
            out=tmp_path / "sac",
            progress=False,
            env_kwargs={"threads": 1},
        )
    )
    assert type(load_agent(agent.final)).__name__ == "SAC"
    with pytest.raises(ValueError, match=r"holds an agent of SAC, not of ViaQ; load_agent\(\) loads both"):
        ViaQ.load(agent.best)


def test_a_planned_movement_is_the_one_that_an_environment_executes():
    env = gym.make(ENV)
    agent = load_agent(ENV)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        (scene,) = (env.unwrapped.batch.scenes.take([0]),)
        present = scene.obstacles[0][scene.present[0]]
        plan = agent.plan(start=scene.start[0], goal=scene.goal[0], obstacles=present)
        env.step(agent.predict(observation, deterministic=True)[0])
        executed = env.unwrapped.last_plan
        duration = plan.durations.sum()
        np.testing.assert_allclose(plan.waypoints, executed.waypoints, atol=1e-6)
        assert executed.durations.sum() == pytest.approx(duration)
        ends = plan.trajectory()(np.array([0.0, duration]))
        np.testing.assert_allclose(ends, [scene.start[0], scene.goal[0]], atol=1e-9)


@pytest.mark.parametrize(
    ("env_id", "arguments", "reason"),
    [
        (ENV, {"obstacles": [(0.0, 0.35, 0.0, 0.0, 0.01)] * 6}, "at most 5 rows, as in .*, got 6"),
        (ENV, {"obstacles": [(0.0, 0.35, 0.03)]}, r"obstacles must have shape \(n, 5\)"),
        (ENV, {"start": (0.0, 9.0)}, "start"),
        (ENV, {"goal": (np.nan, 0.3)}, "goal must be finite"),
        ("viapoint/PlanarReach-v0", {"obstacles": [(0.0, 0.35, 0.0, 0.0, 0.03)]}, "at most 0 rows"),
        (REPLANNING, {}, "whole movements; in viapoint/PlanarMovingObstacles-v0"),
    ],
)
def test_what_cannot_be_planned_is_refused(env_id, arguments, reason):
    with pytest.raises(ValueError, match=reason):
        load_agent(env_id).plan(**{"start": (-0.2, 0.3), "goal": (0.1, 0.4), **arguments})


def test_an_evaluation_has_one_row_for_each_method_and_number_of_checks():
    search = GeometrySearch(ENV, 8)
    result = evaluate(ENV, checks=(0, 4), baselines=["untrained", search], n_scenes=10)
    names = [row["method"] for row in result.rows]
    assert names == ["agent", "agent, 4 checks", "untrained", "untrained, 4 checks", "search, 8 checks"]
    low, high = result.success_interval
    assert low < result.success_rate < high or result.success_rate == high
    assert result.to_dict()["methods"]["agent"]["success"]["rate"] == result.success_rate
    assert all(name in result.to_markdown() for name in names)
    alone = evaluate(search, env=ENV, n_scenes=10)
    assert alone.success_rate == result.rows[-1]["success"]["rate"]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({}, "env must be the id"),
        ({"env": ENV}, "nothing to evaluate"),
        ({"env": ENV, "baselines": ["magic"]}, "baselines in .* must be some of straight, .* got 'magic'"),
        ({"env": ENV, "baselines": ["untrained"]}, "untrained with an agent, got 'untrained'"),
        ({"agent": ENV, "env": REPLANNING}, f"env must be {ENV}"),
        ({"agent": ENV, "scenes": "nowhere.npz"}, "scenes must be one of"),
        ({"env": "viapoint/Nothing-v0", "baselines": ["straight"]}, "there is no environment"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(arguments, reason):
    with pytest.raises(ValueError, match=reason):
        evaluate(**arguments)


@pytest.mark.parametrize(
    "make",
    [lambda: ViaVecEnv(ENV, 4, n_obstacles=2), lambda: make_vec_env(ENV, 4, env_kwargs={"n_obstacles": 2})],
)
def test_the_algorithm_is_used_as_those_of_stable_baselines(make, tmp_path):
    env = make()
    callback = CheckpointCallback(save_freq=8, save_path=str(tmp_path), name_prefix="agent")
    agent = ViaQ("ViaQPolicy", env, seed=0, **SMALL).learn(40, callback)
    assert (agent.env_id, agent.env_kwargs) == (ENV, {"n_obstacles": 2})
    observation = env.reset()
    for path in (tmp_path / "agent_32_steps", str(tmp_path / "agent_32_steps.zip")):
        again = ViaQ.load(path, env=env)
        assert again.num_timesteps == 32
        assert again.predict(observation)[0].shape == (4, 3)
    again.learn(8, reset_num_timesteps=False)
    assert again.num_timesteps == 40
    env.close()


def test_an_agent_of_another_environment_is_not_saved(tmp_path):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(gym.make(ENV).unwrapped, 5), 1)
    agent = ViaQ("ViaQPolicy", env, **SMALL)
    env.envs[0].unwrapped.spec = None
    with pytest.raises(ValueError, match="must be one of this package"):
        agent.save(tmp_path / "agent")
    assert not (tmp_path / "agent").exists()


def test_training_takes_callbacks_of_stable_baselines(run, tmp_path):
    callbacks = [CheckpointCallback(8, str(tmp_path), name_prefix=name) for name in "abc"]
    for number, callback in enumerate((callbacks[0], callbacks[1:2], CallbackList(callbacks[2:]))):
        config = TrainConfig(
            env=ENV, n_timesteps=64, n_envs=4, eval_every=0, out=tmp_path / str(number), progress=False,
            env_kwargs={"threads": 1}, hyperparameters=SMALL,
        )  # fmt: skip
        trained = train(config, callback)
        assert trained.best == trained.final == tmp_path / str(number) / "final"
    assert sorted(path.name for path in tmp_path.glob("?_64_steps")) == [f"{name}_64_steps" for name in "abc"]
    with pytest.raises(BadFileError, match="no run folder"):
        training.Run(tmp_path)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = TrainConfig(
        env=ENV, n_timesteps=64, n_envs=32, eval_every=64, eval_scenes=8, progress=False,
        out=str(tmp_path_factory.mktemp("runs") / "first"), env_kwargs={"threads": 1}, hyperparameters=SMALL,
    )  # fmt: skip
    return train(config)


def test_the_tour(tmp_path, monkeypatch):
    """Everything that a user types, from the first episode to an agent of an arm of one's own."""
    env = gym.make(ENV)
    obs, _ = env.reset(seed=3)

    agent = load_agent(ENV)
    action, _ = agent.predict(obs, deterministic=True)
    obs, reward, terminated, truncated, info = env.step(action)
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    assert reward > 0.0
    plan = env.unwrapped.last_plan
    trajectory = plan.trajectory()
    assert trajectory(0.0).shape == (2,)

    plan = agent.plan(start=(-0.2, 0.3), goal=(0.1, 0.4), obstacles=[(-0.05, 0.35, 0.0, 0.0, 0.03)])
    assert plan.waypoints.shape == (3, 2)

    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    arm = ve.load_arm(
        str(Path(__file__).parents[1] / "docs" / "ur5e.xml"), hand_site="hand", joints=joints, name="tour",
        home=(0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28),
    )  # fmt: skip
    monkeypatch.setitem(ARMS, "tour", arm)  # so that no other test finds it
    ve.register_arm(arm)
    points = np.mean(arm.workspace, axis=0)
    np.testing.assert_allclose(arm.hand_position(arm.inverse_kinematics(points)), points, atol=1e-6)

    def build_post(uniforms, site):
        centre = 0.5 * (site.start + site.goal)
        return np.concatenate((centre, np.zeros_like(centre), 0.02 + 0.0 * uniforms.take(1)), axis=-1)[
            :, None
        ]

    monkeypatch.setattr(families, "_FAMILIES", {d: dict(each) for d, each in families._FAMILIES.items()})
    ve.register_scene_family("post", build_post, n_obstacles=1)

    config = TrainConfig(
        env="viapoint/Obstacles-v0", env_kwargs={"arm": arm.name}, n_timesteps=32, n_envs=16, eval_every=0,
        out=str(tmp_path / "first"), progress=False, hyperparameters=SMALL,
    )  # fmt: skip
    run = train(config)
    result = evaluate(run.best, baselines=["straight"], scenes="test", n_scenes=2)
    assert 0.0 <= result.success_rate <= 1.0
    assert "straight line" in result.to_markdown()
    load_agent(run.folder).save(tmp_path / "my_agent")
    assert ViaQ.load(tmp_path / "my_agent").env_kwargs == {"arm": "tour"}
