"""The same numbers from torch, and gradients that equal finite differences."""

import numpy as np
import pytest
import torch

from viapoint.primitives import (
    FREE,
    dimensionless_jerk,
    minimum_duration,
    minimum_jerk_coefficients,
    passage_durations,
    point_to_point,
    retarget,
    spectral_arc_length,
    speed_valleys,
    through,
)

RNG = np.random.default_rng(40)
START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_draws():
    """Every test begins with the same random numbers, whatever ran before it."""
    RNG.bit_generator.state = START


def tensor(*shape, scale=1.0):
    return torch.tensor(scale * RNG.normal(size=shape), dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("vias", [1, 2])
def test_numbers_equal_numpys(vias, dtype):
    waypoints = RNG.normal(size=(6, vias + 2, 2)).astype(np.float32)
    duration = RNG.uniform(0.5, 1.5, 6).astype(np.float32)
    mine = torch.tensor(waypoints, dtype=dtype), torch.tensor(duration, dtype=dtype)
    theirs = waypoints.astype(float), duration.astype(float)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    moves = [through(w, passage_durations(w, d)) for w, d in (mine, theirs)]
    assert moves[0].coefficients.dtype == dtype
    for nu in range(3):
        a, b = (move.sample(30, nu)[0] for move in moves)
        np.testing.assert_allclose(a.numpy(), b, atol=tolerance * np.abs(b).max())
    np.testing.assert_allclose(moves[0].cost().numpy(), moves[1].cost(), rtol=10 * tolerance)


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("seconds", [1e-9, 1e-6, 1e-3, 1.0, 1e6])
def test_single_precision_holds_any_duration_and_so_do_gradients(seconds, order):
    """Powers of the durations leave the numbers of single precision long before the positions do."""
    waypoints, durations = RNG.normal(size=(4, 2)), seconds * np.array([0.7, 1.0, 1.6])
    velocity, times = RNG.normal(size=2) / seconds, np.linspace(0.0, durations.sum(), 9)
    exact = through(waypoints, durations, order=order, start_velocity=velocity)(times)
    given = (torch.tensor(each, dtype=torch.float32) for each in (waypoints, durations, velocity, times))
    points, lengths, rate, when = given
    lengths.requires_grad_()
    found = through(points, lengths, order=order, start_velocity=rate)(when)
    np.testing.assert_allclose(found.detach().numpy(), exact, atol=2e-4)
    gradient = torch.autograd.grad(found.sum() * seconds, lengths)[0]
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() < 100.0


@pytest.mark.parametrize("vias", [1, 2, 3])
def test_gradients_of_passage_times_equal_finite_differences(vias):
    waypoints, velocity, acceleration = tensor(2, vias + 2, 2), tensor(2, 2, scale=0.3), tensor(2, 2)
    duration = torch.tensor(RNG.uniform(0.5, 2, 2), requires_grad=True)
    assert torch.autograd.gradcheck(passage_durations, (waypoints, duration), atol=1e-5)
    assert torch.autograd.gradcheck(
        lambda w, d, v, a: passage_durations(w, d, start_velocity=v, goal_velocity=FREE, goal_acceleration=a),
        (waypoints, duration, velocity, acceleration),
        atol=1e-5,
    )


def test_gradients_of_positions_and_cost_equal_finite_differences():
    waypoints = tensor(2, 4, 2)
    durations = torch.tensor(RNG.uniform(0.5, 1, (2, 3)), requires_grad=True)
    time = torch.linspace(-0.1, 3.0, 9, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda w, d: through(w, d, goal_acceleration=FREE)(time, 1), (waypoints, durations)
    )
    assert torch.autograd.gradcheck(lambda w, d: through(w, d, order=4).cost(), (waypoints, durations))


@pytest.mark.parametrize(
    "waypoints",
    [
        [[0, 0], [0, 0], [1, 0]],
        [[0, 0], [1e-12, 0], [1, 0]],
        [[0, 0], [1, 0], [1, 0]],
        [[0, 0], [0, 0], [0, 0]],
        [[0, 0], [1, 1], [0, 0]],
        [[0, 0], [0.5, 0], [0.5, 0], [1, 0]],
        [[0, 0], [0.5, 0.1], [0.5, 0.101], [1, 0]],
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_stay_finite_where_via_points_meet(waypoints, dtype):
    points = torch.tensor(waypoints, dtype=dtype, requires_grad=True)
    durations = passage_durations(points, 1.0)
    positions = through(points, durations).sample(20, 0)[0]
    (positions.square().sum() + durations.square().sum()).backward()
    assert torch.isfinite(points.grad).all()


def test_devices_other_kinds_and_mixtures():
    start = torch.zeros(3, 2)
    movement = point_to_point(start, [1.0, 2.0], 0.5)
    assert movement.coefficients.dtype == torch.float32
    assert movement.duration.shape == (3,)
    with pytest.raises(ValueError, match="start"):
        point_to_point("somewhere", [1.0], 1.0)


def test_a_trajectory_is_asked_in_its_own_kind():
    movement = point_to_point([0.0], [1.0], 1.0)
    for call in (lambda: movement(torch.ones(3)), lambda: movement.stretched(torch.tensor(2.0))):
        with pytest.raises(ValueError, match="own kind"):
            call()
    tensors = point_to_point(torch.zeros(1), torch.ones(1), 1.0)
    assert tensors(np.array([0.5])).dtype == torch.float32


@pytest.mark.parametrize("number", [float, np.float64, np.float32, np.array])
def test_a_number_beside_tensors_adds_no_dimension(number):
    reach = point_to_point(torch.zeros(2), torch.ones(2), number(1.0))
    many = point_to_point(torch.zeros(3, 2), torch.ones(2), number(1.0))
    waypoints = torch.rand(3, 2)
    assert reach.duration.shape == reach.cost().shape == ()
    assert many.duration.shape == (3,)
    assert passage_durations(waypoints, number(0.9)).shape == (2,)
    assert passage_durations(torch.rand(5, 3, 2), number(0.9)).shape == (5, 2)
    numbers = [number(value) for value in (0.0, 0.0, 1.0, 0.0, 0.0, 1.0)]
    assert minimum_jerk_coefficients(torch.tensor(0.0), *numbers).shape == (6,)
    assert reach.stretched(number(2.0)).duration.shape == ()
    assert many.stretched(number(2.0)).duration.shape == (3,)
    assert reach.transformed(scale=number(2.0)).cost().shape == ()
    assert retarget(reach, number(0.3), torch.ones(2), number(1.0)).duration.shape == ()
    assert minimum_duration(reach, velocity=number(1.0)).shape == ()
    assert reach(0.5).shape == (2,)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_gives_what_single_precision_gives_within_its_rounding(dtype):
    waypoints = torch.tensor([[0.0, 0.0], [0.5, 0.75], [1.0, 0.0]])
    half, single = (
        through(points, passage_durations(points, 1.0)) for points in (waypoints.to(dtype), waypoints)
    )
    asked = {
        "peak": lambda movement: movement.peak(1),
        "extrema": lambda movement: movement.extrema(1).maximum,
        "smoothness": spectral_arc_length,
        "valleys": lambda movement: speed_valleys(movement).time,
        "jerk": dimensionless_jerk,
        "limits": lambda movement: minimum_duration(movement, velocity=1.0, acceleration=[4.0, 4.0]),
        "duration": lambda movement: movement.durations,
    }
    for name, ask in asked.items():
        assert ask(half).dtype == dtype, name
        torch.testing.assert_close(ask(half).float(), ask(single), rtol=0.05, atol=0.02)
    dropped = through(torch.tensor([[0.0], [0.0], [1.0]], dtype=dtype), [0.0, 1.0])
    torch.testing.assert_close(dropped.cost().float(), torch.tensor(360.0), rtol=0.01, atol=0.0)
