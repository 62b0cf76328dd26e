"""What movements lead to."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.mdp.rewards import RewardWeights
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import GOAL_TOLERANCE

START, GOAL = np.array([-0.3, 0.4]), np.array([0.1, 0.4])


def make(obstacles=(), **kwargs):
    """An environment in a given scene."""
    rows = np.array(obstacles, dtype=float).reshape(-1, 5)
    env = gym.make("viapoint/PlanarObstacles-v0", **kwargs).unwrapped
    env.reset(seed=0, options={"start": START, "goal": GOAL, "obstacles": rows})
    return env


def through(env, via, duration=0.85):
    """The action whose movement passes `via`."""
    waypoints = np.stack((START, via, GOAL))
    return env.action_layout.encode(Plan(waypoints, np.full(2, duration / 2))).astype(np.float32)


WALL = [[-0.1, 0.4, 0.0, 0.1, 0.008]]
"""A row of lights across the middle."""


def test_a_straight_movement_with_nothing_in_the_way_succeeds():
    env = make()
    _, reward, *_, info = env.step(np.zeros(3, dtype=np.float32))
    assert info["is_success"]
    assert info["jerk_ratio"] == pytest.approx(1.0, abs=1e-9)
    assert info["path_length"] == pytest.approx(0.4, abs=1e-3)
    assert info["peak_speed"] == pytest.approx(1.875 * 0.4 / info["duration"], rel=2e-3)
    assert info["jerk_cost"] == pytest.approx(360.0 * 0.4**2 / info["duration"] ** 5, rel=1e-9)
    assert info["first_contact_time"] == -1.0
    assert info["min_clearance"] == 1.0
    assert reward > 1.0


def test_the_way_round_succeeds_where_the_straight_line_crashes():
    env = make(WALL)
    *_, crash = env.step(np.zeros(3, dtype=np.float32))
    assert crash["collision"]
    assert 0.2 < crash["first_contact_time"] < crash["duration"]
    env = make(WALL)
    action = through(env, np.array([-0.1, 0.54]))
    *_, around = env.step(action)
    assert around["is_success"]
    assert 0.0 < around["min_clearance"] < 0.04
    np.testing.assert_allclose(env.last_plan.waypoints[1], [-0.1, 0.54], atol=1e-6)


def test_rewards_are_ordered_as_a_person_would_order_them():
    """A smooth way round, a wide one, a refused one, a crash; and a graze above a crash in the middle."""
    env = make(WALL)
    smooth, wide, graze = (through(env, np.array([-0.1, y])) for y in (0.53, 0.59, 0.515))
    refused, crash = np.array([-1.0, 1.0, 0.0], np.float32), np.zeros(3, np.float32)
    rewards = []
    for action in (smooth, wide, refused, graze, crash):
        env = make(WALL)
        _, reward, *_, info = env.step(action)
        rewards.append((reward, info["is_success"], info["reachable"], info["collision"]))
    assert [r[1:] for r in rewards] == [
        (True, True, False), (True, True, False), (False, False, False), (False, True, True), (False, True, True),
    ]  # fmt: skip
    values = [r[0] for r in rewards]
    assert values == sorted(values, reverse=True)


def test_a_plan_out_of_reach_is_a_failed_movement_that_does_not_start():
    env = make(WALL)
    steps = env.physics_steps
    observation, _, terminated, _, info = env.step(np.array([-1.0, 1.0, 0.0], dtype=np.float32))
    assert terminated
    assert not info["reachable"]
    assert not info["is_success"]
    assert not info["collision"]
    assert env.physics_steps == steps
    np.testing.assert_allclose(observation["hand"], START, atol=1e-6)


def test_a_thin_bar_is_not_tunnelled_at_the_highest_speed():
    """The fastest movements of the action space against the thinnest bar, at 200 places along the line."""
    number = 200
    env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=number, n_obstacles=1).unwrapped
    start, goal = np.array([-0.32, 0.42]), np.array([0.13, 0.42])
    bars = np.zeros((number, 1, 5))
    bars[:, 0, 0] = np.linspace(-0.25, 0.06, number)
    bars[:, 0, 1:] = (0.42, 0.0, 0.06, 0.001)
    env.reset(seed=0, options={"start": start, "goal": goal, "obstacles": bars})
    action = np.zeros((number, 3))
    action[:, 2] = -1.0
    *_, info = env.step(action)
    assert info["collision"].all()


def test_contact_and_clearance_agree_at_every_step():
    env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=100).unwrapped
    env.reset(seed=3)
    *_, info = env.step(np.random.default_rng(0).uniform(-1, 1, (100, 3)))
    touched = 0
    for i, rollout in enumerate(env.last_rollout):
        # contact is found at the state before a step, clearance is that of the state after it
        np.testing.assert_array_equal(rollout.contact[1:], rollout.clearance[:-1] < 0.0)
        assert rollout.contact.any() == info["collision"][i]
        touched += rollout.contact.any()
    assert 20 < touched < 80


def test_the_rollout_is_the_movement_that_info_tells_of():
    env = make(WALL)
    *_, info = env.step(through(env, np.array([-0.1, 0.54])))
    rollout = env.last_rollout
    np.testing.assert_allclose(np.linalg.norm(rollout.hand[-1] - GOAL), info["goal_error"])
    assert info["goal_error"] < GOAL_TOLERANCE
    assert rollout.clearance.min() == pytest.approx(info["min_clearance"])
    error = np.linalg.norm(rollout.hand - rollout.planned, axis=-1)
    assert np.sqrt((error**2).mean()) == pytest.approx(info["tracking_error"])
    assert info["tracking_error"] < 2e-3


def test_short_movements_cost_fewer_physics_steps():
    steps = []
    for duration in (-1.0, 1.0):
        env = make()
        env.step(np.array([0.0, 0.0, duration], dtype=np.float32))
        steps.append(env.physics_steps)
    assert steps[0] == pytest.approx(350, abs=2)
    assert steps[1] == pytest.approx(650, abs=2)


def test_components_beyond_one_are_clipped():
    outcomes = []
    for size in (1.0, 7.0):
        env = make()
        *_, info = env.step(np.array([0.0, 0.0, size], dtype=np.float32))
        outcomes.append(info)
    assert outcomes[0] == outcomes[1]


def test_weights_scale_their_terms():
    action = np.array([0.1, 0.3, 0.2], dtype=np.float32)
    *_, usual = make(WALL).step(action)
    *_, double = make(WALL, reward_weights={"smoothness": 2 * RewardWeights().smoothness}).step(action)
    assert double["reward_smoothness"] == pytest.approx(2 * usual["reward_smoothness"])
    assert double["reward_duration"] == usual["reward_duration"]


def test_more_via_points_and_learned_timing():
    for n_via, timing in ((2, "optimal"), (3, "learned")):
        env = make(n_via=n_via, timing=timing)
        *_, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        assert info["is_success"]
        assert info["jerk_ratio"] == pytest.approx(1.0, abs=1e-6)


def test_a_wrapped_batch_takes_scenes_in_a_batch():
    env = gym.make_vec("viapoint/PlanarObstacles-v0", num_envs=3)
    goals = np.array([[0.1, 0.4], [0.05, 0.5], [0.0, 0.3]])
    observation, _ = env.reset(options={"start": START, "goal": goals, "obstacles": np.zeros((0, 5))})
    np.testing.assert_allclose(observation["goal"], goals, atol=1e-7)
    assert isinstance(env.unwrapped.scenes, Scenes)
    *_, info = env.step(np.zeros((3, 3)))
    assert info["is_success"].all()


@pytest.mark.parametrize("env_id", ["viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0"])
def test_any_success_is_worth_more_than_any_failure(env_id):
    env = gym.make_vec(env_id, num_envs=256)
    env.reset(seed=1)
    rng, rewards, success = np.random.default_rng(1), [], []
    for _ in range(3):
        _, reward, *_, info = env.step(rng.uniform(-1.0, 1.0, (256, 3)))
        rewards.append(reward)
        success.append(info["is_success"])
    reward, success = np.concatenate(rewards), np.concatenate(success)
    assert reward[success].min() > reward[~success].max()
