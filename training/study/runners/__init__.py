"""Runners of jobs: the same jobs on the cores of this machine, or on a Ray cluster, with equal results.

A :class:`Job` is a call of a function that leaves its results in one folder. A :class:`Runner` yields each job with its
:class:`Answer` as soon as it has ended, in any order:

    with make_runner("local", Path("runs/mine"), workers=2) as runner:
        for job, answer in runner.run(jobs):
            print(job.label, answer.error or answer.value)

* `run` takes any iterable and asks for the next job when there is room for it, so a generator can decide late.
* A job runs in another process, on its own cores and with one thread for linear algebra. Its function must be
  importable by name, and its arguments and its value must be picklable.
* An exception of a job is an answer with `error`, one line; other jobs go on. A job whose process was killed, or whose
  node was lost, runs again, `retries` times; it finds the files that its folder had.
* Ctrl-C, an error in the loop's body, or `close()` of the iterator interrupts the running jobs as Ctrl-C does (a
  training saves a checkpoint) and waits for them. Run the same jobs again to continue.

A function sees its folder as `root / job.folder`. Locally, `root` is that of the runner. On Ray it is a temporary
folder of the node, which is filled before the job with what the driver has in `job.folder`, and copied back while it
runs.
"""

from __future__ import annotations

from pathlib import Path

from viapoint.training.study.runners.job import Answer, Job, Runner
from viapoint.training.study.runners.local import LocalRunner
from viapoint.training.study.runners.on_ray import RayRunner

__all__ = ["Answer", "Job", "LocalRunner", "RayRunner", "Runner", "make_runner"]


def make_runner(on: str, root: Path, workers: int | None = None) -> Runner:
    """Return a runner for the folders of jobs in `root`; `on` and `workers` are those of :func:`run_study`.

    Raises:
        ValueError: `on` is no place, or the cluster cannot be reached or has another version of this package.
        ImportError: Ray is not installed.
    """
    if on == "local":
        return LocalRunner(root, 1 if workers is None else workers)
    if on == "ray" or on.startswith("ray://"):
        return RayRunner(root, None if on == "ray" else on, workers)
    raise ValueError(f"on must be local, ray or ray://HOST:PORT, got {on!r}")
