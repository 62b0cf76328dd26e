"""Clearance is exact and agrees with MuJoCo's contacts."""

import numpy as np
import pytest

from viapoint.envs.arms import ADULT
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.distance import (
    MAX_CLEARANCE,
    arm_clearance,
    hand_clearance,
    point_distance_squared,
    segment_distance_squared,
)
from viapoint.envs.sim.simulator import Simulator


def rows(dimension, shape, seed=0):
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-0.5, 0.5, (*shape, dimension))
    axis = rng.uniform(-0.12, 0.12, (*shape, dimension)) * (rng.random((*shape, 1)) < 0.6)
    return np.concatenate((centre, axis, rng.uniform(0.006, 0.04, (*shape, 1))), axis=-1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_segment_distance_is_the_least_of_all_point_distances(dimension):
    rng = np.random.default_rng(1)
    obstacles = rows(dimension, (200, 1))
    first, second = rng.uniform(-0.5, 0.5, (2, 200, 1, dimension))
    exact = np.sqrt(segment_distance_squared(first, second, obstacles))[:, 0, 0]
    s = np.linspace(0.0, 1.0, 301)
    on_link = first + s[:, None] * (second - first)
    centre, axis = obstacles[..., :dimension], obstacles[..., dimension : 2 * dimension]
    on_axis = centre + (2.0 * s[:, None] - 1.0) * axis
    brute = np.linalg.norm(on_link[:, :, None] - on_axis[:, None], axis=-1).min(axis=(1, 2))
    assert (exact <= brute + 1e-12).all()
    np.testing.assert_allclose(exact, brute, atol=3e-3)


@pytest.mark.parametrize("whole_arm", [False, True])
def test_contact_exactly_where_clearance_is_negative(whole_arm):
    number = 3000
    rng = np.random.default_rng(2)
    joints = np.stack((rng.uniform(-0.4, 2.4, number), rng.uniform(0.2, 2.4, number)), axis=-1)
    obstacles, present = rows(2, (number, 3)), rng.random((number, 3)) < 0.8
    obstacles[..., 1] += 0.25
    simulator = Simulator(CollisionModel(ADULT, whole_arm), n_obstacles=3, num_envs=number, threads=2)
    simulator.place(np.arange(number), joints, obstacles, present)
    contact = simulator.rollout(np.arange(number), np.zeros((number, 1, 2))).contact[:, 0]
    clearance = hand_clearance(ADULT.hand_position(joints)[:, None], ADULT.hand_radius, obstacles, present)
    if whole_arm:
        links = ADULT.links(joints)[:, None]
        clearance = np.minimum(clearance, arm_clearance(links, ADULT.link_radii, obstacles, present))
    np.testing.assert_array_equal(contact, clearance.min(axis=-1) < 0.0)
    assert 0.01 < contact.mean() < 0.5


@pytest.mark.parametrize("whole_arm", [False, True])
def test_the_profile_has_the_clearance_as_its_least_value(whole_arm):
    rng = np.random.default_rng(3)
    joints = np.cumsum(rng.uniform(-0.05, 0.05, (10, 40, 2)), axis=1) + 1.0
    obstacles, present = rows(2, (10, 4)), rng.random((10, 4)) < 0.7
    model, hand = CollisionModel(ADULT, whole_arm), ADULT.hand_position(joints)
    profile = model.clearance_profile(hand, np.repeat(obstacles[:, None], 40, axis=1), present, joints)
    least = hand_clearance(hand, ADULT.hand_radius, obstacles, present)
    if whole_arm:
        links = arm_clearance(ADULT.links(joints), ADULT.link_radii, obstacles, present)
        least = np.minimum(least, links)
    np.testing.assert_allclose(profile.min(axis=1), least, atol=1e-12)
    np.testing.assert_allclose(
        model.least_clearance(hand, obstacles, present, joints), least.min(axis=-1), atol=1e-12
    )


def test_a_hand_no_thicker_than_the_forearm_is_inside_its_end():
    rng = np.random.default_rng(6)
    low, high = np.array(ADULT.joint_range).T
    joints = rng.uniform(low, high, (10, 40, 2))
    obstacles, present = rows(2, (10, 4)), rng.random((10, 4)) < 0.7
    hand, links, radii = ADULT.hand_position(joints), ADULT.links(joints), ADULT.link_radii
    alone = arm_clearance(links, radii, obstacles, present)
    for radius in (ADULT.hand_radius, radii[-1]):
        assert (hand_clearance(hand, radius, obstacles, present) >= alone - 1e-12).all()
    assert (hand_clearance(hand, radii[-1] + 0.01, obstacles, present) < alone - 0.009).any()


def test_absent_obstacles_are_far_and_order_is_irrelevant():
    rng = np.random.default_rng(4)
    points, obstacles = rng.uniform(-0.5, 0.5, (5, 30, 2)), rows(2, (5, 4))
    nothing = hand_clearance(points, 0.015, obstacles, np.zeros((5, 4), dtype=bool))
    np.testing.assert_array_equal(nothing, MAX_CLEARANCE)
    there = np.ones((5, 4), dtype=bool)
    forwards = hand_clearance(points, 0.015, obstacles, there)
    np.testing.assert_array_equal(hand_clearance(points, 0.015, obstacles[:, ::-1], there), forwards[:, ::-1])


def test_what_an_obstacle_has_drifted_counts_as_if_it_stood_there():
    generator = np.random.default_rng(5)
    first, second = generator.uniform(-0.5, 0.5, (2, 4, 7, 2))
    obstacles, drift = rows(2, (4, 3)), generator.normal(size=(4, 3, 7, 2))
    for distance, ends in ((point_distance_squared, (first,)), (segment_distance_squared, (first, second))):
        drifted = distance(*ends, obstacles, drift)
        for t in range(7):
            there = obstacles.copy()
            there[..., :2] += drift[:, :, t]
            still = distance(*(end[:, t : t + 1] for end in ends), there)
            np.testing.assert_allclose(drifted[..., t], still[..., 0], atol=1e-12)
