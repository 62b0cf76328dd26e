"""Jobs, and the protocol of what runs them; :mod:`viapoint.training.study.runners` describes both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

LINEAR_ALGEBRA = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment variables of the processes that run jobs: one thread each, so that results agree on all machines."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """Call of a function that leaves its results in one folder."""

    label: str
    """Name in progress lines, unique among the jobs of a call."""
    function: Callable[..., Any]
    """Importable function, which is called as `function(root, *arguments)`."""
    arguments: tuple[Any, ...] = ()
    """Further arguments, picklable."""
    folder: str = ""
    """Folder below `root` that the job reads and writes, the only one; empty if there is none."""
    cpus: int = 1
    """Number of cores."""
    resources: Mapping[str, float] = field(default_factory=dict)
    """Further resources that a Ray node must have, such as {"GPU": 1}; they have no effect on this machine."""
    retries: int = 3
    """Number of times that the job runs again after its process was killed or its node was lost."""


class Answer(NamedTuple):
    """End of a job."""

    value: Any = None
    """Returned value."""
    error: str = ""
    """One line that describes the error; empty on success."""
    place: str = ""
    """Name of the machine, on a cluster."""


class Runner(Protocol):
    """Executor of jobs; a context, at whose end its processes are stopped."""

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Answer]]:
        """Run jobs and yield each with its answer when it has ended."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...


def answer(job: Job, root: Path) -> Answer:
    """Call the function of a job and return its value or its error."""
    try:
        return Answer(job.function(root, *job.arguments))
    except Exception as error:
        return Answer(error=" ".join(f"{type(error).__name__}: {error}".split()))
