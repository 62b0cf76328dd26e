"""A trajectory is a value: nothing that anybody writes later changes it."""

import copy
import pickle

import numpy as np
import pytest
import torch

from viapoint.primitives import point_to_point, retarget, through

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


def test_torch_does_not_share_the_memory_of_a_numpy_argument():
    duration = np.ones(3, np.float32)
    movement = point_to_point(torch.zeros(2), torch.ones(2), duration)
    duration[:] = 4
    assert (movement.duration == 1).all()
