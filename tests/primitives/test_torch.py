"""The same numbers from torch, and gradients that equal finite differences."""

import numpy as np
import pytest
import torch

from viapoint.primitives import FREE, passage_durations, point_to_point, through

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


@pytest.mark.parametrize("vias", [1, 2, 3])
def test_gradients_of_passage_times_equal_finite_differences(vias):
    waypoints, velocity, acceleration = tensor(3, vias + 2, 2), tensor(3, 2, scale=0.3), tensor(3, 2)
    duration = torch.tensor(RNG.uniform(0.5, 2, 3), requires_grad=True)
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
