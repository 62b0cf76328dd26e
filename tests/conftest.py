"""Fixtures for tests that start Ray."""

import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest
from filelock import FileLock

# Ray reads this once, when it is imported; otherwise it replaces 127.0.0.1 by another address.
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
LONGEST = 600
"""Time that a test with Ray may take, [s]."""


@pytest.fixture(scope="session")
def ray_lock():
    """Lock to hold while a Ray starts: a node has 30 s for it, which several at once on a busy machine may exceed."""
    folder = Path(tempfile.gettempdir())
    yield FileLock(folder / f"viapoint-ray-{os.getuid()}.lock", timeout=3 * LONGEST)
    for session in (folder / "ray").glob(f"session_*_{os.getpid()}"):
        shutil.rmtree(session, ignore_errors=True)  # logs, which Ray leaves


@pytest.fixture
def no_hang():
    """Fail a test that waits for ever."""

    def late(*_):
        raise TimeoutError(f"the test takes longer than {LONGEST} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
