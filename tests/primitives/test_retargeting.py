"""Retargeting under way: continuous, idempotent, and safe near arrival."""

import numpy as np
import pytest

from viapoint.primitives import FREE, passage_durations, point_to_point, retarget, through


def test_position_velocity_and_acceleration_go_on_without_a_jump(rng):
    waypoints = rng.normal(size=(10, 3, 2))
    old = through(waypoints, passage_durations(waypoints, 1.0))
    now = rng.uniform(0.05, 0.9, 10)
    goal, speed = rng.normal(size=(2, 10, 2))
    ends = {"goal_velocity": speed, "goal_acceleration": FREE}
    new = retarget(old, now, goal, now + 0.7, via=rng.normal(size=(10, 2)), **ends)
    np.testing.assert_allclose(new.duration, 0.7)
    np.testing.assert_allclose(new([0.7])[:, 0], goal, atol=1e-12)
    np.testing.assert_allclose(new([0.7], 1)[:, 0], speed, atol=1e-11)
    for nu in range(3):
        before, after = old(now[:, None], nu), new(np.zeros((10, 1)), nu)
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-10 * np.abs(before).max())


@pytest.mark.parametrize("steps", [1, 10, 300])
def test_an_unchanged_target_reproduces_the_movement(steps, rng):
    old = point_to_point(rng.normal(size=(4, 2)), rng.normal(size=(4, 2)), 1.5)
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
