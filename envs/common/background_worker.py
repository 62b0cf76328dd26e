"""Worker thread for NumPy code that runs while the physics engine steps."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

R = TypeVar("R")


class BackgroundWorker:
    """Executor of jobs in order, in one thread or immediately; the results are the same."""

    def __init__(self, threaded: bool) -> None:
        """Choose a thread, which starts with the first job, or immediate execution."""
        self._threaded = threaded
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, job: Callable[..., R], *arguments: Any) -> Future[R]:
        """Return a future of `job(*arguments)`."""
        if not self._threaded:
            done: Future[R] = Future()
            done.set_result(job(*arguments))
            return done
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="viapoint")
        return self._pool.submit(job, *arguments)

    def close(self) -> None:
        """Stop the thread after its jobs; the next job starts a new one."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
