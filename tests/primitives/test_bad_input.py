"""Bad input never passes and never surprises: one ValueError that names the argument and says what came."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from viapoint.primitives import (
    FREE,
    Trajectory,
    minimum_jerk_coefficients,
    passage_durations,
    point_to_point,
    retarget,
    through,
)

BAD_NUMBERS = st.sampled_from([np.nan, np.inf, -np.inf])
FEW = settings(max_examples=40, deadline=None)


def spoil(array, where, value):
    spoilt = np.array(array, dtype=float)
    spoilt.flat[where % spoilt.size] = value
    return spoilt


@FEW
@given(
    BAD_NUMBERS,
    st.integers(0, 100),
    st.sampled_from(["start", "goal", "start_velocity", "goal_acceleration"]),
)
def test_point_to_point_names_the_argument_that_is_not_finite(value, where, name):
    arguments = {"start": np.zeros((4, 2)), "goal": np.ones((4, 2)), "duration": 1.0}
    arguments[name] = spoil(np.ones((4, 2)), where, value)
    with pytest.raises(
        ValueError, match=rf"^{name} must be finite, got -?(nan|inf) at index .* \(shape \(4, 2\)\)"
    ):
        point_to_point(**arguments)


@FEW
@given(BAD_NUMBERS, st.integers(0, 100), st.sampled_from(["waypoints", "durations", "via_velocities"]))
def test_through_names_the_argument_that_is_not_finite(value, where, name):
    arguments = {"waypoints": np.zeros((4, 2)), "durations": np.ones(3), "via_velocities": np.ones((2, 2))}
    arguments[name] = spoil(arguments[name], where, value)
    with pytest.raises(ValueError, match=f"^{name} must be finite"):
        through(**arguments)


@FEW
@given(st.floats(max_value=0.0, allow_nan=False, allow_infinity=False), st.integers(0, 4))
def test_durations_must_be_positive(value, where):
    waypoints = np.arange(12.0).reshape(6, 2)
    with pytest.raises(ValueError, match=r"^durations .*, got"):
        through(waypoints, spoil(np.ones(5), where, value))
    for function in (lambda d: point_to_point([0.0], [1.0], d), lambda d: passage_durations(waypoints, d)):
        with pytest.raises(ValueError, match=r"^duration must be positive, got"):
            function(value)
    with pytest.raises(ValueError, match="duration"):
        point_to_point([0.0], [1.0], 1.0).stretched(value)
    with pytest.raises(ValueError, match="T"):
        minimum_jerk_coefficients(0, 0, 0, 1, 0, 0, value)


@FEW
@given(
    hnp.array_shapes(min_dims=0, max_dims=3, max_side=4), hnp.array_shapes(min_dims=0, max_dims=3, max_side=4)
)
def test_shapes_fit_or_are_named(points, times):
    fits = (
        len(points) >= 2
        and points[-2] >= 2
        and len(times) >= 1
        and times[-1] == points[-2] - 1
        and all(a == b or 1 in (a, b) for a, b in zip(points[-3::-1], times[-2::-1], strict=False))
    )
    if fits:
        trajectory = through(np.random.default_rng(0).normal(size=points), np.ones(times))
        batch = np.broadcast_shapes(points[:-2], times[:-1])
        assert trajectory.duration.shape == batch
        assert trajectory.knots.shape == (*batch, points[-2])
        assert trajectory.cost().shape == batch
        assert trajectory.sample(3, 0)[0].shape == (*batch, 3, points[-1])
    else:
        with pytest.raises(ValueError, match=r"waypoints|durations|leading dimensions"):
            through(np.ones(points), np.ones(times))


LENGTHS = st.floats(-1e6, 1e6, allow_subnormal=False)
"""Coordinates, [m]; relative to the whole path, a subnormal distance is zero."""


@pytest.mark.filterwarnings("ignore:passage times:RuntimeWarning")
@settings(max_examples=150, deadline=None)
@given(
    st.integers(3, 5).flatmap(lambda n: hnp.arrays(float, (n, 2), elements=LENGTHS)),
    st.floats(1e-3, 1e3),
    st.booleans(),
)
def test_any_finite_waypoints_give_a_finite_movement(waypoints, duration, moving):
    ends = {"start_velocity": np.ones(2)} if moving else {}
    durations = passage_durations(waypoints, duration, **ends)
    assert (durations >= 0).all()
    np.testing.assert_allclose(durations.sum(), duration, rtol=1e-14)
    assert ((durations > 0) == (np.diff(waypoints, axis=0) != 0).any(axis=1))[:-1].all()
    movement = through(waypoints, durations, **ends)
    assert np.isfinite(movement.coefficients).all()
    assert np.isfinite(movement.sample(9)).all()


@FEW
@given(st.one_of(st.integers(-3, 1), st.integers(5, 9), st.sampled_from([2.5, "3", None, True])))
def test_orders_other_than_2_3_4_are_refused(order):
    with pytest.raises(ValueError, match="order must be 2"):
        point_to_point([0.0], [1.0], 1.0, order=order)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": "here"}, "start"),
        ({"start": [1 + 2j]}, "start"),
        ({"start": [[0.0], [1.0, 2.0]]}, "start"),
        ({"goal": [1.0, 2.0]}, "goal"),
        ({"goal": np.float64(1.0)}, "goal"),
        ({"start": np.zeros((2, 1)), "duration": np.ones(3)}, r"start \(2,\).*duration \(3,\)"),
        ({"start_velocity": [1.0, 2.0]}, "start_velocity"),
        ({"start_velocity": FREE}, "start_velocity cannot be FREE"),
        ({"start_acceleration": FREE}, "start_acceleration cannot be FREE"),
        ({"order": 2, "goal_acceleration": [1.0]}, "goal_acceleration"),
    ],
)
def test_point_to_point_says_what_is_wrong(arguments, message):
    with pytest.raises(ValueError, match=message):
        point_to_point(**{"start": [0.0], "goal": [1.0], "duration": 1.0, **arguments})


def test_a_zero_duration_needs_equal_waypoints():
    with pytest.raises(ValueError, match="durations may be 0 only between equal waypoints"):
        through([[0.0], [1.0], [2.0]], [0.0, 1.0])
    with pytest.raises(ValueError, match="durations must not all be 0"):
        through([[0.0], [0.0]], [0.0])


def test_bad_times_orders_and_buffers_are_named():
    trajectory = point_to_point(np.zeros((3, 2)), np.ones((3, 2)), 1.0)
    for call, message in (
        (lambda: trajectory([np.nan]), "time must be finite"),
        (lambda: trajectory(np.ones((2, 5))), "leading dimensions"),
        (lambda: trajectory([0.5], -1), "nu"),
        (lambda: trajectory([0.5], 1.5), "nu"),
        (lambda: trajectory.sample(1), "time as a number of samples"),
        (lambda: trajectory.sample(5, ()), "nu"),
        (lambda: trajectory.sample(5, out=np.zeros((3, 3, 5, 3))), "out must be 3 arrays"),
        (lambda: trajectory.sample(5, (0,), out=np.zeros((2, 3, 5, 2))), "out must be 1 arrays"),
        (lambda: trajectory.peak(-1), "nu"),
        (lambda: trajectory.energy(6), "nu"),
        (lambda: trajectory.transformed(rotation=np.eye(3)), "rotation"),
        (lambda: trajectory.transformed(translation=[1.0]), "translation"),
        (lambda: trajectory.transformed(scale=np.nan), "scale"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_trajectory_cannot_be_changed_but_copied():
    trajectory = point_to_point([0.0], [1.0], 1.0)
    for copied in (pickle.loads(pickle.dumps(trajectory)), copy.deepcopy(trajectory)):
        np.testing.assert_array_equal(copied.sample(5), trajectory.sample(5))
    with pytest.raises(AttributeError):
        trajectory.order = 4
    assert isinstance(retarget(trajectory, 0.5, [2.0], 1.5), Trajectory)
    assert "1 segments, dimension 1, order 3" in repr(trajectory)


def test_importing_the_package_loads_numpy_and_nothing_heavy():
    code = (
        "import sys, viapoint.primitives as p, numpy as np\n"
        "p.through(np.zeros((3, 2)) + np.arange(3)[:, None], p.passage_durations(np.eye(3), 1.0))\n"
        "print([m for m in ('torch', 'scipy', 'mujoco', 'gymnasium', 'matplotlib') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
