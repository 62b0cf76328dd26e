"""Actors of Ray that run an object, and their successors if they die."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from viapoint.envs.worker_env import BatchServer
from viapoint.envs.worker_process import WorkerDiedError, answer
from viapoint.training.io.ray_cluster import check_nodes, connect, import_ray

SNAPSHOT_EVERY = 64
"""Commands between two snapshots of an actor's environments."""
ATTEMPTS = 3
"""Actors that may die at the same point."""
PATIENCE = 300.0
"""Time that an actor has to start, [s]."""
READS = (("get",), ("call", "observe"), ("call", "render"), ("call", "state"))
"""Commands that change nothing, with their first arguments."""


def join_cluster(on: str, workers: int) -> bool:
    """Connect to a cluster for so many rollout workers, `ray` or `ray://HOST:PORT`; return True if this call connected.

    Raises:
        ImportError: Ray is not installed.
        ValueError: There is no such cluster, it is too small, or its nodes have other versions.
    """
    if on != "ray" and not on.startswith("ray://"):
        raise ValueError(f"on must be ray or ray://HOST:PORT, got {on!r}")
    connected = connect(None if on == "ray" else on, workers)
    ray = import_ray()
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if cores < workers:
            raise ValueError(f"the cluster has {cores} cores, fewer than the {workers} that the workers need")
        if len(ray.nodes()) > 1:
            check_nodes()
    except BaseException:
        leave_cluster(connected)
        raise
    return connected


def leave_cluster(connected: bool) -> None:
    """Disconnect if :func:`join_cluster` connected."""
    if connected:
        import_ray().shutdown()


class ActorLostError(Exception):
    """Death of an actor; what it did since its last answer is lost."""


class Host:
    """Object in an actor, whose methods are called by name."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._server: Any = None
        self._made: tuple[bool, Any] = (True, None)
        try:
            self._server = make()
        except Exception as error:
            self._made = (False, error)

    def answer(self, command: str, arguments: tuple[Any, ...]) -> tuple[bool, Any]:
        """Return True and the result of a method, or False and the error that it raised."""
        return answer(self._server, command, arguments)

    def ready(self) -> tuple[bool, Any]:
        """Return True and None if the object was made, or False and the error."""
        return self._made


class ActorHandle:
    """Actor that runs the object that `make` returns on some threads, and its successors if it dies."""

    def __init__(self, make: Callable[[], Any], title: str, threads: int = 1) -> None:
        self._ray = import_ray()
        self._class = self._ray.remote(num_cpus=threads, max_restarts=0, max_task_retries=0)(Host)
        self._make, self.title = make, title
        self.restarts = 0
        """Number of actors that died."""
        self.start()

    def start(self) -> None:
        """Start an actor, whose first result is None."""
        self._actor = self._class.remote(self._make)
        self.reference = self._actor.ready.remote()

    def ask(self, command: str, arguments: tuple[Any, ...]) -> None:
        """Begin to call a method of the object."""
        self.reference = self._actor.answer.remote(command, arguments)

    def take(self) -> Any:
        """Return the result of the method.

        Raises:
            ActorLostError: The actor died.
        """
        errors = self._ray.exceptions
        try:
            succeeded, value = self._ray.get(self.reference)
        except (errors.RayActorError, errors.ObjectLostError) as error:
            self.restarts += 1
            raise ActorLostError(f"{self.title} died ({' '.join(str(error).split())[:200]})") from None
        if not succeeded:
            raise value
        return value

    def wait(self) -> None:
        """Wait until the actor has started.

        Raises:
            ActorLostError: It died.
            WorkerDiedError: There is no room for it.
        """
        ready, _ = self._ray.wait([self.reference], timeout=PATIENCE)
        if not ready:
            raise WorkerDiedError(
                f"{self.title} did not start within {PATIENCE:g} s: the cluster has no core for it"
            )
        self.take()

    def close(self) -> None:
        """End the actor."""
        if self._ray.is_initialized():
            self._ray.kill(self._actor)


class RecoveringActor:
    """Actor with a native batch, whose work is repeated by another actor if it dies; nothing is lost.

    The environments are deterministic: a snapshot of their state and the commands since then restore them exactly.
    """

    def __init__(self, make: Callable[[], BatchServer], title: str, threads: int) -> None:
        self.handle = ActorHandle(make, title, threads)
        self._settings: list[tuple[str, tuple[Any, ...]]] = []
        self._snapshot: Any = None
        self._log: list[tuple[str, tuple[Any, ...]]] = []
        self._last: tuple[str, tuple[Any, ...]] | None = None

    def submit(self, command: str, arguments: tuple[Any, ...]) -> None:
        """Begin to call a method of the object; see :meth:`WorkerProcess.submit`."""
        self._last = command, arguments
        self.handle.ask(command, arguments)

    def result(self) -> Any:
        """Return the result of the method.

        Raises:
            WorkerDiedError: Several actors died of the same command, or there is no room for another one.
        """
        last = self._last
        for _ in range(ATTEMPTS):
            try:
                if last is None:
                    self.handle.wait()
                    return None
                value = self.handle.take()
                self._remember(*last)
                return value
            except ActorLostError as error:
                lost = error
                self._repeat()
        raise WorkerDiedError(f"{lost}, {ATTEMPTS} times at the same point")

    def close(self) -> None:
        """End the actor."""
        self.handle.close()

    def _remember(self, command: str, arguments: tuple[Any, ...]) -> None:
        if command == "set":
            self._settings.append((command, arguments))
        elif not any((command, *arguments)[: len(reads)] == reads for reads in READS):
            self._log.append((command, arguments))
        if command == "execute" and len(self._log) >= SNAPSHOT_EVERY:
            self.handle.ask("call", ("state",))
            self._snapshot, self._log = self.handle.take(), []

    def _repeat(self) -> None:
        """Bring another actor to the state of the one that died, and ask it again."""
        self.handle.start()
        if self._last is None:
            return
        restored = [("call", ("restore", self._snapshot))] if self._snapshot is not None else []
        for command, arguments in (*self._settings, *restored, *self._log, self._last):
            self.handle.ask(command, arguments)  # an actor answers in the order of the questions
