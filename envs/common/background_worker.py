"""A thread beside the physics: NumPy works there while the engine, in C, works here."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

R = TypeVar("R")


class BackgroundWorker:
    """Does jobs in order, in a thread of its own or at once; what comes out is the same."""

    def __init__(self, threaded: bool) -> None:
        """Take a thread, which starts with the first job, or none."""
        self._threaded = threaded
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, job: Callable[..., R], *arguments: Any) -> Future[R]:
        """A promise of what `job(*arguments)` returns."""
        if not self._threaded:
            done: Future[R] = Future()
            done.set_result(job(*arguments))
            return done
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="viapoint")
        return self._pool.submit(job, *arguments)

    def close(self) -> None:
        """Let the thread go."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
