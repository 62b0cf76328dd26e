"""Measure agents against the number of checks, and write the tables and the figure of docs/agent.md.

    python benchmarks/learning.py --methods viaq --tables results --only train evaluate   # the trainings, resumable
    python benchmarks/agent.py --runs runs/study

For every task and every seed with a trained agent below `--runs`: the agent with 0, 4, 16 and 64 checks and the
untrained network on the frozen `test` and `hard` scenes; for comparison searches without learning that check the same
numbers of plans, in the fixed order of a Sobol sequence or at random. What is measured is kept in `--out`, so a second
call goes on where the first stopped.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import re
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from viapoint.envs.registration import REPLANNING_TASKS, TASKS
from viapoint.training.algorithms.model_io import load_model, untrained
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.io.files import read_json, write_json
from viapoint.training.planners.baselines import SEARCHES, agent_method, make_method
from viapoint.training.rollouts.rollout import new_simulation
from viapoint.training.runs.trainer import one_thread
from viapoint.training.scene_sets.scene_set import load, shipped_path
from viapoint.training.search.candidates import candidate_actions
from viapoint.training.search.geometry_search import GeometrySearch, score_plans
from viapoint.training.search.plan_checks import CLEARANCE_MARGIN, REACH_MARGIN

CHECKS = (0, 4, 16, 64)
"""Checks of an agent's proposals."""
ORDERED = (1, 4, 16, 64, 256, 512)
"""Checks of plans without learning."""
MOVING_SCENES = 250
"""Scenes in which several decisions are made, at most."""
TIMED = 60
"""Decisions that are timed."""
SETS = ("test", "hard")


class RandomOrder:
    """Check plans that are drawn at random for each scene."""

    def __init__(self, task: Any, checks: int) -> None:
        self.name, self._task, self._checks = f"random, {checks} checks", task, checks
        self._generator = np.random.default_rng(0)

    def decide(self, observation: Any, scenes: Any) -> Any:
        """Return the best of random plans that have the duration of the greatest reward."""
        layout = candidate_actions(self._task, 2, replanning=False)[1]
        number, size = len(observation["hand"]), self._task.action.size
        actions = self._generator.uniform(-1.0, 1.0, (number, self._checks, size)).astype(np.float32)
        actions[..., self._task.action.n_via * self._task.action.dimension] = layout[
            self._task.action.n_via * self._task.action.dimension
        ]
        worth = score_plans(observation, actions, self._task, (CLEARANCE_MARGIN, REACH_MARGIN))
        return actions[np.arange(number), worth.argmax(axis=1)]


def main() -> None:
    """Measure, and write the page's parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/study"), help="folder of the trainings")
    parser.add_argument("--out", type=Path, default=Path("runs/agent"), help="folder for single measurements")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the page")
    parser.add_argument("--envs", nargs="*", default=None, help="ids; all that have agents if not given")
    parser.add_argument("--times", action="store_true", help="only time decisions anew, on an idle machine")
    parser.add_argument("--page", action="store_true", help="only write the page from what is measured")
    words = parser.parse_args()
    known = [*TASKS, *REPLANNING_TASKS]
    envs = words.envs or [each for each in known if seeds_of(words.runs, each)]
    unknown = [each for each in envs if each not in known]
    if unknown:
        parser.error(f"envs must be among {', '.join(known)}, got {unknown[0]}")
    with one_thread():
        for env in envs if not words.page else ():
            (time_anew if words.times else measure)(env, words)
    write_page(words)


def seeds_of(runs: Path, env: str) -> dict[int, Path]:
    """Return folders of the trained agents of an environment by seed."""
    found = {}
    for path in sorted((runs / env.rpartition("/")[2] / "viaq").glob("seed-*/best")):
        found[int(path.parent.name.removeprefix("seed-"))] = path
    return found


def measure(env: str, words: argparse.Namespace) -> None:
    """Measure everything of one environment that is not measured yet."""
    simulation = new_simulation(env, 2)
    for name in (each for each in SETS if shipped_path(each, env).is_file()):
        for seed, path in seeds_of(words.runs, env).items():
            for checks in CHECKS:
                once(words, env, name, f"viaq-{checks}-seed-{seed}", agent(path, checks))
            if seed == 0:
                for checks in (0, 64):
                    once(words, env, name, f"untrained-{checks}", agent(path, checks, trained=False))
        for checks in ORDERED:
            once(words, env, name, f"sobol-{checks}", lambda n=checks: GeometrySearch(simulation.task, n))
            if env not in REPLANNING_TASKS:
                once(words, env, name, f"random-{checks}", lambda n=checks: RandomOrder(simulation.task, n))
        for search in SEARCHES:
            once(words, env, name, search, lambda n=search: make_method(n, env))
    simulation.close()


def time_anew(env: str, words: argparse.Namespace) -> None:
    """Time single decisions of every method that is measured in an environment, with the agent of the first seed."""
    simulation = new_simulation(env, 2)
    seeds = seeds_of(words.runs, env)
    frozen = load("test", env).take(slice(0, TIMED))
    for file in sorted((words.out / env.rpartition("/")[2] / "test").glob("*.json")):
        kind, _, rest = file.stem.partition("-")
        number = int(rest.partition("-")[0]) if rest else 0
        if kind in ("viaq", "untrained"):
            method = agent(seeds[min(seeds)], number, trained=kind == "viaq")()
        elif kind in ("sobol", "random"):
            method = (
                GeometrySearch(simulation.task, number)
                if kind == "sobol"
                else RandomOrder(simulation.task, number)
            )
        else:
            method = make_method(file.stem, env)
        times = []
        for row in range(TIMED):
            scene = frozen.scenes.take(slice(row, row + 1))
            observation = simulation.observe(scene)
            began = time.perf_counter()
            method.decide(observation, scene)
            times.append(time.perf_counter() - began)
        write_json(file, {**read_json(file), "decision_time": statistics.median(times[1:])})
        print(env, file.stem, f"{1e3 * statistics.median(times[1:]):.2f} ms", flush=True)
    simulation.close()


def agent(path: Path, checks: int, *, trained: bool = True) -> Callable[[], Any]:
    """Return what makes the method of an agent, or of its network before training."""

    def make() -> Any:
        model = load_model(path)
        return agent_method(f"agent, {checks} checks", model if trained else untrained(model), checks)

    return make


def once(words: argparse.Namespace, env: str, scenes: str, name: str, make: Callable[[], Any]) -> None:
    """Measure a method on a set unless it is measured already."""
    path = words.out / env.rpartition("/")[2] / scenes / f"{name}.json"
    frozen = load(scenes, env)
    frozen = frozen.take(slice(0, MOVING_SCENES)) if env in REPLANNING_TASKS else frozen
    if path.is_file() and read_json(path)["sha256"] == frozen.sha256:
        return
    result = evaluate_methods([make()], frozen, env).results[0]
    summary = result.summary()
    names = ("success", "jerk_ratio", "duration", "decision_time", "success_by_band")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"sha256": frozen.sha256, **{each: summary[each] for each in names}})
    print(
        env,
        scenes,
        name,
        summary["success"]["rate"],
        summary["jerk_ratio"],
        summary["decision_time"],
        flush=True,
    )


def gathered(out: Path) -> dict[str, Any]:
    """Return every measurement as env -> set -> method -> record; seeds are joined into lists."""
    record: dict[str, Any] = {}
    for path in sorted(out.glob("*/*/*.json")):
        env, scenes = path.parts[-3:-1]
        name = re.sub(r"-seed-\d+$", "", path.stem)
        one, table = read_json(path), record.setdefault(env, {}).setdefault(scenes, {})
        entry = table.setdefault(name, {"success": [], "jerk_ratio": [], "decision_time": [], "scenes": None})
        entry["scenes"] = one["success"]["of"]
        for key, value in (
            ("success", one["success"]["rate"]),
            ("jerk_ratio", one["jerk_ratio"]),
            ("decision_time", one["decision_time"]),
        ):
            entry[key].append(value)
    return record


def write_page(words: argparse.Namespace) -> None:
    """Write docs/agent.json, the figure, and the table between the markers of docs/agent.md."""
    file = words.docs / "agent.json"
    record = read_json(file) if file.is_file() else {}
    record.setdefault("measured", {}).update(gathered(words.out))
    record["command"] = "python benchmarks/agent.py"
    write_json(file, record)
    draw(record["measured"], words.docs / "images" / "agent_checks.png")
    study = read_json(words.docs / "results.json")
    place(
        words.docs / "agent.md",
        "checks",
        table({k: v for k, v in record["measured"].items() if not is_replanning(k)}),
    )
    place(
        words.docs / "agents-replanning.md",
        "replanning",
        table({k: v for k, v in record["measured"].items() if is_replanning(k)}),
    )
    place(words.docs / "agent.md", "ablations", ablations(study))


def is_replanning(env: str) -> bool:
    """Return whether plans are revised in an environment."""
    return f"viapoint/{env}" in REPLANNING_TASKS


def place(page: Path, name: str, content: str) -> None:
    """Write a table between its markers in a page."""
    between = re.compile(rf"(<!-- table:{name} -->\n).*?(<!-- end -->)", re.DOTALL)
    page.write_text(between.sub(lambda found: found[1] + content + found[2], page.read_text()))


CHANGES = {
    "viaq": "places of the bodies, minimum, candidates (the agent)",
    "viaq-action": "action instead of places: minimum critic, candidates",
    "viaq-action-heads": "action instead of places: minimum critic with 8 heads, candidates",
    "viaq-sum": "action instead of places: pooled critic, candidates",
    "sac-minimum": "action instead of places: minimum critic, actor of SAC",
    "td3-minimum": "action instead of places: minimum critic, actor of TD3",
    "sac": "action instead of places: pooled critic, actor of SAC",
    "td3": "action instead of places: pooled critic, actor of TD3",
    "viaq-no-refinement": "the agent without refined candidates",
    "viaq-random": "the agent, trained on random actions only",
    "viaq-sparse": "the agent, trained without the clearance term of the reward",
}
"""Rows of the ablations by the name of their training."""


def ablations(study: dict[str, Any]) -> str:
    """Return the table of ablations as Markdown, from the results of the study."""
    lines = ["", "| critic and choice | seeds | `test` | `hard` |", "|---|---|---|---|"]
    for env, entries in study["ablations"].items():
        found = {each["name"]: each for each in entries}
        found |= {
            each["name"]: each for each in study["environments"][env]["methods"] if each["name"] in CHANGES
        }
        for name, label in CHANGES.items():
            if name in found:
                cells = [found[name]["sets"].get(each, {}).get("alone") for each in SETS]
                shown = [spread({"success": cell["each"]}) if cell else "-" for cell in cells]
                lines.append(f"| {label} | {len(found[name]['seeds'])} | {' | '.join(shown)} |")
    return "\n".join(lines) + "\n\n"


ROWS = {
    "viaq-0": "viaq, learned alone",
    "viaq-4": "viaq, 4 checks",
    "viaq-16": "viaq, 16 checks",
    "viaq-64": "viaq, 64 checks",
    "untrained-0": "viaq untrained",
    "untrained-64": "viaq untrained, 64 checks",
    "search16": "search, 16 checks",
    "search64": "search, 64 checks",
    "search512": "search, 512 checks",
    "search4096": "search, 4,096 checks",
}
"""Rows of the table by the name of their measurement."""


def table(record: dict[str, Any]) -> str:
    """Return the table as Markdown."""
    lines = [
        "",
        "| task | method | seeds | `test` | `hard` | jerk ratio (`test`) | time of a decision |",
        "|---|---|---|---|---|---|---|",
    ]
    for env, sets in record.items():
        for name, label in ROWS.items():
            entries = [sets.get(each, {}).get(name) for each in SETS]
            if entries[0] is None:
                continue
            test = entries[0]
            seeds = len(test["success"]) if name.startswith("viaq") else "-"
            jerk = [each for each in test["jerk_ratio"] if each is not None]
            lines.append(
                f"| {env} | {label} | {seeds} | {spread(entries[0])} | {spread(entries[1])} | "
                f"{statistics.mean(jerk):.2f} | {1e3 * statistics.median(test['decision_time']):.1f} ms |"
                if jerk
                else f"| {env} | {label} | {seeds} | {spread(entries[0])} | {spread(entries[1])} | - | - |"
            )
    return "\n".join(lines) + "\n\n"


def spread(entry: dict[str, Any] | None) -> str:
    """Return the mean of a rate over seeds, and its least and greatest value."""
    if entry is None:
        return "-"
    rates = [100.0 * each for each in entry["success"]]
    mean = f"{statistics.mean(rates):.1f} %"
    return mean if len(rates) == 1 else f"{mean} ({min(rates):.1f}-{max(rates):.1f})"


def draw(record: dict[str, Any], path: Path) -> None:
    """Draw failures and jerk against the number of checks, and failures against the time of a decision."""
    solved_at_once = ("PlanarReach-v0", "PandaReach-v0", "PlanarTargetJump-v0")
    tasks = [env for env in record if "sobol-64" in record[env].get("test", {}) and env not in solved_at_once]
    figure, axes = plt.subplots(3, len(tasks), figsize=(3.6 * len(tasks), 8.4), squeeze=False, sharey="row")
    kinds = {
        "viaq": ("agent", "#1f5fa8", "o"),
        "sobol": ("Sobol order", "#c2571a", "s"),
        "random": ("random", "#777777", "^"),
    }
    for column, env in enumerate(tasks):
        for kind, (label, colour, marker) in kinds.items():
            found = {}
            for name, entry in record[env]["test"].items():
                head, _, number = name.rpartition("-")
                if head == kind:
                    found[int(number)] = entry
            checks = sorted(found)
            failures = [max(100.0 * (1.0 - statistics.mean(found[n]["success"])), 0.05) for n in checks]
            jerk = [np.mean([j for j in found[n]["jerk_ratio"] if j is not None] or [np.nan]) for n in checks]
            times = [1e3 * statistics.median(found[n]["decision_time"]) for n in checks]
            style: dict[str, Any] = {"label": label, "color": colour, "marker": marker, "markersize": 4}
            axes[0, column].plot([max(n, 0.5) for n in checks], failures, **style)
            axes[1, column].plot([max(n, 0.5) for n in checks], jerk, **style)
            axes[2, column].plot(times, failures, **style)
        axes[0, column].set_title(env.removesuffix("-v0"), fontsize=10)
        for row, what in enumerate(("checks per decision", "checks per decision", "time of a decision [ms]")):
            axes[row, column].set_xscale("log")
            axes[row, column].set_xlabel(what)
            axes[row, column].grid(alpha=0.3)
        for row in (0, 1):
            axes[row, column].set_xticks([0.5, 1, 4, 16, 64, 512], ["0", "1", "4", "16", "64", "512"])
            axes[row, column].minorticks_off()
        shortest, longest = axes[2, column].get_xlim()
        ticks = [each for each in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if shortest <= each <= longest]
        axes[2, column].set_xticks(ticks, [f"{each:g}" for each in ticks])
        for row in (0, 2):
            axes[row, column].set_yscale("log")
            axes[row, column].set_yticks([0.05, 0.1, 1, 10, 100], ["0", "0.1", "1", "10", "100"])
            axes[row, column].minorticks_off()
    for row, what in enumerate(("failures [%]", "jerk ratio", "failures [%]")):
        axes[row, 0].set_ylabel(what)
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
