"""Merging of new numbers with those of the page, so that a study can grow on more than one machine.

The numbers of the page outlive the run folders. Entries that were not measured again are kept if they are of the same
scenes. A new entry of a method replaces the old one if it has at least as many seeds and covers the same sets and
baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from study.aggregate import conditions, improvement
from study.plan import ABLATIONS, FREEDOM, METHODS, WHOLE, Study, Variant
from viapoint.envs.registration import TASKS
from viapoint.training.planners.baselines import METHODS as BASELINE_METHODS

Numbers = dict[str, Any]


def check_conditions(study: Study, old: Numbers) -> None:
    """Check that the old record has the conditions of the study.

    Raises:
        ValueError: The old record has other numbers of decisions, scenes or checks.
    """
    for name, mine in conditions(study).items():
        if mine != old.get(name):
            raise ValueError(
                f"{study.docs / 'results.json'} holds results with {name} = {old.get(name)}, these would be with "
                f"{mine}: name another folder with --docs, or replace them with --alone"
            )


def merged(new: Numbers, old: Numbers) -> Numbers:
    """Return the union of two records of the same conditions; old entries of other scenes are dropped."""
    environments = dict(old["environments"])
    others = [
        env
        for env, each in new["environments"].items()
        if env in environments and environments[env]["sets"] != each["sets"]
    ]
    for env, each in new["environments"].items():
        known = environments.get(env, each)
        environments[env] = each if env in others else _environment(each, known)
    old = {**old, **{name: _without(old[name], others) for name in ("ablations", "freedom")}}
    studied = {env: each for env, each in environments.items() if each["methods"] or each["baselines"]}
    return {
        **new,
        "seeds": sorted({*new["seeds"], *old["seeds"]}),
        "environments": {env: studied[env] for env in TASKS if env in studied},
        "ablations": _each(new["ablations"], old["ablations"], _ablations),
        "freedom": _each(new["freedom"], old["freedom"], _freedom),
    }


def _without(numbers: Numbers, environments: Sequence[str]) -> Numbers:
    return {env: each for env, each in numbers.items() if env not in environments}


def _each(new: Numbers, old: Numbers, join: Callable[[Any, Any], Any]) -> Numbers:
    """Join the entries of two records by environment."""
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
    """Join two records of an environment; comparisons of the whole agent come from the record of its entry."""
    complete = all(_covers(new[name], old[name]) for name in ("failures", "compared"))
    found = [each for each in new["methods"] if complete or each["name"] != WHOLE.name]
    methods = _joined(found, old["methods"], METHODS)
    mine = {each["name"] for each in methods if each in new["methods"]}
    whole = new if WHOLE.name in mine else old
    baselines = {each["name"]: each for each in old["baselines"]}
    for each in new["baselines"]:
        known = baselines.get(each["name"], each)["sets"]
        sets = {name: found for name, found in each["sets"].items() if _covers(found, known.get(name))}
        baselines[each["name"]] = {**each, "sets": {**known, **sets}}
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
    """Return one entry of each method."""
    entries = {each["name"]: each for each in old}
    for each in new:
        known = entries.get(each["name"], {"seeds": [], "sets": {}})
        if len(each["seeds"]) >= len(known["seeds"]) and _covers(each["sets"], known["sets"]):
            entries[each["name"]] = each
    return [entries[name] for name in _names(order, entries)]


def _covers(new: Any, old: Any) -> bool:
    """Return whether new numbers have a value wherever the old ones do."""
    if isinstance(old, dict):
        return not old or (isinstance(new, dict) and all(_covers(new.get(name), old[name]) for name in old))
    return old is None or new is not None


def _names(order: Sequence[Variant], known: Iterable[str]) -> list[str]:
    there = set(known)
    return [variant.name for variant in order if variant.name in there]
