"""Record of a study: every number of its page and figures, from the files of its measurements.

Numbers may outlive the files that they came from, so that a study can grow on several machines: a row of the earlier
record stays if it is of the same method and scenes, and nothing that covers as much has replaced it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.common.types import Bool, Float
from viapoint.training.evaluation.statistics import across_seeds, mcnemar, probability_of_improvement
from viapoint.training.io.files import read_json
from viapoint.training.io.installed import versions
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes
from viapoint.training.study.config import Agent, Baseline, Environment, Mode, Study
from viapoint.training.study.jobs import (
    Cell,
    baseline_record,
    evaluation_path,
    identity_of,
    sets_of,
    stored,
    times_of,
    trained,
    with_checks,
)

Numbers = dict[str, Any]
Records = Mapping[str, Sequence[Numbers]]
"""Measurements of a row by set, one for each seed."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a table, as the study asks for it."""

    entry: Agent | Baseline
    mode: Mode | None = None
    """Decision mode of an agent."""

    @property
    def id(self) -> str:
        """Id of the row."""
        return self.entry.name if self.mode is None else self.mode.row(self.entry.name)

    def described(self, env: Environment) -> Numbers:
        """Return the entries that say what the row is of."""
        entry, mode = self.entry, self.mode
        found: Numbers = {"row": self.id, "name": entry.name, "label": self._label()}
        if isinstance(entry, Agent):
            mode = mode or Mode()
            found |= {"kind": "agent", "seeds_wanted": list(entry.seeds), **mode._asdict()}
            made: Any = {"training": dict(entry.training), "step_wise": entry.step_wise}
        else:
            found |= {"kind": "baseline", "method": entry.method, "checks": entry.checks}
            fields = ("method", "checks", "time_of", "env_kwargs", "scenes", "n_scenes")
            made = {name: getattr(entry, name) for name in fields}
        made |= {
            "env_kwargs of the environment": dict(env.env_kwargs),
            "n_scenes of the environment": env.n_scenes,
        }
        plain: Numbers = json.loads(json.dumps({**found, "made": made}))
        return plain

    def _label(self) -> str:
        """Return the label of the entry with the decision mode."""
        if self.mode is None:
            return self.entry.label
        checks, untrained, unrevised = self.mode
        words = {"untrained": untrained, "no revision": unrevised, f"{checks} checks": checks}
        return ", ".join([self.entry.label, *(word for word, said in words.items() if said)])


def rows_in(study: Study, env: Environment) -> list[Row]:
    """Return the rows of an environment in the order of the study."""
    here = [each for each in study.agents if env.name in each.environments]
    found = [Row(entry=agent, mode=mode) for agent in here for mode in agent.modes(env.id)]
    return found + [Row(entry=each) for each in study.baselines if env.name in each.environments]


def gather(study: Study, before: Numbers | None = None) -> Numbers:
    """Return the record of a study from its files; rows of an earlier record are kept that are not measured again."""
    record: Numbers = {
        "study": study.name,
        "versions": versions(),
        "environments": {
            env.name: _environment(study, env, (before or {}).get("environments", {}).get(env.name, {}))
            for env in study.environments
        },
    }
    plain: Numbers = json.loads(json.dumps(record), parse_float=lambda digits: round(float(digits), 6))
    return plain


def _environment(study: Study, env: Environment, known: Numbers) -> Numbers:
    """Return the numbers of an environment."""
    sets = sets_of(env)
    described = {name: _described(frozen) for name, frozen in sets.items()}
    old_sets = {name: each["sha256"] for name, each in known.get("sets", {}).items()}
    same = [name for name, each in described.items() if old_sets.get(name) == each["sha256"]]
    old = {each["row"]: each for each in known.get("rows", [])}
    times, planner = times_of(study, env), _planner(study, env, sets)
    rows, records = [], {}
    for row in rows_in(study, env):
        wanted = row.described(env)
        found = {name: some for name, some in _records(study, env, row, sets).items() if some}
        new = _measured(study, env, row, found, planner) if found else None
        kept = _kept(old.get(row.id), wanted, same)
        chosen = new if new is not None and (kept is None or _covers(new, kept)) else kept
        if chosen is None:
            continue
        time = times.get(row.id, {}).get("median", (kept or {}).get("decision_time"))
        rows.append({**wanted, **chosen, "decision_time": time})
        if chosen is new:
            records[row.id] = found
    return {
        "id": env.id,
        "sets": described,
        "rows": rows,
        "compared": _comparisons(study.compare, rows, records, known.get("compared", [])),
    }


def _described(frozen: FrozenScenes) -> Numbers:
    return {
        "scenes": len(frozen.share),
        "sha256": frozen.sha256,
        "bands": {
            band: int((frozen.band == i).sum()) for i, band in enumerate(BANDS) if (frozen.band == i).any()
        },
        "families": {
            str(each): int((frozen.family == each).sum()) for each in np.unique(frozen.family) if each
        },
    }


def _records(study: Study, env: Environment, row: Row, sets: Mapping[str, FrozenScenes]) -> Records:
    """Return the stored measurements of a row by set."""
    if isinstance(row.entry, Baseline):
        return _baseline_records(study, env, row.entry, sets)
    cells = trained(study, env, row.entry)
    mode = row.mode or Mode()
    return {
        name: [
            record for cell in cells if (record := _evaluation(study, cell, name, frozen, mode)) is not None
        ]
        for name, frozen in sets.items()
    }


def _baseline_records(
    study: Study, env: Environment, baseline: Baseline, sets: Mapping[str, FrozenScenes]
) -> Records:
    """Return the stored measurements of a baseline by set."""
    found = with_checks(study, env, baseline)
    if found is None:
        return {}
    records = {
        name: baseline_record(study, found, env, name, frozen) for name, frozen in sets_of(env, found).items()
    }
    return {name: [record] for name, record in records.items() if record is not None and name in sets}


def _evaluation(study: Study, cell: Cell, name: str, frozen: FrozenScenes, mode: Mode) -> Numbers | None:
    """Return the stored measurement of a trained agent, with its seed."""
    folder = study.out / cell.folder
    record = stored(folder / evaluation_path(name, mode), identity_of(frozen, Run(folder).best, mode))
    return None if record is None else {**record, "seed": cell.seed}


def _measured(
    study: Study, env: Environment, row: Row, records: Records, planner: Mapping[str, Numbers]
) -> Numbers:
    """Return the numbers of a row: those of the seeds that are measured on all sets on which any is."""
    sets = sets_of(env, row.entry if isinstance(row.entry, Baseline) else None)
    found: Numbers = {}
    if isinstance(row.entry, Agent):
        seeds = [{each["seed"] for each in some} for some in records.values()]
        common = sorted(set.intersection(*seeds))
        records = {name: [each for each in some if each["seed"] in common] for name, some in records.items()}
        cells = [each for each in trained(study, env, row.entry) if each.seed in common]
        found = {"seeds": common, "training": _training(cells, study)}
        if row.mode == Mode():
            found["curve"] = _curve(cells, study)
    elif row.entry.time_of is not None:
        found["checks"] = next(iter(records.values()))[0]["made"]["checks"]
    found["sets"] = {
        name: numbers_of(some, sets[name], planner.get(name)) for name, some in records.items() if some
    }
    return found


def _training(cells: Sequence[Cell], study: Study) -> Numbers:
    """Return the effort of the trainings: medians over seeds, and the wall time of each."""
    runs = [Run(study.out / cell.folder) for cell in cells]
    last = [run.curve[-1] for run in runs if run.curve]
    cores = [run.folder / "cores.json" for run in runs]
    if not last:
        return {}
    return {
        "decisions": int(np.median([each["decisions"] for each in last])),
        "simulated_seconds": float(np.median([each["simulated_seconds"] for each in last])),
        "seconds": [each["seconds"] for each in last],
        "cores": sorted({read_json(path)["cores"] for path in cores if path.is_file()}),
        "stopped": sorted({run.stopped for run in runs if run.stopped is not None}),
    }


def _curve(cells: Sequence[Cell], study: Study) -> Numbers:
    """Return success on validation scenes, shape (points, seeds), and three clocks, medians over seeds."""
    curves = [Run(study.out / cell.folder).curve for cell in cells]
    points = list(zip(*curves, strict=False))
    clocks = ("decisions", "simulated_seconds", "seconds")
    return {
        **{
            clock: [float(np.median([each[clock] for each in point])) for point in points] for clock in clocks
        },
        "success": [[each["success"]["rate"] for each in point] for point in points],
    }


def numbers_of(records: Sequence[Numbers], frozen: FrozenScenes, planner: Numbers | None) -> Numbers:
    """Return the numbers of a row on a set.

    `success` is the interquartile mean over seeds with its 95 % interval, `each` that of each seed, `jerk_ratio` and
    `time` [s] are medians of successes, then over seeds; `jerk` and `duration` are multiples of the planner's in the
    same scenes: median, least and greatest over seeds.
    """
    success = outcome(records, "is_success")
    frozen = frozen.take(slice(0, success.shape[1]))
    solved = success.astype(bool)

    def interval(some: Bool) -> list[float]:
        return list(across_seeds(success[:, some], frozen.band[some], np.random.default_rng(0)))

    families = [str(each) for each in np.unique(frozen.family) if each]
    return {
        "scenes": int(success.shape[1]),
        "success": interval(np.ones(success.shape[1], dtype=bool)),
        "each": success.mean(axis=1).tolist(),
        "by_band": {
            band: interval(frozen.band == i) for i, band in enumerate(BANDS) if (frozen.band == i).any()
        },
        "by_family": {each: interval(frozen.family == each) for each in families},
        "collision": float(outcome(records, "collision").mean()),
        "jerk_ratio": _median(outcome(records, "jerk_ratio"), solved),
        "time": _median(outcome(records, "duration"), solved),
        **_beside_planner(records, solved, planner),
    }


def outcome(records: Sequence[Numbers], name: str) -> Float:
    """Return an outcome in every scene, shape (records, scenes)."""
    return np.array([record["outcomes"][name] for record in records], dtype=float)


def _median(values: Float, chosen: Bool) -> float | None:
    """Return the median over seeds of the medians over chosen scenes; None if there is none."""
    medians = [np.median(row[some]) for row, some in zip(values, chosen, strict=True) if some.any()]
    return float(np.median(medians)) if medians else None


def _planner(study: Study, env: Environment, sets: Mapping[str, FrozenScenes]) -> Mapping[str, Numbers]:
    """Return the measurement of the planner's stored solutions on each set that has one."""
    stored_ones = [
        each for each in study.baselines if each.method == "stored" and env.name in each.environments
    ]
    if not stored_ones:
        return {}
    records = _baseline_records(study, env, stored_ones[0], sets)
    return {name: some[0] for name, some in records.items()}


def _beside_planner(records: Sequence[Numbers], success: Bool, planner: Numbers | None) -> Numbers:
    """Return jerk and duration of successes as multiples of the planner's in the same scenes."""
    if planner is None:
        return {"jerk": None, "duration": None}
    number, result = success.shape[1], {}
    both = success & outcome([planner], "is_success")[0, :number].astype(bool)
    for key, name in (("jerk", "jerk_ratio"), ("duration", "duration")):
        mine, theirs = outcome(records, name), outcome([planner], name)[0, :number]
        medians = [float(np.median(row[b] / theirs[b])) for row, b in zip(mine, both, strict=True) if b.any()]
        result[key] = [float(np.median(medians)), min(medians), max(medians)] if medians else None
    return result


def _kept(old: Numbers | None, wanted: Numbers, same: Sequence[str]) -> Numbers | None:
    """Return the measured entries of an earlier row of the same method, on scenes that are the same."""
    if old is None or old.get("made") != wanted["made"]:
        return None
    sets = {name: each for name, each in old["sets"].items() if name in same}
    names = ("seeds", "training", "curve", "decision_time", "checks")
    return {**{name: old[name] for name in names if name in old}, "sets": sets} if sets else None


def _covers(new: Numbers, old: Numbers) -> bool:
    """Return whether a new row has as many seeds as an old one, and a number wherever that has one."""
    fewer = len(new.get("seeds", [])) < len(old.get("seeds", []))
    return not fewer and all(
        name in new["sets"]
        and all(new["sets"][name].get(key) is not None for key in each if each[key] is not None)
        for name, each in old["sets"].items()
    )


def _comparisons(
    wanted: Sequence[tuple[str, str]],
    rows: Sequence[Numbers],
    records: Mapping[str, Records],
    old: Sequence[Numbers],
) -> list[Numbers]:
    """Compare pairs of rows: agents run by run, an agent and a baseline scene by scene."""
    by_id = {each["row"]: each for each in rows}
    result = []
    for pair in wanted:
        if not all(row in by_id for row in pair):
            continue
        first, second = (by_id[row] for row in pair)
        entry: Numbers = {"first": pair[0], "second": pair[1], "sets": {}}
        kept = next((each for each in old if (each["first"], each["second"]) == pair), None)
        for name in (each for each in first["sets"] if each in second["sets"]):
            if second["kind"] == "agent":
                entry["sets"][name] = _improvement(first["sets"][name]["each"], second["sets"][name]["each"])
            elif all(row in records for row in pair):
                entry["sets"][name] = _scene_by_scene(*(records[row][name] for row in pair))
            elif kept is not None and name in kept["sets"]:
                entry["sets"][name] = kept["sets"][name]
        result += [entry] if entry["sets"] else []
    return result


def _improvement(first: Sequence[float], second: Sequence[float]) -> Numbers:
    """Return the probability that a run of the first is better than one of the second."""
    interval = probability_of_improvement(first, second, np.random.default_rng(0), samples=2000)
    return {"probability": list(interval), "pairs": len(first) * len(second)}


def _scene_by_scene(first: Sequence[Numbers], second: Sequence[Numbers]) -> Numbers:
    """Return the difference of success: its median, least and greatest value over seeds, and extreme p-values."""
    other = outcome(second, "is_success")[0] > 0.5
    tests = [mcnemar(row, other) for row in outcome(first, "is_success") > 0.5]
    differences = [test.difference for test in tests]
    return {
        "difference": [float(np.median(differences)), min(differences), max(differences)],
        "p_values": [extreme(test.p_value for test in tests) for extreme in (min, max)],
    }
