"""Outcomes of whole movements."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import ENDS, GOAL, PANDA, PLANE, START, WALL, given, post, random_shape, same

from viapoint.envs import Box, HalfSpace, Task
from viapoint.envs.geometry.obstacles import KINDS, pack
from viapoint.envs.outcome import TOLERANCES
from viapoint.envs.scenes.scene import resting


def test_a_plan_out_of_reach_is_a_failed_movement_that_does_not_start():
    env, _ = given(obstacles=[WALL])
    observation, _, terminated, _, info = env.step(np.array([-1.0, 1.0, 0.0], np.float32))
    assert terminated
    assert not any(info[name] for name in ("reachable", "is_success", "collision"))
    assert env.physics_steps == 0
    np.testing.assert_allclose(observation["hand"][:2], START, atol=1e-6)


def test_thin_walls_are_not_tunnelled_at_the_highest_speed():
    number = 100
    env = gym.make_vec(PLANE, num_envs=number, n_obstacles=1).unwrapped
    places = np.linspace(-0.22, 0.03, number)
    walls = [[Box((0.0005, 0.1, 0.04), position=(x, 0.4, 0.0))] for x in places]
    env.reset(seed=0, options={**ENDS, "obstacles": walls})
    action = np.zeros((number, 3))
    action[:, 2] = -1.0
    *_, info = env.step(action)
    assert info["collision"].all()


@pytest.mark.parametrize("kind", KINDS[:5])
@pytest.mark.parametrize("arm", ["planar", "panda"])
def test_contact_implies_negative_clearance_and_clearance_implies_no_contact(arm, kind):
    """In MuJoCo at every physics step of random movements past a random shape."""
    rng = np.random.default_rng(7)
    # Not all kinds have default families in the plane.
    kinds = tuple(dict.fromkeys((kind, "box", "cylinder")))
    settings = {"n_obstacles": 1, "shapes": kinds, "families": "clutter", "whole_arm": arm == "planar"}
    settings |= {"space": "joints", "autoreset_mode": "Disabled"}
    env = gym.make_vec(PANDA if arm == "panda" else PLANE, num_envs=50, **settings).unwrapped
    env.reset(seed=0)
    touched = clear = 0
    for _ in range(2):
        scenes = scenes_with(env, kind, rng)
        env.begin(scenes)
        decision = env.execute_actions(rng.uniform(-1.0, 1.0, env.action_space.shape))
        info = decision.info
        clearance = np.minimum(info["min_clearance"], info["self_clearance"])
        assert (clearance[info["collision"]] < 0.0).all()
        assert not info["collision"][clearance >= 0.0].any()
        touched += info["collision"].sum()
        clear += (clearance >= 0.0).sum()
    assert min(touched, clear) > 2


def scenes_with(env, kind, rng):
    """Return free configurations and a random shape of a kind within reach in each scene."""
    task = Task.of(arm=env.task.arm, space="joints", n_obstacles=0)
    scenes = task.sampler()([np.random.default_rng(seed) for seed in rng.integers(2**31, size=env.num_envs)])
    shapes = []
    for start in scenes.start:
        away = rng.normal(size=3) * (1.0, 1.0, 0.3)
        away *= rng.uniform(0.15, 0.5) / np.linalg.norm(away)
        place = env.task.arm.hand(start) + away
        wall = HalfSpace.facing(-away, position=place)
        shape = wall if kind == "half_space" else random_shape(kind, rng)
        shapes.append([{**shape.to_dict(), "position": place}])
    return resting(scenes.start, scenes.goal, pack(shapes, 1))


@pytest.mark.parametrize("arm", ["planar", "panda"])
def test_a_longer_duration_is_a_longer_movement_in_joint_space(arm):
    """Also where joints have no velocity limit."""
    envs = gym.make_vec("viapoint/Reach-v0", num_envs=3, arm=arm, space="joints").unwrapped
    envs.reset(seed=[0, 0, 0])
    actions = np.zeros(envs.action_space.shape, np.float32)
    actions[:, envs.action_names.index("duration")] = (-1.0, 0.0, 1.0)
    _, reward, _, _, info = envs.step(actions)
    duration = info["final_info"]["duration"]
    assert (np.diff(duration) > 0.1 * duration[0]).all()
    assert (reward > -2.0).all()


def test_the_rollout_is_the_movement_that_info_tells_of():
    env, _ = given(obstacles=[post(-0.1, 0.25)])
    *_, info = env.step(np.array([0.1, 0.3, 0.0], np.float32))
    rollout = env.last_rollout
    assert info["is_success"]
    assert np.linalg.norm(rollout.hand[-1, :2] - GOAL) == pytest.approx(info["goal_error"])
    assert info["goal_error"] < TOLERANCES["hand"].goal
    assert rollout.clearance.min() == pytest.approx(info["min_clearance"])
    error = np.linalg.norm(rollout.hand[:, :2] - rollout.planned, axis=-1)
    assert np.sqrt((error**2).mean()) == pytest.approx(info["tracking_error"])
    assert info["tracking_error"] < 2e-5
    assert len(rollout.time) == env.physics_steps


def test_components_beyond_one_are_clipped():
    outcomes = [given()[0].step(np.array([0.0, 0.0, size], np.float32))[4] for size in (1.0, 7.0)]
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize(("n_via", "timing"), [(0, "optimal"), (2, "optimal"), (3, "learned")])
@pytest.mark.parametrize("space", ["hand", "joints"])
def test_zero_actions_are_straight_minimum_jerk_movements(n_via, timing, space):
    env = gym.make("viapoint/PlanarReach-v0", n_via=n_via, timing=timing, space=space).unwrapped
    env.reset(seed=1)
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert info["jerk_ratio"] == pytest.approx(1.0, abs=1e-6)
    rollout = env.last_rollout
    line = rollout.planned[-1] - rollout.planned[0]
    across = rollout.planned - rollout.planned[0]
    across -= np.outer(across @ line, line) / (line @ line)
    assert np.abs(across).max() < 1e-9
    distance, duration = np.linalg.norm(line), info["duration"]
    assert info["jerk_cost"] == pytest.approx(360.0 * distance**2 / duration**5, rel=1e-5)
    assert (info["first_contact_time"], info["min_clearance"]) == (-1.0, 1.0)
    if space == "hand":
        assert info["path_length"] == pytest.approx(distance, abs=1e-3)
        assert info["peak_speed"] == pytest.approx(1.875 * distance / duration, rel=2e-3)


@pytest.mark.parametrize("env_id", [PLANE, "viapoint/PlanarWholeArm-v0", PANDA])
def test_any_success_is_worth_more_than_any_failure(env_id):
    number = 16 if env_id == PANDA else 128
    env = gym.make_vec(env_id, num_envs=number)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    _, reward, *_, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape) * (number > 16))
    success = info["is_success"]
    if success.any():
        assert reward[success].min() > reward[~success].max()


@pytest.mark.parametrize("turn", [0.4, -0.9])
@pytest.mark.parametrize("mirrored", [False, True])
def test_turned_and_mirrored_obstacles_have_turned_and_mirrored_distances_along_the_way(turn, mirrored):
    """An arm without an asymmetry of its own: hand and posts turn about the vertical axis of the first joint."""
    env = gym.make(PANDA, shapes=("cylinder", "sphere"), families="clutter").unwrapped
    joints = np.array([[-0.3, 0.4, 0.0, -1.8, 0.0, 2.0, 0.0], [0.4, 0.6, 0.0, -1.5, 0.0, 2.1, 0.0]])
    action = np.array([0.1, -0.2, 0.3, 0.1, -0.3, 0.2, 0.0, 0.2], np.float32)
    places = np.array([(0.75, 0.35), (0.2, -0.7)])
    way = np.array([1.0, -1.0 if mirrored else 1.0])
    sign = np.where(np.arange(7) % 2 == 0, way[1], 1.0)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    other_joints = sign * joints + turn * np.eye(7)[0]
    other_action = (action * np.append(sign, 1.0)).astype(np.float32)
    results = []
    for ends, posts, each in (
        (joints, places, action),
        (other_joints, places * way @ rotation, other_action),
    ):
        obstacles = [post(*place, 0.03) for place in posts]
        env.reset(options={"start": ends[0], "goal": ends[1], "obstacles": obstacles})
        results.append(env.step(each)[4])
    usual, other = results
    for name in ("is_success", "collision", "reachable"):
        assert usual[name] == other[name]
    for name in ("duration", "jerk_cost", "path_length"):
        assert other[name] == pytest.approx(usual[name], rel=1e-3)
    assert other["min_clearance"] == pytest.approx(usual["min_clearance"], abs=4e-3)


def test_executed_actions_are_those_of_their_plans():
    results = []
    for by_plan in (False, True):
        env = gym.make_vec(PLANE, num_envs=4, threads=1).unwrapped
        env.reset(seed=2)
        env.step(np.zeros((4, 3)))  # the next episodes have begun
        actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 3))
        space, scenes = env.task.space, env.scenes
        ends = space.coordinates(scenes.start), space.coordinates(scenes.goal)
        plan = env.task.action.decode(actions, *ends)
        results.append(env.execute_plan(plan) if by_plan else env.execute_actions(actions))
    same(results[0].info, results[1].info)
    np.testing.assert_allclose(env.task.action.encode(plan), actions, atol=1e-9)


@pytest.mark.parametrize("arm", ["planar", "panda"])
def test_the_range_is_a_factor_on_offsets_of_via_points(arm):
    usual, wide = (Task.of(arm=arm, n_via=2, via_range=factor).action for factor in (1.0, 2.5))
    start, goal = np.full(usual.dimension, 0.3), np.full(usual.dimension, 0.1)
    action = np.random.default_rng(0).uniform(-0.4, 0.4, usual.size)
    near, far, straight = (
        each.decode(part, start, goal).waypoints
        for each, part in ((usual, action), (wide, action), (usual, 0.0 * action))
    )
    np.testing.assert_allclose(far - straight, 2.5 * (near - straight), atol=1e-12)
