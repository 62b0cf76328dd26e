"""Measuring methods on frozen scenes: the same scenes for each, every outcome kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.evaluation.statistics import mcnemar, success_weighted_path_length, wilson
from viapoint.training.planners.baselines import Method
from viapoint.training.rollouts.rollout import Trial, new_trial
from viapoint.training.scene_sets.scene_set import BANDS, DRAWN, FrozenScenes

Progress = Callable[[str, int, int], None]
"""Is told the method's name, the scenes that are done and the scenes that there are."""

TIMED_DECISIONS = 200
"""Single decisions that are timed, at most."""
TIMING_BUDGET = 3.0
"""Time after which no more are timed, [s]."""
SLOW_DECISION = 0.1
"""A method whose single decisions take longer than this is timed by the batch, [s]."""


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """What one method did in n of the N scenes, from the first on."""

    name: str
    outcomes: Mapping[str, NDArray[Any]]
    """Every scalar of the environment's info, shape (n,) each."""
    actions: Float
    """Shape (n, m)."""
    decision_times: Float
    """Of single decisions, [s]; one number, the mean of a batch, for a slow method."""
    band: NDArray[np.int64]
    """Index into BANDS of each scene, -1 where the share is unknown, shape (n,)."""
    family: NDArray[np.str_]
    """Of each scene, '' for drawn ones, shape (n,)."""
    distance: Float
    """From start to goal, shape (n,), [m]; NaN where the target jumps, of which the shortest path is not known."""
    partial: bool
    """Whether it was interrupted before the last scene."""
    interrupted: bool = False
    """Whether it was interrupted at all, so that no method follows."""

    @property
    def success(self) -> NDArray[np.bool_]:
        """Which of the scenes it succeeded in, shape (n,)."""
        return np.asarray(self.outcomes["is_success"], dtype=bool)

    def summary(self) -> dict[str, Any]:
        """The metrics, by name; those of successes only are None where there is none."""
        success, median = self.success, _median
        return {
            "scenes": len(success),
            "partial": self.partial,
            "success": _rate(success),
            "success_by_band": {
                name: _rate(success[self.band == i]) for i, name in enumerate(BANDS) if (self.band == i).any()
            },
            "success_by_family": {
                str(name): _rate(success[self.family == name])
                for name in dict.fromkeys(self.family.tolist())
                if name != DRAWN
            },
            "collision": _rate(np.asarray(self.outcomes["collision"], dtype=bool)),
            "unreachable": _rate(~np.asarray(self.outcomes["reachable"], dtype=bool)),
            "min_clearance": median(self.outcomes["min_clearance"]),
            "goal_error": median(self.outcomes["goal_error"]),
            "tracking_error": median(self.outcomes["tracking_error"]),
            "jerk_ratio": median(self.outcomes["jerk_ratio"][success]),
            "duration": median(self.outcomes["duration"][success]),
            "path_length": median(self.outcomes["path_length"][success]),
            "spl": success_weighted_path_length(success, self.distance, self.outcomes["path_length"])
            if len(success) and np.isfinite(self.distance).all()
            else None,
            "decision_time": median(self.decision_times),
            "decision_time_98": _quantile(self.decision_times, 0.98)
            if len(self.decision_times) > 1
            else None,
        }


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What several methods did in the same scenes."""

    env_id: str
    scenes: str
    """Name of the set."""
    sha256: str
    """Of the set."""
    results: tuple[MethodResult, ...]
    missing: bool = False
    """Whether it was interrupted before the last method."""

    @property
    def partial(self) -> bool:
        """Whether it was interrupted before the end."""
        return self.missing or any(result.partial for result in self.results)

    def as_json(self) -> dict[str, Any]:
        """Metrics, comparisons with the first method, and every outcome, as JSON can hold them."""
        return {
            "env": self.env_id,
            "scenes": self.scenes,
            "sha256": self.sha256,
            "partial": self.partial,
            "methods": {result.name: result.summary() for result in self.results},
            "compared_with_first": {each.name: _compare(self.results[0], each) for each in self.results[1:]},
            "outcomes": {
                result.name: {
                    "action": _rounded(result.actions),
                    **{name: _rounded(values) for name, values in result.outcomes.items()},
                }
                for result in self.results
            },
        }


def evaluate(
    methods: Sequence[Method],
    frozen: FrozenScenes,
    env_id: str,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    batch: int = 250,
    time_decisions: bool = True,
    progress: Progress | None = None,
) -> Evaluation:
    """Let each method decide in each scene, and simulate its decisions, or let it do so itself where it can.

    Ctrl-C ends it: what is done is returned, and marked as partial.

    Args:
        methods: To measure.
        frozen: The scenes.
        env_id: Of the environment.
        env_kwargs: Of the environment.
        batch: Scenes at a time.
        time_decisions: Whether to time single decisions, too.
        progress: Is told how far it is.
    """
    if not methods:
        raise ValueError("methods must name at least one method")
    results: list[MethodResult] = []
    with _trial(env_id, min(batch, len(frozen.share)), env_kwargs or {}) as trial:
        for method in methods:
            result = _evaluate_one(method, frozen, trial, batch, time_decisions, progress)
            results.append(result)
            if result.interrupted:
                break
    missing = len(results) < len(methods)
    return Evaluation(
        env_id=env_id, scenes=frozen.name, sha256=frozen.sha256, results=tuple(results), missing=missing
    )


def _evaluate_one(
    method: Method,
    frozen: FrozenScenes,
    trial: Trial,
    batch: int,
    time_decisions: bool,
    progress: Progress | None,
) -> MethodResult:
    number = len(frozen.share)
    pieces: list[Mapping[str, NDArray[Any]]] = []
    times: Float = np.zeros(0)
    seconds, interrupted = 0.0, False
    try:
        for first in range(0, number, batch):
            scenes = frozen.scenes.take(slice(first, first + batch))
            began = time.perf_counter()
            decided = method.decide(trial.observe(scenes), scenes)
            seconds += time.perf_counter() - began
            outcome = trial.play(method, scenes, decided)
            action = np.asarray(decided, dtype=np.float64)
            pieces.append({**outcome.info, "reward": outcome.reward, "": action})
            if progress is not None:
                progress(method.name, min(first + batch, number), number)
        if time_decisions and getattr(method, "timed", True):
            times = _decision_times(method, frozen.scenes, trial, seconds / number)
    except KeyboardInterrupt:
        interrupted = True
    actions = [piece[""] for piece in pieces]  # kept with their outcomes, so that Ctrl-C parts none of them
    done = sum(len(piece) for piece in actions)
    names = [name for name in pieces[0] if name] if pieces else ()
    return MethodResult(
        name=method.name,
        outcomes={name: np.concatenate([piece[name] for piece in pieces]) for name in names} or _nothing(),
        actions=np.concatenate(actions) if actions else np.zeros((0, trial.task.action.size)),
        decision_times=times,
        band=frozen.band[:done],
        family=frozen.family[:done],
        distance=_distances(frozen.scenes)[:done],
        partial=interrupted and done < number,
        interrupted=interrupted,
    )


def _distances(scenes: Scenes | ChangingScenes) -> Float:
    away = np.linalg.norm(scenes.goal - scenes.start, axis=-1)
    if isinstance(scenes, ChangingScenes):
        return np.where(np.isfinite(scenes.jump_times).any(axis=-1), np.nan, away)
    return np.asarray(away)


def _decision_times(method: Method, scenes: Scenes, trial: Trial, in_batch: float) -> Float:
    """Seconds of single decisions; for a slow method only its mean in the batch."""
    times: list[float] = []
    began = time.perf_counter()
    for row in range(min(TIMED_DECISIONS + 1, len(scenes.start))):
        one = scenes.take(slice(row, row + 1))
        observation = trial.observe(one)
        before = time.perf_counter()
        method.decide(observation, one)
        times.append(time.perf_counter() - before)
        usual = float(np.median(times[1:])) if row else times[0] / 20.0  # the first may warm up
        if usual > SLOW_DECISION:
            return np.array([in_batch])
        if time.perf_counter() - began > TIMING_BUDGET:
            break
    return np.array(times[1:] or times)


@contextmanager
def _trial(env_id: str, num_envs: int, kwargs: Mapping[str, Any]) -> Iterator[Trial]:
    trial = new_trial(env_id, num_envs, **kwargs)
    try:
        yield trial
    finally:
        trial.close()


def _nothing() -> dict[str, NDArray[Any]]:
    names = ("is_success", "collision", "reachable", "min_clearance", "goal_error", "tracking_error")
    return {name: np.zeros(0) for name in (*names, "jerk_ratio", "duration", "path_length")}


def _compare(first: MethodResult, second: MethodResult) -> dict[str, Any] | None:
    number = min(len(first.success), len(second.success))
    return mcnemar(second.success[:number], first.success[:number])._asdict() if number else None


def _rate(values: NDArray[np.bool_]) -> dict[str, Any]:
    """A rate with its 95 % Wilson interval."""
    interval = wilson(int(values.sum()), len(values))
    return {
        "rate": interval.estimate if len(values) else None,
        "low": interval.low,
        "high": interval.high,
        "count": int(values.sum()),
        "of": len(values),
    }


def _median(values: NDArray[Any]) -> float | None:
    return _quantile(values, 0.5)


def _quantile(values: NDArray[Any], share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _rounded(values: NDArray[Any]) -> list[Any]:
    """Values to a millionth of their unit: short, and finer than any of them is known."""
    listed: list[Any] = (np.round(values, 6) if values.dtype.kind == "f" else values).tolist()
    return listed
