"""Any leading dimensions means none of a movement as well: a batch of zero gives arrays of the right shapes."""

import numpy as np
import pytest
import torch

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.primitives import (
    FREE,
    cost_gradient,
    curvature,
    dimensionless_jerk,
    minimum_duration,
    minimum_jerk_coefficients,
    passage_durations,
    point_to_point,
    retarget,
    spectral_arc_length,
    speed_peaks,
    speed_valleys,
    through,
)

BATCHES = [(0,), (3, 0), (0, 2)]


def tensors(*shape):
    return torch.ones(shape, requires_grad=True)


both_kinds = pytest.mark.parametrize("ones", [lambda *shape: np.ones(shape), tensors], ids=["numpy", "torch"])
every_batch = pytest.mark.parametrize("batch", BATCHES)


def assert_answers_have_the_batch_shape(movement, batch, vias):
    assert movement.duration.shape == batch
    assert movement.knots.shape == (*batch, vias + 2)
    for values in (*movement.sample(5), *movement.sample([0.1] * 5, (0, 6, 1))):
        assert values.shape == (*batch, 5, 2)
    assert movement(0.5, 1).shape == (*batch, 2)
    for nu in (0, 1, 6):
        assert movement.peak(nu).shape == batch
        assert movement.extrema(nu).maximum_time.shape == (*batch, 2)
    for measure in (movement.cost(), dimensionless_jerk(movement), spectral_arc_length(movement)):
        assert measure.shape == batch
    assert movement.energy(0).shape == batch
    for events in (speed_valleys(movement), speed_peaks(movement)):
        assert events.time.shape == events.speed.shape == (*batch, 0)
    assert curvature(movement, [0.1]).shape == (*batch, 1)
    assert cost_gradient(movement).waypoints.shape == (*batch, vias + 2, 2)
    assert minimum_duration(movement, velocity=1.0, acceleration=[1.0, 2.0], jerk=[3.0]).shape == batch
    assert movement.stretched(2.0).duration.shape == batch
    assert movement.transformed(np.eye(2), [1.0, 1.0], 2.0).cost().shape == batch


@both_kinds
@every_batch
@pytest.mark.parametrize("vias", [0, 1, 2])
def test_no_movements_have_every_property_of_movements(ones, batch, vias):
    waypoints, moving = ones(*batch, vias + 2, 2), {"start_velocity": ones(2), "goal_acceleration": FREE}
    for ends in ({}, moving):
        durations = passage_durations(waypoints, ones(*batch), **ends)
        assert durations.shape == (*batch, vias + 1)
        assert_answers_have_the_batch_shape(through(waypoints, durations, **ends), batch, vias)
    shared = through(waypoints, ones(vias + 1), order=4)
    assert shared.sample(5, 0)[0].shape == (*batch, 5, 2)


@both_kinds
@every_batch
def test_no_movements_reach_drop_via_points_and_change_their_goal(ones, batch):
    movement = point_to_point(ones(*batch, 2), ones(2), 1.0)
    assert_answers_have_the_batch_shape(movement, batch, 0)
    assert minimum_jerk_coefficients(ones(*batch), 0, 0, 1, 0, 0, 1.0).shape == (*batch, 6)
    assert through(ones(*batch, 3, 2), [0.0, 1.0]).coefficients.shape == (*batch, 6, 2, 2)
    for changes in ({}, {"via": [0.5, 1.0]}, {"goal_velocity": [1.0, 1.0], "freeze": 0.9}):
        assert retarget(movement, 0.2, ones(2), 0.9, **changes).duration.shape == batch


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("timing", ["optimal", "learned"])
@pytest.mark.parametrize("vias", [0, 1, 2])
def test_no_actions_stand_for_no_plans(kind, timing, vias):
    layout = ActionLayout(n_via=vias, timing=timing)
    plan = layout.decode(kind.ones((0, layout.size)), kind.zeros((0, 2)), kind.ones((0, 2)))
    assert plan.waypoints.shape == (0, vias + 2, 2)
    assert plan.durations.shape == (0, vias + 1)


def test_the_gradient_of_nothing_is_empty():
    waypoints, velocity = tensors(0, 4, 2), tensors(2)
    durations = passage_durations(waypoints, torch.ones(0), start_velocity=velocity)
    through(waypoints, durations, start_velocity=velocity).sample(5)[2].sum().backward()
    assert waypoints.grad.shape == (0, 4, 2)
    assert (velocity.grad == 0).all()
