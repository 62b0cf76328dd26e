"""Progress bars."""

from __future__ import annotations

import sys
from typing import Any

from tqdm.auto import tqdm  # a bar of its own kind in a notebook


def progress_bar(**settings: Any) -> Any:
    """Return a bar of tqdm on the standard error output, which shows nothing if that is no terminal."""
    return tqdm(**{"disable": None, "file": sys.stderr, "dynamic_ncols": True, **settings})
