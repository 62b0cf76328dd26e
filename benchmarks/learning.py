"""Reproduce docs/results.md: trainings, evaluations, baselines, the page and its figures.

    python benchmarks/learning.py --jobs 2
    python benchmarks/learning.py --help

Each training is a run folder and each evaluation a file below --out. Existing ones are kept, so a second call continues
where the first stopped. The page is made from the existing files and states which seeds are included.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import contextlib
import multiprocessing
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

import tyro
from study import aggregate, jobs, page
from study.figures import draw
from study.merge import check_conditions, merged
from study.plan import Study

from viapoint.training.io.files import read_json, write_bytes, write_json

Answer = tuple[bool, str]
"""Success of a job, and its summary or error."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run open jobs, write the page, and return the number of failed jobs; 1 if the page has other conditions."""
    study = tyro.cli(Study, args=arguments, config=(tyro.conf.OmitArgPrefixes,))
    known = study.docs / "results.json"
    before = read_json(known) if known.is_file() and "page" in study.only and not study.alone else None
    try:
        check_conditions(study, before or aggregate.conditions(study))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    failed = run_jobs(jobs.all_jobs(study), study.jobs)
    if "time" in study.only:
        print(jobs.time_decisions(study), flush=True)
    if "page" in study.only:
        record = aggregate.aggregate(study)
        record = record if before is None else merged(record, before)
        study.docs.joinpath("images").mkdir(parents=True, exist_ok=True)
        write_json(known, record)
        write_bytes(study.docs / "results.md", page.page(record).encode())
        for path in draw(record, study.docs / "images"):
            print(path)
        print(study.docs / "results.md")
    for label, reason in failed:
        print(f"failed: {label}: {reason}", file=sys.stderr)
    return len(failed)


def run_jobs(queue: Sequence[jobs.Job], processes: int) -> list[tuple[str, str]]:
    """Run jobs in parallel, print their summaries, and return the labels and errors of those that failed."""
    failed, began = [], time.monotonic()
    for number, (job, (succeeded, summary)) in enumerate(_answers(queue, processes), 1):
        minutes = (time.monotonic() - began) / 60.0
        print(
            f"[{number}/{len(queue)}, {minutes:.1f} min] {job.label}: {'' if succeeded else 'FAILED: '}{summary}",
            flush=True,
        )
        if not succeeded:
            failed.append((job.label, summary))
    return failed


def _answers(queue: Sequence[jobs.Job], processes: int) -> Iterator[tuple[jobs.Job, Answer]]:
    """Yield jobs with their answers as they end; jobs that are done already need no process."""
    here = [job for job in queue if not processes or job.done()]
    yield from ((job, _answer(job)) for job in here)
    waiting = [job for job in queue if job not in here]
    places = list(range(processes))
    running: dict[Any, Any] = {}
    context = multiprocessing.get_context("spawn")
    while waiting or running:
        while waiting and places:
            job, place = waiting.pop(0), places.pop(0)
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(
                target=_run_in_process, args=(job, place, processes, theirs), name=job.label
            )
            process.start()
            theirs.close()
            running[mine] = process, job, place
        ready: list[Any] = wait(list(running))
        for ended in ready:
            process, job, place = running.pop(ended)
            try:
                answer = ended.recv()
            except EOFError:
                process.join()
                answer = False, f"its process ended with code {process.exitcode}"
            process.join()
            places.append(place)
            yield job, answer


def _run_in_process(job: jobs.Job, place: int, processes: int, answer: Any) -> None:
    """Run a job in a process of its own, on its share of the cores, so that times can be compared."""
    threading.Thread(target=_save_and_leave, daemon=True).start()
    if hasattr(os, "sched_getaffinity"):
        mine = sorted(os.sched_getaffinity(0))[place::processes]
        if mine:
            os.sched_setaffinity(0, mine)
    with contextlib.suppress(BrokenPipeError):  # the parent is gone
        answer.send(_answer(job))


def _answer(job: jobs.Job) -> Answer:
    """Run a job and return its success with its summary or error."""
    try:
        return True, job.run(*job.arguments)
    except Exception as error:
        return False, f"{type(error).__name__}: {error}"


def _save_and_leave() -> None:
    """Interrupt this process as by Ctrl-C once its parent is gone; a training saves itself first."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    sys.exit(min(main(), 1))
