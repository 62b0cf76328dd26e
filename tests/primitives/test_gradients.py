"""Closed-form gradients of the cost equal finite differences, and autograd agrees."""

import numpy as np
import pytest
import torch

from viapoint.primitives import (
    FREE,
    cost_gradient,
    curvature,
    dimensionless_jerk,
    minimum_duration,
    passage_durations,
    retarget,
    spectral_arc_length,
    speed_peaks,
    through,
)

RNG = np.random.default_rng(90)
START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_draws():
    """Every test begins with the same random numbers, whatever ran before it."""
    RNG.bit_generator.state = START


torch.set_num_threads(1)


def tensor(*shape, scale=1.0):
    return torch.tensor(scale * RNG.normal(size=shape), dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize("order", [2, 3, 4])
def test_closed_forms_equal_autograd(order):
    waypoints, ends = tensor(3, 5, 2), {"start_velocity": tensor(3, 2), "goal_velocity": tensor(3, 2)}
    durations = torch.tensor(RNG.uniform(0.3, 0.8, (3, 4)), requires_grad=True)
    if order > 2:
        ends |= {"start_acceleration": tensor(3, 2), "goal_acceleration": tensor(3, 2)}
    trajectory = through(waypoints, durations, order=order, **ends)
    closed = cost_gradient(trajectory)
    found = torch.autograd.grad(trajectory.cost().sum(), (waypoints, durations, *ends.values()))
    expected = [closed.waypoints, closed.durations, *(getattr(closed, name) for name in ends)]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.numpy(), b.detach().numpy(), atol=1e-9 * float(a.abs().max()))


@pytest.mark.parametrize("vias", [1, 2, 4])
def test_with_free_passage_times_the_closed_form_is_the_derivative_of_the_optimum(vias):
    waypoints, duration, step = RNG.normal(size=(vias + 2, 2)), 1.3, 1e-6

    def optimum(points, total):
        return float(through(points, passage_durations(points, total)).cost())

    trajectory = through(waypoints, passage_durations(waypoints, duration))
    gradient = cost_gradient(trajectory)
    for place in np.ndindex(waypoints.shape):
        shifted = [waypoints.copy(), waypoints.copy()]
        shifted[0][place] -= step
        shifted[1][place] += step
        difference = (optimum(shifted[1], duration) - optimum(shifted[0], duration)) / (2 * step)
        np.testing.assert_allclose(
            gradient.waypoints[place], difference, rtol=1e-5, atol=1e-5 * trajectory.cost()
        )
    # At free passage times the Hamiltonian is the same in all segments (Eq. C10), and the cost falls as T^-5.
    np.testing.assert_allclose(gradient.durations, -5 * trajectory.cost() / duration, rtol=1e-8)


def test_a_free_end_has_no_force():
    waypoints = RNG.normal(size=(4, 2))
    trajectory = through(waypoints, [0.5, 0.4, 0.6], goal_velocity=FREE, goal_acceleration=FREE)
    gradient = cost_gradient(trajectory)
    size = np.abs(gradient.start_velocity).max()
    np.testing.assert_allclose(gradient.goal_velocity, 0.0, atol=1e-11 * size)
    np.testing.assert_allclose(gradient.goal_acceleration, 0.0, atol=1e-11 * size)


@pytest.mark.parametrize(
    "function",
    [
        lambda trajectory: trajectory.peak(1),
        lambda trajectory: trajectory.extrema(2).minimum,
        lambda trajectory: minimum_duration(trajectory, velocity=1.0, acceleration=[2.0, 3.0]),
        dimensionless_jerk,
        spectral_arc_length,
        lambda trajectory: speed_peaks(trajectory).speed.nan_to_num(),
        lambda trajectory: curvature(trajectory, torch.linspace(0.3, 0.6, 4, dtype=torch.float64)),
        lambda trajectory: retarget(trajectory, 0.3, [1.0, 1.0], 1.5, via=[0.3, 0.2]).cost(),
        lambda trajectory: trajectory.stretched(2.0).transformed(scale=3.0).energy(2),
    ],
)
def test_autograd_passes_through_every_function(function):
    waypoints = tensor(2, 4, 2)

    def value(points):
        return function(through(points, passage_durations(points, 1.0)))

    assert torch.autograd.gradcheck(value, (waypoints,), atol=1e-4, rtol=1e-4)
