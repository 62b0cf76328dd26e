"""Laws of sensors: what is seen, and that nothing else is."""

import dataclasses

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from helpers import PLANE, SENSED, scenes_of

import viapoint.envs as ve
from viapoint.envs.events import NEW_DISTANCE, NEW_POINTS, Event
from viapoint.envs.geometry.obstacles import add_to_model, pack, unpack
from viapoint.training import ViaRank, ViaVecEnv
from viapoint.training.planning.beliefs import Sight, fitted_boxes, thick_points
from viapoint.training.planning.search import registered_task

PANDA = ve.arm_of("panda")
CORNERS = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.05, 0.08) for z in (-0.1, 0.12)])
SCENE = [
    ve.Box((0.1, 0.05, 0.2), position=(0.8, 0.1, 0.1), quaternion=(0.9239, 0.2209, 0.2209, 0.2209)),
    ve.Sphere(0.1, position=(0.9, -0.3, 0.2)),
    ve.Capsule(0.05, 0.1, position=(0.7, 0.4, 0.0), quaternion=(0.8, 0.6, 0.0, 0.0)),
    ve.Cylinder(0.08, 0.1, position=(0.6, -0.1, -0.2), quaternion=(0.6, 0.0, 0.8, 0.0)),
    ve.HalfSpace(position=(0.0, 0.0, -0.5)),
    ve.ConvexMesh(CORNERS, position=(0.9, 0.3, 0.5)),
]
WIDE = ve.Sensor(columns=40, rows=30, field_of_view=2.0, range=3.0)
FINE = ve.Sensor(columns=200, rows=150, field_of_view=1.0, range=3.0)


def look(sensor, *shapes, joints=PANDA.home):
    return sensor.read(PANDA, joints[None], pack([shapes]))


@pytest.mark.parametrize("shape", SCENE, ids=lambda shape: shape.kind)
def test_ranges_are_those_of_mujoco(shape) -> None:
    found = look(WIDE, shape)
    spec = mujoco.MjSpec()
    add_to_model(spec, [shape])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = np.zeros(1, np.int32)
    theirs = []
    for ray in WIDE.directions:
        theirs.append(mujoco.mj_ray(model, data, np.zeros(3), ray, None, 1, -1, geom, None))
    theirs = np.array(theirs)
    theirs = np.where((theirs < 0.0) | (theirs > 3.0), 3.0, theirs)
    # Rays that graze an edge may differ.
    assert (np.abs(found.ranges[0] - theirs) < 1e-4).mean() > 0.995
    assert (found.ranges[0] < 3.0).any()


def test_rays_that_run_along_points_go_on_to_what_is_behind_them() -> None:
    row = np.arange(-0.3, 0.3, 0.01)
    floor = np.stack(np.meshgrid(np.arange(-0.2, 1.0, 0.01), row, 0.0), -1).reshape(-1, 3)
    wall = np.stack(np.meshgrid(1.0, row, np.arange(0.0, 0.4, 0.01)), -1).reshape(-1, 3)
    sensor = ve.Sensor(position=(0.0, 0.0, 0.015), columns=21, field_of_view=0.4, range=1.5)
    alone, both = [ve.PointCloud(each, radius=0.01) for each in (wall, np.concatenate((floor, wall)))]
    np.testing.assert_allclose(look(sensor, both).ranges, look(sensor, alone).ranges, atol=1e-4)


def test_the_nearest_obstacle_is_seen_and_readings_do_not_depend_on_the_batch() -> None:
    sensor = dataclasses.replace(WIDE, noise=0.01, dropped=0.1)
    alone = np.array([look(sensor, shape).ranges[0] for shape in SCENE])
    batch = sensor.read(PANDA, np.tile(PANDA.home, (len(SCENE), 1)), pack([[shape] for shape in SCENE]))
    assert np.array_equal(alone, batch.ranges)
    separate = np.array([look(WIDE, shape).ranges[0] for shape in SCENE])
    together = look(WIDE, *SCENE)
    assert np.array_equal(together.ranges[0], separate.min(axis=0))
    met = together.seen[0] >= 0
    assert np.array_equal(together.seen[0][met], separate.argmin(axis=0)[met])


def test_noise_and_dropped_rays_are_as_stated() -> None:
    wall = ve.Box((0.01, 5.0, 5.0), position=(1.0, 0.0, 0.0))
    sensor = dataclasses.replace(FINE, noise=0.02, dropped=0.2)
    found = look(sensor, wall)
    noisy, met = found.ranges[0], found.seen[0] >= 0
    error = (noisy - look(FINE, wall).ranges[0])[met]
    assert np.isclose(met.mean(), 0.8, atol=0.01)
    assert (noisy[~met] == 3.0).all()
    assert np.isclose(error.std(), 0.02, rtol=0.03)
    assert abs(error.mean()) < 1e-3
    # A scene that was written and read differs in its last bits, and looks the same.
    moved = dataclasses.replace(wall, position=(1.0 + 1e-15, 0.0, 0.0))
    assert np.allclose(look(sensor, moved).ranges[0], noisy, atol=1e-9)


def test_a_sensor_at_the_hand_moves_with_it() -> None:
    task = ve.Task.of(arm="panda", n_obstacles=(1, 4), sensor="hand_camera")
    below = np.array([0.0, 0.0, -0.3])
    # The first joint turns arm and sensor about the vertical axis; the sphere turned alike looks the same.
    turned = PANDA.home + 0.5 * np.eye(7)[0]
    first, second = (
        look(task.sensor, ve.Sphere(0.05, position=PANDA.hand(joints) + below), joints=joints)
        for joints in (PANDA.home, turned)
    )
    assert (first.seen >= 0).any()
    assert np.allclose(first.ranges, second.ranges, atol=1e-4)


@pytest.mark.parametrize(
    "place", [{"position": (0.2, 0.2, 0.0)}, {"mount": "hand", "position": (0.04, 0.0, 0.0)}]
)
def test_no_episode_begins_with_the_sensor_in_an_obstacle(place) -> None:
    moving = {"moving_obstacles": True, "decide_at": ["horizon"]}
    task = ve.Task.of(n_obstacles=(4, 6), sensor={"field_of_view": 6.28, "columns": 36, **place}, **moving)
    scenes = scenes_of(task, 60)
    assert (task.sensor.read(task.arm, scenes.start, scenes.obstacles).ranges >= 0.009).all()


def test_hidden_obstacles_change_nothing() -> None:
    task = registered_task(SENSED)
    scenes = scenes_of(task, 20)
    rotation, origin = task.sensor.pose(task.arm, scenes.start)
    hidden = task.sensor.hidden(rotation, origin, scenes.obstacles)
    assert hidden.any(axis=1).sum() >= 4
    without = scenes._replace(
        obstacles=scenes.obstacles._replace(kind=np.where(hidden, -1, scenes.obstacles.kind))
    )
    env = gym.make_vec(SENSED, num_envs=20).unwrapped
    seen, other = env.begin(scenes), env.begin(without)
    for name in seen:
        assert np.array_equal(seen[name], other[name])
    agent = ViaRank("ViaRankPolicy", ViaVecEnv(SENSED, 1), seed=0, policy_kwargs={"candidates": 64})
    assert np.array_equal(agent.predict(seen)[0], agent.predict(other)[0])


@pytest.mark.parametrize("belief", [thick_points, fitted_boxes])
@pytest.mark.parametrize("env_id", [SENSED, "viapoint/PandaSensed-v0"])
def test_beliefs_hold_what_is_seen_and_leave_the_ends_free(env_id, belief) -> None:
    task = registered_task(env_id)
    scenes = scenes_of(task, 5)
    sight = Sight.of_scenes(scenes, task)
    obstacles = belief(task, sight)
    for b in range(5):
        points = sight.points[b][sight.hit[b]]
        ends = np.linalg.norm(points[:, None] - sight.free[b], axis=-1) - sight.free_radius
        far = points[ends.min(axis=1) > 0.06]
        assert (ve.signed_distances(unpack(obstacles, b), far).min(axis=1) < 0.03).all()
        if belief is thick_points:
            free = ve.signed_distances(unpack(obstacles, b), sight.free[b], sight.free_radius)
            assert (free > 0.009).all()


def test_a_reading_of_zero_is_a_point_at_the_sensor() -> None:
    task = registered_task(SENSED)
    sight = Sight.of_scenes(scenes_of(task, 2), task)
    ray = int(sight.hit[0].argmax())
    sight.points[0, ray] = sight.eyes[0, ray]
    with np.errstate(invalid="raise"):
        (cloud,) = unpack(thick_points(task, sight), 0)
    assert np.isfinite(cloud.points).all()


LOOKING = {"sensor": "hand_rays", "decide_at": ("sight",), "n_via": 1}


def looks_of(observation):
    """Return places, ranges and points of the looks that are remembered."""
    number = len(observation["eyes"])
    points = observation["points"].reshape(number, 8, 192, 3)
    return observation["eyes"].reshape(number, 8, 3), observation["ranges"].reshape(number, 8, 192), points


def test_looks_are_remembered_and_new_points_end_decisions() -> None:
    envs = gym.make_vec(PLANE, num_envs=24, **LOOKING)
    envs.action_space.seed(0)
    before, _ = envs.reset(seed=3)
    seen = 0
    for _ in range(3):
        actions = envs.action_space.sample()
        after, _, ended, _, info = envs.step(actions)
        eyes, ranges, points = looks_of(after)
        _, ranges_before, points_before = looks_of(before)
        for i in np.flatnonzero(~ended):
            # The newest look is made from the hand; those before move up by one.
            assert eyes[i, 0] == pytest.approx(after["hand"][i], abs=1e-6)
            assert np.array_equal(points[i, 1:], points_before[i, :-1])
            assert np.array_equal(ranges[i, 1:], ranges_before[i, :-1])
            # What is new is far from all that was remembered; the arm is within a millimetre of its plan.
            assert info["event"][i] == Event.SIGHT
            new = points[i, 0][ranges[i, 0] < 0.39]
            known = points_before[i][ranges_before[i] < 0.39]
            apart = np.linalg.norm(new[:, None] - known, axis=-1).min(axis=1, initial=1.0)
            assert (apart > NEW_DISTANCE - 0.005).sum() >= NEW_POINTS - 2
            seen += 1
        before = after
    assert seen > 10
