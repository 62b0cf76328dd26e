"""Record of a study: every number of its page and figures, from the files of its measurements.

A row keeps the measurements of each run: which scenes it solved, medians of jerk and time, cost and learning curve.
So its numbers may outlive the files that they came from, and a row can grow seed by seed on several machines.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viapoint.envs.common.types import Bool, Float
from viapoint.training.evaluation.statistics import (
    across_seeds,
    interquartile_mean,
    mcnemar,
    probability_of_improvement,
)
from viapoint.training.io.files import read_json
from viapoint.training.io.installed import versions
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import resolved
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes
from viapoint.training.study.config import FIXED, Agent, Baseline, Environment, Mode, Study
from viapoint.training.study.jobs import (
    PACE,
    baseline_record,
    evaluation_path,
    identity_of,
    sets_of,
    stored,
    times_of,
    trained,
    weights_hash,
    with_checks,
)

CLOCKS = ("decisions", "simulated_seconds", "seconds")
"""Clocks of a learning curve."""

Numbers = dict[str, Any]
Runs = Sequence[Numbers]
"""Measurements of a row, an entry for each seed, or one entry of a baseline.

Entries are `sets` (see :func:`in_one_set`), of an agent `seed`, `training` and perhaps `curve`, of a search of equal
time `checks`.
"""


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
            made: Any = {
                "training": dict(entry.training),
                "step_wise": entry.step_wise,
                "settings": _settings(entry, env),
            }
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
    """Return the record of a study from its files, and from the runs of an earlier record that have no files here."""
    record: Numbers = {
        "study": study.name,
        "versions": versions(),
        "environments": {
            env.name: _environment(study, env, (before or {}).get("environments", {}).get(env.name, {}))
            for env in study.environments
        },
    }
    plain: Numbers = _plain(record)
    return plain


def _plain(record: Any) -> Any:
    """Return plain values as JSON holds them, with six digits."""
    return json.loads(json.dumps(record), parse_float=lambda digits: round(float(digits), 6))


def _settings(agent: Agent, env: Environment) -> Numbers:
    """Return all settings of an agent's training, those of the preset too."""
    config = resolved(agent.config(env, agent.seeds[0], Path())).as_json()
    return {name: value for name, value in config.items() if name not in (*FIXED, *PACE)}


def _environment(study: Study, env: Environment, known: Numbers) -> Numbers:
    """Return the numbers of an environment."""
    sets = sets_of(env)
    described = {name: _described(frozen) for name, frozen in sets.items()}
    old_sets = {name: each["sha256"] for name, each in known.get("sets", {}).items()}
    same = [name for name, each in described.items() if old_sets.get(name) == each["sha256"]]
    old = {each["row"]: each for each in known.get("rows", [])}
    times, planner = times_of(study, env), _planner(study, env, sets)
    rows = []
    for row in rows_in(study, env):
        wanted = row.described(env)
        kept = _kept(old.get(row.id), wanted, same)
        measured = _plain(list(_runs(study, env, row, sets, planner)))  # rounded as the earlier record
        runs = _merged((kept or {}).get("runs", []), measured)
        new = _measured(env, row, runs) if runs else None
        chosen = new if new is not None and (kept is None or _covers(new, kept)) else kept
        if chosen is not None:
            time = times.get(row.id, {}).get("median", (kept or {}).get("decision_time"))
            time = time if row.entry.timed else None
            rows.append({**wanted, **chosen, "decision_time": time})
    compared = _comparisons(study.compare, rows)
    return {"id": env.id, "sets": described, "rows": rows, "compared": compared}


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


def _runs(
    study: Study, env: Environment, row: Row, sets: Mapping[str, FrozenScenes], planner: Mapping[str, Numbers]
) -> Iterator[Numbers]:
    """Yield the runs of a row whose measurements are in files of the study."""
    if isinstance(row.entry, Baseline):
        records = _baseline_records(study, env, row.entry, sets)
        if records:
            checks = next(iter(records.values()))["made"]["checks"]
            equal_time = {} if row.entry.time_of is None else {"checks": checks}
            yield {**equal_time, "sets": _in_sets(records, planner)}
        return
    mode = row.mode or Mode()
    for cell in trained(study, env, row.entry):
        run = Run(study.out / cell.folder)
        found = {
            name: stored(run.folder / evaluation_path(name, mode), identity_of(frozen, run.best, mode))
            for name, frozen in sets.items()
        }
        records = {name: record for name, record in found.items() if record is not None}
        if records:
            own = {"curve": _curve(run), "weights": weights_hash(run.best)} if mode == Mode() else {}
            yield {"seed": cell.seed, "training": _training(run), **own, "sets": _in_sets(records, planner)}


def _baseline_records(
    study: Study, env: Environment, baseline: Baseline, sets: Mapping[str, FrozenScenes]
) -> dict[str, Numbers]:
    """Return the stored measurements of a baseline by set."""
    found = with_checks(study, env, baseline)
    if found is None:
        return {}
    records = {
        name: baseline_record(study, found, env, name, frozen) for name, frozen in sets_of(env, found).items()
    }
    return {name: record for name, record in records.items() if record is not None and name in sets}


def _training(run: Run) -> Numbers:
    """Return decisions and times of a training, its cores, and why it stopped.

    `wall_seconds` is with validation, `seconds` without.
    """
    if not run.curve:
        return {}
    cores = run.folder / "cores.json"
    last = {name: run.curve[-1][name] for name in CLOCKS}
    return {
        **last,
        "wall_seconds": run.curve[-1].get("wall_seconds"),
        "cores": read_json(cores)["cores"] if cores.is_file() else None,
        "stopped": run.stopped,
    }


def _curve(run: Run) -> Numbers:
    """Return the success on validation scenes, and the clocks at these points, shape (points,) each."""
    clocks = {clock: [each[clock] for each in run.curve] for clock in CLOCKS}
    return {**clocks, "success": [each["success"]["rate"] for each in run.curve]}


def _in_sets(records: Mapping[str, Numbers], planner: Mapping[str, Numbers]) -> Numbers:
    return {name: in_one_set(record, planner.get(name)) for name, record in records.items()}


def in_one_set(record: Numbers, planner: Numbers | None) -> Numbers:
    """Return the numbers of a run in a set.

    `solved` says which scenes it solved (see :func:`packed`). `jerk_ratio` and `time`, the duration of the movement
    [s], are medians of successes; `jerk` and `duration` are medians of jerk and duration as multiples of the planner's,
    in the scenes that both solved.
    """
    outcomes = {name: np.asarray(values, dtype=float) for name, values in record["outcomes"].items()}
    solved = outcomes["is_success"] > 0.5
    number, theirs = len(solved), {} if planner is None else planner["outcomes"]
    both = solved & (np.asarray(theirs.get("is_success", np.zeros(number)))[:number] > 0.5)

    def beside(name: str) -> float | None:
        return _median(outcomes[name][both] / np.asarray(theirs[name])[:number][both]) if both.any() else None

    return {
        "scenes": number,
        "solved": packed(solved),
        "collision": float(outcomes["collision"].mean()),
        "jerk_ratio": _median(outcomes["jerk_ratio"][solved]),
        "time": _median(outcomes["duration"][solved]),
        "jerk": beside("jerk_ratio"),
        "duration": beside("duration"),
    }


def packed(solved: Bool) -> str:
    """Return booleans as text: eight a byte, the first in the highest bit, bytes in base 64."""
    return base64.b64encode(np.packbits(solved).tobytes()).decode()


def unpacked(text: str, number: int) -> Bool:
    """Return the booleans of a text, shape (number,)."""
    return np.unpackbits(np.frombuffer(base64.b64decode(text), np.uint8), count=number).astype(bool)


def _measured(env: Environment, row: Row, runs: Runs) -> Numbers:
    """Return the numbers of a row: those of the runs that are measured on all sets on which any is."""
    sets = sets_of(env, row.entry if isinstance(row.entry, Baseline) else None)
    names = [name for name in sets if any(name in run["sets"] for run in runs)]
    runs = [run for run in runs if all(name in run["sets"] for name in names)]
    found: Numbers = {
        "sets": {name: numbers_of([run["sets"][name] for run in runs], sets[name]) for name in names}
    }
    if isinstance(row.entry, Agent):
        found |= {
            "seeds": [run["seed"] for run in runs],
            "training": _efforts([run["training"] for run in runs]),
        }
        if row.mode == Mode():
            found["curve"] = _curves([run["curve"] for run in runs])
    elif row.entry.time_of is not None:
        found["checks"] = runs[0]["checks"]
    return {**found, "runs": list(runs)}


def _efforts(trainings: Sequence[Numbers]) -> Numbers:
    """Return decisions and times of the trainings of a row: medians over seeds, and the wall times of each."""
    some = [each for each in trainings if each]
    if not some:
        return {}
    return {
        "decisions": int(np.median([each["decisions"] for each in some])),
        "simulated_seconds": float(np.median([each["simulated_seconds"] for each in some])),
        "seconds": [each["seconds"] for each in some],
        "wall_seconds": [each["wall_seconds"] for each in some if each.get("wall_seconds") is not None],
        "cores": sorted({each["cores"] for each in some if each["cores"] is not None}),
        "stopped": sorted({each["stopped"] for each in some if each["stopped"] is not None}),
    }


def _curves(curves: Sequence[Numbers]) -> Numbers:
    """Return success on validation scenes, shape (points, seeds), and three clocks, medians over seeds."""
    clocks = {
        clock: [float(np.median(point)) for point in zip(*(each[clock] for each in curves), strict=False)]
        for clock in CLOCKS
    }
    points = zip(*(each["success"] for each in curves), strict=False)
    return {**clocks, "success": [list(point) for point in points]}


def numbers_of(runs: Runs, frozen: FrozenScenes) -> Numbers:
    """Return the numbers of a row on a set from those of its runs.

    `success` is the interquartile mean over seeds with its 95 % interval, `each` the share of scenes that each seed
    solved. `jerk_ratio` and `time` are medians over seeds; `jerk` and `duration` are median, least and greatest over
    seeds (see :func:`in_one_set`).
    """
    number = runs[0]["scenes"]
    solved = np.array([unpacked(run["solved"], number) for run in runs])
    frozen = frozen.take(slice(0, number))

    def interval(some: Bool) -> list[float]:
        return list(across_seeds(solved[:, some], frozen.band[some], np.random.default_rng(0)))

    def known(name: str) -> list[float]:
        return [run[name] for run in runs if run[name] is not None]

    def over_seeds(name: str) -> list[float] | None:
        values = known(name)
        return [float(np.median(values)), min(values), max(values)] if values else None

    families = [str(each) for each in np.unique(frozen.family) if each]
    return {
        "scenes": number,
        "success": interval(np.ones(number, dtype=bool)),
        "each": solved.mean(axis=1).tolist(),
        "by_band": {
            band: interval(frozen.band == i) for i, band in enumerate(BANDS) if (frozen.band == i).any()
        },
        "by_family": {each: interval(frozen.family == each) for each in families},
        "collision": float(interquartile_mean(np.array(known("collision")))),
        "jerk_ratio": _median(known("jerk_ratio")),
        "time": _median(known("time")),
        "jerk": over_seeds("jerk"),
        "duration": over_seeds("duration"),
    }


def _median(values: Float | Sequence[float]) -> float | None:
    """Return the median; None without values."""
    return float(np.median(values)) if len(values) else None


def _planner(study: Study, env: Environment, sets: Mapping[str, FrozenScenes]) -> Mapping[str, Numbers]:
    """Return the measurement of the planner's stored solutions on each set that has one."""
    for each in study.baselines:
        if each.method == "stored" and env.name in each.environments:
            return _baseline_records(study, env, each, sets)
    return {}


def _kept(old: Numbers | None, wanted: Numbers, same: Sequence[str]) -> Numbers | None:
    """Return the measured entries of an earlier row of the same method, on scenes that are the same."""
    if old is None or old.get("made") != wanted["made"]:
        return None
    names = ("seeds", "training", "curve", "decision_time", "checks")
    kept = {name: old[name] for name in names if name in old}
    kept["sets"] = {name: each for name, each in old["sets"].items() if name in same}
    runs = [
        {**run, "sets": {name: each for name, each in run["sets"].items() if name in same}}
        for run in old.get("runs", [])
    ]
    return {**kept, "runs": [run for run in runs if run["sets"]]} if kept["sets"] else None


def _merged(old: Runs, new: Runs) -> list[Numbers]:
    """Return the runs of both, by seed; a new one replaces an old one if it has a number wherever that has one."""
    merged = {run.get("seed"): run for run in old}
    for run in new:
        before = merged.get(run.get("seed"))
        if before is None or _has_all(run["sets"], before["sets"]):
            merged[run.get("seed")] = run
    return [merged[seed] for seed in sorted(merged, key=lambda seed: seed or 0)]


def _covers(new: Numbers, old: Numbers) -> bool:
    """Return whether a new row has as many seeds as an old one, and a number wherever that has one."""
    return len(new.get("seeds", [])) >= len(old.get("seeds", [])) and _has_all(new["sets"], old["sets"])


def _has_all(new: Numbers, old: Numbers) -> bool:
    """Return whether the numbers by set are known wherever old ones are; without successes there is no jerk."""
    return all(
        name in new
        and (
            new[name]["jerk_ratio"] is None
            or all(new[name].get(key) is not None for key in each if each[key] is not None)
        )
        for name, each in old.items()
    )


def _comparisons(wanted: Sequence[tuple[str, str]], rows: Sequence[Numbers]) -> list[Numbers]:
    """Compare pairs of rows: agents run by run, an agent and a baseline scene by scene if runs are known."""
    by_id = {each["row"]: each for each in rows}
    result = []
    for pair in wanted:
        if not all(row in by_id for row in pair):
            continue
        first, second = (by_id[row] for row in pair)
        entry: Numbers = {"first": pair[0], "second": pair[1], "sets": {}}
        for name in (each for each in first["sets"] if each in second["sets"]):
            if second["kind"] == "agent":
                entry["sets"][name] = _improvement(first["sets"][name]["each"], second["sets"][name]["each"])
            elif first.get("runs") and second.get("runs"):
                entry["sets"][name] = _scene_by_scene(
                    *(_solved(each["runs"], name) for each in (first, second))
                )
        result += [entry] if entry["sets"] else []
    return result


def _solved(runs: Runs, name: str) -> Bool:
    """Return which scenes of a set each run solved, shape (runs, scenes)."""
    return np.array([unpacked(run["sets"][name]["solved"], run["sets"][name]["scenes"]) for run in runs])


def _improvement(first: Sequence[float], second: Sequence[float]) -> Numbers:
    """Return the probability that a run of the first is better than one of the second."""
    interval = probability_of_improvement(first, second, np.random.default_rng(0), samples=2000)
    return {"probability": list(interval), "pairs": len(first) * len(second)}


def _scene_by_scene(first: Bool, second: Bool) -> Numbers:
    """Return the difference of success: its median, least and greatest value over seeds, and extreme p-values."""
    tests = [mcnemar(solved, second[0]) for solved in first]
    differences = [test.difference for test in tests]
    return {
        "difference": [float(np.median(differences)), min(differences), max(differences)],
        "p_values": [extreme(test.p_value for test in tests) for extreme in (min, max)],
    }
