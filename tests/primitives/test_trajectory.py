"""Laws of a trajectory: what it passes, that nothing near it costs less, its extremes, and that nothing changes it."""

import copy
import pickle
from itertools import pairwise

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis.extra import numpy as hnp
from scipy.integrate import quad
from scipy.interpolate import make_interp_spline

from viapoint.primitives import minimum_duration, passage_durations, point_to_point, retarget, through


def random_movement(rng, vias, order=3, batch=(), dimension=2):
    waypoints = rng.normal(size=(*batch, vias + 2, dimension))
    durations = rng.uniform(0.2, 1.0, (*batch, vias + 1))
    names = ["start_velocity", "goal_velocity", "start_acceleration", "goal_acceleration"]
    ends = {name: rng.normal(size=(*batch, dimension)) for name in names[: 4 if order > 2 else 2]}
    return waypoints, durations, ends


def test_given_via_velocities_are_met_with_continuous_acceleration(rng):
    waypoints, durations, ends = random_movement(rng, 2)
    velocities = rng.normal(size=(2, 2))
    trajectory = through(waypoints, durations, via_velocities=velocities, **ends)
    knots = trajectory.knots[1:-1]
    np.testing.assert_allclose(trajectory(knots, 1), velocities, atol=1e-12)
    np.testing.assert_allclose(trajectory(knots, 2), trajectory(knots - 1e-10, 2), atol=1e-6)
    free = through(waypoints, durations, **ends)
    assert trajectory.cost() > free.cost()
    best = through(waypoints, durations, via_velocities=free(knots, 1), **ends)
    np.testing.assert_allclose(best.coefficients, free.coefficients, atol=1e-11)


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("vias", [0, 1, 3, 12])
def test_equals_scipys_spline_with_clamped_ends(vias, order, rng):
    waypoints, durations, ends = random_movement(rng, vias, order)
    trajectory = through(waypoints, durations, order=order, **ends)
    np.testing.assert_allclose(trajectory(trajectory.knots), waypoints, atol=1e-11)
    values = [("velocity", 1), ("acceleration", 2)][: order - 1]
    clamped = [[(nu, ends[f"{end}_{name}"]) for name, nu in values] for end in ("start", "goal")]
    if order == 4:  # no jerk at the ends
        clamped = [[*end, (3, np.zeros(2))] for end in clamped]
    spline = make_interp_spline(trajectory.knots, waypoints, k=2 * order - 1, bc_type=tuple(clamped))
    time = np.linspace(0, float(trajectory.duration), 101)
    for nu in range(2 * order - 1):
        reference = spline(time, nu)
        np.testing.assert_allclose(trajectory(time, nu), reference, atol=1e-9 * np.abs(reference).max())
    assert (trajectory(time, 2 * order) == 0).all()


@pytest.mark.parametrize("order", [2, 3, 4])
def test_cost_is_the_integral(order, rng):
    waypoints, durations, ends = random_movement(rng, 2, order)
    trajectory = through(waypoints, durations, order=order, **ends)
    knots = trajectory.knots
    total = sum(
        quad(lambda t: 0.5 * np.sum(trajectory(t, order) ** 2), a, b, epsabs=0, epsrel=1e-12)[0]
        for a, b in pairwise(knots)
    )
    np.testing.assert_allclose(trajectory.cost(), total, rtol=1e-12)


def test_movement_turns_shifts_grows_and_stretches_with_its_points(rng):
    waypoints, durations, ends = random_movement(rng, 2)
    angle = 0.7
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift, scale, pace = np.array([100.0, -3.0]), 2.5, 1.7
    plain = through(waypoints, durations, **ends)
    turned = {name: scale * value @ rotation.T for name, value in ends.items()}
    elsewhere = through(scale * waypoints @ rotation.T + shift, durations, **turned)
    time = np.linspace(-0.1, float(plain.duration) + 0.1, 33)
    moved = plain.transformed(rotation, shift, scale)
    for nu in range(4):
        size = np.abs(elsewhere(time, nu)).max()
        np.testing.assert_allclose(moved(time, nu), elsewhere(time, nu), atol=1e-11 * size)
    slow = plain.stretched(pace * plain.duration)
    for nu in range(4):
        np.testing.assert_allclose(slow(pace * time, nu), plain(time, nu) / pace**nu, atol=1e-10)
    np.testing.assert_allclose(slow.cost(), plain.cost() / pace**5, rtol=1e-13)


@pytest.mark.parametrize("own_durations", [True, False])
@pytest.mark.parametrize("pace", [2.0, np.array([2.0, 1.5, 0.3, 1.0])])
def test_knots_are_stretched_with_their_movements(own_durations, pace, rng):
    waypoints, durations, _ = random_movement(rng, 2, batch=(4,))
    plain = through(waypoints, durations if own_durations else durations[0])
    slow = plain.stretched(pace)
    expected = plain.knots * (pace / plain.duration)[:, None]
    np.testing.assert_allclose(slow.knots, expected, rtol=1e-14)
    np.testing.assert_allclose(slow(slow.knots), waypoints, atol=1e-12)


def test_a_single_time_may_be_an_array_of_its_own_library(rng):
    movement = through(rng.normal(size=(4, 2)), np.full(3, 0.3))
    end = movement(float(movement.duration))
    for time in (movement.duration, np.float64(movement.duration)):
        np.testing.assert_array_equal(movement(time), end)
    in_torch = through(torch.tensor(rng.normal(size=(3, 2))), torch.full((2,), 0.3))
    assert in_torch(in_torch.duration, 1).shape == (2,)


def test_outside_the_movement_the_end_points_are_held_at_rest(rng):
    waypoints, durations, ends = random_movement(rng, 1)
    trajectory = through(waypoints, durations, **ends)
    end = float(trajectory.duration)
    outside = np.array([-5.0, -1e-9, end + 1e-9, end + 9.0])
    np.testing.assert_allclose(trajectory(outside), waypoints[[0, 0, -1, -1]], atol=1e-14)
    assert (trajectory(outside, 1) == 0).all()
    np.testing.assert_allclose(trajectory([end], 1)[0], ends["goal_velocity"], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", [np, torch])
def test_the_total_of_the_durations_is_not_after_the_end(kind, dtype, rng):
    waypoints = kind.asarray(rng.normal(size=(300, 4, 2)).astype(dtype))
    movement = through(waypoints, passage_durations(waypoints, 0.7))
    assert (movement.duration != 0.7).any()
    last, alone = movement([0.1, 0.7, 0.8], 3)[:, 1], movement(0.7, 3)
    np.testing.assert_allclose(last, movement.sample(2, 3)[0][:, 1], rtol=1e4 * np.finfo(dtype).eps)
    np.testing.assert_allclose(alone, last, rtol=1e4 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("vias", [0, 1, 3])
def test_a_batch_gives_bit_for_bit_what_each_item_gives_alone(vias, dimension, rng):
    waypoints, durations, ends = random_movement(rng, vias, batch=(70,), dimension=dimension)
    batch = through(waypoints, durations, **ends)
    answers = (batch.coefficients, batch.cost(), batch.peak(1), batch.extrema(2).maximum)
    for count in (0, 1, 2, 3, 4, 7, 8, 12, 50, 200):  # few times have layouts of their own
        times, number = rng.uniform(-0.1, 4, (70, count)), max(2, count)
        together = [*batch.sample(times), *batch.sample(times[0], nu=(0, 4)), *batch.sample(number)]
        for i in (0, 1, 33, 69):
            for items in (i, slice(i, i + 1)):
                own = {name: value[items] for name, value in ends.items()}
                alone = through(waypoints[items], durations[items], **own)
                single = (alone.coefficients, alone.cost(), alone.peak(1), alone.extrema(2).maximum)
                for whole, part in zip(answers, single, strict=True):
                    np.testing.assert_array_equal(whole[items], part)
                parts = [
                    *alone.sample(times[items]),
                    *alone.sample(times[0], nu=(0, 4)),
                    *alone.sample(number),
                ]
                for whole, part in zip(together, parts, strict=True):
                    np.testing.assert_array_equal(whole[items], part)


def test_a_dropped_via_point_leaves_the_others():
    waypoints = np.array([[0.0, 0], [0, 0], [1, 1], [2, 0], [2, 0]])
    ends = {"start_velocity": np.array([2.0, 1.0]), "goal_velocity": np.array([3.0, 1.0])}
    trajectory = through(waypoints, [0.0, 0.4, 0.6, 0.0], **ends)
    plain = through(waypoints[[0, 2, 3]], [0.4, 0.6], **ends)
    time = np.linspace(0.0, 0.999, 61)
    for nu in range(6):
        np.testing.assert_allclose(trajectory(time, nu), plain(time, nu), atol=1e-9)
    np.testing.assert_allclose(trajectory.cost(), plain.cost(), rtol=1e-13)
    np.testing.assert_allclose(trajectory([1.0], 1), [ends["goal_velocity"]], atol=1e-12)
    least = trajectory.extrema(1).minimum  # a dropped via-point does not count as standing still
    np.testing.assert_allclose(least, plain.extrema(1).minimum, atol=1e-9)


@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(*[hnp.array_shapes(min_dims=0, max_dims=3, max_side=4)] * 2)
def test_leading_dimensions_broadcast_or_are_refused(points, times):
    fits = (
        len(points) >= 2
        and points[-2] >= 2
        and len(times) >= 1
        and times[-1] == points[-2] - 1
        and all(a == b or 1 in (a, b) for a, b in zip(points[-3::-1], times[-2::-1], strict=False))
    )
    if not fits:
        with pytest.raises(ValueError):
            through(np.ones(points), np.ones(times))
        return
    movement, batch = through(np.ones(points), np.ones(times)), np.broadcast_shapes(points[:-2], times[:-1])
    assert movement.duration.shape == movement.cost().shape == batch
    assert movement.knots.shape == (*batch, points[-2])
    assert movement.sample(3, 0)[0].shape == (*batch, 3, points[-1])


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("nu", [0, 1, 2, 3])
def test_no_sample_exceeds_the_extremes_and_dense_samples_reach_them(nu, order, rng):
    waypoints, durations, ends = random_movement(rng, 2, order, batch=(25,))
    trajectory = through(waypoints, durations, order=order, **ends)
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


@pytest.mark.parametrize(
    "limits",
    [
        {"velocity": 0.7},
        {"acceleration": np.array([3.0, 2.0])},
        {"velocity": np.full((25, 1), 0.4), "acceleration": 5.0, "jerk": np.array([9.0, 30.0])},
    ],
)
def test_the_performance_limited_movement_touches_a_limit_and_exceeds_none(limits, rng):
    waypoints, durations, ends = random_movement(rng, 2, batch=(25,))
    trajectory = through(waypoints, durations, **ends)
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


FIELDS = ("coefficients", "durations", "starts", "rates", "end", "duration")


def with_a_dropped_via_point(points, durations):
    points[..., 1, :] = points[..., 0, :]
    durations[..., 0] = 0.0
    return through(points, durations)


def derived(points, durations):
    reach = point_to_point(points[..., 0, :], points[..., 1, :], durations[..., 0])
    moved = reach.stretched(durations[..., 1]).transformed(translation=points[..., 1, :])
    return retarget(moved, 0.1, points[..., 2, :], durations[..., 0])


def answers(movement):
    return [movement.extrema(1).maximum, *movement.sample(7), movement.knots, movement.cost(), movement.end]


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("make", [through, with_a_dropped_via_point, derived])
def test_nothing_written_later_changes_a_trajectory(kind, make):
    points = kind.zeros((3, 3, 2)) + kind.asarray([[0.0], [1.0], [3.0]])
    durations = kind.ones((3, 2))
    movement = make(points, durations)
    given = answers(movement)
    before = [np.array(np.asarray(part)) for part in given]
    points[...], durations[...] = 7.0, 9.0
    for array in given[:4]:
        array[...] = 7.0
    copies = copy.copy(movement), copy.deepcopy(movement), pickle.loads(pickle.dumps(movement))
    for each in (movement, *copies):
        for was, now in zip(before, answers(each), strict=True):
            np.testing.assert_array_equal(now, was)
        for name in FIELDS if kind is np else ():
            with pytest.raises(ValueError):
                getattr(each, name)[...] = 0
    with pytest.raises(AttributeError):
        movement.order = 4
