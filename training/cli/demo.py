"""Command `demo`: train an agent, evaluate it, and write table, figures and a video to one folder."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from viapoint.envs.renderer import GLUnavailableError
from viapoint.training import report
from viapoint.training.agents.agent import Agent, load_agent
from viapoint.training.agents.model_io import untrained
from viapoint.training.configs import DemoConfig, TrainConfig
from viapoint.training.evaluation import evaluate
from viapoint.training.files import check_ours, read_json
from viapoint.training.planning.baselines import agent_method
from viapoint.training.planning.search import registered_task
from viapoint.training.plots import success_of_rows
from viapoint.training.report import scene_progress
from viapoint.training.runs import Run
from viapoint.training.scene_sets import BANDS, FrozenScenes, scenes_for
from viapoint.training.trainer import train_or_resume
from viapoint.training.video import gallery, record_video

CHECKS = 16  # Proposals that the agent checks in the second row of the table
BASELINES = ("search16", "search512", "straight", "random")
# Files besides those of the run, and what they show
FILES = {
    "table.md": "the table",
    "table.json": "the table with every outcome",
    "success.png": "success by difficulty, and during training",
    "gallery.png": "test scenes, planned and executed",
    "movements.mp4": "movements",
}
PICTURES = 12  # Number of movements in the gallery
MOVEMENTS = 4  # Number of movements in the video


def run(config: DemoConfig) -> None:
    """Train and evaluate an agent, write figures and a video, and print the table and the paths.

    Existing results in the folder are kept, so a second call only prints them, and an interrupted call continues.
    """
    began = time.monotonic()
    folder = config.out
    for name in FILES:
        check_ours(folder / name)
    trained = _trained(config)
    agent = load_agent(trained.best)
    frozen = scenes_for("test", registered_task(config.env), config.n_scenes)
    weights = read_json(trained.best / "model.json")["weights_sha256"]
    record = read_json(folder / "table.json") if (folder / "table.json").exists() else {}
    if (record.get("sha256"), record.get("weights_sha256")) != (frozen.sha256, weights):
        record = {**_measured(agent, frozen), "weights_sha256": weights}
        report.write(record, folder)
        _draw_success(folder / "success.png", record, trained)
        (folder / "movements.mp4").unlink(missing_ok=True)  # they are of another agent
    if not (folder / "movements.mp4").exists():
        try:
            _show_movements(folder, agent, frozen)
        except GLUnavailableError as error:
            print(f"movements are not shown: {error}", file=sys.stderr)
    print(report.text(record))
    for name, what in {**FILES, trained.best.name: "the trained agent"}.items():
        if (folder / name).exists():
            print(f"  {folder / name!s:<34} {what}")
    print(f"done in {time.monotonic() - began:.0f} s")


def _trained(config: DemoConfig) -> Run:
    """Return the completed run in the folder, trained now if necessary."""
    if (config.out / "config.json").is_file():
        found = Run(config.out)
        if found.config.env != config.env:
            raise ValueError(
                f"{config.out} holds a demo of {found.config.env}; name another folder with --out"
            )
        number = config.n_timesteps or found.config.total_timesteps
        print(f"{config.out} holds a training of {found.decisions} decisions: starting from it")
    else:
        number = config.n_timesteps or TrainConfig(env=config.env).total_timesteps // 4
        print(f"training for {number} decisions; Ctrl-C saves, and the same command goes on")
    return train_or_resume(TrainConfig(env=config.env, n_timesteps=number, out=config.out))


def _measured(agent: Agent, frozen: FrozenScenes) -> dict[str, Any]:
    """Return the evaluation of the agent and of methods without training."""
    others = (agent_method("untrained", untrained(agent), 0), *BASELINES)
    with scene_progress() as progress:
        result = evaluate(agent, scenes=frozen, checks=(0, CHECKS), baselines=others, progress=progress)
    if result.partial:
        raise KeyboardInterrupt
    return result.to_dict()


def _draw_success(path: Path, record: Mapping[str, Any], trained: Run) -> None:
    """Draw success by the difficulty of the scenes, and success during training."""
    rows = []
    for method, summary in record["methods"].items():
        for band, found in summary["success_by_band"].items():
            rows.append({"method": method, "set": band, "success": found["rate"], **found})
    curve = [[each["decisions"], each["success"]["rate"]] for each in trained.curve]
    success_of_rows(path, pd.DataFrame(rows), {"agent": [curve]}, "random plans that solve the scene")


def _show_movements(folder: Path, agent: Agent, frozen: FrozenScenes) -> None:
    """Draw and film movements in scenes of all difficulties."""
    decide = agent_method("agent", agent, 0).decide
    chosen = frozen.take(np.argsort(-frozen.share, kind="stable")).spread(PICTURES)
    titles = [f"share {BANDS[band]}" for band in chosen.band]
    heading = f"The agent alone in {frozen.name} scenes, easy to hard"
    if registered_task(agent.env_id, **agent.env_kwargs).hand_alone:
        heading += "; only the hand must clear the obstacles, links may cross them"
    env = gym.make(agent.env_id, render_mode="rgb_array", **agent.env_kwargs)
    gallery(folder / "gallery.png", env, chosen.scenes, decide, titles, heading)
    env.close()
    env = gym.make(agent.env_id, render_mode="rgb_array_list", **agent.env_kwargs)
    record_video(folder / "movements.mp4", env, frozen.spread(MOVEMENTS).scenes, decide)
    env.close()
