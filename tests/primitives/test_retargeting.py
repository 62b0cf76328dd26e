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


ENDS = [
    {},
    {"goal_velocity": [0.7, -0.4], "goal_acceleration": [1.0, 2.0]},
    {"goal_velocity": FREE, "goal_acceleration": FREE},
]


def moving_through_a_via_point(ends):
    waypoints = np.array([[0.0, 0.0], [0.4, 0.5], [1.0, 0.0]])
    return through(waypoints, passage_durations(waypoints, 1.0, **ends), **ends)


@pytest.mark.parametrize("ends", ENDS)
def test_after_the_via_point_the_old_target_and_final_state_give_the_rest_of_the_movement(ends):
    old = moving_through_a_via_point(ends)
    now = float(old.knots[1]) + 0.05
    new = retarget(old, now, [1.0, 0.0], 1.0, **ends)
    time = np.linspace(0, 1.0 - now, 30)
    for nu in range(3):
        np.testing.assert_allclose(new(time, nu), old(now + time, nu), atol=1e-9)


@pytest.mark.parametrize("ends", ENDS)
def test_a_via_point_ahead_is_passed_as_before_if_it_is_given_again_and_else_dropped(ends):
    old = moving_through_a_via_point(ends)
    again = retarget(old, 0.2, [1.0, 0.0], 1.0, via=[0.4, 0.5], **ends)
    time = np.linspace(0, 0.8, 30)
    np.testing.assert_allclose(again(time), old(0.2 + time), atol=1e-9)
    dropped = retarget(old, 0.2, [1.0, 0.0], 1.0, **ends)
    state = {"start_velocity": old(0.2, 1), "start_acceleration": old(0.2, 2)}
    smoothest = point_to_point(old(0.2), [1.0, 0.0], 0.8, **state, **ends)
    np.testing.assert_allclose(dropped(time), smoothest(time), atol=1e-12)
    assert dropped.cost() < 0.9 * again.cost()


@pytest.mark.parametrize("ends", ENDS[1:])
def test_the_final_state_is_rest_unless_it_is_given_again(ends):
    new = retarget(moving_through_a_via_point(ends), 0.8, [1.0, 0.0], 1.0)
    np.testing.assert_allclose(new.sample([0.2], (1, 2)), 0.0, atol=1e-10)


@pytest.mark.parametrize("ends", ENDS[:2])
def test_freeze_keeps_goal_arrival_and_final_state_but_no_via_point_of_those_near_arrival(ends):
    old, now, via = moving_through_a_via_point(ends), np.array([0.05, 0.2, 0.95]), [2.0, 0.0]
    new = retarget(old, now, [3.0, 3.0], 1.2, via=via, freeze=0.9)
    np.testing.assert_allclose(new.duration, [1.15, 0.8, 0.05], atol=1e-15)
    expected = [retarget(old, now[0], [3.0, 3.0], 1.2, via=via)]
    expected += [retarget(old, each, [1.0, 0.0], 1.0, **ends) for each in now[1:]]
    for i, movement in enumerate(expected):
        for found, wanted in zip(new.sample(30), movement.sample(30), strict=True):
            np.testing.assert_allclose(found[i], wanted, atol=1e-9)
