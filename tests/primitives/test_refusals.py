"""Bad input never passes: every public function refuses it with a ValueError."""

import numpy as np
import pytest
import torch

import viapoint.primitives as vp
from viapoint.primitives import FREE

REACH = vp.point_to_point([0.0, 0.0], [1.0, 1.0], 1.0)
TENSORS = vp.point_to_point(torch.zeros(2), torch.ones(2), 1.0)
BATCH = vp.point_to_point(np.zeros((3, 2)), np.ones((3, 2)), 1.0)
LINE = [[0.0, 0.0], [0.4, 0.3], [1.0, 0.0]]
GOAL = [1.0, 1.0]
TIME = np.linspace(0.0, 1.0, 20)
SEEN, ONES = REACH(TIME), np.ones((20, 2))
MISSING = np.where(np.arange(20)[:, None] == 3, np.nan, SEEN)
TWICE = np.where(np.arange(20) == 3, TIME[2], TIME)

NO_NUMBERS = ["ab", 1j, {}, object(), [[1.0], [1.0, 2.0]], [torch.ones(1, requires_grad=True)]]
NOT_FINITE = [
    np.nan,
    [0.0, np.inf],
    torch.tensor([np.nan, 0.0]),
    np.ma.masked_array([0.0, 1.0], mask=[False, True]),
]
BAD_ARRAYS = [FREE, *NO_NUMBERS, *NOT_FINITE]
BAD_NU = [[1], -1, 1.5, None, "1", True, np.array(1), FREE]

# fmt: off
REQUIRED = [
    lambda bad: vp.point_to_point(bad, GOAL, 1.0),
    lambda bad: vp.point_to_point(torch.zeros(2), bad, 1.0),
    lambda bad: vp.point_to_point([0.0], [1.0], bad),
    lambda bad: vp.through(bad, [1.0, 1.0]),
    lambda bad: vp.through(LINE, bad),
    lambda bad: vp.passage_durations(LINE, bad),
    lambda bad: REACH.stretched(bad),
    lambda bad: vp.retarget(REACH, bad, GOAL, 1.0),
    lambda bad: vp.retarget(REACH, 0.2, bad, 1.0),
    lambda bad: vp.retarget(REACH, 0.2, GOAL, bad),
    lambda bad: REACH(bad),
    lambda bad: TENSORS.sample(bad),
    lambda bad: vp.speed(REACH, bad),
    lambda bad: vp.curvature(REACH, bad),
    lambda bad: vp.minimum_jerk_coefficients(0.0, 0.0, bad, 1.0, 0.0, 0.0, 1.0),
    lambda bad: vp.minimum_jerk_coefficients(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, bad),
]
OPTIONAL = [
    lambda bad: vp.point_to_point([0.0], [1.0], 1.0, start_velocity=bad),
    lambda bad: vp.point_to_point([0.0], [1.0], 1.0, start_acceleration=bad),
    lambda bad: vp.through(LINE, [1.0, 1.0], via_velocities=bad),
    lambda bad: vp.minimum_duration(REACH, velocity=bad),
    lambda bad: vp.minimum_duration(TENSORS, velocity=1.0, jerk=bad),
    lambda bad: vp.retarget(REACH, 0.2, GOAL, 1.0, via=bad),
    lambda bad: REACH.transformed(rotation=bad),
    lambda bad: REACH.transformed(translation=bad),
    lambda bad: TENSORS.transformed(scale=bad),
]
VALUES = [  # call, then bad values
    (lambda bad: vp.through([[0.0], [1.0]], [1.0], order=bad), [1, 5, 3.0, [3], "3", None, True, np.array([3, 3])]),
    (lambda bad: vp.point_to_point([0.0], [1.0], 1.0, order=2, goal_acceleration=bad), [[1.0]]),
    (lambda bad: vp.point_to_point([0.0], [1.0], bad), [0.0, -1.0, [1.0, -1.0]]),
    (lambda bad: vp.passage_durations(LINE, bad), [0.0, -1.0]),
    (lambda bad: vp.minimum_jerk_coefficients(0, 0, 0, 1, 0, 0, bad), [0.0, -1.0]),
    (lambda bad: vp.through(LINE, bad), [[1.0, -1.0], [0.0, 1.0], [0.0, 0.0], [1.0], 1.0, np.ones((2, 3))]),
    (lambda bad: vp.passage_durations(bad, 1.0), [0.0, [1.0, 2.0], np.ones((1, 2)), np.ones((3, 0))]),
    (lambda bad: vp.point_to_point(bad, GOAL, np.ones(3)), [0.0, [0.0], np.ones((2, 2))]),
    (lambda bad: vp.through(LINE, [1.0, 1.0], start_velocity=bad), [1.0, [1.0], np.ones(3)]),
    (lambda bad: vp.through(LINE, [1.0, 1.0], via_velocities=bad), [1.0, np.ones((2, 2)), np.ones((1, 3))]),
    (lambda bad: BATCH.stretched(bad), [0.0, -1.0, np.ones(2)]),
    (lambda bad: BATCH.transformed(rotation=bad), [1.0, np.eye(3), np.zeros((0, 2)), np.ones((2, 2, 2))]),
    (lambda bad: BATCH.transformed(translation=bad), [[1.0], 1.0, np.ones((2, 2))]),
    (lambda bad: BATCH.transformed(scale=bad), [np.ones(2)]),
    (lambda bad: BATCH(bad), [np.ones((2, 5))]),
    (lambda bad: BATCH.sample(bad), [1, -3]),
    (lambda bad: BATCH.sample(5, bad), [(), *BAD_NU[1:], [-1]]),
    (lambda bad: REACH(0.5, bad), BAD_NU),
    (lambda bad: REACH.peak(bad), BAD_NU),
    (lambda bad: REACH.extrema(bad), BAD_NU),
    (lambda bad: REACH.energy(bad), [*BAD_NU, 6]),
    (lambda bad: vp.minimum_duration(BATCH, **bad), [{}, {"velocity": 0.0}, {"acceleration": [1.0, -1.0]}]),
    (lambda bad: vp.minimum_duration(BATCH, jerk=bad), [np.ones(3), np.ones((2, 1))]),
    (lambda bad: vp.retarget(REACH, bad, GOAL, 2.0), [1.0, -0.1]),
    (lambda bad: vp.retarget(BATCH, 0.2, bad, 2.0), [0.0, np.ones(3), np.ones((2, 2))]),
    (lambda bad: vp.retarget(REACH, 0.5, GOAL, bad), [0.5, 0.0]),
    (lambda bad: vp.retarget(REACH, 0.5, GOAL, 2.0, via=bad), [1.0, [1.0], np.ones(3)]),
    (lambda bad: vp.retarget(REACH, 0.2, GOAL, 1.0, freeze=bad), [np.nan, np.inf, -1, [1.0], "0.1", None, True, FREE]),
    (lambda bad: vp.retarget(REACH, 0.5, GOAL, 2.0, freeze=0.1, goal_velocity=bad), [FREE]),
    (lambda bad: vp.retarget(bad, 0.5, [1.0], 2.0), [vp.point_to_point([0.0], [1.0], 1.0, order=4)]),
    (lambda bad: vp.curvature(bad, [0.5]), [vp.point_to_point([0.0], [1.0], 1.0)]),
    (lambda bad: vp.spectral_arc_length(REACH, cutoff=bad), [0, -1.0, np.nan, None, "10", [10.0], FREE]),
    (lambda bad: vp.spectral_arc_length(REACH, threshold=bad), [-0.1, 1.0, np.nan, None, "0", np.ones(2)]),
    (lambda bad: vp.point_to_point([0.0], [1.0], bad).extrema(2), [1e-300]),
    (lambda bad: vp.point_to_point(torch.zeros(2), torch.ones(2), bad).peak(2), [1e-30]),
    (lambda bad: vp.fit_via_points(bad, SEEN), [TIME * np.nan, TIME[:10], TIME[::-1], TWICE]),
    (lambda bad: vp.fit_via_points(TIME, bad), [MISSING, SEEN[:, 0], ONES, [], [[[0.0], [1.0, 2.0]]], None]),
    (lambda bad: vp.fit_via_points(TIME, bad), [[SEEN, MISSING], [SEEN, SEEN[:, :1]], np.ones((0, 20, 2))]),
    (lambda bad: vp.fit_via_points([TIME], bad), [[SEEN, SEEN]]),
    (lambda bad: vp.fit_via_points(TIME, SEEN, bad), [-1, 9, 1.5, (2, 1), (0, 1, 2), "1", True]),
    (lambda bad: vp.fit_via_points(TIME[:10], SEEN[:10], bad), [3]),  # too few samples for them
    (lambda bad: vp.fit_via_points(TIME, SEEN, free_ends=bad), ["no"]),
    (lambda bad: REACH.stretched(bad), [torch.tensor(0.3)]),  # tensors for a NumPy trajectory
    (lambda bad: REACH.transformed(scale=bad), [torch.tensor(0.3)]),
    (lambda bad: vp.retarget(REACH, bad, GOAL, 1.0), [torch.tensor(0.3)]),
]
NO_TRAJECTORIES = [None, [0.0, 1.0], np.zeros((3, 2)), "reach"]
ASKED = [
    *(vp.cost_gradient, vp.dimensionless_jerk, vp.log_dimensionless_jerk, vp.spectral_arc_length),
    *(vp.speed_peaks, vp.speed_valleys),
    lambda bad: vp.curvature(bad, [0.5]),
    lambda bad: vp.speed(bad, [0.5]),
    lambda bad: vp.minimum_duration(bad, velocity=1.0),
    lambda bad: vp.retarget(bad, 0.2, GOAL, 1.0),
]
# fmt: on
ROWS = [
    *((call, [None, *BAD_ARRAYS]) for call in REQUIRED),
    *((call, BAD_ARRAYS) for call in OPTIONAL),
    *VALUES,
    *((call, NO_TRAJECTORIES) for call in ASKED),
]


@pytest.mark.parametrize(("call", "values"), ROWS)
def test_bad_input_is_refused(call, values):
    for bad in values:
        with pytest.raises(ValueError):
            call(bad)


def test_an_argument_at_fault_is_named():
    """A user finds the one bad number among many by its name and place."""
    goals = [[0.0, 1.0], [np.nan, 1.0], [0.0, 1.0]]
    with pytest.raises(ValueError, match=r"^goal must be finite, got nan at index \(1, 0\)"):
        vp.point_to_point([0.0, 0.0], goals, 1.0)
