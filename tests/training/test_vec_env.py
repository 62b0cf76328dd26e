"""SB3's view of the environment is the environment; laws of the features with which its algorithms see a scene."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from helpers import JUMPS, PANDA, PLANE, REACH, STEP
from stable_baselines3.common.monitor import Monitor

from viapoint.envs import obstacles_to_json, scene_from_json, scene_to_json
from viapoint.envs.geometry.obstacles import POSE_SIZE
from viapoint.envs.registration import check_registered
from viapoint.training import Run, SceneExtractor, Study, TrainConfig, ViaVecEnv, evaluate, load_agent, train
from viapoint.training.agents.agent import find_model
from viapoint.training.cli import commands
from viapoint.training.configs import EvaluateConfig
from viapoint.training.files import BadFileError
from viapoint.training.trainer import _resume_command


def actions(env, seed=0):
    generator = np.random.default_rng(seed)
    return generator.uniform(-0.5, 0.5, (env.num_envs, *env.action_space.shape)).astype(np.float32)


@pytest.mark.parametrize(("env_id", "steps"), [(PLANE, 3), (STEP, 100)])
def test_it_is_the_vector_environment(env_id, steps):
    env, native = ViaVecEnv(env_id, 6, seed=3, threads=1), gym.make_vec(env_id, num_envs=6, threads=1)
    expected, _ = native.reset(seed=3)
    observed = env.reset()
    returns, lengths, ended = np.zeros(6), np.zeros(6, int), 0
    for step in range(steps):
        for name in expected:
            np.testing.assert_array_equal(observed[name], expected[name])
        expected, reward, terminated, truncated, info = native.step(actions(env, step))
        observed, mine, done, infos = env.step(actions(env, step))
        np.testing.assert_array_equal(mine, reward.astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        returns += reward
        lengths += 1
        for i, told in enumerate(infos):
            reported = info["final_info"] if done[i] else info
            for name in reported:
                if not name.startswith(("_", "final_")):
                    np.testing.assert_equal(told[name], reported[name][i])
        for i in np.flatnonzero(done):
            told = infos[i]
            assert told["is_success"] is bool(info["final_info"]["is_success"][i])
            assert told["TimeLimit.truncated"] is bool(truncated[i] and not terminated[i])
            assert (told["episode"]["r"], told["episode"]["l"]) == (pytest.approx(returns[i]), lengths[i])
            for name, part in info["final_obs"][i].items():
                np.testing.assert_array_equal(told["terminal_observation"][name], part)
        ended += done.sum()
        returns[done], lengths[done] = 0.0, 0
    assert ended >= 12
    assert env.physics_steps == native.unwrapped.physics_steps > 0
    native.close()
    env.close()


def register(*, control_step=0.04, **kwargs):
    """Register an id of one's own for the test alone."""
    usual = {"arm": "planar", "decide_at": "steps", "control_step": control_step}
    spec = EnvSpec("me/Own-v0", "viapoint.envs.env:ReachEnv", kwargs=usual, **kwargs)
    gym.registry[spec.id] = spec
    return spec.id


def test_an_own_id_has_the_limit_of_decisions_of_gymnasium(tmp_path, monkeypatch):
    vector = "viapoint.envs.vector_env:ReachVectorEnv"
    env_id = register(vector_entry_point=vector, max_episode_steps=3)
    env = ViaVecEnv(env_id, 2, seed=0, threads=1)
    env.reset()
    cut = [[info["TimeLimit.truncated"] for info in env.step(actions(env))[-1]] for _ in range(6)]
    assert cut == 2 * [[False] * 2, [False] * 2, [True] * 2]
    settings = {"n_timesteps": 16, "n_envs": 2, "eval_scenes": 4, "progress": False}
    settings["hyperparameters"] = {"n_steps": 4, "batch_size": 8}
    run = train(TrainConfig(env=env_id, algo="ppo", out=tmp_path / "run", **settings))
    result = evaluate(run.folder, scenes="validation", n_scenes=4)
    with monkeypatch.context() as patch:
        patch.delitem(gym.registry, env_id)  # where the model is loaded, the id need not be known
        again = evaluate(run.best, scenes="validation", n_scenes=4)
        commands.evaluate(
            EvaluateConfig(agent=str(run.folder), scenes="validation", n_scenes=4, baselines=())
        )
        with pytest.raises(BadFileError, match=f"'{env_id}'; name the module") as raised:
            Run(run.folder)  # but it must be to go on
    assert "written by" not in str(raised.value)
    assert len(list((run.folder / "evaluations").iterdir())) == 1
    for each in (result, again):
        assert each.env_id == env_id
        assert (each.results[0].outcomes["decisions"] == 3).all()
    register(vector_entry_point=vector, control_step=0.08)  # nor another task by this id
    with pytest.raises(BadFileError):
        load_agent(run.folder)


def test_an_id_may_name_the_module_that_registers_it(tmp_path, monkeypatch):
    spec = "'viapoint.envs.env:ReachEnv', vector_entry_point='viapoint.envs.vector_env:ReachVectorEnv'"
    (tmp_path / "own_ids.py").write_text(f"import gymnasium\ngymnasium.register('me/Named-v0', {spec})\n")
    monkeypatch.syspath_prepend(tmp_path)
    named = "own_ids:me/Named-v0"
    assert TrainConfig(env=named).env == EvaluateConfig(env=named).env == "me/Named-v0"
    assert ViaVecEnv(named, 1).env_id == check_registered(named) == "me/Named-v0"
    measured = evaluate(env=named, baselines=["straight"], scenes="validation", n_scenes=2)
    assert measured.env_id == "me/Named-v0"
    run = Run.create(TrainConfig(env=named, out=tmp_path / "run"))
    assert all(f"--env {named}" in command for command in (run.config.command, _resume_command(run)))
    study = Study.from_dict({"environments": [named], "baselines": ["straight"], "scenes": ["validation"]})
    assert study.trials[0].env_id == named  # workers import it
    assert find_model(f"viapoint.envs:{PLANE}") == find_model(PLANE)
    for wrong in ("own_idz:me/Named-v0", "own_ids:me/Named-v1", "me Named", 3):
        with pytest.raises(ValueError):
            check_registered(wrong)


def test_an_own_id_needs_a_vector_environment():
    env_id = register()
    for refused in (lambda: TrainConfig(env=env_id), lambda: evaluate(env=env_id, baselines=["straight"])):
        with pytest.raises(ValueError):
            refused()


def test_seeds_options_and_attributes(env):
    env.seed(5)
    first = env.reset()
    assert any((first[name] != part).any() for name, part in env.reset().items())
    env.seed(5)
    again = env.reset()
    assert all((first[name] == part).all() for name, part in again.items())
    native = env.venv.unwrapped
    scenes = [
        scene_from_json(scene_to_json(native.scenes, native.task.arm, native.task.space_name, scene=row))
        for row in range(6)
    ]
    env.set_options(scenes[0])
    assert np.ptp(env.reset()["goal"], axis=0).max() == 0.0
    texts = [{**scene, "obstacles": obstacles_to_json(scene["obstacles"])} for scene in scenes]
    for options in (scenes, texts):
        env.set_options(options)
        for name, part in env.reset().items():
            np.testing.assert_allclose(part, first[name], atol=1e-6)
    env.set_options({**texts[0], "reset_mask": np.arange(6) > 3})
    some = env.reset()["obstacles"]
    np.testing.assert_allclose(some, first["obstacles"][[0, 1, 2, 3, 0, 0]], atol=1e-6)
    goals = [{"goal": scene["goal"]} for scene in scenes]
    env.seed(5)
    env.set_options([scenes[0], {}, goals[2], goals[3], {}, scenes[5]])  # as SB3's own environments allow
    some = env.reset()
    np.testing.assert_allclose(some["goal"][[0, 2, 3, 5]], first["goal"][[0, 2, 3, 5]], atol=1e-6)
    np.testing.assert_allclose(some["obstacles"][[0, 1, 4, 5]], first["obstacles"][[0, 1, 4, 5]], atol=1e-6)
    assert env.get_attr("num_envs", [-1, 5]) == [6, 6]
    env.set_attr("mark", 1)
    assert env.get_attr("mark", indices=[2, 3]) == [1, 1]
    assert env.env_is_wrapped(Monitor) == [True] * 6  # as the infos tell what a monitor tells
    assert env.env_method("__str__", indices=1) == [str(env.venv.unwrapped)]


ENDS = 7
"""Features of start and goal: middle and line of both, and their distance."""


def observed(env_id, number=16):
    env = ViaVecEnv(env_id, number, seed=0)
    env.reset()
    observation, *_ = env.step(np.full((number, env.action_space.shape[0]), 0.3))
    env.close()
    torch.manual_seed(0)
    extractor = SceneExtractor(env.observation_space).double()
    return extractor, {name: torch.from_numpy(part).double() for name, part in observation.items()}


def rows_of(extractor, observation):
    return observation["obstacles"].reshape(-1, extractor.n_rows, extractor.row_size).clone()


def turned(vectors, turn):
    """Return vectors of two or three components that are turned about the vertical axis."""
    result = vectors.clone()
    result[..., :2] = vectors[..., :2] @ turn.T
    return result


@pytest.mark.parametrize("env_id", [REACH, PLANE, STEP, PANDA, JUMPS])
def test_features_are_as_many_as_stated_and_of_size_one(env_id):
    """Also where the hand is at the goal, as it may be after the last step of an episode."""
    extractor, observation = observed(env_id)
    for seen in (observation, {**observation, "hand": observation["goal"]}):
        for dtype in (torch.float64, torch.float32):
            features = extractor.to(dtype)({name: part.to(dtype) for name, part in seen.items()})
            assert features.shape == (16, extractor.features_dim)
            assert torch.isfinite(features).all()
            assert features.abs().max() < 10.0


@pytest.mark.parametrize("env_id", [PLANE, STEP])
def test_the_order_of_obstacles_does_not_matter(env_id):
    extractor, observation = observed(env_id)
    changed = rows_of(extractor, observation).flip(1)
    after = extractor({**observation, "obstacles": changed.flatten(1)})
    torch.testing.assert_close(after, extractor(observation))


def test_every_obstacle_that_is_there_matters_and_no_other():
    extractor, observation = observed(PLANE)
    before, present = extractor(observation), rows_of(extractor, observation)[..., -1] > 0.5
    assert present.any()
    assert not present.all()
    centre = extractor.row_size - POSE_SIZE
    for row in range(extractor.n_rows):
        moved = rows_of(extractor, observation)
        moved[:, row, centre : centre + 2] += 0.05
        after = extractor({**observation, "obstacles": moved.flatten(1)})
        different = ((after - before).abs() > 1e-9).any(dim=-1)
        assert (different == present[:, row]).all()


def test_a_turn_about_the_base_changes_only_the_features_of_start_and_goal():
    extractor, observation = observed(STEP)
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    other = dict(observation)
    for name in ("hand", "goal", "velocity", "acceleration"):
        other[name] = turned(observation[name], turn)
    rows = rows_of(extractor, observation)
    first = extractor.row_size - POSE_SIZE
    for offset in (0, 3, 6, 12):  # centre, two axes and velocity
        part = slice(first + offset, first + offset + 3)
        rows[..., part] = turned(rows[..., part], turn)
    other["obstacles"] = rows.flatten(1)
    extractor.each[0].weight.data[:, -ENDS:-1] = 0.0  # each obstacle is told where start and goal are
    before, after = extractor(observation), extractor(other)
    torch.testing.assert_close(after[:, ENDS - 1 :], before[:, ENDS - 1 :])
