"""Report on a hyperparameter search: trials, importance of parameters, pruned trials, and the best settings."""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import optuna
from matplotlib.figure import Figure
from optuna.trial import FrozenTrial, TrialState

from viapoint.training.config.configs import TrainConfig, TuneConfig
from viapoint.training.io.files import write_bytes, write_json
from viapoint.training.io.installed import versions
from viapoint.training.io.template import load_template, packaged
from viapoint.training.plotting.plots import style_axes
from viapoint.training.runs.callback import validation_scenes
from viapoint.training.runs.run_dir import Run
from viapoint.training.study.search_space import ATTEMPTS, ERROR, SearchSpace, plain
from viapoint.training.study.tuning import Tuning

SHOWN = 10
"""Greatest number of trials in the table."""
FEWEST = 4
"""Least number of finished trials for which the importance of parameters is estimated."""


def run(config: TuneConfig) -> None:
    """Search for hyperparameters, and write the report: the command `tune`."""
    search = SearchSpace.read(config.file)
    trials = config.trials or search.trials
    tuning = Tuning.create(config.folder, search)
    print(f"{config.folder}: {tuning.finished} of {trials} trials are finished", flush=True)
    try:
        tuning.work(trials, on=config.on, workers=config.workers, told=lambda line: print(line, flush=True))
    finally:
        if tuning.finished:
            print(f"report: {write_report(tuning)}")
    best = tuning.best
    if best is not None:
        print(f"best, trial {best.number}: {best_training(tuning, best).command}")


def write_report(tuning: Tuning) -> Path:
    """Write `report.md`, `trials.json`, `curves.png` and, if a trial is finished, `best.json`; return the first."""
    best = tuning.best
    if best is not None:
        write_json(tuning.folder / "best.json", best_training(tuning, best).as_json())
    write_json(tuning.folder / "trials.json", {"trials": [_record(each) for each in tuning.trials]})
    draw_curves(tuning, tuning.folder / "curves.png")
    path = tuning.folder / "report.md"
    write_bytes(path, report(tuning).encode())
    return path


def _record(trial: FrozenTrial) -> dict[str, Any]:
    """Return a trial as plain values."""
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "parameters": {name: plain(value) for name, value in trial.params.items()},
        "scores": trial.user_attrs.get("scores", []),
        "validation": {str(step): rate for step, rate in sorted(trial.intermediate_values.items())},
        "seconds": round(trial.duration.total_seconds(), 1) if trial.duration else None,
        **({"error": trial.user_attrs[ERROR]} if ERROR in trial.user_attrs else {}),
    }


def best_training(tuning: Tuning, best: FrozenTrial) -> TrainConfig:
    """Return the configuration of the best trial, as `viapoint train` uses it."""
    return tuning.search.training(best.params, tuning.search.seeds[0], progress=True)


def report(tuning: Tuning) -> str:
    """Return the report as Markdown."""
    search, trials = tuning.search, tuning.trials
    folders = [tuning.folder / tuning.folder_of(each) / f"seed-{search.seeds[0]}" for each in trials]
    first = next((each for each in folders if (each / "config.json").is_file()), None)
    using = {**versions(), "optuna": optuna.__version__}
    template = load_template(packaged("study/templates/tuning.md.j2"), filters={"shown": _shown})
    return template.render(
        search=search,
        finished=sum(each.state == TrialState.COMPLETE for each in trials),
        pruned=Counter(each.last_step or 0 for each in trials if each.state == TrialState.PRUNED),
        failed=[each for each in trials if ERROR in each.user_attrs],
        repeated=[each for each in trials if ATTEMPTS in each.user_attrs],
        scenes=None if first is None else validation_scenes(Run(first)),
        best=tuning.ranked[:SHOWN],
        importance=importance(tuning),
        command=best_training(tuning, tuning.best).command if tuning.best is not None else "",
        versions=", ".join(f"{name} {version}" for name, version in using.items()),
    )


def importance(tuning: Tuning) -> dict[str, float]:
    """Return the importance of each parameter by PED-ANOVA, with sum 1; empty where there are too few trials."""
    if len(tuning.ranked) < FEWEST or len({each.value for each in tuning.ranked}) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return optuna.importance.get_param_importances(tuning.study, evaluator=evaluator)


def _shown(value: Any) -> str:
    value = plain(value)
    return f"{value:.3g}" if isinstance(value, float) else f"{value}"


def draw_curves(tuning: Tuning, path: Path) -> None:
    """Draw the success rate of every trial in validation against decisions."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    best = tuning.best
    styles = {
        TrialState.COMPLETE: ("#9aa5b1", "-", "finished"), TrialState.PRUNED: ("#d9822b", "--", "pruned"),
    }  # fmt: skip
    for each in sorted(tuning.trials, key=lambda trial: trial == best):
        if each.state not in styles or not each.intermediate_values:
            continue
        color, line, label = styles[each.state]
        if best is not None and each.number == best.number:
            color, label = "#1f5fa8", f"best (trial {each.number})"
        steps, rates = zip(*sorted(each.intermediate_values.items()), strict=True)
        axes.plot(steps, [100.0 * rate for rate in rates], line, color=color, label=label, marker=".")
    axes.set(xlabel="decisions", ylabel="success in validation [%]")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if handles:
        axes.legend(handles.values(), handles.keys(), frameon=False)
    style_axes(axes)
    figure.savefig(path, dpi=110)
