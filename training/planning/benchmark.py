"""The problems of MotionBenchMaker for the Franka Panda, and the measurement of planners on them.

Problems: C. Chamzas et al., MotionBenchMaker: A tool to generate and benchmark motion planning datasets, IEEE Robotics
and Automation Letters 7 (2022) 882-889. Spheres of the robot: W. Thomason, Z. Kingston and L. E. Kavraki, Motions in
microseconds via vectorized sampling-based planning, ICRA 2024. Both are numeric data; see `data/README.md`.
"""

from __future__ import annotations

import functools
import itertools
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.load import load_arm
from viapoint.envs.common.arrays import Float, frame_matrices
from viapoint.envs.common.validation import finite_array, whole_number
from viapoint.envs.geometry.obstacles import pack, quaternions_of
from viapoint.envs.geometry.shapes import Box, Cylinder, Shape, Sphere
from viapoint.envs.scenes.scene import resting
from viapoint.envs.task import MOST_OBSTACLES, Task
from viapoint.training.checks import unknown_name
from viapoint.training.planning.candidates import MOST_CANDIDATES
from viapoint.training.planning.motion_plan import MotionPlan, execute_plans
from viapoint.training.planning.ompl_paths import import_ompl
from viapoint.training.planning.plan_motion import ompl_motion, plan_motion
from viapoint.training.planning.search import GeometrySearch

DATA = files("viapoint.training.planning") / "data"
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
TOGETHER = 20  # Number of plans that are simulated together
PATH_INSTANTS = 200  # Instants between which the length of a movement is measured
NOTES = (
    "Solved: touches nothing and keeps all limits, by computed geometry; physics: success in MuJoCo, too; both without "
    "problems whose ends are in contact. Times include all checks. Motion time, jerk (relative to the straight "
    "movement), length and clearance are medians of the solved problems."
)


class BenchmarkProblem(NamedTuple):
    """One problem."""

    set: str  # Name of its set
    number: int  # Number within the set, from 1
    start: Float  # Joint positions, shape (J,), [rad] or [m]
    goal: Float  # Joint positions, shape (J,), [rad] or [m]
    obstacles: tuple[Shape, ...]

    @property
    def name(self) -> str:
        """Set and number."""
        return f"{self.set} {self.number}"


@functools.cache
def benchmark_panda() -> Arm:
    """Return the Panda of the benchmark: 59 spheres, the fingers open by 6.5 cm each, dynamics of the built-in one."""
    with as_file(DATA / "panda_spheres.xml") as path:
        return load_arm(path)


def benchmark_problems() -> list[BenchmarkProblem]:
    """Return the 700 problems, of which one, `table_pick 41`, has a goal in contact."""
    with (DATA / "motionbenchmaker.npz").open("rb") as file:
        parts = dict(np.load(file))
    shapes = list[Shape]()
    for kind, pose, size in zip(parts["kind"], parts["pose"], parts["size"], strict=True):
        place = {"position": pose[:3], "quaternion": pose[3:] / np.linalg.norm(pose[3:])}
        shapes.append(Box(size, **place) if kind == KINDS[Box] else Cylinder(size[0], size[1], **place))
    problems, first = [], 0
    rows = (parts[name] for name in ("set", "number", "start", "goal", "count"))
    for group, number, start, goal, count in zip(*rows, strict=True):
        obstacles = tuple(shapes[first : first + count])
        first += count
        problems.append(BenchmarkProblem(SETS[group], int(number), start, goal, obstacles))
    return problems


def read_problems(
    folder: str | Path, joints: Sequence[str] = JOINTS
) -> tuple[list[BenchmarkProblem], list[str]]:
    """Return the problems of a folder of MotionBenchMaker's files, in the order of their sets and numbers.

    The files are `sceneNNNN.yaml` and `requestNNNN.yaml`, in folders named after their sets; `joints` are the names of
    the arm's joints in them, those of the Panda by default. Obstacles are placed relative to the base of the robot,
    which a joint such as `virtual_joint` moves. Values of other joints, frames of objects, and goals after the first
    are not looked at. The second result has a line for each problem that cannot be read; if none can, ValueError.
    Meshes, planes and objects that are attached to the arm cannot be read.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ValueError(f"problems must be a folder of MotionBenchMaker's files, got {folder}")
    scenes = sorted(folder.rglob("scene*.yaml"))
    problems, faults = [], []
    for scene in scenes:
        if re.fullmatch(r"scene\d+", scene.stem):
            try:
                problems.append(_read(scene, joints))
            except ValueError as error:
                faults.append(str(error))
    if not problems:
        raise ValueError(faults[0] if faults else f"{folder} holds no sceneNNNN.yaml of MotionBenchMaker")
    return problems, faults


def _read(scene: Path, joints: Sequence[str]) -> BenchmarkProblem:
    """Return the problem of a scene file and its request file."""
    request = scene.with_name(scene.name.replace("scene", "request"))
    if not request.is_file():
        raise ValueError(f"{request}: there is no such file beside {scene.name}")
    both = f"{scene} and {request.name}"
    try:
        read = yaml.load(scene.read_text(encoding="utf-8"), yaml.CSafeLoader)
        asked = yaml.load(request.read_text(encoding="utf-8"), yaml.CSafeLoader)
        state = asked["start_state"]["joint_state"]
        start = dict(zip(state["name"], state["position"], strict=True))
        wanted = asked["goal_constraints"][0]["joint_constraints"]
        goal = {each["joint_name"]: each["position"] for each in wanted}
        begin = _positions("start", start, joints)
        end = _positions("goal", goal, joints)
        for held in (read.get("robot_state"), asked["start_state"]):
            if held and held.get("attached_collision_objects"):
                raise ValueError("an object is attached to the arm; plan for an arm whose model holds it")
        base: Any = np.eye(4)  # Place of the robot's base
        for each in (asked["start_state"].get("multi_dof_joint_state") or {}).get("transforms") or ():
            base = base @ _matrix({"position": each["translation"], "orientation": each["rotation"]})
        base = np.linalg.inv(base)
        obstacles = tuple(_shapes_of(read["world"]["collision_objects"], base))
        if len(obstacles) > MOST_OBSTACLES:
            raise ValueError(
                f"plans are executed among at most {MOST_OBSTACLES} obstacles, got {len(obstacles)}"
            )
    except yaml.YAMLError as error:
        raise ValueError(f"{both}: no YAML: {' '.join(str(error).split())}") from None
    except (KeyError, TypeError, IndexError, AttributeError, OSError) as error:
        raise ValueError(
            f"{both}: no problem of MotionBenchMaker, which has start_state/joint_state and goal_constraints/0/"
            f"joint_constraints in requests, world/collision_objects in scenes ({error!r:.80})"
        ) from None
    except ValueError as error:
        raise ValueError(f"{both}: {error}") from None
    number = int(scene.stem.removeprefix("scene"))
    return BenchmarkProblem(scene.parent.name.removesuffix("_panda"), number, begin, end, obstacles)


def _positions(name: str, there: Mapping[str, Any], joints: Sequence[str]) -> Float:
    """Return the positions of joints, shape (J,), by their names."""
    for joint in joints:
        if joint not in there:
            raise ValueError(
                f"joint {joint!r} of the arm is not among those of the {name}: {', '.join(there)}"
            )
    # PyYAML takes numbers such as 1e-05 for texts.
    return finite_array(name, np.array([there[joint] for joint in joints], np.float64), (len(joints),))


def _shapes_of(objects: list[Mapping[str, Any]], base: Float) -> Iterator[Shape]:
    """Yield the shapes of collision objects; the matrix `base` maps the world into the frame of the arm."""
    for each in objects:
        unread = [name for name in ("mesh", "meshes", "planes") if each.get(name)]
        if unread:
            raise ValueError(
                f"object {each.get('id')!r} has {unread[0]}; boxes, cylinders and spheres are read"
            )
        outer = base @ _matrix(each.get("pose"))
        for primitive, pose in zip(each["primitives"], each["primitive_poses"], strict=True):
            place = outer @ _matrix(pose)
            turn = quaternions_of(place[:3, :3])
            kind = primitive["type"]
            sizes = np.array(primitive["dimensions"], dtype=np.float64)
            if kind == "box":
                yield Box(0.5 * sizes, position=place[:3, 3], quaternion=turn)
            elif kind == "cylinder":
                yield Cylinder(sizes[1], 0.5 * sizes[0], position=place[:3, 3], quaternion=turn)
            elif kind == "sphere":
                yield Sphere(sizes[0], position=place[:3, 3])
            else:
                raise ValueError(f"primitives must be box, cylinder or sphere, got {kind!r}")


def _matrix(pose: Mapping[str, Any] | None) -> Float:
    """Return the matrix of a pose, shape (4, 4); the identity for none."""
    matrix = np.eye(4)
    if pose:
        x, y, z, w = pose["orientation"]
        quaternion = np.array((w, x, y, z), np.float64)
        matrix[:3, :3] = frame_matrices(quaternion / np.linalg.norm(quaternion))
        matrix[:3, 3] = pose["position"]
    return matrix


Planner = Callable[[Arm, BenchmarkProblem], MotionPlan]
# Function of the planner's name, the number of finished problems and the number of all
Progress = Callable[[str, int, int], None]


def benchmark_planner(name: str) -> Planner:
    """Return a planner by its name: straight, plan_motion, paths, plan_motion+ompl, ompl, or searchN.

    `paths` is plan_motion without random seeds.

    Raises:
        ValueError: There is no such planner, or its library is not installed.
    """
    settings: dict[str, dict[str, Any]] = {
        "straight": {"time_limit": 0.0},
        "plan_motion": {"ompl": False},
        "paths": {"ompl": False, "seeds": 0},
        "plan_motion+ompl": {"time_limit": 10.0},
    }
    if "ompl" in name:
        import_ompl()
    if name == "ompl":
        return lambda arm, each: ompl_motion(arm, each.start, each.goal, pack([each.obstacles]))
    if name in settings:
        return lambda arm, each: plan_motion(arm, each.start, each.goal, each.obstacles, **settings[name])
    checks = re.fullmatch(r"search([1-9]\d*)", name)
    if checks is None:
        raise ValueError(unknown_name("planner", name, [*settings, "ompl", "searchN"]))
    number = whole_number("N of searchN", int(checks[1]), 1, MOST_CANDIDATES)
    each = number // 8  # Number of plans of each of four rounds around the best of the others

    def searched(arm: Arm, problem: BenchmarkProblem) -> MotionPlan:
        task = Task.of(arm=arm, n_obstacles=(0, 32))
        rounds = 4 if each else 0
        search = GeometrySearch(task, number - rounds * each, refinements=rounds, per_round=max(each, 1))
        scene = resting(problem.start[None], problem.goal[None], pack([problem.obstacles]))
        return search.plan_scene(scene, shortest=True)

    return searched


def measure_planner(
    name: str, problems: Sequence[BenchmarkProblem], arm: Arm, *, progress: Progress | None = None
) -> pd.DataFrame:
    """Return one line for each problem: what a planner found, how long it took, and what MuJoCo says of it."""
    planner = benchmark_planner(name)
    planner(arm, problems[0])  # compiles what is not compiled yet
    plans, lines = [], []
    for number, problem in enumerate(problems):
        begin = time.perf_counter()
        plan = planner(arm, problem)
        milliseconds = 1e3 * (time.perf_counter() - begin)
        plans.append(plan)
        refused = plan.reason.startswith(("the start", "the goal", "the arm"))
        path = plan.trajectory()(np.linspace(0.0, plan.duration, PATH_INSTANTS))
        lines.append(
            {
                "planner": name,
                "set": problem.set,
                "number": problem.number,
                "refused": plan.reason if refused else "",
                "solved": plan.success,
                "physics": False,
                "milliseconds": milliseconds,
                "seeds": plan.seeds,
                "via_points": len(plan.durations) - 1,
                "motion_time": plan.duration,
                "jerk": plan.jerk,
                "length": float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()),
                "clearance": plan.clearance,
                "source": plan.source,
            }
        )
        if progress is not None:
            progress(name, number + 1, len(problems))
    for row in succeeding(plans):
        lines[row]["physics"] = True
    return pd.DataFrame(lines)


def succeeding(plans: Sequence[MotionPlan]) -> list[int]:
    """Return the indices of the plans that succeed by geometry and in physics."""
    found = list[int]()
    success = np.array([plan.success for plan in plans], bool)
    counts = np.array([len(plan.durations) for plan in plans])
    for count in np.unique(counts[success]):
        rows = np.flatnonzero(success & (counts == count))
        for some in np.split(rows, range(TOGETHER, len(rows), TOGETHER)):
            outcome, _ = execute_plans([plans[row] for row in some])
            found += some[outcome.is_success].tolist()
    return found


def summary(lines: pd.DataFrame) -> pd.DataFrame:
    """Return one line for each planner and set, and for all sets together, from those of :func:`measure_planner`."""
    rows = []
    names = [*dict.fromkeys(lines["set"]), "all"]
    for planner, name in itertools.product(dict.fromkeys(lines.planner), names):
        some = lines[(lines.planner == planner) & ((lines["set"] == name) | (name == "all"))]
        asked = some[some.refused == ""]
        solved = asked[asked.solved]
        rows.append(
            {
                "planner": planner,
                "set": name,
                "problems": len(asked),
                "solved %": 100.0 * asked.solved.mean(),
                "physics %": 100.0 * asked.physics.mean(),
                "median ms": asked.milliseconds.median(),
                "mean ms": asked.milliseconds.mean(),
                "95 % ms": asked.milliseconds.quantile(0.95),
                "motion s": solved.motion_time.median(),
                "jerk": solved.jerk.median(),
                "length rad": solved.length.median(),
                "clearance mm": 1e3 * solved.clearance.median(),
            }
        )
    return pd.DataFrame(rows)


def markdown(lines: pd.DataFrame) -> str:
    """Return the summary as a Markdown table."""
    digits = ("", "", ".0f", ".1f", ".1f", ".2f", ".2f", ".1f", ".2f", ".2f", ".2f", ".1f")
    return str(summary(lines).to_markdown(index=False, floatfmt=digits))
