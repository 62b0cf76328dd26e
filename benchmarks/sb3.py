"""Train algorithms of Stable-Baselines3 on the tasks with obstacles, for some minutes on one core each.

python benchmarks/sb3.py --minutes 30 --jobs 2     # trains into runs/sb3; an interrupted training begins again
python benchmarks/results.py --only runs           # adds their rows to the tables of results.md

The learning curves go to docs/sb3_curves.csv and docs/images/sb3_curves.png.
"""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib.style
import tyro
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback

from viapoint.training import TrainConfig, train
from viapoint.training.files import write_figure
from viapoint.training.plots import COLUMN, METHOD_STYLES, STYLE, style_axes

TASKS = (
    "PlanarObstacles",
    "PlanarWholeArm",
    "PandaObstacles",
    "PlanarMovingObstacles",
    "PandaMovingObstacles",
    "PlanarSensed",
    "PandaSensed",
)
ALGORITHMS = "sac", "tqc", "ppo"
CURVES, PICTURE = Path("docs/sb3_curves.csv"), Path("docs/images/sb3_curves.png")


@dataclass(frozen=True, kw_only=True)
class Config:
    """Train SAC, TQC and PPO with `SceneExtractor` and the settings of their presets."""

    minutes: float = 30.0
    """Length of each training."""
    task: tuple[str, ...] = TASKS
    """Names of tasks."""
    algo: tuple[str, ...] = ALGORITHMS
    """Names of algorithms."""
    seed: int = 0
    """Seed of the trainings."""
    jobs: int = 2
    """Trainings at a time."""
    out: Path = Path("runs/sb3")
    """Folder of the runs."""


class StopAfter(BaseCallback):
    """Callback that ends a training after some seconds."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.end = time.monotonic() + seconds

    def _on_step(self) -> bool:
        return time.monotonic() < self.end


def train_one(config: Config, task: str, algo: str) -> None:
    """Train one algorithm on one task, unless its run has ended."""
    folder = config.out / f"{task}-{algo}-{config.seed}"
    if (folder / "final").is_dir():
        return
    shutil.rmtree(folder, ignore_errors=True)
    settings: Any = {"env": f"viapoint/{task}-v0", "algo": algo, "seed": config.seed, "out": folder}
    often = 10_000 if algo == "ppo" else 2_000
    unlimited = TrainConfig(**settings, n_timesteps=10**7, eval_every=often, eval_scenes=100, progress=False)
    train(unlimited, StopAfter(60.0 * config.minutes))
    print(f"{folder} has ended", flush=True)


def curves_of(folder: Path) -> list[dict[str, Any]]:
    """Return the learning curves of all runs as rows, with those in CURVES of other trainings."""
    rows: list[dict[str, Any]] = []
    for path in sorted(folder.glob("*/learning_curve.jsonl")):
        task, algo, seed = path.parent.name.split("-")
        if algo not in ALGORITHMS:  # other trainings that benchmarks/results.py measures
            continue
        for line in path.read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            row = {"task": task, "algo": algo, "seed": seed, "decisions": record["decisions"]}
            row["success"] = round(100.0 * record["success"]["rate"], 1)
            rows.append({**row, "seconds": round(record["seconds"])})
    measured = {_training(row) for row in rows}
    with CURVES.open(newline="", encoding="utf-8") as file:
        kept = [row for row in csv.DictReader(file) if _training(row) not in measured]
    return sorted(kept + rows, key=_training)


def _training(row: dict[str, Any]) -> tuple[str, str, str]:
    """Return task, algorithm and seed of a row."""
    return row["task"], row["algo"], row["seed"]


def draw(rows: list[dict[str, Any]]) -> None:
    """Draw success on the validation scenes against decisions, a panel for each task."""
    tasks = [name for name in TASKS if any(row["task"] == name for row in rows)]
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(COLUMN / 2.54, 14.0 / 2.54))
        panels = figure.subplots(4, 2, sharey=True).flat
        for task, panel in zip(tasks, panels, strict=False):
            for algo in ALGORITHMS:
                mine = [row for row in rows if row["task"] == task and row["algo"] == algo]
                decisions = [float(row["decisions"]) / 1000.0 for row in mine]
                success = [float(row["success"]) for row in mine]
                style = {**METHOD_STYLES[algo], "markersize": 2.5}
                panel.plot(decisions, success, label=algo.upper(), **style)
            panel.set_title(task)
            panel.set(ylim=(-4.0, 100.0), yticks=[0, 50, 100])
            style_axes(panel)
        for empty in panels:  # what is left holds the legend
            empty.axis("off")
            empty.legend(*panel.get_legend_handles_labels(), loc="center")
        figure.supxlabel("decisions [1,000]")
        figure.supylabel("success on validation scenes [%]")
        write_figure(PICTURE, figure)


def main() -> None:
    """Train, and write the curves and their picture."""
    config = tyro.cli(Config)
    pairs = list(itertools.product(config.task, config.algo))
    with ProcessPoolExecutor(config.jobs, mp_context=get_context("spawn")) as pool:
        trainings = [pool.submit(train_one, config, task, algo) for task, algo in pairs]
        for training in trainings:
            training.result()
    rows = curves_of(config.out)
    with CURVES.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    draw(rows)


if __name__ == "__main__":
    main()
