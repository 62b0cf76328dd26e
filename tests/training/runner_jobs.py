"""Functions that the tests of runners and studies run in other processes."""

import os
import signal
import time


def square(root, number):
    return number**2


def fail(root, words):
    raise ValueError(words)


def die_first(root, folder, times):
    """Count calls in a file, and kill the process in the first ones."""
    path = root / folder / "calls"
    path.parent.mkdir(parents=True, exist_ok=True)
    calls = int(path.read_text()) + 1 if path.exists() else 1
    path.write_text(str(calls))
    time.sleep(1.6 * (root.name == "node"))  # the driver copies files from time to time
    if calls <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return calls


def wait_for_interrupt(root, folder):
    """Write a file when interrupted, as a training does."""
    path = root / folder / "state"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.write_text("begun")
        time.sleep(60.0)
    except KeyboardInterrupt:
        path.write_text("saved")
        raise


def surroundings(root):
    """Return what may differ between runners and must not."""
    return os.environ["OMP_NUM_THREADS"], len(os.sched_getaffinity(0))


def identity(root):
    return os.getpid()
