"""Runner of jobs in processes of this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, NamedTuple, Self

from viapoint.training.study.runners.job import LINEAR_ALGEBRA, Answer, Job, answer


class LocalRunner:
    """Runner on this machine in `workers` processes, which share the cores; with 0 it runs jobs in this process."""

    def __init__(self, root: Path, workers: int = 1) -> None:
        self._root, self._workers = root, workers
        self._idle: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._idle:
            worker.stop()
        self._idle.clear()

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Answer]]:
        """Run jobs, see :class:`Runner`."""
        if not self._workers:
            yield from ((job, answer(job, self._root)) for job in jobs)
            return
        queue, again = ((job, 0) for job in jobs), list[tuple[Job, int]]()
        free, running = _shares(self._workers), dict[Any, _Task]()
        try:
            while True:
                while free and (following := again.pop(0) if again else next(queue, None)):
                    job, retries = following
                    wanted = min(job.cpus, self._workers)
                    if wanted > len(free):
                        again.insert(0, following)
                        break
                    mine, free = free[:wanted], free[wanted:]
                    worker = self._idle.pop() if self._idle else _Worker(self._root)
                    worker.begin(job, sorted({core for share in mine for core in share}))
                    running[worker.pipe] = _Task(worker, job, mine, retries)
                if not running:
                    return
                for pipe in wait(list(running)):
                    task = running.pop(pipe)
                    found = task.worker.answer()
                    free += task.cores
                    if found is not None:
                        self._idle.append(task.worker)
                        yield task.job, found
                    elif task.retries < task.job.retries:
                        again.append((task.job, task.retries + 1))
                    else:
                        code = task.worker.process.exitcode
                        yield task.job, Answer(error=f"its process ended with code {code}")
        finally:
            _interrupt([task.worker for task in running.values()])


class _Task(NamedTuple):
    """Job in a worker."""

    worker: _Worker
    job: Job
    cores: list[list[int]]
    retries: int


class _Worker:
    """Process that runs one job after the other."""

    def __init__(self, root: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, root), name="viapoint worker")
        before = {name: os.environ.get(name) for name in LINEAR_ALGEBRA}
        os.environ.update(LINEAR_ALGEBRA)
        try:
            self.process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        theirs.close()

    def begin(self, job: Job, cores: Sequence[int]) -> None:
        """Start a job; a process that has died tells so in :meth:`answer`."""
        with contextlib.suppress(BrokenPipeError):
            self.pipe.send((job, cores))

    def answer(self) -> Answer | None:
        """Return the answer of the job, or None if the process has died."""
        try:
            found: Answer = self.pipe.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            return None
        return found

    def stop(self) -> None:
        """End the process after its job."""
        self.pipe.close()
        self.process.join()


def _shares(workers: int) -> list[list[int]]:
    """Return the cores of each worker."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return [cores[i::workers] or cores for i in range(workers)]


def _serve(pipe: Any, root: Path) -> None:
    """Run the jobs that come through a pipe, until it is closed."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # Ctrl-C in the terminal reaches the parent alone, which passes it on once
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background processes ignore
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            job, cores = pipe.recv()
            if cores and hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(0, cores)
            pipe.send(answer(job, root))


def _leave_with_parent() -> None:
    """Interrupt this process as by Ctrl-C when its parent has ended; a training saves itself first."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGINT)


def _interrupt(workers: Sequence[_Worker]) -> None:
    """Interrupt running jobs and wait for them; a second Ctrl-C ends them at once."""
    if not workers:
        return
    print(f"saving {len(workers)} running jobs; Ctrl-C again leaves at once", file=sys.stderr, flush=True)
    try:
        for worker in workers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.process.pid or 0, signal.SIGINT)
        for worker in workers:
            worker.stop()
    except KeyboardInterrupt:
        for worker in workers:
            worker.process.kill()
        raise
