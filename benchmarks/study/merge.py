"""New numbers beside those that the page holds already, so that a study can grow on more than one machine.

A page's numbers outlive the run folders they come from. What was not measured again stays as it is, as long as it was
measured on the same scenes; of one method the entry with more seeds counts, of equally many the new one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from study.gather import improvement
from study.plan import ABLATIONS, FREEDOM, METHODS, WHOLE, Variant
from viapoint.envs.registration import TASKS
from viapoint.training.baselines import METHODS as BASELINE_METHODS

Numbers = dict[str, Any]
CONDITIONS = ("trial", "candidates")
"""What must be the same in two records for their numbers to stand side by side."""


def merged(new: Numbers, old: Numbers) -> Numbers:
    """A record of what is in either; nothing of the old one where it was measured under other conditions."""
    if any(new[name] != old[name] for name in CONDITIONS):
        return new
    environments = {env: dict(each) for env, each in old["environments"].items()}
    for env, each in new["environments"].items():
        known = environments.get(env, each)
        same = known["sets"] == each["sets"]
        environments[env] = _environment(each, known) if same else each
    studied = {env: each for env, each in environments.items() if each["methods"] or each["baselines"]}
    return {
        **new,
        "seeds": sorted({*new["seeds"], *old["seeds"]}),
        "environments": {env: studied[env] for env in TASKS if env in studied},
        "ablations": _each(new["ablations"], old["ablations"], _ablations),
        "freedom": _each(new["freedom"], old["freedom"], _freedom),
    }


def _each(new: Numbers, old: Numbers, join: Callable[[Any, Any], Any]) -> Numbers:
    """What is in either, by environment."""
    return {
        env: join(new[env], old[env]) if env in new and env in old else {**old, **new}[env]
        for env in {**old, **new}
    }


def _ablations(new: Sequence[Numbers], old: Sequence[Numbers]) -> list[Numbers]:
    return _joined(new, old, ABLATIONS)


def _freedom(new: Numbers, old: Numbers) -> Numbers:
    return {
        "agents": _joined(new["agents"], old["agents"], FREEDOM),
        "planner": {**old["planner"], **new["planner"]},
    }


def _environment(new: Numbers, old: Numbers) -> Numbers:
    """One environment's; what compares or describes the whole agent comes from where its entry does."""
    methods = _joined(new["methods"], old["methods"], METHODS)
    mine = {each["name"] for each in methods if each in new["methods"]}
    whole = new if WHOLE.name in mine else old
    baselines = {each["name"]: each for each in (*old["baselines"], *new["baselines"])}
    return {
        "sets": new["sets"],
        "methods": methods,
        "baselines": [baselines[name] for name in ("stored", *BASELINE_METHODS) if name in baselines],
        "decision_time": {**old["decision_time"], **new["decision_time"]},
        "curves": {
            name: (new if name in mine or name not in old["curves"] else old)["curves"][name]
            for name in _names(METHODS, {*new["curves"], *old["curves"]})
        },
        "failures": whole["failures"],
        "improvement": improvement(methods),
        "compared": whole["compared"],
    }


def _joined(new: Sequence[Numbers], old: Sequence[Numbers], order: Sequence[Variant]) -> list[Numbers]:
    """One entry of each method."""
    entries = {each["name"]: each for each in old}
    for each in new:
        known = entries.get(each["name"], each)
        entries[each["name"]] = each if len(each["seeds"]) >= len(known["seeds"]) else known
    return [entries[name] for name in _names(order, entries)]


def _names(order: Sequence[Variant], known: Iterable[str]) -> list[str]:
    there = set(known)
    return [variant.name for variant in order if variant.name in there]
