"""Decision times of all methods of a study, one after the other on an idle machine, and searches of equal time."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.training.algorithms.model_io import load_model
from viapoint.training.evaluation.evaluator import one_thread, single_decision_times
from viapoint.training.io.files import write_json
from viapoint.training.planners.baselines import Method
from viapoint.training.rollouts.rollout import new_simulation
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import FrozenScenes
from viapoint.training.study.config import Agent, Baseline, Environment, Mode, Study
from viapoint.training.study.jobs import (
    Record,
    identity,
    identity_of,
    method_of,
    method_of_mode,
    path_of_times,
    sets_of,
    times_of,
    trained,
)

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
    measure: Callable[[], Record]
    """Function that returns the median time [s] as `median`, and the checks of a search of equal time as `checks`."""


def time_decisions(study: Study) -> Iterator[str]:
    """Time what has no time yet, and yield a line about each; trained agents are those of the first seed."""
    for env in study.environments:
        times = times_of(study, env)
        for row, source, measure in _to_time(study, env, times):
            if times.get(row, {}).get("source") == source:
                continue
            times[row] = {"source": source, **measure()}
            write_json(study.out / path_of_times(env), times)
            checks = f"{times[row]['checks']} checks in " if "checks" in times[row] else ""
            yield f"{env.folder} {row}: {checks}{1e3 * times[row]['median']:.2f} ms"


def remove_times(study: Study, env: Environment, row: str) -> bool:
    """Remove the stored time of a row, and return whether there was one."""
    times = times_of(study, env)
    if times.pop(row, None) is None:
        return False
    write_json(study.out / path_of_times(env), times)
    return True


def median_time(env: Environment, method: Method, env_kwargs: Mapping[str, Any]) -> float:
    """Return the median wall time of single decisions on one thread, without the first one, [s].

    Args:
        env: Environment.
        method: Method that decides.
        env_kwargs: Arguments of the environment for which the method was made, besides those of `env`.
    """
    opened = new_simulation(env.id, 2, **{**env.env_kwargs, **env_kwargs, "threads": 1})
    with one_thread(), contextlib.closing(opened) as simulation:
        scenes = _timed_scenes(env).scenes
        times = list(single_decision_times(method, scenes, simulation, N_TIMED, BUDGET))
    return float(np.median(times[1:] or times))


def checks_within(env: Environment, baseline: Baseline, seconds: float) -> tuple[int, float]:
    """Return the number of checks of a search that takes at most a time, and its own time, [s].

    The number is doubled until it takes longer. Then interpolation narrows the interval, until the time is within
    NEARLY of the limit or after TRIES searches. A search that takes longer even with the fewest checks has these.
    """

    def timed(checks: int) -> float:
        search = dataclasses.replace(baseline, checks=checks)
        return median_time(env, method_of(search, env, _timed_scenes(env), threads=1), search.env_kwargs)

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


def _timed_scenes(env: Environment) -> FrozenScenes:
    """Return the first set of an environment, in whose scenes decisions are timed."""
    return next(iter(sets_of(env).values()))


def _to_time(study: Study, env: Environment, times: Record) -> Iterator[Timed]:
    """Yield the methods of an environment: agents, other baselines, then searches in the time of a row in `times`."""
    frozen = _timed_scenes(env)
    for agent in (each for each in study.agents if each.timed and env.name in each.environments):
        yield from _agent_to_time(study, env, agent)

    def time(baseline: Baseline) -> Record:
        return {"median": median_time(env, method_of(baseline, env, frozen, threads=1), baseline.env_kwargs)}

    def search(baseline: Baseline, seconds: float) -> Record:
        checks, median = checks_within(env, baseline, seconds)
        return {"median": median, "checks": checks}

    here = [each for each in study.baselines if env.name in each.environments]
    for baseline in here:
        if baseline.timed and baseline.time_of is None:
            source = identity(baseline, env, frozen)
            yield Timed(baseline.name, source, functools.partial(time, baseline))
    for baseline in here:
        if baseline.time_of in times:
            limit = times[baseline.time_of]
            source = {"time_of": limit, **identity(baseline, env, frozen)}
            yield Timed(baseline.name, source, functools.partial(search, baseline, limit["median"]))


def _agent_to_time(study: Study, env: Environment, agent: Agent) -> Iterator[Timed]:
    """Yield the decision modes of an agent of the first trained seed."""
    first = next(iter(trained(study, env, agent)), None)
    if first is None:
        return
    folder = Run(study.out / first.folder).best
    kwargs = {**first.training(study.out).env_kwargs, "threads": 1}
    model = functools.cache(lambda: load_model(folder))

    def measure(mode: Mode) -> Record:
        return {"median": median_time(env, method_of_mode(mode, model(), env, kwargs), kwargs)}

    for mode in agent.modes(env.id):
        source = identity_of(_timed_scenes(env), folder, mode)
        yield Timed(mode.row(agent.name), source, functools.partial(measure, mode))
