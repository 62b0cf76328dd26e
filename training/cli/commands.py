"""Commands `train`, `evaluate` and `play`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from viapoint.training.agents.agent import load_agent
from viapoint.training.config.configs import (
    USUAL_BASELINES,
    EvaluateConfig,
    PlayConfig,
    TrainConfig,
    env_of_arm,
)
from viapoint.training.evaluation import report
from viapoint.training.evaluation.evaluator import check_baselines, environment_of, evenly_spread
from viapoint.training.evaluation.evaluator import evaluate as measure
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planning import benchmark_report
from viapoint.training.planning.baselines import agent_method, make_method
from viapoint.training.planning.benchmark import benchmark_problems, read_problems
from viapoint.training.planning.search import registered_task
from viapoint.training.runs import trainer as training
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import NUMBERS, SETS, FrozenScenes, scenes_for


class EvaluationStoppedError(Exception):
    """An evaluation was stopped by Ctrl-C; what it had finished is written and marked as partial."""

    exit_code = 130
    """Exit code of shells for Ctrl-C."""


def train(config: TrainConfig) -> None:
    """Train, and print where the run is."""
    if config.resume:
        run = Run(config.folder)
        what = f"{run.config.algo} on {run.config.env}, seed {run.config.seed},"
        print(f"going on with {what} after {run.decisions} decisions")
    run = training.train(config)
    last = run.curve[-1] if run.curve else None
    reached = f", success {100.0 * last['success']['rate']:.1f} % on validation scenes" if last else ""
    stalled = run.stopped == "stalled"
    number = run.decisions if stalled else run.config.total_timesteps
    print(f"trained for {number} decisions{' until it stalled' * stalled}{reached}: {run.folder}")


def evaluate(config: EvaluateConfig) -> None:
    """Evaluate, print the table, and write the results."""
    if config.of_planners:
        _measure_planners(config)
        return
    agent = None if config.agent is None else load_agent(config.agent)
    run = (
        Run(str(config.agent))
        if config.agent and (Path(config.agent).expanduser() / "config.json").is_file()
        else None
    )
    env, argument = config.env, None
    if config.arm is not None:
        own = agent.env_id if agent is not None else config.env
        env, argument = env_of_arm(config.arm, own)
        argument = {**(agent.env_kwargs if agent is not None else {}), **argument}
    env_id, env_kwargs = environment_of(agent, env, argument)
    task = registered_task(env_id, **env_kwargs)
    check_baselines(config.baselines, agent, task)
    whole = scenes_for(config.scenes, task, config.n_scenes)
    scenes = whole.take(evenly_spread(len(whole.share), config.n_scenes))
    with report.progress_bar() as progress:
        given: Any = {"checks": config.checks, "baselines": config.baselines, "progress": progress}
        result = measure(agent, env=env, env_kwargs=argument, scenes=scenes, **given)
    record = result.to_dict()
    report.show(record)
    if run is not None:
        record["weights_sha256"] = read_json(run.best / "model.json").get("weights_sha256")
        name = _evaluation_name(config.scenes, whole, len(scenes.share), partial=result.partial)
        print(f"kept as {run.write_evaluation(name, record)}")
    if config.json is not None:
        write_json(config.json, record)
        print(f"results, scene by scene: {config.json}")
    if result.partial:
        raise EvaluationStoppedError("stopped: the results are partial")


def _measure_planners(config: EvaluateConfig) -> None:
    """Measure planners on the problems of MotionBenchMaker, print the table, and write one line for each problem."""
    problems = benchmark_problems() if config.problems is None else read_problems(config.problems)
    problems = [problems[row] for row in evenly_spread(len(problems), config.n_scenes)]
    names = ("plan_motion",) if config.baselines == USUAL_BASELINES else config.baselines
    for name in names:
        benchmark_report.benchmark_planner(name)  # an unknown name is told before anything is measured
    with report.progress_bar() as progress:
        lines = [benchmark_report.measure_planner(name, problems, progress=progress) for name in names]
    print(f"{benchmark_report.markdown(pd.concat(lines))}\n\n{benchmark_report.NOTES}")
    if config.json is not None:
        write_json(config.json, pd.concat(lines).to_dict("records"))
        print(f"results, problem by problem: {config.json}")


def _evaluation_name(scenes: str, whole: FrozenScenes, number: int, *, partial: bool) -> str:
    """Return a file name that is unique to the scenes of an evaluation and to their number."""
    name = Path(scenes).stem + ("" if scenes in SETS else f".{whole.sha256[:8]}")
    is_drawn = bool(np.isnan(whole.share).any())  # no more of them than are asked for
    every = NUMBERS[scenes] if is_drawn and scenes in NUMBERS else len(whole.share)
    name += "" if number == every else f".first-{number}"
    return name + (".partial" if partial else "")


def play(config: PlayConfig) -> None:
    """Record a video of the movements of an agent, or of the geometry search."""
    from viapoint.training.plotting.video import record_video

    agent = None if config.agent is None else load_agent(config.agent)
    env_id, argument = env_of_arm(config.arm, agent.env_id if agent is not None else None)
    assert env_id is not None
    env_kwargs = {**(agent.env_kwargs if agent is not None else {}), **argument}
    scenes = scenes_for(config.scenes, registered_task(env_id, **env_kwargs), config.n_scenes).scenes
    rows = evenly_spread(len(scenes.start), config.n_scenes)
    env = gym.make(env_id, render_mode="rgb_array_list", **env_kwargs)
    if agent is None:
        method = make_method("search512", env_id, **env_kwargs)
    else:
        name = f"agent, {config.checks} checks" if config.checks else "agent"
        method = agent_method(name, agent, config.checks)
    config.video.parent.mkdir(parents=True, exist_ok=True)
    record_video(config.video, env, scenes.take(rows), method.decide, name=method.name)
    env.close()
    print(f"{len(rows)} movements: {config.video}")
