"""Observed candidates are the plans of a search: their margins are computed once, and alike in every form."""

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env

from viapoint.envs.geometry.obstacles import unpack
from viapoint.training import (
    ObserveCandidates,
    TrainConfig,
    VectorObserveCandidates,
    ViaVecEnv,
    load_agent,
)
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.observe_candidates import BOUND
from viapoint.training.rollouts.vec_env import observed_candidates
from viapoint.training.runs.trainer import train

ENV, IN_SPACE, REPLANNING = (
    f"viapoint/{name}-v0" for name in ("PlanarObstacles", "PandaObstacles", "PlanarMovingObstacles")
)
TINY = {
    "sac": {"learning_starts": 32, "gradient_steps": 1, "batch_size": 16, "buffer_size": 64},
    "ppo": {"n_steps": 2, "batch_size": 16, "n_epochs": 1},
}


@pytest.mark.parametrize("env_id", [ENV, IN_SPACE])
def test_the_sign_of_a_margin_tells_whether_the_candidate_succeeds(env_id):
    envs = VectorObserveCandidates(gym.make_vec(env_id, num_envs=64, threads=1), 4)
    observation, _ = envs.reset(seed=0)
    margins, scenes = observation["candidates"], envs.unwrapped.scenes
    actions = candidate_actions(envs.unwrapped.task, 4, replanning=False)
    assert np.abs(margins).max() <= BOUND
    assert (margins[:, 0] < 0.0).all()  # the straight movement
    for k in range(1, 4):
        envs.unwrapped.begin(scenes)
        success = envs.unwrapped.execute_actions(np.tile(actions[k], (64, 1))).info["is_success"]
        clear = (margins[:, k] < -0.006) | (margins[:, k] > 0.003)  # spheres are up to 5 mm outside the arm
        np.testing.assert_array_equal(success[clear], margins[clear, k] > 0.0)
    assert (margins[:, 1:] > 0.003).any()


@pytest.mark.parametrize("env_id", [ENV, REPLANNING])
def test_single_and_vector_form_see_the_same_in_whole_episodes(env_id):
    envs = VectorObserveCandidates(gym.make_vec(env_id, num_envs=2, threads=1), 8)
    single = ObserveCandidates(gym.make(env_id), 8)
    many, _ = envs.reset(seed=[3, 4])
    one, _ = single.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2, envs.single_action_space.shape[0]))
    for action in actions.astype(np.float32):
        for name in one:
            np.testing.assert_array_equal(one[name], many[name][0], err_msg=name)
        many, *_, info = envs.step(action)
        one, _, terminated, truncated, _ = single.step(action[0])
        if terminated or truncated:
            final = info["final_obs"][0]
            for name in one:
                np.testing.assert_array_equal(one[name], final[name], err_msg=name)
            assert (one["candidates"] == 0.0).all() == terminated
            return
    pytest.fail("the episode does not end")


class Cut(gym.vector.VectorWrapper):
    """Vector environment whose episodes are truncated where they would terminate."""

    def step(self, actions):
        observation, reward, terminated, truncated, info = self.env.step(actions)
        return observation, reward, np.zeros_like(terminated), terminated | truncated, info


def test_after_a_truncation_candidates_are_computed_as_values_go_on_from_there():
    single = ObserveCandidates(gym.make("viapoint/PlanarTargetJump-v0", max_episode_steps=1), 8)
    single.reset(seed=0)
    observation, _, terminated, truncated, _ = single.step(np.zeros(3, np.float32))
    assert (terminated, truncated) == (False, True)
    assert observation["candidates"].any()
    envs = VectorObserveCandidates(Cut(gym.make_vec(REPLANNING, num_envs=1, threads=1)), 8)
    envs.reset(seed=0)
    truncated = [False]
    while not truncated[0]:
        *_, truncated, info = envs.step(np.zeros((1, 3), np.float32))
    assert info["final_obs"][0]["candidates"].any()


def test_the_wrapper_is_an_environment_and_its_record_makes_it_again():
    check_env(ObserveCandidates(gym.make(ENV), 8), skip_render_check=True)
    again = gym.make(ObserveCandidates(gym.make(ENV), 8).spec)
    assert again.observation_space["candidates"].shape == (8,)


@pytest.mark.parametrize("algo", TINY)
def test_a_trained_agent_computes_the_candidates_wherever_it_decides(algo, tmp_path):
    settings = {"n_timesteps": 64, "n_envs": 16, "eval_scenes": 8, "env_kwargs": {"threads": 1}}
    settings |= {"observe_candidates": 12, "hyperparameters": TINY[algo], "progress": False}
    run = train(TrainConfig(algo=algo, out=tmp_path / "run", **settings))
    agent = load_agent(run.folder)
    assert observed_candidates(agent.get_env()) == 12
    assert agent.env_kwargs == {"threads": 1}
    plain, wrapped = gym.make(ENV), ObserveCandidates(gym.make(ENV), 12)
    seen, known = plain.reset(seed=5)[0], wrapped.reset(seed=5)[0]
    action, _ = agent.predict(seen, deterministic=True)
    np.testing.assert_array_equal(action, agent.predict(known, deterministic=True)[0])
    batch = {name: np.stack((part, part)) for name, part in seen.items()}
    np.testing.assert_allclose(agent.predict(batch, deterministic=True)[0], [action, action], atol=1e-6)
    scenes, task = plain.unwrapped.batch.scenes, plain.unwrapped.task
    plan = agent.plan(seen["hand"], seen["goal"], unpack(scenes.obstacles, 0))
    start, goal = task.space.coordinates(scenes.start), task.space.coordinates(scenes.goal)
    expected = task.action.decode(action[None].astype(float), start, goal).take(0)
    np.testing.assert_allclose(plan.waypoints, expected.waypoints, atol=1e-4)
    longer = train(TrainConfig(out=run.folder, resume=True, n_timesteps=96, progress=False))
    assert longer.config.observe_candidates == 12


def test_plain_stable_baselines3_learns_with_it():
    env = make_vec_env(ENV, 2, wrapper_class=ObserveCandidates, wrapper_kwargs={"n_candidates": 4})
    assert observed_candidates(env) == 4
    stable_baselines3.PPO("MultiInputPolicy", env, n_steps=4, batch_size=8).learn(8)
    env = ViaVecEnv(ENV, 4, seed=0, observe_candidates=4, threads=1)
    stable_baselines3.SAC("MultiInputPolicy", env, learning_starts=4, buffer_size=16).learn(8)
