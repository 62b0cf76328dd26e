"""The same numbers from torch, and gradients that equal closed forms and finite differences."""

import numpy as np
import pytest
import torch

import viapoint.primitives as vp

torch.set_num_threads(1)


@pytest.fixture
def tensor(rng):
    def draw(*shape, scale=1.0):
        return torch.tensor(scale * rng.normal(size=shape), requires_grad=True)

    return draw


@pytest.mark.parametrize("kind", [np, torch])
def test_the_widest_type_counts_wherever_it_stands(kind):
    wide, narrow = kind.asarray([0.1, 0.2], dtype=kind.float64), kind.asarray([1.0, 1.0], dtype=kind.float32)
    for ends in ((wide, narrow), (narrow, wide)):
        assert vp.point_to_point(*ends, 1.0).coefficients.dtype == kind.float64


@pytest.mark.parametrize(
    ("kind", "dtype"), [(torch, torch.float64), (torch, torch.float32), (np, np.float32)], ids=str
)
@pytest.mark.parametrize("vias", [1, 2])
def test_numbers_of_torch_and_of_single_precision_are_those_of_double_precision(vias, kind, dtype, rng):
    waypoints = rng.normal(size=(6, vias + 2, 2)).astype(np.float32)
    duration = rng.uniform(0.5, 1.5, 6).astype(np.float32)
    mine = kind.asarray(waypoints, dtype=dtype), kind.asarray(duration, dtype=dtype)
    theirs = waypoints.astype(float), duration.astype(float)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    moves = [vp.through(w, vp.passage_durations(w, d)) for w, d in (mine, theirs)]
    assert moves[0].coefficients.dtype == dtype
    np.testing.assert_allclose(moves[0].durations, moves[1].durations, rtol=tolerance)
    for nu in range(3):
        a, b = (move.sample(30, nu)[0] for move in moves)
        np.testing.assert_allclose(a, b, atol=tolerance * np.abs(b).max())
    np.testing.assert_allclose(moves[0].cost(), moves[1].cost(), rtol=10 * tolerance)


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("seconds", [1e-9, 1e-6, 1e-3, 1.0, 1e6])
def test_single_precision_holds_any_duration_and_so_do_gradients(seconds, order, rng):
    """Powers of the durations leave the numbers of single precision long before the positions do."""
    waypoints, durations = rng.normal(size=(4, 2)), seconds * np.array([0.7, 1.0, 1.6])
    velocity, times = rng.normal(size=2) / seconds, np.linspace(0.0, durations.sum(), 9)
    exact = vp.through(waypoints, durations, order=order, start_velocity=velocity)(times)
    given = (torch.tensor(each, dtype=torch.float32) for each in (waypoints, durations, velocity, times))
    points, lengths, rate, when = given
    lengths.requires_grad_()
    found = vp.through(points, lengths, order=order, start_velocity=rate)(when)
    np.testing.assert_allclose(found.detach().numpy(), exact, atol=2e-4)
    gradient = torch.autograd.grad(found.sum() * seconds, lengths)[0]
    assert gradient.abs().max() < 100.0


@pytest.mark.parametrize("vias", [1, 2, 3])
def test_gradients_of_passage_times_equal_finite_differences(vias, tensor, rng):
    waypoints, velocity, acceleration = tensor(2, vias + 2, 2), tensor(2, 2, scale=0.3), tensor(2, 2)
    duration = torch.tensor(rng.uniform(0.5, 2, 2), requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda w, d, v, a: vp.passage_durations(
            w, d, start_velocity=v, goal_velocity=vp.FREE, goal_acceleration=a
        ),
        (waypoints, duration, velocity, acceleration),
        atol=1e-5,
        fast_mode=True,
    )


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
    durations = vp.passage_durations(points, 1.0)
    positions = vp.through(points, durations).sample(20, 0)[0]
    (positions.square().sum() + durations.square().sum()).backward()
    assert torch.isfinite(points.grad).all()


@pytest.mark.parametrize(
    "measure",
    [
        lambda movement: vp.curvature(movement, [0.3, 0.6]).sum(-1),
        vp.dimensionless_jerk,
        vp.log_dimensionless_jerk,
        vp.spectral_arc_length,
        lambda movement: vp.minimum_duration(movement, acceleration=1.0),
        lambda movement: vp.minimum_duration(movement, velocity=0.5, jerk=[9.0, 9.0]),
    ],
)
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_still_and_steady_movements_of_a_batch_do_not_change_the_gradients_of_others(measure, speed):
    """A steady movement has no acceleration and no jerk; where nothing moves most measures are undefined."""
    moving = torch.tensor([[0.0, 0.0], [0.3, 0.4], [1.0, 0.0]], dtype=torch.float64)
    other = speed * torch.tensor([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]], dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0.0], [speed, 0.0]], dtype=torch.float64)
    shift = torch.zeros((3, 2), dtype=torch.float64, requires_grad=True)

    def values(points, rate):
        movement = vp.through(points + shift, [0.5, 0.5], start_velocity=rate, goal_velocity=rate)
        return measure(movement)

    both = values(torch.stack([moving, other]), velocity)
    (found,) = torch.autograd.grad(both[0], shift, retain_graph=True)
    (expected,) = torch.autograd.grad(values(moving, velocity[0]), shift)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert torch.isfinite(torch.autograd.grad(both[1], shift)[0]).all()


@pytest.mark.parametrize("number", [float, np.float64, np.float32, np.array])
def test_a_number_beside_tensors_adds_no_dimension(number):
    reach = vp.point_to_point(torch.zeros(2), torch.ones(2), number(1.0))
    assert reach.coefficients.dtype == torch.float32
    assert reach(np.array([0.5])).dtype == torch.float32
    assert vp.passage_durations(torch.rand(5, 3, 2), number(0.9)).shape == (5, 2)
    assert vp.minimum_jerk_coefficients(torch.tensor(0.0), *[number(1.0)] * 6).shape == (6,)
    for answer in (
        reach.duration,
        reach.cost(),
        reach.stretched(number(2.0)).duration,
        reach.transformed(scale=number(2.0)).cost(),
        vp.retarget(reach, number(0.3), torch.ones(2), number(1.0)).duration,
        vp.minimum_duration(reach, velocity=number(1.0)),
    ):
        assert answer.shape == ()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_gives_what_single_precision_gives_within_its_rounding(dtype):
    waypoints = torch.tensor([[0.0, 0.0], [0.5, 0.75], [1.0, 0.0]])
    half, single = (
        vp.through(points, vp.passage_durations(points, 1.0)) for points in (waypoints.to(dtype), waypoints)
    )
    for ask in (
        lambda movement: movement.durations,
        lambda movement: movement.peak(1),
        lambda movement: movement.extrema(1).maximum,
        lambda movement: vp.speed_valleys(movement).time,
        lambda movement: vp.minimum_duration(movement, velocity=1.0, acceleration=[4.0, 4.0]),
        vp.dimensionless_jerk,
        vp.spectral_arc_length,
    ):
        assert ask(half).dtype == dtype
        torch.testing.assert_close(ask(half).float(), ask(single), rtol=0.05, atol=0.02)
    dropped = vp.through(torch.tensor([[0.0], [0.0], [1.0]], dtype=dtype), [0.0, 1.0])
    torch.testing.assert_close(dropped.cost().float(), torch.tensor(360.0), rtol=0.01, atol=0.0)


@pytest.mark.parametrize("order", [2, 3, 4])
def test_closed_forms_equal_autograd(order, tensor, rng):
    waypoints, ends = tensor(3, 5, 2), {"start_velocity": tensor(3, 2), "goal_velocity": tensor(3, 2)}
    durations = torch.tensor(rng.uniform(0.3, 0.8, (3, 4)), requires_grad=True)
    if order > 2:
        ends |= {"start_acceleration": tensor(3, 2), "goal_acceleration": tensor(3, 2)}
    trajectory = vp.through(waypoints, durations, order=order, **ends)
    closed = vp.cost_gradient(trajectory)
    found = torch.autograd.grad(trajectory.cost().sum(), (waypoints, durations, *ends.values()))
    expected = [closed.waypoints, closed.durations, *(getattr(closed, name) for name in ends)]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.numpy(), b.detach().numpy(), atol=1e-9 * float(a.abs().max()))


def test_a_free_end_has_no_force(rng):
    waypoints = rng.normal(size=(4, 2))
    trajectory = vp.through(waypoints, [0.5, 0.4, 0.6], goal_velocity=vp.FREE, goal_acceleration=vp.FREE)
    gradient = vp.cost_gradient(trajectory)
    size = np.abs(gradient.start_velocity).max()
    np.testing.assert_allclose(gradient.goal_velocity, 0.0, atol=1e-11 * size)
    np.testing.assert_allclose(gradient.goal_acceleration, 0.0, atol=1e-11 * size)


@pytest.mark.parametrize(
    "function",
    [
        lambda trajectory: trajectory(torch.linspace(-0.1, 1.1, 9), 1),
        lambda trajectory: trajectory.peak(1),
        lambda trajectory: trajectory.extrema(2).minimum,
        lambda trajectory: vp.minimum_duration(trajectory, velocity=1.0, acceleration=[2.0, 3.0]),
        vp.dimensionless_jerk,
        vp.spectral_arc_length,
        lambda trajectory: vp.speed_peaks(trajectory).speed.nan_to_num(),
        lambda trajectory: vp.curvature(trajectory, torch.linspace(0.3, 0.6, 4, dtype=torch.float64)),
        lambda trajectory: vp.retarget(trajectory, 0.3, [1.0, 1.0], 1.5, via=[0.3, 0.2]).cost(),
        lambda trajectory: trajectory.stretched(2.0).transformed(scale=3.0).energy(2),
    ],
)
def test_autograd_passes_through_every_function(function, tensor):
    waypoints = tensor(2, 4, 2)

    def value(points):
        return function(vp.through(points, vp.passage_durations(points, 1.0)))

    assert torch.autograd.gradcheck(value, (waypoints,), atol=1e-4, rtol=1e-4, fast_mode=True)
