"""A trajectory is a value: nothing that anybody writes later changes it."""

import copy
import pickle

import numpy as np
import pytest
import torch

from viapoint.primitives import point_to_point, retarget, through

FIELDS = ("coefficients", "durations", "starts", "rates", "end")


def answers(movement):
    found = [movement.duration, movement.knots, movement.cost(), movement.peak(1), *movement.sample(7)]
    return [np.array(np.asarray(part)) for part in found]


def through_all(kind, waypoints, durations):
    return through(waypoints, durations)


def with_a_dropped_via_point(kind, waypoints, durations):
    waypoints[..., 1, :] = waypoints[..., 0, :]
    durations[..., 0] = 0
    return through(waypoints, durations)


def reaching(kind, waypoints, durations):
    return point_to_point(waypoints[..., 0, :], waypoints[..., 2, :], durations[..., 0])


def stretched(kind, waypoints, durations):
    return through(kind.ones((2, 1)), kind.ones(1)).stretched(durations[..., 0])


def continued(kind, waypoints, durations):
    old = point_to_point(waypoints[..., 0, :], waypoints[..., 1, :], 2.0)
    return retarget(old, kind.zeros(3), waypoints[..., 2, :], durations[..., 0])


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("make", [through_all, with_a_dropped_via_point, reaching, stretched, continued])
def test_the_caller_may_write_into_what_was_given(kind, make):
    waypoints = kind.zeros((3, 3, 2)) + kind.asarray([[0.0], [1.0], [3.0]])
    durations = kind.ones((3, 2))
    movement = make(kind, waypoints, durations)
    before = answers(movement)
    waypoints[...], durations[...] = 7.0, 9.0
    for was, now in zip(before, answers(movement), strict=True):
        np.testing.assert_array_equal(now, was)


def test_torch_does_not_share_the_memory_of_a_numpy_argument():
    duration = np.ones(3, np.float32)
    movement = point_to_point(torch.zeros(2), torch.ones(2), duration)
    duration[:] = 4
    assert (movement.duration == 1).all()


def test_the_arrays_of_a_numpy_trajectory_are_read_only():
    via = through([[0.0, 0.0], [0.5, 1.0], [1.0, 1.0]], [1.0, 1.0])
    reach = point_to_point(np.zeros((3, 2)), np.ones((3, 2)), np.ones(3))
    derived = (via.stretched(3.0), via.transformed(scale=2.0), retarget(reach, 0.5, [2.0, 2.0], 1.5))
    copies = [pickle.loads(pickle.dumps(via)), copy.deepcopy(via), copy.copy(via)]
    for movement in (via, reach, *derived, *copies):
        for name in (*FIELDS, "duration"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(movement, name)[...] = 0


def test_what_a_trajectory_answers_belongs_to_the_caller():
    movement = point_to_point([0.0, 0.0], [1.0, 1.0], 1.0)
    before = answers(movement)
    extrema = movement.extrema(1)
    for array in (
        movement.knots,
        *movement.sample(5),
        movement([0.0, 1.0]),
        extrema.maximum,
        extrema.maximum_time,
    ):
        array[...] = 7.0
    for was, now in zip(before, answers(movement), strict=True):
        np.testing.assert_array_equal(now, was)
