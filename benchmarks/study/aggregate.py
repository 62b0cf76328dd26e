"""Aggregation of the files of a study into one record with every number of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study import jobs
from study.jobs import ALONE, CHECKED, WAYS
from study.plan import ABLATIONS, FREEDOM, FREEDOM_LABELS, WHOLE, Cell, Study, Variant, sets_of
from viapoint.envs.common.types import Bool
from viapoint.training.evaluation.statistics import across_seeds, mcnemar, probability_of_improvement
from viapoint.training.io.files import read_json
from viapoint.training.io.installed import versions
from viapoint.training.planners.baselines import METHODS as BASELINE_METHODS
from viapoint.training.plotting.failure_report import KINDS
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes

Numbers = dict[str, Any]


def aggregate(study: Study) -> Numbers:
    """Return the record of the page from the existing files."""
    record: Numbers = _rounded(
        {
            "versions": versions(),
            "seeds": list(study.seeds),
            **conditions(study),
            "environments": {env: _environment(env, study) for env in study.environments},
            "ablations": {env: _table(env, ABLATIONS, {}, study) for env in study.studied},
            "freedom": {env: _freedom(env, study) for env in study.studied},
        }
    )
    return record


def conditions(study: Study) -> Numbers:
    """Return the conditions that must agree for numbers to share a page."""
    trial = {"n_timesteps": study.n_timesteps, "n_scenes": study.n_scenes}
    return {"trial": trial, "checks": study.checks}


def _environment(env: str, study: Study) -> Numbers:
    """Return the results of one environment."""
    variants = study.variants("results", env)
    found = _table(env, variants, {}, study)
    path = jobs.timings_path(env, study)
    times = {name: each["median"] for name, each in read_json(path).items()} if path.is_file() else {}
    return {
        "sets": {name: _described(jobs.scenes(name, env, study)) for name in sets_of(env)},
        "methods": found,
        "baselines": _baselines(env, study),
        "decision_time": times,
        "curves": {variant.name: _curves(env, variant, study) for variant in variants},
        "failures": {name: _failures(env, name, study) for name in sets_of(env)},
        "improvement": improvement(found),
        "compared": {name: _compared(env, name, study) for name in sets_of(env)},
    }


def _described(frozen: FrozenScenes) -> Numbers:
    family = _family(frozen)
    return {
        "scenes": len(frozen.share),
        "sha256": frozen.sha256,
        "bands": {band: int((frozen.band == i).sum()) for i, band in enumerate(BANDS)},
        "families": {str(each): int((family == each).sum()) for each in np.unique(family) if each},
    }


def _family(frozen: FrozenScenes) -> NDArray[np.str_]:
    """Return the family of each scene, empty where a set has none, shape (N,)."""
    family = getattr(frozen, "family", None)
    return np.full(len(frozen.share), "") if family is None else np.asarray(family).astype(str)


def finished(env: str, variant: Variant, study: Study) -> list[Cell]:
    """Return the trainings of a variant that are done."""
    cells = [Cell(env=env, variant=variant, seed=seed) for seed in study.seeds]
    return [cell for cell in cells if jobs.state(cell, study) == "trained"]


def _table(env: str, variants: Sequence[Variant], labels: dict[str, str], study: Study) -> list[Numbers]:
    """Return one entry for each variant that has a trained seed."""
    found = []
    for variant in variants:
        cells = finished(env, variant, study)
        if cells:
            label = labels.get(variant.name, variant.label)
            sets = {name: _agent(cells, name, study) for name in sets_of(env)}
            found.append(
                {
                    "name": variant.name,
                    "label": label,
                    "seeds": [cell.seed for cell in cells],
                    "training": _training(cells, study),
                    "sets": {name: each for name, each in sets.items() if each},
                }
            )
    return found


def _training(cells: Sequence[Cell], study: Study) -> Numbers:
    """Return the effort of the trainings, medians over seeds."""
    runs = [Run(cell.folder(study)) for cell in cells]
    last = [run.curve[-1] for run in runs]
    cores = [run.folder / "cores.json" for run in runs]
    return {
        "decisions": int(np.median([each["decisions"] for each in last])),
        "simulated_seconds": float(np.median([each["simulated_seconds"] for each in last])),
        "seconds": [each["seconds"] for each in last],
        "cores": sorted({read_json(path)["cores"] for path in cores if path.is_file()}),
    }


def _agent(cells: Sequence[Cell], name: str, study: Study) -> Numbers:
    """Return the numbers of each decision mode of an agent on one set; empty unless every seed was measured."""
    records = _records(cells, name, study)
    if len(records) < len(cells):
        return {}
    frozen = jobs.scenes(name, cells[0].env, study)
    ways = [way for way in WAYS if way in records[0]["methods"]]
    return {way: _numbers(records, way, frozen, study) for way in ways}


def _records(cells: Sequence[Cell], name: str, study: Study) -> list[Numbers]:
    """Return the stored evaluations of these agents and scenes."""
    found = []
    for cell in cells:
        run, frozen = Run(cell.folder(study)), jobs.scenes(name, cell.env, study)
        identity = jobs.identity_of(frozen, run.best, study)
        record = jobs.stored(jobs.evaluation_path(cell, name, study), identity)
        if record is not None:
            found.append(record)
    return found


def _numbers(records: Sequence[Numbers], method: str, frozen: FrozenScenes, study: Study) -> Numbers:
    """Return a row of a table: success by band and family, jerk and duration relative to the planner's."""
    success = jobs.rate_table(records, method, "is_success")
    frozen = frozen.take(slice(0, success.shape[1]))
    family = _family(frozen)
    names = [str(each) for each in np.unique(family) if each]
    return {
        "success": _interval(success, frozen.band),
        "each": success.mean(axis=1).tolist(),
        "by_band": {
            band: _interval(success[:, frozen.band == i], frozen.band[frozen.band == i])
            for i, band in enumerate(BANDS)
            if (frozen.band == i).any()
        },
        "by_family": {
            each: _interval(success[:, family == each], frozen.band[family == each]) for each in names
        },
        "collision": float(jobs.rate_table(records, method, "collision").mean()),
        **_beside_the_planner(records, method, success.astype(bool), frozen, study),
    }


def _beside_the_planner(
    records: Sequence[Numbers], method: str, success: Bool, frozen: FrozenScenes, study: Study
) -> Numbers:
    """Return jerk ratio and duration of successes relative to the planner's in the same scenes.

    Each is [median over seeds, least, greatest] of the medians over scenes, or None without the planner or a success.
    """
    path = jobs.baseline_path(frozen.env_id, frozen.name, "stored", study)
    result: Numbers = {"jerk": None, "duration": None}
    planner = jobs.stored(path, {"scenes": jobs.scenes(frozen.name, frozen.env_id, study).sha256})
    if planner is None:
        return result
    name = next(iter(planner["methods"]))
    solved = jobs.rate_table([planner], name, "is_success")[0, : success.shape[1]].astype(bool)
    for key, outcome in (("jerk", "jerk_ratio"), ("duration", "duration")):
        mine = jobs.rate_table(records, method, outcome)
        theirs = jobs.rate_table([planner], name, outcome)[0, : success.shape[1]]
        medians = [
            float(np.median(row[both] / theirs[both]))
            for row, both in zip(mine, success & solved, strict=True)
            if both.any()
        ]
        result[key] = [float(np.median(medians)), min(medians), max(medians)] if medians else None
    return result


def _interval(scores: NDArray[np.float64], strata: NDArray[np.int64]) -> list[float]:
    return list(across_seeds(scores, strata, np.random.default_rng(0)))


def _baselines(env: str, study: Study) -> list[Numbers]:
    found = []
    for name in (each for each in ("stored", *BASELINE_METHODS) if each in study.baselines):
        sets = {}
        for each in sets_of(env):
            frozen = jobs.scenes(each, env, study)
            record = jobs.stored(jobs.baseline_path(env, each, name, study), {"scenes": frozen.sha256})
            if record is not None:
                label = next(iter(record["methods"]))
                sets[each] = _numbers([record], label, frozen, study)
        if sets:
            found.append({"name": name, "label": label, "sets": sets})
    return found


def _curves(env: str, variant: Variant, study: Study) -> Numbers:
    """Return success on validation scenes, shape (points, seeds), and three clocks, medians over seeds."""
    curves = [Run(cell.folder(study)).curve for cell in finished(env, variant, study)]
    points = list(zip(*curves, strict=False))
    clocks = ("decisions", "simulated_seconds", "seconds")
    return {
        **{
            clock: [float(np.median([each[clock] for each in point])) for point in points] for clock in clocks
        },
        "success": [[each["success"]["rate"] for each in point] for point in points],
    }


def _failures(env: str, name: str, study: Study) -> Numbers:
    """Return the share of all scenes that fail by each kind, mean over seeds, for each decision mode."""
    records = _records(finished(env, WHOLE, study), name, study)
    number = len(jobs.scenes(name, env, study).share)
    ways = [way for way in (ALONE, CHECKED) if records and way in records[0]["failures"]]

    def share(way: str, kind: str, what: str) -> float:
        counts = [record["failures"][way][kind][what] for record in records]
        return float(np.mean(counts)) / number

    return {
        way: {
            kind.name: {
                "words": kind.description,
                "share": share(way, kind.name, "count"),
                "another": share(way, kind.name, "another"),
            }
            for kind in KINDS
        }
        for way in ways
    }


def improvement(methods: Sequence[Numbers]) -> Numbers:
    """Return the probability that a run of the whole agent, policy alone, beats a run of another algorithm (`test`)."""
    each = {m["name"]: m["sets"]["test"][ALONE]["each"] for m in methods if "test" in m["sets"]}
    mine = each.pop(WHOLE.name, None)
    if mine is None:
        return {}
    result = {}
    for name, others in each.items():
        generator = np.random.default_rng(0)
        interval = probability_of_improvement(mine, others, generator, samples=2000)
        result[name] = {"interval": list(interval), "pairs": len(mine) * len(others)}
    rounded: Numbers = _rounded(result)
    return rounded


def _compared(env: str, name: str, study: Study) -> Numbers:
    """Compare the agent with a search that checks as many plans, scene by scene; empty without such a search."""
    frozen = jobs.scenes(name, env, study)
    other = jobs.stored(
        jobs.baseline_path(env, name, f"search{study.checks}", study), {"scenes": frozen.sha256}
    )
    records = _records(finished(env, WHOLE, study), name, study)
    if other is None or not records:
        return {}
    second = jobs.rate_table([other], next(iter(other["methods"])), "is_success")[0] > 0.5
    first = jobs.rate_table(records, CHECKED, "is_success") > 0.5
    tests = [mcnemar(row, second) for row in first]
    differences = [test.difference for test in tests]
    return {
        "difference": [float(np.median(differences)), min(differences), max(differences)],
        "p_value": max(test.p_value for test in tests),
    }


def _freedom(env: str, study: Study) -> Numbers:
    """Return the numbers of agent and planner with more via-points and with learned timing."""
    planner = {}
    for variant in FREEDOM:
        frozen = jobs.scenes("test", env, study).take(slice(0, jobs.N_PLANNED))
        record = jobs.stored(jobs.planned_path(env, variant, study), {"scenes": frozen.sha256})
        if record is not None:
            planner[variant.name] = _numbers([record], next(iter(record["methods"])), frozen, study)
    return {"agents": _table(env, FREEDOM, FREEDOM_LABELS, study), "planner": planner}


def _rounded(value: Any) -> Any:
    """Round floats of nested values to a millionth."""
    if isinstance(value, dict):
        return {str(name): _rounded(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return round(float(value), 6) if isinstance(value, float | np.floating) else value
