"""Processes that run an object: commands and their results go through a socket.

Python's `multiprocessing` starts its processes by a fork, which is unsafe beside the threads of MuJoCo and torch, or by
importing the main module again, which needs a guard in every script. Here a process imports only what its object needs.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from gymnasium.vector.utils import CloudpickleWrapper

COMMAND = "from viapoint.envs.worker_process import serve; serve()"
PATIENCE = 5.0
"""Time that a process has to end by itself, [s]."""


class WorkerDiedError(RuntimeError):
    """A worker process ended before its work was done."""


def answer(server: Any, command: str, arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Return True and the result of a method, or False and the error that it raised."""
    try:
        return True, getattr(server, command)(*arguments)
    except Exception as error:
        return False, _portable(error)


def _portable(error: Exception) -> Exception:
    """Return an error that another process can raise; errors other than those of arguments tell where they arose."""
    if not isinstance(error, ValueError | TypeError):
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
    return error


def serve() -> None:
    """Run an object in this process until its parent closes the socket."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    connection = Connection(int(sys.argv[1]))
    try:
        server: Any = None
        ready: tuple[bool, Any] = (True, None)
        try:
            server = connection.recv().fn()
        except Exception as error:
            ready = (False, _portable(error))
        connection.send(ready)
        while True:
            command, arguments = connection.recv()
            connection.send(answer(server, command, arguments))
    except (EOFError, ConnectionError):
        pass


class WorkerProcess:
    """Process that runs one object; :meth:`submit` and :meth:`result` call its methods.

    The first result, None, tells that the object has been made.
    """

    def __init__(self, make: Callable[[], Any], title: str, threads: int) -> None:
        self.title = title
        self._connection, theirs = Pipe()
        path = os.pathsep.join(os.path.abspath(each) for each in sys.path)
        limits = {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "OPENBLAS", "MKL")}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", COMMAND, str(theirs.fileno())],
            env={**limits, **os.environ, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(),),
        )
        theirs.close()
        self._pending = 0
        self._send(CloudpickleWrapper(make))

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def submit(self, command: str, arguments: tuple[Any, ...]) -> None:
        """Begin to call a method of the object; results that nobody took are dropped."""
        while self._pending:
            self._receive()
        self._send((command, arguments))

    def result(self) -> Any:
        """Return the result of the method.

        Raises:
            WorkerDiedError: The process ended.
        """
        succeeded, value = self._receive()
        if not succeeded:
            raise value
        return value

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, message: Any) -> None:
        self._pending += 1
        try:
            self._connection.send(message)
        except OSError:
            raise self._death() from None

    def _receive(self) -> Any:
        try:
            received = self._connection.recv()
        except (EOFError, OSError):
            raise self._death() from None
        self._pending -= 1
        return received

    def _death(self) -> WorkerDiedError:
        try:
            code = self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            return WorkerDiedError(f"{self.title} does not answer any more")
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return WorkerDiedError(f"{self.title} {how}")
