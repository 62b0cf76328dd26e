"""Page docs/results.md from the record: prose is a template, and every number comes from the record."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from study.jobs import ALONE, CHECKED, N_PLANNED, WAYS
from study.plan import FREEDOM_LABELS, WHOLE, short
from study.prose import FAILURES, FREEDOM, INTRODUCTION, KNOWLEDGE, TAGS
from viapoint.training.runs import callback
from viapoint.training.scene_sets.scene_set import BANDS

Numbers = Mapping[str, Any]
Rows = list[list[str]]


def page(record: Numbers) -> str:
    """Return the whole page as Markdown."""
    parts = [INTRODUCTION.format(seeds=_seeds(record)), KNOWLEDGE]
    parts += [_environment(env, each) for env, each in record["environments"].items()]
    parts.append(FAILURES)
    parts += [_ablations(env, each) for env, each in record["ablations"].items() if len(each) > 1]
    parts += [
        _freedom(env, each, record)
        for env, each in record["freedom"].items()
        if len(each["agents"]) > 1 or each["planner"]
    ]
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    parts += [_tags(), f"Made with {versions}."]
    return "\n".join(part.strip() + "\n" for part in parts)


def _seeds(record: Numbers) -> str:
    """Return a sentence about the seeds that are included."""
    wanted = record["seeds"]
    entries = [
        (short(env), entry) for env, each in record["environments"].items() for entry in each["methods"]
    ]
    entries += [(short(env), entry) for env, each in record["ablations"].items() for entry in each]
    entries += [(short(env), entry) for env, each in record["freedom"].items() for entry in each["agents"]]
    partial = {f"{env}, {e['name']}: {_listed(e['seeds'])}" for env, e in entries if e["seeds"] != wanted}
    text = f"Seeds asked for: {_listed(wanted)}."
    trial = {name: value for name, value in record["trial"].items() if value is not None}
    if trial:
        text += " **A trial, not a result**: " + ", ".join(f"{n} = {v}" for n, v in trial.items()) + "."
    if not entries:
        return f"{text} None is in yet."
    if not partial:
        return f"{text} All of them are in."
    return f"{text} **Not all of them are in**; what there is: " + "; ".join(sorted(partial)) + "."


def _environment(env: str, numbers: Numbers) -> str:
    """Return the section of one environment: figure, tables and comparisons."""
    lines = [f"## {short(env)}"]
    if numbers["methods"]:
        lines.append(f"![Learning curves and success by band](images/{figure_name(env)})")
    for name, about in numbers["sets"].items():
        rows = _rows(numbers, name, about)
        if rows:
            lines.append(f"**{name}**: {about['scenes']:,} scenes, sha256 `{about['sha256'][:12]}`.")
            lines.append(_table(rows))
            lines.append(_families(numbers, name, about))
            lines.append(_comparison(numbers, name))
            lines.append(_failure_table(numbers["failures"].get(name, {}), name))
    lines.append(_improvement(numbers["improvement"]))
    return "\n\n".join(line for line in lines if line)


def figure_name(env: str) -> str:
    """Return the file name of an environment's figure."""
    words = re.findall("[A-Z][a-z]*", short(env).partition("-")[0])
    return "_".join(["results", *words]).lower() + ".png"


def _rows(numbers: Numbers, name: str, about: Numbers) -> Rows:
    """Return the rows of all methods on one set."""
    bands = [band for band in BANDS if about["bands"][band]] if sum(about["bands"].values()) else []
    head = ["method", "seeds", "success (95 %)", *bands, "jerk / planner", "duration / planner", "decision"]
    head += ["minutes (cores)", "decisions", "simulated"]
    rows = []
    for entry in numbers["methods"]:
        for way, found in entry["sets"].get(name, {}).items():
            label = f"{entry['label']}, {WAYS[way]}"
            time = _ms(numbers["decision_time"].get(f"{entry['name']} {way}"))
            seeds = str(len(entry["seeds"]))
            rows.append([label, seeds, *_success(found, bands), *_beside(found), time, *_effort(entry)])
    for entry in numbers["baselines"]:
        if name in entry["sets"]:
            found = entry["sets"][name]
            time = _ms(
                numbers["decision_time"].get("planner" if entry["name"] == "stored" else entry["name"])
            )
            rows.append([entry["label"], "-", *_success(found, bands), *_beside(found), time, *["-"] * 3])
    return [head, *rows] if rows else []


def _success(found: Numbers, bands: Sequence[str]) -> list[str]:
    return [_interval(found["success"]), *(_percent(found["by_band"][band][0]) for band in bands)]


def _beside(found: Numbers) -> list[str]:
    return ["-" if found[key] is None else _multiple(found[key][0]) for key in ("jerk", "duration")]


def _multiple(value: float) -> str:
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2f}"


def _effort(entry: Numbers) -> list[str]:
    training = entry["training"]
    seconds = sorted(training["seconds"])
    minutes = seconds[len(seconds) // 2] / 60.0
    cores = "-".join(str(each) for each in training["cores"])
    simulated = f"{training['simulated_seconds'] / 3600:.1f} h"
    return [f"{minutes:.1f} ({cores or '?'})", f"{training['decisions']:,}", simulated]


def _families(numbers: Numbers, name: str, about: Numbers) -> str:
    """Return a table of success by family of scenes, empty where a set has no families."""
    families = about["families"]
    if not families:
        return ""
    rows = [["method", *(f"{family} ({count})" for family, count in families.items())]]
    for entry in numbers["methods"]:
        for way, found in entry["sets"].get(name, {}).items():
            label = f"{entry['label']}, {WAYS[way]}"
            rows.append([label, *(_interval(found["by_family"][family]) for family in families)])
    for entry in numbers["baselines"]:
        if name in entry["sets"]:
            found = entry["sets"][name]["by_family"]
            rows.append([entry["label"], *(_interval(found[family]) for family in families)])
    return "By family:\n\n" + _table(rows)


def _comparison(numbers: Numbers, name: str) -> str:
    """Compare checked proposals with a search that checks as many plans."""
    found = numbers["compared"].get(name)
    if not found:
        return ""
    middle, least, most = (100.0 * each for each in found["difference"])
    p = found["p_value"]
    shown = "p < 0.0001" if p < 1e-4 else f"p <= {p:.2g}"
    if not (least or most):
        return "The agent with checked proposals solves as many scenes as the search with as many checks."
    return (
        f"Success of {WHOLE.label} with checked proposals minus that of the search with as many checks: {middle:+.1f} "
        f"points (median seed; {least:+.1f} to {most:+.1f}); exact McNemar test scene by scene, {shown} in every seed."
    )


def _failure_table(found: Numbers, name: str) -> str:
    """Return a table of failures by kind."""
    if not found:
        return ""
    kinds = next(iter(found.values()))
    head = ["how it fails"]
    for way in found:
        head += [WAYS[way], "another proposal succeeds"]
    rows = [head]
    for kind, about in kinds.items():
        line = [about["words"]]
        for each in found.values():
            line += [_percent(each[kind]["share"]), _percent(each[kind]["another"])]
        rows.append(line)
    return (
        f"Failures of {WHOLE.label} in the {name} scenes, in percent of all scenes, mean over seeds (pictures: "
        f"`viapoint evaluate RUN --scenes {name} --failures DIR`):\n\n" + _table(rows)
    )


def _improvement(found: Numbers) -> str:
    if not found:
        return ""
    each = ", ".join(
        f"{name} {_interval(value['interval'])}, {value['pairs']} pairs of runs"
        for name, value in found.items()
    )
    return (
        f"Probability that a run of {WHOLE.label}, policy alone, does better on the test scenes than a run of another "
        f"algorithm: {each}."
    )


def _ablations(env: str, entries: Sequence[Numbers]) -> str:
    """Return the section of ablations."""
    lines = [f"## What each part contributes: {short(env)}"]
    whole = entries[0]
    for name in whole["sets"]:
        rows = [["agent", "seeds", "policy alone", "< 1 %", "checked proposals", "< 1 %", "jerk / planner"]]
        for entry in entries:
            found = entry["sets"].get(name)
            if found:
                label = "the whole agent" if entry["name"] == WHOLE.name else entry["label"]
                ways = [found[ALONE], found.get(CHECKED)]
                cells = [cell for way in ways for cell in _with_rarest(way)]
                rows.append([label, str(len(entry["seeds"])), *cells, _beside(found[ALONE])[0]])
        lines += [f"**{name}**:", _table(rows)]
    return "\n\n".join(lines)


def _with_rarest(found: Numbers | None) -> list[str]:
    if found is None:
        return ["-", "-"]
    rare = found["by_band"].get(BANDS[-1])
    return [_interval(found["success"]), "-" if rare is None else _percent(rare[0])]


def _freedom(env: str, found: Numbers, record: Numbers) -> str:
    """Return the section of action spaces: number of via-points and timing."""
    lines = [FREEDOM.format(planned=N_PLANNED).replace("pay?", f"pay? {short(env)}", 1).strip()]
    sets = list(dict.fromkeys(name for entry in found["agents"] for name in entry["sets"]))
    for name in sets:
        rows = [["agent", "seeds", "success (95 %)", *BANDS, "checked proposals", "jerk / planner"]]
        for entry in (each for each in found["agents"] if name in each["sets"]):
            one = entry["sets"][name]
            bands = [
                _percent(one[ALONE]["by_band"][b][0]) if b in one[ALONE]["by_band"] else "-" for b in BANDS
            ]
            cells = [_interval(one[ALONE]["success"]), *bands, _with_rarest(one.get(CHECKED))[0]]
            rows.append([entry["label"], str(len(entry["seeds"])), *cells, _beside(one[ALONE])[0]])
        lines += [f"**{name}**, policy alone:", _table(rows), _answer(found["agents"], name)]
    if found["planner"]:
        rows = [["planner", "success (95 %)", "jerk / stored", "duration / stored"]]
        for name, each in found["planner"].items():
            rows.append([FREEDOM_LABELS[name], _interval(each["success"]), *_beside(each)])
        lines.append(_table(rows))
    return "\n\n".join(line for line in lines if line)


def _answer(entries: Sequence[Numbers], name: str) -> str:
    """Return a sentence that compares the best action space of each band with one via-point."""
    here = [entry for entry in entries if name in entry["sets"]]
    if len(here) < 2 or here[0]["name"] != WHOLE.name:
        return ""
    base, parts = here[0]["sets"][name][ALONE]["by_band"], []
    for band in base:
        best = max(here, key=lambda entry: entry["sets"][name][ALONE]["by_band"][band][0])
        mine, theirs = base[band], best["sets"][name][ALONE]["by_band"][band]
        gain = 100.0 * (theirs[0] - mine[0])
        if best is here[0] or gain <= 0.0:
            parts.append(f"{band}: nothing is better than {here[0]['label']}")
        else:
            sure = "the intervals are apart" if theirs[1] > mine[2] else "the intervals overlap"
            parts.append(f"{band}: {best['label']}, {gain:+.1f} points, {sure}")
    return "Best in each band, against one via-point with optimal timing: " + "; ".join(parts) + "."


def _tags() -> str:
    """Return the section of TensorBoard tags."""
    rows = [["tag", "meaning"], *([f"`{tag}`", words] for tag, words in TAGS.items())]
    known = {*callback.OUTCOMES, *callback.VALIDATED}
    assert known <= set(TAGS), known - set(TAGS)
    head = "## What TensorBoard shows\n\n`tensorboard --logdir runs/study` (or any run folder), besides `train/*`:"
    return f"{head}\n\n{_table(rows).replace('---:', '---')}"


def _table(rows: Rows) -> str:
    """Return a Markdown table without the columns in which no method has a value."""
    shown = [i for i in range(len(rows[0])) if i == 0 or any(row[i] != "-" for row in rows[1:])]
    lines = [[row[i] for i in shown] for row in rows]
    lines.insert(1, ["---"] + ["---:"] * (len(shown) - 1))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _percent(rate: float) -> str:
    return f"{100.0 * rate:.1f} %"


def _interval(values: Sequence[float]) -> str:
    estimate, low, high = (100.0 * value for value in values)
    return f"{estimate:.1f} % ({low:.1f}-{high:.1f})"


def _ms(seconds: float | None) -> str:
    return (
        "-" if seconds is None else f"{1e3 * seconds:.2g} ms" if seconds < 0.1 else f"{1e3 * seconds:.0f} ms"
    )


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(str(number) for number in numbers)
