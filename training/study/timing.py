"""Decision times of all methods of a study, one after the other on an idle machine, and searches of equal time."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from viapoint.training.algorithms.model_io import load_model
from viapoint.training.evaluation.evaluator import one_thread
from viapoint.training.io.files import write_json
from viapoint.training.planners.baselines import Method
from viapoint.training.rollouts.rollout import new_simulation
from viapoint.training.runs.run_dir import Run
from viapoint.training.study.config import Agent, Baseline, Environment, Study
from viapoint.training.study.jobs import (
    Cell,
    Record,
    identity,
    identity_of,
    of_equal_time,
    path_of_times,
    sets_of,
    state,
    times_of,
)
from viapoint.training.study.methods import method_of, method_of_mode, modes

N_TIMED = 100
"""Greatest number of scenes in which decisions are timed."""
BUDGET = 5.0
"""Wall time after which no further decision of a method is timed, [s]."""
MOST_CHECKS = 1 << 16
"""Greatest number of checks of a search of equal time."""
NEARLY, TRIES = 0.97, 6
"""Share of the allowed time that a search of equal time shall take, and most searches that are timed to get there."""
FEWEST_CHECKS = 64
"""Checks with which the search of equal time begins. With fewer often no plan is clear, and a decision takes longer."""


class Timed(NamedTuple):
    """Method to be timed."""

    row: str
    """Id of its row."""
    source: Any
    """Plain values; a time is obsolete if they have changed."""
    method: Any
    """Function without arguments that returns the method."""


def time_decisions(study: Study) -> Iterator[str]:
    """Time what has no time yet, and yield a line about each; trained agents are those of the first seed."""
    for env in study.environments:
        times = times_of(study, env)
        for row, source, make in _to_time(study, env):
            if times.get(row, {}).get("source") == source:
                continue
            times[row] = {"source": source, "median": median_time(study, env, make())}
            _write(study, env, times)
            yield f"{env.folder} {row}: {1e3 * times[row]['median']:.2f} ms"
        for baseline in of_equal_time(study, env):
            if baseline.time_of not in times:
                continue
            source = {"time_of": times[baseline.time_of], **_made(baseline, env)}
            if times.get(baseline.name, {}).get("source") == source:
                continue
            checks, seconds = checks_within(study, env, baseline, times[baseline.time_of]["median"])
            times[baseline.name] = {"source": source, "median": seconds, "checks": checks}
            _write(study, env, times)
            yield f"{env.folder} {baseline.name}: {checks} checks in {1e3 * seconds:.2f} ms"


def remove_times(study: Study, env: Environment, row: str) -> bool:
    """Remove the stored time of a row, and return whether there was one."""
    times = times_of(study, env)
    if times.pop(row, None) is None:
        return False
    _write(study, env, times)
    return True


def median_time(study: Study, env: Environment, method: Method) -> float:
    """Return the median wall time of single decisions on one thread, without the first one, [s]."""
    frozen = next(iter(sets_of(env).values()))
    times: list[float] = []
    began = time.perf_counter()
    opened = new_simulation(env.id, 2, **{**env.env_kwargs, "threads": 1})
    with one_thread(), contextlib.closing(opened) as simulation:
        for row in range(min(N_TIMED, len(frozen.share))):
            scene = frozen.scenes.take(slice(row, row + 1))
            observation = simulation.observe(scene)
            before = time.perf_counter()
            method.decide(observation, scene)
            times.append(time.perf_counter() - before)
            if time.perf_counter() - began > BUDGET:
                break
    return float(np.median(times[1:] or times))


def checks_within(study: Study, env: Environment, baseline: Baseline, seconds: float) -> tuple[int, float]:
    """Return the number of checks of a search that takes at most a time, and its own time, [s].

    The number is doubled until it takes longer. Then interpolation narrows the interval, until the time is within
    NEARLY of the limit or after TRIES searches. A search that takes longer even with the fewest checks has these.
    """
    frozen = next(iter(sets_of(env).values()))

    def timed(checks: int) -> float:
        search = dataclasses.replace(baseline, checks=checks)
        return median_time(study, env, method_of(search, env, frozen, threads=1))

    low, took = FEWEST_CHECKS, timed(FEWEST_CHECKS)
    high, longer = low, took
    while longer <= seconds and high < MOST_CHECKS:
        low, took = high, longer
        high, longer = 2 * low, timed(2 * low)
    for _ in range(TRIES):
        if took >= NEARLY * seconds or high - low < 2 or longer <= seconds:
            break
        between = int(np.clip(low + (high - low) * (seconds - took) / (longer - took), low + 1, high - 1))
        tried = timed(between)
        if tried <= seconds:
            low, took = between, tried
        else:
            high, longer = between, tried
    return (high, longer) if longer <= seconds else (low, took)


def _to_time(study: Study, env: Environment) -> Iterator[Timed]:
    """Yield the methods of an environment: agents of the first trained seed, then baselines."""
    frozen = next(iter(sets_of(env).values()))
    for agent in (each for each in study.agents if each.timed and env.name in each.environments):
        yield from _agent_to_time(study, env, agent)
    for baseline in study.baselines:
        if baseline.timed and baseline.time_of is None and env.name in baseline.environments:
            yield Timed(
                baseline.name,
                _made(baseline, env),
                lambda baseline=baseline: method_of(baseline, env, frozen, threads=1),
            )


def _agent_to_time(study: Study, env: Environment, agent: Agent) -> Iterator[Timed]:
    runs = [Cell(env=env, agent=agent, seed=seed) for seed in agent.seeds]
    first = next((cell for cell in runs if state(cell, study.out) == "trained"), None)
    if first is None:
        return
    folder = Run(study.out / first.folder).best
    frozen = next(iter(sets_of(env).values()))
    kwargs = {**first.training(study.out).env_kwargs, "threads": 1}
    model: Any = None

    def make(mode: Any) -> Method:
        nonlocal model
        model = load_model(folder) if model is None else model
        return method_of_mode(mode, model, env, kwargs)

    for mode in modes(agent, env):
        yield Timed(mode.row(agent), identity_of(frozen, folder, mode), lambda mode=mode: make(mode))


def _made(baseline: Baseline, env: Environment) -> Record:
    return identity(baseline, env, next(iter(sets_of(env).values())))


def _write(study: Study, env: Environment, times: Record) -> None:
    path = study.out / path_of_times(env)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, times)
