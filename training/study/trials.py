"""Trials of a study: what one worker trains and measures, its record, and the tables of all records."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from viapoint.training.agents.model_io import load_model, untrained
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.evaluation.statistics import across_seeds, wilson
from viapoint.training.io.files import read_json, write_bytes, write_json
from viapoint.training.planning.baselines import Method, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.plotting.plots import success_of_rows
from viapoint.training.rollouts.rollout import whole_task
from viapoint.training.runs.trainer import train_or_resume
from viapoint.training.scene_sets.scene_set import FrozenScenes, scenes_for
from viapoint.training.study.config import Study, Trial

Record = dict[str, Any]
KEYS = ["environment", "set", "method"]
# Columns that are medians over seeds; `decisions` are those of a training
MEDIANS = ["collision", "jerk_ratio", "movement_s", "decision_ms", "decisions"]
COLUMNS = [*KEYS, "seeds", "scenes", "success", "low", "high", *MEDIANS]  # Of `results.csv`
NOTE = (
    "Success with 95 % intervals. Jerk of successes, relative to the straight movement's. Median time of a decision on "
    "the cores of one trial. Written by `viapoint study`."
)


def run_trial(trial: Trial, out: Path) -> Record:
    """Train if needed, or go on with an interrupted training, measure, and return the record of a trial."""
    record: Record = {"viapoint": "study", "asked": _asked(trial)}
    env_kwargs, decisions = dict(trial.env_kwargs), None
    methods: dict[str, Method] = {}
    if trial.method:
        methods[trial.row] = make_method(trial.method, trial.env_id, **env_kwargs, threads=1)
    else:
        config = trial.config(out)
        run = train_or_resume(config)
        models: dict[str, Any] = {trial.row: load_model(run.best)}
        if trial.untrained:
            models[f"{trial.row}/untrained"] = untrained(models[trial.row], trial.seed)
        for name, model in models.items():
            for checks in trial.checks:
                methods[f"{name}/{checks}" if checks else name] = agent_method("agent", model, checks)
            for refine in trial.refine:
                methods[f"{name}/refine{refine}"] = agent_method("agent", model, 0, refine)
        env_kwargs, decisions = whole_task(config.env, config.env_kwargs), run.decisions
        record["curve"] = [[each["decisions"], each["success"]["rate"]] for each in run.curve]
        record["seconds"] = run.curve[-1]["seconds"] if run.curve else None
    record["rows"] = []
    env_kwargs["threads"] = 1  # other trials have the other cores
    for row, method in methods.items():
        for name, frozen in _sets(trial).items():
            line = {"method": row, "set": name, **_measured(method, frozen, trial.env_id, env_kwargs)}
            if decisions is not None:
                line["decisions"] = 0 if "/untrained" in row else decisions
            record["rows"].append(line)
    write_json(trial.folder(out) / "result.json", record)
    return record


def finished_record(trial: Trial, out: Path) -> Record | None:
    """Return the record of a trial that is complete, or None; a record of other settings is obsolete."""
    path = trial.folder(out) / "result.json"
    if not path.is_file():
        return None
    record = read_json(path)
    return record if record.get("asked") == _asked(trial) else None


def write_results(study: Study, folder: Path) -> pd.DataFrame:
    """Write `results.csv`, `results.md` and a figure for each environment from all records, and return the table."""
    lines = []
    curves: dict[str, dict[str, list[Any]]] = {}
    for trial in study.trials:
        record = finished_record(trial, folder) or {"rows": []}
        lines += [{"environment": trial.environment, **line} for line in record["rows"]]
        if "curve" in record:
            of_rows = curves.setdefault(trial.environment, {})
            of_rows.setdefault(trial.row, []).append(record["curve"])
    table = _table(lines)
    write_bytes(folder / "results.csv", table.to_csv(index=False).encode())
    write_bytes(folder / "results.md", markdown(table, study.name).encode())
    for environment, part in table.groupby("environment", sort=False):
        figure = folder / f"{environment.rpartition('/')[2]}.png"
        success_of_rows(figure, part, curves.get(environment, {}))
    return table


def _table(lines: list[Record]) -> pd.DataFrame:
    """Return one line for each environment, set of scenes and row, over all its seeds."""
    rows = []
    for keys, runs in pd.DataFrame(lines, columns=[*COLUMNS, "solved", "band"]).groupby(KEYS, sort=False):
        solved = np.array([[bit == "1" for bit in each] for each in runs["solved"]], dtype=float)
        if len(runs) == 1:
            success, low, high = wilson(int(solved.sum()), solved.size)
        else:
            band = np.array(runs["band"].iloc[0])
            success, low, high = across_seeds(solved, band, np.random.default_rng(0))
        row = dict(zip(KEYS, keys, strict=True))
        row |= {"seeds": len(runs), "scenes": solved.shape[1], "success": success, "low": low, "high": high}
        rows.append({**row, **runs[MEDIANS].astype(float).median()})
    return pd.DataFrame(rows, columns=COLUMNS).round(4)


def markdown(table: pd.DataFrame, title: str) -> str:
    """Return a page with one table for each environment: sets of scenes side by side, success in percent."""
    parts = [f"# {title}", NOTE]
    for environment, lines in table.groupby("environment", sort=False):
        rows = lines.drop_duplicates("method").set_index("method")
        shown = rows[["seeds"]].copy()
        for name, some in lines.groupby("set", sort=False):
            percent = (100.0 * some.set_index("method")[["success", "low", "high"]]).map("{:.1f}".format)
            shown[name] = percent["success"] + " % (" + percent["low"] + "-" + percent["high"] + ")"
        shown["jerk"] = rows["jerk_ratio"].map("{:.2f}".format, na_action="ignore")
        shown["decision ms"] = rows["decision_ms"].map("{:.1f}".format, na_action="ignore")
        text = shown.fillna("-").reset_index().to_markdown(index=False, disable_numparse=True)
        parts += [f"## {environment}", text]
    return "\n\n".join(parts) + "\n"


def _asked(trial: Trial) -> Record:
    """Return what identifies a trial as plain values."""
    values = dataclasses.asdict(trial)
    values["scenes"] = {name: frozen.sha256 for name, frozen in _sets(trial).items()}
    plain: Record = json.loads(json.dumps(values))
    return plain


def _sets(trial: Trial) -> dict[str, FrozenScenes]:
    """Return the sets of scenes of a trial by name."""
    task = registered_task(trial.env_id, **trial.env_kwargs)
    found = {}
    for name in trial.scenes:
        found[Path(name).stem] = scenes_for(name, task, trial.n_scenes)
    return found


def _measured(method: Method, frozen: FrozenScenes, env_id: str, env_kwargs: Record) -> Record:
    """Return what a line of a table says about a method in a set of scenes."""
    (result,) = evaluate_methods([method], frozen, env_id, env_kwargs=env_kwargs).results
    if result.interrupted:
        raise KeyboardInterrupt
    summary = result.summary()
    seconds = summary["decision_time"]
    return {
        "band": result.band.tolist(),
        "solved": "".join("01"[solved] for solved in result.success.astype(int)),
        "collision": summary["collision"]["rate"],
        "jerk_ratio": summary["jerk_ratio"],
        "movement_s": summary["duration"],
        "decision_ms": None if seconds is None else 1e3 * seconds,
    }
