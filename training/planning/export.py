"""Files of joint movements for controllers: tables of numbers, and messages of ROS 2."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from viapoint.envs.common.arrays import Float
from viapoint.envs.common.validation import finite_array
from viapoint.training.files import write_bytes
from viapoint.training.planning.motion_plan import JointMotion, MotionPlan

PARTS = JointMotion._fields[1:]  # Quantities of a table, each of which has a column for each joint
# Names of the same quantities in a point of `trajectory_msgs/JointTrajectory`
ROS_PARTS = ("positions", "velocities", "accelerations")


def write_motion(
    plan: MotionPlan, path: str | Path, rate: float = 100.0, *, force: bool = False
) -> JointMotion:
    """Write the movement of the joints, and return it.

    A `.csv` file has the columns `time` [s] and, for each joint, `position:NAME`, `velocity:NAME`, `acceleration:NAME`
    and `torque:NAME`, in rad or m and their derivatives, and N m or N. A `.yaml` file is a message
    `trajectory_msgs/JointTrajectory` of ROS 2, without torques (`effort`), which controllers of positions refuse.

    Args:
        plan: Plan.
        path: File that ends in .csv, .yaml or .yml; others raise ValueError.
        rate: Instants per second, [Hz].
        force: True for plans without success, too, which raise UnsafePlanError otherwise.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import arm_of
        >>> from viapoint.training import plan_motion, read_motion, write_motion
        >>> arm = arm_of("panda")
        >>> motion = write_motion(plan_motion(arm, arm.home, np.zeros(7) + [0, 0, 0, -1, 0, 1, 0]), "runs/plan.csv")
        >>> names, again = read_motion("runs/plan.csv")
        >>> names == arm.joint_names, np.allclose(again.position, motion.position)
        (True, True)
    """
    path = Path(path).expanduser()
    form = _form(path)
    motion = plan.joints(rate, force=force)
    names = plan.arm.joint_names
    write_bytes(path, (_table(names, motion) if form == "csv" else _message(names, motion)).encode())
    return motion


def read_motion(path: str | Path) -> tuple[tuple[str, ...], JointMotion]:
    """Return the names of the joints and the movement of a file of :func:`write_motion`; ValueError for other files.

    A message of ROS 2 has no torques: they are NaN.

    Example:
        >>> from viapoint.envs import arm_of
        >>> from viapoint.training import plan_motion, read_motion, write_motion
        >>> plan = plan_motion("planar", (-0.2, 0.3), (0.1, 0.4))
        >>> _ = write_motion(plan, "runs/planar.csv")
        >>> names, motion = read_motion("runs/planar.csv")
        >>> names, motion.position.shape[1]
        (('shoulder', 'elbow'), 2)
    """
    path = Path(path).expanduser()
    form = _form(path)
    try:
        text = path.read_text(encoding="utf-8-sig")  # of a spreadsheet
        names, time, parts = _read_table(text) if form == "csv" else _read_message(text)
        if not (np.diff(finite_array("time", time, (len(time),))) > 0.0).all():
            raise ValueError("its times do not increase")
        shape = (len(time), len(names))
        motion = [finite_array("motion", part, shape) for part in parts]
        if form == "yaml":
            motion.append(np.full(shape, np.nan))
        return names, JointMotion(time, *motion)
    except (KeyError, IndexError, TypeError, ValueError, yaml.YAMLError) as error:
        wanted = _columns(("NAME",)) if form == "csv" else ("joint_names", *ROS_PARTS, "time_from_start")
        fault = f"{type(error).__name__}: {' '.join(str(error).split())[:80]}"
        raise ValueError(f"{path} is no movement of joints, with {', '.join(wanted)} ({fault})") from None


def _form(path: Path) -> str:
    """Return the form of a file by its suffix."""
    form = path.suffix.lower().replace("yml", "yaml").removeprefix(".")
    if form not in ("csv", "yaml"):
        raise ValueError(f"a movement is written as .csv or .yaml, got {path}")
    return form


def _columns(names: tuple[str, ...]) -> list[str]:
    """Return the first line of a table."""
    return ["time", *(f"{part}:{name}" for part in PARTS for name in names)]


def _table(names: tuple[str, ...], motion: JointMotion) -> str:
    """Return a movement as comma-separated values."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(_columns(names))
    np.savetxt(text, np.column_stack(motion), "%.12g", ",")
    return text.getvalue()


def _read_table(text: str) -> tuple[tuple[str, ...], Float, list[Float]]:
    """Return joints, times and quantities of a table."""
    rows = csv.reader(io.StringIO(text))
    head = next(rows, [])
    names = tuple(column.removeprefix("position:") for column in head if column.startswith("position:"))
    if head != _columns(names):
        raise ValueError("its columns are others")
    numbers = np.array([row for row in rows if row], np.float64)
    return names, numbers[:, 0], np.split(numbers[:, 1:], len(PARTS), axis=1)


def _message(names: tuple[str, ...], motion: JointMotion) -> str:
    """Return a movement as a message of ROS 2."""
    points = []
    for time, *values in zip(*motion, strict=True):
        point: dict[str, Any] = {}
        for name, value in zip(ROS_PARTS, values, strict=False):
            point[name] = [float(f"{number:.12g}") for number in value]
        # Whole nanoseconds, which carry over into seconds.
        seconds, rest = divmod(round(1e9 * float(time)), 1_000_000_000)
        points.append({**point, "time_from_start": {"sec": seconds, "nanosec": rest}})
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message = {"header": header, "joint_names": list(names), "points": points}
    return yaml.dump(
        message, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=100_000
    )


def _read_message(text: str) -> tuple[tuple[str, ...], Float, list[Float]]:
    """Return joints, times and quantities of a message of ROS 2."""
    message = yaml.load(text, yaml.CSafeLoader)
    points = message["points"]
    times = [point["time_from_start"] for point in points]
    time = np.array([each["sec"] + 1e-9 * each["nanosec"] for each in times])
    parts = [np.array([point[name] for point in points], dtype=np.float64) for name in ROS_PARTS]
    return tuple(message["joint_names"]), time, parts
