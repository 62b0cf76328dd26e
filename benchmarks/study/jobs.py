"""Jobs of the study: trainings, evaluations, baselines and timings, each stored in a file and done once."""

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
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planners.baselines import SEARCHES, Method, agent_method, make_method
from viapoint.training.plotting.failure_report import classify_failures
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import one_thread, resolved, train
from viapoint.training.scene_sets.scene_set import FrozenScenes, load

STORED_OUTCOMES = ("is_success", "collision", "jerk_ratio", "duration")
"""Outcomes that are stored for every scene."""
IDENTIFYING = ("env", "algo", "seed", "n_timesteps", "n_envs", "env_kwargs", "hyperparameters")
"""Fields of the configuration that must agree for a run to be of this study."""
N_PLANNED = 200
"""Number of scenes that the planner searches anew for each action space."""
N_TIMED = 100
"""Number of scenes in which decisions are timed."""
ALONE, CHECKED, UNTRAINED = "alone", "checked", "untrained"
"""Decision modes: the network alone, checked proposals, and checked proposals of the untrained network."""
WAYS = {ALONE: "policy alone", CHECKED: "checked proposals", UNTRAINED: "untrained, checked proposals"}
"""Names of the decision modes in tables."""


class Job(NamedTuple):
    """Job for this process or another one."""

    label: str
    run: Callable[..., str]
    arguments: tuple[Any, ...]
    is_done: Callable[..., bool]

    def done(self) -> bool:
        """Return whether the job is done; running it again then only reports the result."""
        try:
            return self.is_done(*self.arguments)
        except (ValueError, OSError):
            return False  # running the job reports the error


def all_jobs(study: Study) -> list[Job]:
    """Return all jobs except the timing; each job skips what is done."""
    found = []
    if {"train", "evaluate"} & set(study.only):
        found += [Job(str(cell), train_and_evaluate, (cell, study), is_complete) for cell in study.cells()]
    if "baselines" in study.only:
        if "results" in study.tables:
            found += [
                Job(f"{short(env)} {name}", baseline, (env, name, study), has_baseline)
                for env in study.environments
                for name in study.baselines
            ]
        if "freedom" in study.tables:
            found += [
                Job(
                    f"{short(env)} planner {variant.name}",
                    plan_with_freedom,
                    (env, variant, study),
                    has_planned,
                )
                for env in study.studied
                for variant in FREEDOM
            ]
    return found


def is_complete(cell: Cell, study: Study) -> bool:
    """Return whether the requested steps of a training are done, or cannot be done."""
    status = state(cell, study)
    if status != "trained":
        return status not in ("absent", "unfinished")
    model = Run(cell.folder(study)).best
    return "evaluate" not in study.only or all(
        stored(evaluation_path(cell, name, study), identity_of(scenes(name, cell.env, study), model, study))
        for name in sets_of(cell.env)
    )


def has_baseline(env: str, name: str, study: Study) -> bool:
    """Return whether a baseline is measured on every set."""
    return all(
        stored(baseline_path(env, each, name, study), {"scenes": scenes(each, env, study).sha256})
        for each in sets_of(env)
    )


def has_planned(env: str, variant: Variant, study: Study) -> bool:
    """Return whether the planner is measured with an action space."""
    frozen = scenes("test", env, study).take(slice(0, N_PLANNED))
    return stored(planned_path(env, variant, study), {"scenes": frozen.sha256}) is not None


def train_and_evaluate(cell: Cell, study: Study) -> str:
    """Train and evaluate as requested and not done yet; return a summary."""
    status = state(cell, study)
    if status not in ("absent", "unfinished", "trained"):
        raise ValueError(f"{cell.folder(study)} {status}")
    if "train" in study.only and status != "trained":
        again = TrainConfig(out=cell.folder(study), resume=True, progress=False)
        run = train(cell.training(study) if status == "absent" else again)
        write_json(run.folder / "cores.json", {"cores": cores(), "of": os.cpu_count()})
        status = "trained"
    if "evaluate" in study.only and status == "trained":
        rates = [f"{name} {_rates(agent_evaluation(cell, name, study))}" for name in sets_of(cell.env)]
        return "; ".join(rates)
    return status


def state(cell: Cell, study: Study) -> str:
    """Return `absent`, `unfinished`, `trained`, or the reason why the cell cannot be trained."""
    try:
        config = cell.training(study)
    except ValueError as error:
        return str(error)
    if not (config.folder / "config.json").is_file():
        return "absent"
    run = Run(config.folder)
    asked, found = (json.loads(json.dumps(each.as_json())) for each in (resolved(config), run.config))
    other = [name for name in IDENTIFYING if asked[name] != found[name]]
    if other:
        return f"was trained with other settings ({', '.join(other)}): move it away or name another --out"
    finished = run.decisions >= run.config.total_timesteps and (run.folder / "final").is_dir()
    return "trained" if finished else "unfinished"


def agent_evaluation(cell: Cell, name: str, study: Study) -> dict[str, Any]:
    """Return the evaluation of a trained agent on a set, from its file if that is of this agent and these scenes."""
    run, frozen = Run(cell.folder(study)), scenes(name, cell.env, study)
    identity = identity_of(frozen, run.best, study)
    path = evaluation_path(cell, name, study)
    found = stored(path, identity)
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
    """Return model and number of checks of each decision mode of an agent."""
    found = {ALONE: (model, 0)}
    if hasattr(model.policy, "checks"):
        found |= {CHECKED: (model, study.checks), UNTRAINED: (untrained(model), study.checks)}
    return found


def identity_of(frozen: FrozenScenes, model: Path, study: Study) -> dict[str, Any]:
    """Return the entries that identify an evaluation: scenes, weights and number of checks."""
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
        record = stored(path, {"scenes": frozen.sha256})
        if record is None:
            if name == "stored":
                method = StoredSolutions(frozen)
            elif method is None:
                method = make_method(name, env)
            record = _measure_baseline(method, frozen, env, path, {})
        rates.append(f"{each} {_rates(record)}")
    return "; ".join(rates)


def plan_with_freedom(env: str, variant: Variant, study: Study) -> str:
    """Measure the planner with an action space, in the first test scenes."""
    frozen = scenes("test", env, study).take(slice(0, N_PLANNED))
    path, kwargs = planned_path(env, variant, study), dict(variant.env_kwargs)
    record = stored(path, {"scenes": frozen.sha256})
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
    """Evaluate methods in all scenes; an interrupted evaluation raises KeyboardInterrupt and stores nothing."""
    with one_thread():
        results = evaluate_methods(methods, frozen, env, env_kwargs=kwargs, time_decisions=timed).results
    if any(each.interrupted for each in results):
        raise KeyboardInterrupt
    return results


def time_decisions(study: Study) -> str:
    """Time single decisions of one agent of each algorithm, on one thread and without other jobs."""
    for env in study.environments:
        frozen = scenes("test", env, study).take(slice(0, N_TIMED))
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
    """Return name, source and factory of each timed method; a changed source makes a time obsolete."""
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
    """Return a set of scenes, or its first `n_scenes`."""
    return load(name, env).take(slice(0, study.n_scenes))


def evaluation_path(cell: Cell, name: str, study: Study) -> Path:
    """Return the file of an agent's evaluation on a set."""
    return cell.folder(study) / "evaluations" / f"study-{name}.json"


def baseline_path(env: str, set_name: str, name: str, study: Study) -> Path:
    """Return the file of a baseline's evaluation."""
    return study.out / short(env) / "baselines" / f"{set_name}-{name}.json"


def planned_path(env: str, variant: Variant, study: Study) -> Path:
    """Return the file of the planner's evaluation with an action space."""
    return study.out / short(env) / "planner" / f"{variant.name}.json"


def timings_path(env: str, study: Study) -> Path:
    """Return the file of decision times."""
    return study.out / short(env) / "timings.json"


def compact(result: MethodResult) -> dict[str, Any]:
    """Return the metrics of a result and its outcomes in every scene."""
    outcomes = {
        name: np.round(np.asarray(result.outcomes[name], float), 6).tolist() for name in STORED_OUTCOMES
    }
    return {"summary": result.summary(), "outcomes": outcomes}


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def stored(path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """Return the record in a file, or None if there is none with this identity."""
    if not path.is_file():
        return None
    record = read_json(path)
    return record if {name: record.get(name) for name in identity} == identity else None


def _rates(record: dict[str, Any]) -> str:
    each = record["methods"].items()
    return ", ".join(f"{name} {100 * one['summary']['success']['rate']:.1f} %" for name, one in each)


def rate_table(records: Sequence[dict[str, Any]], method: str, outcome: str) -> np.ndarray:
    """Return an outcome in every scene, shape (records, scenes)."""
    return np.array([record["methods"][method]["outcomes"][outcome] for record in records], dtype=float)
