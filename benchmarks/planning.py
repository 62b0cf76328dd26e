"""Planners on the problems of MotionBenchMaker: the table of docs/planning.md, and the curves of its figure.

python benchmarks/planning.py table   # problems 21 to 100 of each set, about five minutes
python benchmarks/planning.py curves  # each fourth of these, about six minutes
python benchmarks/planning.py data FOLDER  # the problems of the package again, from a folder of the original files
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib.style
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from viapoint.envs.geometry.obstacles import pack
from viapoint.training.files import write_figure
from viapoint.training.planning import benchmark
from viapoint.training.planning.benchmark import BenchmarkProblem, benchmark_panda, benchmark_problems
from viapoint.training.planning.plan_motion import plan_motion
from viapoint.training.plots import COLUMN, METHOD_STYLES, STYLE, style_axes

DOCS = Path(__file__).parents[1] / "docs"
TABLE = DOCS / "planning.csv"
PAGE = DOCS / "planning.md"
BEGIN, END = "<!-- table -->", "<!-- end of table -->"
HARDEST = ("cage", "table_under_pick")
PUBLISHED = (
    "| *VAMP, RRT-Connect (published; not smooth, not timed)* | 100 | | 0.035 | | | | | | |",
    "| *cuRobo (published; on a GPU, 800 problems)* | 100 | | | 38 | | 1.3 | | | |",
)
"""Rows from the papers on VAMP (Thomason et al. 2024) and cuRobo (Sundaralingam et al. 2023)."""
CURVES, FIGURE = DOCS / "planning_curves.csv", DOCS / "images" / "planning.png"
DEVELOPED_ON = 20
"""Greatest number of the problems that were looked at during development."""
UNSOLVABLE = "table_pick 41"
"""Problem with a goal in contact, which tables leave out, too."""
EVERY, PATIENCE = 4, 0.5
"""Step between the problems of the curves, and of the comparison with the least jerk in a longer time, [s]."""
PLANNERS = ("straight", "plan_motion", "paths", "plan_motion+ompl", "search512", "ompl")
LIMITS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Time limits of plan_motion, [ms]."""
CHECKS = (16, 64, 256, 1024, 4096, 16384)
"""Numbers of plans that the search checks."""


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("table", "curves", "data"))
    parser.add_argument("folder", nargs="?", type=Path)
    asked = parser.parse_args()
    if asked.what == "data":
        if asked.folder is None:
            parser.error("data needs a folder")
        write_problems(asked.folder)
        return
    problems = [each for each in benchmark_problems() if each.number > DEVELOPED_ON]
    if asked.what == "table":
        write_table(problems)
    else:
        solvable = [each for each in problems[::EVERY] if each.name != UNSOLVABLE]
        measure_curves(solvable).to_csv(CURVES, index=False, float_format="%.4g", lineterminator="\n")
        draw_curves()


def write_problems(folder: Path) -> None:
    """Write the numeric file of the package from a folder of the original files."""
    problems, _ = benchmark.read_problems(folder)
    shapes = [shape for problem in problems for shape in problem.obstacles]
    np.savez_compressed(
        Path(benchmark.__file__).parent / "data" / "motionbenchmaker.npz",
        set=np.array([benchmark.SETS.index(problem.set) for problem in problems], np.int8),
        number=np.array([problem.number for problem in problems], np.int16),
        start=np.array([problem.start for problem in problems]),
        goal=np.array([problem.goal for problem in problems]),
        count=np.array([len(problem.obstacles) for problem in problems], np.int16),
        kind=np.array([benchmark.KINDS[type(shape)] for shape in shapes], np.int8),
        pose=np.array([[*shape.position, *shape.quaternion] for shape in shapes], np.float32),
        size=np.array([shape.packed_size for shape in shapes], np.float32),
    )


def write_table(problems: list[BenchmarkProblem]) -> None:
    """Measure all planners, print the table, and write it."""
    lines = pd.concat([benchmark.measure_planner(name, problems, benchmark_panda()) for name in PLANNERS])
    print(benchmark.markdown(lines))
    found = benchmark.summary(lines)
    found.to_csv(TABLE, index=False, float_format="%.4g", lineterminator="\n")
    before, _, after = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = after.partition(END)
    text = f"{page_table(found)}\n\n{quality(problems, lines[lines.planner == 'plan_motion'])}"
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    unsolved = lines[
        lines.planner.str.startswith("plan_motion") & (lines.refused == "") & ~(lines.solved & lines.physics)
    ]
    print(unsolved[["planner", "set", "number", "solved", "physics", "clearance", "seeds"]].to_string())


def quality(problems: list[BenchmarkProblem], lines: pd.DataFrame) -> str:
    """Return a sentence on the jerk of plan_motion relative to the least that it finds in PATIENCE."""
    arm, ratios = benchmark_panda(), []
    for problem, jerk in zip(problems[::EVERY], lines.jerk[::EVERY], strict=True):
        best = plan_motion(
            arm, problem.start, problem.goal, problem.obstacles, enough=10**5, time_limit=PATIENCE, ompl=False
        )
        ratios.append(jerk / min(best.jerk, jerk))
    found = pd.Series(ratios)
    return (
        f"Jerk of plan_motion relative to the least that it finds in {1e3 * PATIENCE:.0f} ms, every {EVERY}th problem: "
        f"median {found.median():.2f}, mean {found.mean():.2f}, 95 % {found.quantile(0.95):.2f}; at most 1.15 in "
        f"{100 * (found <= 1.15).mean():.0f} %."
    )


def page_table(found: pd.DataFrame) -> str:
    """Return the table of the page: all sets together, the hardest ones of plan_motion, and what others published."""
    rows = found[(found["set"] == "all") | ((found.planner == "plan_motion") & found["set"].isin(HARDEST))]
    heads = [
        "planner",
        "solved %",
        "physics %",
        "median ms",
        "mean ms",
        "95 % ms",
        "motion s",
        "jerk",
        "length rad",
        "clearance mm",
    ]
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    for row in rows.to_dict("records"):
        name = row["planner"] if row["set"] == "all" else f"{row['planner']}, {row['set']}"
        numbers = [row[head] for head in heads[1:]]
        digits = (1, 1, 1, 1, 1, 2, 2, 2, 1)
        cells = ["-" if np.isnan(n) else f"{n:.{d}f}" for n, d in zip(numbers, digits, strict=True)]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join([*lines, *PUBLISHED])


def measure_curves(problems: list[BenchmarkProblem]) -> pd.DataFrame:
    """Return the share solved and the median jerk of each planner against the time that it is given, [ms]."""
    arm, scenes = benchmark_panda(), [pack([each.obstacles]) for each in problems]
    points: list[tuple[str, float, float, float]] = []
    for limit in LIMITS:
        plans = [
            plan_motion(
                arm,
                each.start,
                each.goal,
                scene,
                seeds=10**5,
                enough=10**5,
                time_limit=1e-3 * limit,
                ompl=False,
            )
            for each, scene in zip(problems, scenes, strict=True)
        ]
        solved = [plan.jerk for plan in plans if plan.success]
        taken = float(np.median([plan.milliseconds for plan in plans]))
        points.append(("plan_motion", taken, len(solved) / len(plans), float(np.median(solved))))
        print(points[-1], file=sys.stderr)
    for checks in CHECKS:
        lines = benchmark.measure_planner(f"search{checks}", problems, benchmark_panda())
        jerk = lines[lines.solved].jerk.median()
        points.append(("search", lines.milliseconds.median(), lines.solved.mean(), jerk))
    # A path is found or not: the curve is the share of those that took less than a time.
    lines = benchmark.measure_planner("ompl", problems, benchmark_panda())
    for limit in LIMITS:
        found = lines[lines.solved & (lines.milliseconds <= limit)]
        if len(found):
            points.append(("ompl", limit, len(found) / len(lines), found.jerk.median()))
    return pd.DataFrame(points, columns=["planner", "ms", "solved", "jerk"])


def draw_curves() -> None:
    """Draw share solved and jerk against the time that planners are given."""
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, 5.6 / 2.54))
        left, right = figure.subplots(1, 2)
        for name, points in pd.read_csv(CURVES).groupby("planner", sort=False):
            style = {**METHOD_STYLES[str(name)], "markersize": 3.0}
            left.plot(points.ms, 100.0 * points.solved, label=name, **style)
            right.plot(points.ms, points.jerk, **style)
        for axes in (left, right):
            style_axes(axes)
            axes.set(xscale="log", xlabel="time [ms]", xticks=[1, 10, 100, 1000])
            axes.set_xticklabels(["1", "10", "100", "1000"])
        left.set(ylabel="solved [%]", ylim=(0, 103))
        right.set(yscale="log", ylabel="jerk, relative to straight")
        right.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
        right.minorticks_off()
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=len(names))
        write_figure(FIGURE, figure)


if __name__ == "__main__":
    main()
