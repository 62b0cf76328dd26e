"""Retargeting under way: continuous, idempotent, and safe near arrival."""

import numpy as np
import pytest

from viapoint.primitives import FREE, passage_durations, point_to_point, retarget, through

RNG = np.random.default_rng(80)
START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_draws():
    """Every test begins with the same random numbers, whatever ran before it."""
    RNG.bit_generator.state = START


def test_position_velocity_and_acceleration_go_on_without_a_jump():
    waypoints = RNG.normal(size=(10, 3, 2))
    old = through(waypoints, passage_durations(waypoints, 1.0))
    now = RNG.uniform(0.05, 0.9, 10)
    new = retarget(old, now, RNG.normal(size=(10, 2)), now + 0.7, via=RNG.normal(size=(10, 2)))
    for nu in range(3):
        before, after = old(now[:, None], nu), new(np.zeros((10, 1)), nu)
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-10 * np.abs(before).max())


@pytest.mark.parametrize("steps", [1, 10, 300])
def test_an_unchanged_target_reproduces_the_movement(steps):
    old = point_to_point(RNG.normal(size=(4, 2)), RNG.normal(size=(4, 2)), 1.5)
    current, passed = old, 0.0
    for _ in range(steps):
        step = 1.2 / steps
        current = retarget(current, step, old([1.5])[:, 0], current.duration)
        passed += step
    time = np.linspace(0, 0.3, 20)
    for nu in range(3):
        expected = old(passed + time, nu)
        np.testing.assert_allclose(current(time, nu), expected, atol=1e-9 * np.abs(old.peak(nu)).max())


def test_a_movement_through_a_via_point_goes_on_to_it():
    waypoints = np.array([[0.0, 0.0], [0.4, 0.5], [1.0, 0.0]])
    old = through(waypoints, passage_durations(waypoints, 1.0))
    new = retarget(old, 0.2, waypoints[2], 1.0, via=waypoints[1])
    time = np.linspace(0, 0.8, 30)
    np.testing.assert_allclose(new(time), old(0.2 + time), atol=1e-9)


def test_target_arrival_and_final_state_may_all_change():
    old = point_to_point([0.0, 0.0], [1.0, 0.0], 1.0)
    new = retarget(old, 0.4, [0.5, 0.8], 1.3, goal_velocity=[1.0, 0.0], goal_acceleration=FREE)
    np.testing.assert_allclose(new.duration, 0.9)
    np.testing.assert_allclose(new([0.9])[0], [0.5, 0.8], atol=1e-12)
    np.testing.assert_allclose(new([0.9], 1)[0], [1.0, 0.0], atol=1e-12)


def test_freeze_keeps_the_old_target_near_arrival():
    old = point_to_point(np.zeros((2, 2)), np.ones((2, 2)), 1.0)
    now = np.array([0.5, 0.95])
    new = retarget(old, now, [3.0, 3.0], 1.2, via=[2.0, 0.0], freeze=0.1)
    np.testing.assert_allclose(new.duration, [0.7, 0.05], atol=1e-15)
    ends = new(new.duration[:, None])[:, 0]
    np.testing.assert_allclose(ends, [[3.0, 3.0], [1.0, 1.0]], atol=1e-12)
    time = np.linspace(0, 0.05, 9)
    np.testing.assert_allclose(new(time)[1], old(0.95 + time)[1], atol=1e-11)


def test_noise_of_the_state_grows_with_the_inverse_cube_of_the_remaining_time():
    """Why replanning must stop: jerk = 60 dx / R^3 for an error dx of the measured position."""
    noise = 1e-6
    for remaining in (0.3, 0.03, 0.003):
        plan = point_to_point([noise], [0.0], remaining)
        np.testing.assert_allclose(abs(plan(0.0, 3)[0]), 60 * noise / remaining**3, rtol=1e-9)
        pushed = point_to_point([0.0], [0.0], remaining, start_velocity=[noise])
        np.testing.assert_allclose(abs(pushed(0.0, 3)[0]), 36 * noise / remaining**2, rtol=1e-9)
        bent = point_to_point([0.0], [0.0], remaining, start_acceleration=[noise])
        np.testing.assert_allclose(abs(bent(0.0, 3)[0]), 9 * noise / remaining, rtol=1e-9)


def test_noisy_states_replanned_until_a_minimum_remaining_time_still_arrive():
    """A controller plans from measured states every 10 ms, and keeps its last plan for the last 100 ms."""
    state, goal = [np.zeros(2), np.zeros(2), np.zeros(2)], np.array([0.3, 0.2])
    arrival, step, worst = 0.8, 0.01, 0.0
    for k in range(70):
        seen = [value + RNG.normal(size=2) * 1e-4 for value in state]
        plan = point_to_point(
            seen[0], goal, arrival - k * step, start_velocity=seen[1], start_acceleration=seen[2]
        )
        worst = max(worst, float(plan.peak(3)))
        state = [plan(step, nu) for nu in range(3)]
    last = point_to_point(state[0], goal, 0.1, start_velocity=state[1], start_acceleration=state[2])
    np.testing.assert_allclose(last(0.1), goal, atol=1e-12)
    smooth = point_to_point([0.0, 0.0], goal, arrival).peak(3)
    assert worst < 10 * smooth


def test_bad_requests_are_named():
    old = point_to_point([0.0, 0.0], [1.0, 0.0], 1.0)
    goal = [1.0, 1.0]
    for arguments, name in (
        ((old, 1.0, goal, 2.0), "time"),
        ((old, -0.1, goal, 2.0), "time"),
        ((old, 0.5, goal, 0.5), "arrival"),
        ((old, 0.5, [1.0, 1.0, 1.0], 2.0), "goal"),
        ((old, 0.5, [np.nan, 1.0], 2.0), "goal"),
        ((point_to_point([0.0, 0.0], goal, 1.0, order=4), 0.5, goal, 2.0), "order"),
    ):
        with pytest.raises(ValueError, match=name):
            retarget(*arguments)
    with pytest.raises(ValueError, match="via"):
        retarget(old, 0.5, goal, 2.0, via=[1.0])
    with pytest.raises(ValueError, match="goal_velocity"):
        retarget(old, 0.5, goal, 2.0, goal_velocity=FREE, freeze=0.1)
