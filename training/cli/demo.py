"""Command `demo`: train an agent, evaluate it, and write table, figures and a video to one folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.training.agents.agent import Agent, find_model, load_agent
from viapoint.training.agents.model_io import untrained
from viapoint.training.config.configs import DemoConfig, TrainConfig
from viapoint.training.evaluation import report
from viapoint.training.evaluation.evaluator import evaluate_methods, evenly_spread
from viapoint.training.io.files import BadFileError, check_ours, read_json
from viapoint.training.planning.baselines import Method, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.plotting import plots
from viapoint.training.plotting.gallery import Entry, gallery, play
from viapoint.training.plotting.video import record_video
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import train
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes, scenes_for

BASELINES = ("search16", "search512", "straight", "random")
FILES = (
    "table.md",
    "table.json",
    "learning_curve.png",
    "success_by_band.png",
    "gallery.png",
    "movements.mp4",
)
"""Files besides those of the run."""
PICTURES = 12
"""Number of movements in the gallery."""
MOVEMENTS = 4
"""Number of movements in the video."""


def run(config: DemoConfig) -> None:
    """Train and evaluate an agent, write figures and a video, and print the table and the paths.

    Existing results in the folder are kept, so a second call only prints them, and an interrupted call continues.
    """
    began = time.monotonic()
    folder = config.out
    for name in FILES:
        check_ours(folder / name)
    trained = _trained(config)
    model_folder = find_model(folder)
    agent = load_agent(model_folder)
    frozen = scenes_for("test", registered_task(config.env), config.n_scenes)
    frozen = frozen.take(evenly_spread(len(frozen.share), config.n_scenes))
    record = _measured(config, agent, frozen)
    heading = f"The agent alone in {frozen.name} scenes, easy to hard"
    files: dict[str, tuple[str, Callable[[Path], Any] | None]] = {
        "table.md": ("the table", None),
        "table.json": ("the table with every outcome", None),
        "learning_curve.png": (
            "success during training",
            lambda path: plots.learning_curve(path, trained.curve),
        ),
        "success_by_band.png": ("success by difficulty", lambda path: plots.success_by_band(path, record)),
        "gallery.png": (
            "test scenes, planned and executed",
            lambda path: gallery(path, entries(agent, frozen, PICTURES), heading=heading),
        ),
        "movements.mp4": ("movements", lambda path: _film(path, agent, frozen)),
        model_folder.name: ("the trained agent", None),
    }
    weights = model_folder / "weights.safetensors"
    for name, (_, draw) in files.items():
        path = folder / name
        if draw and (not path.exists() or path.stat().st_mtime < weights.stat().st_mtime):
            draw(path)
    report.show(record)
    for name, (what, _) in files.items():
        print(f"  {folder / name!s:<34} {what}")
    print(f"done in {time.monotonic() - began:.0f} s")


def entries(agent: Agent, frozen: FrozenScenes, count: int) -> list[Entry]:
    """Return the agent's movements in scenes of all difficulties for the gallery."""
    by_difficulty = np.argsort(-frozen.share, kind="stable")
    chosen = frozen.take(by_difficulty[evenly_spread(len(by_difficulty), count)])
    titles = [f"share {BANDS[band]}" for band in chosen.band]
    decide = agent_method("agent", agent, 0).decide
    return play(agent.env_id, chosen.scenes, titles, decide, **agent.env_kwargs)


def _trained(config: DemoConfig) -> Run:
    """Return the completed run in the folder, trained now if necessary."""
    asked = TrainConfig(env=config.env, seed=config.seed, n_timesteps=config.total_timesteps, out=config.out)
    if not (config.out / "config.json").exists():
        print(f"training for {asked.total_timesteps} decisions; Ctrl-C saves, and the same command goes on")
        return train(asked)
    found = Run(config.out)
    for name in ("env", "seed"):
        if getattr(found.config, name) != getattr(config, name):
            raise BadFileError(
                config.out,
                f"holds a run with {name} {getattr(found.config, name)!r}, not {getattr(config, name)!r}; "
                "name another folder with --out",
            )
    done = found.decisions
    if done >= (config.n_timesteps or found.config.total_timesteps):
        print(f"{config.out} holds an agent trained for {done} decisions: starting from it")
        return found
    print(f"{config.out} holds a training stopped after {done} decisions: going on with it")
    return train(TrainConfig(env=config.env, n_timesteps=config.n_timesteps, out=config.out, resume=True))


def _measured(config: DemoConfig, agent: Agent, frozen: FrozenScenes) -> dict[str, Any]:
    """Return the evaluation of the agent, from the folder if it holds one for these weights and scenes."""
    path = config.out / "table.json"
    identity = {
        "sha256": frozen.sha256,
        "weights_sha256": read_json(find_model(config.out) / "model.json")["weights_sha256"],
        "checks": config.checks,
    }
    if path.exists():
        record = read_json(path)
        if not record.get("partial") and {name: record.get(name) for name in identity} == identity:
            print(f"{path} holds its evaluation: starting from it")
            return record
    methods: list[Method] = [
        agent_method("agent", agent, 0),
        agent_method(f"agent, {config.checks} checks", agent, config.checks),
        agent_method("untrained", untrained(agent), 0),
        *(make_method(name, config.env) for name in BASELINES),
    ]
    with report.progress_bar() as progress:
        result = evaluate_methods(methods, frozen, config.env, progress=progress)
    record = {**result.to_dict(), **identity}
    report.write(record, config.out)
    if result.partial:
        raise KeyboardInterrupt
    return record


def _film(path: Path, agent: Agent, frozen: FrozenScenes) -> None:
    env = gym.make(agent.env_id, render_mode="rgb_array_list", **agent.env_kwargs)
    scenes = frozen.scenes.take(evenly_spread(len(frozen.share), MOVEMENTS))
    record_video(path, env, scenes, agent_method("agent", agent, 0).decide)
    env.close()
