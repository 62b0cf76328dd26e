"""Arms of public files: what loads, how long it takes, and how well they move. The table of docs/arms.md.

python benchmarks/arms.py FOLDER ...  # copies of the projects in PROJECTS; what is not there is left out

It takes about half a minute for each arm. Nothing is downloaded.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.load import load_arm
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.planning.benchmark import succeeding
from viapoint.training.planning.motion_plan import MotionPlan, execute_plans
from viapoint.training.planning.plan_motion import plan_motion

DOCS = Path(__file__).parents[1] / "docs"
TABLE, PAGE = DOCS / "arms.csv", DOCS / "arms.md"
BEGIN, END = "<!-- table -->", "<!-- end of table -->"
STRAIGHT, PROBLEMS = 50, 100
"""Numbers of straight movements without obstacles, and of problems with 1 to 16 obstacles."""
PROJECTS = {
    "menagerie": "MuJoCo Menagerie a03e87b (each folder has its licence)",
    "erd": "example-robot-data 6.0.0 (BSD-3-Clause)",
    "bullet": "bulletphysics/bullet3 6c888f4 (zlib; folders have their own licences)",
    "urdfs": "Daniella1/urdf_files_dataset 81f4cda (MIT; folders have their own licences)",
    "airo": "airo-ugent/airo-models 6c187ea (MIT)",
    "unitree": "unitreerobotics/unitree_ros d6f13aa (BSD-3-Clause)",
    "robosuite": "robosuite 1.5.2 (MIT)",
    "robotics": "gymnasium-robotics 1.4.2 (MIT)",
    "gymxarm": "gym-xarm 0.1.1 (Apache-2.0)",
}
"""Projects, with commit or version, and licence."""
ROBOSUITE = "robosuite/models/assets/robots"
BULLET = "examples/pybullet/gym/pybullet_data"
FILES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("menagerie", "franka_emika_panda/panda.xml", {}),
    ("menagerie", "franka_emika_panda/panda_nohand.xml", {}),
    ("menagerie", "franka_fr3/fr3.xml", {}),
    ("menagerie", "franka_fr3_v2/fr3v2.xml", {}),
    ("menagerie", "kuka_iiwa_14/iiwa14.xml", {}),
    ("menagerie", "kinova_gen3/gen3.xml", {}),
    ("menagerie", "universal_robots_ur5e/ur5e.xml", {}),
    ("menagerie", "universal_robots_ur10e/ur10e.xml", {}),
    ("menagerie", "ufactory_xarm7/xarm7.xml", {}),
    ("menagerie", "ufactory_lite6/lite6.xml", {}),
    ("menagerie", "rethink_robotics_sawyer/sawyer.xml", {}),
    ("menagerie", "flexiv_rizon4/flexiv_rizon4.xml", {}),
    ("menagerie", "unitree_z1/z1.xml", {}),
    ("menagerie", "trossen_vx300s/vx300s.xml", {}),
    ("menagerie", "trossen_wx250s/wx250s.xml", {}),
    ("menagerie", "trossen_wxai/trossen_ai_bimanual.xml", {"base": "left/root"}),
    ("menagerie", "aloha/aloha.xml", {"base": "left/base_link"}),
    ("menagerie", "arx_l5/arx_l5.xml", {}),
    ("menagerie", "agilex_piper/piper.xml", {}),
    ("menagerie", "i2rt_yam/yam.xml", {}),
    ("menagerie", "trs_so_arm100/so_arm100.xml", {}),
    ("menagerie", "robotstudio_so101/so101.xml", {}),
    ("menagerie", "low_cost_robot_arm/low_cost_robot_arm.xml", {}),
    ("menagerie", "google_robot/robot.xml", {}),
    ("menagerie", "stanford_tidybot/tidybot.xml", {}),
    ("menagerie", "boston_dynamics_spot/spot_arm.xml", {}),
    ("menagerie", "pal_tiago/tiago.xml", {}),
    ("menagerie", "pal_tiago_dual/tiago_dual.xml", {"base": "arm_left_1_link"}),
    ("menagerie", "hello_robot_stretch/stretch.xml", {}),
    ("menagerie", "hello_robot_stretch_3/stretch.xml", {}),
    ("erd", "robots/ur_description/urdf/ur5_robot.urdf", {}),
    ("erd", "robots/ur_description/urdf/ur3_gripper.urdf", {}),
    ("erd", "robots/panda_description/urdf/panda.urdf", {}),
    ("erd", "robots/tiago_description/robots/tiago.urdf", {}),
    ("erd", "robots/baxter_description/urdf/baxter.urdf", {"tool": "left_gripper"}),
    ("erd", "robots/kinova_description/robots/kinova.urdf", {}),
    ("airo", "airo_models/arms/ur5e/ur5e.urdf", {}),
    ("unitree", "robots/z1_description/xacro/z1.urdf", {}),
    ("bullet", f"{BULLET}/xarm/xarm6_with_gripper.urdf", {}),
    ("bullet", f"{BULLET}/franka_panda/panda.urdf", {}),
    ("bullet", f"{BULLET}/kuka_iiwa/model.urdf", {}),
    ("urdfs", "urdf_files/random/robot-assets/fetch/robots/fetch.urdf", {}),
    ("urdfs", "urdf_files/random/robot-assets/ur10/ur10_robot.urdf", {}),
    ("urdfs", "urdf_files/matlab/kortex_description/urdf/kinovaGen3.urdf", {}),
    ("urdfs", "urdf_files/matlab/sawyer_description/urdf/rethinkSawyer.urdf", {}),
    ("urdfs", "urdf_files/matlab/abb_irb120_support/urdf/abbIrb120.urdf", {}),
    ("urdfs", "urdf_files/matlab/yumi_description/urdf/abbYuMi.urdf", {"base": "yumi_link_1_l"}),
    ("urdfs", "urdf_files/oems/xacro_generated/franka_emika/franka_description/robots/fr3/fr3.urdf", {}),
    ("robosuite", f"{ROBOSUITE}/panda/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/iiwa/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/jaco/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/kinova3/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/sawyer/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/spot_arm/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/ur5e/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/xarm7/robot.xml", {}),
    ("robosuite", f"{ROBOSUITE}/tiago/robot.xml", {"tool": "left_hand"}),
    ("robosuite", f"{ROBOSUITE}/baxter/robot.xml", {"tool": "left_hand"}),
    ("robotics", "gymnasium_robotics/envs/assets/fetch/reach.xml", {}),
    (
        "robotics",
        "gymnasium_robotics/envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml",
        {},
    ),
    ("gymxarm", "gym_xarm/tasks/assets/lift.xml", {}),
)
"""Project, path in it, and arguments that `load_arm` needs beside the path."""


class Movements(NamedTuple):
    """Measured movements of an arm."""

    straight: int
    """Number of the straight movements that succeed."""
    tracking: float
    """Greatest root mean square distance of them from the plan, [mrad] or [mm]."""
    solved: float
    """Share of the problems with obstacles that are solved by geometry and in physics, [%]."""
    median: float
    """Median of the planning times, [ms]."""
    slow: float
    """95th percentile of them, [ms]."""


def main() -> None:
    """Measure the arms that are in the folders of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="roots of copies of the projects")
    parser.add_argument("--only", default="", help="measure paths that contain this text; other rows stay")
    asked = parser.parse_args()
    warnings.filterwarnings("ignore", module="viapoint")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        for project, file, arguments in FILES:
            path = next((each / file for each in asked.folders if (each / file).is_file()), None)
            if path is None or asked.only not in file:
                continue
            line = {"project": project, "file": file, "arguments": len(arguments)}
            line.update(measure(path, arguments))
            print(line, flush=True)
            write(line)


def write(line: dict[str, Any]) -> None:
    """Write a line into the table and the page, in the place of an older one."""
    known = (
        pd.read_csv(TABLE, keep_default_na=False, na_values=[""])
        if TABLE.is_file()
        else pd.DataFrame({"file": []})
    )
    found = pd.concat([known[known.file != line["file"]], pd.DataFrame([line])])
    order = {file: row for row, (_, file, _) in enumerate(FILES)}
    found = found.sort_values("file", key=lambda files: files.map(order)).fillna({"fault": ""})
    found.to_csv(TABLE, index=False, float_format="%.4g", lineterminator="\n")
    before, _, after = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = after.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{page_table(found)}\n{END}{after}", encoding="utf-8")


def measure(path: Path, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return what is known of the arm of a file."""
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        try:
            arm = load_arm(path, **arguments)
        except ValueError as error:
            return {"fault": str(error)[:300]}
        seconds.append(time.perf_counter() - begin)
    known: dict[str, Any] = {
        "arm": arm.name,
        "joints": len(arm.joint_names),
        "first_s": seconds[0],
        "second_s": seconds[1],
        "spheres": len(arm.spheres.radius),
        "excess_mm": 1e3 * arm.excess,
        "fault": "",
    }
    try:
        return {**known, **measure_movements(arm)._asdict()}
    except RuntimeError as error:  # too few scenes were found
        return {**known, "fault": str(error)}


def measure_movements(arm: Arm) -> Movements:
    """Return how many straight movements and drawn problems an arm masters."""
    # Straight movements in which the arm would touch itself are none that physics could master.
    straight = [plan for plan in planned(arm, drawn(arm, 0, 2 * STRAIGHT), time_limit=0.0) if plan.success]
    outcome, _ = execute_plans(straight[:STRAIGHT])
    found = planned(arm, drawn(arm, (1, 16), PROBLEMS), time_limit=1.0)
    times = [plan.milliseconds for plan in found]
    solved = succeeding(found)
    return Movements(
        straight=int(outcome.is_success.sum()),
        tracking=1e3 * float(outcome.tracking_error.max()),
        solved=100.0 * len(solved) / len(found),
        median=float(np.median(times)),
        slow=float(np.quantile(times, 0.95)),
    )


def drawn(arm: Arm, n_obstacles: Any, number: int) -> list[Scenes]:
    """Return scenes that are drawn for an arm, one for each of the first seeds with which one is found."""
    sampler = Task.of(arm=arm, n_obstacles=n_obstacles).sampler()
    found: list[Scenes] = []
    for seed in range(2 * number):
        try:
            found.append(sampler([np.random.default_rng(seed)]))
        except RuntimeError:  # no scene was found
            if seed + 1 - len(found) > number:  # too few are left
                raise
        if len(found) == number:
            break
    return found


def planned(arm: Arm, scenes: list[Scenes], time_limit: float) -> list[MotionPlan]:
    """Return plans for scenes."""
    return [
        plan_motion(arm, each.start[0], each.goal[0], each.obstacles, time_limit=time_limit)
        for each in scenes
    ]


def page_table(found: pd.DataFrame) -> str:
    """Return the table of the page and what it was measured on."""
    columns = ["arguments", "first_s", "second_s", "spheres", "excess_mm", "straight", "tracking", "solved"]
    heads = ["file", "arguments", "load s", "again s", "spheres", "excess mm", f"straight of {STRAIGHT}"]
    heads += ["tracking mrad", "solved %", "median ms", "95 % ms"]
    loaded = found[found.spheres.notna()]
    bare = int((loaded.arguments == 0).sum())
    parts = [
        f"{len(loaded)} of {len(found)} files load, {bare} of them with no argument beside the path. The median of the "
        f"{int(found.solved.notna().sum())} arms whose movements were measured is {found.solved.median():.0f} % of the "
        "problems.\n"
    ]
    for project in dict.fromkeys(found.project):
        rows = found[found.project == project]
        files = [f"{Path(file).parent.name}/{Path(file).name}" for file in rows.file]
        table = rows[[*columns, "median", "slow"]].copy()
        table.insert(0, "file", files)
        table.columns = pd.Index(heads)
        digits = ("", ".0f", ".1f", ".1f", ".0f", ".0f", ".0f", ".2g", ".0f", ".1f", ".0f")
        text = table.to_markdown(index=False, floatfmt=digits, missingval="")
        text = re.sub(r"\bnan\b", "   ", text)
        parts.append(f"### {PROJECTS[project]}\n\n{text}\n")
        for file, fault in zip(files, rows.fault, strict=True):
            if fault:
                parts.append(f"`{file}`: {fault}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    main()
