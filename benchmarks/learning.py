"""Everything in docs/results.md, by one command: trainings, evaluations, baselines, the page and its figures.

    python benchmarks/learning.py --jobs 2
    python benchmarks/learning.py --help

Each training is a run folder and each evaluation a file below --out; whatever is there already is kept, so a second
call goes on where the first stopped, and the page is made from what is there and says which seeds are in.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import tyro
from study import gather, page, work
from study.figures import draw
from study.plan import Study

from viapoint.training.files import write_bytes, write_json


def main(words: Sequence[str] | None = None) -> int:
    """Do what is left to do, write the page, and return how many jobs failed."""
    study = tyro.cli(Study, args=words, config=(tyro.conf.OmitArgPrefixes,))
    failed = carry_out(work.jobs(study), study.jobs)
    if "time" in study.only:
        print(work.time_decisions(study), flush=True)
    if "page" in study.only:
        record = gather.gather(study)
        study.docs.joinpath("images").mkdir(parents=True, exist_ok=True)
        write_json(study.docs / "results.json", record)
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
    for number, (job, answer) in enumerate(_answers(jobs, processes), 1):
        try:
            told = answer()
        except Exception as error:
            told = f"FAILED: {type(error).__name__}: {error}"
            failed.append((job.label, str(error)))
        minutes = (time.monotonic() - began) / 60.0
        print(f"[{number}/{len(jobs)}, {minutes:.1f} min] {job.label}: {told}", flush=True)
    return failed


def _answers(jobs: Sequence[work.Job], processes: int) -> Iterator[tuple[work.Job, Any]]:
    """Each job with a function that returns its answer or raises its error, in the order in which they end."""
    if not processes:
        for job in jobs:
            yield job, lambda job=job: job.work(*job.arguments)
        return
    context = multiprocessing.get_context("spawn")
    places = context.Queue()
    for place in range(processes):
        places.put((place, processes))
    with ProcessPoolExecutor(processes, context, initializer=_take_place, initargs=(places,)) as pool:
        running = {pool.submit(job.work, *job.arguments): job for job in jobs}
        try:
            for future in as_completed(running):
                yield running[future], future.result
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise


def _take_place(places: Any) -> None:
    """Keep a process to its share of the cores, so that times can be compared."""
    place, processes = places.get()
    if hasattr(os, "sched_getaffinity"):
        mine = sorted(os.sched_getaffinity(0))[place::processes]
        if mine:
            os.sched_setaffinity(0, mine)


if __name__ == "__main__":
    sys.exit(min(main(), 1))
