"""Progress bars, which are shown on terminals alone."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm.auto import tqdm  # a bar of its own kind in a notebook


def progress_bar(**settings: Any) -> Any:
    """Return a bar of tqdm on the standard error output, which shows nothing if that is no terminal."""
    return tqdm(**{"disable": None, "file": sys.stderr, "dynamic_ncols": True, **settings})


@contextmanager
def scene_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar over the scenes of each method; the context is a function of name, finished and all scenes."""
    with progress_bar(unit=" scenes", delay=0.01) as bar:
        shown = ""

        def progress(name: str, done: int, total: int) -> None:
            nonlocal shown
            if name != shown:
                shown = name
                bar.reset(total)
                bar.set_description(name)
            bar.update(done - bar.n)

        yield progress
