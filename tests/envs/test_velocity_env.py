"""The tasks with an action in every control step."""

import itertools
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
from scene_numbers import steered

from viapoint.envs.actions.velocity import Steering
from viapoint.envs.actions.via_points import Motion
from viapoint.envs.arms import ADULT, PANDA
from viapoint.envs.mdp.rewards import RewardTerms, RewardWeights, reward_terms
from viapoint.envs.registration import STEP_TASKS, twin_of
from viapoint.envs.sim.outcome import SETTLING, Outcome

STEP = "viapoint/PlanarObstaclesStep-v0"
START, GOAL = np.array([-0.3, 0.4]), np.array([0.1, 0.4])
WALL = [[-0.1, 0.4, 0.0, 0.1, 0.008]]


def make(obstacles=(), **kwargs):
    """An environment in a given scene, and its first observation."""
    rows = np.array(obstacles, dtype=float).reshape(-1, 5)
    env = gym.make(STEP, **kwargs).unwrapped
    observation, _ = env.reset(seed=0, options={"start": START, "goal": GOAL, "obstacles": rows})
    return env, observation


def towards(env, observation, points):
    """Steer the hand past points to the last of them, and play to the end: all steps."""
    steps, points = [], [np.asarray(point, dtype=float) for point in points]
    while True:
        if len(points) > 1 and np.linalg.norm(observation["hand"] - points[0]) < 0.03:
            points = points[1:]
        velocity = 8.0 * (points[0] - observation["hand"]) - 0.3 * observation["velocity"]
        action = env.steering.encode(velocity, START, GOAL).astype(np.float32)
        observation, *rest = env.step(action)
        steps.append((observation, *rest))
        if rest[1] or rest[2]:
            return steps


@pytest.mark.parametrize("name", [STEP, "viapoint/PandaObstaclesStep-v0"])
def test_steered_along_solutions_of_the_twin_the_hand_succeeds(name):
    """Nothing is lost by an action in every control step."""
    found = steered(name, 40)
    assert found["success"] == 1.0
    assert found["of_solutions"] < found["jerk_ratio"] < 15.0


@pytest.fixture
def steering():
    return Steering()


def some_motion(number=5, seed=0):
    values = np.random.default_rng(seed).normal(size=(4, number, 2))
    return Motion(*values[:3]), values[3]


def test_each_derivative_of_the_reference_is_that_of_the_one_before_and_control_steps_join():
    steering = Steering(timestep=2e-4)
    motion, _ = some_motion()
    for _, wanted in (some_motion(seed=seed) for seed in range(3)):
        whole = steering.follow(motion, wanted)
        for value, rate in itertools.pairwise(whole):
            slope = (value[:, 2:] - value[:, :-2]) / (2.0 * steering.timestep)
            np.testing.assert_allclose(slope, rate[:, 1:-1], atol=1e-4 * np.abs(rate).max())
        for part, begin in zip(whole, motion, strict=True):
            np.testing.assert_allclose(part[:, 0], begin, rtol=1e-12)
        motion = Motion(*(part[:, -1] for part in whole))


def test_the_filter_obeys_its_equation_and_the_jerk_cost_is_its_integral():
    fine = Steering(timestep=1e-4, control_step=0.04)
    motion, wanted = some_motion()
    reference, w = fine.follow(motion, wanted), fine.bandwidth
    law = w**2 * (wanted[:, None] - reference.velocity) - 2.0 * w * reference.acceleration
    slope = np.gradient(reference.acceleration, fine.timestep, axis=1)
    np.testing.assert_allclose(slope[:, 1:-1], law[:, 1:-1], atol=1e-4 * np.abs(law).max())
    cost = 0.5 * np.trapezoid((law**2).sum(axis=-1), dx=fine.timestep, axis=-1)
    np.testing.assert_allclose(fine.jerk_cost(motion, wanted), cost, rtol=1e-5)


def test_the_zero_action_brings_to_rest_and_no_action_exceeds_the_bounds(steering):
    generator = np.random.default_rng(1)
    motion = Motion.at_rest(np.zeros((64, 2)))
    speed, acceleration = steering.greatest
    for _ in range(200):
        action = np.sign(generator.normal(size=(64, 2)))
        wanted = steering.decode(action, np.zeros((64, 2)), generator.normal(size=(64, 2)))
        whole = steering.follow(motion, wanted)
        assert np.abs(whole.velocity).max() <= speed + 1e-12
        assert np.abs(whole.acceleration).max() <= acceleration + 1e-12
        motion = Motion(*(part[:, -1] for part in whole))
    for _ in range(15):
        motion = Motion(*(part[:, -1] for part in steering.follow(motion, np.zeros((64, 2)))))
    assert np.abs(motion.velocity).max() < 1e-4


def test_encode_is_the_inverse_of_decode(steering):
    generator = np.random.default_rng(2)
    action, start, goal = generator.uniform(-1.0, 1.0, (3, 50, 2))
    np.testing.assert_allclose(steering.encode(steering.decode(action, start, goal), start, goal), action)


def test_a_control_step_of_single_precision_is_the_multiple_that_it_stands_for():
    for steps in range(1, 501):
        given = steps * 0.002
        assert Steering(control_step=np.float32(given)).control_step == pytest.approx(given, abs=1e-12)
        assert Steering(control_step=given).control_step == given
    assert Steering(control_step=np.float32(0.04)) == Steering(control_step=Fraction(1, 25)) == Steering()
    env = gym.make(STEP, control_step=np.float32(0.04)).unwrapped
    assert env.observation_layout == gym.make(STEP).unwrapped.observation_layout


@pytest.mark.parametrize("record", [ADULT, PANDA], ids=lambda record: record.name)
def test_an_arm_by_name_is_its_record(record):
    """In space, too."""
    results = []
    for arm in (record, record.name):
        env = gym.make(STEP, arm=arm, whole_arm=True).unwrapped
        env.reset(seed=3)
        assert env.task.arm is record
        results.append(env.step(np.full(record.dimension, 0.2, np.float32)))
    (seen, *rest), (same, *others) = results
    assert rest == others
    for name in seen:
        np.testing.assert_array_equal(seen[name], same[name])


def test_it_arrives_where_nothing_is_in_the_way():
    steps = towards(*make(), [GOAL])
    *_, terminated, truncated, info = steps[-1]
    assert terminated
    assert not truncated
    assert info["is_success"]
    assert len(steps) * 0.04 == pytest.approx(info["duration"] + SETTLING, abs=0.04)
    assert info["path_length"] == pytest.approx(0.4, abs=0.02)
    assert info["tracking_error"] < 1e-3


def test_the_way_round_succeeds_where_the_straight_line_crashes():
    crash = towards(*make(WALL), [GOAL])[-1]
    assert crash[2]
    assert crash[-1]["collision"]
    assert not crash[-1]["is_success"]
    assert 0.0 <= crash[-1]["first_contact_time"] <= crash[-1]["duration"]
    around = towards(*make(WALL), [(-0.2, 0.55), (-0.05, 0.55), GOAL])[-1]
    assert around[-1]["is_success"]
    assert 0.0 < around[-1]["min_clearance"] < 0.1


def test_terms_of_a_success_sum_to_those_of_a_whole_movement_with_its_outcome():
    steps = towards(*make(WALL), [(-0.2, 0.55), (-0.05, 0.55), GOAL])
    info = steps[-1][-1]
    outcome = Outcome(**{name: np.array([info[name]]) for name in Outcome._fields})
    whole = reward_terms(outcome, float(np.sqrt(0.6 * 1.2)), RewardWeights()).as_info()
    for name, (value,) in whole.items():
        assert sum(step[-1][name] for step in steps) == pytest.approx(value, abs=1e-12), name
    assert sum(step[-1]["reward_progress"] for step in steps) == pytest.approx(1 - info["goal_error"] / 0.4)
    for _, reward, *_, step in steps:
        terms = [step[f"reward_{name}"] for name in (*RewardTerms._fields, "progress")]
        assert reward == pytest.approx(sum(terms), abs=1e-12)


def test_time_runs_out():
    env, observation = make(WALL)
    assert observation["time_left"] == pytest.approx(33 * 0.04)
    for step in range(1, 34):
        observation, _, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        assert truncated == (step == 33)
        assert observation["time_left"] == pytest.approx((33 - step) * 0.04, abs=1e-6)
    assert not info["is_success"]
    assert info["goal_error"] == pytest.approx(0.4, abs=1e-3)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(2, dtype=np.float32))


def test_a_reference_out_of_reach_ends_the_episode():
    env, _ = make()
    terminated = False
    while not terminated:
        before = env.physics_steps
        observation, _, terminated, truncated, info = env.step(np.array([0.0, 1.0], dtype=np.float32))
        assert not truncated
    assert not info["reachable"]
    assert not info["is_success"]
    assert not info["collision"]
    assert env.physics_steps == before
    assert env.observation_space.contains(observation)


def test_equal_seeds_give_the_scenes_of_the_twin():
    for name, twin in STEP_TASKS.items():
        assert twin_of(name) == twin_of(twin) == twin
        mine, theirs = (gym.make_vec(each, num_envs=5).reset(seed=3)[0] for each in (name, twin))
        for part in theirs:
            np.testing.assert_array_equal(mine[part], theirs[part])


def test_episodes_go_on_where_their_state_was_taken():
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 6, 2)).astype(np.float32)
    first, second = gym.make_vec(STEP, num_envs=6), gym.make_vec(STEP, num_envs=6)
    first.reset(seed=0)
    for action in actions[:3]:
        first.step(action)
    second.unwrapped.restore(first.unwrapped.state())
    for action in actions[3:]:
        one, two = first.step(action), second.step(action)
        np.testing.assert_array_equal(one[1], two[1])
        for name in one[0]:
            np.testing.assert_array_equal(one[0][name], two[0][name])


def test_the_rollout_is_the_movement_so_far():
    env, observation = make()
    towards(env, observation, [GOAL])
    rollout = env.last_rollout
    assert rollout.hand.shape == rollout.planned.shape == (len(rollout.time), 2)
    assert np.abs(rollout.hand - rollout.planned).max() < 2e-3
    np.testing.assert_allclose(rollout.hand[-1], GOAL, atol=0.01)
    assert len(rollout.time) % env.steering.physics_steps == 0


@pytest.mark.usefixtures("opengl")
def test_pictures_show_the_movement_so_far():
    env, _ = make(render_mode="rgb_array_list", width=64, height=64)
    frames = [len(env.render())]
    for _ in range(3):
        env.step(np.array([0.5, 0.0], dtype=np.float32))
        frames.append(len(env.render()))
    assert frames == [1, 3, 5, 7]  # 50 frames/s, the start included
    env.close()
