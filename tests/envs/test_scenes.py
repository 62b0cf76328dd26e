"""Scenes that are drawn, and scenes that are given to `reset`."""

import math

import gymnasium as gym
import numpy as np
import pytest
from helpers import (
    CRATE,
    ENDS,
    HOME,
    MOVING,
    OTHER,
    PANDA,
    PANDA_ENDS,
    PANDA_MOVING,
    PLANE,
    given,
    post,
    same,
    same_scenes,
    scenes_of,
)

import viapoint.envs as ve
from viapoint import primitives
from viapoint.envs.arms.kinematics import forward
from viapoint.envs.geometry.obstacles import KINDS, no_obstacles, unpack
from viapoint.envs.scenes.families_registry import FAMILIES, default_families, scene_families
from viapoint.envs.scenes.layout import MOST_PLACES, PLACE, ROW, most_rows
from viapoint.envs.scenes.sampler import room_of
from viapoint.envs.scenes.scene import NEVER, check_scenes

REACHING = {"courses": "reaches"}
HOUSE = ve.Box((0.3, 0.3, 0.3), position=(0.3, 0.0, 0.5), name="house")


@pytest.fixture(scope="module")
def several():
    return gym.make_vec(PANDA, num_envs=3, threads=1).unwrapped


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        (PLANE, {}),
        (PLANE, {"whole_arm": True}),
        (PLANE, {"n_obstacles": (3, 5), "families": ("clutter", "gate")}),
        (PANDA, {"n_obstacles": (1, 16)}),
        (PANDA, {"n_obstacles": 9, "families": ("shelf", "cage")}),
        (PANDA, {"n_obstacles": (2, 4), "shapes": "sphere", "families": "clutter"}),
    ],
    ids=str,
)
def test_ends_are_free_and_the_straight_movement_is_not(env_id, kwargs):
    env = gym.make_vec(env_id, num_envs=12, threads=1, **kwargs).unwrapped
    env.reset(seed=0)
    check_scenes(env.scenes, env.task.arm)
    counts = env.scenes.obstacles.present.sum(axis=-1)
    fewest, most = env.task.n_obstacles
    assert (counts <= most).all()
    assert "families" in kwargs or (counts >= fewest).all() or env_id == PANDA
    info = env.execute_actions(np.zeros(env.action_space.shape)).info
    assert ((info["planned_clearance"] < 0.01) | ~info["reachable"]).all()


@pytest.mark.parametrize("env_id", [PLANE, MOVING, PANDA, PANDA_MOVING])
def test_a_scene_depends_on_its_generator_alone(env_id):
    task = gym.make(env_id).unwrapped.task
    together = scenes_of(task, 6)
    for i in (0, 5):
        same_scenes(task.sampler()([np.random.default_rng((0, i))]), together.take([i]))
    same_scenes(ve.Scenes.together([together.take([0, 1]), together.take([2, 3, 4, 5])]), together)


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        (PLANE, {}), (PANDA, {}), (MOVING, {}), (MOVING, REACHING), ("viapoint/PlanarTargetJump-v0", {}),
        ("viapoint/PlanarTargetJump-v0", {"n_jumps": (0, 2)}), ("viapoint/PlanarTargetJumpStep-v0", {}),
        ("viapoint/PlanarMovingObstaclesStep-v0", REACHING),
    ],
)  # fmt: skip
def test_drawn_scenes_survive_json(env_id, kwargs):
    """And their episodes."""
    env = gym.make(env_id, **kwargs).unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        scenes = env.batch.scenes
        text = ve.scene_to_json(scenes, env.task.arm, env.task.space_name, env_id=env_id)
        before = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        env.reset(options=ve.scene_from_json(text))
        again = env.batch.scenes
        for name, part in scenes.obstacles._asdict().items():
            if name not in ("meshes", "clouds"):
                np.testing.assert_allclose(getattr(again.obstacles, name), part, atol=1e-12)
        for name in ("start", "goal", "jumps", "turn_velocity", "reach"):
            np.testing.assert_allclose(getattr(again, name), getattr(scenes, name), atol=1e-9)
        after = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        for name, value in before.items():
            assert after[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name


def test_ends_may_be_poses_in_joint_space(several):
    down = (0.0, 1.0, 0.0, 0.0)
    poses = [ve.Pose((0.5, y, 0.4), down) for y in (-0.2, 0.0, 0.3)]
    several.reset(seed=0, options={"start": HOME, "goal": poses, "obstacles": []})
    hands, axes = forward(several.task.arm.chain, several.scenes.goal)
    np.testing.assert_allclose(hands, [pose.position for pose in poses], atol=1e-5)
    np.testing.assert_allclose(axes[:, 2, 2], -1.0, atol=1e-4)
    several.reset(seed=0, options={"goal": {"position": (0.5, 0.1, 0.3)}})
    np.testing.assert_allclose(several.task.arm.hand(several.scenes.goal), [(0.5, 0.1, 0.3)] * 3, atol=1e-5)


def test_the_parts_that_are_not_given_are_drawn_to_fit(several):
    several.reset(seed=0, options={"obstacles": [CRATE]})
    assert several.scenes.obstacles.present.sum() == 3
    check_scenes(several.scenes, several.task.arm)
    several.reset(seed=0, options={"start": HOME})
    np.testing.assert_array_equal(several.scenes.start, [HOME] * 3)
    assert several.scenes.obstacles.present.any(axis=1).all()


def test_each_scene_of_a_batch_has_its_own_obstacles_and_names(several):
    floor = ve.Box((0.2, 0.2, 0.05), position=(0.0, 0.0, -0.03))  # touches the base, which it may
    several.reset(seed=0, options={**PANDA_ENDS, "obstacles": [[CRATE], [CRATE.to_dict(), floor], []]})
    assert several.scenes.obstacles.present.sum(axis=1).tolist() == [1, 2, 0]
    for obstacles, words in (
        ([[CRATE], [CRATE, HOUSE], []], "scene 1: obstacle 1 'house' touches the arm at the start"),
        ([HOUSE], "scene 0: obstacle 0 'house'"),
    ):
        with pytest.raises(ValueError, match=words):
            several.reset(seed=0, options={**PANDA_ENDS, "obstacles": obstacles})


def test_obstacles_that_are_given_a_velocity_move_in_any_task():
    """Contact and clearance agree on it."""
    coming = post(0.1, 0.7, 0.03, velocity=(0.0, -0.35, 0.0))
    env, _ = given(PLANE, [coming])
    *_, info = env.step(np.array([0.0, 0.0, 1.0], np.float32))
    assert info["collision"]
    assert -0.01 < info["min_clearance"] < 0.0
    still, _ = given(PLANE, [post(0.1, 0.7, 0.03)])
    assert not still.step(np.array([0.0, 0.0, 1.0], np.float32))[4]["collision"]


def test_a_jump_and_a_turn_can_be_given_to_all_scenes_or_to_each():
    env = gym.make_vec(MOVING, num_envs=2, threads=1).unwrapped
    row, turn = [0.3, *OTHER], [0.4, 0.1, 0.0, 0.0]
    options = {**ENDS, "obstacles": [post(-0.3, 0.65)]}
    env.reset(seed=0, options={**options, "jumps": [row], "turns": [turn]})
    together = env.scenes
    env.reset(seed=0, options={**options, "jumps": [[row]] * 2, "turns": [[turn]] * 2})
    same_scenes(env.scenes, together)
    np.testing.assert_allclose(
        env.task.arm.hand(together.goals(np.full(2, 0.3)))[:, :2], [OTHER] * 2, atol=1e-9
    )
    one = {**options, "jumps": [row], "turns": [turn], "reaches": ()}
    two = {**one, "obstacles": [post(-0.3, 0.65), post(0.3, 0.6)], "jumps": [row, [0.6, 0.1, 0.4]]}
    two |= {"turns": (), "reaches": [[0.0] * 5, [0.1, 0.25, 0.05, 0.0, 0.0]]}
    env.reset(seed=0, options={name: [one[name], two[name]] for name in one})
    for i, options in enumerate((one, two)):  # lists of different lengths
        alone = gym.make_vec(MOVING, num_envs=1).unwrapped
        alone.reset(seed=i, options=options)
        same_scenes(env.scenes.take([i]), alone.scenes)


@pytest.mark.parametrize("env_id", ["viapoint/PlanarWholeArmStep-v0", MOVING])
def test_drawn_obstacles_leave_given_targets_free(env_id):
    env = gym.make_vec(env_id, num_envs=30, threads=1, n_jumps=(0, 3)).unwrapped
    first, _ = env.reset(seed=0)
    env.reset(seed=1000, options={"jumps": [[[0.3, *goal[:2]]] for goal in first["goal"]]})


def test_a_mesh_survives_json_and_one_without_a_name_changes_nothing():
    """Whatever the order of its vertices is, and the number of its names."""
    vertices = ve.ConvexMesh.hull(np.random.default_rng(0).normal(0.0, 0.04, (30, 3))).vertices
    ve.register_mesh("pebble", vertices)
    ve.register_mesh("gravel", vertices[::-1])
    env = gym.make(PANDA, shapes=("box", "gravel"), families="clutter").unwrapped
    mesh = {"obstacles": [{"shape": "gravel", "position": (0.5, -0.5, 0.5)}]}
    first, _ = env.reset(seed=1, options={**PANDA_ENDS, **mesh})
    text = ve.scene_to_json(env.batch.scenes, env.task.arm)
    same(env.reset(seed=1, options=ve.scene_from_json(text))[0], first)
    with pytest.raises(ValueError, match="register_mesh"):
        gym.make(PANDA, shapes=("box", "convex_mesh"))


def test_where_nothing_fits_the_random_generator_stays_as_it_was():
    usual, refused = (gym.make(PLANE).unwrapped for _ in range(2))
    usual.reset(seed=0)
    refused.reset(seed=0)
    start = np.array([0.2, 0.5, 0.0])
    ways = 0.56 * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    walls = [ve.Box((0.5, 0.5, 0.04), position=start + way) for way in ways]
    with pytest.raises(ValueError, match="leave room"):
        refused.reset(options={"start": start, "obstacles": walls})
    same(refused.reset()[0], usual.reset()[0])


def test_changes_are_drawn_and_applied_in_time():
    task = gym.make(PANDA_MOVING).unwrapped.task
    scenes = scenes_of(task, 12)
    velocity, turns = scenes.obstacles.velocity, scenes.turn_time
    present = scenes.obstacles.present
    assert (np.linalg.norm(velocity[present], axis=-1) > 0.0).mean() > 0.5
    time = 0.4
    later = scenes.obstacles_at(np.full(12, time)).centre
    before = np.minimum(time, turns)[..., None]
    after = np.maximum(time - turns, 0.0)[..., None]
    wanted = scenes.obstacles.centre + before * velocity + after * scenes.turn_velocity
    np.testing.assert_allclose(later, wanted, atol=1e-12)
    assert (turns[~present] == NEVER).all()


@pytest.mark.parametrize("env_id", [MOVING, PANDA_MOVING])
def test_reaches_of_obstacles_are_minimum_jerk_movements(env_id):
    """As observed within a chord, too; the physics is within 1 mm. Some began before the episode."""
    env = gym.make(env_id, **REACHING, decide_at=("horizon",), horizon=0.034).unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        scenes, seen, over = env.batch.scenes, [], False
        assert scenes.reach[..., 1].any()
        while not over:
            observation, _, over, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
            rows = env.task.observation.rows(observation["obstacles"])
            seen.append((info["time"], rows[:, -16:-13], rows[:, -4:-1]))
        times, places, velocities = map(np.array, zip(*seen, strict=True))
        time = env.last_rollout.time
        every = scenes.take(np.zeros(len(time), np.int64)).obstacles_at(time, in_chords=True)
        for row in np.flatnonzero(scenes.reach[0, :, 1]):
            begin, duration, *way = scenes.reach[0, row]
            reach = primitives.point_to_point(np.zeros(3), np.array(way), duration)
            first = scenes.obstacles.centre[0, row] - reach(np.clip(-begin, 0.0, duration))
            moved, since = (np.clip(each - begin, 0.0, duration) for each in (time, times))
            np.testing.assert_allclose(every.centre[:, row], first + reach(moved), atol=1e-3)
            np.testing.assert_allclose(places[:, row], first + reach(since), atol=1e-6)
            np.testing.assert_allclose(velocities[:, row], reach(since, 1), atol=1e-6)


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
    return room_of(ve.arm_of("planar" if plane else "panda"), kinds, (1, most), tall)


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


def test_families_that_do_not_fit_are_no_defaults():
    assert default_families(False, ("sphere",), 32) == ("clutter",)
    assert "shelf" not in default_families(False, ALL, 3)


def test_furniture_moves_with_its_frame():
    def build(x, y, yaw):
        furniture = ve.Furniture(ve.Room(ALL, 1, 9), x, y, yaw)
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
