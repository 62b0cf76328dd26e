"""Processes that run an object: commands through a socket, arrays of results through shared memory.

Python's `multiprocessing` starts its processes by a fork, which is unsafe beside the threads of MuJoCo and torch, or by
importing the main module again, which needs a guard in every script. Here a process imports only what its object needs.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from gymnasium.vector.utils import CloudpickleWrapper

ALIGNMENT = 64
LARGEST = 1 << 26
"""Largest message in shared memory, which is kept for the next ones, [bytes]; larger ones go through the socket."""
COMMAND = "from viapoint.envs.worker_process import serve; serve()"
PATIENCE = 5.0
"""Time that a process has to end by itself, [s]."""


class WorkerDiedError(RuntimeError):
    """A worker process ended before its work was done."""


class SharedMemory:
    """Memory that two processes share by an open file without a name, which the system frees when both have ended."""

    def __init__(self, file: int | None = None) -> None:
        self.file = _open_unnamed() if file is None else file
        self._map: mmap.mmap | None = None

    def view(self, size: int) -> memoryview:
        """Return the first bytes of the memory, which grows where it is smaller.

        Raises:
            OSError: There is no memory left.
        """
        if self._map is None or len(self._map) < size:
            if os.fstat(self.file).st_size < size:
                _extend(self.file, 2 * size)
            self._map = mmap.mmap(self.file, 0)  # arrays of earlier messages keep the old one alive
        return memoryview(self._map)[:size]


def _open_unnamed() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("viapoint")
    file, path = tempfile.mkstemp()
    os.unlink(path)
    return file


def _extend(file: int, size: int) -> None:
    if hasattr(os, "posix_fallocate"):  # fails now, where a page without memory would kill the process later
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def send(connection: Connection, memory: SharedMemory, message: Any, shared: bool) -> None:
    """Send a message; if `shared`, its arrays go through shared memory, where they stay until the next message."""
    if not shared:
        connection.send((pickle.dumps(message, protocol=5), []))
        return
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    spans, end = [], 0
    for array in arrays:
        spans.append((end, array.nbytes))
        end += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
    if end > LARGEST:
        send(connection, memory, message, shared=False)
        return
    view = memory.view(max(end, 1))
    for array, (first, size) in zip(arrays, spans, strict=True):
        view[first : first + size] = array
    connection.send((body, spans))


def receive(connection: Connection, memory: SharedMemory) -> Any:
    """Receive what :func:`send` sent."""
    body, spans = connection.recv()
    view = memory.view(max((first + size for first, size in spans), default=1))
    return pickle.loads(body, buffers=[view[first : first + size] for first, size in spans])


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
    connection, memory = Connection(int(sys.argv[1])), SharedMemory(int(sys.argv[2]))
    try:
        server: Any = None
        ready: tuple[bool, Any] = (True, None)
        try:
            server = connection.recv().fn()
        except Exception as error:
            ready = (False, _portable(error))
        send(connection, memory, ready, shared=False)
        while True:
            command, arguments, shared = connection.recv()
            send(connection, memory, answer(server, command, arguments), shared)
    except (EOFError, ConnectionError):
        pass


class WorkerProcess:
    """Process that runs one object; :meth:`submit` and :meth:`result` call its methods.

    The first result, None, tells that the object has been made.
    """

    def __init__(self, make: Callable[[], Any], title: str, threads: int) -> None:
        self.title = title
        self._memory = SharedMemory()
        self._connection, theirs = Pipe()
        files = theirs.fileno(), self._memory.file
        path = os.pathsep.join(os.path.abspath(each) for each in sys.path)
        limits = {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "OPENBLAS", "MKL")}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", COMMAND, *map(str, files)],
            env={**limits, **os.environ, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            pass_fds=files,
        )
        theirs.close()
        self._pending = 0
        self._send(CloudpickleWrapper(make))

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def submit(self, command: str, arguments: tuple[Any, ...], *, shared: bool) -> None:
        """Begin to call a method of the object; results that nobody took are dropped.

        The arrays of a shared result stay in shared memory until the next call of this method.
        """
        while self._pending:
            self._receive()
        self._send((command, arguments, shared))

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
        if self._memory.file >= 0:
            os.close(self._memory.file)
            self._memory.file = -1

    def _send(self, message: Any) -> None:
        self._pending += 1
        try:
            self._connection.send(message)
        except OSError:
            raise self._death() from None

    def _receive(self) -> Any:
        try:
            received = receive(self._connection, self._memory)
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
