"""What `viapoint train`, `evaluate` and `play` do."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm.auto import tqdm

from viapoint.envs.registration import ONLINE_TASKS
from viapoint.training.config.configs import EvaluateConfig, PlayConfig, TrainConfig
from viapoint.training.evaluation import report
from viapoint.training.evaluation.evaluator import evaluate as measure
from viapoint.training.io.files import write_json
from viapoint.training.planners.baselines import Method, check_method, make_method
from viapoint.training.planners.replanning_baselines import OpenLoopBaseline
from viapoint.training.plotting.failure_report import sort_out, write
from viapoint.training.rollouts.rollout import OnlineTrial
from viapoint.training.rollouts.step_rollout import is_step_wise, whole_task
from viapoint.training.runs import trainer as training
from viapoint.training.runs.agents import Agent, load_agent
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import SETS, FrozenScenes, scenes_for


class EvaluationStoppedError(Exception):
    """An evaluation was stopped by Ctrl-C; what it had finished is written and marked as partial."""

    exit_code = 130
    """As shells count an end by Ctrl-C."""


def train(config: TrainConfig) -> None:
    """Train, and say where everything is."""
    if config.resume:
        run = Run(config.folder)
        what = f"{run.config.algo} on {run.config.env}, seed {run.config.seed},"
        print(f"going on with {what} after {run.decisions} decisions")
    run = training.train(config)
    last = run.curve[-1] if run.curve else None
    reached = f", success {100.0 * last['success']['rate']:.1f} % on validation scenes" if last else ""
    print(f"trained for {run.config.total_timesteps} decisions{reached}: {run.folder}")


def evaluate(config: EvaluateConfig) -> None:
    """Measure, print the table, and write the results."""
    agent = load_agent(config.run, config.pretrained) if config.run or config.pretrained else None
    env_id, env_kwargs = _task_of(config, agent)
    whole = scenes_for(config.scenes, env_id, env_kwargs)
    frozen = whole.take(slice(0, config.n_scenes))
    methods = _methods(config, agent, env_id, env_kwargs)
    with progress_bar(methods, len(frozen.share)) as progress, training.one_thread():
        result = measure(methods, frozen, env_id, env_kwargs=env_kwargs, progress=progress)
    record = result.as_json()
    report.show(record)
    if config.run is not None and (config.run / "config.json").is_file():
        name = _kept_as(config.scenes, whole, len(frozen.share), partial=result.partial)
        print(f"kept as {Run(config.run).write_evaluation(name, record)}")
    if config.json is not None:
        config.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(config.json, record)
        print(f"results, scene by scene: {config.json}")
    if result.partial:
        raise EvaluationStoppedError("stopped: the results are partial")
    if config.failures is not None and agent is not None:
        last = [each for each in result.results if each.name.startswith("agent")][-1]
        done = frozen.take(slice(0, len(last.success)))
        failures = sort_out(last, done, agent.model, env_id, **env_kwargs)
        write(failures, config.failures, env_id, **env_kwargs)
        print(f"{len(failures.rows)} failures by kind: {config.failures}")


def _kept_as(scenes: str, whole: FrozenScenes, number: int, *, partial: bool) -> str:
    """A name for an evaluation in some scenes that replaces none in other ones, and no whole one by a part."""
    name = Path(scenes).stem + ("" if scenes in SETS else f".{whole.sha256[:8]}")
    name += "" if number == len(whole.share) else f".first-{number}"
    return name + (".partial" if partial else "")


def _task_of(config: EvaluateConfig, agent: Agent | None) -> tuple[str, dict[str, Any]]:
    """Id and arguments of the environment to measure in.

    Raises:
        ValueError: The agent is for another one than was named, or what was asked for cannot be had there.
    """
    mine = agent.env_id if agent else str(config.env)
    env_id, env_kwargs = whole_task(mine, agent.env_kwargs if agent else {})
    if config.env not in (None, mine, env_id):
        raise ValueError(
            f"env must be {mine}, on which the agent of {config.run or config.pretrained} was trained, or be left "
            f"out, got {config.env!r}"
        )
    if config.failures is not None and (is_step_wise(mine) or env_id in ONLINE_TASKS):
        raise ValueError(f"failures are sorted where one action is a whole movement; in {mine} it is not")
    for name in config.methods:
        check_method(name, env_id)
    return env_id, env_kwargs


def _methods(
    config: EvaluateConfig, agent: Agent | None, env_id: str, env_kwargs: Mapping[str, Any]
) -> list[Method]:
    """What is measured, in the order in which it was named."""
    methods: list[Method] = []
    for name in config.methods:
        if name == "unrevised" and agent:
            methods.append(OpenLoopBaseline(agent.method(), OnlineTrial(env_id, **env_kwargs)))
        elif name not in ("agent", "untrained"):
            methods.append(make_method(name, env_id, **env_kwargs))
        elif agent:
            methods += [getattr(agent, "method" if name == "agent" else name)(n) for n in config.checks]
    return methods


def play(config: PlayConfig) -> None:
    """Film an agent's movements."""
    from viapoint.training.plotting.video import film

    agent = load_agent(config.run, config.pretrained)
    scenes = scenes_for(config.scenes, *whole_task(agent.env_id, agent.env_kwargs)).scenes
    rows = spread(len(scenes.start), config.n_scenes)
    env = gym.make(agent.env_id, render_mode="rgb_array_list", **agent.env_kwargs)
    method = agent.method(config.checks)
    config.video.parent.mkdir(parents=True, exist_ok=True)
    film(config.video, env, scenes.take(rows), method.decide, name=method.name)
    env.close()
    print(f"{len(rows)} movements: {config.video}")


def spread(number: int, count: int) -> Any:
    """At most `count` indices, evenly spread over `number`."""
    return np.unique(np.linspace(0, number - 1, min(count, number)).round().astype(int))


@contextmanager
def progress_bar(methods: Sequence[Method], scenes: int) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar over methods and scenes."""
    with tqdm(total=scenes * len(methods), unit=" scenes", file=sys.stderr, dynamic_ncols=True) as bar:

        def progress(name: str, done: int, total: int) -> None:
            bar.set_description(name)
            bar.update(done - (bar.n % total))

        yield progress
