"""Wall time of a study on two Ray nodes of one core each, relative to two local processes, in alternating runs.

    python benchmarks/ray_study.py --json runs/ray_study.json

takes about four minutes on two idle cores. Both nodes are on this machine. A round runs the same study in both ways,
every other round in the opposite order, and compares weights and evaluations. The time of a run includes the start of
the processes that train; the start of the nodes is a number of its own. Processor times are those of the command and
of all processes that it or the nodes started; other load on the machine hardly changes them. Rounds are added to those
in the file.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from workers import free_cores

from viapoint.training import Study, run_study
from viapoint.training.io.ray_cluster import LOOPBACK, import_ray

WAYS = ("local", "ray")
ENV = "viapoint/PlanarObstacles-v0"
RESULTS = ("weights.safetensors", "evaluations")
"""Parts of the paths of files that must be equal."""


def study_in(folder: Path, trainings: int, decisions: int) -> Study:
    """Return the study: trainings of `viaq` that differ in their seeds, with checkpoints and evaluations."""
    agent = {
        "n_timesteps": decisions,
        "eval_every": decisions // 2,
        "checkpoint_every": decisions // 2,
        "eval_scenes": 100,
        "hyperparameters": {"learning_starts": 512, "gradient_steps": 4},
    }
    environment = {"n_scenes": 250, "scenes": ["test"]}
    return Study.from_dict(
        {
            "out": str(folder),
            "seeds": list(range(trainings)),
            "environments": {ENV: environment},
            "agents": {"viaq": agent},
        }
    )


@contextlib.contextmanager
def two_nodes() -> Iterator[Any]:
    """Start two nodes of one core each, which listen on 127.0.0.1, connect to them, and return them."""
    ray = import_ray()
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1")
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def processor_time(cluster: Any = None) -> float:
    """Return the processor time of this process, of its children that have ended, and of the nodes, [s]."""
    usage = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    total = sum(each.ru_utime + each.ru_stime for each in usage)
    if cluster is None:
        return total
    import psutil  # part of Ray

    started = [
        each.process.pid
        for node in cluster.list_all_nodes()
        for some in node.all_processes.values()
        for each in some
    ]
    processes = {
        child
        for pid in started
        for child in [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    }
    return total + sum(sum(each.cpu_times()[:4]) for each in processes)


def timed(way: str, trainings: int, decisions: int) -> dict[str, Any]:
    """Run the study once; return times and a hash of its results.

    Times are those of the start of the nodes, of the study, and the processor time of the study, [s].
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        began = time.perf_counter()
        cluster = stack.enter_context(two_nodes()) if way == "ray" else None
        ready, worked = time.perf_counter(), processor_time(cluster)
        study = study_in(Path(folder), trainings, decisions)
        run_study(study, on=way, workers=2 if way == "local" else None, only=["train", "evaluate"])
        ended, done = time.perf_counter(), processor_time(cluster)
        return {
            "start_s": ready - began,
            "study_s": ended - ready,
            "processor_s": done - worked,
            "sha256": results_hash(study.out),
        }


def results_hash(folder: Path) -> str:
    """Return the hash of all weights and evaluations."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        if any(part in name for part in RESULTS) and "checkpoints" not in name:
            digest.update(name.encode() + path.read_bytes())
    return digest.hexdigest()


def ratios(rounds: list[dict[str, Any]], name: str) -> dict[str, float]:
    """Return the median, least and greatest time of local processes relative to that on Ray."""
    found = [each["local"][name] / each["ray"][name] for each in rounds]
    return {"median": float(np.median(found)), "least": min(found), "greatest": max(found)}


def main() -> None:
    """Measure, print, and add to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--trainings", type=int, default=6)
    parser.add_argument("--decisions", type=int, default=10240)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    os.environ.update(LOOPBACK)
    settings = {"cores": os.cpu_count(), "trainings": options.trainings, "decisions": options.decisions}
    rounds: list[dict[str, Any]] = []
    if options.json and options.json.is_file():
        before = json.loads(options.json.read_text())
        rounds = before["rounds"] if before["settings"] == settings else []
    result: dict[str, Any] = {}
    for _ in range(options.rounds):
        found: dict[str, Any] = {"free_cores": free_cores()}
        for way in WAYS if len(rounds) % 2 else WAYS[::-1]:
            found[way] = timed(way, options.trainings, options.decisions)
            print(
                f"{way}: {found[way]['study_s']:.1f} s after a start of {found[way]['start_s']:.1f} s",
                flush=True,
            )
        rounds.append(found)
        result = {
            "settings": settings,
            "efficiency": ratios(rounds, "study_s"),
            "efficiency_processor": ratios(rounds, "processor_s"),
            "equal_results": len({each[way]["sha256"] for each in rounds for way in WAYS}) == 1,
            "rounds": rounds,
        }
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({name: each for name, each in result.items() if name != "rounds"}, indent=1))


if __name__ == "__main__":
    main()
