"""Thread of one tab of the live page, in which all its work is done."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable

Job = Callable[[], None]

TICK = 0.03
"""Time between two pictures of an animation, [s]."""
PAUSE = 0.12
"""Time without other jobs after which `later` jobs are done, [s]."""


class JobThread(threading.Thread):
    """Thread that does jobs one after the other and animates in between.

    Jobs of the same key replace each other while they wait, so that a fast drag skips positions instead of lagging
    behind. Jobs whose key begins with `later` wait for a pause, so that they do not delay what follows in a drag.

    Args:
        name: Name of the thread.
        begin: First job.
        animate: Function that shows the next picture if it is due, and returns True as long as there is more to show.
        end: Last job, also after an error.
        tell: Function that shows an error to the user, in one sentence.
    """

    def __init__(
        self, name: str, *, begin: Job, animate: Callable[[], bool], end: Job, tell: Callable[[str], None]
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._begin, self._animate, self._end, self._tell = begin, animate, end, tell
        self._jobs: dict[str, tuple[float, Job]] = {}
        self._quiet_at = 0.0
        self.posted = time.perf_counter()
        """Time at which the present job was posted, of `time.perf_counter`, [s]."""
        self._wake, self._busy = threading.Condition(), True
        self.closed = False
        """True after :meth:`close`."""

    @property
    def idle(self) -> bool:
        """True if no job waits or is being done."""
        with self._wake:
            return not self._jobs and not self._busy

    def post(self, key: str, job: Job) -> None:
        """Hand a job to the thread; a waiting one of the same key is replaced."""
        with self._wake:
            self._jobs.pop(key, None)
            self._jobs[key] = time.perf_counter(), job
            if not key.startswith("later"):
                self._quiet_at = self._jobs[key][0] + PAUSE
            self._wake.notify()

    def close(self) -> None:
        """End the thread after the job that is being done."""
        with self._wake:
            self.closed = True
            self._wake.notify()

    def run(self) -> None:
        """Do jobs until the thread is closed."""
        try:
            self._begin()
            more = True
            while not self.closed:
                job = self._next(more)
                if job is not None:
                    self.guard(job)
                more = self._animate()
        except Exception:
            if not self.closed:
                traceback.print_exc(file=sys.stderr)
        finally:
            self._end()

    def guard(self, job: Job) -> None:
        """Do a job; an error is told in one sentence."""
        try:
            job()
        except Exception as error:
            if self.closed:
                return
            sentence = " ".join(str(error).split()).removeprefix("scene 0: ")
            known = isinstance(error, ValueError | OSError) or type(error).__module__.startswith("viapoint")
            if not known:
                traceback.print_exc(file=sys.stderr)
                sentence = f"{type(error).__name__}: {sentence}"
            self._tell(f"{sentence[:1].upper()}{sentence[1:].rstrip('.')}.")

    def _next(self, animated: bool) -> Job | None:
        """Return the next job; wait for one, but only for a moment while something is animated."""
        with self._wake:
            self._busy = False
            key = self._due()
            if key is None and not self.closed:
                left = max(self._quiet_at - time.perf_counter(), 0.001) if self._jobs else None
                waits = [each for each in (left, TICK if animated else None) if each is not None]
                self._wake.wait(min(waits, default=None))
                key = self._due()
            if self.closed or key is None:
                return None
            self._busy = True
            self.posted, job = self._jobs.pop(key)
            return job

    def _due(self) -> str | None:
        """Return the key of the next job; None while there is none, or only later ones that wait for a pause."""
        urgent = [key for key in self._jobs if not key.startswith("later")]
        if urgent or time.perf_counter() < self._quiet_at:
            return urgent[0] if urgent else None
        return next(iter(self._jobs), None)
