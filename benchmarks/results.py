"""Measure shipped agents and methods without learning in the frozen sets; write tables of three pages and a figure.

python benchmarks/results.py                                  # all tasks; hours
python benchmarks/results.py --env viapoint/PandaObstacles-v0 # others keep their numbers
python benchmarks/results.py --only agents                    # only shipped agents, searches and planners
python benchmarks/results.py --only runs                      # only the trainings of benchmarks/sb3.py
python benchmarks/results.py --only looking                   # only searches and agents that look again on the way
python benchmarks/results.py --only reaches                   # only obstacles on reaches of their own
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib.style
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from viapoint.training import Run, evaluate, load_agent
from viapoint.training.checks import SHIPPED_IDS
from viapoint.training.files import write_figure
from viapoint.training.planning.search import registered_task
from viapoint.training.plots import COLUMN, METHOD_STYLES, STYLE, style_axes
from viapoint.training.scene_sets import SETS, shipped_set

BASELINES = ("untrained", "straight", "sobol64", "search512", "plan_motion", "ompl")
REPLANNING_BASELINES = BASELINES[:-2]
"""Baselines of tasks in which plans are revised: planners are for obstacles that rest."""
SENSED_BASELINES = (
    "untrained",
    "straight",
    "points:search512",
    "fitted:search512",
    "thick:search512",
    "thick:plan_motion",
    "cautious512",
    "cautious2048",
    "deep:plan_motion",
    "seen:search512",
    "known:search512",
    "known:plan_motion",
)
"""Baselines of tasks with a sensor: beliefs with more and more information. The last three need the truth."""
LOOKING: dict[str, dict[str, Any]] = {
    "one look": {"decide_at": "end"},
    "a look each 0.3 s": {"decide_at": ["horizon"]},
    "looks at what is new": {"decide_at": ["sight"]},
}
"""Decisions of PlanarSensed with rays around the hand, in which points that were seen are remembered."""
LOOKS = "PlanarSensed, hand_rays"
"""Name of this variant in the file and on the page."""
PREDICTIONS = ("rest:search512", "search512", "reach:search512", "known:search512")
"""Searches with more and more that is known of the courses of obstacles."""
INTERVALS = {"PlanarMovingObstacles": (0.3, 0.1), "PandaMovingObstacles": (0.5,)}
"""Greatest times from one decision to the next, [s], in tasks whose obstacles may be on reaches of their own."""
REACHES = [f"{name}, reaches" for name in INTERVALS]
"""Names of these variants."""
PAGES = Path("docs/results.md"), Path("docs/results-sensed.md"), Path("docs/results-details.md")
PICTURE = Path("docs/images/results.png")
DETAILS = ("points:", "cautious2048", "fitted:", "thick:plan_motion", "agent, seed", "untrained, ")
"""Beginnings of methods that are on other pages or in the file only."""
SHOWN: dict[str, dict[str, Any]] = {
    "plan_motion": METHOD_STYLES["plan_motion"],
    "deep:plan_motion": METHOD_STYLES["plan_motion"],
    "known:plan_motion": METHOD_STYLES["plan_motion"],
    "ompl": METHOD_STYLES["ompl"],
    "search512": METHOD_STYLES["search"],
    "cautious512": {**METHOD_STYLES["search"], "marker": "X"},
    "thick:search512": {**METHOD_STYLES["search"], "marker": "<"},
    "agent": METHOD_STYLES["agent"],
    "agent, 4 refined": {**METHOD_STYLES["agent"], "marker": "*"},
    "untrained": METHOD_STYLES["untrained"],
    "SAC": METHOD_STYLES["sac"],
    "PPO": METHOD_STYLES["ppo"],
}
"""Styles of the methods in the figure."""
PRIVILEGED = "known:"
"""Beginning of methods that know more than a sensor tells, which have hollow marks."""
FIELDS = ("env", "scenes", "method", "success", "low", "high", "count", "jerk_ratio", "milliseconds")


@dataclass(frozen=True, kw_only=True)
class Config:
    """Measure shipped agents, searches and the straight movement in all frozen sets but `validation`."""

    out: Path = Path("docs/results.csv")
    """File of the numbers."""
    env: tuple[str, ...] = SHIPPED_IDS
    """Ids of environments with a shipped agent."""
    n_scenes: int | None = None
    """Number of scenes of each set; default: all of them."""
    only: Literal["everything", "agents", "runs", "looking", "reaches"] = "everything"
    """Part that is measured: shipped agents and their baselines, the trainings in `runs`, looking again on the way,
    or obstacles on reaches of their own; other numbers stay."""
    runs: Path = Path("runs/sb3")
    """Folder of trainings, which get a row each: those of benchmarks/sb3.py, viaq and viarank with other seeds, such as
    `PlanarSensed-viarank-1`, with more via-points, such as `PlanarObstacles-2via-0`, and viarank with other beliefs,
    such as `PlanarSensed-fitted`."""
    reaches: Path = Path("runs/reaches")
    """Folder of trainings among obstacles on reaches of their own, such as `PlanarMovingObstacles-0` for seed 0."""
    looks: Path = Path("runs/looks")
    """Folder of trainings that look again each 0.3 s, such as `PlanarSensed-0` for seed 0."""


def rows_of(config: Config, env_id: str, name: str) -> Iterator[dict[str, Any]]:
    """Yield the numbers of each method in one set."""
    task = registered_task(env_id)
    settings: dict[str, Any] = {"checks": [0, 16], "refine": [4], "baselines": BASELINES}
    if task.sensor is not None:
        refine = [] if task.space.of_hand else [16]  # in the plane, refined plans solve no other scenes
        settings = {"refine": refine, "baselines": SENSED_BASELINES}
    elif task.replanning:
        settings = {"checks": [0, 16], "baselines": REPLANNING_BASELINES}
    common: dict[str, Any] = {"env": env_id, "scenes": name, "n_scenes": config.n_scenes}
    common["time_decisions"] = name == "test"
    if config.only in ("everything", "agents"):
        for row in evaluate(load_agent(env_id), **common, **settings).rows:
            yield _numbers(env_id, name, row["method"], row)
    short = env_id.removeprefix("viapoint/").removesuffix("-v0")
    if config.only in ("everything", "reaches"):
        yield from reaches_of(config, short, common)
    if config.only in ("everything", "looking") and task.sensor is not None and task.space.of_hand:
        for when, kwargs in LOOKING.items():
            settings = {**common, "env_kwargs": {"sensor": "hand_rays", **kwargs}}
            once = kwargs["decide_at"] == "end"
            stronger = ["thick:plan_motion", "deep:plan_motion"] if once else ["thick:search4096"]
            rows = evaluate(**settings, baselines=["thick:search512", *stronger, "known:search512"]).rows
            if not once:
                rows += seeds_of(config.looks, short, settings, untrained="horizon" in kwargs["decide_at"])
            for row in rows:
                yield _numbers(LOOKS, name, f"{row['method']}, {when}", row)
    if config.only in ("everything", "runs"):
        for row in runs_of(config.runs, short, common):
            yield _numbers(env_id, name, row["method"], row)


def runs_of(folder: Path, short: str, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the numbers of the trainings of a task in a folder of several, each under the name of its method."""
    rows = []
    for path in sorted(folder.glob(f"{short}-*")):
        run = Run(path)
        agent = load_agent(path)  # the best by validation
        method = f"{run.config.algorithm.upper()}, {agent.num_timesteps:,} of {run.curve[-1]['decisions']:,}"
        last = path.name.rpartition("-")[2]
        if run.config.algorithm in ("viaq", "viarank"):
            n_via = run.config.env_kwargs.get("n_via", 1)
            method = "agent" if last == "0" else f"agent, seed {last}" if last.isdigit() else f"{last}:agent"
            method += f", {n_via} via-points" if n_via > 1 else ""
        rows.append({**evaluate(agent, **settings, baselines=[]).rows[0], "method": method})
    return rows


def reaches_of(config: Config, short: str, common: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the numbers of each method among obstacles on reaches of their own, in scenes that are drawn."""
    for interval in INTERVALS.get(short, ()):
        settings = {**common, "env_kwargs": {"courses": "reaches", "horizon": interval}}
        rows = evaluate(**settings, baselines=("straight", *PREDICTIONS)).rows
        for row in rows + seeds_of(config.reaches, short, settings):
            yield _numbers(f"{short}, reaches", "test", f"{row['method']}, every {interval} s", row)


def seeds_of(
    folder: Path, short: str, settings: dict[str, Any], *, untrained: bool = True
) -> list[dict[str, Any]]:
    """Return the numbers of the trainings of a task in a folder, such as `PlanarSensed-0` for seed 0."""
    rows = []
    for run in sorted(folder.glob(f"{short}-*")):
        seed = run.name.rpartition("-")[2]
        baselines = ["untrained"] if untrained and seed == "0" else []
        for row in evaluate(load_agent(run), **settings, baselines=baselines).rows:
            rows.append({**row, "method": row["method"].replace("agent", f"agent, seed {seed}")})
    return rows


def _numbers(env_id: str, name: str, method: str, row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the file for a row of an evaluation."""
    success = row["success"]
    return {
        "env": env_id,
        "scenes": name,
        "method": method,
        "success": round(100.0 * success["rate"], 1),
        "low": round(100.0 * success["low"], 1),
        "high": round(100.0 * success["high"], 1),
        "count": success["of"],
        "jerk_ratio": _rounded(row["jerk_ratio"], 1.0),
        "milliseconds": _rounded(row["decision_time"], 1e3),
    }


def _rounded(value: float | None, unit: float) -> float | str:
    """Return a number with two decimals; an empty text where there is none."""
    return "" if value is None else round(unit * value, 2)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of one environment: success with its interval in each set, jerk and time in `test`."""
    sets = [name for name in SETS if any(row["scenes"] == name for row in rows)]
    lines = [
        f"| method | {' | '.join(f'`{name}`' for name in sets)} | jerk | time |",
        "|---" * (len(sets) + 3) + "|",
    ]
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = {row["scenes"]: row for row in rows if row["method"] == method}
        cells = [f"{mine[name]['success']} ({mine[name]['low']}-{mine[name]['high']})" for name in sets]
        last = mine["test"]
        numbers = [last[name] if float(last[name] or 0.0) else "-" for name in ("jerk_ratio", "milliseconds")]
        lines.append(f"| {' | '.join((method, *cells, *map(str, numbers)))} |")
    return "\n".join(lines)


def is_detail(method: str) -> bool:
    """Return True for methods that are not in the table of their task."""
    return method.startswith(DETAILS) or method.endswith(":agent")


def tables(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Return the tables of both pages by the headings that they follow."""
    found = {}
    for env_id in dict.fromkeys(row["env"] for row in rows):
        mine = [row for row in rows if row["env"] == env_id]
        heading = env_id.removeprefix("viapoint/").removesuffix("-v0")
        if env_id not in SHIPPED_IDS:  # tables of other pages
            found[heading] = table(mine)
            continue
        found[heading] = table([row for row in mine if not is_detail(row["method"])])
        for kind, part in {"beliefs": ":", "seeds": "agent, seed", "untrained": "untrained, "}.items():
            # Planners are in the table of the task.
            some = [row for row in mine if part in row["method"] and ":plan" not in row["method"]]
            if some:
                found[f"{heading}, {kind}"] = table(some)
    return found


def write_pages(rows: list[dict[str, Any]]) -> None:
    """Put the tables into the pages: each follows its heading, up to the next empty line after it."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for heading, lines in tables(rows).items():
            before, found, after = text.partition(f"### {heading}\n\n")
            if found:  # tasks without obstacles are not on the pages
                _, _, rest = after.partition("\n\n")  # after the old table
                text = f"{before}{found}{lines}\n\n{rest}"
        page.write_text(text, encoding="utf-8")


def draw(rows: list[dict[str, Any]]) -> None:
    """Draw success in `test` against the time of a decision, a panel for each task with obstacles."""
    headings = re.findall(r"### (.*)", PAGES[0].read_text(encoding="utf-8"))
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, 14.0 / 2.54))
        panels = figure.subplots(4, 2, sharex=True, sharey=True).flat
        marks: dict[str, Any] = {}
        for heading, axes in zip(headings, panels, strict=False):
            mine = [row for row in rows if row["env"] == f"viapoint/{heading}-v0" and row["scenes"] == "test"]
            for name, row in shown_methods(mine):
                marks[name] = draw_method(axes, name, row)
            axes.set_title(heading)
            axes.tick_params(labelbottom=True)
            style_axes(axes)
        axes.set(xscale="log", xlim=(0.3, 200.0), ylim=(-6.0, 108.0), yticks=[0, 50, 100])
        axes.set_xticks([1, 10, 100], ["1", "10", "100"])
        for axes in panels:  # what is left holds the legend
            axes.axis("off")
            order = [name for name in SHOWN if name in marks]
            legend = axes.legend([marks[name] for name in order], order, loc="center", labelspacing=0.15)
            legend.set_in_layout(False)
        figure.supxlabel("time of a decision [ms]")
        figure.supylabel("success in test [%]")
        write_figure(PICTURE, figure)


def shown_methods(rows: list[dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the methods of the figure among the rows of one task and set, by their names in SHOWN."""
    for row in rows:
        name = row["method"] if row["method"].startswith("agent") else row["method"].partition(",")[0]
        # By validation, the best model of such a training is the untrained one.
        untrained = ", 0 of " in row["method"]
        if name in SHOWN and not untrained and not is_detail(row["method"]):
            yield name, row


def draw_method(axes: Axes, name: str, row: dict[str, Any]) -> Any:
    """Draw success and time of a method, and return the mark for the legend."""
    style = {**SHOWN[name], "linestyle": "none", "markersize": 5.0, "elinewidth": 1.0}
    if name.startswith(PRIVILEGED):
        style["markerfacecolor"] = "white"
    success = float(row["success"])
    bars = [[success - float(row["low"])], [float(row["high"]) - success]]
    return axes.errorbar(float(row["milliseconds"]), success, bars, **style)


def in_order(rows: list[dict[str, Any]], before: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows by their tasks, and those of methods that were there before in the place that they had."""
    tasks = [*SHIPPED_IDS, LOOKS, *REACHES]
    methods = list(dict.fromkeys((row["env"], row["method"]) for row in [*before, *rows]))
    return sorted(rows, key=lambda row: (tasks.index(row["env"]), methods.index((row["env"], row["method"]))))


def main() -> None:
    """Measure, and write the file, the tables of the pages and the figure after each task."""
    config = tyro.cli(Config)
    torch.set_num_threads(1)
    every: list[dict[str, Any]] = []
    if config.out.is_file():
        with config.out.open(newline="", encoding="utf-8") as file:
            every = list(csv.DictReader(file))
    for env_id in config.env:
        task = registered_task(env_id)
        found = []
        for name in SETS:
            if name != "validation" and shipped_set(name, task) is not None:
                found += list(rows_of(config, env_id, name))
        measured = {(row["env"], row["method"]) for row in found}
        kept = [row for row in every if (row["env"], row["method"]) not in measured]
        every = in_order(kept + found, every)
        with config.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, FIELDS)
            writer.writeheader()
            writer.writerows(every)
        write_pages(every)
        draw(every)
        print(f"{env_id} is measured", flush=True)


if __name__ == "__main__":
    main()
