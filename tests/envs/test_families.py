"""Layouts of families are valid obstacles in any room, and move and grow with their frame."""

import math

import numpy as np
import pytest

from viapoint.envs.arms.kinematics import link_poses
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.geometry.obstacles import KINDS, no_obstacles, unpack
from viapoint.envs.geometry.shapes import Sphere
from viapoint.envs.scenes.families_registry import (
    FAMILIES,
    default_families,
    register_scene_family,
    scene_families,
)
from viapoint.envs.scenes.layout import MOST_PLACES, PLACE, ROW, Furniture, Place, Room, most_rows
from viapoint.envs.scenes.sampler import room_of
from viapoint.envs.task import Task

ALL = KINDS[:5]
NAMES = sorted(FAMILIES)


def shapes_of(layout):
    """Return the obstacles of a layout as shapes, which check their own numbers."""
    rows = np.array(layout.rows).reshape(-1, ROW)
    obstacles = no_obstacles(1, len(rows))
    obstacles.kind[0] = rows[:, 0]
    obstacles.centre[0], obstacles.size[0] = rows[:, 1:4], rows[:, 13:]
    obstacles.rotation[0] = rows[:, 4:13].reshape(-1, 3, 3)
    turned = obstacles.rotation[0] @ obstacles.rotation[0].transpose(0, 2, 1)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(obstacles.rotation[0]), 1.0)
    return unpack(obstacles, 0)


def room(plane, most, kinds=ALL, tall=False):
    return room_of(arm_of("planar" if plane else "panda"), kinds, (1, most), tall)


@pytest.mark.parametrize(("plane", "name"), NAMES)
@pytest.mark.parametrize("tall", [False, True])
@pytest.mark.parametrize("spare", [0, 2, 12])
def test_layouts_are_valid_obstacles_of_allowed_kinds(plane, name, tall, spare):
    family = FAMILIES[plane, name]
    most = family.n_obstacles + spare
    for kinds in {ALL, (*family.kinds, "cylinder"), family.kinds or ("box",)}:
        rng = np.random.default_rng(spare)
        for _ in range(12):
            layout = family.build(rng, room(plane, most, kinds, tall))
            shapes = shapes_of(layout)
            assert len(shapes) <= (most_rows(most) if layout.keep else most)
            assert layout.keep <= most
            assert {shape.kind for shape in shapes} <= set(kinds)
            places = np.array([*layout.goals, *layout.starts]).reshape(-1, PLACE)
            assert np.isfinite(places).all()
            assert (places[:, 6:9] >= 0.0).all()
            assert len(places) <= 2 * MOST_PLACES
            if plane:
                assert len(layout.starts) == len(layout.goals) == PLACE


def test_families_never_trained_are_no_defaults():
    names = default_families(False, ALL, 32)
    assert set(names) == {"shelf", "table", "bin", "gate", "tunnel", "clutter"}
    assert default_families(False, ("sphere",), 32) == ("clutter",)
    assert "shelf" not in default_families(False, ALL, 3)


def test_furniture_moves_with_its_frame():
    """Turn and shift the frame: the layout is turned and shifted."""

    def build(x, y, yaw):
        furniture = Furniture(Room(ALL, 1, 9), x, y, yaw)
        furniture.box((0.1, 0.2, 0.3), (0.01, 0.02, 0.03), 0.4)
        furniture.capsule((0.3, -0.2, 0.1), 0.02, 0.1, 0.7, 0.5)
        furniture.cylinder((0.0, 0.5, 0.2), 0.03, 0.1)
        furniture.sphere((0.2, 0.0, 0.0), 0.1)
        furniture.floor(-0.1)
        return shapes_of(furniture.layout())

    x, y, yaw = 0.4, -0.3, 1.1
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    moved = points @ turn.T + (x, y, 0.0)
    for first, second in zip(build(0.0, 0.0, 0.0), build(x, y, yaw), strict=True):
        np.testing.assert_allclose(first.distance(points), second.distance(moved), atol=1e-12)


def test_layouts_grow_with_the_arm_around_its_foot():
    small, foot, scale = room(False, 16), np.array([0.1, 0.2, 0.3]), 0.4
    large = small._replace(scale=scale, foot=tuple(foot))
    for name, family in scene_families(plane=False).items():
        first, second = (family.build(np.random.default_rng(3), each) for each in (small, large))
        one, two = (np.array(each.rows).reshape(-1, ROW) for each in (first, second))
        np.testing.assert_allclose(two[:, 1:4], foot + scale * one[:, 1:4], atol=1e-12, err_msg=name)
        np.testing.assert_allclose(two[:, 13:], scale * one[:, 13:], atol=1e-12)
        np.testing.assert_allclose(two[:, 4:13], one[:, 4:13])


def test_elbow_is_that_of_the_arm():
    arm, rng = arm_of("planar"), np.random.default_rng(0)
    furniture = Furniture(room(True, 5), 0.1, 0.2, 0.7)
    turn = np.array([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]])
    for joints in rng.uniform(*arm.joint_range.T, (50, 2)):
        elbow = link_poses(arm.chain, joints)[1][2, :2]
        hand = (arm.hand(joints)[:2] - (0.1, 0.2)) @ turn
        np.testing.assert_allclose(furniture.elbow(*hand), (elbow - (0.1, 0.2)) @ turn, atol=1e-9)


@pytest.mark.usefixtures("registry")
def test_own_family_of_shapes_and_places_is_drawn():
    def ball(rng, room):
        return [Sphere(0.1, position=(0.45, 0.0, 0.45))], [Place((0.6, 0.0, 0.4), half=(0.05, 0.1, 0.1))]

    register_scene_family("ball", ball, kinds=("sphere",), trained=True)
    assert "ball" in default_families(False, ("sphere",), 1)
    task = Task.of(arm="panda", n_obstacles=1, shapes="sphere", families="ball")
    sampler = task.sampler()
    scenes = sampler([np.random.default_rng(seed) for seed in range(5)])
    assert (scenes.obstacles.centre == (0.45, 0.0, 0.45)).all()
    assert (scenes.obstacles.kind == 0).all()
