"""Jobs of a study: trainings with their evaluations, and baselines. Each leaves files, and does nothing twice.

A measurement names what it is of: the hash of the scenes, and the hash of the weights or the settings of the method.
One of anything else is made again.

OUT/<environment>/<agent>/seed-<n>/                         run folder
OUT/<environment>/<agent>/seed-<n>/evaluations/<set>.<mode>.json
OUT/<environment>/baselines/<name>/<set>.json
OUT/<environment>/timings.json                              decision times
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viapoint.envs.worker_env import n_cores
from viapoint.training.algorithms.model_io import load_model, untrained
from viapoint.training.config.configs import TrainConfig
from viapoint.training.evaluation.evaluator import evaluate_methods, one_thread
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planners.baselines import (
    Method,
    RandomOrder,
    StoredSolutions,
    agent_method,
    make_method,
    refined_search,
)
from viapoint.training.planners.replanning_baselines import OpenLoopBaseline
from viapoint.training.rollouts.rollout import EpisodeSimulation, new_simulation
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import resolved, train
from viapoint.training.scene_sets.scene_set import FrozenScenes, scenes_for
from viapoint.training.search.geometry_search import GeometrySearch
from viapoint.training.study.config import Agent, Baseline, Environment, Mode, Study
from viapoint.training.study.runners import Job

STORED_OUTCOMES = ("is_success", "collision", "jerk_ratio", "duration")
"""Outcomes that are stored for every scene."""
IDENTIFYING = ("env", "algo", "seed", "n_timesteps", "n_envs", "env_kwargs", "hyperparameters")
"""Fields of a configuration that must agree for a run to be of the study, besides those that the study names."""
PACE = ("eval_every", "checkpoint_every", "rollout_workers", "on")
"""Fields of a configuration that may differ."""

Sets = Mapping[str, FrozenScenes]
Record = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Training of a study."""

    env: Environment
    agent: Agent
    seed: int

    def __str__(self) -> str:
        return f"{self.env.folder} {self.agent.name} seed {self.seed}"

    @property
    def folder(self) -> str:
        """Folder of the run, below that of the study."""
        return f"{self.env.folder}/{self.agent.name}/seed-{self.seed}"

    def training(self, root: Path) -> TrainConfig:
        """Return the configuration of the training."""
        return self.agent.config(self.env, self.seed, root / self.folder)


def cells_of(agent: Agent, env: Environment) -> list[Cell]:
    """Return the trainings of an agent in an environment."""
    return [Cell(env=env, agent=agent, seed=seed) for seed in agent.seeds]


def trained(study: Study, env: Environment, agent: Agent) -> list[Cell]:
    """Return the trainings of an agent that have ended."""
    return [cell for cell in cells_of(agent, env) if state(cell, study.out) == "trained"]


def training_jobs(study: Study, steps: Sequence[str]) -> Iterator[Job]:
    """Yield a job for each training of which something is missing, by seed: every table has its first seed early."""
    every = [
        cell
        for agent in study.agents
        for name in agent.environments
        for cell in cells_of(agent, study.environment(name))
    ]
    for cell in sorted(every, key=lambda cell: cell.seed):
        if is_complete(cell, study.out, steps):
            continue
        yield Job(
            label=str(cell),
            function=train_and_evaluate,
            arguments=(cell, tuple(steps), sets_of(cell.env)),
            folder=cell.folder,
            cpus=cell.agent.cpus,
            resources=cell.agent.resources,
        )


def baseline_jobs(study: Study, *, of_equal_time: bool) -> Iterator[Job]:
    """Yield a job for each baseline of which a measurement is missing: searches of equal time, or all others."""
    pairs = [(each, study.environment(name)) for each in study.baselines for name in each.environments]
    for each, env in pairs:
        baseline = with_checks(study, env, each)
        if baseline is None or (each.time_of is not None) is not of_equal_time:
            continue
        sets = sets_of(env, baseline)
        if all(baseline_record(study, baseline, env, name, each) for name, each in sets.items()):
            continue
        yield Job(
            label=f"{env.folder} {baseline.name}",
            function=measure_baseline,
            arguments=(baseline, env, sets),
            folder=f"{env.folder}/baselines/{baseline.name}",
        )


def with_checks(study: Study, env: Environment, baseline: Baseline) -> Baseline | None:
    """Return a baseline with its number of checks; None for a search of equal time that has not been timed."""
    if baseline.time_of is None:
        return baseline
    checks = times_of(study, env).get(baseline.name, {}).get("checks")
    return None if checks is None else dataclasses.replace(baseline, checks=checks)


def is_complete(cell: Cell, root: Path, steps: Sequence[str]) -> bool:
    """Return whether the steps of a training are done."""
    try:
        if state(cell, root) != "trained":
            return False
        model = Run(root / cell.folder).best
        return "evaluate" not in steps or all(
            stored(root / cell.folder / evaluation_path(name, mode), identity_of(frozen, model, mode))
            for name, frozen in sets_of(cell.env).items()
            for mode in cell.agent.modes(cell.env.id)
        )
    except (ValueError, OSError):
        return False  # running the job reports the error


def train_and_evaluate(root: Path, cell: Cell, steps: Sequence[str], sets: Sets) -> str:
    """Train if needed, measure each decision mode on each set if needed, and return a summary.

    Raises:
        ValueError: The folder holds a training with other settings, or the training cannot be made.
    """
    status = state(cell, root)
    config = cell.training(root)
    if status not in ("absent", "unfinished", "trained"):
        raise ValueError(f"{config.folder} {status}")
    if "train" in steps and status != "trained":
        resume = TrainConfig(out=config.folder, resume=True, progress=False)
        run = train(config if status == "absent" else resume)
        write_json(run.folder / "cores.json", {"cores": n_cores(), "of": os.cpu_count()})
        status = "trained"
    if "evaluate" not in steps or status != "trained":
        return status
    rates = []
    for name, frozen in sets.items():
        found = agent_evaluations(root, cell, name, frozen)
        rates.append(", ".join([name, *(f"{mode} {percent(record)}" for mode, record in found.items())]))
    return "; ".join(rates)


def state(cell: Cell, root: Path) -> str:
    """Return `absent`, `unfinished`, `trained`, or the reason why the cell cannot be trained."""
    config = cell.training(root)
    if not (config.folder / "config.json").is_file():
        return "absent"
    run = Run(config.folder)
    asked, found = (json.loads(json.dumps(each.as_json())) for each in (resolved(config), run.config))
    named = [name for name in cell.agent.training if name not in PACE]
    other = [name for name in dict.fromkeys([*IDENTIFYING, *named]) if asked[name] != found[name]]
    if other:
        return f"was trained with other settings ({', '.join(other)}): move it away, or give the study another folder"
    ended = run.decisions >= run.config.total_timesteps or run.stopped is not None
    return "trained" if ended and run.final.is_dir() else "unfinished"


def agent_evaluations(root: Path, cell: Cell, name: str, frozen: FrozenScenes) -> dict[str, Record]:
    """Return the measurements of each decision mode of a trained agent on a set, made where they are missing."""
    run = Run(root / cell.folder)
    kwargs = dict(cell.training(root).env_kwargs)
    found, model = {}, None
    for mode in cell.agent.modes(cell.env.id):
        path, wanted = run.folder / evaluation_path(name, mode), identity_of(frozen, run.best, mode)
        record = stored(path, wanted)
        if record is None:
            model = load_model(run.best) if model is None else model
            method = method_of_mode(mode, model, cell.env, kwargs, cell.seed)
            record = wanted | measure(method, frozen, cell.env, kwargs)
            write_json(path, record)
        found[mode.name] = record
    return found


def measure_baseline(root: Path, baseline: Baseline, env: Environment, sets: Sets) -> str:
    """Measure a baseline on each set where that is missing, and return a summary."""
    rates, method = [], None
    for name, frozen in sets.items():
        path, wanted = root / path_of(baseline, env, name), identity(baseline, env, frozen)
        record = stored(path, wanted)
        if record is None:
            if method is None or baseline.method == "stored":
                method = method_of(baseline, env, frozen)
            kwargs = {**env.env_kwargs, **baseline.env_kwargs}
            record = wanted | measure(method, frozen, env, kwargs)
            write_json(path, record)
        rates.append(f"{name} {percent(record)}")
    return "; ".join(rates)


def baseline_record(
    study: Study, baseline: Baseline, env: Environment, name: str, frozen: FrozenScenes
) -> Record | None:
    """Return the stored measurement of a baseline on a set, or None."""
    return stored(study.out / path_of(baseline, env, name), identity(baseline, env, frozen))


def measure(method: Method, frozen: FrozenScenes, env: Environment, kwargs: Mapping[str, Any]) -> Record:
    """Return the metrics of a method and its outcomes in every scene; nothing if it was interrupted."""
    with one_thread():
        evaluation = evaluate_methods([method], frozen, env.id, env_kwargs=kwargs, time_decisions=False)
    (result,) = evaluation.results
    if result.interrupted:
        raise KeyboardInterrupt
    outcomes = {
        name: np.round(np.asarray(result.outcomes[name], float), 6).tolist() for name in STORED_OUTCOMES
    }
    return {"method": result.name, "summary": result.summary(), "outcomes": outcomes}


def sets_of(env: Environment, baseline: Baseline | None = None) -> dict[str, FrozenScenes]:
    """Return the sets of scenes of an environment, or those of a baseline, by name."""
    chosen = env.scenes if baseline is None or baseline.scenes is None else baseline.scenes
    n_scenes = env.n_scenes if baseline is None or baseline.n_scenes is None else baseline.n_scenes
    kwargs = json.dumps(dict(env.env_kwargs), sort_keys=True)
    return {Path(name).stem: _loaded(name, env.id, kwargs).take(slice(0, n_scenes)) for name in chosen}


@functools.lru_cache(maxsize=64)
def _loaded(name: str, env_id: str, kwargs: str) -> FrozenScenes:
    return scenes_for(name, env_id, json.loads(kwargs))


@functools.lru_cache(maxsize=256)
def _hash_of_file(path: Path, time: int, size: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def weights_hash(model: Path) -> str:
    """Return the SHA-256 of the weights of a model folder."""
    weights = model / "weights.safetensors"
    state = weights.stat()
    return _hash_of_file(weights, state.st_mtime_ns, state.st_size)


def identity_of(frozen: FrozenScenes, model: Path, mode: Mode) -> Record:
    """Return the entries that identify the evaluation of an agent."""
    return {"scenes": frozen.sha256, "weights": weights_hash(model), "mode": mode.name}


def identity(baseline: Baseline, env: Environment, frozen: FrozenScenes) -> Record:
    """Return the entries that identify the measurement of a baseline."""
    made = {"method": baseline.method, "checks": baseline.checks}
    return {
        "scenes": frozen.sha256,
        "made": {**made, "env_kwargs": {**env.env_kwargs, **baseline.env_kwargs}},
    }


def evaluation_path(name: str, mode: Mode) -> str:
    """Return the file of an agent's evaluation on a set, below its run folder."""
    return f"evaluations/{name}.{mode.name}.json"


def path_of(baseline: Baseline, env: Environment, name: str) -> str:
    """Return the file of a baseline's measurement on a set, below the folder of the study."""
    return f"{env.folder}/baselines/{baseline.name}/{name}.json"


def measured_files(
    study: Study, env: Environment, entry: Agent | Baseline, mode: Mode | None
) -> Iterator[Path]:
    """Yield the files that hold the measurements of a row, whether they exist or not."""
    for name in sets_of(env, entry if isinstance(entry, Baseline) else None):
        if isinstance(entry, Baseline):
            yield study.out / path_of(entry, env, name)
        else:
            for cell in cells_of(entry, env):
                yield study.out / cell.folder / evaluation_path(name, mode or Mode())


def stored(path: Path, wanted: Record) -> Record | None:
    """Return the record in a file, or None if there is none with this identity."""
    if not path.is_file():
        return None
    record = read_json(path)
    return record if {name: record.get(name) for name in wanted} == wanted else None


def percent(record: Record) -> str:
    """Return the success of a measurement in words."""
    return f"{100.0 * record['summary']['success']['rate']:.1f} %"


def path_of_times(env: Environment) -> str:
    """Return the file of the decision times in an environment, below the folder of the study."""
    return f"{env.folder}/timings.json"


def times_of(study: Study, env: Environment) -> Record:
    """Return the stored times by row."""
    path = study.out / path_of_times(env)
    return read_json(path) if path.is_file() else {}


def method_of_mode(mode: Mode, model: Any, env: Environment, kwargs: Any, seed: int = 0) -> Method:
    """Return an agent that decides in a mode; the network before training has the weights of the seed."""
    chosen = untrained(model, seed) if mode.untrained else model
    method = agent_method(mode.name, chosen, mode.checks)
    if mode.unrevised:
        return OpenLoopBaseline(method, EpisodeSimulation(env.id, **kwargs))
    return method


def method_of(baseline: Baseline, env: Environment, frozen: FrozenScenes, **more: Any) -> Method:
    """Return a baseline in an environment."""
    kwargs = {**env.env_kwargs, **baseline.env_kwargs, **more}
    if baseline.method == "stored":
        return StoredSolutions(frozen)
    if baseline.checks is None:
        return make_method(baseline.method, env.id, **kwargs)
    if baseline.method == "search":
        return refined_search(baseline.checks)(new_simulation(env.id, 2, **kwargs))
    if baseline.method == "sobol":
        return GeometrySearch(env.id, baseline.checks, **kwargs)
    return RandomOrder(env.id, baseline.checks, **kwargs)
