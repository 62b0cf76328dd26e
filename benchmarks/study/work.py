"""The work: trainings, evaluations, baselines and timings, each kept in a file and done once."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from study.plan import FREEDOM, Cell, Study, Variant, sets_of, short
from viapoint.training.algorithms.model_io import load_model, untrained
from viapoint.training.cli.demo import StoredSolutions
from viapoint.training.config.configs import TrainConfig
from viapoint.training.evaluation.evaluator import MethodResult, evaluate_methods
from viapoint.training.io.config_json import as_json
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planners.baselines import SEARCHES, Method, agent_method, make_method
from viapoint.training.plotting.failure_report import classify_failures
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import one_thread, resolved, train
from viapoint.training.scene_sets.scene_set import FrozenScenes, load

KEPT = ("is_success", "collision", "jerk_ratio", "duration")
"""Outcomes that are kept scene by scene."""
SAME = ("env", "algo", "seed", "n_timesteps", "n_envs", "env_kwargs", "hyperparameters")
"""What must be the same in two configurations for their runs to be the same."""
PLANNED = 200
"""Scenes that the planner solves anew for each degree of freedom."""
TIMED = 100
"""Scenes of the timing."""
ALONE, CHECKED, UNTRAINED = "alone", "checked", "untrained"
"""Ways to decide: by the network alone, by checks of its proposals, and by checks of those of the untrained network."""
WAYS = {
    ALONE: "policy alone",
    CHECKED: "checked proposals",
    UNTRAINED: "untrained, checked proposals",
}
"""Names of these in tables."""


class Job(NamedTuple):
    """Something to do, in this process or in another one."""

    label: str
    work: Callable[..., str]
    arguments: tuple[Any, ...]
    is_done: Callable[..., bool]

    def done(self) -> bool:
        """Whether it has been done before, so that doing it again only tells how it went."""
        try:
            return self.is_done(*self.arguments)
        except (ValueError, OSError):
            return False  # the work itself will say what is wrong


def jobs(study: Study) -> list[Job]:
    """What there is to do, but for timing; the work itself sees what is done already."""
    found = []
    if {"train", "evaluate"} & set(study.only):
        found += [Job(str(cell), complete, (cell, study), completed) for cell in study.cells()]
    if "baselines" in study.only:
        if "results" in study.tables:
            found += [
                Job(f"{short(env)} {name}", baseline, (env, name, study), has_baseline)
                for env in study.environments
                for name in study.baselines
            ]
        if "freedom" in study.tables:
            found += [
                Job(f"{short(env)} planner {variant.name}", planned, (env, variant, study), has_planned)
                for env in study.studied
                for variant in FREEDOM
            ]
    return found


def completed(cell: Cell, study: Study) -> bool:
    """Whether a training and its evaluations are done, as far as they are asked for, or cannot be done."""
    there = state(cell, study)
    if there != "trained":
        return there not in ("absent", "unfinished")
    model = Run(cell.folder(study)).best
    return "evaluate" not in study.only or all(
        kept(evaluation_path(cell, name, study), identity_of(scenes(name, cell.env, study), model, study))
        for name in sets_of(cell.env)
    )


def has_baseline(env: str, name: str, study: Study) -> bool:
    """Whether a baseline is measured on every set."""
    return all(
        kept(baseline_path(env, each, name, study), {"scenes": scenes(each, env, study).sha256})
        for each in sets_of(env)
    )


def has_planned(env: str, variant: Variant, study: Study) -> bool:
    """Whether the planner is measured with a degree of freedom."""
    frozen = scenes("test", env, study).take(slice(0, PLANNED))
    return kept(planned_path(env, variant, study), {"scenes": frozen.sha256}) is not None


def complete(cell: Cell, study: Study) -> str:
    """Train and measure, as far as it is asked for and not done; says how it went."""
    done = state(cell, study)
    if done not in ("absent", "unfinished", "trained"):
        raise ValueError(f"{cell.folder(study)} {done}")
    if "train" in study.only and done != "trained":
        again = TrainConfig(out=cell.folder(study), resume=True, progress=False)
        run = train(cell.training(study) if done == "absent" else again)
        write_json(run.folder / "cores.json", {"cores": cores(), "of": os.cpu_count()})
        done = "trained"
    if "evaluate" in study.only and done == "trained":
        rates = [f"{name} {_rates(measured(cell, name, study))}" for name in sets_of(cell.env)]
        return "; ".join(rates)
    return done


def state(cell: Cell, study: Study) -> str:
    """`absent`, `unfinished`, `trained`, or in words what is in the way."""
    try:
        config = cell.training(study)
    except ValueError as error:
        return str(error)
    if not (config.folder / "config.json").is_file():
        return "absent"
    run = Run(config.folder)
    asked, found = (json.loads(json.dumps(as_json(each))) for each in (resolved(config), run.config))
    other = [name for name in SAME if asked[name] != found[name]]
    if other:
        return f"was trained with other settings ({', '.join(other)}): move it away or name another --out"
    finished = run.decisions >= run.config.total_timesteps and (run.folder / "final").is_dir()
    return "trained" if finished else "unfinished"


def measured(cell: Cell, name: str, study: Study) -> dict[str, Any]:
    """The evaluation of a trained agent on a set, from its file where it is of this agent and these scenes."""
    run, frozen = Run(cell.folder(study)), scenes(name, cell.env, study)
    identity = identity_of(frozen, run.best, study)
    path = evaluation_path(cell, name, study)
    found = kept(path, identity)
    if found is not None:
        return found
    model: Any = load_model(run.best)
    methods = [agent_method(way, agent, checks) for way, (agent, checks) in agents(model, study).items()]
    kwargs = dict(cell.variant.env_kwargs)
    results = _results(methods, frozen, cell.env, kwargs)
    with one_thread():
        failures = {
            each.name: classify_failures(each, frozen, model, cell.env, **kwargs).counts()
            for each in results
            if each.name != UNTRAINED and hasattr(model.policy, "checks")
        }
    record = {**identity, "methods": {each.name: compact(each) for each in results}, "failures": failures}
    run.write_evaluation(path.stem, record)
    return record


def agents(model: Any, study: Study) -> dict[str, tuple[Any, int]]:
    """Return the ways in which an agent is measured: model and number of checks."""
    found = {ALONE: (model, 0)}
    if hasattr(model.policy, "checks"):
        found |= {CHECKED: (model, study.checks), UNTRAINED: (untrained(model), study.checks)}
    return found


def identity_of(frozen: FrozenScenes, model: Path, study: Study) -> dict[str, Any]:
    """What an evaluation must say to be of this agent and these scenes."""
    return {
        "scenes": frozen.sha256,
        "weights": hashlib.sha256((model / "weights.safetensors").read_bytes()).hexdigest(),
        "checks": study.checks,
    }


def baseline(env: str, name: str, study: Study) -> str:
    """Measure a baseline on every set of an environment."""
    method: Method | None = None
    rates = []
    for each in sets_of(env):
        frozen, path = scenes(each, env, study), baseline_path(env, each, name, study)
        record = kept(path, {"scenes": frozen.sha256})
        if record is None:
            if name == "stored":
                method = StoredSolutions(frozen)
            elif method is None:
                method = make_method(name, env)
            record = _measure_baseline(method, frozen, env, path, {})
        rates.append(f"{each} {_rates(record)}")
    return "; ".join(rates)


def planned(env: str, variant: Variant, study: Study) -> str:
    """Let the planner search with a degree of freedom, in the first test scenes."""
    frozen = scenes("test", env, study).take(slice(0, PLANNED))
    path, kwargs = planned_path(env, variant, study), dict(variant.env_kwargs)
    record = kept(path, {"scenes": frozen.sha256})
    if record is None:
        record = _measure_baseline(make_method("planner", env, **kwargs), frozen, env, path, kwargs)
    return _rates(record)


def _measure_baseline(
    method: Method, frozen: FrozenScenes, env: str, path: Path, kwargs: dict[str, Any]
) -> dict[str, Any]:
    (result,) = _results([method], frozen, env, kwargs)
    record = {"scenes": frozen.sha256, "methods": {method.name: compact(result)}}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, record)
    return record


def _results(
    methods: Sequence[Method], frozen: FrozenScenes, env: str, kwargs: dict[str, Any], timed: bool = False
) -> tuple[MethodResult, ...]:
    """What came of each method in all scenes; where it was interrupted, nothing is kept."""
    with one_thread():
        results = evaluate_methods(methods, frozen, env, env_kwargs=kwargs, time_decisions=timed).results
    if any(each.interrupted for each in results):
        raise KeyboardInterrupt
    return results


def time_decisions(study: Study) -> str:
    """Time single decisions of one agent of each algorithm, on one thread, with nothing else at work here."""
    for env in study.environments:
        frozen = scenes("test", env, study).take(slice(0, TIMED))
        path = timings_path(env, study)
        times: dict[str, Any] = read_json(path) if path.is_file() else {}
        for name, source, method in _to_time(env, study):
            if times.get(name, {}).get("source") == source:
                continue
            (result,) = _results([method()], frozen, env, {"threads": 1}, timed=True)
            times[name] = {"source": source, "median": float(np.median(result.decision_times))}
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, times)
    return "decisions timed"


def _to_time(env: str, study: Study) -> list[tuple[str, str, Callable[[], Method]]]:
    """Name, what it depends on, and the method."""
    found: list[tuple[str, str, Callable[[], Method]]] = [
        (name, name, lambda name=name: make_method(name, env, threads=1))  # type: ignore[misc]
        for name in ("random16", "random80", *SEARCHES, "planner", "ompl")
        if name in study.baselines or (name == "planner" and "stored" in study.baselines)
    ]
    for variant in study.variants("results", env):
        cells = [Cell(env=env, variant=variant, seed=seed) for seed in study.seeds]
        first = next((cell for cell in cells if state(cell, study) == "trained"), None)
        if first is None:
            continue
        folder = Run(first.folder(study)).best
        model: Any = load_model(folder)
        source = identity_of(scenes("test", env, study), folder, study)["weights"]
        for way, (agent, checks) in agents(model, study).items():
            method = lambda way=way, agent=agent, checks=checks: agent_method(way, agent, checks)  # noqa: E731
            found.append((f"{variant.name} {way}", f"{source} {checks}", method))
    return found


def scenes(name: str, env: str, study: Study) -> FrozenScenes:
    """A set of scenes, or its first ones."""
    return load(name, env).take(slice(0, study.n_scenes))


def evaluation_path(cell: Cell, name: str, study: Study) -> Path:
    """Of an agent's evaluation on a set."""
    return cell.folder(study) / "evaluations" / f"study-{name}.json"


def baseline_path(env: str, set_name: str, name: str, study: Study) -> Path:
    """Of a baseline's evaluation."""
    return study.out / short(env) / "baselines" / f"{set_name}-{name}.json"


def planned_path(env: str, variant: Variant, study: Study) -> Path:
    """Of the planner's evaluation with a degree of freedom."""
    return study.out / short(env) / "planner" / f"{variant.name}.json"


def timings_path(env: str, study: Study) -> Path:
    """Of the times of single decisions."""
    return study.out / short(env) / "timings.json"


def compact(result: MethodResult) -> dict[str, Any]:
    """The metrics, and the outcomes that the tables are made of."""
    outcomes = {name: np.round(np.asarray(result.outcomes[name], float), 6).tolist() for name in KEPT}
    return {"summary": result.summary(), "outcomes": outcomes}


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def kept(path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """The record in a file, None where there is none of this identity."""
    if not path.is_file():
        return None
    record = read_json(path)
    return record if {name: record.get(name) for name in identity} == identity else None


def _rates(record: dict[str, Any]) -> str:
    each = record["methods"].items()
    return ", ".join(f"{name} {100 * one['summary']['success']['rate']:.1f} %" for name, one in each)


def rate_table(records: Sequence[dict[str, Any]], method: str, outcome: str) -> np.ndarray:
    """An outcome scene by scene, shape (records, scenes)."""
    return np.array([record["methods"][method]["outcomes"][outcome] for record in records], dtype=float)
