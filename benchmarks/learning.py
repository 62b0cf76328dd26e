"""Everything in docs/results.md, by one command: trainings, evaluations, baselines, the page and its figures.

    python benchmarks/learning.py --jobs 2
    python benchmarks/learning.py --help

Each training is a run folder and each evaluation a file below --out; whatever is there already is kept, so a second
call goes on where the first stopped, and the page is made from what is there and says which seeds are in.
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
from study import gather, page, work
from study.figures import draw
from study.merge import check_conditions, merged
from study.plan import Study

from viapoint.training.io.files import read_json, write_bytes, write_json

Answer = tuple[bool, str]
"""Whether a job went well, and what it told."""


def main(words: Sequence[str] | None = None) -> int:
    """Do what is left to do, write the page, and return how many jobs failed; 1 if the page is of other conditions."""
    study = tyro.cli(Study, args=words, config=(tyro.conf.OmitArgPrefixes,))
    known = study.docs / "results.json"
    before = read_json(known) if known.is_file() and "page" in study.only and not study.alone else None
    try:
        check_conditions(study, before or gather.conditions(study))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    failed = carry_out(work.jobs(study), study.jobs)
    if "time" in study.only:
        print(work.time_decisions(study), flush=True)
    if "page" in study.only:
        record = gather.gather(study)
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


def carry_out(jobs: Sequence[work.Job], processes: int) -> list[tuple[str, str]]:
    """Do the jobs, some at a time, and say how each went; the labels and reasons of those that failed are returned."""
    failed, began = [], time.monotonic()
    for number, (job, (well, told)) in enumerate(_answers(jobs, processes), 1):
        minutes = (time.monotonic() - began) / 60.0
        print(
            f"[{number}/{len(jobs)}, {minutes:.1f} min] {job.label}: {'' if well else 'FAILED: '}{told}",
            flush=True,
        )
        if not well:
            failed.append((job.label, told))
    return failed


def _answers(jobs: Sequence[work.Job], processes: int) -> Iterator[tuple[work.Job, Answer]]:
    """Each job with its answer, in the order in which they end; what is done already needs no process."""
    quick = [not processes or job.done() for job in jobs]
    yield from ((job, _answer(job)) for job, here in zip(jobs, quick, strict=True) if here)
    waiting = [job for job, here in zip(jobs, quick, strict=True) if not here]
    places = list(range(processes))
    running: dict[Any, Any] = {}
    context = multiprocessing.get_context("spawn")
    while waiting or running:
        while waiting and places:
            job, place = waiting.pop(0), places.pop(0)
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(job, place, processes, theirs), name=job.label)
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


def _work(job: work.Job, place: int, processes: int, answer: Any) -> None:
    """Do a job in a process of its own, on its share of the cores, so that times can be compared."""
    threading.Thread(target=_save_and_leave, daemon=True).start()
    if hasattr(os, "sched_getaffinity"):
        mine = sorted(os.sched_getaffinity(0))[place::processes]
        if mine:
            os.sched_setaffinity(0, mine)
    with contextlib.suppress(BrokenPipeError):  # nobody is left to hear it
        answer.send(_answer(job))


def _answer(job: work.Job) -> Answer:
    """Whether a job went well, and what it told."""
    try:
        return True, job.work(*job.arguments)
    except Exception as error:
        return False, f"{type(error).__name__}: {error}"


def _save_and_leave() -> None:
    """Stop as by Ctrl-C once the parent is gone, however it went: a training saves itself first."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    sys.exit(min(main(), 1))
