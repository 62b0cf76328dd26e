"""Batches of zero movements give arrays of the right shapes, whatever is asked of them."""

import numpy as np
import pytest
import torch

import viapoint.primitives as vp

SHAPES = {  # answer of a movement through two via-points in the plane: shape after the batch's
    "duration": (lambda movement: movement.duration, ()),
    "knots": (lambda movement: movement.knots, (4,)),
    "sample": (lambda movement: movement.sample([0.1] * 5, (0, 6, 1))[1], (5, 2)),
    "call": (lambda movement: movement(0.5, 1), (2,)),
    "peak": (lambda movement: movement.peak(1), ()),
    "peak beyond the degree": (lambda movement: movement.peak(6), ()),
    "extrema": (lambda movement: movement.extrema(1).maximum_time, (2,)),
    "cost": (lambda movement: movement.cost(), ()),
    "energy": (lambda movement: movement.energy(0), ()),
    "stretched": (lambda movement: movement.stretched(2.0).duration, ()),
    "transformed": (lambda movement: movement.transformed(np.eye(2), [1.0, 1.0], 2.0).cost(), ()),
    "jerk": (vp.dimensionless_jerk, ()),
    "arc length": (vp.spectral_arc_length, ()),
    "valleys": (lambda movement: vp.speed_valleys(movement).time, (0,)),
    "peaks": (lambda movement: vp.speed_peaks(movement).speed, (0,)),
    "curvature": (lambda movement: vp.curvature(movement, [0.1]), (1,)),
    "gradient": (lambda movement: vp.cost_gradient(movement).waypoints, (4, 2)),
    "limits": (lambda movement: vp.minimum_duration(movement, velocity=1.0, jerk=[3.0, 1.0]), ()),
    "new goal": (lambda movement: vp.retarget(movement, 0.2, [1.0, 1.0], 0.9, via=[0.5, 1.0]).duration, ()),
    "late": (lambda movement: vp.retarget(movement, 0.2, [1.0, 1.0], 0.9, freeze=0.9).duration, ()),
    "reach": (lambda movement: vp.point_to_point(movement(0.0), movement(1.0), 1.0).coefficients, (6, 1, 2)),
    "dropped": (lambda movement: vp.through(movement([0.0, 0.0, 1.0]), [0.0, 1.0]).coefficients, (6, 2, 2)),
    "polynomial": (lambda movement: vp.minimum_jerk_coefficients(*[movement.duration] * 7), (6,)),
}


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("batch", [(0,), (3, 0), (0, 2)])
@pytest.mark.parametrize("name", SHAPES)
def test_no_movements_have_every_property_of_movements(name, batch, kind):
    ask, shape = SHAPES[name]
    waypoints = kind.ones((*batch, 4, 2))
    for ends in ({}, {"start_velocity": kind.ones(2), "goal_acceleration": vp.FREE}):
        durations = vp.passage_durations(waypoints, kind.ones(batch), **ends)
        assert ask(vp.through(waypoints, durations, **ends)).shape == (*batch, *shape)


def test_the_gradient_of_nothing_is_empty():
    waypoints, velocity = torch.ones((0, 4, 2), requires_grad=True), torch.ones(2, requires_grad=True)
    durations = vp.passage_durations(waypoints, torch.ones(0), start_velocity=velocity)
    vp.through(waypoints, durations, start_velocity=velocity).sample(5)[2].sum().backward()
    assert waypoints.grad.shape == (0, 4, 2)
    assert (velocity.grad == 0).all()
