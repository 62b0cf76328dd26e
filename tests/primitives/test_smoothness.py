"""Measures of smoothness: closed forms, invariances, and what the paper says about speed and curvature."""

import numpy as np
import pytest
import torch

import viapoint.primitives as vp

MEASURES = [vp.dimensionless_jerk, vp.log_dimensionless_jerk, vp.spectral_arc_length]


def via_movement(along, across, duration=1.0):
    """From (0, 0) to (1, 0) by way of (along, across)."""
    waypoints = np.array([[0.0, 0.0], [along, across], [1.0, 0.0]])
    return vp.through(waypoints, vp.passage_durations(waypoints, duration))


@pytest.mark.parametrize("duration", [0.5, 1.0, 3.0])
def test_the_straight_reach_has_its_closed_forms(duration):
    reach = vp.point_to_point([0.0, 0.0], [0.3, 0.4], duration)
    np.testing.assert_allclose(reach.energy(3), 720 * 0.25 / duration**5, rtol=1e-13)
    np.testing.assert_allclose(vp.dimensionless_jerk(reach), 204.8, rtol=1e-12)
    np.testing.assert_allclose(vp.log_dimensionless_jerk(reach), -5.3220, atol=5e-5)
    np.testing.assert_allclose(vp.spectral_arc_length(reach), -1.4024, atol=5e-5)
    np.testing.assert_allclose(vp.spectral_arc_length(reach.stretched(0.005)), -1.0, atol=1e-3)


@pytest.mark.parametrize("measure", MEASURES)
def test_measures_do_not_depend_on_place_size_or_orientation_nor_jerk_on_duration(measure, rng):
    waypoints = rng.normal(size=(6, 4, 2))
    movement = vp.through(waypoints, vp.passage_durations(waypoints, 1.0))
    moved = movement.transformed(np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([5.0, 6.0]), 3.0)
    if measure is not vp.spectral_arc_length:
        moved = moved.stretched(7.0)
    np.testing.assert_allclose(measure(moved), measure(movement), rtol=1e-9)


@pytest.mark.parametrize("height", [0.4, -0.4])
def test_curvature_is_that_of_the_path_and_in_space_its_size(height):
    movement = via_movement(0.3, height)
    time = np.linspace(0.2, 0.8, 7)
    step = 1e-5
    heading = [np.arctan2(*movement(time + s, 1).T[::-1]) for s in (-step, step)]
    turning = (heading[1] - heading[0]) / (2 * step)
    np.testing.assert_allclose(vp.curvature(movement, time), turning / vp.speed(movement, time), rtol=1e-6)
    lifted = movement.transformed(np.eye(3)[:, :2])
    np.testing.assert_allclose(vp.curvature(lifted, time), np.abs(vp.curvature(movement, time)), rtol=1e-12)


@pytest.mark.parametrize(("height", "valleys"), [(0.28, 0), (9 / 32 - 1e-4, 0), (9 / 32 + 1e-4, 1), (1.0, 1)])
def test_a_symmetric_via_point_makes_a_speed_valley_beyond_nine_thirty_seconds(height, valleys):
    movement = via_movement(0.5, height)
    found = vp.speed_valleys(movement)
    assert found.time.shape == (valleys,)
    assert vp.speed_peaks(movement).time.shape == (valleys + 1,)
    np.testing.assert_allclose(found.time, 0.5, atol=1e-9)


def test_speed_events_are_local_extremes_and_pad_with_nan(rng):
    waypoints = rng.normal(size=(12, 5, 2))
    waypoints[0] = np.linspace([0, 0], [1, 1], 5)
    movement = vp.through(waypoints, vp.passage_durations(waypoints, 2.0))
    for events, sign in ((vp.speed_valleys(movement), 1), (vp.speed_peaks(movement), -1)):
        exists = ~np.isnan(events.time)
        assert exists[1:].any()
        time = np.where(exists, events.time, 1.0)
        for shift in (-1e-4, 1e-4):
            nearby = vp.speed(movement, time + shift)
            assert (sign * (nearby - events.speed)[exists] > -1e-12).all()
    assert np.isnan(vp.speed_valleys(movement).time[0]).all()
    assert (~np.isnan(vp.speed_peaks(movement).time[0])).sum() == 1


def test_limits_of_the_measures():
    still = vp.point_to_point([1.0, 1.0], [1.0, 1.0], 1.0)
    assert np.isnan(vp.dimensionless_jerk(still))
    assert vp.speed_valleys(still).time.shape == (0,)
    assert np.isnan(vp.curvature(via_movement(0.5, 0.3), [0.0])).all()
    steady = vp.point_to_point([0.0], [1.0], 0.5, start_velocity=[2.0], goal_velocity=[2.0])
    assert vp.dimensionless_jerk(steady) == 0
    assert vp.log_dimensionless_jerk(steady) == np.inf


def test_a_recording_has_the_smoothness_of_its_movement():
    movement, time = via_movement(0.3, 0.4), np.linspace(0.0, 1.0, 101)
    recording = vp.through(movement(time), np.diff(time))
    for measure in MEASURES:
        np.testing.assert_allclose(measure(recording), measure(movement), rtol=1e-6)
    np.testing.assert_allclose(vp.speed_peaks(recording).time, vp.speed_peaks(movement).time, atol=1e-6)
    with pytest.raises(ValueError, match="its attribute `trajectory`"):
        vp.log_dimensionless_jerk(vp.fit_via_points(time, movement(time), 1))


@pytest.mark.parametrize("size", [1e-300, 1e-200, 1e-110, 1e110, 1e200, 1e300])
def test_measures_hold_for_any_size(size):
    movement = via_movement(0.3, 0.5)
    other = movement.transformed(scale=size)
    time = np.linspace(0.1, 0.9, 9)
    np.testing.assert_allclose(vp.speed(other, time) / size, vp.speed(movement, time), rtol=1e-13)
    np.testing.assert_allclose(vp.curvature(other, time) * size, vp.curvature(movement, time), rtol=1e-12)
    np.testing.assert_allclose(
        vp.speed_valleys(other).speed / size, vp.speed_valleys(movement).speed, rtol=1e-9
    )
    for measure in MEASURES:
        np.testing.assert_allclose(measure(other), measure(movement), rtol=1e-12)


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("duration", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_measures_of_single_precision_are_those_of_double_precision(kind, size, duration, rng):
    waypoints = size * np.concatenate([rng.normal(size=(40, 3, 2)), [[[0, 0], [0.3, 0.5], [1, 0]]]])
    parts = kind.asarray(waypoints, dtype=kind.float32), kind.asarray(duration, dtype=kind.float32)
    single = vp.through(parts[0], vp.passage_durations(*parts))
    double = vp.through(waypoints, np.asarray(vp.passage_durations(*parts), float))
    for measure in MEASURES:
        np.testing.assert_allclose(measure(single), measure(double), rtol=1e-3)
    for events in (vp.speed_valleys, vp.speed_peaks):
        found, expected = events(single).time, events(double).time
        assert found.shape == expected.shape
        np.testing.assert_allclose(found / duration, expected / duration, atol=2e-3)
