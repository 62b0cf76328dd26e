"""Free passage times: the only root, its limits, and no better neighbour."""

from itertools import pairwise

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from viapoint.primitives import FREE, passage_durations, through


def residual(t, start, via, goal):
    """Flash & Hogan's Eq. C16 as derived: (E - D q).(E (1 - 2 t) + D t^3 (2 - t))."""
    q = 10 * t**3 - 15 * t**4 + 6 * t**5
    first, whole = via - start, goal - start
    return np.sum((first - whole * q) * (first * (1 - 2 * t) + whole * t**3 * (2 - t)), axis=-1)


VIAS = {
    "box": lambda rng: rng.uniform(-2, 2, (500, 2)),
    "tiny": lambda rng: rng.normal(size=(500, 2)) * 10.0 ** rng.uniform(-12, 0, (500, 1)),
    "far": lambda rng: rng.normal(size=(500, 2)) * 10.0 ** rng.uniform(0, 6, (500, 1)),
    "on the line": lambda rng: rng.uniform(-1, 2, (500, 1)) * [1.0, 0.0],
    "near the goal": lambda rng: (
        [1.0, 0.0] + rng.normal(size=(500, 2)) * 10.0 ** rng.uniform(-6, 0, (500, 1))
    ),
}


@pytest.mark.parametrize("family", VIAS)
def test_one_via_point_is_passed_where_eq_c16_changes_sign(family, rng):
    via, start, goal = VIAS[family](rng), np.zeros(2), np.array([1.0, 0.0])
    waypoints = np.stack([np.broadcast_to(start, via.shape), via, np.broadcast_to(goal, via.shape)], axis=1)
    fractions = passage_durations(waypoints, 1.0)
    np.testing.assert_allclose(fractions.sum(-1), 1.0, rtol=1e-15)
    # Looked at from the nearer end the root is a sign change within 1e-12 of its own size.
    late = fractions[:, 1] < fractions[:, 0]
    via = np.where(late[:, None], goal - via, via)
    t = fractions.min(axis=-1)[:, None]
    low, high = t * (1 - 1e-12), t * (1 + 1e-12)
    assert (residual(low, start, via, goal) >= 0).all()
    assert (residual(np.where(t == 0.5, 0.5, high), start, via, goal) <= 0).all()


@pytest.mark.parametrize("vias", [1, 2, 3, 5])
@pytest.mark.parametrize("ends", ["at rest", "moving and free"])
def test_no_shift_of_a_passage_time_lowers_the_cost(vias, ends, rng):
    waypoints = rng.normal(size=(40, vias + 2, 2))
    moving = {"start_velocity": rng.normal(size=(40, 2)), "goal_velocity": FREE} if ends != "at rest" else {}
    durations = passage_durations(waypoints, 1.3, **moving)
    best = through(waypoints, durations, **moving).cost()
    for s, t in pairwise(range(vias + 1)):
        for shift in (-1e-2, -1e-3, -1e-5, 1e-5, 1e-3, 1e-2):
            moved = durations.copy()
            moved[:, s] += shift * durations.min(axis=-1)
            moved[:, t] -= shift * durations.min(axis=-1)
            assert (through(waypoints, moved, **moving).cost() >= best * (1 - 1e-12)).all()


@pytest.mark.parametrize("gap", [3e-9, 1e-8])
def test_nearly_equal_via_points_anywhere_cost_no_more_than_a_stop_there(gap):
    waypoints = np.array([[0.0, 0.0], [0.5, 0.2], [0.5, 0.2 + gap], [1.0, 0.0]])
    waypoints = waypoints + np.array([0.0, 3e3, 1e5])[:, None, None]
    cost = through(waypoints, passage_durations(waypoints, 1.0)).cost()
    np.testing.assert_allclose(cost, 6169.6, rtol=1e-3)


def test_equal_neighbours_are_merged():
    waypoints = np.array([[0.0, 0], [1, 1], [1, 1], [2, -1], [3, 0], [3, 0]])
    durations = passage_durations(waypoints, 1.0)
    merged = passage_durations(waypoints[[0, 1, 3, 4]], 1.0)
    np.testing.assert_array_equal(durations[[0, 2, 3]], merged)
    np.testing.assert_array_equal(durations[[1, 4]], 0.0)


@pytest.mark.parametrize("vias", [1, 2, 4, 7, 12, 20])
def test_a_batch_gives_bit_for_bit_what_each_item_gives_alone(vias, rng):
    waypoints = rng.normal(size=(12, vias + 2, 3))
    waypoints[2] = waypoints[2, 0]
    waypoints[3, 1] = waypoints[3, 0]
    waypoints[4, -2] = waypoints[4, -1]
    waypoints[5, 1] = waypoints[5, 0] + [1e-30, 0.0, 0.0]
    waypoints[6, -2] = waypoints[6, -1] + 1e-9
    duration = rng.uniform(0.5, 2, 12)
    velocity = rng.normal(size=(12, 3)) * (rng.uniform(size=(12, 1)) < 0.5)
    uneven, distinct = 10.0 ** rng.uniform(-9, 0, (12, vias + 1)), rng.normal(size=waypoints.shape)
    together = through(distinct, uneven).coefficients
    for i in range(12):
        np.testing.assert_array_equal(through(distinct[i], uneven[i]).coefficients, together[i])
    for ends in ({}, {"start_velocity": velocity}):
        batch = passage_durations(waypoints, duration, **ends)
        movements = through(waypoints, batch, **ends)
        for i in range(12):
            own = {name: value[i] for name, value in ends.items()}
            alone = passage_durations(waypoints[i], duration[i], **own)
            np.testing.assert_array_equal(alone, batch[i])
            coefficients = through(waypoints[i], alone, **own).coefficients
            np.testing.assert_array_equal(coefficients, movements.coefficients[i])


@pytest.mark.parametrize("goal_velocity", [None, FREE])
@pytest.mark.parametrize("goal_acceleration", [None, FREE])
@pytest.mark.parametrize("pace", [0.3, 3.0, 10.0])
def test_one_via_point_anywhere_with_moving_ends_is_passed_at_the_global_minimum(
    goal_velocity, goal_acceleration, pace, rng
):
    count, early = 150, np.concatenate([np.linspace(0.005, 0.5, 50), np.logspace(-5, -1, 50)])
    waypoints, (velocity, acceleration, given) = (
        rng.normal(size=(count, 3, 2)),
        rng.normal(size=(3, count, 2)),
    )
    near = 10.0 ** rng.uniform(-8, 0, (count, 1))
    waypoints[:60, 1] = waypoints[:60, 0] + near[:60] * waypoints[:60, 1]
    waypoints[60:120, 1] = waypoints[60:120, 2] + near[60:120] * waypoints[60:120, 1]
    ends = {
        "start_velocity": pace * velocity,
        "start_acceleration": pace * acceleration,
        "goal_velocity": pace * given if goal_velocity is None else FREE,
        "goal_acceleration": goal_acceleration,
    }
    cost = through(waypoints, passage_durations(waypoints, 1.0, **ends), **ends).cost()
    for t in (*early, *(1 - early)):
        anywhere = through(waypoints, np.tile([t, 1 - t], (count, 1)), **ends).cost()
        assert (cost <= anywhere * (1 + 1e-9)).all()


@pytest.mark.parametrize("distance", [1e-1, 1e-3, 1e-5, 1e-7, 1e-10, 1e-40, 1e-160, 1e-300])
@pytest.mark.parametrize("rest", ["nowhere", "at the start", "at the goal"])
def test_a_movement_and_its_reversal_pass_at_the_same_instant(distance, rest, rng):
    """Also with moving ends and very near either end, where the instant is known from the nearer one."""
    direction = rng.normal(size=(30, 2))
    via = distance * direction / np.linalg.norm(direction, axis=1)[:, None]
    start, goal = np.zeros((30, 2)), np.broadcast_to([1.0, -2.0], (30, 2))
    here = rng.normal(size=(2, 30, 2)) * (rest != "at the start")
    there = rng.normal(size=(2, 30, 2)) * (rest != "at the goal")
    names = ("start_velocity", "start_acceleration", "goal_velocity", "goal_acceleration")
    forth = dict(zip(names, (*here, *there), strict=True))
    back = dict(zip(names, (-there[0], there[1], -here[0], here[1]), strict=True))
    waypoints = np.stack([start, via, goal], axis=1)
    away = passage_durations(waypoints, 1.0, **forth)
    assert (away > 0).all()
    assert np.isfinite(through(waypoints, away, **forth).coefficients).all()
    # The same seen from the goal: the origin lies there, so that the via-point is as near as it was.
    toward = passage_durations(waypoints[:, ::-1], 1.0, **back)[:, ::-1]
    costs = through(waypoints, away, **forth).cost(), through(waypoints, toward, **forth).cost()
    np.testing.assert_allclose(*costs, rtol=1e-9)
    if distance > 1e-15:  # nearer than rounding, instants are equally good
        np.testing.assert_allclose(toward, away, rtol=2e-9)


LENGTHS = st.floats(-1e6, 1e6, allow_subnormal=False)
"""Coordinates, [m]; relative to the whole path, a subnormal distance is zero."""


@pytest.mark.filterwarnings("error:(invalid|divide)")
@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.example(1e-200 * np.arange(8.0).reshape(4, 2) ** 2, 1.0, True)
@hypothesis.given(
    st.integers(3, 5).flatmap(lambda n: hnp.arrays(float, (n, 2), elements=LENGTHS)),
    st.floats(1e-3, 1e3),
    st.booleans(),
)
def test_any_finite_waypoints_give_a_finite_movement(waypoints, duration, moving):
    ends = {"start_velocity": np.ones(2)} if moving else {}
    durations = passage_durations(waypoints, duration, **ends)
    assert (durations >= 0).all()
    np.testing.assert_allclose(durations.sum(), duration, rtol=1e-14)
    gaps = np.abs(np.diff(waypoints, axis=0)).max(axis=1)
    assert (durations[gaps > 1e-15 * np.abs(waypoints).max()] > 0).all()
    assert (durations[:-1][gaps[:-1] == 0] == 0).all()
    movement = through(waypoints, durations, **ends)
    assert np.isfinite(movement.coefficients).all()
    assert np.isfinite(movement.sample(9)).all()
