"""Searches, planners and agents in scenes with obstacles of any shape."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC

from viapoint.envs import Box, Cylinder
from viapoint.training import GeometrySearch, SceneExtractor, ViaQ, ViaVecEnv
from viapoint.training.planning.baselines import make_method

PLANE, MOVING = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"
SHAPES = ("capsule", "box", "cylinder")
OBSTACLES = [
    Box((0.02, 0.06, 0.04), position=(-0.02, 0.35, 0.0)),
    Cylinder(0.02, 0.04, position=(0.25, 0.5, 0.0)),
]
ENDS = {"start": (-0.2, 0.35), "goal": (0.15, 0.35)}


def test_plans_without_an_environment_are_those_of_an_environment():
    env = gym.make(PLANE, shapes=SHAPES).unwrapped
    observation, _ = env.reset(options={**ENDS, "obstacles": OBSTACLES})
    search = GeometrySearch(PLANE, 256, shapes=SHAPES)
    agent = ViaQ("ViaQPolicy", ViaVecEnv(PLANE, 4, seed=0, threads=1, shapes=SHAPES), seed=0)
    given = [OBSTACLES[0].to_dict(), OBSTACLES[1]]
    for method in (agent, search):
        action, _ = method.predict(observation, deterministic=True)
        env.reset(options={**ENDS, "obstacles": OBSTACLES})
        *_, info = env.step(action)
        plan = method.plan(**ENDS, obstacles=given)
        np.testing.assert_allclose(env.last_plan.waypoints, plan.waypoints, atol=1e-5)
    assert info["is_success"]
    with pytest.raises(ValueError):
        GeometrySearch(PLANE, 8, shapes="cylinder").plan(**ENDS, obstacles=OBSTACLES)
    env.close()


def test_the_motion_planner_solves_a_scene_with_a_box():
    pytest.importorskip("ompl")
    env = gym.make(PLANE, shapes=SHAPES).unwrapped
    env.reset(options={**ENDS, "obstacles": OBSTACLES})
    scenes = env.batch.scenes
    method = make_method("ompl", PLANE, shapes=SHAPES)
    assert method.execute(scenes, method.decide({}, scenes)).success.all()
    env.close()


@pytest.mark.parametrize("env_id", [PLANE, MOVING])
def test_algorithms_learn_from_rows_of_shapes(env_id):
    env = ViaVecEnv(env_id, 8, seed=0, threads=1, shapes=SHAPES)
    for algorithm, settings in ((SAC, {"learning_starts": 8}), (PPO, {"n_steps": 2, "n_epochs": 1})):
        extractor = {"features_extractor_class": SceneExtractor}
        algorithm("MultiInputPolicy", env, batch_size=8, policy_kwargs=extractor, **settings).learn(16)
    small = {"candidates": 16, "refinements": 1, "per_refinement": 8, "width": 8}
    ViaQ("ViaQPolicy", env, learning_starts=8, batch_size=8, policy_kwargs=small).learn(16)
    env.close()
