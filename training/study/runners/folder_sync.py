"""Copies of a job's folder between a node and the driver of a cluster, part by part and each part whole or not at all.

A part is a folder with files and without folders, such as a model or a checkpoint; or a file beside folders.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from viapoint.training.io.files import UNFINISHED, write_bytes, write_folder

Changes = dict[str, bytes | None]
"""Parts by their paths: an archive of a folder, whose path ends in a slash; the bytes of a file; None if it is gone."""
Signature = tuple[tuple[str, int, int], ...]

PERIOD = 1.0
"""Time between two looks at a folder, [s]."""
IGNORED = ("lock", "lock.pid")


def parts(folder: Path) -> dict[str, Signature]:
    """Return the parts of a folder, each with names, sizes and times of its files."""
    found: dict[str, Signature] = {}
    for walked, folders, names in os.walk(folder):
        place = Path(walked)
        folders[:] = [name for name in folders if not UNFINISHED.fullmatch(name)]
        files = []
        for name in sorted(names):
            with contextlib.suppress(FileNotFoundError):  # a file may be replaced meanwhile
                if name not in IGNORED and not UNFINISHED.fullmatch(name):
                    state = (place / name).stat()
                    files.append((name, state.st_size, state.st_mtime_ns))
        where = place.relative_to(folder).as_posix()
        if files and not folders and place != folder:
            found[f"{where}/"] = tuple(files)
        else:
            found |= {(PurePosixPath(where) / each[0]).as_posix(): (each,) for each in files}
    return found


def pack(folder: Path, known: dict[str, Signature]) -> Changes:
    """Return the parts that differ from the known ones, and update these."""
    now = parts(folder)
    changes: Changes = dict.fromkeys(known.keys() - now.keys())
    for path in [path for path in now if known.get(path) != now[path]]:
        try:
            changes[path] = _archive(folder / path) if path.endswith("/") else (folder / path).read_bytes()
        except FileNotFoundError:  # replaced meanwhile: next time
            now.pop(path)
    known.clear()
    known.update(now)
    return changes


def unpack(changes: Changes, folder: Path) -> None:
    """Write changed parts to a folder, and remove those that are gone."""
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in changes.items():
        target = folder / path
        if content is None:
            shutil.rmtree(target, ignore_errors=True) if path.endswith("/") else target.unlink(
                missing_ok=True
            )
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.endswith("/"):
            write_folder(target, lambda temporary, content=content: _extract(content, temporary))  # type: ignore[misc]
        else:
            write_bytes(target, content)


def _archive(folder: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(folder.iterdir()):
            if path.is_file() and not UNFINISHED.fullmatch(path.name):
                archive.write(path, path.name)
    return packed.getvalue()


def _extract(content: bytes, folder: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)


class Sender:
    """Thread that sends the changes of a job's folder while it runs, and at its end."""

    def __init__(self, folder: Path, send: Callable[[Changes], object]) -> None:
        self._folder, self._send = folder, send
        self._known = parts(folder)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Sender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._send_changes()

    def _watch(self) -> None:
        while not self._ended.wait(PERIOD):
            self._send_changes()

    def _send_changes(self) -> None:
        if self._folder.is_dir() and (changes := pack(self._folder, self._known)):
            self._send(changes)
