"""Command `study`: run what is missing of a study, and write its pages."""

from __future__ import annotations

import fnmatch
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from viapoint.training.config.configs import StudyConfig
from viapoint.training.io.files import read_json, write_json
from viapoint.training.study.config import Environment, Study
from viapoint.training.study.figures import draw_figures
from viapoint.training.study.jobs import baseline_jobs, measured_files, training_jobs
from viapoint.training.study.page import write_pages
from viapoint.training.study.results import Row, gather, rows_in
from viapoint.training.study.runners import Job, make_runner
from viapoint.training.study.timing import remove_times, time_decisions

Step = Literal["train", "evaluate", "baselines", "time", "page"]
Report = Callable[[str], object]
STEPS: tuple[Step, ...] = get_args(Step)


class StudyFailedError(Exception):
    """Some jobs of a study failed; the others are done, and the same command tries again."""

    exit_code = 1
    """Exit code of the command."""


def run(config: StudyConfig) -> None:
    """Run a study from the command line."""
    report = functools.partial(print, flush=True)
    run_study(
        config.file, on=config.on, workers=config.workers, only=config.only, redo=config.redo, report=report
    )


def run_study(
    study: Study | str | Path,
    *,
    on: str = "local",
    workers: int | None = None,
    only: Sequence[str] = STEPS,
    redo: Sequence[str] = (),
    report: Report | None = None,
) -> dict[str, Any]:
    """Run what is missing of a study, and write its record, figures and pages.

    Trainings and measurements that exist are kept, so the same call continues where another one stopped, on any
    machine. Results do not depend on where and in which order jobs ran.

    Args:
        study: Study, or its YAML file.
        on: `local`; `ray` for the cluster of the environment variable RAY_ADDRESS, or without it for a Ray of this
            machine; or `ray://HOST:PORT`.
        workers: Number of parallel jobs. Locally 1 by default, and 0 for this process. On Ray all that fit by default.
        only: Steps to run: `train`, `evaluate`, `baselines`, `time` and `page`.
        redo: Patterns of rows, such as `viaq/*`, or of environments and rows, such as `PandaReach-v0/*`, whose
            measurements by these steps are removed first and made again. Trainings are kept.
        report: Function that takes a line about each finished job, timing and file, such as `print`.

    Returns:
        The record, which is in the study's JSON file as well.

    Raises:
        ValueError: The study, a step, a pattern or the cluster is not allowed; the message lists what is.
        StudyFailedError: Jobs failed; the others are done.

    Example:
        >>> import tempfile
        >>> from viapoint.training import Study, run_study
        >>> given = {"environments": ["viapoint/PlanarReach-v0"], "baselines": ["straight", "search64"]}
        >>> study = Study.from_dict({**given, "out": tempfile.mkdtemp()}, name="reach")
        >>> record = run_study(study, workers=0, only=["baselines", "page"])
        >>> [row["label"] for row in record["environments"]["viapoint/PlanarReach-v0"]["rows"]]
        ['straight', 'search64']
    """
    for step in only:
        if step not in STEPS:
            raise ValueError(f"only must be some of {', '.join(STEPS)}, got {step!r}")
    study = study if isinstance(study, Study) else Study.from_yaml(study)
    report = report or (lambda line: None)
    steps = set(only)
    before = read_json(study.page.record) if study.page.record.is_file() else None
    if redo:
        _remove_measurements(study, redo, steps, report)
    jobs = list(training_jobs(study, only)) if steps & {"train", "evaluate"} else []
    jobs += baseline_jobs(study, of_equal_time=False) if "baselines" in steps else []
    failed = []
    if jobs or steps & {"baselines", "time"}:
        failed = _measure(study, jobs, steps, on, workers, report)
    record = gather(study, before)
    if "page" in steps:
        write_json(study.page.record, record)
        for path in [
            *draw_figures(record, study.page.figures, study.page.shown),
            *write_pages(record, study.page),
        ]:
            report(str(path))
    if failed:
        raise StudyFailedError(f"{len(failed)} jobs failed: {'; '.join(failed)}")
    return record


def _remove_measurements(study: Study, patterns: Sequence[str], steps: set[str], report: Report) -> None:
    """Remove the measurements and decision times of rows, so that the steps make them again."""
    rows = [(env, row) for env in study.environments for row in rows_in(study, env)]
    for pattern in patterns:
        if not any(_matches(row, env, pattern) for env, row in rows):
            allowed = ", ".join(dict.fromkeys(row.id for _, row in rows))
            raise ValueError(f"redo must match rows; those of the study are {allowed}; got {pattern!r}")
    for env, row in rows:
        if any(_matches(row, env, pattern) for pattern in patterns):
            removed = 0
            if ("baselines" if row.mode is None else "evaluate") in steps:
                for path in measured_files(study, env, row.entry, row.mode):
                    removed += path.is_file()
                    path.unlink(missing_ok=True)
            if "time" in steps:
                removed += remove_times(study, env, row.id)
            report(f"{env.folder} {row.id}: {removed} measurements removed")


def _matches(row: Row, env: Environment, pattern: str) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for name in (row.id, f"{env.folder}/{row.id}"))


def _measure(
    study: Study, jobs: Sequence[Job], steps: set[str], on: str, workers: int | None, report: Report
) -> list[str]:
    """Run jobs, then timings alone, then the searches that they decide; return what failed."""
    study.out.mkdir(parents=True, exist_ok=True)
    failed: list[str] = []

    def run_all(jobs: Sequence[Job]) -> None:
        with make_runner(on, study.out, workers) as runner:
            began = time.monotonic()
            report(f"{len(jobs)} jobs; Ctrl-C saves, and the same command goes on")
            for number, (job, answer) in enumerate(runner.run(jobs), 1):
                minutes = (time.monotonic() - began) / 60.0
                where = f" on {answer.place}" if answer.place else ""
                text = f"FAILED: {answer.error}" if answer.error else answer.value
                report(f"[{number}/{len(jobs)}, {minutes:.1f} min] {job.label}{where}: {text}")
                if answer.error:
                    failed.append(f"{job.label}: {answer.error}")

    if jobs:
        run_all(jobs)
    if "time" in steps:
        for line in time_decisions(study):
            report(line)
    later = list(baseline_jobs(study, of_equal_time=True)) if "baselines" in steps else []
    if later:
        run_all(later)
    return failed
