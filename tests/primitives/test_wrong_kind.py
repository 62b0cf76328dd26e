"""What is no array, no number or no buffer is refused by one ValueError that names the argument at fault."""

import re

import numpy as np
import pytest
import torch

from viapoint.primitives import (
    FREE,
    cost_gradient,
    curvature,
    dimensionless_jerk,
    log_dimensionless_jerk,
    minimum_duration,
    minimum_jerk_coefficients,
    passage_durations,
    point_to_point,
    retarget,
    spectral_arc_length,
    speed,
    speed_peaks,
    speed_valleys,
    through,
)

REACH = point_to_point([0.0, 0.0], [1.0, 1.0], 1.0)
TENSORS = point_to_point(torch.zeros(2), torch.ones(2), 1.0)
WAYPOINTS = [[0.0, 0.0], [0.4, 0.3], [1.0, 0.0]]
NO_ARRAYS = [None, FREE, "ab", 1j, {}, object(), [[1.0], [1.0, 2.0]], [torch.ones(1, requires_grad=True)]]

REQUIRED = {
    "start": lambda bad: point_to_point(bad, [1.0, 1.0], 1.0),
    "goal": lambda bad: point_to_point(torch.zeros(2), bad, 1.0),
    "duration": lambda bad: point_to_point([0.0], [1.0], bad),
    "waypoints": lambda bad: through(bad, [1.0, 1.0]),
    "durations": lambda bad: through(WAYPOINTS, bad),
    "duration ": lambda bad: passage_durations(WAYPOINTS, bad),
    "duration  ": lambda bad: REACH.stretched(bad),
    "time": lambda bad: retarget(REACH, bad, [1.0, 1.0], 1.0),
    "goal ": lambda bad: retarget(REACH, 0.2, bad, 1.0),
    "arrival": lambda bad: retarget(REACH, 0.2, [1.0, 1.0], bad),
    "time ": lambda bad: REACH(bad),
    "time  ": lambda bad: TENSORS.sample(bad),
    "time   ": lambda bad: speed(REACH, bad),
    "time    ": lambda bad: curvature(REACH, bad),
    "ddx0": lambda bad: minimum_jerk_coefficients(0.0, 0.0, bad, 1.0, 0.0, 0.0, 1.0),
    "T": lambda bad: minimum_jerk_coefficients(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, bad),
}
OPTIONAL = {
    "start_velocity": lambda bad: point_to_point([0.0], [1.0], 1.0, start_velocity=bad),
    "via_velocities": lambda bad: through(WAYPOINTS, [1.0, 1.0], via_velocities=bad),
    "velocity": lambda bad: minimum_duration(REACH, velocity=bad),
    "jerk": lambda bad: minimum_duration(TENSORS, velocity=1.0, jerk=bad),
    "via": lambda bad: retarget(REACH, 0.2, [1.0, 1.0], 1.0, via=bad),
    "rotation": lambda bad: REACH.transformed(rotation=bad),
    "translation": lambda bad: REACH.transformed(translation=bad),
    "scale": lambda bad: TENSORS.transformed(scale=bad),
}


@pytest.mark.parametrize("bad", NO_ARRAYS, ids=lambda bad: type(bad).__name__)
@pytest.mark.parametrize("name", REQUIRED)
def test_a_required_argument_that_is_no_array_is_named_alone(name, bad):
    expected = rf"^{name.strip()} must be an array of real numbers, got {re.escape(repr(bad))}"
    with pytest.raises(ValueError, match=expected):
        REQUIRED[name](bad)


@pytest.mark.parametrize("bad", NO_ARRAYS[1:], ids=lambda bad: type(bad).__name__)
@pytest.mark.parametrize("name", OPTIONAL)
def test_an_optional_argument_that_is_no_array_is_named_alone(name, bad):
    with pytest.raises(ValueError, match=rf"^{name} (cannot be FREE|must be an array of real numbers, got)"):
        OPTIONAL[name](bad)


@pytest.mark.parametrize("order", [3.0, [3], np.array([3, 3]), np.float64(3)])
def test_an_order_is_a_whole_number(order):
    for call in (
        lambda: point_to_point([0.0], [1.0], 1.0, order=order),
        lambda: through([[0], [1]], [1], order=order),
    ):
        with pytest.raises(ValueError, match=r"^order must be 2"):
            call()
    assert point_to_point([0.0], [1.0], 1.0, order=np.int64(4)).order == 4


@pytest.mark.parametrize("nu", [[1, 2], [1], 1.5, None, "1", True, np.array(1), FREE])
@pytest.mark.parametrize("ask", ["__call__", "peak", "extrema", "energy", "sample"])
def test_one_derivative_is_asked_for_by_one_whole_number(ask, nu):
    time = {"__call__": (0.5,), "sample": (5,)}.get(ask, ())
    if ask == "sample" and isinstance(nu, list):
        assert len(REACH.sample(5, nu)) == len(nu)
        return
    with pytest.raises(ValueError, match=r"^nu must be (a )?whole number"):
        getattr(REACH, ask)(*time, nu)


@pytest.mark.parametrize("freeze", [np.nan, np.inf, -1, -1e-9, np.ones(2), "0.1", None, True, FREE, 10**400])
def test_freeze_is_a_time(freeze):
    with pytest.raises(ValueError, match=r"^freeze must be a finite number of at least 0, got"):
        retarget(REACH, 0.2, [1.0, 1.0], 1.0, freeze=freeze)


@pytest.mark.parametrize("freeze", [0, 0.1, np.float32(0.1), np.array(0.1), torch.tensor(0.1)])
def test_freeze_may_be_any_kind_of_number(freeze):
    late = retarget(REACH, 0.95, [5.0, 5.0], 2.0, freeze=freeze)
    np.testing.assert_allclose(late.duration, 0.05 if freeze > 0 else 1.05, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("cutoff", [0, -1.0, np.nan, None, "10", [10.0], FREE]),
        ("threshold", [-0.1, 1.0, np.nan, None, "0", np.ones(2)]),
        ("padding", [1.5, -1, None, "4", True, 4.0, [4], 10**9]),
    ],
)
def test_the_settings_of_the_spectrum_are_named_one_by_one(name, values):
    for value in values:
        with pytest.raises(ValueError, match=f"^{name} must be a .*number.*, got {re.escape(repr(value))}"):
            spectral_arc_length(REACH, **{name: value})
    assert spectral_arc_length(REACH, cutoff=np.inf, threshold=0, padding=np.int64(0)) < 0


@pytest.mark.parametrize("own", [np, torch])
def test_a_buffer_is_of_the_trajectorys_kind_and_takes_real_numbers(own):
    movement, other = {np: (REACH, torch), torch: (TENSORS, np)}[own]
    shape = (3, 5, 2)
    for out, message in (
        (own.zeros(shape, dtype=own.int64), "out must be of a floating dtype, got .*int64"),
        (other.zeros(shape), "out must be 3 arrays of the trajectory's own kind"),
        (5, "out must be 3 arrays of the trajectory's own kind, got int"),
        ([None] * 3, "own kind, got list"),
        (np.zeros(shape).tolist(), "own kind, got list"),
        (own.zeros((2, 5, 2)), "out must be 3 arrays of shape"),
    ):
        with pytest.raises(ValueError, match=message):
            movement.sample(5, out=out)
    for dtype in (own.float32, own.float64):
        written = movement.sample(5, out=own.zeros(shape, dtype=dtype))
        np.testing.assert_allclose(np.asarray(written), np.asarray(movement.sample(5)), atol=1e-5)
    with pytest.raises(ValueError, match="out must be writeable"):
        REACH.sample(5, out=np.broadcast_to(0.0, shape))


def test_a_numpy_trajectory_is_not_continued_or_limited_by_tensors():
    for call in (
        lambda: retarget(REACH, torch.tensor(0.3), [1.0, 1.0], 1.0),
        lambda: minimum_duration(REACH, velocity=torch.tensor(0.3)),
        lambda: REACH.transformed(scale=torch.tensor(0.3)),
    ):
        with pytest.raises(ValueError, match="own kind"):
            call()


def test_a_map_to_no_dimension_is_refused():
    with pytest.raises(ValueError, match="rotation"):
        REACH.transformed(rotation=np.zeros((0, 2)))


@pytest.mark.parametrize("size", [1e-200, 1e-9, 1.0, 1e200])
@pytest.mark.parametrize("kind", [np, torch])
def test_peaks_of_any_size_are_right(kind, size):
    points = kind.asarray([[0.0, 0.0], [3.0, 4.0]], dtype=kind.float64) * size
    movement = point_to_point(points[0], points[1], 2.0)
    np.testing.assert_allclose(movement.peak(1), 1.875 * 5 * size / 2, rtol=1e-14)
    np.testing.assert_allclose(movement.extrema(1).maximum[1], 1.875 * 4 * size / 2, rtol=1e-14)


def test_a_peak_is_right_or_its_overflow_is_named():
    brief = point_to_point([0.0, 0.0], [1.0, 1.0], 1e-300)
    np.testing.assert_allclose(brief.peak(1), 1.875e300 * 2**0.5, rtol=1e-14)
    np.testing.assert_allclose(minimum_duration(brief, velocity=1.0), 1.875 * 2**0.5, rtol=1e-14)
    single = point_to_point(torch.zeros(2), torch.ones(2), 1e-30)
    for movement, nu, shortest in ((brief, 2, "1e-300"), (single, 2, "1e-30")):
        for ask in (movement.peak, movement.extrema):
            with pytest.raises(
                ValueError, match=f"derivative 2 of the trajectory overflows .*float.* {shortest} s"
            ):
                ask(nu)


@pytest.mark.parametrize("bad", [None, [0.0, 1.0], np.zeros((3, 2)), "reach", WAYPOINTS])
@pytest.mark.parametrize(
    "ask",
    [
        cost_gradient,
        dimensionless_jerk,
        log_dimensionless_jerk,
        spectral_arc_length,
        speed_peaks,
        speed_valleys,
        lambda bad: curvature(bad, [0.5]),
        lambda bad: minimum_duration(bad, velocity=1.0),
        lambda bad: retarget(bad, 0.2, [1.0, 1.0], 1.0),
        lambda bad: speed(bad, [0.5]),
    ],
)
def test_what_is_no_trajectory_is_named(ask, bad):
    expected = f"^trajectory must be a viapoint.primitives.Trajectory, got {type(bad).__name__}$"
    with pytest.raises(ValueError, match=expected):
        ask(bad)
