"""Fits of via-points: what was put in comes out, in any frame, and nothing near it fits better."""

import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from viapoint.primitives import fit_via_points, through

ENDS = pytest.mark.parametrize("free_ends", [False, True])


def movement(rng, n_via, dimension=2):
    """Waypoints, durations and trajectory of a random movement, whose via-points are apart in time."""
    waypoints = rng.uniform(-0.3, 0.3, (n_via + 2, dimension))
    durations = rng.uniform(0.5, 1.5, n_via + 1)
    return waypoints, durations, through(waypoints, durations)


def samples(trajectory, free_ends, rng, count=100, noise=0.0):
    """Times and positions of a movement; with free ends, from before its onset or after it until likewise its end."""
    duration = float(trajectory.duration)
    before, after = rng.uniform(-0.06, 0.2, 2) * duration * free_ends
    time = np.linspace(-before, duration + after, count)
    return time, trajectory(time) + noise * rng.normal(size=(count, trajectory.dimension))


def assert_same(found, expected, atol=1e-7):
    for name in ("via_points", "passage_times", "start", "goal", "onset", "end", "r_squared", "noise"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=atol, err_msg=name)


@ENDS
@given(st.integers(0, 2), st.integers(1, 3), st.integers(0, 10**6))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_without_noise_the_movement_is_recovered(free_ends, n_via, dimension, seed):
    rng = np.random.default_rng(seed)
    waypoints, durations, trajectory = movement(rng, n_via, max(dimension, 1 + (n_via > 0)))
    time, position = samples(trajectory, free_ends, rng)
    fit = fit_via_points(time, position, n_via, free_ends=free_ends)
    knots = np.concatenate(([0.0], np.cumsum(durations)))
    np.testing.assert_allclose(fit.via_points, waypoints[1:-1], atol=1e-5)
    np.testing.assert_allclose(fit.passage_times, knots[1:-1], atol=1e-5)
    np.testing.assert_allclose([fit.onset, fit.end], knots[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(fit(time), position, atol=1e-7)
    assert 1.0 - fit.r_squared < 1e-12


@ENDS
@pytest.mark.parametrize("seed", range(4))
def test_a_fit_moves_with_space_and_time(free_ends, seed):
    rng = np.random.default_rng(seed)
    _, _, trajectory = movement(rng, 1 + seed % 2)
    time, position = samples(trajectory, free_ends, rng, noise=0.001)
    n_via = 1 + seed % 2
    fit = fit_via_points(time, position, n_via, free_ends=free_ends)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved = fit_via_points(
        3.0 * time - 7.0, 20.0 * position @ turn.T + [5.0, 6.0], n_via, free_ends=free_ends
    )
    np.testing.assert_allclose(moved.via_points, 20.0 * fit.via_points @ turn.T + [5.0, 6.0], atol=1e-4)
    for name in ("passage_times", "onset", "end"):
        np.testing.assert_allclose(getattr(moved, name), 3.0 * getattr(fit, name) - 7.0, atol=1e-5)
    np.testing.assert_allclose(moved.r_squared, fit.r_squared, atol=1e-9)
    np.testing.assert_allclose(moved.noise, 20.0 * fit.noise, rtol=1e-6)


def squares_at(knots, time, position):
    """Least sum of squared residuals with given times, from basis movements and a linear solver."""
    count = len(knots)
    columns = [
        through(np.eye(count)[:, k : k + 1], np.diff(knots))(time - knots[0])[:, 0] for k in range(count)
    ]
    basis = np.stack(columns, axis=-1)
    solution = np.linalg.lstsq(basis, position)[0]
    return np.square(basis @ solution - position).sum()


@ENDS
@pytest.mark.parametrize("n_via", [1, 2, 3])
def test_no_other_times_nearby_fit_better(free_ends, n_via, rng):
    _, _, trajectory = movement(rng, n_via)
    time, position = samples(trajectory, free_ends, rng, noise=0.003)
    fit = fit_via_points(time, position, n_via, free_ends=free_ends)
    knots = np.concatenate(([fit.onset], fit.passage_times, [fit.end]))
    least = squares_at(knots, time, position)
    assert least == pytest.approx(np.square(fit(time) - position).sum(), rel=1e-9)
    assert float(fit.noise) == pytest.approx(0.003, rel=0.2)
    for size in (1e-4, 1e-3, 1e-2):
        for _ in range(20):
            change = size * rng.normal(size=n_via + 2)
            change[[0, -1]] *= free_ends
            assert squares_at(knots + change, time, position) >= least * (1.0 - 1e-9)


def test_the_noise_is_not_that_which_the_fit_explains():
    """With few samples, residuals are smaller than the noise by the share of the fitted numbers."""
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        time, position = samples(movement(rng, 1)[2], False, rng, 12, noise=0.002)
        squares.append(float(fit_via_points(time, position, 1, free_ends=False).noise) ** 2)
    assert 0.0018 < math.sqrt(np.mean(squares)) < 0.0022


@pytest.mark.parametrize(
    ("lost", "value", "jump"),
    [(slice(0, 1), 0, 1), (slice(20, 21), 0, 20), (slice(20, 22), 0, 20), (slice(20, 32), 20, 32)],
)
def test_samples_of_a_lost_marker_are_told_until_they_are_left_out(lost, value, jump):
    time = np.linspace(0.0, 1.0, 60)
    good = through([[0.2, 0.5], [0.4, 0.6], [0.6, 0.5]], [0.4, 0.6])(time)
    bad = good.copy()
    bad[lost] = good[value] if value else 0.0  # held, or lost
    with pytest.warns(UserWarning, match=f"sample {jump} of movement 1, at "):
        fit_via_points(time, [good, bad], 1)
    fit_via_points(np.delete(time, lost), np.delete(good, lost, axis=0), 1)


@pytest.mark.parametrize("count", [5, 6, 7, 9, 10])
def test_too_few_samples_are_told_with_the_via_points_that_they_allow(count, rng):
    time, position = samples(movement(rng, 0)[2], False, rng, count)
    with pytest.raises(ValueError, match=r"n_via=\d") as told:
        fit_via_points(time, position)
    most = int(re.search(r"n_via=(\d)", str(told.value))[1])
    assert fit_via_points(time, position, (0, most)).n_via == 0
    with pytest.raises(ValueError):
        fit_via_points(time, position, most + 1)


@pytest.mark.parametrize("part", [slice(0, 50), slice(50, 100), slice(30, 70)])
def test_via_points_are_passed_within_the_recording(part, rng):
    for _ in range(5):
        time, position = samples(movement(rng, 2)[2], False, rng)
        fit = fit_via_points(time[part], position[part], 2)
        assert time[part][0] < fit.passage_times[0] < fit.passage_times[1] < time[part][-1]


def test_the_number_of_via_points_is_found_where_noise_is_low():
    right = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        _, _, trajectory = movement(rng, seed % 3)
        time, position = samples(trajectory, seed % 2 == 0, rng, noise=0.0005)
        right += int(fit_via_points(time, position, free_ends=seed % 2 == 0).n_via) == seed % 3
    assert right >= 19


def test_a_batch_holds_the_fits_of_its_movements(rng):
    several = []
    for n_via in (0, 2):
        several.append(samples(movement(rng, n_via)[2], True, rng, noise=0.001))
    time, position = (np.stack(part) for part in zip(*several, strict=True))
    batch = fit_via_points(time[None], position[None])
    starts = 5 * np.arange(2)  # movements of a list may have different lengths
    parts = [(own[0][start:], own[1][start:]) for own, start in zip(several, starts, strict=True)]
    listed = fit_via_points([own_time for own_time, _ in parts], [own_position for _, own_position in parts])
    np.testing.assert_array_equal(batch(0.3, 1), batch([0.3], 1)[..., 0, :])
    assert batch.via_points.shape == (1, 2, 2, 2)
    assert listed.via_points.shape == (2, 2, 2)
    for i in range(2):
        for found, row, recording in ((batch, (0, i), several[i]), (listed, (i,), parts[i])):
            one = fit_via_points(*recording)
            count = int(one.n_via)
            np.testing.assert_array_equal(found.via_points[row][:count], one.via_points)
            assert np.isnan(found.via_points[row][count:]).all()
            assert np.isnan(found.passage_times[row][count:]).all()
            np.testing.assert_array_equal(found.bic[row], one.bic)
            np.testing.assert_allclose(found(recording[0])[row], one(recording[0]), atol=1e-12)
    shared = fit_via_points(time[0], [position[0], position[0]], 1)
    np.testing.assert_array_equal(shared.end[0], shared.end[1])


def test_the_kind_of_the_positions_is_kept(rng):
    time, position = samples(movement(rng, 1)[2], True, rng, noise=0.001)
    expected = fit_via_points(time, position, 1)
    tensors = fit_via_points(torch.tensor(time), torch.tensor(position), 1)
    assert isinstance(tensors.trajectory.coefficients, torch.Tensor)
    assert_same(tensors, expected)
    np.testing.assert_allclose(tensors(torch.tensor(time), 1), expected(time, 1), atol=1e-9)
    assert isinstance(tensors.n_via, torch.Tensor)
    single = fit_via_points(time.astype(np.float32), position.astype(np.float32), 1)
    assert single.via_points.dtype == np.float32
    assert_same(single, expected, atol=1e-3)


@pytest.mark.parametrize("kind", [np.asarray, list, lambda time: np.rint(1e9 * time).astype(np.int64)])
def test_clocks_of_many_digits_may_come_with_positions_of_few(kind, rng):
    time, position = samples(movement(rng, 1)[2], True, rng, noise=0.001)
    expected = fit_via_points(time, position, 1)
    clock = kind(time + 1e5)
    found = fit_via_points(clock, position.astype(np.float32), 1)
    unit = np.ptp(clock) / np.ptp(time)
    np.testing.assert_allclose(found.duration / unit, expected.duration, atol=1e-4)
    np.testing.assert_allclose(found.via_points, expected.via_points, atol=1e-4)


@pytest.mark.parametrize("length", [15.0, 60.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_movement_is_found_among_long_rests(length, share, rng):
    waypoints, _, trajectory = movement(rng, 1)
    duration = float(trajectory.duration)
    onset = 0.1 + share * (length - 0.2 - duration)
    time = np.arange(0.0, length, 0.01)
    inside = np.clip(time - onset, 0.0, duration)
    fit = fit_via_points(time, trajectory(inside) + rng.normal(0.0, 5e-4, (len(time), 2)))
    assert fit.n_via == 1
    np.testing.assert_allclose((fit.onset, fit.end), (onset, onset + duration), atol=0.05)
    np.testing.assert_allclose(fit.via_points, waypoints[1:-1], atol=0.02)
