"""Tasks with an action in every control step."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from helpers import GOAL, OTHER, STEP, UR5E, WALL, given, post
from scipy.integrate import simpson

from viapoint.envs import Task, load_arm
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import Motion, Steering
from viapoint.envs.scenes.scene import NEVER


def steering(timestep=0.002, physics_steps=20):
    return Steering(
        names=("x", "y"), top_speed=(1.5, 1.5), bandwidth=25.0, physics_steps=physics_steps, timestep=timestep
    )


def some_motion(number=5, seed=0):
    values = np.random.default_rng(seed).normal(size=(4, number, 2))
    return Motion(*values[:3]), values[3]


def towards(env, observation, *points):
    """Steer the hand past points to its goal, and return all steps of the episode."""
    steps = []
    while True:
        hand, goal = observation["hand"][:2], observation["goal"][:2]
        if points and np.linalg.norm(hand - points[0]) < 0.03:
            points = points[1:]
        velocity = 8.0 * ((points[0] if points else goal) - hand) - 0.3 * observation["velocity"]
        action = np.clip(velocity / env.task.steering.top_speed, -1.0, 1.0)  # along x and y of the world
        observation, *rest = env.step(action.astype(np.float32))
        steps.append((observation, *rest))
        if rest[1] or rest[2]:
            return steps


def test_the_filter_obeys_its_equation_and_control_steps_join():
    """Each derivative is that of the one before, and the jerk cost is the integral."""
    fine = steering(1e-4, 400)
    motion, _ = some_motion()
    for _, wanted in (some_motion(seed=seed) for seed in range(3)):
        whole, w = fine.follow(motion, wanted, 400), fine.bandwidth
        law = w**2 * (wanted[:, None] - whole.velocity) - 2.0 * w * whole.acceleration
        for value, rate in itertools.pairwise((*whole, law)):
            slope = (value[:, 2:] - value[:, :-2]) / (2.0 * fine.timestep)
            np.testing.assert_allclose(slope, rate[:, 1:-1], atol=1e-4 * np.abs(rate).max())
        for part, begin in zip(whole, motion, strict=True):
            np.testing.assert_allclose(part[:, 0], begin, rtol=1e-12)
        cost = 0.5 * simpson((law**2).sum(axis=-1), dx=fine.timestep, axis=-1)
        half = 0.5 * simpson((law[:, :201] ** 2).sum(axis=-1), dx=fine.timestep, axis=-1)
        for share, expected in ((1.0, cost), (0.5, half)):  # a contact may end a control step
            found = fine.jerk_cost(motion, wanted, np.full(len(cost), 400 * share * fine.timestep))
            np.testing.assert_allclose(found, expected, rtol=1e-5)
        motion = Motion(*(part[:, -1] for part in whole))


def test_the_zero_action_brings_to_rest_and_no_action_exceeds_the_bounds():
    usual, generator = steering(), np.random.default_rng(1)
    motion = Motion.at_rest(np.zeros((64, 2)))
    for _ in range(200):
        action = np.sign(generator.normal(size=(64, 2)))
        wanted = action * np.array(usual.top_speed)
        whole = usual.follow(motion, wanted, 20)
        assert np.abs(whole.velocity).max() <= 2.0 * max(usual.top_speed) + 1e-12
        assert np.abs(whole.acceleration).max() <= usual.greatest_acceleration + 1e-12
        motion = Motion(*(part[:, -1] for part in whole))
    for _ in range(15):
        motion = Motion(*(part[:, -1] for part in usual.follow(motion, np.zeros((64, 2)), 20)))
    assert np.abs(motion.velocity).max() < 1e-4


def test_arms_of_the_package_are_steered_as_fast_as_agents_were_trained():
    for arm, speeds in (("planar", (5.0,) * 2), ("panda", (1.0875,) * 4 + (1.305,) * 3)):
        task = Task.of(arm=arm, space="joints", n_obstacles=0, decide_at="steps")
        assert (task.steering.top_speed, task.steering.bandwidth, task.time_limit) == (speeds, 12.0, 5.1)


def test_an_arm_of_little_torque_is_steered_so_slowly_that_it_follows():
    arm = load_arm(UR5E, torque_limit=[82.0] * 3 + [15.0] * 3)
    env = gym.make_vec("viapoint/Reach-v0", 20, arm=arm, decide_at="steps", threads=1).unwrapped
    env.reset(seed=0)
    rng, active = np.random.default_rng(0), np.ones(20, bool)
    for step in range(60):
        if step % 5 == 0:  # all joints turn round at once
            action = rng.choice([-1.0, 1.0], env.action_space.shape)
        active &= ~env.execute_actions(action, active).terminated
    for each in env.last_rollout:
        if len(each.time) > 1 and not each.contact.any():
            assert np.abs(each.joints - each.planned).max() < 0.02
            assert (np.abs(np.diff(each.joints, axis=0)) <= arm.timestep * arm.velocity_limit).all()


def test_slow_movements_are_not_cut_off():
    slow = load_arm(UR5E, velocity_limit=0.5)
    for arm, changes in ((slow, {}), ("panda", {"duration_range": (1.1, 20.0)})):
        env = gym.make_vec("viapoint/Reach-v0", 3, arm=arm, decide_at=(), threads=1, **changes).unwrapped
        env.reset(seed=0)
        slowest = np.eye(env.task.action.size)[[-1] * 3]
        assert env.execute_actions(slowest).info["is_success"].all()


def test_the_way_round_succeeds_where_the_straight_line_crashes():
    crash = towards(*given(STEP, [WALL]))[-1]
    assert crash[2]
    assert crash[-1]["collision"]
    assert not crash[-1]["is_success"]
    env, observation = given(STEP, [WALL])
    around = towards(env, observation, (-0.2, 0.56), (-0.05, 0.56))
    info, rollout = around[-1][-1], env.last_rollout
    assert info["is_success"]
    assert len(around) * 0.04 == pytest.approx(info["duration"] + SETTLING, abs=0.041)
    assert len(rollout.planned) == len(around) * env.task.steering.physics_steps
    assert np.abs(rollout.hand[:, :2] - rollout.planned).max() < 2e-3
    np.testing.assert_allclose(rollout.hand[-1, :2], GOAL, atol=0.01)
    assert 0.0 < info["min_clearance"] < 0.1
    progress = sum(step[-1]["reward_progress"] for step in around)
    assert progress == pytest.approx(1.0 - info["goal_error"] / 0.4)


@pytest.mark.parametrize("seed", range(6))
def test_a_hand_that_follows_a_jumping_target_arrives_at_the_last_place(seed):
    env = gym.make("viapoint/PlanarTargetJumpStep-v0").unwrapped
    seen, _ = env.reset(seed=seed)
    times = env.batch.scenes.jump_times
    info = towards(env, seen)[-1][-1]
    assert info["is_success"]
    assert info["time"] > times[times < NEVER].max()


def test_time_runs_out():
    env, observation = given(STEP, [WALL])
    number = int(np.ceil(env.task.time_limit / 0.04 - 1e-9))
    assert observation["time_left"] == pytest.approx(env.task.time_limit)
    zero = np.zeros(2, np.float32)
    for step in range(1, number + 1):
        observation, _, terminated, truncated, info = env.step(zero)
        assert not truncated
        assert terminated == (step == number)
    assert not info["is_success"]
    assert info["goal_error"] == pytest.approx(0.4, abs=1e-3)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(zero)


def test_a_reference_out_of_reach_ends_the_episode():
    env, _ = given(STEP)
    terminated = False
    while not terminated:
        before = env.physics_steps
        observation, _, terminated, truncated, info = env.step(np.array([0.0, 1.0], np.float32))
        assert not truncated
    assert not any(info[name] for name in ("reachable", "is_success", "collision"))
    assert env.physics_steps == before
    assert env.observation_space.contains(observation)


def test_no_jerk_counts_after_a_contact():
    costs = []
    for control_step in (0.02, 0.4):
        env, _ = given(STEP, [WALL], control_step=control_step)
        terminated = False
        while not terminated:
            *_, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
        assert info["collision"]
        costs.append(info["jerk_cost"])
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


def test_a_jump_after_the_time_limit_keeps_nobody_waiting():
    env, observation = given("viapoint/PlanarTargetJumpStep-v0", jumps=[[30.0, *OTHER]])
    assert towards(env, observation)[-1][-1]["is_success"]


def test_obstacles_turn_within_a_control_step():
    """They do not go on to its end and jump from there."""
    coming = post(-0.1, 0.5, velocity=(0.0, -0.9, 0.0))
    env, _ = given(STEP, [coming], turns=[[0.05, 0.0, 0.9, 0.0]], control_step=0.1)
    *_, info = env.step(np.zeros(2, np.float32))
    assert info["min_clearance"] == pytest.approx(env.last_rollout.clearance.min(), abs=1e-9)
