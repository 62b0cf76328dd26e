"""Scheduling of stages across threads; no result depends on it.

The physics engine is C code that releases Python's global lock, so a background thread can compute references and
outcomes in NumPy while the main thread waits for the engine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")
Group = TypeVar("Group")
References = TypeVar("References")
Simulated = TypeVar("Simulated")
Measured = TypeVar("Measured")


class Scheduler:
    """Runner of stages on a background thread, which starts with the first job, or on the calling thread alone."""

    def __init__(self, threaded: bool) -> None:
        self._threaded = threaded
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, job: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Run `job(*arguments)` on the background thread; jobs run one at a time in the order of submission."""
        if not self._threaded:
            return _run_now(job, *arguments)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="viapoint")
        return self._pool.submit(job, *arguments)

    def run(
        self,
        groups: Sequence[Group],
        build_references: Callable[[Group], References],
        simulate: Callable[[References], Simulated],
        measure: Callable[[References, Simulated], Measured],
        meanwhile: Callable[[], Result] | None = None,
    ) -> tuple[list[Measured], Future[Result] | None]:
        """Run three stages over groups: `simulate` on the calling thread, the others on the background thread.

        With one group there is nothing to overlap, and all stages run on the calling thread. The independent job
        `meanwhile` may run during the physics; its future is returned with the results of the last stage.
        """
        submit = self.submit if len(groups) > 1 else _run_now
        references = [submit(build_references, group) for group in groups]
        # The physics waits for the first references only, so the independent job comes after all of them.
        following = None if meanwhile is None else self.submit(meanwhile)
        measured = [submit(measure, each.result(), simulate(each.result())) for each in references]
        return [each.result() for each in measured], following

    def close(self) -> None:
        """Stop the background thread."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _run_now(job: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """Run a job on the calling thread and return its completed future."""
    done: Future[Result] = Future()
    done.set_result(job(*arguments))
    return done
