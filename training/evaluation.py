"""Evaluation of agents and baselines on the same scenes, with every outcome and intervals."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from stable_baselines3.common.base_class import BaseAlgorithm

from viapoint.envs.common.arrays import Float, Observation
from viapoint.envs.common.validation import finite_array
from viapoint.envs.outcome import Outcome
from viapoint.envs.registration import check_registered
from viapoint.envs.scenes.scene import Scenes
from viapoint.training import report
from viapoint.training.agents.agent import load_agent
from viapoint.training.agents.model_io import check_same_task, untrained
from viapoint.training.checks import check_whole
from viapoint.training.files import versions
from viapoint.training.planning.baselines import Method, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import Outcomes, SceneSimulation, joined, whole_task
from viapoint.training.scene_sets import BANDS, DRAWN, SETS, FrozenScenes, scenes_for
from viapoint.training.vec_env import ViaVecEnv, env_arguments

Interval = tuple[float, float, float]  # Estimate, and both ends of its confidence interval
Progress = Callable[[str, int, int], None]  # Method's name, scenes done, all scenes

CONFIDENCE = 0.95  # Confidence of all intervals
TIMED_DECISIONS = 200  # Number of single decisions after which no further scene is timed
TIMING_BUDGET = 3.0  # Wall time after which no further decision is timed, [s]
SLOW_DECISION = 0.1  # Decision time above which a method is timed in batches, [s]


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """Outcomes of one method in the first n of N scenes."""

    name: str
    outcomes: Outcomes
    """Scalars of the environment's info and `reward` by name, shape (n,) each, and `action`, shape (n, m)."""
    decision_times: Float
    """Wall times of single decisions, [s]; one number, the mean of a batch, for a slow method."""
    band: NDArray[np.int64]  # Index into BANDS of each scene, -1 if the share is unknown, shape (n,)
    family: NDArray[np.str_]  # Scene family of each scene, '' for the training distribution, shape (n,)
    partial: bool  # True if Ctrl-C ended it: scenes or decision times are missing

    @property
    def success(self) -> NDArray[np.bool_]:
        """Success in each scene, shape (n,)."""
        return np.asarray(self.outcomes["is_success"], dtype=bool)

    def summary(self) -> dict[str, Any]:
        """Return the metrics by name; those of successes are None without successes."""
        success = self.success
        summary: dict[str, Any] = {"scenes": len(success), "partial": self.partial, "success": _rate(success)}
        by_band = summary["success_by_band"] = {}
        for i, name in enumerate(BANDS):
            if (self.band == i).any():
                by_band[name] = _rate(success[self.band == i])
        by_family = summary["success_by_family"] = {}
        for name in dict.fromkeys(self.family.tolist()):
            if name != DRAWN:
                by_family[name] = _rate(success[self.family == name])
        summary["collision"] = _rate(np.asarray(self.outcomes["collision"], dtype=bool))
        summary["unreachable"] = _rate(~np.asarray(self.outcomes["reachable"], dtype=bool))
        for name in ("min_clearance", "goal_error", "tracking_error"):
            summary[name] = _quantile(self.outcomes[name])
        for name in ("jerk_ratio", "duration", "path_length"):
            summary[name] = _quantile(self.outcomes[name][success])
        summary["decision_time"] = _quantile(self.decision_times)
        several = len(self.decision_times) > 1
        summary["decision_time_98"] = _quantile(self.decision_times, 0.98) if several else None
        return summary


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Outcomes of several methods in the same scenes.

    Example:
        >>> from viapoint.training import evaluate
        >>> result = evaluate(env="viapoint/PlanarReach-v0", baselines=["straight", "random"], n_scenes=20)
        >>> result.success_rate, [row["method"] for row in result.rows]
        (1.0, ['straight', 'random'])
        >>> print(result.to_markdown().splitlines()[0])  # doctest: +ELLIPSIS
        # viapoint/PlanarReach-v0, scenes test (20, sha256 ...)
    """

    env_id: str  #: Id of the environment.
    scenes: str  #: Name of the scene set.
    sha256: str  #: Hash of the scene set.
    results: tuple[MethodResult, ...]  #: Outcomes of each method, the agent first.

    @property
    def partial(self) -> bool:
        """Mark of an evaluation that was interrupted before the end."""
        return self.results[-1].partial

    @property
    def success_rate(self) -> float:
        """Share of the scenes in which the first method succeeded."""
        return float(self.results[0].success.mean())

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Metrics of each method by name, the name of the method as `method`.

        Rates are dictionaries of `rate`, `low`, `high` (95 % Wilson interval), `count` and `of`; lengths are in [m],
        errors in joint space in [rad], and times in [s].
        """
        return [{"method": result.name, **result.summary()} for result in self.results]

    def to_markdown(self) -> str:
        """Return the table of all methods as a Markdown document."""
        return report.markdown(self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return metrics and every outcome, as JSON can represent them."""
        outcomes: dict[str, dict[str, list[Any]]] = {result.name: {} for result in self.results}
        for result in self.results:
            for name, values in result.outcomes.items():
                # A millionth of their unit is finer than their accuracy.
                rounded = np.round(values, 6) if values.dtype.kind == "f" else values
                outcomes[result.name][name] = rounded.tolist()
        return {
            "viapoint": versions()["viapoint"],
            "env": self.env_id,
            "scenes": self.scenes,
            "sha256": self.sha256,
            "partial": self.partial,
            "methods": {result.name: result.summary() for result in self.results},
            "outcomes": outcomes,
        }


def evaluate(
    agent: str | Path | BaseAlgorithm | Method | None = None,
    *,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    scenes: str | Path | FrozenScenes = "test",
    n_scenes: int | None = None,
    checks: int | Sequence[int] | None = None,
    refine: int | Sequence[int] = (),
    baselines: Sequence[str | Method] = (),
    time_decisions: bool = True,
    progress: Progress | None = None,
) -> EvaluationResult:
    """Evaluate an agent and baselines on the same scenes.

    Ctrl-C ends the evaluation; the result then holds the finished scenes and is marked as partial.

    Args:
        agent: Id of a shipped agent, run folder, model folder, an agent, or any object with `name` and `decide`, such
            as a :class:`GeometrySearch`; None to evaluate baselines alone.
        env: Id of the environment; that of the agent if not given.
        env_kwargs: Keyword arguments of the environment; those of the agent if not given.
        scenes: `validation`, `test`, `hard`, `uniform`, the path of a scene file, or a scene set.
        n_scenes: Number of scenes, evenly spread over the set; all if not given.
        checks: Numbers of proposals that the agent checks with exact geometry, one row each; its own if not given.
        refine: Numbers of proposals that the planner refines, one further row each.
        baselines: Objects with `name` and `decide`, or names: `untrained` (the agent's network before training),
            `straight`, `random`, `plan_motion`, `ompl`, `searchN` and `sobolN` (N checked plans); with a sensor also
            `cautiousN` and BELIEF:METHOD, such as `thick:search512`; where obstacles move also PREDICTION:searchN, such
            as `reach:search512`.
        time_decisions: Measure the wall time of single decisions.
        progress: Function of the method's name and the numbers of finished and of all scenes.

    Raises:
        ValueError: There is no such agent, baseline, scene set or environment, or they do not fit together.

    Example:
        >>> from viapoint.training import evaluate
        >>> result = evaluate("viapoint/PlanarObstacles-v0", baselines=["straight"], n_scenes=50)
        >>> result.success_rate > 0.5, [row["method"] for row in result.rows]
        (True, ['agent', 'straight'])
    """
    if n_scenes is not None:
        check_whole("n_scenes", n_scenes)
    if isinstance(baselines, str) or not isinstance(baselines, Sequence):
        raise ValueError(f"baselines must be a list, such as ['straight'], got {baselines!r}")
    if not isinstance(scenes, str | Path | FrozenScenes):
        raise ValueError(f"scenes must be one of {', '.join(SETS)}, a file or a set, got {scenes!r}")
    settings: list[dict[str, int]] = []
    for number in checks if isinstance(checks, Iterable) else [checks]:
        settings.append({} if number is None else {"checks": check_whole("checks", number)})
    for number in refine if isinstance(refine, Iterable) else [refine]:
        settings.append({"checks": 0, "refine": check_whole("refine", number)})
    if isinstance(agent, str | Path):
        agent = load_agent(agent)
    env_id, kwargs = _environment_of(agent, env, env_kwargs)
    task = registered_task(env_id, **kwargs)
    methods: list[Method] = []
    if isinstance(agent, BaseAlgorithm):
        methods += [agent_method("agent", agent, **each) for each in settings]
    elif agent is not None:
        methods.append(agent)
    for each in baselines:
        if not isinstance(each, str):
            methods.append(each)
        elif each == "untrained" and isinstance(agent, BaseAlgorithm):
            before = untrained(agent)
            methods += [agent_method(each, before, **setting) for setting in settings]
        else:
            methods.append(make_method(each, env_id, **kwargs))
    chosen = scenes_for(scenes, task, n_scenes)
    if n_scenes is not None and n_scenes > len(chosen.share):
        print(f"{chosen.name} has {len(chosen.share)} scenes, not {n_scenes}: all are used", file=sys.stderr)
    options: dict[str, Any] = {"time_decisions": time_decisions, "progress": progress}
    result = evaluate_methods(methods, chosen, env_id, env_kwargs=kwargs, **options)
    own = agent.get_env().unwrapped if isinstance(agent, BaseAlgorithm) else None  # type: ignore[union-attr]
    return replace(result, env_id=getattr(own, "recorded_id", env_id))


def _environment_of(agent: Any, env: str | None, env_kwargs: Any) -> tuple[str, dict[str, Any]]:
    """Return id and arguments of the environment of an evaluation, in which an action is a whole movement."""
    if not isinstance(agent, BaseAlgorithm):
        if env is None:
            raise ValueError("env must be the id of an environment where no trained agent is given")
        return check_registered(env), whole_task(env, env_kwargs or {})
    # Stable-Baselines3 loads models without an environment.
    if agent.get_env() is None and env is not None:
        agent.set_env(ViaVecEnv(env, agent.n_envs, **(env_kwargs or {})))
    mine, kwargs = env_arguments(agent.get_env())
    if env is not None and check_registered(env) != mine:
        raise ValueError(f"env must be {mine}, on which the agent was trained, or be left out, got {env!r}")
    if env_kwargs is not None:
        trained = agent.get_env().get_attr("task", [0])[0]  # type: ignore[union-attr]
        check_same_task(trained, registered_task(mine, **env_kwargs))
    return mine, whole_task(mine, kwargs if env_kwargs is None else env_kwargs)


def evaluate_methods(
    methods: Sequence[Method],
    frozen: FrozenScenes,
    env_id: str,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    batch: int = 250,
    time_decisions: bool = True,
    progress: Progress | None = None,
) -> EvaluationResult:
    """Evaluate one or more methods in the same scenes, `batch` at a time; the rest is as for :func:`evaluate`."""
    if not methods:
        raise ValueError("there is nothing to evaluate: give an agent or baselines")
    for each in methods:
        if not isinstance(getattr(each, "name", None), str) or not callable(getattr(each, "decide", None)):
            raise ValueError(f"methods must be names, or objects with `name` and `decide`, got {each!r}")
    names = [each.name for each in methods]
    if len(set(names)) < len(names):
        raise ValueError(f"methods must have different names, got {', '.join(names)}")
    results: list[MethodResult] = []
    opened = SceneSimulation(env_id, min(batch, len(frozen.share)), **(env_kwargs or {}))
    with one_thread(), closing(opened) as simulation:
        for method in methods:
            results.append(_evaluate_one(method, frozen, simulation, batch, time_decisions, progress))
            if results[-1].partial:
                break
    return EvaluationResult(env_id=env_id, scenes=frozen.name, sha256=frozen.sha256, results=tuple(results))


def _evaluate_one(
    method: Method, frozen: FrozenScenes, simulation: SceneSimulation, batch: int, timed: bool, progress: Any
) -> MethodResult:
    number = len(frozen.share)
    pieces: list[Outcomes] = []
    times: Float = np.zeros(0)
    seconds, interrupted = 0.0, False
    try:
        for first in range(0, number, batch):
            scenes = frozen.scenes.take(slice(first, first + batch))
            began = time.perf_counter()
            decided = method.decide(simulation.observe(scenes), scenes)
            seconds += time.perf_counter() - began
            if not hasattr(method, "execute"):  # others have decisions of their own kind
                shape = len(scenes.start), len(simulation.task.action_names)
                decided = finite_array(f"decisions of {method.name}", decided, shape)
            outcome = simulation.play(method, scenes, decided)
            outcome["action"] = np.asarray(decided, dtype=np.float64)
            pieces.append(outcome)
            if progress is not None:
                progress(method.name, min(first + batch, number), number)
        if timed:
            times = _decision_times(method, frozen.scenes, simulation, seconds / number)
    except KeyboardInterrupt:
        interrupted = True
    nothing = {name: np.zeros(0) for name in (*Outcome._fields, "action")}
    outcomes = joined(pieces) if pieces else nothing
    done = len(outcomes["is_success"])
    return MethodResult(
        name=method.name,
        outcomes=outcomes,
        decision_times=times,
        band=frozen.band[:done],
        family=frozen.family[:done],
        partial=interrupted,
    )


def _decision_times(method: Method, scenes: Scenes, simulation: SceneSimulation, in_batch: float) -> Float:
    """Return the wall times of single decisions, [s]; for a slow method, the mean in a batch.

    In tasks with replanning, they are all decisions of whole episodes: those in motion take longer than the first ones.
    """
    times: list[float] = []

    def decide(observation: Observation, scenes: Scenes) -> Float:
        before = time.perf_counter()
        decided = method.decide(observation, scenes)
        times.append(time.perf_counter() - before)
        return decided

    began = time.perf_counter()
    replanning = simulation.task.replanning and not hasattr(method, "execute")
    with closing(SceneSimulation(simulation.env_id, 1, **simulation.kwargs)) as alone:
        for row in range(len(scenes.start)):
            one = scenes.take(slice(row, row + 1))
            decided = decide(simulation.observe(one), one)
            if replanning:
                alone(one, decided, decide)
            usual = float(np.median(times[1:] or [times[0] / 20.0]))  # the first may warm up
            if usual > SLOW_DECISION:  # a look at each scene would take too long
                return np.array([in_batch])
            if len(times) > TIMED_DECISIONS or time.perf_counter() - began > TIMING_BUDGET:
                break
    return np.array(times[1:] or times)  # without the first one, which may warm up


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread, which is fastest for small networks and gives the same numbers on any machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _rate(values: NDArray[np.bool_]) -> dict[str, Any]:
    """Return a rate with its 95 % Wilson interval."""
    count = int(values.sum())
    number = len(values)
    rate, low, high = wilson(count, number)
    return {"rate": rate if number else None, "low": low, "high": high, "count": count, "of": number}


def _quantile(values: NDArray[Any], share: float = 0.5) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def wilson(successes: int, trials: int) -> Interval:
    """Return Wilson's score interval of a success rate; without trials it is (nan, 0, 1).

    Recommended by Brown, Cai and DasGupta 2001, Stat. Sci. 16. Impossible counts raise ValueError or TypeError.
    """
    if successes == trials == 0:
        return math.nan, 0.0, 1.0
    test = stats.binomtest(successes, trials)
    low, high = test.proportion_ci(CONFIDENCE, method="wilson")
    return float(test.statistic), float(low), float(high)


def across_seeds(
    scores: ArrayLike, strata: ArrayLike, generator: np.random.Generator, *, samples: int = 2_000
) -> Interval:
    """Return the interquartile mean over seeds of each seed's mean over scenes, with a two-way bootstrap interval.

    `scores` has shape (seeds, scenes), and `strata` holds the stratum of each scene, such as its band, shape (scenes,).

    The interquartile mean leaves out the lowest and the highest floor(n / 4) of the seeds. A draw takes seeds as whole
    rows and scenes as whole columns, scenes within their strata, as all agents meet the same scenes; drawn one by one,
    the entries of an agent that fails in many scenes would pass for many agents. Scores of 0 and 1 that differ in no
    stratum show no spread to a bootstrap; then the interval is Wilson's over the scenes.

    Sources: Owen 2007, The Pigeonhole Bootstrap, Ann. Appl. Stat. 1, 386-411; Agarwal et al. 2021, arXiv 2108.13264.
    Intervals of a few seeds may be too narrow: those of five simulated agents cover the truth in 88 to 99 % of trials.
    """
    table = np.asarray(scores, dtype=np.float64)
    seeds, scenes = table.shape
    _, at, group = np.unique(np.asarray(strata), return_index=True, return_inverse=True)
    if (table == table[0, at][group]).all() and np.isin(table[0], (0.0, 1.0)).all():
        return wilson(int(table[0].sum()), scenes)
    times_drawn = np.zeros((scenes, samples))
    for each in range(group.max() + 1):
        rows = np.flatnonzero(group == each)
        times_drawn[rows] = generator.multinomial(len(rows), np.full(len(rows), 1 / len(rows)), samples).T
    means = table @ times_drawn / scenes
    chosen = generator.integers(seeds, size=(seeds, samples))
    draws = stats.trim_mean(np.take_along_axis(means, chosen, axis=0), 0.25, axis=0)
    low, high = np.quantile(draws, (0.5 - CONFIDENCE / 2.0, 0.5 + CONFIDENCE / 2.0))
    return float(stats.trim_mean(table.mean(axis=1), 0.25)), float(low), float(high)
