"""Episodes of tests: a few scenes in the plane, and how to play them."""

import gymnasium as gym
import numpy as np

import viapoint.envs as package
from viapoint.envs import Box, Cylinder, arm_of
from viapoint.envs.events import Event

OBSTACLES, STEP, JUMP, MOVING = (
    f"viapoint/{name}-v0"
    for name in ("PlanarObstacles", "PlanarObstaclesStep", "PlanarTargetJump", "PlanarMovingObstacles")
)
PANDA, PANDA_MOVING = "viapoint/PandaObstacles-v0", "viapoint/PandaMovingObstacles-v0"
IDS = package.ENV_IDS
START, GOAL, OTHER = np.array([-0.3, 0.4]), np.array([0.1, 0.4]), np.array([0.0, 0.55])
ENDS = {"start": START, "goal": GOAL}
WALL = Box((0.008, 0.1, 0.04), position=(-0.1, 0.4, 0.0))
"""Wall across the middle of the straight line from START to GOAL."""

HOME = arm_of("panda").home
PANDA_ENDS = {"start": HOME, "goal": HOME + np.array([0.9, 0.3, 0.0, 0.2, 0.0, 0.0, 0.0])}
CRATE = Box((0.03, 0.04, 0.05), position=(0.2, 0.7, 0.4), quaternion=(0.96, 0.0, 0.28, 0.0))
"""Box within reach of the Panda."""


def post(x, y, radius=0.02, **others):
    """Return a post in the plane."""
    return Cylinder(radius, 0.04, position=(x, y, 0.0), **others)


def given(env_id=OBSTACLES, obstacles=(), seed=0, *, jumps=(), turns=None, **kwargs):
    """Return an environment in a given scene of the plane, and its first observation."""
    env = gym.make(env_id, **kwargs).unwrapped
    options = {**ENDS, "obstacles": list(obstacles)}
    if env.task.replanning:
        options["jumps"] = np.array(jumps).reshape(-1, 3)
    if turns is not None:
        options["turns"] = np.array(turns)
    return env, env.reset(seed=seed, options=options)[0]


def play(env, scale=0.0, seed=0):
    """Play zero or random actions until the episode ends, and return the infos with rewards."""
    generator = np.random.default_rng(seed)
    infos = []
    over = False
    while not over:
        action = scale * generator.uniform(-1.0, 1.0, env.action_space.shape)
        _, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        infos.append({**info, "reward": reward})
        over = terminated or truncated
    return infos


def events(infos):
    """Return the events of the decisions."""
    return [Event(info["event"]) for info in infos]


def same(first, second):
    """Check that two observations or infos are equal, bit by bit."""
    assert set(first) == set(second)
    for name, part in first.items():
        np.testing.assert_array_equal(part, second[name], err_msg=name)


def same_scenes(first, second):
    """Check that scenes are equal, bit by bit."""
    *_, meshes, clouds = first.obstacles
    assert not len(meshes.normals) or np.array_equal(meshes.normals, second.obstacles.meshes.normals)
    assert not len(clouds.points) or np.array_equal(clouds.points, second.obstacles.clouds.points)
    for one, other in zip(
        (*first._replace(obstacles=()), *first.obstacles[:5]),
        (*second._replace(obstacles=()), *second.obstacles[:5]),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


DRAWN = {
    "start": [-0.1, 0.25],
    "goal": [-0.1, 0.55],
    "obstacles": [post(-0.4, 0.6), Box((0.05, 0.01, 0.04), position=(-0.16, 0.4, 0.0))],
}
"""Scene of the tests of pictures."""
STRAIGHT, AROUND = np.zeros(3, np.float32), np.array([0.0, -0.5, 0.5], np.float32)


def moved(env, action):
    """Return the info of a movement in the scene of the tests of pictures."""
    env.reset(options=DRAWN)
    return env.step(action)[-1]
