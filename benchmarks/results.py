"""Measure the shipped agents and the methods without learning in the frozen sets, and write the tables of results.md.

python benchmarks/results.py                                  # all tasks; hours
python benchmarks/results.py --env viapoint/PandaObstacles-v0 # others keep their numbers
python benchmarks/results.py --only runs                      # only the trainings of benchmarks/sb3.py
python benchmarks/results.py --only looking                   # only searches that look again on the way
python benchmarks/results.py --only reaches                   # only obstacles on reaches of their own
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from viapoint.training import Run, evaluate, load_agent
from viapoint.training.config.checks import SHIPPED_IDS
from viapoint.training.planning.search import registered_task
from viapoint.training.scene_sets import SETS, shipped_set

BASELINES = ("untrained", "straight", "sobol64", "search512", "plan_motion")
REPLANNING_BASELINES = BASELINES[:-1]
"""Baselines of tasks in which plans are revised: :func:`plan_motion` is for obstacles that rest."""
SENSED_BASELINES = (
    "untrained",
    "straight",
    "points:search512",
    "fitted:search512",
    "thick:search512",
    "thick:plan_motion",
    "cautious512",
    "seen:search512",
    "known:search512",
    "known:plan_motion",
)
"""Baselines of tasks with a sensor: beliefs with more and more information. The last three need the truth."""
LOOKING: dict[str, Any] = {
    "one look": "end",
    "a look each 0.3 s": ["horizon"],
    "looks at what is new": ["sight"],
    "looks at what is new or near": ["sight", "clearance"],
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
PAGE = Path("docs/results.md")
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
    only: Literal["everything", "runs", "looking", "reaches"] = "everything"
    """Part that is measured: the trainings in `runs`, searches that look again, or obstacles on reaches of their own;
    other numbers stay."""
    runs: Path = Path("runs/sb3")
    """Folder of trainings of algorithms of Stable-Baselines3 by benchmarks/sb3.py, which get a row each."""
    reaches: Path = Path("runs/reaches")
    """Folder of trainings among obstacles on reaches of their own, such as `PlanarMovingObstacles-0` for seed 0."""


def rows_of(config: Config, env_id: str, name: str) -> Iterator[dict[str, Any]]:
    """Yield the numbers of each method in one set."""
    task = registered_task(env_id)
    settings: dict[str, Any] = {"checks": [0, 16], "refine": [4], "baselines": BASELINES}
    if task.sensor is not None:
        settings = {"refine": [16], "baselines": SENSED_BASELINES}
    elif task.replanning:
        settings = {"checks": [0, 16], "baselines": REPLANNING_BASELINES}
    common: dict[str, Any] = {"env": env_id, "scenes": name, "n_scenes": config.n_scenes}
    common["time_decisions"] = name == "test"
    if config.only == "everything":
        for row in evaluate(load_agent(env_id), **common, **settings).rows:
            yield _numbers(env_id, name, row["method"], row)
    short = env_id.removeprefix("viapoint/").removesuffix("-v0")
    if config.only in ("everything", "reaches"):
        yield from reaches_of(config, short, common)
    if config.only in ("everything", "looking") and task.sensor is not None and task.space.of_hand:
        for when, decide_at in LOOKING.items():
            kwargs = {"sensor": "hand_rays", "decide_at": decide_at}
            searches = ["thick:search512", "known:search512"]
            for row in evaluate(**common, env_kwargs=kwargs, baselines=searches).rows:
                yield _numbers(LOOKS, name, f"{row['method']}, {when}", row)
    if config.only in ("looking", "reaches"):
        return
    for folder in sorted(config.runs.glob(f"{short}-*")):
        run = Run(folder)
        method = f"{run.config.algorithm.upper()}, {run.curve[-1]['decisions']:,} decisions"
        if run.config.algorithm == "viarank":  # with another belief
            method = f"{folder.name.rpartition('-')[2]}:agent"
        row = evaluate(load_agent(folder), **common, baselines=[]).rows[0]
        yield _numbers(env_id, name, method, row)


def reaches_of(config: Config, short: str, common: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the numbers of each method among obstacles on reaches of their own, in scenes that are drawn."""
    for interval in INTERVALS.get(short, ()):
        kwargs = {"courses": "reaches", "horizon": interval}
        rows = evaluate(**common, env_kwargs=kwargs, baselines=("straight", *PREDICTIONS)).rows
        for folder in sorted(config.reaches.glob(f"{short}-*")):
            seed = folder.name.rpartition("-")[2]
            baselines = ["untrained"] if seed == "0" else []
            for row in evaluate(load_agent(folder), **common, env_kwargs=kwargs, baselines=baselines).rows:
                rows.append({**row, "method": row["method"].replace("agent", f"agent, seed {seed}")})
        for row in rows:
            yield _numbers(f"{short}, reaches", "test", f"{row['method']}, every {interval} s", row)


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


def write_page(rows: list[dict[str, Any]]) -> None:
    """Put the tables into the page: each follows the heading of its task, up to the next empty line after it."""
    text = PAGE.read_text(encoding="utf-8")
    for env_id in dict.fromkeys(row["env"] for row in rows):
        heading = f"### {env_id.removeprefix('viapoint/').removesuffix('-v0')}\n\n"
        before, found, after = text.partition(heading)
        if not found:
            continue  # tasks without obstacles are not on the page
        mine = [row for row in rows if row["env"] == env_id]
        if env_id in SHIPPED_IDS:  # in the file only
            mine = [row for row in mine if not row["method"].startswith("untrained, ")]
        _, _, rest = after.partition("\n\n")  # after the old table
        text = f"{before}{heading}{table(mine)}\n\n{rest}"
    PAGE.write_text(text, encoding="utf-8")


def main() -> None:
    """Measure, and write the file and the tables of the page after each task."""
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
        order = [*SHIPPED_IDS, LOOKS, *REACHES]
        every = sorted(kept + found, key=lambda row: order.index(row["env"]))
        with config.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, FIELDS)
            writer.writeheader()
            writer.writerows(every)
        write_page(every)
        print(f"{env_id} is measured", flush=True)


if __name__ == "__main__":
    main()
