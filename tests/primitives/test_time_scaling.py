"""Exact extremes, and the shortest duration within limits."""

import numpy as np
import pytest
import torch

from viapoint.primitives import minimum_duration, point_to_point, through


def movements(rng, count=25, vias=2, order=3):
    waypoints = rng.normal(size=(count, vias + 2, 2))
    durations = rng.uniform(0.2, 1.0, (count, vias + 1))
    return through(waypoints, durations, start_velocity=rng.normal(size=(count, 2)), order=order)


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("nu", [0, 1, 2, 3])
def test_no_sample_exceeds_the_extremes_and_dense_samples_reach_them(nu, order, rng):
    trajectory = movements(rng, order=order)
    values = trajectory.sample(5001, nu)[0]
    norm = np.linalg.norm(values, axis=-1).max(axis=1)
    peak = trajectory.peak(nu)
    assert (norm <= peak * (1 + 1e-9)).all()
    np.testing.assert_allclose(norm, peak, rtol=2e-3)
    extrema = trajectory.extrema(nu)
    size = np.abs(values).max(axis=(1, 2))[:, None]
    assert (values.max(axis=1) <= extrema.maximum + 1e-9 * size).all()
    assert (values.min(axis=1) >= extrema.minimum - 1e-9 * size).all()
    np.testing.assert_allclose(values.max(axis=1) / size, extrema.maximum / size, atol=2e-3)
    if nu < 2 * order - 2:  # continuous: the value is reached at the time given
        for d in range(2):
            at = trajectory(extrema.minimum_time[:, d, None], nu)[:, 0, d]
            np.testing.assert_allclose(at, extrema.minimum[:, d], atol=1e-9 * size.max())


def test_a_dropped_via_point_does_not_count_as_standing_still():
    trajectory = through([[0.0], [0.0], [1.0]], [0.0, 1.0], start_velocity=[2.0], goal_velocity=[3.0])
    assert trajectory.extrema(1).minimum > -10
    plain = point_to_point([0.0], [1.0], 1.0, start_velocity=[2.0], goal_velocity=[3.0])
    np.testing.assert_allclose(trajectory.extrema(1).minimum, plain.extrema(1).minimum)


@pytest.mark.parametrize(
    "limits",
    [
        {"velocity": 0.7},
        {"acceleration": np.array([3.0, 2.0])},
        {"velocity": np.full((25, 1), 0.4), "acceleration": 5.0, "jerk": np.array([9.0, 30.0])},
    ],
)
def test_the_performance_limited_movement_touches_a_limit_and_exceeds_none(limits, rng):
    trajectory = movements(rng)
    limited = trajectory.stretched(minimum_duration(trajectory, **limits))
    ratios = []
    for nu, name in enumerate(("velocity", "acceleration", "jerk"), start=1):
        if name not in limits:
            continue
        limit = np.asarray(limits[name])
        if limit.ndim == 0 or limit.shape[-1] == 1:
            ratios.append(limited.peak(nu) / (limit[..., 0] if limit.ndim else limit))
        else:
            extrema = limited.extrema(nu)
            ratios.append((np.maximum(-extrema.minimum, extrema.maximum) / limit).max(axis=-1))
    np.testing.assert_allclose(np.max(ratios, axis=0), 1.0, rtol=1e-12)


@pytest.mark.parametrize("size", [1e-200, 1e-9, 1.0, 1e200])
@pytest.mark.parametrize("kind", [np, torch])
def test_peaks_of_any_size_and_pace_are_right(kind, size):
    points = kind.asarray([[0.0, 0.0], [3.0, 4.0]], dtype=kind.float64) * size
    movement = point_to_point(points[0], points[1], 2.0)
    for nu, factor in ((1, 1.875), (2, 10 / np.sqrt(3)), (3, 60), (6, 0)):
        np.testing.assert_allclose(movement.peak(nu), factor * 5 * size / 2**nu, rtol=1e-14)
    np.testing.assert_allclose(movement.extrema(1).maximum[1], 1.875 * 4 * size / 2, rtol=1e-14)
    np.testing.assert_allclose(movement.extrema(1).maximum_time, [1.0, 1.0], rtol=1e-7)
    brief = point_to_point([0.0, 0.0], [1.0, 1.0], 1e-300)
    np.testing.assert_allclose(brief.peak(1), 1.875e300 * 2**0.5, rtol=1e-14)
    np.testing.assert_allclose(minimum_duration(brief, velocity=1.0), 1.875 * 2**0.5, rtol=1e-14)
