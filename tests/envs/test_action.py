"""Laws of the action."""

import numpy as np
import pytest
import torch

from viapoint.envs.actions.via_points import ActionLayout, Plan, frame
from viapoint.primitives import point_to_point

LAYOUTS = [
    ActionLayout(dimension=d, n_via=k, timing=timing)
    for d in (2, 3)
    for k in (0, 1, 2, 3)
    for timing in ("optimal", "learned")
]


def ends(dimension, number=20, seed=0):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-0.5, 0.5, (number, dimension))
    step = rng.standard_normal((number, dimension))
    return start, start + 0.3 * step / np.linalg.norm(step, axis=-1, keepdims=True)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_zero_action_is_the_straight_minimum_jerk_movement(layout):
    start, goal = ends(layout.dimension)
    plan = layout.decode(np.zeros((20, layout.size)), start, goal)
    duration = plan.durations.sum(axis=-1)
    np.testing.assert_allclose(duration, layout.centre_duration, rtol=1e-12)
    times = duration[:, None] * np.linspace(0.0, 1.0, 50)
    straight = point_to_point(start, goal, duration)
    for nu, scale in ((0, 1.0), (1, 1.0), (2, 10.0)):
        np.testing.assert_allclose(plan.trajectory()(times, nu), straight(times, nu), atol=1e-8 * scale)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_encode_inverts_decode(layout):
    start, goal = ends(layout.dimension)
    action = np.random.default_rng(1).uniform(-1.0, 1.0, (20, layout.size))
    np.testing.assert_allclose(layout.encode(layout.decode(action, start, goal)), action, atol=1e-9)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_component_has_a_name_and_a_unit(layout):
    assert len(layout.names) == len(layout.units) == layout.size == len(set(layout.names))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_numpy_and_torch_decode_alike(layout):
    start, goal = ends(layout.dimension)
    action = np.random.default_rng(2).uniform(-1.0, 1.0, (20, layout.size))
    ours = layout.decode(action, start, goal)
    theirs = layout.decode(*(torch.as_tensor(a) for a in (action, start, goal)))
    np.testing.assert_allclose(theirs.waypoints.numpy(), ours.waypoints, atol=1e-12)
    np.testing.assert_allclose(theirs.durations.numpy(), ours.durations, atol=1e-9)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_frame_is_orthonormal_and_starts_along_the_line(dimension):
    start, goal = ends(dimension)
    if dimension == 3:
        goal[0] = start[0] + [0.0, 0.0, 0.2]  # straight up
    axes = np.stack(frame(goal - start), axis=-2)
    np.testing.assert_allclose(
        axes @ np.swapaxes(axes, -1, -2), np.tile(np.eye(dimension), (20, 1, 1)), atol=1e-12
    )
    along = (goal - start) / np.linalg.norm(goal - start, axis=-1, keepdims=True)
    np.testing.assert_allclose(axes[:, 0], along, atol=1e-12)


def test_a_movement_turns_and_shifts_with_its_ends():
    layout = ActionLayout(n_via=2)
    start, goal = ends(2)
    action = np.random.default_rng(3).uniform(-1.0, 1.0, (20, layout.size))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    here = layout.decode(action, start, goal)
    there = layout.decode(action, start @ turn.T + 0.3, goal @ turn.T + 0.3)
    np.testing.assert_allclose(there.waypoints, here.waypoints @ turn.T + 0.3, atol=1e-12)
    np.testing.assert_allclose(there.durations, here.durations, atol=1e-9)


def test_bigger_duration_component_means_longer_between_the_stated_bounds():
    layout = ActionLayout(duration_range=(0.5, 2.0))
    start, goal = ends(2, 3)
    action = np.zeros((3, layout.size))
    action[:, layout.names.index("duration")] = (-1.0, 0.0, 1.0)
    np.testing.assert_allclose(layout.decode(action, start, goal).durations.sum(axis=-1), (0.5, 1.0, 2.0))


def test_lists_are_arrays():
    layout = ActionLayout()
    plan = layout.decode([0.1, 0.2, 0.3], [0.0, 0.0], (0.3, 0.1))
    same = layout.decode(np.array([0.1, 0.2, 0.3]), np.zeros(2), np.array([0.3, 0.1]))
    np.testing.assert_array_equal(plan.waypoints, same.waypoints)
    np.testing.assert_array_equal(plan.durations, same.durations)
    listed = Plan(same.waypoints.tolist(), same.durations.tolist())
    np.testing.assert_array_equal(layout.encode(listed), layout.encode(same))
    with pytest.raises(ValueError):
        layout.decode([[0.1], 0.2, 0.3], [0.0, 0.0], [0.3, 0.1])
