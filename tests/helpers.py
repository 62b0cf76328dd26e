"""Tasks, scenes, episodes and shapes that tests of several packages begin with."""

import itertools
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np

from viapoint.envs import Box, ConvexMesh, Cylinder, arm_of, as_obstacle
from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.events import Event
from viapoint.envs.geometry.clearance import FAR, row_clearances
from viapoint.training.planning.problem import Problem

PLANE = "viapoint/PlanarObstacles-v0"
REACH = "viapoint/PlanarReach-v0"
STEP = "viapoint/PlanarObstaclesStep-v0"
WHOLE = "viapoint/PlanarWholeArm-v0"
MOVING = "viapoint/PlanarMovingObstacles-v0"
JUMPS = "viapoint/PlanarTargetJump-v0"
SENSED = "viapoint/PlanarSensed-v0"
PANDA = "viapoint/PandaObstacles-v0"
PANDA_MOVING = "viapoint/PandaMovingObstacles-v0"
UR5E = Path(__file__).parents[1] / "docs" / "ur5e.xml"
"""Model file of an arm that is not of the package."""
START, GOAL, OTHER = np.array([-0.3, 0.4]), np.array([0.1, 0.4]), np.array([0.0, 0.55])
ENDS = {"start": START, "goal": GOAL}
WALL = Box((0.008, 0.1, 0.04), position=(-0.1, 0.4, 0.0))
"""Wall across the middle of the straight line from START to GOAL."""

HOME = arm_of("panda").home
PANDA_ENDS = {"start": HOME, "goal": HOME + np.array([0.9, 0.3, 0.0, 0.2, 0.0, 0.0, 0.0])}
CRATE = Box((0.03, 0.04, 0.05), position=(0.2, 0.7, 0.4), quaternion=(0.96, 0.0, 0.28, 0.0))
"""Box within reach of the Panda."""


def post(x, y, radius=0.02, **others):
    return Cylinder(radius, 0.04, position=(x, y, 0.0), **others)


def given(env_id=PLANE, obstacles=(), seed=0, *, jumps=(), turns=None, **kwargs):
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


def scenes_of(task, number, seed=0):
    """Draw scenes, each with a generator of its own."""
    return task.sampler()([np.random.default_rng((seed, each)) for each in range(number)])


def problem_of(task, number, seed=0):
    return Problem.of_scenes(scenes_of(task, number, seed), task)


def random_shape(kind, rng, *, moving=False):
    quaternion = rng.normal(size=4)
    a, b, c = rng.uniform(0.02, 0.2, 3)
    some, many = (0.1 * rng.normal(size=(number, 3)) for number in rng.integers((4, 1), (30, 60)))
    sizes = {
        "sphere": {"radius": a},
        "capsule": {"radius": a, "half_length": b},
        "cylinder": {"radius": a, "half_length": b},
        "box": {"size": (a, b, c)},
        "half_space": {},
        "convex_mesh": {"vertices": ConvexMesh.hull(some).vertices},
        "point_cloud": {"points": many, "radius": 0.3 * a},
    }
    return as_obstacle(
        {
            "shape": kind,
            "position": rng.uniform(-0.2, 0.2, 3),
            "quaternion": quaternion / np.linalg.norm(quaternion),
            "velocity": rng.uniform(-0.5, 0.5, 3) * moving,
            **sizes[kind],
        }
    )


def configuration_clearances(arm, joints, obstacles, times=0.0):
    """Return the clearance of N arms in N scenes at N times from obstacles and from themselves, shape (N, 2), [m]."""
    centre = obstacles.centre + np.reshape(times, (-1, 1, 1)) * obstacles.velocity
    apart, own = row_clearances(arm.chain, arm.spheres, joints, obstacles._replace(centre=centre), FAR)
    return np.stack((apart.min(axis=1, initial=FAR), own), axis=-1)


def least_pair_distance(arm, joints):
    """Least signed distance of spheres of each compared pair of groups, shape (..., P), [m]."""
    spheres, centres = arm.spheres, sphere_centres(arm.chain, arm.spheres, joints)
    some = [slice(*ends) for ends in itertools.pairwise(spheres.first)]
    found = []
    for a, b in spheres.pairs:
        apart = np.linalg.norm(centres[..., some[a], None, :] - centres[..., None, some[b], :], axis=-1)
        found.append((apart - spheres.radius[some[a], None] - spheres.radius[some[b]]).min(axis=(-2, -1)))
    return np.stack(found, axis=-1) if found else np.empty((*joints.shape[:-1], 0))


def check_contact_implies_overlap(arm, number=3000):
    """Compare with the contacts that MuJoCo finds in the arm's own model, in both directions of the promise."""
    model = arm.compile(0)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    joints = rng.uniform(*arm.joint_range.T, (number, len(arm.joint_names)))
    distance = least_pair_distance(arm, joints)
    pairs = {
        frozenset((arm.group_names[a], arm.group_names[b])): i for i, (a, b) in enumerate(arm.spheres.pairs)
    }
    contacts = 0
    for row, configuration in enumerate(joints):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for geom in data.contact.geom:
            names = frozenset(model.body(model.geom_bodyid[each]).name for each in geom)
            assert distance[row, pairs[names]] < 0.0  # no other pairs are in contact
            contacts += 1
    assert contacts > 0
