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

from viapoint.envs import Box, Cylinder, Shape
from viapoint.envs.arms import PANDA, PANDA_FINE
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.rows import quaternion_of_axes
from viapoint.training.live.scene_draws import PROBLEMS, benchmark_scene

OF_EACH_SET = 4
"""Problems of each set."""
MOST_MOVED = 0.2
"""Greatest distance of start and goal from the benchmark's, [m]."""
DIGITS = 5
"""Decimal places, [m] and [rad]."""
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
    models = [CollisionModel(arm, True) for arm in (PANDA, PANDA_FINE)]
    sets: dict[str, list[dict[str, Any]]] = {}
    for name in sorted(texts):
        match = re.search(r"(\w+)_panda/scene(\d+)\.yaml$", name)
        if match is None:
            continue
        shown = sets.setdefault(match[1], [])
        record = problem(texts[name], texts[name.replace("scene", "request")])
        moved = [each for model in models for each in benchmark_scene(record, model)[1].values()]
        if max(moved) <= MOST_MOVED:
            shown.append({"set": match[1], "number": int(match[2]), **record})
    for name, shown in sets.items():
        print(f"{name}: {len(shown)} of 100 can be shown")
    record = {
        "source": SOURCE,
        "licence": Path(licence).read_text(encoding="utf-8"),
        "units": "m and rad; quaternions are w, x, y, z; sizes are half lengths",
        "problems": [each for shown in sets.values() for each in shown[:OF_EACH_SET]],
    }
    lines = json.dumps(record, indent=1).replace("\n   ", " ")
    PROBLEMS.write_text(lines + "\n", encoding="utf-8")


def problem(scene: bytes, request: bytes) -> dict[str, Any]:
    """Return obstacles, start and goal of the files of one problem."""
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
    ends = {"start": start, "goal": goal}
    return {
        **{name: rounded([joints[each] for each in JOINTS]) for name, joints in ends.items()},
        "obstacles": [{k: rounded(v) for k, v in each.to_dict().items()} for each in obstacles],
    }


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
    x, y, z, w = orientation
    return Box((1.0, 1.0, 1.0), quaternion=(w, x, y, z)).rotation


def rounded(value: Any) -> Any:
    """Return numbers as rounded ones, and anything else as it is."""
    return value if isinstance(value, str) else (np.round(value, DIGITS) + 0.0).tolist()


if __name__ == "__main__":
    main()
