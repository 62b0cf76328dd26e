"""Progress bar of commands."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm.auto import tqdm


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar over the scenes of each method."""
    with tqdm(unit=" scenes", file=sys.stderr, dynamic_ncols=True) as bar:

        def progress(name: str, done: int, total: int) -> None:
            if bar.desc != f"{name}: ":
                bar.reset(total)
                bar.set_description(name)
            bar.update(done - bar.n)

        yield progress
