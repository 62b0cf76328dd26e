"""Problems of MotionBenchMaker for the live page: `python benchmarks/motion_bench_maker.py ARCHIVE LICENCE`.

ARCHIVE is the .tar.bz2 file of the Panda's problems as distributed with VAMP: folders SET_panda with a file
`sceneNNNN.yaml` of MoveIt for the obstacles of each problem, and a file `requestNNNN.yaml` for its start and goal.
LICENCE is MotionBenchMaker's licence file. The script writes the file of the live page with the first problems of each
set that the page can show. The Panda of the environments stands on a table and its hand always points down, so that
start and goal are moved to where it can rest. A problem is shown if each of them moves by at most MOST_MOVED.
"""

from __future__ import annotations

import json
import re
import sys
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from viapoint.envs import Box, Cylinder, Shape
from viapoint.envs.arms import PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.geometry.rows import obstacle_rows, quaternion_of_axes
from viapoint.envs.scenes.scene import Scenes, rest_clearance
from viapoint.training.live.scene_draws import PROBLEMS
from viapoint.training.live.scene_file import SCENE_SHAPES

OF_EACH_SET = 4
"""Problems of each set."""
MOST_MOVED = 0.2
"""Greatest distance of start and goal from the benchmark's, [m]."""
DIGITS = 5
"""Decimal places, [m] and [rad]."""
GRID = 0.02
"""Distance of the hand positions among which the nearest possible one is looked for, [m]."""
MARGIN = 0.01
"""Least clearance of the arm, and least distance from the border of its reach, at start and goal, [m]."""
BLOCK = 256
"""Hand positions whose clearance is computed together."""
MODEL = CollisionModel(PANDA, True)
"""Arm that can rest at start and goal."""
JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
SOURCE = (
    "MotionBenchMaker (C. Chamzas et al., MotionBenchMaker: a tool to generate and benchmark motion planning datasets, "
    "IEEE Robotics and Automation Letters 7, 2022), as distributed with VAMP (W. Thomason, Z. Kingston and L. Kavraki, "
    "Motions in microseconds via vectorized sampling-based planning, ICRA 2024)"
)


def main() -> None:
    """Write the file, and print how many problems of each set can be shown."""
    archive, licence = sys.argv[1:]
    with tarfile.open(archive) as files:
        texts = {each.name: files.extractfile(each).read() for each in files if each.isfile()}  # type: ignore[union-attr]
    sets: dict[str, list[dict[str, Any]]] = {}
    for name in sorted(texts):
        match = re.search(r"(\w+)_panda/scene(\d+)\.yaml$", name)
        if match is None:
            continue
        shown = sets.setdefault(match[1], [])
        record = problem(texts[name], texts[name.replace("scene", "request")])
        if record is not None:
            shown.append({"set": match[1], "number": int(match[2]), **record})
    for name, shown in sets.items():
        print(f"{name}: {len(shown)} of 100 can be shown")
    record = {
        "source": SOURCE,
        "licence": Path(licence).read_text(encoding="utf-8"),
        "units": "m and rad; quaternions are w, x, y, z; sizes are half lengths",
        "can be shown, of 100": {name: len(shown) for name, shown in sets.items()},
        "problems": [each for shown in sets.values() for each in shown[:OF_EACH_SET]],
    }
    lines = json.dumps(record, indent=1).replace("\n   ", " ")
    PROBLEMS.write_text(lines + "\n", encoding="utf-8")


def problem(scene: bytes, request: bytes) -> dict[str, Any] | None:
    """Return obstacles, start and goal of the files of one problem; None if an end must be moved too far."""
    world, asked = yaml.safe_load(scene)["world"], yaml.safe_load(request)
    obstacles = [
        obstacle(primitive, pose, each.get("pose"))
        for each in world["collision_objects"]
        for primitive, pose in zip(each["primitives"], each["primitive_poses"], strict=True)
    ]
    state = asked["start_state"]["joint_state"]
    start = dict(zip(state["name"], state["position"], strict=True))
    wanted = asked["goal_constraints"][0]["joint_constraints"]
    goal = {each["joint_name"]: each["position"] for each in wanted}
    joints = np.array([[end[each] for each in JOINTS] for end in (start, goal)])
    hands = np.asarray(PANDA.hand_position(joints))
    rows = obstacle_rows(obstacles, 3, SCENE_SHAPES)
    first = nearest_free(hands[0], rows)
    ends = None if first is None else (first, nearest_free(hands[1], rows, away_from=first))
    if ends is None or ends[1] is None:
        return None
    return {
        "start": rounded(ends[0]),
        "goal": rounded(ends[1]),
        "start_joints": rounded(joints[0]),
        "goal_joints": rounded(joints[1]),
        "obstacles": [{k: rounded(v) for k, v in each.to_dict().items()} for each in obstacles],
    }


def nearest_free(point: Float, rows: Float, away_from: Float | None = None) -> Float | None:
    """Return the nearest position to a point at which the arm rests clear of obstacles, shape (3,), [m].

    Args:
        point: Position of the hand, shape (3,), [m].
        rows: Rows of obstacles, shape (n, .), [m].
        away_from: Position from which a movement to the result must be long enough, shape (3,), [m].

    Returns:
        The position; None if there is none on a grid within MOST_MOVED and the arm's reach.
    """
    steps = np.arange(-MOST_MOVED, MOST_MOVED, GRID)
    grid = np.round(point / GRID) * GRID + np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    candidates = np.concatenate((point[None], grid))
    reach = np.asarray(PANDA.reach_margin(candidates))
    near = (reach > MARGIN) & (norm(candidates - point) <= MOST_MOVED)
    if away_from is not None:
        near &= norm(candidates - away_from) > MIN_GOAL_DISTANCE
    candidates = candidates[near]
    candidates = candidates[np.argsort(norm(candidates - point), kind="stable")]
    for first in range(0, len(candidates), BLOCK):
        some = candidates[first : first + BLOCK]
        scenes = Scenes(some, some, np.broadcast_to(rows, (len(some), *rows.shape)))
        clear = rest_clearance(scenes, some, MODEL).min(axis=-1)
        if (clear > MARGIN).any():
            return np.asarray(some[(clear > MARGIN).argmax()])
    return None


def obstacle(primitive: Mapping[str, Any], pose: Mapping[str, Any], frame: Mapping[str, Any] | None) -> Shape:
    """Return a box or a cylinder from a primitive with a pose in a frame."""
    turn, position = matrix(pose["orientation"]), np.array(pose["position"])
    if frame is not None:
        position = np.array(frame["position"]) + matrix(frame["orientation"]) @ position
        turn = matrix(frame["orientation"]) @ turn
    sizes, place = (
        primitive["dimensions"],
        {"position": position, "quaternion": quaternion_of_axes(*turn.T[:2])},
    )
    if primitive["type"] == "box":
        return Box(0.5 * np.array(sizes), **place)
    if primitive["type"] == "cylinder":
        return Cylinder(sizes[1], 0.5 * sizes[0], **place)
    raise ValueError(f"obstacles are boxes and cylinders, got {primitive['type']!r}")


def matrix(orientation: Any) -> Any:
    """Return the rotation matrix of a quaternion x, y, z, w."""
    return Rotation.from_quat(orientation).as_matrix()


def rounded(value: Any) -> Any:
    """Return numbers as rounded ones, and anything else as it is."""
    return value if isinstance(value, str) else (np.round(value, DIGITS) + 0.0).tolist()


if __name__ == "__main__":
    main()
