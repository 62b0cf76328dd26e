"""Measurement of planners on the problems of MotionBenchMaker: solved by geometry and in physics, times and quality."""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from viapoint.envs.arms.arm import Arm
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import resting
from viapoint.envs.task import Task
from viapoint.training.config.checks import unknown_name
from viapoint.training.planning.benchmark import BenchmarkProblem, benchmark_panda
from viapoint.training.planning.motion_plan import MotionPlan, execute_plans
from viapoint.training.planning.ompl_paths import import_ompl
from viapoint.training.planning.plan_motion import checked_motion, ompl_motion, plan_motion
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import GeometrySearch

Planner = Callable[[Arm, BenchmarkProblem], MotionPlan]
# Function of the planner's name, the number of finished problems and the number of all
Progress = Callable[[str, int, int], None]

TOGETHER = 20  # Number of plans that are simulated together
PATH_INSTANTS = 200  # Instants between which the length of a movement is measured
NOTES = (
    "Solved: touches nothing and keeps all limits, by computed geometry; physics: success in MuJoCo, too; both without "
    "problems whose ends are in contact. Times include all checks. Motion time, jerk (relative to the straight "
    "movement), length and clearance are medians of the solved problems."
)


def benchmark_planner(name: str) -> Planner:
    """Return a planner by its name: straight, plan_motion, plan_motion+ompl, ompl, or search512 or another number.

    Raises:
        ValueError: There is no such planner, or its library is not installed.
    """
    planners: dict[str, Planner] = {
        "straight": lambda arm, each: plan_motion(arm, each.start, each.goal, each.obstacles, time_limit=0.0),
        "plan_motion": lambda arm, each: plan_motion(arm, each.start, each.goal, each.obstacles, ompl=False),
        "plan_motion+ompl": lambda arm, each: plan_motion(
            arm, each.start, each.goal, each.obstacles, time_limit=10.0
        ),
        "ompl": lambda arm, each: ompl_motion(arm, each.start, each.goal, pack([each.obstacles])),
    }
    if "ompl" in name:
        import_ompl()
    if name in planners:
        return planners[name]
    checks = re.fullmatch(r"search([1-9]\d*)", name)
    if checks is None:
        raise ValueError(unknown_name("planner", name, [*planners, "searchN"]))
    return lambda arm, each: _searched(arm, each, int(checks[1]))


def _searched(arm: Arm, problem: BenchmarkProblem, checks: int) -> MotionPlan:
    """Return the best of some checked plans with one via-point, half of them around the best of the others."""
    half = checks // 2
    task = Task.of(arm=arm, n_obstacles=(0, 32))
    search = GeometrySearch(task, checks - half, refinements=4, per_round=max(half // 4, 1))
    obstacles = pack([problem.obstacles])
    given = Problem.of_scenes(resting(problem.start[None], problem.goal[None], obstacles), task)
    plan = task.action.decode(search.solve(given), given.start, given.goal).take(0)
    return checked_motion(
        arm, "joints", Plan(plan.waypoints, plan.durations), obstacles, "search", shortest=True
    )


def measure_planner(
    name: str, problems: Sequence[BenchmarkProblem], *, physics: bool = True, progress: Progress | None = None
) -> pd.DataFrame:
    """Return one line for each problem: what a planner found, how long it took, and what MuJoCo says of it."""
    arm, planner = benchmark_panda(), benchmark_planner(name)
    planner(arm, problems[0])  # compiles what is not compiled yet
    plans, lines = [], []
    for number, problem in enumerate(problems):
        begin = time.perf_counter()
        plan = planner(arm, problem)
        milliseconds = 1e3 * (time.perf_counter() - begin)
        plans.append(plan)
        path = plan.trajectory()(np.linspace(0.0, plan.duration, PATH_INSTANTS))
        lines.append(
            {
                "planner": name,
                "set": problem.set,
                "number": problem.number,
                "refused": plan.reason.startswith(("the start", "the goal", "the arm")),
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
    if physics:
        for row in succeeding(plans):
            lines[row]["physics"] = True
    return pd.DataFrame(lines)


def succeeding(plans: Sequence[MotionPlan]) -> list[int]:
    """Return the indices of the plans that succeed by geometry and in physics."""
    found = []
    for count in {len(plan.durations) for plan in plans}:
        rows = [row for row, plan in enumerate(plans) if plan.success and len(plan.durations) == count]
        for first in range(0, len(rows), TOGETHER):
            some = rows[first : first + TOGETHER]
            outcome = execute_plans([plans[row] for row in some])
            found += [row for row, success in zip(some, outcome.is_success, strict=True) if success]
    return found


def summary(lines: pd.DataFrame) -> pd.DataFrame:
    """Return one line for each planner and set, and for all sets together, from those of :func:`measure_planner`."""
    rows = []
    names = [*dict.fromkeys(lines["set"]), "all"]
    for planner, name in itertools.product(dict.fromkeys(lines.planner), names):
        some = lines[(lines.planner == planner) & ((lines["set"] == name) | (name == "all"))]
        asked = some[~some.refused]
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
