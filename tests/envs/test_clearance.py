"""Clearance is the least of all spheres, promises no contact, and is the same however it is computed."""

import mujoco
import numpy as np
import pytest

from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.geometry.clearance import (
    FAR,
    clearance_profile,
    configuration_clearances,
    memory,
    movement_clearance,
)
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.geometry.shapes import Box, Capsule, Cylinder, HalfSpace, Sphere

KINDS = ("sphere", "capsule", "cylinder", "box", "half_space")


def unit(rng, size):
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


def some_shapes(rng, number, kinds=KINDS, moving=False):
    shapes = []
    for _ in range(number):
        pose = {
            "position": rng.uniform(-0.7, 0.7, 3) * (1.0, 1.0, rng.choice((0.2, 1.0))),
            "quaternion": unit(rng, 4),
        }
        pose["velocity"] = rng.uniform(-0.5, 0.5, 3) if moving else (0.0, 0.0, 0.0)
        kind = rng.choice(kinds)
        if kind == "sphere":
            shapes.append(Sphere(rng.uniform(0.02, 0.15), **pose))
        elif kind == "capsule":
            shapes.append(Capsule(rng.uniform(0.02, 0.1), rng.uniform(0.05, 0.3), **pose))
        elif kind == "cylinder":
            shapes.append(Cylinder(rng.uniform(0.02, 0.1), rng.uniform(0.05, 0.3), **pose))
        elif kind == "box":
            shapes.append(Box(rng.uniform(0.02, 0.2, 3), **pose))
        else:
            normal = unit(rng, 3)
            shapes.append(HalfSpace.facing(normal, position=-0.5 * normal))
    return shapes


def some_joints(rng, arm, *shape):
    low, high = arm.joint_range.T
    return rng.uniform(low, high, (*shape, len(low)))


@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_is_that_of_the_nearest_sphere(name):
    rng, arm = np.random.default_rng(0), arm_of(name)
    number = 60
    joints = some_joints(rng, arm, number)
    scenes = [some_shapes(rng, 4, moving=True) for _ in range(number)]
    times = rng.uniform(0.0, 1.0, number)
    found = configuration_clearances(arm.chain, arm.spheres, joints, pack(scenes), times)
    link = np.repeat(arm.spheres.link, np.diff(arm.spheres.first))
    group = np.repeat(np.arange(len(arm.spheres.link)), np.diff(arm.spheres.first))
    for i in range(number):
        centres = sphere_centres(arm.chain, arm.spheres, joints[i])
        moves = link > 0
        distances = [
            shape.distance(centres[moves] - times[i] * shape.velocity, arm.spheres.radius[moves])
            for shape in scenes[i]
        ]
        assert found[i, 0] == pytest.approx(min(np.min(distances), FAR), abs=1e-9)
        apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
        apart -= arm.spheres.radius[:, None] + arm.spheres.radius
        pairs = {tuple(pair) for pair in arm.spheres.pairs}
        compared = np.array([[(a, b) in pairs for b in group] for a in group])
        assert found[i, 1] == pytest.approx(min(apart[compared].min(initial=FAR), FAR), abs=1e-9)


@pytest.mark.parametrize("name", ["planar", "panda"])
def test_clearance_of_a_movement_is_that_of_its_nearest_configuration(name):
    """Though most configurations are skipped."""
    rng, arm = np.random.default_rng(1), arm_of(name)
    for _ in range(20):
        obstacles = pack([some_shapes(rng, 5, moving=True)])
        ends = some_joints(rng, arm, 2)
        path = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
        step = 0.004
        found = movement_clearance(
            arm.chain, arm.spheres, arm.reach, path, obstacles, 0, 0.0, step, memory(arm.chain, arm.spheres)
        )
        whole = obstacles.take(np.zeros(len(path), int))
        each = configuration_clearances(arm.chain, arm.spheres, path, whole, step * np.arange(len(path)))
        assert found == pytest.approx(tuple(each.min(axis=0)), abs=1e-12)
        profile = clearance_profile(arm.chain, arm.spheres, path, obstacles, 0, step, 0.1)
        np.testing.assert_allclose(profile, np.minimum(each[:, 0], 0.1), atol=1e-12)


@pytest.mark.parametrize("name", ["planar", "panda"])
@pytest.mark.parametrize("kind", KINDS)
def test_without_a_negative_clearance_there_is_no_contact(name, kind):
    """In MuJoCo, for the arm with obstacles and with itself; and contacts have negative clearances."""
    rng, arm = np.random.default_rng(2), arm_of(name)
    number = 400
    joints = some_joints(rng, arm, number)
    scenes = [some_shapes(rng, 1, (kind,)) for _ in range(number)]
    found = configuration_clearances(arm.chain, arm.spheres, joints, pack(scenes), np.zeros(number))
    counts = np.zeros(2, int)
    model = arm.compile(1)
    data = mujoco.MjData(model)
    for i, (shape,) in enumerate(scenes):
        model.geom("obstacle_0").type[:] = shape.geom.value
        size = (0.0, 0.0, 0.01) if kind == "half_space" else shape.packed_size
        model.geom("obstacle_0").size[:] = size
        model.geom_rbound[model.geom("obstacle_0").id] = 0.0 if kind == "half_space" else 1.0
        model.geom_aabb[model.geom("obstacle_0").id] = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
        data.mocap_pos[0], data.mocap_quat[0] = shape.position, shape.quaternion
        data.qpos[:] = joints[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        contact = data.ncon > 0
        free = found[i].min() >= 0.0
        assert not (free and contact), (i, found[i])
        counts += (free, contact)
    assert (counts > 10).all()
