"""What becomes of sets of scenes that were made again: compared with those shipped, and written where one says so."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes, load, shipped_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to write; nowhere if not said."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--write", action="store_true", help="replace the shipped files")
    where.add_argument("--out", type=Path, help="folder to write to")


def shipped(name: str, env_id: str) -> FrozenScenes | None:
    """A set as it is shipped; None if there is none yet."""
    return load(name, env_id) if shipped_path(name, env_id).is_file() else None


def compare_with_shipped(sets: Iterable[FrozenScenes], arguments: argparse.Namespace) -> bool:
    """Tell each set's hash as soon as it is made, write it if asked to, and return whether all are as shipped."""
    same = True
    for frozen in sets:
        before, path = shipped(frozen.name, frozen.env_id), shipped_path(frozen.name, frozen.env_id)
        if arguments.out is not None:
            arguments.out.mkdir(parents=True, exist_ok=True)
            frozen.save(arguments.out / path.name)
        elif arguments.write:
            frozen.save(path)
        print(
            f"{path.name}: {_bands(frozen)}, sha256 {frozen.sha256}: {_verdict(before, frozen)}", flush=True
        )
        same &= before is not None and before.sha256 == frozen.sha256
    return same


def _bands(frozen: FrozenScenes) -> str:
    counts = ", ".join(f"{label}: {int(np.sum(frozen.band == i))}" for i, label in enumerate(BANDS))
    return f"{len(frozen.share)} scenes ({counts})"


def _verdict(before: FrozenScenes | None, frozen: FrozenScenes) -> str:
    if before is None:
        return "new"
    return "as shipped" if before.sha256 == frozen.sha256 else f"DIFFERENT, shipped is {before.sha256}"
