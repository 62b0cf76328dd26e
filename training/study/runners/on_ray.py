"""Runner of jobs on a Ray cluster. Nodes need no common folder: the driver collects the files of all jobs.

A job works in a temporary folder of its node. It begins with the files that the driver has, and each part of them that
changes is sent to the driver within seconds. So a job that is lost with its node continues elsewhere from the last
checkpoint that was written, and everything is in the folder of the driver when it ends.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

from filelock import FileLock, Timeout

from viapoint.training.io.installed import installed
from viapoint.training.io.ray_cluster import check_nodes, check_versions, connect, import_ray
from viapoint.training.study.runners.folder_sync import Changes, Sender, pack, unpack
from viapoint.training.study.runners.job import LINEAR_ALGEBRA, Answer, Job, answer

POLL = 0.5
"""Time between two looks for files of running jobs, [s]."""
QUEUED = 2
"""Jobs that are handed to Ray for each core of the cluster, so that cores never wait and clusters may grow."""
ONE_THREAD = {"runtime_env": {"env_vars": LINEAR_ALGEBRA}}
"""Option of all functions that run on nodes; those with equal options share processes."""
NODE_ID = "ray.io/node-id"
"""Label that Ray gives to each node."""


class Collector:
    """Actor that holds files of jobs until the driver takes them."""

    def __init__(self) -> None:
        self._waiting: list[tuple[str, int, Changes]] = []

    def put(self, job: str, attempt: int, changes: Changes) -> None:
        """Take changes of a job."""
        self._waiting.append((job, attempt, changes))

    def take(self) -> list[tuple[str, int, Changes]]:
        """Return what there is, once."""
        waiting, self._waiting = self._waiting, []
        return waiting


class _Task(NamedTuple):
    """Job that Ray runs."""

    job: Job
    attempt: int


class RayRunner:
    """Runner on a Ray cluster, see :func:`viapoint.training.study.runners.make_runner`.

    Args:
        root: Folder of the driver that the folders of jobs are in.
        address: Address of the cluster; see :func:`viapoint.training.io.ray_cluster.connect`.
        workers: Number of parallel jobs; all that fit by default.
    """

    def __init__(self, root: Path, address: str | None = None, workers: int | None = None) -> None:
        if workers == 0:
            raise ValueError("workers must be 1 or more on a cluster, got 0")
        self._root, self._workers = root, workers
        self._connected = connect(address, workers)
        self._ray = import_ray()
        self._excluded: set[str] = set()
        try:
            check_nodes(ONE_THREAD)
            from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

            here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=True)
            actor = self._ray.remote(num_cpus=0)(Collector)
            self._collector = actor.options(scheduling_strategy=here).remote()
            self._function = self._ray.remote(max_retries=0)(_run_on_node)
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._connected:
            self._ray.shutdown()

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Answer]]:
        """Run jobs, see :class:`viapoint.training.study.runners.job.Runner`."""
        queue, again, running = (_Task(job, 0) for job in jobs), list[_Task](), dict[Any, _Task]()
        try:
            while True:
                while len(running) < self._room() and (task := again.pop(0) if again else next(queue, None)):
                    running[self._submit(task)] = task
                if not running:
                    return
                ready, _ = self._ray.wait(list(running), timeout=POLL)
                self._collect(running)
                for reference in ready:
                    task = running.pop(reference)
                    found, lost = self._answer(reference, task.job)
                    if lost and task.attempt < task.job.retries:
                        again.append(_Task(task.job, task.attempt + 1))
                    else:
                        yield task.job, found
        finally:
            self._interrupt(running)

    def _room(self) -> int:
        """Return the number of jobs that may be handed to Ray."""
        return self._workers or QUEUED * max(int(self._ray.cluster_resources().get("CPU", 1)), 1)

    def _submit(self, task: _Task) -> Any:
        """Hand a job with the files of its folder to Ray."""
        job = task.job
        folder = self._root / job.folder
        files = pack(folder, {}) if job.folder and folder.is_dir() else {}
        needs: dict[str, Any] = {"num_cpus": job.cpus, "name": job.label}
        if "GPU" in job.resources:
            needs["num_gpus"] = job.resources["GPU"]
        needs["resources"] = {name: value for name, value in job.resources.items() if name != "GPU"}
        if self._excluded:
            needs["label_selector"] = {NODE_ID: f"!in({','.join(sorted(self._excluded))})"}
        if not self._nodes_for(job):
            wanted = ", ".join(f"{least:g} {name}" for name, least in _wanted(job).items())
            _warn(f"{job.label} waits for a node with {wanted}; the cluster has none that gets jobs")
        return self._function.options(**needs, **ONE_THREAD).remote(
            job, task.attempt, files, self._collector, installed()
        )

    def _nodes_for(self, job: Job) -> set[str]:
        """Return the ids of the nodes that have what a job needs and may get jobs."""
        return {
            node["NodeID"]
            for node in self._ray.nodes()
            if node["Alive"]
            and node["NodeID"] not in self._excluded
            and all(node["Resources"].get(name, 0) >= least for name, least in _wanted(job).items())
        }

    def _answer(self, reference: Any, job: Job) -> tuple[Answer, bool]:
        """Return the answer of a job that has ended, and whether it may run again."""
        try:
            found, unusable = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            return Answer(error=" ".join(str(error.cause).split())), False
        except self._ray.exceptions.RayError as error:
            return Answer(error=" ".join(f"{type(error).__name__}: {error}".split())), True
        if not unusable or not self._nodes_for(job) - {unusable}:
            return found, False
        if unusable not in self._excluded:
            self._excluded.add(unusable)
            _warn(f"{found.place} gets no further jobs: {found.error}")
        return found, True

    def _collect(self, running: dict[Any, _Task]) -> None:
        """Write the files that have come from nodes."""
        tasks = {task.job.label: task for task in running.values()}
        try:
            collected = self._ray.get(self._collector.take.remote())
        except self._ray.exceptions.RayError as error:
            reason = " ".join(str(error).split())[:200]
            raise ConnectionError(
                f"the Ray cluster is lost; finished jobs are kept, and the same command goes on ({reason})"
            ) from error
        for label, attempt, changes in collected:
            if label in tasks and attempt == tasks[label].attempt:  # a node may seem lost and live on
                unpack(changes, self._root / tasks[label].job.folder)

    def _interrupt(self, running: dict[Any, _Task]) -> None:
        """Interrupt jobs, and take the files that they save; a second Ctrl-C leaves at once."""
        if not running:
            return
        _warn(f"saving {len(running)} jobs; Ctrl-C again leaves at once")
        for reference in running:
            self._ray.cancel(reference)
        waiting = list(running)
        while waiting:
            _, waiting = self._ray.wait(waiting, timeout=POLL)
            self._collect(running)


def _wanted(job: Job) -> dict[str, float]:
    """Return the resources that a node must have for a job."""
    return {"CPU": job.cpus, **job.resources}


def _warn(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _run_on_node(
    job: Job, attempt: int, files: Changes, collector: Any, wanted: dict[str, str]
) -> tuple[Answer, str]:
    """Run a job in a temporary folder, and return its answer, with the node's id if the node cannot run jobs."""
    import ray

    node = ray.get_runtime_context().get_node_id()
    place = f"{socket.gethostname()}/{node[:6]}"

    def send(changes: Changes) -> None:
        ray.get(collector.put.remote(job.label, attempt, changes))

    try:
        check_versions(installed(), wanted, place)
    except ValueError as error:  # a node that has joined since the start
        return Answer(error=str(error), place=place), node
    try:
        with tempfile.TemporaryDirectory(prefix="viapoint-") as scratch, _own_cores(job.cpus):
            root = Path(scratch) / "node"
            root.mkdir()
            if not job.folder:
                return answer(job, root)._replace(place=place), ""
            unpack(files, root / job.folder)
            with Sender(root / job.folder, send):
                found = answer(job, root)
    except OSError as error:
        found = Answer(error=str(error))
    full = os.strerror(errno.ENOSPC) in found.error
    return found._replace(place=place), node if full else ""


@contextlib.contextmanager
def _own_cores(number: int) -> Iterator[None]:
    """Restrict this process to cores that no other job of this machine has, as long as there are some."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    folder = Path(tempfile.gettempdir()) / f"viapoint-cores-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    with contextlib.ExitStack() as stack:
        mine: list[int] = []
        for core in sorted(before):
            if len(mine) < number:
                with contextlib.suppress(Timeout):
                    stack.enter_context(FileLock(folder / str(core)).acquire(timeout=0))
                    mine.append(core)
        if mine:
            os.sched_setaffinity(0, mine)
        try:
            yield
        finally:
            os.sched_setaffinity(0, before)
