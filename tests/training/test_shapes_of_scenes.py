"""Searches, planners and agents in scenes with obstacles of any shape."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC

from viapoint.envs import Box, Cylinder, obstacles_from_rows
from viapoint.envs.rendering.overlay import Movement
from viapoint.training import GeometrySearch, SceneExtractor, ViaQ, ViaVecEnv
from viapoint.training.planning.cma_planner import Planner, PlannerBudget
from viapoint.training.planning.plan_checks import check_plans
from viapoint.training.planning.planned_movements import take_rows
from viapoint.training.plotting.top_view import widened_outline
from viapoint.training.rollouts.rollout import SceneSimulation

PANDA, PLANE, WHOLE, MOVING = (
    "viapoint/PandaObstacles-v0",
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArm-v0",
    "viapoint/PlanarMovingObstacles-v0",
)
SHAPES = ("capsule", "box", "cylinder")
WALL = Box((0.02, 0.06, 0.2), position=(-0.02, 0.35, 0.0))
CAN = Cylinder(0.02, 0.1, position=(0.25, 0.5, 0.0))
ENDS = {"start": (-0.2, 0.35), "goal": (0.15, 0.35)}


def test_checks_of_one_plan_are_those_of_a_batch():
    envs = gym.make_vec(PANDA, num_envs=24, threads=1).unwrapped
    observation, _ = envs.reset(seed=2)
    actions = 0.3 * np.random.default_rng(0).uniform(-1.0, 1.0, (24, 1, 4)).astype(np.float32)
    together = check_plans(observation, actions, envs.task, max_refined=0.01).clearance
    alone = [
        check_plans(take_rows(observation, slice(i, i + 1)), actions[i, None], envs.task, max_refined=0.01)
        for i in range(24)
    ]
    np.testing.assert_allclose(np.concatenate([each.clearance for each in alone]), together, atol=1e-6)
    envs.close()


def test_plans_without_an_environment_are_those_of_an_environment():
    env = gym.make(PLANE, shapes=SHAPES).unwrapped
    observation, _ = env.reset(options={**ENDS, "obstacles": [WALL, CAN]})
    search = GeometrySearch(PLANE, 256, shapes=SHAPES)
    plan = search.plan(**ENDS, obstacles=[WALL.to_dict(), CAN])
    action, _ = search.predict(observation)
    *_, info = env.step(action)
    assert info["is_success"]
    np.testing.assert_allclose(env.last_plan.waypoints, plan.waypoints, atol=1e-5)
    agent = ViaQ("ViaQPolicy", ViaVecEnv(PLANE, 4, seed=0, threads=1, shapes=SHAPES), seed=0)
    action, _ = agent.predict(observation, deterministic=True)
    env.reset(options={**ENDS, "obstacles": [WALL, CAN]})
    env.step(action)
    np.testing.assert_allclose(
        agent.plan(**ENDS, obstacles=[WALL, CAN]).waypoints, env.last_plan.waypoints, atol=1e-5
    )
    with pytest.raises(ValueError):
        GeometrySearch(PLANE, 8).plan(**ENDS, obstacles=[WALL])
    env.close()


def test_planners_solve_a_scene_with_a_box():
    simulation = SceneSimulation(PLANE, 64, shapes=SHAPES, threads=1)
    env = gym.make(PLANE, shapes=SHAPES).unwrapped
    env.reset(options={**ENDS, "obstacles": [WALL, CAN]})
    scenes = env.batch.scenes
    found = Planner(simulation, budget=PlannerBudget(first=64, generations=1))(scenes)
    assert found.success.all()
    pytest.importorskip("ompl")
    from viapoint.training.planning.ompl_planner import MotionPlanner

    plan = MotionPlanner(simulation).plan(scenes)
    assert simulation.execute_plan(scenes, plan).success.all()
    simulation.close()
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


def test_movements_and_outlines_of_shapes_are_drawn():
    env = gym.make(WHOLE, shapes=SHAPES, render_mode="rgb_array", width=64, height=64).unwrapped
    env.reset(seed=2)
    scenes = env.batch.scenes
    *_, info = env.step(np.zeros(3))
    rollout = env.batch.last_rollout[0]
    movement = Movement.of(env.task.collision_model, scenes, env.last_plan, rollout)
    assert info["collision"]
    (shape,) = obstacles_from_rows(scenes.obstacles[0, movement.contact.obstacle, None])
    place = np.array([*movement.contact.position, 0.0])
    radius = env.task.arm.hand_radius if movement.contact.link is None else 0.03
    assert abs(float(shape.distance(place))) < radius + 0.01
    outline = widened_outline(shape.footprint()[0], 0.01)
    outside = np.concatenate((outline, np.zeros((len(outline), 1))), axis=-1)
    np.testing.assert_allclose(shape.distance(outside), 0.01, atol=1e-3)
    assert env.render().std() > 1.0
    env.close()
