"""Trials of a study: what one worker trains and measures, and the record that it leaves in `result.json`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from viapoint.training.agents.model_io import load_model, untrained
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planning.baselines import Method, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollouts.rollout import whole_task
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import train_or_resume
from viapoint.training.scene_sets.scene_set import FrozenScenes, scenes_for
from viapoint.training.study.config import Environment, Trial, Values

Record = dict[str, Any]


def run_trial(trial: Trial, out: Path) -> Record:
    """Train if needed, measure, and return the record of a trial.

    A training that is complete is not repeated, and one that was interrupted goes on from its last checkpoint.

    Args:
        trial: Trial of a study.
        out: Folder of the study.

    Raises:
        ValueError: The folder holds a training with other settings, or the training cannot be made.
    """
    record: Record = {"viapoint": "study", "asked": asked(trial)}
    if trial.method:
        method = make_method(trial.method, trial.env.id, **trial.env.env_kwargs, threads=1)
        record["rows"] = measured(trial, {"": method}, trial.env.env_kwargs)
    else:
        config = trial.config(out)
        run = train_or_resume(config)
        model: Any = load_model(run.best)
        methods = {_suffix(checks): agent_method("agent", model, checks) for checks in trial.checks}
        if trial.untrained:
            other = untrained(model, trial.seed)
            for checks in trial.checks:
                methods[f"/untrained{_suffix(checks)}"] = agent_method("untrained", other, checks)
        record["rows"] = measured(trial, methods, whole_task(config.env, config.env_kwargs))
        record["curve"] = [[each["decisions"], each["success"]["rate"]] for each in run.curve]
        record["seconds"] = run.curve[-1]["seconds"] if run.curve else None
        for line in record["rows"]:
            line["decisions"] = 0 if "/untrained" in line["method"] else run.decisions
    write_json(trial.folder(out) / "result.json", record)
    return record


def asked(trial: Trial) -> Record:
    """Return what identifies a trial as plain values; a record of anything else is obsolete."""
    values = dataclasses.asdict(trial)
    del values["resources"]
    values["env"]["scenes"] = {Path(name).stem: frozen.sha256 for name, frozen in _sets(trial.env).items()}
    plain: Record = json.loads(json.dumps(values))
    return plain


def finished_record(trial: Trial, out: Path) -> Record | None:
    """Return the record of a trial that is complete, or None."""
    path = trial.folder(out) / "result.json"
    if not path.is_file():
        return None
    record = read_json(path)
    return record if record.get("asked") == asked(trial) else None


class ReportCallback(BaseCallback):
    """Callback that reports the validations of a run, each once, to a function that may raise to end the training."""

    def __init__(self, folder: Path, report: Callable[[Record], None]) -> None:
        super().__init__()
        self.folder, self.report = folder, report
        self._reported = 0

    def _on_rollout_start(self) -> None:
        curve = Run(self.folder).curve
        for each in curve[self._reported :]:
            if each["decisions"]:  # the validation before training says nothing about it
                self.report({"success": each["success"]["rate"], "decisions": each["decisions"]})
        self._reported = len(curve)

    def _on_step(self) -> bool:
        return True


def measured(trial: Trial, methods: Mapping[str, Method], env_kwargs: Values) -> list[Record]:
    """Return one line for each method, by the end of its row's name, and each set of scenes."""
    kwargs = {**env_kwargs, "threads": int(trial.resources["cpu"])}  # other trials have the other cores
    lines: list[Record] = []
    for suffix, method in methods.items():
        for name, frozen in _sets(trial.env).items():
            (result,) = evaluate_methods([method], frozen, trial.env.id, env_kwargs=kwargs).results
            if result.interrupted:
                raise KeyboardInterrupt
            summary = result.summary()
            milliseconds = None if summary["decision_time"] is None else 1e3 * summary["decision_time"]
            line = {"method": trial.row + suffix, "set": Path(name).stem, "band": result.band.tolist()}
            line |= {"solved": "".join("01"[solved] for solved in result.success.astype(int))}
            line |= {"collision": summary["collision"]["rate"], "jerk_ratio": summary["jerk_ratio"]}
            lines.append({**line, "movement_s": summary["duration"], "decision_ms": milliseconds})
    return lines


def _sets(env: Environment) -> dict[str, FrozenScenes]:
    """Return the sets of scenes of an environment."""
    task, found = registered_task(env.id, **env.env_kwargs), {}
    for name in env.scenes:
        found[name] = scenes_for(name, task, env.n_scenes).take(slice(0, env.n_scenes))
    return found


def _suffix(checks: int) -> str:
    """Return the end of the name of a row with a number of checks."""
    return f"/{checks}" if checks else ""
