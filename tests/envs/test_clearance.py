"""Clearance is the least of all spheres, and is the same however it is computed."""

import dataclasses

import numpy as np
import pytest
from helpers import least_pair_distance, random_shape

from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.geometry.clearance import (
    FAR,
    RESOLUTION,
    ROUGHLY,
    bounds_memory,
    configuration_clearances,
    memory,
    movement_clearance,
)
from viapoint.envs.geometry.obstacles import KINDS, pack
from viapoint.envs.geometry.shapes import as_obstacle


def some_shapes(rng, number):
    """Return moving shapes around the arm."""
    shapes = []
    for kind in rng.choice(KINDS, number):
        shape = random_shape(kind, rng, moving=True)
        shapes.append(as_obstacle({**shape.to_dict(), "position": rng.uniform(-0.7, 0.7, 3)}))
    return shapes


def some_joints(rng, arm, *shape):
    low, high = arm.joint_range.T
    return rng.uniform(low, high, (*shape, len(low)))


@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_is_that_of_the_nearest_sphere(name):
    rng, arm = np.random.default_rng(0), arm_of(name)
    number = 60
    joints = some_joints(rng, arm, number)
    scenes = [some_shapes(rng, 4) for _ in range(number)]
    times = rng.uniform(0.0, 1.0, number)
    found = configuration_clearances(arm.chain, arm.spheres, joints, pack(scenes), times)
    link = np.repeat(arm.spheres.link, np.diff(arm.spheres.first))
    for i in range(number):
        centres = sphere_centres(arm.chain, arm.spheres, joints[i])
        moves = link > 0
        distances = [
            shape.distance(centres[moves] - times[i] * shape.velocity, arm.spheres.radius[moves])
            for shape in scenes[i]
        ]
        assert max(found[i, 0], -FAR) == pytest.approx(np.clip(np.min(distances), -FAR, FAR), abs=1e-9)
    own = least_pair_distance(arm, joints).min(axis=-1, initial=FAR)
    np.testing.assert_allclose(found[:, 1], own, atol=1e-9)


@pytest.mark.parametrize("number", [0, 5])
@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_of_a_movement_is_that_of_its_nearest_configuration(name, number):
    """Though most configurations of these winding movements are skipped."""
    rng, arm = np.random.default_rng(1), arm_of(name)
    share = np.linspace(0.0, 1.0, 400)[:, None]
    step, placed = 0.004, memory(arm.chain, arm.spheres)
    bounds = bounds_memory(arm.chain, arm.spheres, False)
    for _ in range(50):
        obstacles = pack([some_shapes(rng, number)]).with_rows(5)
        start, goal, bend = some_joints(rng, arm, 3)
        path = start + share * (goal - start) + 0.3 * np.sin(3.0 * np.pi * share) * (bend - start)
        path = np.clip(path, *arm.joint_range.T)
        found = movement_clearance(
            arm.chain, arm.spheres, arm.reach, path, obstacles, 0, 0.0, step, placed, bounds, 0.0
        )
        scenes = obstacles.take(np.zeros(len(path), int))
        each = configuration_clearances(arm.chain, arm.spheres, path, scenes, step * np.arange(len(path)))
        np.testing.assert_allclose(np.maximum(found, -FAR), np.maximum(each.min(axis=0), -FAR), atol=1e-9)


@pytest.mark.parametrize(("name", "number"), [("planar", 9), ("panda", 9), ("panda", 97)])
def test_clearance_between_configurations_is_that_of_many_more(name, number):
    """Of a path with few of them, among obstacles that move."""
    rng, arm = np.random.default_rng(1), arm_of(name)
    placed = memory(arm.chain, arm.spheres)
    all_times, these_times = (bounds_memory(arm.chain, arm.spheres, between) for between in (True, False))
    corners, few, many = (np.linspace(0.0, 1.0, each) for each in (9, number, 4001))
    duration = 0.5
    deeper = 0
    for _ in range(60):
        shapes = [
            dataclasses.replace(each, velocity=rng.uniform(-0.2, 0.2, 3)) for each in some_shapes(rng, 5)
        ]
        turns = some_joints(rng, arm, 9).T
        path = np.stack([np.interp(few, corners, joint) for joint in turns], axis=-1)
        dense = np.stack([np.interp(many, corners, joint) for joint in turns], axis=-1)
        body = arm.chain, arm.spheres, arm.reach
        least = []
        for joints, bounds in ((path, all_times), (dense, these_times), (path, these_times)):
            step = duration / (len(joints) - 1)
            found = movement_clearance(*body, joints, pack([shapes]), 0, 0.0, step, placed, bounds, 0.0)
            least.append(max(min(found), -FAR))
        # Many configurations may miss something, too.
        assert least[1] - 3e-3 <= least[0] <= least[1] + ROUGHLY
        assert least[0] < 0.0 or least[1] > -RESOLUTION
        deeper += least[0] < least[2] - (0.01 if number == 9 else 1e-3)
    assert deeper > 10  # something passes between the configurations
