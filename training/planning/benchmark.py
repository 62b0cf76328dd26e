"""The problems of MotionBenchMaker for the Franka Panda, and the robot that they are stated for.

Problems: C. Chamzas et al., MotionBenchMaker: A tool to generate and benchmark motion planning datasets, IEEE Robotics
and Automation Letters 7 (2022) 882-889. Spheres of the robot: W. Thomason, Z. Kingston and L. E. Kavraki, Motions in
microseconds via vectorized sampling-based planning, ICRA 2024. Both are numeric data; see `data/README.md`.
"""

from __future__ import annotations

import csv
import functools
import re
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import yaml

from viapoint.envs.arms.arm import Arm, arm_from_xml, asset
from viapoint.envs.arms.registry import PANDA_HOME
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.shapes import Box, Cylinder, Shape, as_obstacle

# Names of the sets
SETS = (
    "bookshelf_small",
    "bookshelf_tall",
    "bookshelf_thin",
    "box",
    "cage",
    "table_pick",
    "table_under_pick",
)
KINDS: dict[type[Shape], int] = {Box: 0, Cylinder: 1}  # Numbers of shapes in the numeric file
JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))  # Names of the joints in the files
LOWEST = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)
# Ranges of the joints in the published description, [rad]
HIGHEST = (2.9671, 1.8326, 2.9671, 0.0873, 2.9671, 3.8223, 2.9671)
# Bodies of the fingers, and the directions in which they open along y
FINGERS = {"leftfinger": 1.0, "rightfinger": -1.0}
# Opening of a finger, and height of the fingers' frames over that of the hand, [m]
OPEN, FINGER_HEIGHT = 0.065, 0.0584
# Pairs of bodies, besides neighbours, that the published description does not compare (panda.srdf)
NEVER_TOUCH = {
    "link0": ("link2", "link3", "link4"),
    "link1": ("link3", "link4"),
    "link2": ("link4", "link6"),
    "link3": ("link5", "link6", "link7", "gripper", "leftfinger", "rightfinger"),
    "link4": ("link6", "link7", "gripper", "leftfinger", "rightfinger"),
    "link6": ("gripper", "leftfinger", "rightfinger"),
    "link7": ("leftfinger", "rightfinger"),
}


class BenchmarkProblem(NamedTuple):
    """One problem."""

    set: str  # Name of its set
    number: int  # Number within the set, from 1
    start: Float  # Joint positions, shape (7,), [rad]
    goal: Float  # Joint positions, shape (7,), [rad]
    obstacles: tuple[Shape, ...]  # Obstacles

    @property
    def name(self) -> str:
        """Set and number."""
        return f"{self.set} {self.number}"


@functools.cache
def benchmark_panda() -> Arm:
    """Return the Panda of the benchmark: 59 spheres, the fingers open by 6.5 cm each, dynamics of the built-in one."""
    spec = mujoco.MjSpec.from_string(asset("panda.xml"))
    for body in spec.bodies:
        for geom in list(body.geoms):
            if geom.name != "table":
                spec.delete(geom)
    for joint, low, high in zip(spec.joints, LOWEST, HIGHEST, strict=True):
        joint.range = low, high
    gripper = spec.body("gripper")
    for name, side in FINGERS.items():
        gripper.add_body(name=name, pos=(0.0, side * OPEN, FINGER_HEIGHT))
    with (files("viapoint.training.planning") / "data" / "panda_spheres.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            place = [float(row[axis]) for axis in "xyz"]
            size = (float(row["radius"]), 0.0, 0.0)
            spec.body(row["body"]).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=place, size=size)
    return arm_from_xml(
        "panda_spheres",
        spec.to_xml(),
        joints=tuple(f"joint{number}" for number in range(1, 8)),
        tool="hand",
        home=PANDA_HOME,
        velocity_limit=(2.175,) * 4 + (2.61,) * 3,
        torque_limit=(87.0,) * 4 + (12.0,) * 3,
        exclude={
            frozenset((first, second)): "never in contact"
            for first, others in NEVER_TOUCH.items()
            for second in others
        },
    )


def benchmark_problems() -> list[BenchmarkProblem]:
    """Return the 700 problems, of which one, `table_pick 41`, has a goal in contact."""
    with (files("viapoint.training.planning") / "data" / "motionbenchmaker.npz").open("rb") as file:
        parts = dict(np.load(file))
    problems, first = [], 0
    for k, count in enumerate(parts["count"]):
        shapes: list[Shape] = []
        for row in range(first, first + count):
            size, position, quaternion = parts["size"][row], parts["pose"][row, :3], parts["pose"][row, 3:]
            quaternion = quaternion / np.linalg.norm(quaternion)
            if parts["kind"][row] == KINDS[Box]:
                shapes.append(Box(size, position=position, quaternion=quaternion))
            else:
                shapes.append(Cylinder(size[0], size[1], position=position, quaternion=quaternion))
        first += count
        name, number = SETS[parts["set"][k]], int(parts["number"][k])
        problems.append(BenchmarkProblem(name, number, parts["start"][k], parts["goal"][k], tuple(shapes)))
    return problems


def read_problems(folder: str | Path) -> list[BenchmarkProblem]:
    """Return the problems of a folder of MotionBenchMaker's files, in the order of their sets and numbers.

    The files are `sceneNNNN.yaml` and `requestNNNN.yaml`, in folders named after their sets.

    Raises:
        ValueError: There is no problem, or a file cannot be read; the message names it.
    """
    scenes = sorted(Path(folder).expanduser().rglob("scene*.yaml"))
    if not scenes:
        raise ValueError(f"{folder} holds no scene*.yaml of MotionBenchMaker")
    return [_read(scene) for scene in scenes]


def _read(scene: Path) -> BenchmarkProblem:
    """Return the problem of a scene file and its request file."""
    request = scene.with_name(scene.name.replace("scene", "request"))
    try:
        world = yaml.load(scene.read_text(encoding="utf-8"), yaml.CSafeLoader)["world"]
        asked = yaml.load(request.read_text(encoding="utf-8"), yaml.CSafeLoader)
        state = asked["start_state"]["joint_state"]
        start = dict(zip(state["name"], state["position"], strict=True))
        wanted = asked["goal_constraints"][0]["joint_constraints"]
        goal = {each["joint_name"]: each["position"] for each in wanted}
        begin = np.array([start[joint] for joint in JOINTS], dtype=np.float64)
        end = np.array([goal[joint] for joint in JOINTS], dtype=np.float64)
        obstacles = tuple(_shapes_of(world["collision_objects"]))
    except (KeyError, TypeError, IndexError, OSError, yaml.YAMLError) as error:
        raise ValueError(f"{scene}: no problem of MotionBenchMaker for the Panda ({error!r:.80})") from None
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from None
    number = re.search(r"\d+", scene.stem)
    assert number is not None
    return BenchmarkProblem(scene.parent.name.removesuffix("_panda"), int(number[0]), begin, end, obstacles)


def _shapes_of(objects: list[Mapping[str, Any]]) -> Iterator[Shape]:
    """Yield the shapes of collision objects."""
    for each in objects:
        outer = _matrix(each.get("pose"))
        for primitive, pose in zip(each["primitives"], each["primitive_poses"], strict=True):
            place = outer @ _matrix(pose)
            quaternion = np.empty(4)
            mujoco.mju_mat2Quat(quaternion, place[:3, :3].flatten())
            kind, sizes = primitive["type"], np.array(primitive["dimensions"], dtype=np.float64)
            if kind == "box":
                values: dict[str, Any] = {"size": 0.5 * sizes}
            elif kind == "cylinder":
                values = {"radius": sizes[1], "half_length": 0.5 * sizes[0]}
            elif kind == "sphere":
                values = {"radius": sizes[0]}
            else:
                raise ValueError(f"primitives must be box, cylinder or sphere, got {kind!r}")
            yield as_obstacle({"shape": kind, **values, "position": place[:3, 3], "quaternion": quaternion})


def _matrix(pose: Mapping[str, Any] | None) -> Float:
    """Return the matrix of a pose, shape (4, 4); the identity for none."""
    matrix = np.eye(4)
    if pose:
        x, y, z, w = pose["orientation"]
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, np.array((w, x, y, z)) / np.linalg.norm((w, x, y, z)))
        matrix[:3, :3], matrix[:3, 3] = turn.reshape(3, 3), pose["position"]
    return matrix


def write_problems(folder: str | Path, path: str | Path) -> None:
    """Write the numeric file of the package from a folder of the original files."""
    problems = read_problems(folder)
    shapes = [shape for problem in problems for shape in problem.obstacles]
    np.savez_compressed(
        path,
        set=np.array([SETS.index(problem.set) for problem in problems], np.int8),
        number=np.array([problem.number for problem in problems], np.int16),
        start=np.array([problem.start for problem in problems]),
        goal=np.array([problem.goal for problem in problems]),
        count=np.array([len(problem.obstacles) for problem in problems], np.int16),
        kind=np.array([KINDS[type(shape)] for shape in shapes], np.int8),
        pose=np.array([[*shape.position, *shape.quaternion] for shape in shapes], np.float32),
        size=np.array([shape.packed_size for shape in shapes], np.float32),
    )
